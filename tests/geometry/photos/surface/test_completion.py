"""Splats with poses become a whole mesh: holes close, what is seen through stays open, what nothing shows is not made up."""

from dataclasses import replace

import numpy as np
import pytest
from radio_scenes import box_mesh, joined
from trimesh.creation import icosphere
from trimesh.remesh import subdivide_to_size
from views import look

import warprrf as wr
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.surface import completion
from warprrf.geometry.scans import SurfaceConfig, find_patches
from warprrf.geometry.splats.gaussians import discs_on_mesh

pytest.importorskip("open3d")
pycolmap = pytest.importorskip("pycolmap")

ROOM = box_mesh([0, 0, 0], [4, 3, 2.5], inward=True)
MIDDLE = np.array([2.0, 1.5, 1.2])
ANGLES = np.arange(20) * np.pi / 5  # once round looking down, once looking up
AROUND = np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.repeat([-0.8, 0.8], 10)])
CONFIG = ReconstructionConfig()


def without(mesh, *boxes):
    """``mesh`` cut into faces of 15 cm, without those whose centre lies in one of the boxes."""
    vertices, faces = subdivide_to_size(mesh.vertices, mesh.faces, 0.15)
    centre = vertices[faces].mean(axis=1)
    kept = [((centre < low) | (centre > high)).any(axis=1) for low, high in boxes]
    return wr.Mesh(vertices, faces[np.all(kept, axis=0)])


def made(folder, shown, places, turn=None, config=CONFIG):
    """What becomes of splats on the mesh ``shown`` and a COLMAP model of 20 cameras at each place; all turned about z."""
    turn = np.eye(3) if turn is None else turn
    g = discs_on_mesh(wr.Mesh(shown.vertices @ turn, shown.faces), int(100 * shown.areas.sum()))
    flat = wr.Gaussians(g.means, g.quaternions, g.scales, g.opacities, np.zeros((len(g), 1, 3)))
    flat.save_ply(folder / "g.ply")
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(model="PINHOLE", width=96, height=72, params=[50, 50, 46.5, 38], camera_id=1)
    model.add_camera_with_trivial_rig(lens)
    for k, (place, ahead) in enumerate((place, ahead) for place in places for ahead in AROUND):
        camera = look((place + 0.3 * ahead * [1, 1, 0]) @ turn, (place + 1.3 * ahead) @ turn)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(camera.rotation), camera.world_to_camera[:3, 3])
        image = pycolmap.Image(name=f"{k:03d}.jpg", camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pose)
    (folder / "model").mkdir()
    model.write_binary(str(folder / "model"))
    return wr.Reconstruction.from_files(folder / "g.ply", colmap=folder / "model", config=config)


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_a_punched_room_is_closed_again_along_its_own_directions(angle, tmp_path):
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    holes = [([1, 1, -1], [2, 2.2, 1]), ([3.9, 0.5, 0.8], [5, 1.5, 1.9]), ([2.5, 2, 2], [5, 4, 4])]
    rec = made(tmp_path, without(wr.Mesh(*ROOM), *holes), [MIDDLE], turn)
    truth, patches = wr.Mesh(ROOM[0] @ turn, ROOM[1]), rec.patches
    rays = MIDDLE @ turn, np.random.default_rng(0).standard_normal((4000, 3))
    np.testing.assert_allclose(rec.mesh.cast(*rays).t, truth.cast(*rays).t, atol=5e-3)
    assert len(rec.cameras) == 20 and len(rec.mesh.faces) < 3000
    # One patch a side, the largest first: floor and ceiling, the walls across y and those across x; all face inward.
    assert patches.area == pytest.approx([12, 12, 10, 10, 7.5, 7.5], rel=5e-3)
    assert rec.mesh.areas.sum() == pytest.approx(truth.areas.sum(), rel=5e-3)
    for k in range(6):
        own = patches.faces(k)
        np.testing.assert_allclose(rec.mesh.triangles[own] @ patches.normal[k], patches.offset[k], atol=1e-6)
        assert (rec.mesh.face_normals[own] @ patches.normal[k] > 0).all()
        assert patches.normal[k] @ rays[0] > patches.offset[k]


def test_edges_are_sharp_before_anything_is_completed(tmp_path):
    config = replace(CONFIG, completion=False)
    rec = made(tmp_path, wr.Mesh(*ROOM), [MIDDLE], config=config)
    on = np.abs(rec.mesh.vertices @ rec.patches.normal.T - rec.patches.offset) < 1e-6
    assert (on.sum(axis=1) == 2).sum() > 200  # vertices on two planes at once


