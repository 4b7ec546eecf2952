"""Lookups against averages written out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from warprrf.rf.spectra import lookups
from warprrf.rf.spectra.dataset import SpectrumDataset

SHAPE = (10, 20)
FLOOR = 1e-12


def training_set(positions, gains):
    if not gains:
        return SpectrumDataset.empty(transmitter=[9.0, 9.0, 9.0], frequency_hz=1e9, shape=SHAPE)
    found = SpectrumDataset.from_spectra(
        receivers=np.array(positions, float), transmitter=np.full(3, 9.0), frequency_hz=1e9, beam_sigma_rad=0.1, floor=FLOOR,
        path_gain=np.stack([np.full(SHAPE, g) for g in gains]),
        delay_s=np.stack([np.full(SHAPE, 1e-9 * i) for i in range(len(gains))]),
    )  # fmt: skip
    return replace(found, range_db=(-120.0, -60.0))


def test_nearest_copies_gain_and_delay_of_the_nearest_receiver():
    ds = training_set([[0, 0, 0], [5, 0, 0]], [1e-8, 1e-9])
    spectrum = lookups.nearest(ds)([3.0, 0.0, 0.0])
    assert spectrum.path_gain[0, 0] == pytest.approx(1e-9)
    assert spectrum.delay_s[0, 0] == 1e-9


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ({"domain": "db"}, (1e-8 + FLOOR) ** 0.8 * (1e-10 + FLOOR) ** 0.2 - FLOOR),
        ({"domain": "linear", "power": 1.0}, (1e-8 + 1e-10 / 2) / 1.5),
    ],
)
def test_idw_is_the_weighted_mean_of_its_domain_and_a_training_spectrum_at_its_own_place(how, expected):
    found = lookups.idw(training_set([[0, 0, 0], [3, 0, 0]], [1e-8, 1e-10]), **how)
    assert found([1.0, 0.0, 0.0]).path_gain[3, 3] == pytest.approx(expected, rel=1e-5)
    assert found([3.0, 0.0, 0.0]).path_gain[0, 0] == pytest.approx(1e-10, rel=1e-3)


def test_idw_of_a_steep_power_is_the_nearest_receivers_spectrum():
    """The inverse powers themselves leave double precision."""
    ds = training_set([[0, 0, 0], [3, 0, 0]], [1e-8, 1e-10])
    for at in ([1.0, 20.0, 0.0], [0.01, 0.0, 0.0]):
        assert lookups.idw(ds, power=1e4)(at).path_gain[3, 3] == pytest.approx(1e-8, rel=1e-5)


@pytest.mark.parametrize(
    ("gains", "better"),
    [([1e-8, 1e-9, 1e-10], "db"), ([1.0e-8, 5.05e-9, 1.0e-10], "linear")],
)
def test_idw_chooses_the_domain_that_predicts_left_out_receivers_better(gains, better):
    ds = training_set([[0, 0, 0], [1, 0, 0], [2, 0, 0]], gains)
    assert lookups.idw(ds).note.startswith(f"averaged in {better}")


def test_constant_and_mean_are_averages_of_decibels():
    ds = training_set([[0, 0, 0], [1, 0, 0]], [1e-8, 1e-10])
    ds.path_gain[0, 0] = 1e-7
    level = 10 * np.log10(ds.path_gain + FLOOR)
    constant = lookups.constant(ds)([9.0, 9.0, 9.0]).path_gain
    assert np.ptp(constant) == 0
    assert 10 * np.log10(constant[0, 0] + FLOOR) == pytest.approx(level.mean(), abs=1e-4)
    mean = lookups.mean(ds)([9.0, 9.0, 9.0]).path_gain
    assert 10 * np.log10(mean + FLOOR) == pytest.approx(level.mean(axis=0), abs=1e-4)
