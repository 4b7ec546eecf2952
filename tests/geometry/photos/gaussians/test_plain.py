"""Surfaces without features, found from their edges: photos of flat-coloured rooms, cast ray by ray."""

import numpy as np
import pytest
import trimesh
from helpers.views import look

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.gaussians import plain
from warprrf.geometry.photos.gaussians.plain import plain_surfaces, with_plain
from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.planes import Plane

SIZE = np.array([6.0, 5.0, 3.0])  # of the room [m]
PILLAR = np.array([[3.4, 2.2, 0.0], [4.0, 2.8, 3.0]])
SHADES = np.array([[0.55, 0.4, 0.35], [0.7, 0.68, 0.6], [0.45, 0.46, 0.5], [0.62, 0.66, 0.58], [0.3, 0.3, 0.32],
                   [0.86, 0.86, 0.84], [0.75, 0.74, 0.76], [0.68, 0.67, 0.7], [0.72, 0.72, 0.72], [0.66, 0.65, 0.63]])  # fmt: skip


def room():
    """Room and pillar as one mesh, and the number of the flat side that each face belongs to."""
    shell = trimesh.creation.box(bounds=[np.zeros(3), SIZE])
    shell.invert()
    both = trimesh.util.concatenate([shell, trimesh.creation.box(bounds=PILLAR)])
    side = np.abs(both.face_normals).argmax(axis=1) * 2 + (both.face_normals.sum(axis=1) < 0)
    side[12:] += 4 * (side[12:] < 4) + 2
    return Mesh(both.vertices, both.faces), side


def photos(cameras, mirrors=False):
    """What the cameras see: each side in one colour, four rays a pixel."""
    mesh, side = room()
    images = []
    for camera in cameras:
        fine = camera.resized(2 * camera.width, 2 * camera.height)
        rays = fine.directions().reshape(-1, 3)
        hit = mesh.cast(np.broadcast_to(fine.position, rays.shape), rays)
        color = SHADES[side[hit.face]]
        if mirrors:
            pane = hit.point[:, 0] < 1e-3
            back = mesh.cast(hit.point[pane] + [1e-4, 0, 0], rays[pane] * [-1, 1, 1])
            color[pane] = 0.35 * color[pane] + 0.5 * SHADES[side[back.face]]
        image = color.reshape(camera.height, 2, camera.width, 2, 3).mean(axis=(1, 3))
        images.append(image.astype(np.float32))
    return images


@pytest.fixture(scope="module")
def cameras():
    """Thirty cameras in the room that look across it."""
    rng = np.random.default_rng(3)
    result = []
    for k in range(30):
        angle = 2 * np.pi * k / 30
        position = SIZE / 2 + [2.3 * np.cos(angle), 1.9 * np.sin(angle), rng.uniform(-0.3, 0.3)]
        target = SIZE / 2 - [2.0 * np.cos(angle + 0.7), 2.0 * np.sin(angle + 0.7), rng.uniform(-0.5, 0.5)]
        result.append(look(position, target, width=320, height=240, f=170.0))
    return result


def found(cameras, images):
    """Plain surfaces in photos, and which lines through the six sides of the room end on what a mirror shows, 10 cm behind it
    or more: those that end 8 and 12 cm behind the sides."""
    outwards, away = np.concatenate([-np.eye(3), np.eye(3)]), np.tile(SIZE / 2, 2)[:, None]
    targets = np.concatenate([SIZE / 2 + (away + behind) * outwards for behind in (0.08, 0.12)])
    sight = np.broadcast_to(SIZE / 2, targets.shape), targets
    planes, reflected = plain_surfaces(PosedPhotos(images, cameras), np.eye(3), sight)
    return planes, reflected.reshape(2, 6).tolist()


def test_walls_ceiling_and_pillar_without_features_are_found_from_their_edges(cameras):
    mesh, _ = room()
    planes, reflected = found(cameras, photos(cameras))
    for axis in range(3):
        for side, height in ((1, 0.0), (-1, SIZE[axis])):
            normal = side * np.eye(3)[axis]
            own = [p for p in planes if p.normal @ normal > 0.99 and abs(p.offset - side * height) < 0.02]
            assert sum(p.area() for p in own) > 0.6 * np.prod(SIZE) / SIZE[axis], (axis, side)
    cells = np.concatenate([plane.cells() for plane in planes])
    assert np.mean(mesh.distance(cells) < 0.1) > 0.95
    faces = [p for p in planes if abs(p.normal[2]) < 0.1 and mesh.distance(p.cells()).mean() < 0.05]
    assert any(
        ((p.cells() > PILLAR[0] - 0.05) & (p.cells() < PILLAR[1] + 0.05)).all(axis=1).any() for p in faces
    )
    assert all(plane.plain for plane in planes) and reflected == [[False] * 6] * 2


def test_what_a_pane_mirrors_becomes_no_surface(cameras):
    planes, reflected = found(cameras, photos(cameras, mirrors=True))
    assert reflected == [[False] * 6, [True] + [False] * 5]
    assert (np.concatenate([plane.cells() for plane in planes])[:, 0] > -0.1).all()


def test_photos_full_of_features_show_no_plain_surface(cameras):
    rng = np.random.default_rng(0)
    images = [rng.uniform(size=(240, 320, 3)).astype(np.float32) for _ in cameras[:4]]
    assert found(cameras[:4], images) == ([], [[False] * 6] * 2)


def test_a_plain_cell_gives_way_to_points_on_a_plane_and_to_lines_of_sight():
    everywhere = np.ones((20, 20), dtype=bool)
    wall = Plane(
        np.array([0.0, 1.0, 0.0]), 0.0, np.zeros(0, int), corner=np.zeros(2), occupied=everywhere, plain=True
    )
    points = wall.to_world(np.array([[0.55, 0.55]])) + [0, 0.08, 0]
    poster = Plane(wall.normal, 0.08, np.array([0]), corner=np.zeros(2), occupied=everywhere)
    through = wall.to_world(np.array([[1.55, 1.55]]))
    sight = np.repeat(through + [0, 2.0, 0], 2, axis=0), np.repeat(through - [0, 2.0, 0], 2, axis=0)
    ours, plain = with_plain([poster], [wall], points, sight)
    kept = np.zeros((20, 20), dtype=bool)
    # Its point and what lies round it; and where the wall is seen through.
    kept[4:7, 4:7] = kept[15, 15] = True
    assert (ours.occupied == kept).all() and (plain.occupied == ~kept).all() and plain.plain


@pytest.mark.parametrize(("share", "lines"), [(0.28, 0), (0.4, 1)])
def test_plain_surfaces_are_looked_for_where_a_third_of_the_photos_is_plain(
    cameras, monkeypatch, share, lines
):
    asked = []
    monkeypatch.setattr(plain, "find_lines", lambda *given: asked.append(given) or [])
    image = np.random.default_rng(0).random((240, 320, 3)).astype(np.float32)
    image[: round(240 * share) + 6] = 0.5  # six rows more, which a texture beside them keeps from being plain
    assert found(cameras[:12], [image] * 12) == ([], [[False] * 6] * 2)
    assert len(asked) == lines
