"""The benchmark of arrays: fields before and after readings of pictures that a known field gives."""

from dataclasses import replace
from types import SimpleNamespace

import furnished
import numpy as np

import warprrf as wr
from benchmarks.arrays import ARRAY, SHAPE, _fields, hemisphere, normalised
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.spectra.dataset import SpectrumDataset


def test_a_field_comes_nearer_to_pictures_of_darker_walls_than_its_start():
    scene, places = furnished.furnished(), furnished.RECEIVERS[:3]
    frame = SpectrumDataset.empty(
        transmitter=furnished.TX,
        frequency_hz=28e9,
        shape=(30, 60),
        beam_sigma_rad=furnished.SIGMA,
        floor=1e-14,
    )
    single = wr.Effects(mirrors=1, scatterings=1, transmissions=0, diffractions=0, residual=False)
    start = BistaticField.prior(scene, frame, effects=single)
    darker = replace(start.parameters, log_mirror=start.parameters.log_mirror - 3.0)
    truth = replace(start, parameters=darker)
    asking = ARRAY, hemisphere(SHAPE), furnished.TX
    pictures = normalised(np.stack([truth.array_spectrum(rx, *asking) for rx in places]))
    measured = wr.channel.ArraySpectra(furnished.TX, places, pictures, 28e9, ARRAY, hemisphere(SHAPE))

    def fit(geometry, data):
        return wr.RadioField.fit(geometry, data, model="bistatic", quick=True, effects=single)

    found = _fields(SimpleNamespace(fit=fit), scene, measured, pictures, SimpleNamespace(receivers=places))
    before, after = (np.mean(found["psnr_db"][name]) for name in ("field, no readings", "field"))
    assert after > before + 3.0
