"""Planes proven by comparing photos, on photos of a painted room that is known in closed form."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import views

from warprrf.geometry.photos import sweep
from warprrf.geometry.photos.cells import meeting, occupancy
from warprrf.geometry.photos.config import PlaneConfig
from warprrf.geometry.photos.planes import Plane, aligned, plane_axes

pytest.importorskip("open3d")
look = partial(views.look, width=240, height=180, f=170.0)

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
    u = np.arange(-half, half, 0.05) + 0.025
    points = np.stack([*(g.ravel() for g in np.meshgrid(u, u)), np.full(u.size**2, z)], axis=1)
    none = points[:0]
    plane = Plane(np.array([0.0, 0, 1]), z, np.arange(len(points)))
    return points, occupancy([plane], points, none, none, config=PlaneConfig(margin_m=0.0))[0]


@pytest.mark.usefixtures("device")
def test_agreement_is_the_mean_correlation_over_pairs(views):
    cameras, photos = views
    centre, axes = np.array([[0.9, -1.0, 0.02]]), plane_axes(np.array([0.0, 0, 1]))
    chosen = sweep.choose_views(centre, np.array([0.0, 0, 1]), np.ones((1, 12), dtype=bool), cameras)
    got, contrast = photos.agreement(centre, axes, chosen)
    # By brute force: bilinear samples, then np.corrcoef over all pairs.
    offsets = (np.arange(sweep.SIDE) - (sweep.SIDE - 1) / 2) * sweep.PATCH_M / (sweep.SIDE - 1)
    grid = np.array([a * axes[0] + b * axes[1] for b in offsets for a in offsets]) + centre
    rows = []
    for c in chosen[0]:
        image = photo(cameras[c])[..., 0].astype(np.float64)
        uv = cameras[c].project(grid)[0] - 0.5
        j, i = np.floor(uv).astype(int).T
        fx, fy = (uv - np.floor(uv)).T
        rows.append(
            (1 - fy) * ((1 - fx) * image[i, j] + fx * image[i, j + 1])
            + fy * ((1 - fx) * image[i + 1, j] + fx * image[i + 1, j + 1])
        )
    pairs = np.corrcoef(rows)[np.triu_indices(len(rows), 1)]
    assert got[0] == pytest.approx(pairs.mean(), abs=2e-3)
    assert contrast[0] == pytest.approx(np.mean([np.std(r) for r in rows]), rel=1e-3)


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


def test_what_one_looks_through_is_no_table():
    plane = floor_plane(0.5, z=0.7)[1]
    rng = np.random.default_rng(0)
    targets = np.concatenate([rng.uniform(-1, 1, (400, 2)), np.zeros((400, 1))], axis=1)
    eyes = np.tile([0.0, 0, 2], (400, 1))
    assert (plane.seen_through(eyes, targets, 0.05) > 0)[plane.occupied].mean() > 0.5
    assert not plane.seen_through(eyes, targets + [0, 0, 0.7], 0.05).any()


def test_a_small_known_piece_grows_to_what_the_photos_show(views):
    _, photos = views
    points, piece = floor_plane(0.9)  # with the table's shadow in it: photos disagree there
    (proven,) = sweep.proven_cells([replace(piece, inliers=np.zeros(0, dtype=int))], points, photos)
    assert proven.area() > 1.8 * piece.area()
    corner = np.array([[1.2, 1.2, 0.0], [-1.2, 1.2, 0], [1.2, -1.2, 0], [-1.2, -1.2, 0]])
    assert proven.covers(corner).mean() >= 0.75


def rectangle(normal, origin, first, second, cell=0.1):
    """A plane patch through ``origin`` spanned by ``first`` and ``second`` (whole cells)."""
    normal = np.asarray(normal, float)
    axes = plane_axes(normal)
    steps = [np.arange(cell / 2, np.linalg.norm(s), cell)[:, None] * (s / np.linalg.norm(s)) for s in
             (np.asarray(first, float), np.asarray(second, float))]  # fmt: skip
    points = (np.asarray(origin, float) + steps[0][:, None] + steps[1][None]).reshape(-1, 3)
    uv = points @ axes.T
    corner = uv.min(axis=0) - cell / 2
    index = np.round((uv - corner) / cell - 0.5).astype(int)
    occupied = np.zeros(index.max(axis=0) + 1, dtype=bool)
    occupied[tuple(index.T)] = True
    return Plane(normal, float(normal @ origin), np.zeros(0, int), 0.0, corner, cell, occupied)


def test_wall_and_floor_reach_their_common_edge():
    floor = rectangle([0, 0, 1], [0.2, 0, 0], [2, 0, 0], [0, 2, 0])  # stops 20 cm short of the wall
    wall = rectangle([1, 0, 0], [0, 0, 0.2], [0, 2, 0], [0, 0, 2])  # and the wall 20 cm above the floor
    floor2, wall2 = meeting([floor, wall])
    assert floor2.covers(np.array([[0.05, 1.0, 0], [0.15, 0.5, 0]])).all()
    assert wall2.covers(np.array([[0, 1.0, 0.05]])).all()
    assert not floor2.covers(np.array([[-0.15, 1.0, 0]])).any()  # nor through the wall
    assert floor2.area() == pytest.approx(floor.area() + 0.2 * 2, rel=0.1)


def test_the_faces_of_a_pillar_end_at_its_edge():
    front = rectangle([0, -1, 0], [-0.5, 0, 0], [1.2, 0, 0], [0, 0, 2])  # true to x = 0.5, hangs over to 0.7
    side = rectangle([1, 0, 0], [0.5, 0, 0], [0, 1, 0], [0, 0, 2])
    front2, side2 = meeting([front, side])
    assert not front2.covers(np.array([[0.65, 0, 1.0]])).any()
    assert front2.covers(np.array([[0.45, 0, 1.0], [-0.45, 0, 1]])).all()
    assert side2.occupied.sum() == side.occupied.sum()


def test_a_thin_screen_does_not_cut_the_floor_it_stands_on():
    floor = rectangle([0, 0, 1], [-2, 0, 0], [4, 0, 0], [0, 2, 0])
    sides = [rectangle([s, 0, 0], [0.1 * s, 0.5, 0], [0, 1, 0], [0, 0, 2]) for s in (1, -1)]
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
