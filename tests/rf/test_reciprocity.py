"""Scattering with transmitter and receiver exchanged: what a surface element passes on, in single paths and in total."""

from dataclasses import replace

import numpy as np
import pytest
from furnished import RECEIVERS, TX, F, furnished, spectra
from path_makers import random_directions
from places import LOBBY
from radio_scenes import SlabMaterial
from twin_fields import known_field

import warprrf as wr
from warprrf.rf.em.fresnel import lobe
from warprrf.rf.em.materials import NARROWEST_LOBE
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.exact import ExactEngine
from warprrf.rf.fields.base import RadioField
from warprrf.rf.tracing.model import Effects

WAVELENGTH = SPEED_OF_LIGHT / F
RX = RECEIVERS[0]
MATERIALS = [
    SlabMaterial("walls", 3.0, 0.5, 0.02, 0.5, "directive", 12, reciprocal=True),
    SlabMaterial("block", 6.0, 0.5, np.inf, 0.8, reciprocal=True),
]


def over_the_hemisphere(alpha, reciprocal):
    """What a lobe scatters, from normal to grazing incidence: a product rule of its own."""
    node, weight = np.polynomial.legendre.leggauss(300)
    turn = (np.arange(600) + 0.5) * 2.0 * np.pi / 600
    cos_s, weight = 0.5 * (1.0 + node)[:, None], 0.5 * weight
    for cos_i in (1.0, 0.8, 0.4, 0.1, 0.01, 1e-4):
        cos_mirror = cos_i * cos_s + np.sqrt((1.0 - cos_i**2) * (1.0 - cos_s**2)) * np.cos(turn)
        f = lobe(alpha, cos_i, cos_s, cos_mirror, reciprocal=reciprocal)
        assert (f >= 0).all()
        yield weight @ f.mean(axis=1) * 2.0 * np.pi


@pytest.mark.parametrize("alpha", [0, 1, 4, 12, 30, 200])
def test_a_reciprocal_lobe_is_symmetric_and_either_kind_scatters_all_that_comes(alpha):
    a, b = (random_directions(2000, seed) for seed in (0, 1))
    a[:, 2], b[:, 2] = np.abs(a[:, 2]), np.abs(b[:, 2])
    cos_mirror = 2.0 * a[:, 2] * b[:, 2] - (a * b).sum(axis=1)
    # f_s cos(theta_i): what the path gain of an element is proportional to
    there, back = (
        lobe(alpha, x[:, 2], y[:, 2], cos_mirror, reciprocal=True) * x[:, 2] for x, y in ((a, b), (b, a))
    )
    np.testing.assert_allclose(there, back, rtol=1e-12, atol=1e-300)
    assert list(over_the_hemisphere(alpha, True)) == pytest.approx([1.0] * 6, rel=1e-9)
    assert list(over_the_hemisphere(alpha, False)) == pytest.approx([1.0] * 6, rel=1e-6)


def test_the_narrowest_lobe_scatters_all_that_comes():
    """Of the kind that is not reciprocal, whose narrow lobes cost no time."""
    assert list(over_the_hemisphere(NARROWEST_LOBE, False)) == pytest.approx([1.0] * 6, rel=1e-6)


def test_light_from_inside_a_surface_and_into_it_is_refused():
    for name, cosines in (("cos_incidence", (-0.3, 0.5)), ("cos_scatter", (0.5, -0.3))):
        with pytest.raises(ValueError, match=name):
            lobe(0, *cosines, 0.2)


def test_a_fields_scattered_power_is_the_same_both_ways():
    plain = known_field()
    field = replace(plain, parameters=replace(plain.parameters, reciprocal=True))

    def total(f, transmitter, receiver):
        return f.path_gains(f.view(receiver, transmitter)).single.sum()

    assert total(field, TX, RX) == pytest.approx(total(field, RX, TX), rel=5e-3)
    assert abs(total(plain, TX, RX) / total(plain, RX, TX) - 1.0) > 0.05


@pytest.mark.parametrize("receiver", [7, *(pytest.param(k, marks=pytest.mark.long) for k in (0, 20))])
def test_the_exact_engine_is_reciprocal_by_sequence_and_in_total(receiver):
    """The seventh receiver is blocked, and gets more than a third of its scattered power by way of mirrors."""
    ds, scene = wr.SpectrumDataset.load(LOBBY / "spectra.nc"), wr.Scene.load(LOBBY / "scene.xml")
    scene = scene.with_materials([replace(m, reciprocal=True) for m in scene.materials])
    effects = Effects(mirrors=1, scatterings=1, transmissions=0, diffractions=0, residual=False)
    ends = np.stack([ds.transmitter, ds.receivers[receiver]])

    def powers(transmitter, receiver):
        known = {"transmitter": transmitter, "frequency_hz": ds.frequency_hz, "shape": (60, 120)}
        engine = ExactEngine(scene, **known, effects=effects)
        found = {paths.sequence: paths.power.sum() for paths in engine.sequences(receiver)}
        return found | {"total": sum(found.values())}

    there, back = powers(*ends), powers(*ends[::-1])
    for name in ("S", "MS", "SM"):
        assert abs(10.0 * np.log10(there[name] / back[name[::-1]])) < 0.05, name
    assert abs(10.0 * np.log10(there["total"] / back["total"])) < 0.05


def test_a_fit_takes_reciprocal_lobes_and_its_file_says_so(tmp_path):
    scene = furnished(*MATERIALS)
    ds = spectra(scene, RECEIVERS[[0, 5]], shape=(20, 40), sub_pixels=4)
    field = RadioField.fit(scene, ds, quick=True, reciprocal=True)
    field.save(tmp_path / "field.safetensors")
    again = RadioField.load(tmp_path / "field.safetensors")
    assert again.parameters.reciprocal
    assert np.array_equal(again.spectrum(RX).path_gain, field.spectrum(RX).path_gain)
    assert not RadioField.fit(scene, ds, quick=True).parameters.reciprocal
