"""Planes against shapes known in closed form."""

import numpy as np
import pytest
from radio_scenes import box_mesh
from trimesh.remesh import subdivide_to_size
from views import pinhole

from warprrf.geometry import pipeline
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.gaussians.cells import occupancy
from warprrf.geometry.photos.gaussians.initialise import discs
from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.photos.surface.fusion import (
    _sure,
    depth_maps,
    depth_views,
    fuse_depth,
    fuse_maps,
)
from warprrf.geometry.planes import Plane, PlaneConfig, detect_planes, plane_axes
from warprrf.geometry.scans import SurfaceConfig, find_patches

CONFIG = ReconstructionConfig()
CAMERA = pinhole(64, 48, focal=50)
WALL = 2.0 / CAMERA.directions()[..., 2]  # its range, at z = 2


def grid_on(plane_normal, offset, size=1.0, step=0.05):
    u, v = np.meshgrid(np.arange(-size, size, step), np.arange(-size, size, step))
    axes = plane_axes(np.asarray(plane_normal, float))
    return np.stack([u.ravel(), v.ravel()], axis=1) @ axes + offset * np.asarray(plane_normal, float)


def test_planes_are_found_in_noisy_points_with_outliers():
    rng = np.random.default_rng(2)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    # A box seen from outside.
    truth = [(s * turn[:, k], d) for k, d in ((0, 1.0), (1, 1.5), (2, 2.0)) for s in (1, -1)]
    points, normals = [], []
    for normal, offset in truth:
        uv = rng.uniform(-1, 1, (700, 2))
        points.append(uv @ plane_axes(normal) + (offset + 0.005 * rng.standard_normal((700, 1))) * normal)
        wobble = normal + 0.1 * rng.standard_normal((700, 3))
        normals.append(wobble / np.linalg.norm(wobble, axis=1, keepdims=True))
    points.append(rng.uniform(-2, 2, (800, 3)))
    stray = rng.standard_normal((800, 3))
    normals.append(stray / np.linalg.norm(stray, axis=1, keepdims=True))
    found = detect_planes(np.concatenate(points), np.concatenate(normals), config=PlaneConfig())
    assert len(found) == len(truth)
    for k, (normal, offset) in enumerate(truth):
        match = max(found, key=lambda p: p.normal @ normal)
        # 5 mm / 1 m / sqrt(700) is 0.01 degrees.
        assert np.degrees(np.arccos(min(1.0, match.normal @ normal))) < 0.1
        assert abs(match.offset - offset) < 1.5e-3
        own = (match.inliers >= 700 * k) & (match.inliers < 700 * (k + 1))
        assert own.mean() > 0.95 and own.sum() > 650
        assert match.rms_m == pytest.approx(0.005, rel=0.1)


def test_the_two_sides_of_a_thin_wall_are_two_planes():
    front, back = grid_on([1, 0, 0], 0.005), grid_on([1, 0, 0], -0.005)
    points = np.concatenate([front, back])
    normals = np.repeat([[1.0, 0, 0], [-1.0, 0, 0]], [len(front), len(back)], axis=0)
    found = detect_planes(points, normals, config=PlaneConfig())
    assert sorted(np.round(p.normal @ [1, 0, 0]) for p in found) == [-1, 1]
    for plane in found:
        assert plane.offset == pytest.approx(0.005, abs=1e-9)


def test_noise_around_a_plane_is_no_second_plane_but_a_poster_is():
    rng = np.random.default_rng(3)
    wall = np.concatenate([rng.uniform(-2, 2, (4000, 2)), 0.02 * rng.standard_normal((4000, 1))], axis=1)
    up = np.tile([0.0, 0, 1], (4000, 1))
    assert len(detect_planes(wall, up, config=PlaneConfig())) == 1
    inside = (np.abs(wall[:, :2]) < 0.5).all(axis=1)
    poster = wall * [1, 1, 0.05]
    poster[inside, 2] += 0.08
    offsets = sorted(p.offset for p in detect_planes(poster, up, config=PlaneConfig()))
    assert offsets == pytest.approx([0, 0.08], abs=1e-3)


