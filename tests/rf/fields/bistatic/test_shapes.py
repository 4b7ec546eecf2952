"""Groups of a mesh without colours or names: what shape alone tells, how scans come in, and what it is worth."""

import numpy as np
import rooms
from furnished import ROOM, spectra
from radio_scenes import RadioScene, SlabMaterial, box_mesh, joined, tube
from trimesh.remesh import subdivide_to_size

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.planar_patches import planar_patches
from warprrf.geometry.scans import is_scan, scanned_patches
from warprrf.rf.fields.base import RadioField
from warprrf.rf.spectra.metrics import evaluate
from warprrf.rf.tracing.groups import shape_groups
from warprrf.rf.tracing.surface import Surface

CUPBOARD = box_mesh([2.2, 1.6, 0.0], [3.0, 2.4, 2.2])
DESK = box_mesh([0.6, 2.6, 0.7], [2.0, 3.3, 0.8])


def groups_of(mesh):
    return shape_groups(mesh, planar_patches(mesh).face_patch)


def as_partition(label):
    return {frozenset(np.flatnonzero(label == k).tolist()) for k in np.unique(label)}


def test_the_middle_of_a_piece_is_the_tile_nearest_to_its_middle():
    """Of a strip of squares that are of two pieces, of three and five squares."""
    x, y = np.meshgrid(np.arange(9.0), [0.0, 1.0], indexing="ij")
    corner = np.arange(18).reshape(9, 2)
    quads = np.column_stack([corner[:-1], corner[1:, ::-1]])
    faces = np.concatenate([quads[:, [0, 3, 1]], quads[:, [1, 3, 2]]])
    mesh = Mesh(np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), faces)
    surface = Surface.of(mesh, element_m=10.0)
    tiles = surface.tiles
    middle = tiles.centre[tiles.middles((tiles.centre[:, 0] > 3).astype(int))]
    np.testing.assert_allclose(middle[:, 0], [1.5, 5.5], atol=0.17)


def test_sides_of_a_room_are_taken_for_materials_of_their_own_and_a_thing_for_one():
    mesh, part = joined(ROOM, CUPBOARD, DESK)
    group, material, look = groups_of(mesh)
    assert len(as_partition(group[part == 0])) == 6  # planes
    assert len(as_partition(material[group][part == 0])) == 6
    for thing in (1, 2):
        assert len(set(material[group][part == thing])) == 1
    assert material.max() + 1 == 8
    assert np.isfinite(look).all()


def test_a_curved_surface_is_one_piece():
    mesh, part = joined(ROOM, tube(24, 0.4, 2.5))
    group = groups_of(mesh)[0]
    assert len(set(group[part == 1])) == 1
    assert len(set(group[part == 0])) == 6


def test_groups_do_not_depend_on_indices_winding_or_direction():
    mesh, _ = joined(ROOM, CUPBOARD, DESK)
    group, material, look = groups_of(mesh)
    turn = np.radians(27.0)
    about = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    soup = Mesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))
    for other in (
        soup,
        Mesh(mesh.vertices, mesh.faces[:, ::-1]),
        Mesh(mesh.vertices @ about.T + [3, -8, 0], mesh.faces),
    ):
        again = groups_of(other)
        assert as_partition(again[0]) == as_partition(group)
        assert as_partition(again[1][again[0]]) == as_partition(material[group])
        np.testing.assert_allclose(again[2][again[0]][:, 2:], look[group][:, 2:], atol=1e-6)


def test_groups_do_not_depend_on_how_faces_are_cut():
    """A room whose seams do not match was taken for as many things as it has pieces: 36 in place of 14."""
    room = rooms.plain()
    whole, cut = (Surface.of(r.mesh) for r in (room, rooms.cut_in_part(room)))
    assert len(set(whole.group)) == len(set(cut.group)) == 14
    assert sorted(whole.material) == sorted(cut.material)


def test_crumbs_join_the_nearest_piece_of_their_part():
    # Stands in the wall x = 0, linked to it by a corner's edge.
    ledge = box_mesh([0, 1.0, 1.0], [0.1, 1.3, 1.1])
    mesh, part = joined(ROOM, ledge)
    group, material, _ = groups_of(mesh)
    assert len(set(group[part == 1])) == 1  # a part of crumbs is one group
    assert material.max() + 1 == 6  # too small for a material of its own


