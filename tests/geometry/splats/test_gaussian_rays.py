"""Rays through Gaussians against brute force in float64 and against the rasteriser; what goes wrong is named."""

import numpy as np
import pytest
from rays_by_definition import brute_hits, brute_transmittance, cloud, expect_hits

from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.rasterizer import Blending

RULES = ["product", "exp"]


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("order", ["peak", "range"])
@pytest.mark.parametrize("k", [1, 4, 64])
def test_hits_are_those_of_brute_force(rule, order, k):
    rng = np.random.default_rng(1)
    g, blending = cloud(rng, 200), Blending(rule=rule, transmittance_min=1e-3)
    origins, directions = rng.uniform(-2, 2, (150, 3)), rng.normal(size=(150, 3))
    found = GaussianRays(g, blending=blending).hits(origins, directions, k, order=order)
    expected = [brute_hits(g, o, d, k, blending, order) for o, d in zip(origins, directions, strict=True)]
    assert max(len(rows) for rows, _ in expected) >= min(k, 10)
    expect_hits(found, expected)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("rule", RULES)
def test_transmittance_is_that_of_brute_force_and_of_the_way_back(rule):
    rng = np.random.default_rng(2)
    g, blending = cloud(rng, 300), Blending(rule=rule)
    a, b = rng.uniform(-2, 2, (2, 400, 3))
    rays = GaussianRays(g, blending=blending)
    expected = [brute_transmittance(g, p, q, blending) for p, q in zip(a, b, strict=True)]
    found = rays.transmittance(a, b)
    assert np.ptp(expected) > 0.9
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    np.testing.assert_allclose(rays.transmittance(b, a), found, rtol=1e-9)
