"""Rays through Gaussians against brute force in float64 and against the rasteriser; what goes wrong is named."""

import copy
import pickle

import numpy as np
import pytest
import warp as wp
from rays_by_definition import brute_hits, brute_transmittance, cloud, expect_hits, one

import warprrf as wr
from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.rasterizer import Blending, Rasterizer

RULES = ["product", "exp"]


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 0, np.nan], [1, 0, 0]), "origins.*NaN"),
        (([0, 0, 0], [1, np.inf, 0]), "directions.*NaN"),
        (([0, 0, 0], [0, 0, 0]), "directions: got 1 of length zero"),
        ((np.zeros((3, 3)), np.ones((2, 3))), "directions: got 2 for 3 origins"),
        (([0, 1e20, 0], [1, 0, 0]), "origins: got numbers above 1e.15"),
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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_they_are_copied_and_pickled(dtype):
    kinds = {
        np.float32: (wp.vec3, wp.vec4, wp.vec3, wp.float32),
        np.float64: (wp.vec3d, wp.vec4d, wp.vec3d, wp.float64),
    }
    values = [[[0.0, 0, 2], [0, 0, 3]], [[1.0, 0, 0, 0]] * 2, [[0.1, 0.2, 0.3]] * 2, [0.5, 0.25]]
    arrays = tuple(
        wp.array(np.array(v, dtype), dtype=k, device="cpu") for v, k in zip(values, kinds[dtype], strict=True)
    )
    rays = GaussianRays(arrays, blending=Blending(rule="exp"))
    ends = np.zeros(3), np.array([0.1, 0.0, 4.0])
    for again in (copy.deepcopy(rays), pickle.loads(pickle.dumps(rays))):
        assert [a.dtype for a in again.inputs] == [a.dtype for a in arrays]
        assert again.transmittance(*ends) == rays.transmittance(*ends) < 1
