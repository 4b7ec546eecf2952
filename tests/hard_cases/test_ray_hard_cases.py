"""Hard cases of rays through Gaussians, each with the right answer from a closed form or from the definition."""

import numpy as np
import pytest
from rays_by_definition import brute_hits, expect_hits, gaussians

from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.rasterizer import RADIO


def test_inside_a_gaussian_only_a_peak_ahead_counts():
    rays = GaussianRays(gaussians([0, 0, 0]))
    found = rays.hits([[-0.05, 0, 0], [0.05, 0, 0], [0, 0, 0]], [1, 0, 0], 2)
    assert found.index[:, 0].tolist() == [0, -1, -1]  # at its very centre a Gaussian contributes nothing
    assert found.t[0, 0] == pytest.approx(0.05) and found.alpha[0, 0] == pytest.approx(0.8)


def test_no_gaussian_met_and_none_there():
    nothing = gaussians(np.zeros((0, 3)))
    for g in (gaussians(), gaussians(opacities=0.0), nothing):
        rays = GaussianRays(g)
        found = rays.hits([0, 0, 0], [[-1, 0, 0], [0, 0, 1]], 3)
        assert (found.index == -1).all() and np.isinf(found.t).all() and not found.weight.any()
        np.testing.assert_array_equal(found.left, [1, 1])
        np.testing.assert_array_equal(rays.transmittance([0, 0, 0], [[0, 0, 9], [0, 9, 0]]), [1, 1])
    assert GaussianRays(gaussians()).hits(np.zeros((0, 3)), [1, 0, 0]).index.shape == (0, 16)


def test_between_two_equal_points_everything_passes():
    rays = GaussianRays(gaussians())
    np.testing.assert_array_equal(rays.transmittance([[2, 0, 0], [0, 0, 0]], [[2, 0, 0], [0, 0, 0]]), [1, 1])


@pytest.mark.usefixtures("device")
def test_needles_of_one_to_ten_thousand_are_exact():
    rng = np.random.default_rng(8)
    n = 200
    scales = np.full((n, 3), 1e-4)
    scales[np.arange(n), rng.integers(3, size=n)] = 1.0
    g = gaussians(rng.uniform(-5, 5, (n, 3)), scales, 1.0, rng.normal(size=(n, 4)))
    origin = rng.uniform(-5, 5, (n, 3))
    axis = g.rotations[np.arange(n), :, np.argmax(g.scales, axis=1)]
    target = g.means + rng.normal(size=(n, 1)) * axis + 1e-4 * rng.normal(size=(n, 3))
    found = GaussianRays(g).hits(origin, target - origin, 4)
    expected = [brute_hits(g, o, d, 4, RADIO) for o, d in zip(origin, target - origin, strict=True)]
    assert sum(len(rows) for rows, _ in expected) > 150
    for ray, (rows, _) in enumerate(expected):
        assert found.index[ray, : len(rows)].tolist() == [row[0] for row in rows]
        np.testing.assert_allclose(found.alpha[ray, : len(rows)], [row[2] for row in rows], atol=1e-8)


def test_ten_micrometres_at_ten_metres_and_a_kilometre_away():
    """Boxes are in float32: none may be missed for it. Rays at the means, and one standard deviation beside."""
    rng = np.random.default_rng(9)
    n, size = 500, 1e-5
    means = (10.0 * rng.normal(size=(n, 3))).astype(np.float32)
    rays = GaussianRays(gaussians(means, [size] * 3, 1.0))
    for origin in (np.zeros(3), np.array([800.0, -600.0, 20.0])):
        toward = means.astype(np.float64) - origin
        side = np.cross(toward, [0.3, 0.5, 0.8])
        side *= size / np.linalg.norm(side, axis=1, keepdims=True)
        for offset, alpha in ((0.0 * side, RADIO.alpha_max), (side, np.exp(-0.5))):
            found = rays.hits(origin, toward + offset, 1)
            assert (found.index[:, 0] == np.arange(n)).all()
            np.testing.assert_allclose(found.alpha[:, 0], alpha, rtol=1e-4)


def test_a_hundred_metres_wide_gaussian_beside_a_millimetre_one():
    g = gaussians([[0, 0, 50], [3, 0, 0]], [[100] * 3, [1e-3] * 3])
    rays = GaussianRays(g)
    directions = np.array([[1, 1e-5, 0], [1, 0, 1e-3], [1, 1e-2, 0]])
    expected = [brute_hits(g, np.zeros(3), direction, 2, RADIO) for direction in directions]
    expect_hits(rays.hits([0, 0, 0], directions, 2), expected)


def test_an_axis_parallel_ray_along_a_box_s_side_is_not_lost():
    g = gaussians(scales=[0.1] * 3, opacities=1.0)
    # Just inside the ellipsoid: alpha just counts.
    y = 0.1 * np.sqrt(2 * np.log(1 / RADIO.alpha_min)) * (1 - 1e-9)
    found = GaussianRays(g).hits([[0, y, 0], [0, -y, 0], [0, 1.001 * y, 0]], [1, 0, 0], 1)
    assert found.index[:, 0].tolist() == [0, 0, -1]


def test_ties_go_by_index():
    rays = GaussianRays(gaussians([[2, 0, 0]] * 5, opacities=[0.1, 0.2, 0.3, 0.4, 0.5]))
    assert rays.hits([0, 0, 0], [1, 0, 0], 5).index[0].tolist() == [0, 1, 2, 3, 4]
    assert rays.hits([0, 0, 0], [1, 0, 0], 3).index[0].tolist() == [0, 1, 2]
