"""Rays through Gaussians against brute force in float64 and against the rasteriser, in closed form, and hard cases."""

import numpy as np
import pytest
import warp as wp

import warprrf as wr
from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.rasterizer import RADIO, Blending, Rasterizer

RULES = ["product", "exp"]


def cloud(rng, n, low=0.02, high=0.5, spread=2.0):
    return wr.Gaussians(
        rng.uniform(-spread, spread, (n, 3)),
        rng.normal(size=(n, 4)),
        np.exp(rng.uniform(np.log(low), np.log(high), (n, 3))),
        rng.uniform(0.05, 1.0, n),
        np.zeros((n, 1, 3)),
    )


def one(mean=(2.0, 0.0, 0.0), scales=(0.1, 0.2, 0.3), opacity=0.5, quaternion=(1.0, 0, 0, 0)):
    return wr.Gaussians([mean], [quaternion], [scales], [opacity], np.zeros((1, 1, 3)))


def peaks(g, origin, unit):
    """Range of the peak and the response there, (N,) each: textbook form in float64."""
    whiten = g.rotations.transpose(0, 2, 1) / g.scales.astype(np.float64)[:, :, None]
    offset = np.einsum("nij,nj->ni", whiten, origin - g.means.astype(np.float64))
    toward = whiten @ unit
    t = -np.sum(offset * toward, axis=1) / np.sum(toward**2, axis=1)
    return t, np.exp(-0.5 * np.sum((offset + t[:, None] * toward) ** 2, axis=1))


def brute_hits(g, origin, direction, k, blending, order="peak"):
    unit = direction / np.linalg.norm(direction)
    t, response = peaks(g, origin, unit)
    raw = g.opacities.astype(np.float64) * response
    alpha = np.minimum(raw, blending.alpha_max)
    key = t if order == "peak" else np.linalg.norm(g.means.astype(np.float64) - origin, axis=1)
    chosen = np.flatnonzero((raw > blending.alpha_min) & (t > 0))
    chosen = chosen[np.argsort(key[chosen], kind="stable")][:k]
    left, rows = 1.0, []
    for i in chosen:
        if left <= blending.transmittance_min:
            break
        rows.append((i, t[i], alpha[i], left * alpha[i]))
        left *= 1 - alpha[i] if blending.rule == "product" else np.exp(-alpha[i])
    return rows, left


def brute_transmittance(g, a, b, blending):
    length = np.linalg.norm(b - a)
    t, response = peaks(g, a, (b - a) / length)
    raw = g.opacities.astype(np.float64) * response
    alpha = np.minimum(raw, blending.alpha_max)[(raw > blending.alpha_min) & (t > 0) & (t < length)]
    return np.prod(1 - alpha) if blending.rule == "product" else np.exp(-alpha.sum())


def expect_hits(found, expected):
    """The rows of :func:`brute_hits`, one ray after the other."""
    for ray, (rows, left) in enumerate(expected):
        count = int(np.count_nonzero(found.index[ray] >= 0))
        assert found.index[ray, :count].tolist() == [row[0] for row in rows]
        assert (found.index[ray, count:] == -1).all() and np.isinf(found.t[ray, count:]).all()
        assert not found.weight[ray, count:].any() and not found.alpha[ray, count:].any()
        for values, column in ((found.t, 1), (found.alpha, 2), (found.weight, 3)):
            np.testing.assert_allclose(
                values[ray, :count], [row[column] for row in rows], rtol=1e-9, atol=1e-12
            )
        assert found.left[ray] == pytest.approx(left, rel=1e-9, abs=1e-14)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("order", ["peak", "range"])
@pytest.mark.parametrize("k", [1, 4, 64])
def test_hits_are_those_of_brute_force(rule, order, k):
    rng = np.random.default_rng(1)
    g, blending = cloud(rng, 200), Blending(rule=rule, transmittance_min=1e-3)
    origins, directions = rng.uniform(-2, 2, (150, 3)), rng.normal(size=(150, 3))
    found = GaussianRays(g, blending=blending, device="cpu").hits(origins, directions, k, order=order)
    expected = [brute_hits(g, o, d, k, blending, order) for o, d in zip(origins, directions, strict=True)]
    assert max(len(rows) for rows, _ in expected) >= min(k, 10)
    expect_hits(found, expected)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("rule", RULES)
