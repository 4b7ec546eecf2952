"""Planar patches are the same whatever exporters and scanners do to a mesh; curved surfaces are not flat."""

from dataclasses import replace

import numpy as np
import pytest
import rooms
from radio_scenes import box_mesh, joined, tube
from trimesh.creation import icosphere
from trimesh.remesh import subdivide

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.planar_patches import PlanarPatches, planar_patches

BOXES = (((0, 0, 0), (10, 8, 3)), ((2, 2, 0.01), (4, 3, 1)), ((6, 5, 0.01), (7, 7, 1.2)))


def room(times=0):
    """A room with two boxes in it: eighteen rectangles."""
    mesh, _ = joined(*(box_mesh(low, high) for low, high in BOXES))
    return finer(mesh.vertices, mesh.faces, times)


def finer(vertices, faces, times):
    for _ in range(times):
        vertices, faces = subdivide(vertices, faces)
    return vertices, faces


def true_areas():
    sizes = [np.subtract(high, low) for low, high in BOXES]
    return np.sort([a for x, y, z in sizes for a in (x * y, x * y, y * z, y * z, x * z, x * z)])[::-1]


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-4])
def test_small_errors_of_vertices_leave_the_patches_and_their_planes(noise):
    v, f = room(3)
    true = planar_patches(Mesh(v, f))
    v = v + noise * np.random.default_rng(1).normal(size=v.shape)
    patches = planar_patches(Mesh(v, f))
    assert len(patches) == 18
    np.testing.assert_allclose(patches.area, true_areas(), rtol=1e-4 + 20 * noise)
    # Fitted planes err less than the vertices do.
    for p in range(18):
        corners = true.boxes[true.face_patch[patches.faces(p)[0]]]
        assert np.abs(corners @ patches.normal[p] - patches.offset[p]).max() < 2.0 * noise + 1e-12


@pytest.mark.parametrize("noise", [5e-3, 2e-2])
def test_a_scan_with_errors_as_large_as_its_faces_are_high_keeps_its_walls(noise):
    """Six walls of a room in faces of 9 to 20 cm; a tenth of the faces is missing."""
    low, high = np.zeros(3), np.array([6.0, 5.0, 3.0])
    v, f = finer(*box_mesh(low, high), 5)
    rng = np.random.default_rng(6)
    mesh = Mesh(v + noise * rng.normal(size=v.shape), f[rng.random(len(f)) > 0.1])
    patches = planar_patches(mesh)
    assert patches.area[:6].sum() > 0.95 * mesh.areas.sum()
    axis = np.abs(patches.normal[:6]).argmax(axis=1)
    assert sorted(axis) == [0, 0, 1, 1, 2, 2]
    assert np.abs(patches.normal[np.arange(6), axis]).min() > np.cos(np.radians(0.2))
    for p in range(6):
        corners = mesh.triangles[patches.faces(p)].reshape(-1, 3)
        here = corners.mean(axis=0)
        here[axis[p]] = (low if here[axis[p]] < 1.0 else high)[axis[p]]
        assert abs(here @ patches.normal[p] - patches.offset[p]) < 0.2 * noise


