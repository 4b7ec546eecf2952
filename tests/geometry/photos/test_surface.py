"""Points, planes, fused depth and planar patches against shapes known in closed form."""

from functools import partial

import numpy as np
import pytest
import views

from warprrf.geometry.photos.cells import occupancy
from warprrf.geometry.photos.fusion import fuse_depth
from warprrf.geometry.photos.planes import Plane, detect_planes, plane_axes
from warprrf.geometry.photos.points import clean_points
from warprrf.geometry.photos.snapping import find_patches, flattened, largest_first, simplified

pytest.importorskip("open3d")
look = partial(views.look, width=160, height=120, f=100.0, off=(1.5, -2.0))

LOW, HIGH = np.array([-2.0, -1.5, 0.0]), np.array([2.013, 1.517, 2.511])  # not whole voxels


def room_range(camera):
    """Distance to the inside of the box LOW..HIGH along every pixel's ray."""
    d = camera.directions()
    with np.errstate(divide="ignore"):
        return np.where(d > 0, (HIGH - camera.position) / d, (LOW - camera.position) / d).min(axis=-1)


def room_cameras():
    angles = np.arange(12) * np.pi / 6
    return [
        look([0.5 * np.cos(a), 0.4 * np.sin(a), 1.2], [np.cos(a), np.sin(a), 1.2 + tilt])
        for a in angles
        for tilt in (-2.5, -0.7, 0.0, 0.7, 2.5)
    ]


def room_distance(points):
    return np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(axis=1)


@pytest.fixture(scope="module")
def fused():
    rng = np.random.default_rng(0)
    cameras = room_cameras()
    depths = [room_range(c) + 0.004 * rng.standard_normal((c.height, c.width)) for c in cameras]
    return fuse_depth(depths, cameras)


def grid_on(plane_normal, offset, size=1.0, step=0.05):
    u, v = np.meshgrid(np.arange(-size, size, step), np.arange(-size, size, step))
    axes = plane_axes(np.asarray(plane_normal, float))
    return np.stack([u.ravel(), v.ravel()], axis=1) @ axes + offset * np.asarray(plane_normal, float)


def test_planted_outliers_are_cleaned_and_little_else():
    rng = np.random.default_rng(0)
    good = np.concatenate([rng.uniform(-1, 1, (2000, 2)), 0.003 * rng.standard_normal((2000, 1))], axis=1)
    bad = rng.uniform(-3, 3, (40, 3)) + [0, 0, 5]
    keep = clean_points(np.concatenate([good, bad]))
    assert not keep[2000:].any()
    assert keep[:2000].mean() > 0.97
    error, length = np.full(2000, 0.3), np.full(2000, 4)
    error[:10], length[10:20] = 3.0, 2
    keep = clean_points(good, reprojection_error=error, track_length=length)
    assert not keep[:20].any()


def test_planes_are_found_in_noisy_points_with_outliers():
    rng = np.random.default_rng(2)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    truth = [
        (s * turn[:, k], d) for k, d in ((0, 1.0), (1, 1.5), (2, 2.0)) for s in (1, -1)
    ]  # a box seen from outside
    points, normals = [], []
    for normal, offset in truth:
        uv = rng.uniform(-1, 1, (700, 2))
        points.append(uv @ plane_axes(normal) + (offset + 0.005 * rng.standard_normal((700, 1))) * normal)
        wobble = normal + 0.1 * rng.standard_normal((700, 3))
        normals.append(wobble / np.linalg.norm(wobble, axis=1, keepdims=True))
    points.append(rng.uniform(-2, 2, (800, 3)))
    stray = rng.standard_normal((800, 3))
    normals.append(stray / np.linalg.norm(stray, axis=1, keepdims=True))
    found = detect_planes(np.concatenate(points), np.concatenate(normals))
    assert len(found) == len(truth)
    for k, (normal, offset) in enumerate(truth):
        match = max(found, key=lambda p: p.normal @ normal)
        assert (
            np.degrees(np.arccos(min(1.0, match.normal @ normal))) < 0.1
        )  # 5 mm / 1 m / sqrt(700) is 0.01 degrees
        assert abs(match.offset - offset) < 1.5e-3
        own = (match.inliers >= 700 * k) & (match.inliers < 700 * (k + 1))
        assert own.mean() > 0.95 and own.sum() > 650
        assert match.rms_m == pytest.approx(0.005, rel=0.1)


def test_the_two_sides_of_a_thin_wall_are_two_planes():
    front, back = grid_on([1, 0, 0], 0.005), grid_on([1, 0, 0], -0.005)
    points = np.concatenate([front, back])
    normals = np.repeat([[1.0, 0, 0], [-1.0, 0, 0]], [len(front), len(back)], axis=0)
    found = detect_planes(points, normals)
    assert sorted(np.round(p.normal @ [1, 0, 0]) for p in found) == [-1, 1]
    for plane in found:
        assert plane.offset == pytest.approx(0.005, abs=1e-9)


