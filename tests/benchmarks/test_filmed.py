"""The film's reference and its score, on frames of a box drawn in closed form."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import places
import pytest
import views
from PIL import Image
from radio_scenes import box_mesh
from scipy.spatial.transform import Rotation

import warprrf as wr
from benchmarks import filmed
from benchmarks.filmed import Film, laid_on, score, score_cameras
from benchmarks.runner import Job
from benchmarks.stage1 import Room

pytest.importorskip("open3d")
LOW, HIGH = np.array([-1.2, -1.0, 0.0]), np.array([1.2, 1.0, 2.4])
TILT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the files' world has y down, as such sets do


@pytest.fixture(scope="module")
def cameras():
    angles = np.arange(24) * np.pi / 12
    return [
        views.look(
            [0.4 * np.cos(a), 0.3 * np.sin(a), 1.2], [2 * np.cos(a), 2 * np.sin(a), 0.3 if k % 2 else 1.6],
            width=256, height=192, f=160.0,
        )
        for k, a in enumerate(angles)
    ]  # fmt: skip


@pytest.fixture(scope="module")
def film(cameras, tmp_path_factory):
    folder = tmp_path_factory.mktemp("film")
    camera = cameras[0]
    lens = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    np.savetxt(folder / "camera-intrinsics.txt", lens)
    for k, c in enumerate(cameras):
        pose = np.linalg.inv(c.world_to_camera)
        pose[:3] = TILT.T @ pose[:3]
        np.savetxt(folder / f"frame-{k:06d}.pose.txt", pose, fmt="%.7e")
        depth = views.range_in_box(c, LOW, HIGH) * (c.directions() @ c.rotation[2])
        z = np.round(1e3 * depth).astype(np.uint16)
        z[:2] = 65535
        Image.fromarray(z).save(folder / f"frame-{k:06d}.depth.png")
        Image.new("RGB", (c.width, c.height)).save(folder / f"frame-{k:06d}.color.jpg")
    return Film.open(str(folder))


@pytest.fixture(scope="module")
def reference(film):
    depth, _ = film.depth(0)
    assert (depth[:2] == 0).all() and (depth[2:] > 0).all()  # what is unknown is no ray
    return film.levelled(film.surface(range(24), lambda stage, done, total: None))


def test_a_tilted_reference_is_levelled(reference):
    film, surface = reference
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("xy", [9, -4], degrees=True).as_matrix()
    tilted = wr.Mesh(surface.vertices @ tilt[:3, :3].T, surface.faces)
    levelled, mesh = replace(film, poses=tilt @ film.poses).levelled(tilted)
    floor = mesh.vertices[mesh.vertices[:, 2] < np.percentile(mesh.vertices[:, 2], 5)]
    assert np.percentile(floor[:, 2], 95) - floor[:, 2].min() < 0.02
    turned = levelled.poses[:, :3, :3] @ film.poses[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(turned[:, 2], [[0, 0, 1]] * len(turned), atol=2e-3)  # about z alone


def test_true_cameras_and_mesh_score_zero_in_any_frame_and_a_larger_mesh_how_much(reference, cameras):
    levelled, surface = reference
    figures, (scale, rotation, shift) = score_cameras(cameras, levelled.poses)
    assert figures["camera_rms_m"] < 1e-5 and figures["camera_rotation_median_deg"] < 1e-3
    assert scale == pytest.approx(1, abs=1e-6)
    true, grown = (box_mesh(LOW - by, HIGH + by, inward=True) for by in (0.0, 0.1))
    found = score(wr.Mesh(true[0] @ rotation.T + shift, true[1]), surface, levelled.rays(3))
    assert found["covered"] == 1 and found["f_5_cm"] > 0.97
    assert found["normal_median_deg"] < 3  # of millimetres rounded, fused in voxels of 2 cm
    for name in ("distance", "range", "back"):
        assert found[f"{name}_median_m"] < 0.01 and found[f"{name}_within_5_cm"] > 0.97
    found = score(wr.Mesh(grown[0] @ rotation.T + shift, grown[1]), surface, levelled.rays(3))
    assert found["distance_median_m"] == pytest.approx(0.1, abs=0.01)
    assert found["back_median_m"] == pytest.approx(0.1, abs=0.01)
    assert 0.1 < found["range_median_m"] < 0.15  # along slanted rays
    assert found["back_within_5_cm"] < 0.01 and found["f_5_cm"] < 0.02


def test_a_moved_mesh_is_laid_on_the_reference(reference, cameras):
    levelled, surface = reference
    _, (_, rotation, shift) = score_cameras(cameras, levelled.poses)
    turn = Rotation.from_euler("zx", [2, -1], degrees=True).as_matrix()
    vertices, faces = box_mesh(LOW, HIGH, inward=True)
    true = vertices @ rotation.T + shift
    moved = wr.Mesh((true @ turn.T + [0.03, -0.02, 0.04]) / 1.04, faces)
    laying = laid_on(moved, surface, levelled.rays(3))
    assert laying["scale"] == pytest.approx(1.04, abs=0.004)
    # A voxel of the reference; moved by 5 to 17 cm.
    np.testing.assert_allclose(moved.transformed(**laying).vertices, true, atol=0.02)


def test_free_places_are_seen_through_and_off_the_walls(reference, monkeypatch):
    film, surface = reference
    monkeypatch.setattr(filmed, "GRID_M", 0.2)
    places = film.free(surface, 1)
    assert len(places) >= 8 and surface.distance(places).min() > filmed.CLEAR_M
    assert ((places > surface.bounds[0]) & (places < surface.bounds[1])).all()
    assert not len(film.free(surface, 12))  # two frames prove nothing


@pytest.mark.long
def test_a_field_on_a_moved_mesh_is_worse_than_on_the_reference(reference, tmp_path, monkeypatch):
    film, surface = reference
    for name, value in {"ENGINE": "exact", "SHAPE": (18, 36), "TRAINING": 4, "GRID_M": 0.2}.items():
        monkeypatch.setattr(filmed, name, value)
    moved = surface.transformed(shift=[0.15, 0.1, 0.0])
    job = Job(tmp_path, device="cpu")
    found = filmed.field_errors(surface, film.free(surface, 1)[:14], {"moved": moved}, job)
    assert found["train"] == 4 and found["test"] >= 4
    assert found["reference"]["psnr_db"] > found["moved"]["psnr_db"] + 3
    with pytest.raises(ValueError, match="free places"):
        filmed.field_errors(surface, np.zeros((7, 3)), {}, job)


@pytest.mark.parametrize("drawn", [False, True])
def test_the_reference_of_a_room_scores_nothing_against_itself(film, drawn):
    folder = places.LOBBY if drawn else Path(film.stems[0]).parent
    room = Room.open(str(folder), 8, lambda stage, done, total: None)
    assert len(room.files) == (120 if drawn else 8) and set(room.known) <= {file.name for file in room.files}
    found = score(room.reference, room.reference, room.rays)
    assert found["covered"] > 0.9 and found["distance_p90_m"] < 1e-4 and found["f_5_cm"] > 0.98
