"""Antenna de-embedding against measurements simulated path by path, without the grid's own convolution."""

from dataclasses import replace

import numpy as np
import pytest
from path_makers import random_directions

import warprrf as wr
from warprrf.rf.spectra.deembedding import deembed
from warprrf.rf.spectra.levels import free_space_gain
from warprrf.rf.spectra.spectrum import (
    default_floor,
    directions_from_angles,
    pixel_directions,
    pixel_solid_angles,
    spread,
)

SHAPE = (90, 180)
SIGMA = np.radians(2.0)
WIDTH = np.radians(10.0)
KAPPA = np.log(2) / (1 - np.cos(WIDTH / 2))  # half power at 5 degrees off boresight
# A von Mises-Fisher pattern that radiates 4 pi in all: its gain on boresight is 2 kappa / (1 - exp(-2 kappa)).
PEAK = 2 * KAPPA / (1 - np.exp(-2 * KAPPA))
POWERS = np.array([1e-8, 0.7e-8])

PAIRS = {
    "equator": ((80, 20.3), (80, 32.488)),  # 12 degrees apart each
    "seam": ((120, -173), (120, 173.131)),
    "across the pole": ((5.5, 10), (6.5, 190)),
    "across the other pole": ((175, -60), (173, 120)),
    "one below the other": ((40, 50), (52, 50)),
}


def horn(angle):
    return PEAK * np.exp(KAPPA * (np.cos(angle) - 1))


def toward(*angles):
    zenith, azimuth = np.radians(angles).T
    return directions_from_angles(zenith, azimuth)


def scan(directions, powers, pattern=horn, shape=SHAPE):
    """Path by path: what the antenna steered to each pixel centre receives."""
    chord = np.linalg.norm(pixel_directions(shape)[:, :, None] - directions, axis=-1)
    return pattern(2 * np.arcsin(np.clip(chord / 2, 0, 1))) @ powers


def dataset(measured, **extra):
    count, *shape = measured.shape
    return wr.SpectrumDataset.from_spectra(
        receivers=np.arange(3.0 * count).reshape(count, 3),
        transmitter=np.zeros(3),
        frequency_hz=300e9,
        path_gain=measured,
        delay_s=np.tile(np.arange(np.prod(shape)).reshape(shape) * 1e-12, (count, 1, 1)),
        aod=np.full((count, *shape, 2), 0.5, np.float32),
        line_of_sight=np.ones(count, bool),
        beam_sigma_rad=SIGMA,
        engine="exact",
        role=["test"] * count,
        attributes={"campaign": "hall"},
        **extra,
    )


def db(x):
    return 10 * np.log10(x)


@pytest.mark.parametrize("pair", PAIRS)
def test_two_sources_12_degrees_apart_are_told_apart_and_the_total_is_right(pair):
    d = toward(*PAIRS[pair])
    assert np.degrees(np.arccos(d[0] @ d[1])) == pytest.approx(12.0, abs=0.02)
    measured = scan(d, POWERS)
    out = dataset(measured[None]).deembed(horn)
    gain = out.path_gain[0].astype(float)
    assert db(gain.sum() / POWERS.sum()) == pytest.approx(0.0, abs=0.1)
    middle = d.sum(axis=0) / np.linalg.norm(d.sum(axis=0))
    angle = np.arccos(np.clip(pixel_directions(SHAPE) @ np.array([*d, middle]).T, -1, 1))
    density = gain / pixel_solid_angles(SHAPE)[:, None]
    peaks = [density[angle[..., k] < np.radians(3)].max() for k in range(2)]
    valley = density[angle[..., 2] < np.radians(1.5)].max()
    assert db(min(peaks) / valley) > 6  # less than 3 dB in the measurement
    for k in range(2):
        own = gain[angle[..., k] < np.radians(6)].sum()
        assert db(own / POWERS[k]) == pytest.approx(0.0, abs=1.0)
        where = np.unravel_index(np.where(angle[..., k] < np.radians(6), density, 0).argmax(), SHAPE)
        assert angle[where][k] < np.radians(2.0)
    raw = measured / measured.max()
    assert db(raw[angle[..., 1] < np.radians(1.5)].max() / raw[angle[..., 2] < np.radians(1.5)].max()) < 3