def test_transmittance_is_that_of_brute_force_and_of_the_way_back(rule):
    rng = np.random.default_rng(2)
    g, blending = cloud(rng, 300), Blending(rule=rule)
    a, b = rng.uniform(-2, 2, (2, 400, 3))
    rays = GaussianRays(g, blending=blending, device="cpu")
    expected = [brute_transmittance(g, p, q, blending) for p, q in zip(a, b, strict=True)]
    found = rays.transmittance(a, b)
    assert np.ptp(expected) > 0.9
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    np.testing.assert_allclose(rays.transmittance(b, a), found, rtol=1e-9)


def test_transmittance_multiplies_along_a_segment():
    rng = np.random.default_rng(3)
    rays = GaussianRays(cloud(rng, 300), device="cpu")
    a, b = rng.uniform(-2, 2, (2, 200, 3))
    between = a + rng.uniform(0.1, 0.9, (200, 1)) * (b - a)
    whole = rays.transmittance(a, b)
    assert np.ptp(whole) > 0.9
    np.testing.assert_allclose(
        rays.transmittance(a, between) * rays.transmittance(between, b), whole, rtol=1e-8, atol=1e-15
    )


def test_what_the_weights_leave_is_the_transmittance_to_far_away():
    rng = np.random.default_rng(4)
    blending = Blending(alpha_min=1e-4, alpha_max=1.0, transmittance_min=1e-12)
    rays = GaussianRays(cloud(rng, 100), blending=blending, device="cpu")
    origin, toward = rng.uniform(-1, 1, (100, 3)), rng.normal(size=(100, 3))
    found = rays.hits(origin, toward, 100)
    far = origin + 50.0 * toward / np.linalg.norm(toward, axis=1, keepdims=True)
    np.testing.assert_allclose(found.left, rays.transmittance(origin, far), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(1 - found.weight.sum(axis=1), found.left, atol=1e-12)


@pytest.mark.parametrize("rule", RULES)
def test_a_panorama_s_rays_see_what_the_rasteriser_renders(rule):
    rng = np.random.default_rng(5)
    g, blending = cloud(rng, 400, low=0.01), Blending(alpha_min=1e-3, rule=rule)
    cam = wr.Camera.spherical(60, 30, position=(0.1, -0.2, 0.3))
    raster = Rasterizer(device="cpu", blending=blending, real=wp.float64)
    features = wp.zeros((len(g), 1), dtype=wp.float64, device="cpu")
    image = raster.rasterize(*raster.upload(g), features, cam)
    found = GaussianRays(g, blending=blending, device="cpu").hits(
        cam.position, cam.directions().reshape(-1, 3), 400, order="range"
    )
    alpha = found.weight.sum(axis=1)
    np.testing.assert_allclose(alpha, image.alpha.numpy().ravel(), atol=1e-9)
    first = np.argmax(found.weight, axis=1)[:, None]
    assert (np.take_along_axis(found.index, first, 1)[:, 0] == image.dominant.numpy().ravel()).all()
    seen = alpha > 0
    assert seen.mean() > 0.5
    t = np.where(found.index >= 0, found.t, 0.0)
    depth = (found.weight * t).sum(axis=1)[seen] / alpha[seen]
    np.testing.assert_allclose(depth, image.depth.numpy().ravel()[seen], rtol=1e-9)
    np.testing.assert_allclose(
        np.take_along_axis(t, first, 1)[seen, 0], image.peak.numpy().ravel()[seen], rtol=1e-9
    )


def test_hits_go_on_from_the_last_one():
    """A list too short for a ray is continued by a second ray from its last peak."""
    rng = np.random.default_rng(6)
    rays = GaussianRays(cloud(rng, 300), blending=Blending(transmittance_min=1e-30), device="cpu")
    origin, d = np.zeros(3), np.array([1.0, 0.3, -0.2])
    unit = d / np.linalg.norm(d)
    whole = rays.hits(origin, d, 100)
    count = int(np.count_nonzero(whole.index[0] >= 0))
    assert count > 6
    first = rays.hits(origin, d, 3)
    rest = rays.hits(origin + first.t[0, -1] * (1 + 1e-12) * unit, d, 100)
    assert [*first.index[0], *rest.index[0, : count - 3]] == whole.index[0, :count].tolist()
    np.testing.assert_allclose(first.left[0] * rest.left[0], whole.left[0], rtol=1e-9)


def test_the_length_of_a_direction_does_not_matter():
    rng = np.random.default_rng(7)
    rays, d = GaussianRays(cloud(rng, 100), device="cpu"), rng.normal(size=(50, 3))
    one, other = rays.hits([0, 0, 0], d), rays.hits([0, 0, 0], 1e-6 * d)
    assert (one.index == other.index).all()
    np.testing.assert_allclose(one.weight, other.weight, rtol=1e-12)


# ---------------------------------------------------------------------------------------------------- hard cases


def test_peak_outside_the_segment_does_not_count():
    rays = GaussianRays(one(), device="cpu")
    end = np.array([[1.99, 0, 0], [2.01, 0, 0], [5, 0, 0], [-5, 0, 0]])
    np.testing.assert_allclose(rays.transmittance([0, 0, 0], end), [1, 0.5, 0.5, 1])


def test_inside_a_gaussian_only_a_peak_ahead_counts():
    rays = GaussianRays(one(mean=(0, 0, 0), opacity=0.8), device="cpu")
    found = rays.hits([[-0.05, 0, 0], [0.05, 0, 0], [0, 0, 0]], [1, 0, 0], 2)
    assert found.index[:, 0].tolist() == [0, -1, -1]  # at its very centre a Gaussian contributes nothing
    assert found.t[0, 0] == pytest.approx(0.05) and found.alpha[0, 0] == pytest.approx(0.8)


def test_no_gaussian_met_and_none_there():
    nothing = wr.Gaussians(
        np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 1, 3))
    )
    for g in (one(), one(opacity=0.0), nothing):
        rays = GaussianRays(g, device="cpu")
        found = rays.hits([0, 0, 0], [[-1, 0, 0], [0, 0, 1]], 3)
        assert (found.index == -1).all() and np.isinf(found.t).all() and not found.weight.any()
        np.testing.assert_array_equal(found.left, [1, 1])
        np.testing.assert_array_equal(rays.transmittance([0, 0, 0], [[0, 0, 9], [0, 9, 0]]), [1, 1])
    assert GaussianRays(one(), device="cpu").hits(np.zeros((0, 3)), [1, 0, 0]).index.shape == (0, 16)


