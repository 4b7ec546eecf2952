import numpy as np
import pytest
from places import LOBBY

pytest.importorskip("open3d")

from benchmarks.engine.rays import KINDS, bumpy_sphere, ray_rows
from warprrf.rf.scene import Scene


def test_the_bumpy_sphere_is_closed_wound_outward_and_seen_from_its_middle():
    mesh = bumpy_sphere(5_000)
    assert mesh.is_closed
    assert len(mesh.faces) == pytest.approx(5_000, rel=0.1)
    winding, _ = mesh.look_around([[0.0, 0, 0], [9, 0, 0]], [[0.1, 0.2, 0.3]])
    np.testing.assert_array_equal(winding, [[1], [0]])
    assert ((mesh.triangles.mean(axis=1) * mesh.face_normals).sum(axis=1) > 0).all()


def test_rows_hold_every_runner_and_both_yardsticks():
    meshes = {"scene": Scene.load(LOBBY / "scene.xml").mesh, "bumpy sphere": bumpy_sphere(1_000)}
    rows = ray_rows(meshes, rays=2_000, repeats=1)
    assert [(r["mesh"], r["kind"]) for r in rows] == [(m, k) for m in meshes for k in KINDS]
    for row in rows:
        for runner in ("warp", "chosen", "embree bare", "embree from arrays"):
            assert row[runner]["rays_per_s"] > 0
        assert row["embree bare"]["over_bare"] == 1.0 and row["embree from arrays"]["over_arrays"] == 1.0
        assert row["other_hits"] < 0.01 and row["t_difference_m"] < 1e-5


def test_no_rays_are_refused():
    with pytest.raises(ValueError, match="rays: got 0"):
        ray_rows({}, rays=0)