def test_the_total_does_not_depend_on_the_horn_or_how_its_gain_is_stated():
    d, truth = toward((70, 10), (100, -120)), POWERS.sum()
    for width in (8.0, 20.0, 40.0):
        kappa = np.log(2) / (1 - np.cos(np.radians(width) / 2))

        def pattern(angle, kappa=kappa):
            return np.exp(kappa * (np.cos(angle) - 1))

        for peak_dbi, stated in ((0.0, None), (17.0, 17.0), (0.0, 0.0)):
            measured = 10 ** (peak_dbi / 10) * scan(d, POWERS, pattern)
            out = deembed(measured[None], pattern, SIGMA, boresight_gain_dbi=stated, iterations=60)
            assert db(out.path_gain.sum() / truth) == pytest.approx(0.0, abs=0.1)


def test_deembedding_comes_closer_to_the_true_spectrum_than_the_measurement():
    rng = np.random.default_rng(3)
    d = random_directions(12, rng)
    powers = 10 ** rng.uniform(-10, -8, 12)
    truth = spread(d, powers, SHAPE, SIGMA)
    measured = scan(d, powers)
    naive = measured * pixel_solid_angles(SHAPE)[:, None]
    naive *= truth.sum() / naive.sum()
    out = deembed(measured[None], horn, SIGMA)
    error, before = (np.abs(x - truth).sum() / truth.sum() for x in (out.path_gain[0], naive))
    assert error < 0.2 and error < 0.2 * before


def test_a_needle_leaves_the_spectrum_as_it_is_but_for_the_beam():
    image = np.zeros((2, 30, 60))
    image[0, 10, 20], image[0, 0, 5], image[1, 29, 59] = 1e-8, 3e-9, 2e-9
    out = deembed(image, lambda angle: (angle < 1e-6).astype(float), SIGMA)
    for k in range(2):
        lit = image[k] > 0
        expected = spread(pixel_directions((30, 60))[lit], image[k][lit], (30, 60), SIGMA)
        np.testing.assert_allclose(out.path_gain[k], expected, rtol=1e-9, atol=1e-20)


def test_a_fixed_isotropic_antenna_changes_nothing():
    data = dataset(scan(toward((80, 20)), POWERS[:1], shape=(18, 36))[None])
    out = data.deembed(np.ones((18, 36)))
    np.testing.assert_array_equal(out.path_gain, data.path_gain)
    lit = data.path_gain > 0
    np.testing.assert_array_equal(out.delay_s[lit], data.delay_s[lit])
    assert np.isnan(out.delay_s[~lit]).all()
    assert out.attributes["deembedded_share_of_sphere"] == pytest.approx(1.0)


def test_a_fixed_pattern_divides_out_and_its_blind_side_becomes_empty():
    truth = np.full((1, 18, 36), 1e-9)
    zenith = (np.arange(18) + 0.5) * np.pi / 18
    gain = np.broadcast_to(5.0 * np.maximum(np.cos(zenith), 1e-4)[:, None] ** 2, (18, 36))
    out = dataset(truth * gain).deembed(gain, limit_db=20)
    told = gain > 0.01 * gain.max()
    np.testing.assert_allclose(out.path_gain[0][told], 1e-9, rtol=1e-6)
    assert not out.path_gain[0][~told].any() and np.isnan(out.delay_s[0][~told]).all()
    assert np.isnan(out.aod[0][~told]).all() and np.isfinite(out.aod[0][told]).all()
    covered = out.attributes["deembedded_share_of_sphere"]
    assert covered == pytest.approx(0.5 * (1 - np.cos(np.pi / 18 * told[:, 0].sum())), abs=1e-9)


@pytest.mark.parametrize("below_db", [10, 20, 30])
def test_noise_neither_adds_power_nor_grows_with_steps(below_db):
    d = toward((80, 20.3), (100, -60))
    clean = scan(d, POWERS)
    noise = clean.max() * 10 ** (-below_db / 10)
    # The power of complex noise, averaged over 8 snapshots.
    measured = clean + noise * np.random.default_rng(below_db).gamma(8, 1 / 8, SHAPE)
    short, long = (
        deembed(measured[None], horn, SIGMA, noise=noise, snapshots=8, iterations=n).path_gain[0]
        for n in (100, 2000)
    )
    truth = spread(d, POWERS, SHAPE, SIGMA)
    for out in (short, long):
        assert db(out.sum() / POWERS.sum()) == pytest.approx(0.0, abs=0.15)
        assert np.isfinite(out).all()
        quiet = np.arccos(pixel_directions(SHAPE) @ d.T).min(axis=-1) > np.radians(15)
        assert out[quiet].max() < 0.02 * truth.max()
        assert np.abs(out - truth).sum() < 0.45 * truth.sum()
    # More steps sharpen what the noise allows, or stop: they never lead away from the truth.
    assert np.abs(long - truth).sum() <= np.abs(short - truth).sum()