def test_noise_around_a_plane_is_no_second_plane_but_a_poster_is():
    rng = np.random.default_rng(3)
    wall = np.concatenate([rng.uniform(-2, 2, (4000, 2)), 0.02 * rng.standard_normal((4000, 1))], axis=1)
    up = np.tile([0.0, 0, 1], (4000, 1))
    assert len(detect_planes(wall, up)) == 1
    inside = (np.abs(wall[:, :2]) < 0.5).all(axis=1)
    poster = wall * [1, 1, 0.05]
    poster[inside, 2] += 0.08
    offsets = sorted(p.offset for p in detect_planes(poster, up))
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
        return np.array([[*p.normal, p.offset] for p in detect_planes(points, normals)])

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
    (found,) = occupancy([plane], frame, eyes, targets)
    assert not found.covers(np.array([[0.0, 0, 0], [0.2, 0, -0.2]])).any()
    assert found.covers(np.array([[0.8, 0, 0.8], [-0.7, 0, 0.0], [0.0, 0, 0.9]])).all()
    assert not found.covers(np.array([[1.8, 0, 0]])).any()
    # Nobody looks through: the hole is filled, as a bare patch of wall would be.
    (closed,) = occupancy([plane], frame, eyes[:0], targets[:0])
    assert closed.covers(np.array([[0.0, 0, 0]])).all()
    assert closed.area() > found.area() + 0.5


def test_fused_room_has_no_bias_on_any_side(fused):
    # A pixel off by half would move floor and ceiling alike by 1 cm here.
    vertices = fused.vertices
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        middle = (
            np.abs(vertices[:, others] - ((LOW + HIGH) / 2)[others]) < 0.6 * ((HIGH - LOW) / 2)[others]
        ).all(axis=1)
        for wall in (LOW[axis], HIGH[axis]):
            near = vertices[middle & (np.abs(vertices[:, axis] - wall) < 0.1), axis] - wall
            assert len(near) > 100
            assert abs(np.median(near)) < 2.5e-3
    assert np.percentile(room_distance(vertices), 90) < 0.01


def test_fused_surface_faces_the_cameras(fused):
    centres = fused.triangles.mean(axis=1)
    inward = ((np.array([0, 0, 1.2]) - centres) * fused.face_normals).sum(axis=1) > 0
    assert inward.mean() > 0.999


def walls():
    return [
        Plane(s * np.eye(3)[a], float(s * wall[a]), np.zeros(0, dtype=int))
        for a in range(3)
        for s, wall in ((1, LOW), (-1, HIGH))
    ]


@pytest.mark.parametrize("known", [True, False])
def test_patches_of_a_room_are_its_six_sides(fused, known):
    patches = largest_first(find_patches(fused, walls() if known else ()), 0.15)
    assert len(patches) == 6
    size = HIGH - LOW
    for normal, offset, area in zip(patches.normal, patches.offset, patches.area, strict=True):
        axis = np.abs(normal).argmax()
        wall = LOW[axis] if normal[axis] > 0 else HIGH[axis]
        assert np.degrees(np.arccos(np.abs(normal[axis]))) < 0.2
        assert abs(offset - normal[axis] * wall) < 4e-3
        assert area == pytest.approx(np.prod(size) / size[axis], rel=0.08)
    assert (patches.face_patch >= 0).mean() > 0.98


def test_flattened_patches_are_flat_with_sharp_edges(fused):
    patches = flattened(find_patches(fused, walls()))
    flat = patches.mesh
    for k in range(6):
        corners = flat.triangles[patches.faces(k)]
        assert np.median(np.abs(corners @ patches.normal[k] - patches.offset[k])) < 1e-12
    assert np.percentile(room_distance(flat.vertices), 99) < 1e-9
    # The edge of wall and floor was rounded by the voxels, and is no more.
    at = [LOW[0], 0.3, LOW[2]]
    assert np.linalg.norm(flat.vertices - at, axis=1).min() < 0.04
    assert np.abs(np.linalg.norm(fused.vertices - at, axis=1)).min() < 0.08


def test_simplified_room_is_the_same_surface_with_few_faces(fused):
    flat = flattened(find_patches(fused, walls()))
    coarse = simplified(flat)
    assert len(coarse.mesh.faces) < 0.15 * len(flat.mesh.faces)
    d = np.random.default_rng(0).standard_normal((20_000, 3))
    origin = np.tile([0.1, 0.2, 1.1], (len(d), 1))
    before, after = flat.mesh.cast(origin, d), coarse.mesh.cast(origin, d)
    assert after.valid.mean() > before.valid.mean() - 2e-3
    both = before.valid & after.valid
    assert np.percentile(np.abs(after.t[both] - before.t[both]), 99) < 1e-3
    for k in range(6):
        assert (coarse.mesh.face_normals[coarse.faces(k)] @ coarse.normal[k] > 0).all()
