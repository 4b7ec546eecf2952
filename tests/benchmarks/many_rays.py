"""Ten million rays inside a closed mesh, a million of them at its vertices: run by name, it takes a minute or two."""

import importlib.util

import numpy as np
import pytest

from benchmarks.engine.rays import bumpy_sphere

no_embree = pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="needs open3d")


@pytest.mark.parametrize("backend", ["warp", pytest.param("embree", marks=no_embree)])
def test_none_of_ten_million_rays_escapes(backend):
    mesh, rng = bumpy_sphere(20_000), np.random.default_rng(0)
    assert mesh.is_closed
    for _ in range(10):
        vertex = mesh.vertices[rng.integers(len(mesh.vertices), size=100_000)]
        origin = rng.uniform(-0.5, 0.5, (1_000_000, 3))
        direction = rng.standard_normal((1_000_000, 3))
        direction[:100_000] = vertex - origin[:100_000]
        assert mesh.cast(origin, direction, backend=backend, device="cpu").valid.all()
