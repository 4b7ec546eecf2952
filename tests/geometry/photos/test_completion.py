"""A mesh made whole: holes close, what is seen through stays open, and nothing changes where there are no planes."""

import numpy as np
import pytest

import warprrf as wr
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.completion import complete
from warprrf.geometry.photos.config import SurfaceConfig
from warprrf.geometry.photos.snapping import find_patches, largest_first
from warprrf.geometry.planar_patches import PlanarPatches

pytest.importorskip("scipy")

FLAT = SurfaceConfig(patch_distance_m=0.01)
ROOM = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.5]])


def sheet(axis, height, low, high, sign, step=0.1):
    """Triangles of a rectangle across ``axis`` at ``height``, facing ``sign`` along it, in cells of ``step``."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    u, v = (np.linspace(x, y, round((y - x) / step) + 1) for x, y in zip(low, high, strict=True))
    corners = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    quad = np.stack([corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]], axis=2).reshape(
        -1, 4, 2
    )
    points = np.zeros((len(quad), 4, 3))
    points[..., [b, c]], points[..., axis] = quad, height
    points = points[:, ::sign]
    return np.concatenate([points[:, [0, 1, 2]], points[:, [0, 2, 3]]])


def box(low, high, sign=1, without=()):
    """Triangles of a box's sides: facing out for ``sign`` 1, in for -1; ``without`` names sides (axis, end)."""
    parts = []
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for end, height in enumerate((low[axis], high[axis])):
            if (axis, end) not in without:
                facing = sign * (1 if end else -1)
                parts.append(sheet(axis, height, (low[b], low[c]), (high[b], high[c]), facing))
    return np.concatenate(parts)


def as_mesh(triangles):
    points, index = np.unique(np.round(triangles.reshape(-1, 3), 6), axis=0, return_inverse=True)
    return Mesh(points, index.reshape(-1, 3))


def punched(triangles, low, high):
    """Triangles without those whose centre lies in the box from ``low`` to ``high``."""
    centre = triangles.mean(axis=1)
    return triangles[~((centre > low) & (centre < high)).all(axis=1)]


def cameras(places):
    """Pinhole cameras at each place, looking all around."""
    result = []
    for place in places:
        for ahead in np.concatenate([np.eye(3), -np.eye(3)]):
            down = np.array([0.0, 1.0, 0.0]) if abs(ahead[2]) > 0.5 else np.array([0.0, 0.0, -1.0])
            pose = np.eye(4)
            pose[:3, :3] = [np.cross(down, ahead), down, ahead]
            pose[:3, 3] = -pose[:3, :3] @ place
            result.append(wr.Camera.pinhole(80, 80, fx=36, fy=36, cx=40, cy=40, world_to_camera=pose))
    return result


def seen(mesh, truth, views):
    """Depth maps of the truth, unknown where the mesh lacks the surface: a hole comes from unreliable depth."""
    depths = []
    for camera in views:
        d = camera.directions().reshape(-1, 3)
        true, own = truth.cast(camera.position, d).t, mesh.cast(camera.position, d).t
        known = np.isfinite(true) & np.isclose(true, own, rtol=0, atol=1e-3)
        depths.append(np.where(known, true, 0.0).reshape(camera.height, camera.width))
    return depths


def run(broken, whole, places):
    mesh, truth = as_mesh(broken), as_mesh(whole)
    views = cameras(np.asarray(places, dtype=float))
    patches = find_patches(mesh, config=FLAT)
    whole = complete(patches, views, seen(mesh, truth, views))
    return largest_first(whole, 0.15), truth


INSIDE = np.array([[1.0, 1.0, 1.2], [3.0, 1.0, 1.5], [3.0, 2.0, 1.0], [1.0, 2.0, 1.6]])


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_a_punched_room_is_closed_again_along_its_own_directions(angle):
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    room = box(*ROOM, sign=-1)
    broken = punched(room, (1.0, 1.0, -1.0), (2.0, 2.2, 1.0))  # floor
    broken = punched(broken, (3.9, 0.5, 0.8), (5.0, 1.5, 1.9))  # wall
    broken = punched(broken, (2.5, 2.0, 2.0), (5.0, 4.0, 4.0))  # a corner of the ceiling with its walls
    patches, truth = run(broken @ turn, room @ turn, INSIDE @ turn)
    mesh = patches.mesh
    rays = INSIDE[0] @ turn, np.random.default_rng(0).standard_normal((4000, 3))
    np.testing.assert_allclose(mesh.cast(*rays).t, truth.cast(*rays).t, atol=2e-3)
    # One patch a side, the largest first: floor and ceiling, the walls across y and those across x.
    assert patches.area == pytest.approx([12, 12, 10, 10, 7.5, 7.5], rel=2e-3)
    assert mesh.areas.sum() == pytest.approx(truth.areas.sum(), rel=2e-3)
    for k in range(6):
        own = patches.faces(k)
        np.testing.assert_allclose(mesh.triangles[own] @ patches.normal[k], patches.offset[k], atol=1e-6)
    assert len(largest_first(patches, 9.0)) == 4


