"""Powers that no path gain can be: in another unit, or of what was not taken out."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from places import LOBBY
from radio_scenes import box_mesh

from warprrf.geometry.mesh import Mesh
from warprrf.rf.fields.base import RadioField
from warprrf.rf.spectra.antenna import horn
from warprrf.rf.spectra.dataset import SpectrumDataset, question_spectra
from warprrf.rf.spectra.levels import MARGIN_DB
from warprrf.rf.spectra.readings import Readings, question_readings

TX, RX, F = np.zeros(3), np.array([[2.0, 0, 0], [5.0, 0, 0], [9.0, 3.0, 0]]), 28e9
FREE_DB = 20 * np.log10(299_792_458 / F / (4 * np.pi * np.linalg.norm(RX, axis=1)))
TRUE_DB = FREE_DB + [1.0, 0.5, -25.0]  # the last one is blocked
UNITS = [
    (lambda db: -db, "minus signs"),
    (lambda db: db / 2, "amplitudes"),
    (lambda db: db + 30.0, "dBm"),
    (lambda db: 10 ** (db / 10), "linear powers given as decibels"),
    (lambda db: 10 * np.log10(-db), "given as linear"),
]


def readings(power_db, **settings):
    return Readings(TX, RX, 10 ** (power_db / 10), F, 1e-15, **settings)


def spectra(total_db):
    gain = np.zeros((3, 4, 8))
    gain[:, 1, 2:4] = 0.5 * 10 ** (total_db[:, None] / 10)
    return SpectrumDataset.from_spectra(
        receivers=RX, transmitter=TX, frequency_hz=F, path_gain=gain, beam_sigma_rad=0.3
    )


@pytest.mark.parametrize(("spoil", "unit"), UNITS)
def test_powers_of_another_unit_are_questioned_and_the_unit_guessed(spoil, unit, tmp_path):
    """As much as was transmitted is an error, far above line of sight a warning: in tables, spectra, their files and fits."""
    power_db, good = np.asarray(spoil(TRUE_DB)), spectra(TRUE_DB)
    ends = zip(("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z"), [*np.zeros((3, 3)), *RX.T], strict=True)
    table = dict(ends) | {"power_db": power_db}
    scaled = replace(good, path_gain=good.path_gain * 10 ** ((power_db - TRUE_DB) / 10)[:, None, None])
    scaled.save(tmp_path / "spectra.nc")
    room = Mesh(*box_mesh([-1, -1, -1], [10, 4, 1], inward=True))
    loads = [
        lambda: Readings.from_table(table, frequency_hz=F, floor=1e-15),
        lambda: RadioField.fit(room, readings(power_db), quick=True, iterations=1),
        lambda: spectra(power_db),
        lambda: SpectrumDataset.load(tmp_path / "spectra.nc"),
        lambda: RadioField.fit(room, scaled, quick=True, iterations=1),
    ]
    for load in loads[: 2 if "linear powers" in unit else 5]:
        with pytest.raises(ValueError, match=unit) if power_db.max() >= 0 else pytest.warns(match=unit):
            load()


def test_powers_that_can_be_pass():
    """What adds to line of sight up to the margin, fading, the gain of antennas, chains of unknown gain; the lobby."""
    strong = np.full(3, 0.9 * MARGIN_DB) + FREE_DB
    gain_db = 10 * np.log10(horn(0.2).peak_gain)
    turned = {"arrival": np.tile([np.pi / 2, np.pi], (3, 1)), "receive_pattern": horn(0.2)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        question_readings(readings(strong))
        question_readings(readings(strong + 9.0, samples=1))
        question_readings(readings(strong + gain_db, **turned))
        question_readings(readings(TRUE_DB + 40.0, chain=["amplifier"] * 3))
        spectra(strong)
        for file in ("spectra.nc", "spectra_sionna.nc"):
            question_spectra(SpectrumDataset.load(LOBBY / file))
    with pytest.warns(UserWarning, match="unknown gain are above 0 dB"):
        question_readings(readings(-TRUE_DB, chain=["horn"] * 3))
    with pytest.warns(UserWarning, match=r"1 of 3 \(rows 1\)"):
        question_readings(readings(TRUE_DB + [0.0, 20.0, 0.0]))
