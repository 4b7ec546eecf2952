"""Rays through Gaussians against brute force in float64 and against the rasteriser; what goes wrong is named."""

import numpy as np
import pytest
import warp as wp
from rays_by_definition import brute_hits, brute_transmittance, cloud, expect_hits

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