def test_a_doorway_seen_through_stays_open():
    wall = box((1.9, 0.0, 0.0), (2.1, 3.0, 2.5))
    door = (1.8, 1.0, -0.1), (2.2, 2.0, 2.0)
    rim = np.concatenate(
        [sheet(1, 1.0, (0.0, 1.9), (2.0, 2.1), 1), sheet(1, 2.0, (0.0, 1.9), (2.0, 2.1), -1),
         sheet(2, 2.0, (1.9, 1.0), (2.1, 2.0), -1)]
    )  # fmt: skip
    room = np.concatenate([box(*ROOM, sign=-1), punched(wall, *door), rim])
    broken = punched(room, (1.8, 0.2, 1.0), (2.2, 0.6, 1.6))  # a hole in both faces of the wall
    patches, truth = run(broken, room, [*INSIDE, [0.8, 1.5, 1.0], [3.2, 1.5, 1.0]])
    mesh = patches.mesh
    y, z = np.meshgrid(np.linspace(0.05, 2.95, 40), np.linspace(0.05, 2.45, 40))
    here = np.stack([np.full(y.size, 1.5), y.ravel(), z.ravel()], axis=1)
    there = here + [1.0, 0, 0]
    near_rim = (
        (np.abs(here[:, 1] - 1.0) < 0.1) | (np.abs(here[:, 1] - 2.0) < 0.1) | (np.abs(here[:, 2] - 2.0) < 0.1)
    )
    np.testing.assert_array_equal(mesh.visible(here, there)[~near_rim], truth.visible(here, there)[~near_rim])


def test_a_mesh_without_planes_or_views_stays_as_it_is():
    rng = np.random.default_rng(0)
    mesh = Mesh(rng.random((30, 3)), rng.integers(0, 30, (40, 3)))
    views = cameras([[0.5, 0.5, 0.5]])
    none = PlanarPatches.from_planes(mesh, np.full(40, -1), np.zeros((0, 3)), [], tolerance_m=1e-6)
    assert complete(none, views, [np.ones((80, 80))] * 6) is none
    patches = find_patches(as_mesh(box(*ROOM, sign=-1)), config=FLAT)
    assert complete(patches, [], []) is patches


def test_a_place_seen_in_part_only_is_not_guessed():
    hall = box((0.0, 0.0, 0.0), (9.0, 6.0, 5.0), sign=-1)
    end = punched(hall, (1.0, -1.0, 0.05), (10.0, 7.0, 6.0))
    end = punched(end, (1.0, 0.5, -1.0), (7.5, 7.0, 1.0))  # and a strip of the floor, up to the camera
    mesh = as_mesh(end)
    patches = find_patches(mesh, config=FLAT)
    views = [cameras([[8.0, 3.0, 2.0]])[3]]  # looks there
    depths = seen(mesh, as_mesh(hall), views)
    assert complete(patches, views, depths) is patches


def test_an_oblique_surface_is_kept():
    room = box(*ROOM, sign=-1)
    ramp = sheet(2, 0.0, (1.0, 1.0), (2.0, 2.0), 1)
    ramp[..., 2] = 0.4 + 0.5 * (ramp[..., 0] - 1.0)  # a board in the air, 27 degrees steep
    whole = np.concatenate([room, ramp, ramp[:, ::-1] - [0, 0, 0.04]])  # its two faces
    patches, _ = run(whole, whole, INSIDE)
    n = np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25)
    both = np.abs(patches.normal @ n) > 0.999
    assert both.sum() == 2
    assert patches.area[both].sum() == pytest.approx(2 * np.sqrt(1.25), rel=1e-3)
    points = np.random.default_rng(1).uniform((1.1, 1.1, 2.0), (1.9, 1.9, 2.4), (4000, 3))
    below = patches.mesh.cast(points, [0, 0, -1.0]).point
    np.testing.assert_allclose(below[:, 2], 0.4 + 0.5 * (points[:, 0] - 1), atol=1e-6)