def test_noise_that_outweighs_the_signal_leaves_nothing():
    measured = np.full((1, 18, 36), 1e-9)
    out = deembed(measured, horn, SIGMA, noise=2e-9)
    assert not out.path_gain.any() and (out.source == -1).all()


def test_a_data_set_keeps_what_was_measured_and_says_what_was_done(tmp_path):
    measured = np.stack([scan(toward((80, 20)), POWERS[:1], shape=(36, 72)), np.zeros((36, 72))])
    data = dataset(np.concatenate([measured, measured[:1], measured[:1]]))
    seen = []
    out = data.deembed(horn, boresight_gain_dbi=0.0, progress=lambda *tick: seen.append(tick))
    assert seen[-1] == ("deembed", 4, 4)
    assert not out.path_gain[1].any() and np.isnan(out.delay_s[1]).all()
    np.testing.assert_array_equal(out.receivers, data.receivers)
    assert out.attributes["campaign"] == "hall" and "scanned" in out.attributes["deembedded"]
    row, column = np.unravel_index(out.path_gain[0].argmax(), (36, 72))
    # Delays count pixels: where the path is strongest the delay is that of the pixel or a neighbour.
    assert out.delay_s[0, row, column] == pytest.approx(data.delay_s[0, row, column], abs=80e-12)
    out.save(tmp_path / "out.nc")
    again = wr.SpectrumDataset.load(tmp_path / "out.nc")
    np.testing.assert_array_equal(again.path_gain, out.path_gain)
    assert again.attributes["deembedded"] == out.attributes["deembedded"]


def test_who_sees_the_transmitter_is_judged_without_the_antennas_gain():
    """A blocked receiver whose strongest path comes 12 dB below free space from beside the transmitter."""
    ends = {
        "receivers": np.array([[4.0, 0, 0], [0, 4.0, 0]]),
        "transmitter": np.zeros(3),
        "frequency_hz": 300e9,
    }
    friis = free_space_gain(np.zeros(3), ends["receivers"], 300e9)
    directions = -ends["receivers"] / 4.0
    power = [friis[0] * scan(directions[:1], [1.0]), friis[1] / 16 * scan(directions[1:], [1.0])]
    raw = wr.SpectrumDataset.from_spectra(path_gain=np.stack(power), beam_sigma_rad=SIGMA, **ends)
    assert raw.line_of_sight.all()  # 27 dB of horn
    assert raw.deembed(horn).line_of_sight.tolist() == [True, False]
    known = replace(raw, line_of_sight=[False, True]).deembed(horn)
    assert known.line_of_sight.tolist() == [False, True]


def test_the_floor_is_that_of_what_was_received_though_most_received_nothing():
    """As of a hall whose receivers are mostly blocked: the antenna's gain of 27 dB goes out of the floor, too."""
    one = scan(toward((80, 20)), POWERS[:1], shape=(36, 72))
    alone, among = (dataset(np.stack([one, *[np.zeros((36, 72))] * n])).deembed(horn) for n in (0, 3))
    assert among.floor == alone.floor == default_floor(alone.path_gain)
    assert among.range_db == alone.range_db


@pytest.mark.parametrize(
    ("pattern", "options", "named"),
    [
        (np.cos, {}, "pattern"),  # negative
        (lambda a: np.zeros(a.shape), {}, "pattern"),
        (lambda a: 1.0, {}, "same gain in all directions"),
        (np.ones((9, 18)), {}, "pattern"),  # of another grid
        (np.zeros((18, 36)), {}, "pattern"),
        (horn, {"noise": -1.0}, "noise"),
        (horn, {"limit_db": 20.0}, "limit_db"),  # of a fixed antenna
        (np.ones((18, 36)), {"limit_db": -1.0}, "limit_db"),
        (np.ones((18, 36)), {"noise": 1e-9}, "noise"),  # of a scan
    ],
)
def test_patterns_and_options_without_an_answer_are_refused(pattern, options, named):
    with pytest.raises((ValueError, TypeError), match=named):
        dataset(np.ones((1, 18, 36)) * 1e-9).deembed(pattern, **options)