def test_rounding_and_a_point_more_or_less_decide_nothing():
    """Eight weak planes in a cloud: draws follow from where points lie, not from their number or order."""
    rng = np.random.default_rng(4)
    points, normals = [rng.uniform(-3, 3, (4000, 3))], [rng.standard_normal((4000, 3))]
    for _ in range(8):
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        flat = rng.uniform(-0.25, 0.25, (50, 2)) @ plane_axes(normal)
        points.append(rng.uniform(-3, 3, 3) + flat + 0.003 * rng.standard_normal((50, 1)) * normal)
        normals.append(normal + 0.15 * rng.standard_normal((50, 3)))
    points, normals = np.concatenate(points), np.concatenate(normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def planes(points, normals):
        return np.array([[*p.normal, p.offset] for p in detect_planes(points, normals, config=PlaneConfig())])

    usual, back, less = planes(points, normals), slice(None, None, -1), slice(1, None)
    assert len(usual) == 8
    np.testing.assert_allclose(planes(points[back], normals[back]), usual, atol=1e-9)
    np.testing.assert_allclose(planes(points[less], normals[less]), usual, atol=1e-9)
    np.testing.assert_allclose(planes(points * (1 + 1e-7), normals), usual, atol=1e-5)


def test_a_plane_is_empty_where_one_sees_through_it():
    frame = grid_on([0, 1, 0], 0.0)
    window = (np.abs(frame) < 0.4).all(axis=1)
    plane = Plane(np.array([0.0, 1, 0]), 0.0, np.flatnonzero(~window))
    eyes = np.tile([0.0, 3, 0], (int(window.sum()), 1))
    targets = frame[window] * [2, 1, 2] - [0, 3, 0]  # three metres behind, straight through the window
    (found,) = occupancy([plane], frame, eyes, targets, config=PlaneConfig())
    assert not found.covers(np.array([[0.0, 0, 0], [0.2, 0, -0.2]])).any()
    assert found.covers(np.array([[0.8, 0, 0.8], [-0.7, 0, 0.0], [0.0, 0, 0.9]])).all()
    assert not found.covers(np.array([[1.8, 0, 0]])).any()
    # Nobody looks further than the plane: the hole is filled, as a bare patch of wall would be.
    (closed,) = occupancy([plane], frame, eyes, frame[window], config=PlaneConfig())
    assert closed.covers(np.array([[0.0, 0, 0]])).all()
    assert closed.area() > found.area() + 0.5


def test_faces_go_to_the_planes_that_are_given_and_others_to_planes_of_their_own():
    vertices, faces = subdivide_to_size(*box_mesh([0, 0, 0], [4, 3, 2.5], inward=True), 0.2)
    mesh = Mesh(vertices + 0.004 * np.random.default_rng(0).standard_normal(vertices.shape), faces)
    planes = [Plane(np.eye(3)[a], 0.0, np.zeros(0, dtype=int)) for a in (2, 0)]
    patches = find_patches(mesh, planes, SurfaceConfig())
    np.testing.assert_array_equal(patches.normal[:2], [[0, 0, 1], [1, 0, 0]])
    assert patches.area[:2] == pytest.approx([12, 7.5], rel=0.05)
    rest = np.argsort(-patches.area[2:]) + 2  # ceiling, two long walls and a short one
    assert patches.area[rest] == pytest.approx([12, 10, 10, 7.5], rel=0.05)
    np.testing.assert_allclose(patches.normal[rest[[0, 3]]], [[0, 0, -1], [-1, 0, 0]], atol=2e-3)


def test_faces_of_a_given_plane_do_not_go_to_one_that_is_found_near_it():
    floor = subdivide_to_size(
        np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0.0]]), [[0, 1, 2], [0, 2, 3]], 0.2
    )
    step = floor[0] * [0.5, 0.5, 1] + [1, 1, 0.05], floor[1] + len(floor[0])
    mesh = Mesh(np.concatenate([floor[0], step[0]]), np.concatenate([floor[1], step[1]]))
    given = Plane(np.array([0.0, 0, 1]), -0.015, np.zeros(0, dtype=int))
    patches = find_patches(mesh, [given], SurfaceConfig())
    assert patches.area == pytest.approx([12, 3])
    assert patches.offset == pytest.approx([-0.015, 0.05])


def test_depth_maps_are_as_large_as_small_photos_and_smaller_than_large_ones():
    given = [pinhole(640, 480, focal=500), pinhole(1600, 1200, focal=1250)]
    small, large = depth_views(given, SurfaceConfig())
    assert (small.width, small.height, small.fx) == (640, 480, 500)
    assert large.width * large.height == pytest.approx(320_000, rel=2e-3)
    assert (
        large.fx / large.width == pytest.approx(1250 / 1600) == pytest.approx(0.75 * large.fy / large.height)
    )
    assert depth_views(given[:1], SurfaceConfig(depth_pixels=1))[0].width == 1
    with pytest.raises(ValueError, match="depth_pixels: got 0"):
        SurfaceConfig(depth_pixels=0)


