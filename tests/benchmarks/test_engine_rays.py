import importlib.util

import numpy as np
import pytest

from benchmarks.engine.rays import bumpy_sphere, run_rays
from warprrf.geometry.mesh import Mesh

no_embree = pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="needs open3d")


def test_the_bumpy_sphere_is_closed_wound_outward_and_seen_from_its_middle():
    mesh = bumpy_sphere(5_000)
    assert isinstance(mesh, Mesh) and mesh.is_closed
    assert len(mesh.faces) == pytest.approx(5_000, rel=0.1)
    np.testing.assert_allclose(mesh.winding_number([[0.0, 0, 0], [9, 0, 0]]), [1, 0], atol=1e-9)
    assert ((mesh.triangles.mean(axis=1) * mesh.face_normals).sum(axis=1) > 0).all()


@no_embree
def test_rows_hold_every_runner_and_both_yardsticks():
    rows = run_rays(triangles=1_000, rays=2_000, repeats=1)
    kinds = ("panorama", "incoherent", "sight, free", "sight, blocked")
    assert [(r["mesh"], r["kind"]) for r in rows] == [
        (m, k) for m in ("scene", "bumpy sphere") for k in kinds
    ]
    for row in rows:
        for runner in ("warp", "embree", "chosen", "embree bare", "embree from arrays"):
            assert row[runner]["rays_per_s"] > 0
        assert row["embree bare"]["over_bare"] == 1.0 and row["embree from arrays"]["over_arrays"] == 1.0
        if row["kind"].startswith("sight"):
            assert row["other_sight"] < 0.01
        else:
            assert row["t_difference_m"] < 1e-5 and row["other_faces"] < 0.01


def test_no_rays_are_refused():
    with pytest.raises(ValueError, match="rays: got 0"):
        run_rays(rays=0)
