"""What located receivers are compared with: multilateration and the nearest horn scan."""

from dataclasses import replace

import numpy as np

import warprrf as wr
from benchmarks.locate import aligned, clocked, multilaterated, nearest_horn
from benchmarks.measurements import POINTINGS

SOURCES = np.array(
    [[0.5, 0.5, 2.8], [9.5, 0.7, 2.6], [9.0, 7.5, 2.9], [0.8, 7.0, 2.5], [5.0, 0.4, 2.7], [5.0, 7.6, 2.2]]
)
BOUNDS = np.array([[0.0, 0.0, 0.0], [10.0, 8.0, 3.0]])
THERE, CARRIER_HZ = np.array([6.5, 3.0, 1.2]), 60e9


def test_multilateration_is_right_where_all_are_in_sight():
    distance = np.linalg.norm(SOURCES - THERE, axis=1)
    power = (299792458.0 / CARRIER_HZ / (4.0 * np.pi * distance)) ** 2
    seen = wr.Readings(SOURCES, THERE + 1.0, power, CARRIER_HZ, 1e-20)
    assert np.abs(multilaterated(seen, BOUNDS) - THERE).max() < 1e-3
    blocked = replace(seen, power=power * np.where(np.arange(6) < 3, 1e-2, 1.0))
    assert np.linalg.norm(multilaterated(blocked, BOUNDS) - THERE) > 1.0


def test_the_nearest_scan_is_found_under_any_gain_and_turn():
    known = 10.0 ** np.random.default_rng(0).uniform(-12.0, -9.0, (7, 5, len(POINTINGS)))
    one = wr.Readings(
        SOURCES[0], THERE, 0.02 * known[4, 3], CARRIER_HZ, 1e-20, arrival=POINTINGS, receive_pattern=wr.horn(np.radians(10.0)),
        chain=["horn"] * len(POINTINGS), azimuth_known=False,
    )  # fmt: skip
    assert nearest_horn(one, known) == 4


def test_first_arrivals_tell_the_place_whatever_the_clock():
    taps = np.arange(160) / 4e9
    distance = np.linalg.norm(SOURCES[:3] - THERE, axis=1)
    power = np.sinc(2e9 * (taps - distance[:, None] / 299792458.0)) ** 2
    one = wr.Readings(
        np.repeat(SOURCES[:3], 160, axis=0), THERE + 1.0, np.maximum(power, 1e-3).ravel(), CARRIER_HZ, 1e-4,
        delay_s=np.tile(taps + 1e-7, 3), bandwidth_hz=2e9, clock_known=False,
    )  # fmt: skip
    assert np.linalg.norm(clocked(one, BOUNDS, THERE[2]) - THERE) < 0.15  # half a tap is 7 cm


def test_profiles_are_compared_whatever_the_clock_and_the_gain():
    power = 10.0 ** np.random.default_rng(0).uniform(-12.0, -9.0, (4, 3, 50))
    late = 0.02 * np.roll(power, 17, axis=-1)
    np.testing.assert_allclose(aligned(late), aligned(power), atol=1e-9)
    assert np.abs(aligned(power)[0] - aligned(power)[1]).mean() > 1.0
