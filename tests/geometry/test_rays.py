"""Ray and distance queries, on both back ends, against answers known in closed form; their hard cases."""

import importlib.util
import os
import sys

import numpy as np
import pytest
from radio_scenes import box_mesh, joined
from scipy.spatial.transform import Rotation

from benchmarks.engine.rays import bumpy_sphere
from warprrf.device import resolve
from warprrf.geometry import rays as raysearch
from warprrf.geometry.mesh import Mesh

ROOM = (np.array([-7.0, -6.0, 0.0]), np.array([8.0, 6.0, 4.0]))
no_embree = pytest.mark.skipif(importlib.util.find_spec("open3d") is None, reason="needs open3d")


@pytest.fixture(
    params=["warp", pytest.param("embree", marks=no_embree), pytest.param("cuda", marks=pytest.mark.cuda)]
)
def where(request):
    """What searches, and where."""
    if request.param == "cuda":
        return {"backend": "warp", "device": "cuda:0"}
    return {"backend": request.param, "device": "cpu"}


def directions(n, seed=0):
    d = np.random.default_rng(seed).standard_normal((n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def box_exit(origin, d, low, high):
    """Where rays from inside a box, or from on one of its faces inwards, leave it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(d > 0, (high - origin) / d, (low - origin) / d)
    return np.where(d == 0, np.inf, t).min(axis=1)


def test_rays_at_vertices_and_edges_of_a_closed_mesh_do_not_escape(where):
    """Nor are they stopped elsewhere by faces that come twice or have no area."""
    clean, rng = bumpy_sphere(5_000), np.random.default_rng(1)
    dirt = np.concatenate([clean.faces[::9], clean.faces[::7, [0, 0, 1]]])
    mesh = Mesh(clean.vertices, np.concatenate([dirt, clean.faces]))
    assert mesh.is_closed
    vertex = mesh.vertices[rng.integers(len(mesh.vertices), size=60_000)]
    face = mesh.triangles[rng.integers(len(mesh.faces), size=60_000)]
    share = rng.uniform(size=(60_000, 1))
    edge = share * face[:, 0] + (1 - share) * face[:, 1]
    target = np.concatenate([vertex, edge, 10.0 * directions(80_000)])
    origin = rng.uniform(-0.05, 0.05, (len(target), 3))
    hit = mesh.cast(origin, target - origin, **where)
    assert hit.valid.all()
    distance = np.linalg.norm(target - origin, axis=1)[:120_000]
    np.testing.assert_allclose(hit.t[:120_000], distance, atol=5e-5)


def test_an_open_mesh_is_not_recast(where):
    whole = bumpy_sphere(5_000)
    mesh = Mesh(whole.vertices, whole.faces[:-1])
    assert not mesh.is_closed
    hole = whole.triangles[-1].mean(axis=0)
    assert mesh.cast([0, 0, 0], hole, **where).face[0] == -1


@pytest.mark.parametrize("height", [1e-3, 1e-5])
def test_grazing_rays_meet_floor_or_wall_where_they_should(where, height):
    rng = np.random.default_rng(2)
    n = 20_000
    origin = np.column_stack([rng.uniform(-6, 7, n), rng.uniform(-5, 5, n), np.full(n, height)])
    azimuth = rng.uniform(-np.pi, np.pi, n)
    slope = height * 10.0 ** rng.uniform(-2, 2, n)
    d = np.column_stack([np.cos(azimuth), np.sin(azimuth), -slope])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    hit = Mesh(*box_mesh(*ROOM)).cast(origin, d, **where)
    t = box_exit(origin, d, *ROOM)
    # Float32 places the foot of the wall to 1e-6 m: there a ray may be given either face.
    foot = np.abs(origin[:, 2] + d[:, 2] * box_exit(origin, d * [1, 1, 0], *ROOM)) < 4e-6
    np.testing.assert_allclose(hit.t[~foot], t[~foot], rtol=1e-9)
    assert foot.mean() < (0.01 if height == 1e-3 else 0.6)
    assert hit.valid.all()


def test_a_receiver_on_a_surface_meets_the_next_surface(where):
    turn, n = Rotation.random(None, 4).as_matrix(), 30_000
    vertices, faces = box_mesh(*ROOM)
    room = Mesh(vertices @ turn.T + [3.0, -2.0, 1.0], faces)
    rng = np.random.default_rng(5)
    p = rng.uniform(ROOM[0] + 0.1, ROOM[1] - 0.1, (n, 3))
    axis, side = rng.integers(3, size=n), rng.integers(2, size=n)
    p[np.arange(n), axis] = np.stack(ROOM)[side, axis]
    d = directions(n, seed=6)
    d[np.arange(n), axis] = np.abs(d[np.arange(n), axis]) * (1 - 2 * side)
    steep = np.abs(d[np.arange(n), axis]) > 1e-3
    # -0 and tiny distances to the own wall cannot arise: the ray leads away from it.
    t = box_exit(p, d, *ROOM)
    hit = room.cast(p @ turn.T + [3.0, -2.0, 1.0], d @ turn.T, **where)
    np.testing.assert_allclose(hit.t[steep], t[steep], rtol=1e-9)


def test_a_surface_just_before_the_receiver_is_met(where):
    rng = np.random.default_rng(7)
    gap = 10.0 ** rng.uniform(-9, -3, 5000)
    origin = np.column_stack([rng.uniform(-6, 7, 5000), rng.uniform(-5, 5, 5000), gap])
    down = directions(5000, seed=8)
    down[:, 2] = -np.abs(down[:, 2]) - 0.2
    unit = down / np.linalg.norm(down, axis=1, keepdims=True)
    hit = Mesh(*box_mesh(*ROOM)).cast(origin, down, **where)
    np.testing.assert_allclose(hit.t, -gap / unit[:, 2], rtol=1e-6)


def test_a_kilometre_scene_far_from_the_origin_is_exact(where):
    low, high = np.array([431_000.0, 5_411_000.0, 200.0]), np.array([432_000.0, 5_412_000.0, 260.0])
    mesh = Mesh(*box_mesh(low, high))
    origin = np.random.default_rng(9).uniform(low + 1, high - 1, (50_000, 3))
    d = directions(50_000, seed=10)
    hit = mesh.cast(origin, d, **where)
    t = box_exit(origin, d, low, high)
    exit_point = origin + t[:, None] * d
    gap = np.sort(np.minimum(exit_point - low, high - exit_point), axis=1)[:, 1]
    inner = gap > 1e-3  # not within float32's reach of an edge
    np.testing.assert_allclose(hit.t[inner], t[inner], atol=5e-9)
    assert hit.valid.all() and inner.mean() > 0.999
    np.testing.assert_allclose(hit.t, t, atol=2e-2)


def test_a_kilometre_scene_sees_from_floor_to_wall(where):
    mesh, rng = Mesh(*box_mesh([0, 0, 0], [1000.0, 1000, 30])), np.random.default_rng(11)
    floor = np.column_stack([rng.uniform(1, 999, (2000, 2)), np.zeros(2000)])
    wall = np.column_stack([np.full(2000, 1000.0), rng.uniform(1, 999, 2000), rng.uniform(1, 29, 2000)])
    assert mesh.visible(floor, wall, **where).all() and mesh.visible(wall, floor, **where).all()
    assert not mesh.visible(floor, wall + [0.01, 0, 0], **where).any()


@no_embree
@pytest.mark.parametrize("blockers", [2, 60])
def test_sight_is_that_of_both_back_ends_and_of_rays(blockers):
    """Whether most segments are free or most are blocked."""
    rng = np.random.default_rng(14)
    mesh, _ = joined(*(box_mesh(c - 0.2, c + 0.2) for c in rng.uniform(-1.5, 1.5, (blockers, 3))))
    a, b = rng.uniform(-2, 2, (2, 40_000, 3))
    b[:500] = a[:500] + 1e-5  # too short for anything to lie between
    a[500:1500] = mesh.triangles[rng.integers(len(mesh.faces), size=1000)].mean(axis=1)  # starts on surfaces
    seen = mesh.visible(a, b, backend="embree", device="cpu")
    assert seen[:500].all() and (seen.mean() > 0.5) == (blockers == 2)
    expected = mesh.visible(a, b, backend="warp", device="cpu")
    assert (seen != expected).mean() < 1e-4
    length = np.linalg.norm(b - a, axis=1)
    hit = mesh.cast(a[1500:], (b - a)[1500:], backend="warp", device="cpu")
    free = hit.t >= length[1500:] - 1e-4
    assert (expected[1500:] != free).mean() < 1e-3  # but for surfaces at the very ends


@no_embree
@pytest.mark.parametrize("length", [1.0, 1e-12, 1e12, 1e-25, 1e25])
def test_many_rays_meet_what_each_meets_alone(length):
    """Bit by bit, of whatever length, missing, or at a surface; both back ends see the same."""
    count = 47
    whole, rng = bumpy_sphere(5_000), np.random.default_rng(15)
    mesh = Mesh(whole.vertices, whole.faces[::2])
    origin, d = rng.uniform(-2, 2, (count, 3)), length * directions(count, seed=16)
    origin[::3] = mesh.triangles[: (count + 2) // 3].mean(axis=1)
    found = mesh.cast(origin, d, backend="embree", device="cpu")
    alone = [mesh.cast(o, w, backend="embree", device="cpu") for o, w in zip(origin, d, strict=True)]
    np.testing.assert_array_equal(found.face, [hit.face[0] for hit in alone])
    np.testing.assert_array_equal(found.t, [hit.t[0] for hit in alone])
    np.testing.assert_array_equal(found.face, mesh.cast(origin, d, backend="warp", device="cpu").face)
    assert 0.1 < found.valid.mean() < 0.9
    end = origin + d * (3.0 / length)
    seen = mesh.visible(origin, end, backend="embree", device="cpu")
    np.testing.assert_array_equal(seen, mesh.visible(origin, end, backend="warp", device="cpu"))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_point_sees_itself_and_no_points_see_nothing(where, count):
    mesh, point = Mesh(*box_mesh(*ROOM)), np.ones((count, 3))
    for a in (point, np.ones(3)):
        assert mesh.visible(a, point, **where).tolist() == [True] * count
    assert mesh.cast(point, point, **where).t.shape == (count,)


def test_auto_takes_embree_for_many_rays_on_a_cpu_where_it_is_installed(monkeypatch):
    cpu, choose = resolve("cpu"), raysearch.choose_backend
    monkeypatch.setattr(raysearch, "open3d_installed", lambda: True)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    assert choose("auto", cpu, raysearch.EMBREE_RAYS_TO_LOAD) == "embree"
    assert choose("auto", cpu, raysearch.EMBREE_RAYS_TO_LOAD - 1) == "warp"
    monkeypatch.setitem(sys.modules, "open3d", raysearch)
    assert choose("auto", cpu, raysearch.EMBREE_RAYS) == "embree"
    assert choose("auto", cpu, raysearch.EMBREE_RAYS - 1) == "warp"
    monkeypatch.setattr(raysearch, "open3d_installed", lambda: False)
    assert choose("auto", cpu, 10**7) == "warp"


@no_embree
def test_more_threads_than_cores_are_not_asked_of_embree(monkeypatch):
    """It would say so on standard error."""
    monkeypatch.setattr(raysearch, "threads", lambda: 999)
    scene = raysearch.EmbreeScene(np.eye(3), np.array([[0, 1, 2]]), np.array([0]))
    assert scene._threads_for(np.empty((10_000_000, 0))) == os.cpu_count()


def test_the_same_directions_are_cast_from_every_origin(where):
    mesh, d = Mesh(*box_mesh(*ROOM)), directions(1_500)
    origin = np.array([[0.5, 0.25, 1.5], [1.0, 0.5, 0.7], [0.2, 0.3, 0.4]])
    every = np.repeat(origin, len(d), axis=0), np.tile(d, (len(origin), 1))
    for toward in (d, every[1]):
        hit = mesh.cast(origin, toward, per_origin=len(d), **where)
        np.testing.assert_allclose(hit.t, box_exit(*every, *ROOM), rtol=1e-12)
        np.testing.assert_allclose(hit.point, every[0] + hit.t[:, None] * every[1], atol=1e-12)
    with pytest.raises(ValueError, match=r"^directions: got 7 for 4500 origins"):
        mesh.cast(origin, d[:7], per_origin=len(d), **where)


def test_points_stand_whatever_is_cast_later(where):
    mesh, rng = Mesh(*box_mesh(*ROOM)), np.random.default_rng(20)
    origin, toward, hits = rng.uniform(0.5, 1.5, (6, 3_001, 3)), rng.standard_normal((6, 3_001, 3)), []
    for o, d in zip(origin, toward, strict=True):
        given = o.copy(), d.copy()
        hits.append(mesh.cast(*given, **where))
        for array in given:
            array[:] = np.nan
        mesh.cast(d, o, **where)
    for o, d, hit in zip(origin, toward, hits, strict=True):
        unit = d / np.linalg.norm(d, axis=1, keepdims=True)
        wall = o + box_exit(o, unit, *ROOM)[:, None] * unit
        np.testing.assert_allclose(hit.point, wall, rtol=0, atol=1e-11)
        assert ((hit.normal * unit).sum(axis=1) > 0).all()  # those of walls, outward
        np.testing.assert_allclose(np.abs(hit.normal).max(axis=1), 1.0)


def test_segments_too_long_for_float32_are_judged_and_those_too_long_for_float64_refused(where):
    mesh, outward = bumpy_sphere(5_000), directions(35, seed=21)
    start = np.where(np.arange(35)[:, None] % 2, 1.0, 9.0) * outward
    start[::7] = 1e17 * outward[::7]
    for length in (1e16, 1e25, 1e60):
        seen = mesh.visible(start, length * outward, **where)
        expected = np.arange(35) % 2 == 0
        expected[::7] = True
        np.testing.assert_array_equal(seen, expected)
    with pytest.raises(ValueError, match="b: got 105 values that are above"):
        mesh.visible(start, 1e201 * np.sign(outward), **where)


@no_embree
def test_rays_that_leave_their_surface_slowly_meet_the_next_one(monkeypatch):
    """In float32 the floor lies higher than it is, and they meet it over and over, here for thousands of steps."""
    rng, casts, floor = np.random.default_rng(22), [], 0.1
    low, high = np.array([-7.0, -6.0, floor]), np.array([8.0, 6.0, 4.07])
    origin = np.column_stack([rng.uniform(-6, 7, 300), rng.uniform(-5, 5, 300), np.full(300, floor)])
    azimuth, slope = rng.uniform(-np.pi, np.pi, 300), 10.0 ** rng.uniform(-5, -3, 300)
    d = np.column_stack([np.cos(azimuth), np.sin(azimuth), slope])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    cast = raysearch.EmbreeScene.cast
    monkeypatch.setattr(raysearch.EmbreeScene, "cast", lambda self, r: casts.append(len(r)) or cast(self, r))
    hit = Mesh(*box_mesh(low, high)).cast(origin, d, backend="embree", device="cpu")
    t = box_exit(origin, d, low, high)
    foot = t * d[:, 2] < 1e-5  # there float32 may give either face
    assert foot.mean() < 0.1
    assert casts[-1] > 100  # so many glide on after the last round
    np.testing.assert_allclose(hit.t[~foot], t[~foot], rtol=1e-9)


def test_misses_are_inf_and_minus_one():
    plane = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    hit = plane.cast([[0.2, 0.2, 1.0], [5, 5, 1]], [0, 0, -1])
    assert hit.face.tolist() == [0, -1] and hit.t[1] == np.inf and np.isnan(hit.point[1]).all()
    np.testing.assert_array_equal(hit.normal[0], [0, 0, 1])


def test_thin_sheet_just_off_the_end_still_blocks():
    sheet = Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    assert not sheet.visible([0.1, 0.2, 0.0005], [0.1, 0.2, -3.0])[0]
    assert sheet.visible([0.1, 0.2, 0.0], [0.1, 0.2, -3.0])[0]


@pytest.mark.usefixtures("device")
def test_distance_to_a_box_from_outside_and_inside():
    mesh = Mesh(*box_mesh((-1, -1, -1), (1, 1, 1)))
    p = np.random.default_rng(3).uniform(-3, 3, (3000, 3))
    outside = np.linalg.norm(np.maximum(np.abs(p) - 1, 0), axis=1)
    expected = np.where(outside > 0, outside, (1 - np.abs(p)).min(axis=1))
    np.testing.assert_allclose(mesh.distance(p), expected, atol=1e-6)
    found = mesh.closest(p)
    np.testing.assert_allclose(np.linalg.norm(found.point - p, axis=1), found.distance)


def test_winding_number_counts_the_solids_around_a_point():
    mesh, _ = joined(box_mesh((-1, -1, -1), (1, 1, 1)), box_mesh((-2, -2, -2), (3, 2, 2)))
    towards = np.random.default_rng(0).normal(size=(20, 3))
    number, _ = mesh.crossings([[0.1, 0.2, 0.3], [2.5, 0.1, 0.2], [9, 0, 0]], towards)
    np.testing.assert_array_equal(number, np.tile([[2], [1], [0]], 20))


def test_the_cross_section_of_a_box_is_its_outline():
    mesh = Mesh(*box_mesh((0, 0, 0), (4, 3, 2)))
    lines = mesh.cross_section(1.2)
    assert np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() == pytest.approx(2 * (4 + 3))
    assert mesh.cross_section(2.5).shape == (0, 2, 2)


@pytest.mark.parametrize(
    "name", ["vertices", "faces", "triangles", "areas", "face_normals", "bounds", "center"]
)
def test_what_a_mesh_keeps_cannot_be_written_into(name):
    """``low, high = scene.bounds; low += 0.5`` would move the room's walls for all that asks later."""
    kept = getattr(Mesh(*box_mesh([0, 0, 0], [5, 4, 3])), name)
    with pytest.raises(ValueError, match="read-only"):
        kept += kept