def test_tops_of_one_height_mirror_for_the_thing_they_are_of():
    other = box_mesh([0.4, 0.4, 0.0], [1.2, 1.2, 2.2])  # as high as the cupboard
    mesh, part = joined(ROOM, CUPBOARD, other)
    surface = Surface.of(mesh)
    middle = surface.mesh.triangles.mean(axis=1)
    top = np.abs(middle[:, 2] - 2.2) < 1e-6
    first, second = (np.unique(surface.patch[top & side]) for side in (middle[:, 0] > 2, middle[:, 0] < 2))
    assert len(first) == len(second) == 1 and first != second
    assert surface.patch_group[first] != surface.patch_group[second]


def scan(edge_m=0.07, error_m=0.02):
    """The furnished room as a scanner gives it: small faces, vertices with errors, holes."""
    r = np.random.default_rng(3)
    vertices, faces = subdivide_to_size(*ROOM, edge_m)
    vertices, place = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    faces = place.reshape(-1)[faces]
    centre = vertices[faces].mean(axis=1)
    for k in r.integers(0, len(centre), 12):
        faces, centre = (a[np.linalg.norm(centre - centre[k], axis=1) > 0.15] for a in (faces, centre))
    return Mesh(vertices + error_m / np.sqrt(3) * r.normal(size=vertices.shape), faces)


def test_planes_are_found_in_a_scan_with_errors_of_2_cm_and_holes():
    mesh = scan()
    assert is_scan(mesh)
    patches = scanned_patches(mesh)
    assert len(patches) == 6
    assert (patches.face_patch >= 0) @ patches.mesh.areas > 0.93 * patches.mesh.areas.sum()
    sides = [(axis, side) for axis in range(3) for side in (0.0, (5.0, 4.0, 3.0)[axis])]
    for axis, side in sides:
        fits = np.abs(patches.normal[:, axis]) > np.cos(np.radians(0.3))
        fits &= np.abs(patches.offset * np.sign(patches.normal[:, axis]) - side) < 5e-3
        assert fits.sum() == 1
    assert len(set(shape_groups(patches.mesh, patches.face_patch)[0])) == 6
    assert len(patches.mesh.faces) < 0.2 * len(mesh.faces)
    surface = Surface.of(mesh)
    assert surface.groups == 6
    assert (surface.patch >= 0) @ surface.mesh.areas > 0.93 * surface.mesh.areas.sum()


def test_a_bare_mesh_is_nearly_as_good_as_one_with_names():
    mesh, part = joined(ROOM, CUPBOARD, DESK)
    floor = (mesh.triangles[:, :, 2] < 1e-6).all(axis=1) & (part == 0)
    materials = [
        SlabMaterial("plaster", 3.0, 0.5, np.inf, 0.5, "directive", 4),
        SlabMaterial("wood", 6.0, 0.5, np.inf, 0.9),
        SlabMaterial("metal", 1.0, 1e5, np.inf, 0.2, "directive", 10),
    ]
    face_material = np.where(part == 1, 2, np.where(floor | (part == 2), 1, 0))
    scene = RadioScene(mesh, face_material, materials)
    r = np.random.default_rng(5)
    places = np.column_stack([r.uniform(0.4, 4.6, 14), r.uniform(0.4, 1.4, 14), r.uniform(0.9, 2.0, 14)])
    ds = spectra(scene, places, transmitter=np.array([4.3, 3.4, 2.3]), sub_pixels=3)
    train, test = ds.subset(range(4)), ds.subset(range(4, 14))
    one = RadioScene(mesh, np.zeros(len(part), int), materials[:1])

    def psnr_db(geometry):
        field = RadioField.fit(geometry, train, sub_pixels=2)
        return evaluate(test, field.spectrum)["psnr_db"]

    named, bare, alone = (psnr_db(geometry) for geometry in (scene, mesh, one))
    assert bare > alone + 3.0
    assert bare > named - 1.0