def test_small_planes_are_parallel_to_larger_ones_that_they_are_nearly_parallel_to():
    def built(middle, size, tilt_deg):
        tilt = np.radians(tilt_deg)
        along, normal = np.array([np.cos(tilt), 0, np.sin(tilt)]), np.array([-np.sin(tilt), 0, np.cos(tilt)])
        x, y = (np.arange(-side / 2, side / 2 + 0.01, 0.1) for side in size)
        vertices = np.array(middle) + x[:, None, None] * along + y[:, None] * np.array([0.0, 1, 0])
        n = len(y)
        first = (np.arange(len(x) - 1)[:, None] * n + np.arange(n - 1)).ravel()
        faces = np.concatenate(
            [np.stack([first, first + n, first + n + 1], 1), np.stack([first, first + n + 1, first + 1], 1)]
        )
        plane = Plane(normal, float(normal @ middle), np.zeros(0, np.int64))
        return vertices.reshape(-1, 3), faces, plane

    def turned(*boards):
        start = np.cumsum([0, *(len(v) for v, _, _ in boards)])
        vertices = np.concatenate([v for v, _, _ in boards])
        faces = np.concatenate([f + first for (_, f, _), first in zip(boards, start, strict=False)])
        given = [plane for _, _, plane in boards]
        return given, find_patches(Mesh(vertices, faces), given, SurfaceConfig())

    small, long = built([0.0, 5, 1], (1, 1), 1.5), built([0.0, 12, 2], (9, 0.5), 1.5)
    given, patches = turned(built([0.0, 0, 0], (4, 4), 0.0), small, built([0.0, 8, 3], (1, 1), 4.0), long)
    np.testing.assert_array_equal(patches.normal[1], given[0].normal)
    assert patches.offset[1] == pytest.approx(1.0)  # turned about its middle
    for k, why in ((0, "the largest"), (2, "4 degrees"), (3, "its ends would move by 12 cm")):
        np.testing.assert_array_equal(patches.normal[k], given[k].normal, err_msg=why)
    given, patches = turned(built([0.0, 0, 0], (4, 4), 1.0), built([0.0, 5, 1], (1, 1), 0.0))
    np.testing.assert_array_equal(patches.normal[1], given[1].normal)  # it is level


def test_of_depths_that_no_photo_proves_those_stay_that_lie_on_a_plane():
    plane = Plane(
        np.array([0, 0, -1.0]),
        -2.0,
        np.zeros(0, np.int64),
        occupied=np.ones((3, 40), bool),
        corner=np.array([-0.1, -2]),
    )
    proved = np.zeros(WALL.shape, dtype=bool)
    proved[:5] = True
    for shift, held in ((1.0, True), (1.1, False)):
        kept = _sure(shift * WALL, proved, CAMERA, [plane], 0.06) > 0
        points = CAMERA.position + shift * WALL[..., None] * CAMERA.directions()
        there = plane.covers(points.reshape(-1, 3)).reshape(WALL.shape)
        assert 0.01 < (there & ~proved).mean() < 0.9
        np.testing.assert_array_equal(kept, proved | (there & held))


def test_depth_maps_of_gaussians_end_where_neither_photos_nor_planes_hold_them():
    at = np.stack([*np.mgrid[-2:2:0.05, -2:2:0.05], np.full((80, 80), 2.0)], axis=-1).reshape(-1, 3)
    wall = discs(at, np.tile([0, 0, -1.0], (len(at), 1)), np.full(len(at), 0.05), np.full(at.shape, 0.5))
    photos = PosedPhotos([np.full((48, 64, 3), 0.5, np.float32)], [CAMERA])  # one photo proves nothing
    plane = Plane(np.array([0, 0, -1.0]), -2.0, np.zeros(0, np.int64), occupied=np.ones((80, 80), bool),
                  corner=np.array([-4.0, -4.0]))  # fmt: skip
    kept, none = (
        depth_maps(wall, [CAMERA], photos=photos, planes=p, config=CONFIG)[0] for p in ([plane], [])
    )
    assert (kept > 0).mean() > 0.9 and np.abs(kept / WALL - 1)[kept > 0].max() < 0.02
    assert (none == 0).all()


def test_a_depth_map_with_few_known_pixels_does_not_end_the_fusion():
    few = np.zeros_like(WALL)
    few[9:12, 9:12] = WALL[9:12, 9:12]
    few[8, 8] = 100.0  # beyond the largest range
    mesh = fuse_depth([WALL, few, WALL], [CAMERA] * 3, config=SurfaceConfig())
    assert np.abs(mesh.vertices[:, 2] - 2).max() < 0.01


@pytest.mark.parametrize("least_views", [1, 2])
def test_as_many_depth_maps_as_must_see_a_surface_do(least_views):
    left = np.where(np.arange(64) < 32, WALL, 0.0)
    right = np.where(np.arange(64) < 32, 0.0, WALL)
    mesh = fuse_depth([left, right, right], [CAMERA] * 3, config=SurfaceConfig(), least_views=least_views)
    assert mesh.vertices[:, 0].max() > 1.0  # what two saw
    assert (mesh.vertices[:, 0].min() < -1.0) == (least_views == 1)


def test_holes_that_stay_open_are_said_to():
    patches, whole = fuse_maps([CAMERA] * 2, [WALL] * 2, config=CONFIG)
    assert len(patches.mesh.faces) and not whole  # one plane is no room
    said = pipeline._said_of_surface(0.1, 0.0, True)
    assert [text.split(":")[0] for text in said] == ["surface", "holes"]
    assert pipeline._said_of_surface(0.0, 0.0, False) == ()