def test_a_doorway_seen_through_stays_open(tmp_path):
    wall = [([1.9, 0, 0], [2.1, 1, 2.5]), ([1.9, 2, 0], [2.1, 3, 2.5]), ([1.9, 1, 2], [2.1, 2, 2.5])]
    truth, _ = joined(ROOM, *(box_mesh(*part) for part in wall))
    rec = made(tmp_path, truth, [MIDDLE - [1, 0, 0], MIDDLE + [1, 0, 0]])
    assert rec.patches.area.min() > 0.15
    y, z = (g.ravel() for g in np.meshgrid(np.linspace(0.05, 2.95, 40), np.linspace(0.05, 2.45, 40)))
    here = np.stack([np.full(y.size, 1.5), y, z], axis=1)
    rim = np.minimum(np.minimum(np.abs(y - 1), np.abs(y - 2)), np.abs(z - 2)) < 0.1
    seen, expected = (m.visible(here, here + [1.0, 0, 0])[~rim] for m in (rec.mesh, truth))
    np.testing.assert_array_equal(seen, expected)


def test_a_slope_and_a_ball_are_kept(tmp_path):
    corners = [[2.6, 1, 0], [3.8, 1, 0], [3.8, 2.2, 0], [2.6, 2.2, 0], [3.8, 1, 0.6], [3.8, 2.2, 0.6]]
    wedge = [[0, 4, 5], [0, 5, 3], [0, 1, 4], [3, 5, 2], [1, 2, 5], [1, 5, 4]]
    truth, _ = joined(ROOM, (np.array(corners), np.array(wedge)))
    rec = made(tmp_path, truth, [MIDDLE])
    points = np.random.default_rng(1).uniform((2.9, 1.1, 2.0), (3.7, 2.1, 2.4), (4000, 3))
    below = rec.mesh.cast(points, [0, 0, -1.0]).point
    np.testing.assert_allclose(below[:, 2], 0.5 * (points[:, 0] - 2.6), atol=0.01)
    ball = icosphere(subdivisions=4, radius=1.5)
    (tmp_path / "ball").mkdir()
    found = made(tmp_path / "ball", wr.Mesh(ball.vertices, ball.faces[:, ::-1]), [np.zeros(3)]).mesh
    off = np.abs(np.linalg.norm(found.vertices, axis=1) - 1.5)
    assert np.median(off) < 0.01 and off.max() < 0.1


def test_a_place_seen_in_part_only_is_not_guessed(tmp_path):
    hall = wr.Mesh(*box_mesh([0, 0, 0], [9, 6, 5], inward=True))
    end = without(hall, ([1, -1, 0.05], [10, 7, 6]))  # its far end, and the floor
    rec = made(tmp_path, end, [np.array([8.0, 3, 2])])
    *rest, down = rec.mesh.cast([8, 3, 2], np.vstack([np.eye(3), -np.eye(3)])).t
    assert np.isinf(rest).all()
    assert down == pytest.approx(2, abs=0.01)  # the floor's gap beneath the cameras is closed


def test_gaps_of_planes_are_closed_unless_they_are_wide_or_a_photo_looks_through():
    turn = np.linalg.qr([[1.0, 0.3, 0.2], [0.1, 1, 0.4], [-0.2, 0.3, 1]])[0]
    floor, shelf, table = (
        (np.array([[x, y, z] for x, y in zip((a, b, b, a), (c, c, d, d), strict=True)]), np.array([[0, 1, 2], [0, 2, 3]]))
        for a, b, c, d, z in ((0, 12, 0, 4, 0), (5.2, 6.2, 1.5, 2.5, -0.5), (0.8, 2.6, 0.8, 2.6, 0.6))
    )  # fmt: skip
    beneath, seen_through, wide, corner, of_table = (
        ([1, 1, -0.1], [2.4, 2.4, 0.1]), ([5, 1.3, -0.1], [6.4, 2.7, 0.1]), ([7.5, 0.8, -0.1], [9.9, 3.2, 0.1]),
        ([10.8, -1, -0.1], [13, 2.5, 0.1]), ([1.5, 1.5, 0.5], [1.9, 1.9, 0.7]),
    )  # fmt: skip
    mesh = without(joined(floor, shelf, table)[0], beneath, seen_through, wide, corner, of_table)
    mesh = wr.Mesh(mesh.vertices @ turn.T, mesh.faces)
    cameras = [look(turn @ [x, 2, 2], turn @ [x, 2.1, 0]) for x in (1.7, 5.7, 8.7, 11.5)]
    after = completion._without_gaps(find_patches(mesh, (), SurfaceConfig()), cameras)
    eyes = np.array(
        [[1.2, 1.2, 0.3], [1.7, 1.7, 1], [5.7, 2, 1], [8.7, 2, 1], [11.6, 1, 1], [11.6, 3.5, 1], [1, 1, 1]]
    )
    met = after.mesh.cast(eyes @ turn.T, turn @ [0, 0, -1.0])
    np.testing.assert_allclose(met.t, [0.3, 0.4, 1.5, np.inf, np.inf, 1, 0.4], atol=1e-9)
    patch = after.face_patch[met.face]
    assert patch[0] == patch[5] != patch[1] == patch[6]
    facing = (after.mesh.face_normals * after.normal[after.face_patch]).sum(axis=1)
    assert facing[len(mesh.faces) :].min() > 0.99