def test_between_two_equal_points_everything_passes():
    rays = GaussianRays(one(), device="cpu")
    np.testing.assert_array_equal(rays.transmittance([[2, 0, 0], [0, 0, 0]], [[2, 0, 0], [0, 0, 0]]), [1, 1])


@pytest.mark.usefixtures("device")
def test_needles_of_one_to_ten_thousand_are_exact():
    rng = np.random.default_rng(8)
    n = 200
    scales = np.full((n, 3), 1e-4)
    scales[np.arange(n), rng.integers(3, size=n)] = 1.0
    g = wr.Gaussians(
        rng.uniform(-5, 5, (n, 3)), rng.normal(size=(n, 4)), scales, np.ones(n), np.zeros((n, 1, 3))
    )
    origin = rng.uniform(-5, 5, (n, 3))
    axis = g.rotations[np.arange(n), :, np.argmax(g.scales, axis=1)]
    target = g.means + rng.normal(size=(n, 1)) * axis + 1e-4 * rng.normal(size=(n, 3))
    found = GaussianRays(g, device="cpu").hits(origin, target - origin, 4)
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
    g = wr.Gaussians(
        means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), size), np.ones(n), np.zeros((n, 1, 3))
    )
    rays = GaussianRays(g, device="cpu")
    for origin in (np.zeros(3), np.array([800.0, -600.0, 20.0])):
        toward = means.astype(np.float64) - origin
        side = np.cross(toward, [0.3, 0.5, 0.8])
        side *= size / np.linalg.norm(side, axis=1, keepdims=True)
        for offset, alpha in ((0.0 * side, RADIO.alpha_max), (side, np.exp(-0.5))):
            found = rays.hits(origin, toward + offset, 1)
            assert (found.index[:, 0] == np.arange(n)).all()
            np.testing.assert_allclose(found.alpha[:, 0], alpha, rtol=1e-4)


