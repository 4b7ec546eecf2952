"""Spreads: hand-made channels, invariances, bounds."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from path_makers import random_paths

from warprrf.rf.channel.dispersion import angular_spread, coherence_bandwidth, delay_spread
from warprrf.rf.paths.path_set import Paths

powers = arrays(np.float64, 6, elements=st.floats(1e-3, 1.0))
delays = arrays(np.float64, 6, elements=st.floats(0.0, 1e-7))


def test_two_equal_paths():
    p, t = np.array([1.0, 1.0]), np.array([10e-9, 14e-9])
    mean, spread = delay_spread(p, t)
    assert mean == pytest.approx(12e-9) and spread == pytest.approx(2e-9)
    # |1 + exp(-j 2 pi f 4 ns)| / 2 = |cos(pi f 4 ns)| = 1/2 at f = 1 / (3 * 4 ns)
    assert coherence_bandwidth(p, t) == pytest.approx(1 / 12e-9, rel=1e-9)
    assert coherence_bandwidth(p, t, level=0.9) == pytest.approx(np.arccos(0.9) / np.pi / 4e-9, rel=1e-9)


@pytest.mark.parametrize("side", [0.278, 0.28, 0.281, 0.5])
def test_a_short_dip_of_the_correlation_counts(side):
    """It falls below one half for a hundredth of the period of the longest delay, between two trials."""
    p, t = np.array([1.0, side, side]), np.array([0.0, 10.0, 23.7]) * 1e-9
    shift = np.linspace(0.0, 1e8, 200_001)
    correlation = np.abs(np.exp(-2j * np.pi * shift[:, None] * t) @ p) / p.sum()
    first = shift[np.flatnonzero(correlation <= 0.5)[0]]
    assert coherence_bandwidth(p, t) == pytest.approx(first, abs=1e3)


def test_exponential_profile():
    """A dense exponential profile of decay T has delay spread T and |R(f)| = 1 / sqrt(1 + (2 pi f T)^2)."""
    decay = 5e-9
    t = np.linspace(0, 20 * decay, 4001)
    p = np.exp(-t / decay)
    assert delay_spread(p, t)[1] == pytest.approx(decay, rel=1e-2)
    assert coherence_bandwidth(p, t) == pytest.approx(np.sqrt(3) / (2 * np.pi * decay), rel=1e-2)


def test_angular_spread_of_a_narrow_cone_is_its_standard_deviation():
    angle = 3.1 + np.random.default_rng(0).normal(scale=0.05, size=20000)  # across the seam at pi
    assert angular_spread(np.ones(20000), angle) == pytest.approx(0.05, rel=0.02)
    assert angular_spread(np.ones(2), np.array([0.0, np.pi])) > 5


@given(powers, delays, st.floats(0, 1e-6), st.floats(0.01, 100.0))
def test_delay_spread_ignores_shift_and_scale(p, t, shift, scale):
    spread = delay_spread(p, t)[1]
    assert delay_spread(scale * p, t + shift)[1] == pytest.approx(spread, rel=1e-6, abs=1e-15)
    assert 0 <= spread <= 0.5 * np.ptp(t) * (1 + 1e-9) + 1e-20
    assert delay_spread(p, 2 * t)[1] == pytest.approx(2 * spread, rel=1e-9, abs=1e-20)


@given(powers, delays)
@example(np.array([1.0, *[0.5] * 5]), np.array([0.0, *[1.2e-308] * 5]))
def test_correlation_falls_no_faster_than_the_delay_spread_allows(p, t):
    """|R(f)| >= 1 - (2 pi f S)^2 / 2, so half is not reached before f = 1 / (2 pi S)."""
    spread = delay_spread(p, t)[1]
    width = float(coherence_bandwidth(p, t))
    if np.isfinite(width):
        assert width >= (1 - 1e-6) / (2 * np.pi * spread)
        delay = t - t.min()
        share = np.abs((p * np.exp(-2j * np.pi * width * delay)).sum()) / p.sum()
        assert share == pytest.approx(0.5, abs=1e-6)


@given(powers, arrays(np.float64, 6, elements=st.floats(-3.0, 3.0)), st.floats(-3.0, 3.0))
def test_angular_spread_ignores_rotation(p, angle, turn):
    assert angular_spread(p, angle + turn) == pytest.approx(
        float(angular_spread(p, angle)), rel=1e-5, abs=1e-6
    )


def test_all_measures_of_several_receivers():
    direct = random_paths(4, seed=1).select([0])
    los = Paths.concatenate([direct, random_paths(5, seed=2)])
    los.kind[0] = "los"
    both = Paths.stack([los, random_paths(3, seed=3), random_paths(1).select([])])
    d = both.dispersion()
    assert d.k_factor[0] == pytest.approx(los.power[0] / los.power[1:].sum())
    assert d.k_factor[1] == 0 and np.isnan(d.k_factor[2])
    for name, value in vars(d).items():
        assert value.shape == (3,)
        if name != "path_gain":
            assert np.isnan(value[2]), name
        alone = getattr(los.dispersion(), name)
        assert value[0] == pytest.approx(float(alone), rel=1e-12)
    for name, value in vars(both[2].dispersion()).items():
        assert value == 0 if name == "path_gain" else np.isnan(value), name
    only = los.select([0]).dispersion()
    assert only.k_factor == np.inf and only.delay_spread_s == 0 and only.coherence_bandwidth_hz == np.inf


def test_paths_that_are_marked_invalid_carry_no_power():
    """As channels leave them out, by hand: valid says what is a path."""
    paths = random_paths(6)
    chosen = np.array([True, False, True, True, False, True])
    marked, taken = replace(paths, valid=chosen), paths.select(chosen)
    np.testing.assert_array_equal(marked.cfr([3e11]), taken.cfr([3e11]))
    for name, value in vars(taken.dispersion()).items():
        assert getattr(marked.dispersion(), name) == pytest.approx(float(value), rel=1e-12), name


def test_paths_without_an_angle_say_which():
    paths = random_paths(4)
    with pytest.raises(ValueError, match="paths: phi_t: got NaN"):
        replace(paths, phi_t=np.full_like(paths.phi_t, np.nan)).dispersion()
