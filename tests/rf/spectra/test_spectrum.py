"""The grid covers the sphere, and the beam keeps power wherever a path points."""

import numpy as np
import pytest
from path_makers import random_directions

from warprrf.rf.spectra.spectrum import (
    Spectrum,
    angles_from_directions,
    beam_sums,
    pixel_directions,
    pixel_of,
    pixel_solid_angles,
    spread,
    spread_paths,
    to_db,
    unit_beams,
)

SIGMA = np.deg2rad(2.0)


def brute_force(d, powers, shape, sigma):
    """The beam's definition, without windows or a cutoff."""
    weight = np.exp((np.einsum("hwi,li->lhw", pixel_directions(shape), d) - 1) / sigma**2)
    weight *= pixel_solid_angles(shape)[None, :, None]
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    return (powers[:, None, None] * weight).sum(axis=0)


def test_solid_angles_cover_the_sphere():
    for shape in [(90, 180), (60, 120), (7, 3)]:
        assert pixel_solid_angles(shape).sum() * shape[1] == pytest.approx(4 * np.pi, rel=1e-14)


def test_every_pixel_centre_falls_in_its_own_pixel():
    row, column = pixel_of(pixel_directions((60, 120)), (60, 120))
    np.testing.assert_array_equal(row, np.arange(60)[:, None] + 0 * column)
    np.testing.assert_array_equal(column, np.arange(120)[None, :] + 0 * row)


def test_azimuth_is_in_the_half_open_interval():
    zenith, azimuth = angles_from_directions([[-1.0, -0.0, 0.0], [0, 0, 1], [0, 0, -1]])
    assert azimuth[0] == np.pi
    np.testing.assert_allclose(zenith, [np.pi / 2, 0, np.pi])


@pytest.mark.parametrize("shape", [(90, 180), (60, 120), (45, 31)])
@pytest.mark.parametrize("sigma", [np.deg2rad(0.05), SIGMA, 0.3])
def test_each_path_sums_to_its_gain_at_poles_seam_and_anywhere(shape, sigma):
    special = np.array(
        [[0, 0, 1], [0, 0, -1], [1e-9, 0, 1], [-1, 0, 0], [-1, 1e-12, 0], [-1, -1e-12, 0.3]], float
    )
    for d in np.concatenate([special, random_directions(10)]):
        assert spread(d[None], [3.0], shape, sigma).sum() == pytest.approx(3.0, rel=1e-12)


@pytest.mark.parametrize("sigma", [SIGMA, 0.2])
def test_spread_is_the_beams_definition(sigma):
    d = np.concatenate([random_directions(40), [[0, 0, 1], [-1, 0, 0], [-1, 1e-3, 0], [1e-3, 0, -1]]])
    powers = np.random.default_rng(1).uniform(0, 1, len(d))
    expected = brute_force(d, powers, (60, 120), sigma)
    np.testing.assert_allclose(
        spread(d, powers, (60, 120), sigma), expected, atol=1e-9 * expected.max(), rtol=1e-6
    )


def test_the_cutoff_lies_100_db_below_the_peak():
    d = np.array([[0.6, 0.0, 0.8]])
    full, cut = brute_force(d, np.ones(1), (90, 180), SIGMA), spread(d, [1.0], (90, 180), SIGMA)
    assert full[cut == 0].max() / full.max() < 1e-10


def test_the_strongest_path_is_the_one_that_gives_most():
    d, powers = random_directions(300, 2), np.random.default_rng(3).lognormal(0, 3, 300)
    images = np.stack([spread(d[k : k + 1], powers[k : k + 1], (30, 60), 0.1) for k in range(300)])
    found = spread_paths(d, powers, (30, 60), 0.1)
    np.testing.assert_allclose(found.path_gain, images.sum(axis=0), rtol=1e-9)
    empty = images.max(axis=0) == 0
    np.testing.assert_array_equal(found.strongest, np.where(empty, -1, images.argmax(axis=0)))


def test_known_beams_change_nothing_where_dark_paths_are_left_out():
    d, powers = random_directions(40), np.where(np.arange(40) % 3 == 0, 0.0, 1e-9)
    expected = spread_paths(d, powers, (30, 60), 0.1)
    found = spread_paths(d, powers, (30, 60), 0.1, beams=beam_sums(d, (30, 60), 0.1))
    np.testing.assert_allclose(found.path_gain, expected.path_gain, rtol=1e-13)
    np.testing.assert_array_equal(found.strongest, expected.strongest)


def test_paths_without_power_give_an_empty_spectrum():
    found = spread_paths(random_directions(5), np.zeros(5), (10, 20), SIGMA)
    assert found.path_gain.sum() == 0 and (found.strongest == -1).all()


def test_decibels_and_plot():
    s = Spectrum(path_gain=np.full((4, 8), 1e-9), floor=1e-9, range_db=(-90.0, -60.0))
    np.testing.assert_allclose(s.path_gain_db, to_db(2e-9, 0.0))
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("Agg")
    assert s.plot().get_xlabel().startswith("azimuth")
    pyplot.close("all")


def test_bad_paths_are_refused():
    with pytest.raises(ValueError, match="powers.*at least 0"):
        spread([[0, 0, 1.0]], [-1.0], (4, 8), SIGMA)
    with pytest.raises(ValueError, match="sigma"):
        spread([[0, 0, 1.0]], [1.0], (4, 8), 0.0)
    with pytest.raises(ValueError, match="directions.*zero"):
        spread([[0, 0, 0.0]], [1.0], (4, 8), SIGMA)
    with pytest.raises(ValueError, match="shape"):
        spread([[0, 0, 1.0]], [1.0], (4,), SIGMA)


@pytest.mark.parametrize("sigma", [np.radians(2.0), np.radians(0.05), 1.2])
def test_beams_made_at_once_are_those_made_one_by_one(sigma):
    # A pole, and the seam.
    directions = np.concatenate([random_directions(10, 4), [[0, 0, 1], [-1, 1e-9, 0]]])
    together = unit_beams(directions, (30, 60), sigma)
    for beam, direction in zip(together, directions, strict=True):
        alone = spread(direction[None], np.ones(1), (30, 60), sigma)
        assert np.allclose(beam, alone, rtol=1e-6, atol=1e-9)