def test_hills_are_no_noise():
    x, y = np.meshgrid(np.arange(12.0), np.arange(12.0), indexing="ij")
    z = 0.3 * np.random.default_rng(7).normal(size=x.shape)
    k = np.arange(144).reshape(12, 12)
    a, b, c, d = (q.ravel() for q in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    f = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    patches = planar_patches(Mesh(np.column_stack([q.ravel() for q in (x, y, z)]), f))
    assert len(patches) == len(f) and patches.tolerance_m < 1e-4


WRITTEN = [
    *rooms.EXACT, "turned four times in float32", "in two sheets 1e-5 m apart", "noise of 1e-4 m, subdivided, subdivided",
    "noise of 1e-5 m, covered by finer faces", "covered by finer faces, noise of 1e-5 m",
]  # fmt: skip


@pytest.mark.parametrize("laws", WRITTEN)
def test_a_room_has_the_same_patches_however_it_is_written(laws):
    """Surfaces within the tolerance of each other are one. Faces without area are of no patch."""
    v, f = room()
    written = replace(rooms.plain(), vertices=v, faces=f, part=0 * f[:, 0])
    for law in [laws] if laws in rooms.LAWS else laws.split(", "):
        written = rooms.LAWS[law](written)
    patches = planar_patches(written.mesh)
    assert len(patches) == 18
    np.testing.assert_array_equal(patches.face_patch >= 0, patches.mesh.areas > 1e-9)


def test_materials_are_kept_apart():
    v, f = box_mesh((0, 0, 0), (4, 3, 2))
    patches = planar_patches(Mesh(v, f), np.arange(12) % 2)
    for p in range(len(patches)):
        assert len(np.unique(patches.faces(p) % 2)) == 1 and patches.group[p] == patches.faces(p)[0] % 2
    with pytest.raises(ValueError, match="groups"):
        planar_patches(Mesh(v, f), [0, 1])


@pytest.mark.parametrize("noise", [0.0, 1e-7])
@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((icosphere(3).vertices, icosphere(3).faces), 1280),
        (tube(64, 0.3, 2.0), 64),
        (tube(256, 1.0, 2.0), 256),
    ],
    ids=["sphere", "pipe", "fine"],
)
def test_facets_of_curved_surfaces_are_not_merged(shape, expected, noise):
    v, f = shape
    patches = planar_patches(Mesh(v + noise * np.random.default_rng(4).normal(size=v.shape), f))
    assert len(patches) >= expected
    assert patches.area.max() < 1.01 * patches.mesh.areas.sum() / expected * 2.5


def test_a_long_gentle_bend_is_not_one_plane():
    """Neighbours differ by less than the limit, the ends by far more: pieces are judged by their own plane."""
    x = np.linspace(0.0, 2.0, 2001)
    z = 0.5 * x**2  # 1e-3 rad a strip
    v = np.concatenate([np.column_stack([x, np.full_like(x, y), z]) for y in (0.0, 1.0)])
    k = np.arange(2000)
    f = np.concatenate([np.column_stack([k, k + 1, k + 2002]), np.column_stack([k, k + 2002, k + 2001])])
    patches = planar_patches(Mesh(v, f))
    normal, offset = patches.normal[patches.face_patch], patches.offset[patches.face_patch]
    gap = np.einsum("fki,fi->fk", patches.mesh.triangles, normal) - offset[:, None]
    assert np.abs(gap).max() < 2 * patches.tolerance_m < 4e-5
    assert len(patches) > 50


def test_contains_covers_a_patch_without_seams_and_nothing_else():
    v, f = room(2)
    patches = planar_patches(Mesh(v, f))
    rng = np.random.default_rng(5)
    for p in range(len(patches)):
        low, high = patches.boxes[p]
        point = rng.uniform(low - 0.3, high + 0.3, size=(500, 3))
        point -= (point @ patches.normal[p] - patches.offset[p])[:, None] * patches.normal[p]
        inside = ((point >= low - 1e-7) & (point <= high + 1e-7)).all(axis=1)
        np.testing.assert_array_equal(patches.contains(np.full(500, p), point), inside)
        corners = patches.mesh.triangles[patches.faces(p)].reshape(-1, 3)
        assert patches.contains(np.full(len(corners), p), corners).all()


def test_given_planes_keep_their_side():
    v, f = box_mesh((0, 0, 0), (1, 1, 1))
    found = planar_patches(Mesh(v, f))

    def of_planes(count):
        planes = found.normal[:count], found.offset[:count]
        return PlanarPatches.from_planes(found.mesh, found.face_patch, *planes, tolerance_m=0.02)

    given = of_planes(6)
    assert not given.two_sided and given.tolerance_m == 0.02
    np.testing.assert_allclose(given.area, 1.0)
    with pytest.raises(ValueError, match="face_patch"):
        of_planes(3)
