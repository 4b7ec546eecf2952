"""What a refinement starts from, on photos of a painted floor and table that are known in closed form."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import views

from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.gaussians import sweep
from warprrf.geometry.photos.gaussians.cells import meeting
from warprrf.geometry.photos.gaussians.initialise import initialise
from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.photos.posed.sparse import SparseModel, detect_room_planes
from warprrf.geometry.planes import Plane, aligned

pytest.importorskip("open3d")
look, flat = partial(views.look, width=240, height=180, f=170.0), views.flat

TABLE = (np.array([-0.5, -0.4]), np.array([0.5, 0.4]), 0.7)  # corners and height of its top
PLAIN_Y = -1.0  # beyond it the floor shows nothing
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
        grey = np.where(on_table | ((floor > 0) & (q[..., 1] > PLAIN_Y)), grey, 0.5)
    return np.repeat(grey[..., None].astype(np.float32), 3, axis=-1)


@pytest.fixture(scope="module")
def sparse():
    """Points of the floor, but for what the table hides, and of a wall; then wrong ones: lone, seen twice, off by two pixels."""
    angle = np.arange(12) * np.pi / 6
    eyes = np.column_stack([1.4 * np.cos(angle), 1.4 * np.sin(angle), 2.6 + 0.2 * (np.arange(12) % 2)])
    rng = np.random.default_rng(0)
    floor = rng.uniform([-0.9, -1.7, 0], [0.9, 0.9, 0], (1500, 3))
    floor = floor[(np.abs(floor[:, :2]) > TABLE[1]).any(axis=1)]
    good = np.concatenate([floor, rng.uniform([-2, -1, 0], [-2, 1, 2], (1000, 3))])
    lone = rng.uniform([-1.2, -1.2, 0.9], [1.2, 1.2, 2.0], (20, 3))
    crowds = [at + 0.01 * rng.standard_normal((20, 3)) for at in ([0.6, 0.7, 1.2], [-0.6, 0.7, 1.3])]
    points = np.concatenate([good + 0.003 * rng.standard_normal(good.shape), lone, *crowds])
    length, error = np.full(len(points), 3), np.full(len(points), 0.3)
    length[-40:-20], error[-20:] = 2, 2.0
    share = (TABLE[2] - eyes[:, 2]) / (points[:, None, 2] - eyes[:, 2])
    crossed = eyes[:, :2] + share[..., None] * (points[:, None, :2] - eyes[:, :2])
    hidden = ((crossed > TABLE[0]) & (crossed < TABLE[1])).all(axis=-1) & (share < 1)
    order = np.argsort(hidden + rng.random(hidden.shape), axis=1)
    seen = np.concatenate([row[:n] for row, n in zip(order, length, strict=True)])
    cameras = {f"{k}.png": look(eye, [0, 0, 0.3]) for k, eye in enumerate(eyes)}
    colors = np.full(points.shape, 0.5)
    return SparseModel(cameras, points, colors, error, length, seen, metric=True, upright=True)


def test_planes_go_as_far_as_photos_show_them_and_take_fine_discs_where_these_are_busy(sparse):
    images = [photo(camera) for camera in sparse.cameras.values()]
    config = ReconstructionConfig(plain=False, gaussians=3000)
    planes, g = initialise(sparse, PosedPhotos(images, [*sparse.cameras.values()]), config=config)
    floor, _, table = planes
    np.testing.assert_array_equal([floor.normal, table.normal], [[0, 0, 1], [0, 0, 1]])
    # The floor beyond its points, but not beneath the table, of which there is no point at all.
    assert floor.covers(np.array([[x, y, 0] for x in (-1.2, 1.2) for y in (-0.8, 1.2)])).all()
    assert not floor.covers(np.array([[0, 0, 0], [0.1, 0.1, 0]])).any()
    assert [floor.offset, table.offset] == pytest.approx([0, TABLE[2]], abs=5e-3)
    assert table.area() == pytest.approx(np.prod(TABLE[1] - TABLE[0]), rel=0.1)
    here = (np.abs(g.means[:, :2]) < 1.5).all(axis=1)
    z, y = g.means[here, 2], g.means[here, 1]
    assert np.minimum(np.abs(z), np.abs(z - TABLE[2])).max() < 5e-3  # none on wrong points
    assert np.abs(g.normals[here, 2]).min() > 1 - 1e-6 and 2500 < len(g) <= 3000
    assert (g.scales.min(axis=1) < 0.1 * g.scales.max(axis=1)).all()
    grey = (g.sh[here, 0] * 0.5 / np.sqrt(np.pi) + 0.5).mean(axis=1)
    busy, plain = (z < 0.1) & (y > PLAIN_Y + 0.1), (z < 0.1) & (y < PLAIN_Y - 0.1)
    assert busy.sum() / 2.4 > 4 * plain.sum() / 0.4  # by area
    assert np.corrcoef(grey[busy], paint(*g.means[here][busy, :2].T))[0, 1] > 0.95
    np.testing.assert_allclose(grey[plain], 0.5, atol=1e-3)


def test_photos_of_two_sizes_are_compared(sparse):
    cameras = [c.resized(200, 150) if k % 2 else c for k, c in enumerate(sparse.cameras.values())]
    config = ReconstructionConfig(plain=False, gaussians=3000)
    planes, _ = initialise(sparse, PosedPhotos([photo(c) for c in cameras], cameras), config=config)
    assert [p.offset for p in planes if p.normal[2] > 0.99] == pytest.approx([0, TABLE[2]], abs=5e-3)
    assert planes[-1].area() == pytest.approx(np.prod(TABLE[1] - TABLE[0]), rel=0.1)


def test_a_plane_whose_features_were_taken_for_two_is_one(sparse, monkeypatch):
    def halves(cleaned, *args):
        (floor, *others), normals = detect_room_planes(cleaned, *args)
        left = cleaned.points[floor.inliers, 0] < 0
        parts = floor.inliers[left], floor.inliers[~left]
        halved = [replace(floor, inliers=own, offset=floor.offset + 0.01 * k) for k, own in enumerate(parts)]
        return halved + others, normals

    images = [photo(camera) for camera in sparse.cameras.values()]
    config = ReconstructionConfig(plain=False, sweep=False, gaussians=3000)
    monkeypatch.setattr("warprrf.geometry.photos.gaussians.initialise.detect_room_planes", halves)
    wall, floor = initialise(sparse, PosedPhotos(images, [*sparse.cameras.values()]), config=config)[0]
    assert abs(wall.normal[2]) < 0.01 and floor.covers(np.array([[x, 0.7, 0] for x in (-0.7, 0.7)])).all()


def test_compared_photos_differ_in_direction():
    eyes = [*([2.0, 0.02 * k, 1.0] for k in range(10)), [0, 2.0, 1.0]]
    cameras = [look(eye, [0, 0, 0.0]) for eye in eyes]
    chosen = sweep.choose_views(None, np.zeros((1, 3)), np.array([0.0, 0, 1]), cameras)
    used = chosen[chosen >= 0]
    line = np.array([cameras[c].position for c in used])
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    angle = np.arccos(np.clip(line @ line.T, -1, 1))[np.triu_indices(len(used), 1)]
    assert 10 in used and (angle > np.radians(sweep.MIN_ANGLE_DEG)).all()


def test_wall_and_floor_reach_their_common_edge():
    floor = flat([0, 0, 1], [0.2, 0, 0], [2.2, 2, 0])[1]  # stops 20 cm short of the wall
    wall = flat([1, 0, 0], [0, 0, 0.2], [0, 2, 2.2])[1]  # and the wall 20 cm above the floor
    floor2, wall2 = meeting([floor, wall])
    assert floor2.covers(np.array([[0.05, 1.0, 0], [0.15, 0.5, 0]])).all()
    assert wall2.covers(np.array([[0, 1.0, 0.05]])).all()
    assert not floor2.covers(np.array([[-0.15, 1.0, 0]])).any()  # nor through the wall
    assert floor2.area() == pytest.approx(floor.area() + 0.2 * 2, rel=0.1)


def test_pieces_of_one_plane_are_united_and_a_sign_before_its_wall_is_not():
    wall = flat([0, -1, 0], [0, 0, 0], [2, 0, 2])[1]
    piece = flat([0, -1, 0], [2.5, 0.015, 0], [3, 0.015, 1])[1]
    sign = flat([0, -1, 0], [0.5, -0.03, 0.5], [1, -0.03, 1])[1]
    back = flat([0, 1, 0], [0, 0.01, 0], [1, 0.01, 2])[1]
    one, *others = sweep.united((), [sign, piece, wall, back])
    assert one.area() == pytest.approx(wall.area() + piece.area(), rel=0.01)
    assert one.offset == wall.offset and [p.offset for p in others] == [back.offset, sign.offset]


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
    across = sizes[:, None] * rng.uniform(-1, 1, (1000, 2))
    flat = np.column_stack([across, noise * rng.standard_normal(1000)])
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
