"""Planes proven by comparing photos, on photos of a painted room that is known in closed form."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import views

from warprrf.geometry.photos import sweep
from warprrf.geometry.photos.cells import meeting
from warprrf.geometry.photos.planes import Plane, aligned

pytest.importorskip("open3d")
look, flat = partial(views.look, width=240, height=180, f=170.0), views.flat

TABLE = (np.array([-0.5, -0.4]), np.array([0.5, 0.4]), 0.7)  # corners and height of its top
LOW, HIGH = np.array([-2.0, -2.0]), np.array([2.0, 2.0])  # of the floor that is looked at
GRAIN = 0.08  # [m]; the sweep goes in steps of 3 cm and sees no texture much finer than that
NOISE = np.random.default_rng(7).random((256, 256)).astype(np.float32)


def paint(x, y):
    """A texture with structure from ``GRAIN`` up, bilinear in the cells of ``NOISE``."""
    u, v = np.mod(x / GRAIN, 256), np.mod(y / GRAIN, 256)
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - i, v - j
    at = lambda k, m: NOISE[k % 256, m % 256]  # noqa: E731
    return (1 - a) * ((1 - b) * at(i, j) + b * at(i, j + 1)) + a * (
        (1 - b) * at(i + 1, j) + b * at(i + 1, j + 1)
    )


def photo(camera):
    """Floor z = 0 with a table top (painted alike, 10 m further on in the texture); sky where neither is met."""
    d, o = camera.directions(), camera.position
    with np.errstate(divide="ignore", invalid="ignore"):
        top, floor = (TABLE[2] - o[2]) / d[..., 2], -o[2] / d[..., 2]
        p, q = o[:2] + top[..., None] * d[..., :2], o[:2] + floor[..., None] * d[..., :2]
        on_table = (top > 0) & ((p > TABLE[0]) & (p < TABLE[1])).all(axis=-1)
        grey = np.where(on_table, paint(p[..., 0] + 10, p[..., 1]), paint(q[..., 0], q[..., 1]))
        grey = np.where(on_table | (floor > 0), grey, 0.5)
    return np.repeat(grey[..., None].astype(np.float32), 3, axis=-1)


@pytest.fixture(scope="module")
def views():
    cameras = [
        look([2.6 * np.cos(a), 2.6 * np.sin(a), 1.5 + 0.2 * (k % 2)], [0, 0, 0.3])
        for k, a in enumerate(np.arange(12) * np.pi / 6)
    ]
    return cameras, sweep.GreyPhotos.upload(cameras, [photo(c) for c in cameras], device="cpu")


def floor_plane(half, z=0.0):
    return flat([0, 0, 1], [-half, -half, z], [half, half, z])


def test_compared_photos_differ_in_direction():
    cameras = [look([2.0, 0.02 * k, 1.0], [0, 0, 0.0]) for k in range(10)] + [
        look([0, 2.0, 1.0], [0, 0, 0.0])
    ]
    chosen = sweep.choose_views(
        np.zeros((1, 3)), np.array([0.0, 0, 1]), np.ones((1, 11), dtype=bool), cameras
    )
    used = chosen[chosen >= 0]
    line = np.array([cameras[c].position for c in used])
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    angle = np.arccos(np.clip(line @ line.T, -1, 1))[np.triu_indices(len(used), 1)]
    assert 10 in used and (angle > np.radians(sweep.MIN_ANGLE_DEG)).all()


def test_a_table_top_without_any_feature_is_found_at_its_height(views):
    _, photos = views
    points, floor = floor_plane(2.0)
    corners = np.array([[x, y, z] for x in (-2, 2) for y in (-2, 2) for z in (0.0, 2.0)])
    none = np.zeros((0, 3))
    spread = np.concatenate([points, np.repeat(corners, 30, axis=0)])
    found = sweep.joined([floor], sweep.level_planes([floor], spread, photos, (none, none)))
    (table,) = [p for p in found if p.offset > 0.3]
    assert table.offset == pytest.approx(TABLE[2], abs=5e-3)
    size = TABLE[1] - TABLE[0]
    assert table.area() == pytest.approx(np.prod(size), rel=0.35)
    inside = ((table.cells()[:, :2] > TABLE[0] - 0.1) & (table.cells()[:, :2] < TABLE[1] + 0.1)).all(axis=1)
    assert inside.all()


def test_a_small_known_piece_grows_to_what_the_photos_show(views):
    _, photos = views
    points, piece = floor_plane(0.9)  # with the table's shadow in it: photos disagree there
    (proven,) = sweep.proven_cells([replace(piece, inliers=np.zeros(0, dtype=int))], points, photos)
    assert proven.area() > 1.8 * piece.area()
    corner = np.array([[1.2, 1.2, 0.0], [-1.2, 1.2, 0], [1.2, -1.2, 0], [-1.2, -1.2, 0]])
    assert proven.covers(corner).mean() >= 0.75


def test_wall_and_floor_reach_their_common_edge():
    floor = flat([0, 0, 1], [0.2, 0, 0], [2.2, 2, 0])[1]  # stops 20 cm short of the wall
    wall = flat([1, 0, 0], [0, 0, 0.2], [0, 2, 2.2])[1]  # and the wall 20 cm above the floor
    floor2, wall2 = meeting([floor, wall])
    assert floor2.covers(np.array([[0.05, 1.0, 0], [0.15, 0.5, 0]])).all()
    assert wall2.covers(np.array([[0, 1.0, 0.05]])).all()
    assert not floor2.covers(np.array([[-0.15, 1.0, 0]])).any()  # nor through the wall
    assert floor2.area() == pytest.approx(floor.area() + 0.2 * 2, rel=0.1)


def test_the_faces_of_a_pillar_end_at_its_edge():
    front = flat([0, -1, 0], [-0.5, 0, 0], [0.7, 0, 2])[1]  # true to x = 0.5, hangs over to 0.7
    side = flat([1, 0, 0], [0.5, 0, 0], [0.5, 1, 2])[1]
    front2, side2 = meeting([front, side])
    assert not front2.covers(np.array([[0.65, 0, 1.0]])).any()
    assert front2.covers(np.array([[0.45, 0, 1.0], [-0.45, 0, 1]])).all()
    assert side2.occupied.sum() == side.occupied.sum()


def test_a_thin_screen_does_not_cut_the_floor_it_stands_on():
    floor = flat([0, 0, 1], [-2, 0, 0], [2, 2, 0])[1]
    sides = [flat([s, 0, 0], [0.1 * s, 0.5, 0], [0.1 * s, 1.5, 2])[1] for s in (1, -1)]
    floor2, *_ = meeting([floor, *sides])
    assert floor2.occupied.sum() == floor.occupied.sum()


def test_nearly_level_weak_planes_become_level_and_tilted_ones_stay():
    rng = np.random.default_rng(0)
    sizes, noise = np.repeat([2.0, 0.2, 1.0], [900, 40, 60]), np.repeat([0.003, 0.004, 0.001], [900, 40, 60])
    flat = np.column_stack(
        [sizes[:, None] * rng.uniform(-1, 1, (1000, 2)), noise * rng.standard_normal(1000)]
    )
    strong, weak, tilted = flat[:900, [2, 0, 1]], flat[900:940], flat[940:]
    slope = np.array([np.sin(0.04), 0, np.cos(0.04)])
    tilted[:, 2] -= tilted[:, 0] * np.tan(0.04)
    points = np.concatenate([strong, weak, tilted])
    off = np.array([np.sin(0.03), 0, np.cos(0.03)])
    planes = [
        Plane(np.array([1.0, 0, 0]), 0.0, np.arange(900), 0.003),
        Plane(off, 0.0, np.arange(900, 940), 0.004),
        Plane(slope, 0.0, np.arange(940, 1000), 0.001),
    ]
    wall, seat, ramp = aligned(planes, points)
    np.testing.assert_array_equal(seat.normal, [0, 0, 1])
    assert abs(seat.offset) < 2e-3
    np.testing.assert_array_equal(ramp.normal, slope)
    assert wall is planes[0]
