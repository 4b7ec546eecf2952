"""Ray and distance queries against geometry that is known in closed form."""

import numpy as np
import pytest

from warprrf.geometry.mesh import Mesh


def box(low, high):
    """A closed box, normals outward."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return low + corners * (high - low), np.array(faces)


def room():
    return Mesh(*box((-7, -6, 0), (8, 6, 4)))


def directions(n, seed=0):
    d = np.random.default_rng(seed).standard_normal((n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def box_exit(origin, d, low, high):
    with np.errstate(divide="ignore"):
        return np.where(d > 0, (high - origin) / d, (low - origin) / d).min(axis=1)


@pytest.mark.usefixtures("device")
def test_hits_are_exact_in_float64():
    origin, d = np.array([1.23456789, -2.3456789, 1.1111]), directions(20_000)
    hit = room().cast(origin, d)
    t = box_exit(origin, d, np.array([-7.0, -6, 0]), np.array([8.0, 6, 4]))
    np.testing.assert_allclose(hit.t, t, rtol=1e-12)
    np.testing.assert_allclose(hit.point, origin + t[:, None] * d, atol=1e-11)


def test_direction_length_does_not_matter():
    d = directions(100)
    np.testing.assert_allclose(room().cast([0, 0, 2], 7.0 * d).t, room().cast([0, 0, 2], d).t, rtol=1e-12)


def test_no_ray_leaves_a_closed_mesh():
    mesh = room()
    assert mesh.is_closed
    origin = np.array([0.3, 0.1, 1.7])
    corners = mesh.vertices - origin
    edges = mesh.vertices[mesh.faces[:, :2]].mean(axis=1) - origin
    hit = mesh.cast(origin, np.concatenate([corners, edges, directions(200_000)]))
    assert hit.valid.all()


def test_misses_are_inf_and_minus_one():
    plane = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    hit = plane.cast([[0.2, 0.2, 1.0], [5, 5, 1]], [0, 0, -1])
    assert hit.face.tolist() == [0, -1] and hit.t[1] == np.inf and np.isnan(hit.point[1]).all()
    np.testing.assert_array_equal(hit.normal[0], [0, 0, 1])


def test_points_on_surfaces_see_each_other():
    mesh, rng = room(), np.random.default_rng(1)
    floor = np.column_stack([rng.uniform(-7, 8, 2000), rng.uniform(-6, 6, 2000), np.zeros(2000)])
    wall = np.column_stack([np.full(2000, 8.0), rng.uniform(-6, 6, 2000), rng.uniform(0, 4, 2000)])
    assert mesh.visible(floor, wall).all()
    assert mesh.visible(wall, floor).all()


@pytest.mark.usefixtures("device")
def test_a_screen_blocks_exactly_its_shadow():
    screen = Mesh([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], [[0, 1, 2], [0, 2, 3]])
    rng = np.random.default_rng(2)
    b = np.column_stack([np.full(5000, 2.0), rng.uniform(-4, 4, 5000), rng.uniform(-4, 4, 5000)])
    a = np.array([-2.0, 0.0, 0.0])
    crossing = 0.5 * b[:, 1:]
    shadow = (np.abs(crossing) < 1).all(axis=1)
    clear = (np.abs(np.abs(crossing) - 1) > 1e-6).all(axis=1)
    np.testing.assert_array_equal(screen.visible(a, b)[clear], ~shadow[clear])
    np.testing.assert_array_equal(screen.visible(b, a), screen.visible(a, b))


def test_thin_sheet_just_off_the_end_still_blocks():
    sheet = Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    assert not sheet.visible([0.1, 0.2, 0.0005], [0.1, 0.2, -3.0])[0]
    assert sheet.visible([0.1, 0.2, 0.0], [0.1, 0.2, -3.0])[0]


@pytest.mark.usefixtures("device")
def test_distance_to_a_box_from_outside_and_inside():
    mesh = Mesh(*box((-1, -1, -1), (1, 1, 1)))
    p = np.random.default_rng(3).uniform(-3, 3, (3000, 3))
    outside = np.linalg.norm(np.maximum(np.abs(p) - 1, 0), axis=1)
    expected = np.where(outside > 0, outside, (1 - np.abs(p)).min(axis=1))
    np.testing.assert_allclose(mesh.distance(p), expected, atol=1e-6)
    found = mesh.closest(p)
    np.testing.assert_allclose(np.linalg.norm(found.point - p, axis=1), found.distance)


def test_normals_areas_and_bounds():
    mesh = Mesh(*box((0, 0, 0), (2, 3, 4)))
    assert mesh.areas.sum() == pytest.approx(2 * (6 + 8 + 12))
    outward = ((mesh.triangles.mean(axis=1) - mesh.center) * mesh.face_normals).sum(axis=1)
    assert (outward > 0).all()
    np.testing.assert_array_equal(mesh.bounds, [[0, 0, 0], [2, 3, 4]])


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "words"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], ValueError, "vertices"),
        (np.zeros((3, 3)), [[0, 1, 3]], ValueError, "faces.*0 to 2"),
        (np.zeros((3, 3)), np.zeros((0, 3)), ValueError, "faces"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], ValueError, "NaN"),
        (np.eye(3), [[0, 1, 1.5]], TypeError, "whole"),
    ],
)
def test_bad_meshes_are_refused(vertices, faces, error, words):
    with pytest.raises(error, match=words):
        Mesh(vertices, faces)


def test_bad_rays_are_refused():
    with pytest.raises(ValueError, match="directions.*zero"):
        room().cast([0, 0, 1], [0, 0, 0])
    with pytest.raises(ValueError, match="origins.*NaN"):
        room().cast([0, 0, np.nan], [0, 0, 1])


def test_winding_number_counts_the_solids_around_a_point():
    inner_vertices, inner_faces = box((-1, -1, -1), (1, 1, 1))
    outer_vertices, outer_faces = box((-2, -2, -2), (3, 2, 2))
    mesh = Mesh(
        np.concatenate([inner_vertices, outer_vertices]), np.concatenate([inner_faces, outer_faces + 8])
    )
    towards = np.random.default_rng(0).normal(size=(20, 3))
    number, _ = mesh.look_around([[0.1, 0.2, 0.3], [2.5, 0.1, 0.2], [9, 0, 0]], towards)
    np.testing.assert_array_equal(number, np.tile([[2], [1], [0]], 20))


def test_the_cross_section_of_a_box_is_its_outline():
    mesh = Mesh(*box((0, 0, 0), (4, 3, 2)))
    lines = mesh.cross_section(1.2)
    assert np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() == pytest.approx(2 * (4 + 3))
    assert mesh.cross_section(2.5).shape == (0, 2, 2)