def test_a_hundred_metres_wide_gaussian_beside_a_millimetre_one():
    g = wr.Gaussians(
        [[0, 0, 50], [3, 0, 0]], [[1, 0, 0, 0]] * 2, [[100] * 3, [1e-3] * 3], [0.5, 0.5], np.zeros((2, 1, 3))
    )
    rays = GaussianRays(g, device="cpu")
    found = rays.hits([0, 0, 0], [[1, 1e-5, 0], [1, 0, 1e-3], [1, 1e-2, 0]], 2)
    for ray, direction in enumerate([[1, 1e-5, 0], [1, 0, 1e-3], [1, 1e-2, 0]]):
        rows, _ = brute_hits(g, np.zeros(3), np.array(direction), 2, RADIO)
        assert found.index[ray, : len(rows)].tolist() == [row[0] for row in rows]


def test_an_axis_parallel_ray_along_a_box_s_side_is_not_lost():
    g = one(mean=(2.0, 0, 0), scales=(0.1, 0.1, 0.1), opacity=1.0)
    y = (
        0.1 * np.sqrt(2 * np.log(1 / RADIO.alpha_min)) * (1 - 1e-9)
    )  # just inside the ellipsoid: alpha just counts
    found = GaussianRays(g, device="cpu").hits([[0, y, 0], [0, -y, 0], [0, 1.001 * y, 0]], [1, 0, 0], 1)
    assert found.index[:, 0].tolist() == [0, 0, -1]


def test_ties_go_by_index():
    g = wr.Gaussians(
        [[2, 0, 0]] * 5, [[1, 0, 0, 0]] * 5, [[0.1] * 3] * 5, [0.1, 0.2, 0.3, 0.4, 0.5], np.zeros((5, 1, 3))
    )
    rays = GaussianRays(g, device="cpu")
    assert rays.hits([0, 0, 0], [1, 0, 0], 5).index[0].tolist() == [0, 1, 2, 3, 4]
    assert rays.hits([0, 0, 0], [1, 0, 0], 3).index[0].tolist() == [0, 1, 2]


def test_a_million_gaussians_are_found_where_they_are():
    rng = np.random.default_rng(10)
    n = 1_000_000
    means = rng.uniform(-10, 10, (n, 3))
    g = wr.Gaussians(
        means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), 2e-3), np.full(n, 0.5), np.zeros((n, 1, 3))
    )
    rays = GaussianRays(g, device="cpu")
    end = g.means[rng.integers(n, size=20)].astype(np.float64) * 1.5
    blocked = 0
    for ray, found in zip(end, rays.transmittance([0, 0, 0], end), strict=True):
        length = np.linalg.norm(ray)
        along = g.means.astype(np.float64) @ (ray / length)
        square = np.sum((g.means - along[:, None] * ray / length) ** 2, axis=1) / 2e-3**2
        alpha = 0.5 * np.exp(-0.5 * square)
        alpha = alpha[(alpha > RADIO.alpha_min) & (along > 0) & (along < length)]
        assert found == pytest.approx(np.prod(1 - alpha), rel=1e-5)  # scales are rounded to float32
        blocked += found < 0.6
    assert blocked >= 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 0, np.nan], [1, 0, 0]), "origins.*NaN"),
        (([0, 0, 0], [1, np.inf, 0]), "directions.*NaN"),
        (([0, 0, 0], [0, 0, 0]), "directions: got 1 of length zero"),
        ((np.zeros((3, 3)), np.ones((2, 3))), "directions: got 2 for 3 origins"),
        (([0, 1e200, 0], [1, 0, 0]), "origins: got numbers above 1e.15"),
        (([0, 0], [1, 0, 0]), r"origins: got shape \(1, 2\)"),
        (([0, 0, 0], [1, 0, 0], 0), "k: got 0"),
    ],
)
def test_bad_rays_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        GaussianRays(one(), device="cpu").hits(*arguments)


def test_other_bad_arguments_are_named():
    rays = GaussianRays(one(), device="cpu")
    with pytest.raises(ValueError, match="b: got 1 values that are NaN"):
        rays.transmittance([0, 0, 0], [0, 0, np.nan])
    with pytest.raises(ValueError, match="order: got 'depth', expected one of peak, range"):
        rays.hits([0, 0, 0], [1, 0, 0], order="depth")
    with pytest.raises(TypeError, match="gaussians: got list"):
        GaussianRays([1, 2])
