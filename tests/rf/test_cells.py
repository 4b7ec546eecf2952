"""Cells of a surface: of its places, not of its faces."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from furnished import furnished
from trimesh.remesh import subdivide
from twin_fields import known_field

import warprrf as wr
from warprrf import tensor_files
from warprrf.geometry.mesh import Mesh
from warprrf.rf.tracing.cells import ARRAYS, Cells
from warprrf.rf.tracing.surface import Surface

UP = np.array([[0.0, 0.0, 1.0]])


def cells_of(mesh, width_m, patch=0):
    """Those of ``mesh``, all of one group and one horizontal patch, or of none."""
    one = np.zeros(len(mesh.faces), np.int32)
    return Cells.of(mesh, one, one + patch, UP, 3 * width_m)


def places_on(mesh, count, seed=0):
    """Faces (N,), chosen by area, and points (N, 3) on them."""
    rng = np.random.default_rng(seed)
    face = rng.choice(len(mesh.faces), count, p=mesh.areas / mesh.areas.sum())
    return face, np.einsum("nc,nci->ni", rng.dirichlet(np.ones(3), count), mesh.triangles[face])


@pytest.fixture(scope="module")
def turned():
    """A furnished room that stands askew, so that no wall is along an axis."""
    mesh = furnished().mesh
    turn = trimesh.transformations.euler_matrix(0.3, 0.2, 0.7)[:3, :3]
    return Surface.of(Mesh(mesh.vertices @ turn.T, mesh.faces))


def test_tiles_are_all_of_the_surface_and_no_larger_than_a_square(turned):
    tiles, mesh = turned.tiles, turned.mesh
    np.testing.assert_allclose(np.bincount(tiles.face, tiles.area), mesh.areas, rtol=1e-9)
    moment = np.stack([np.bincount(tiles.face, tiles.area * x) for x in tiles.centre.T], axis=1)
    np.testing.assert_allclose(moment / mesh.areas[:, None], mesh.triangles.mean(axis=1), atol=1e-9)
    extent, axis = np.ptp(tiles.corners, axis=1), turned.cells.axis[tiles.face]
    extent[np.arange(len(axis)), axis] = 0.0  # along which it is looked at
    assert (extent <= turned.cells.width_m[tiles.face, None] * (1 + 1e-9)).all()


def test_a_place_is_of_the_tile_that_holds_it(turned):
    face, point = places_on(turned.mesh, 4000)
    near = turned.tiles.fan.closest(point).face // 5
    same = turned.tiles.face[near] == face  # but where two faces meet
    assert same.mean() > 0.99
    np.testing.assert_array_equal(turned.cells.at(face, point)[same], turned.tiles.cell[near[same]])


def test_cells_do_not_depend_on_how_a_floor_is_cut():
    """Into two triangles or into many, other ones: which places share a cell is the same."""
    floor = Mesh(
        np.array([[0.0, 0, 0], [3.1, 0, 0], [3.1, 2.3, 0], [0, 2.3, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    other = Mesh(*subdivide(*subdivide(floor.vertices, np.array([[0, 1, 3], [1, 2, 3]]))))
    face, point = places_on(floor, 10_000)
    one, two = cells_of(floor, 0.125), cells_of(other, 0.125)
    a, b = one.at(face, point), two.at(other.closest(point).face, point)
    pairs = np.unique(np.column_stack([a, b]), axis=0)
    assert len(one) == len(two) == len(pairs) == len(np.unique(a)) == 25 * 19
    square = np.floor(point[:, :2] / 0.125).astype(int)
    assert len(np.unique(np.column_stack([square, a[:, None]]), axis=0)) == len(one)
    assert len(np.unique(one.element)) == 9 * 7


def test_a_long_thin_strip_askew_has_cells_along_it_alone():
    along, across = np.array([100.0, 80.0, 0.0]), np.array([-0.004, 0.005, 0.0])
    strip = Mesh(np.array([0 * along, along, along + across, across]), np.array([[0, 1, 2], [0, 2, 3]]))
    cells = cells_of(strip, 0.1)
    assert 1800 < len(cells) < 2100
    assert len(cells.cell) < 4200
    face, point = places_on(strip, 500)
    assert len(np.unique(cells.at(face, point))) > 300


def test_places_beside_a_face_are_of_its_nearest_square():
    """Rounding moves what a ray hits off the face by a little."""
    floor = Mesh(np.array([[0.0, 0, 0], [3, 0, 0], [3, 3, 0]]), np.array([[0, 1, 2]]))
    cells = cells_of(floor, 0.15)
    off = np.array([[3.0 + 1e-7, 1.0, 1e-7], [1.2, -1e-7, 0.0], [3.1, 3.1, 0.0]])
    inside = np.array([[2.9, 1.0, 0.0], [1.2, 0.1, 0.0], [2.99, 2.9, 0.0]])
    none = np.zeros(3, int)
    np.testing.assert_array_equal(cells.at(none, off), cells.at(none, inside))


def test_faces_of_no_patch_lie_in_layers():
    """Both sides of a shelf, and what stands on another, are told apart by height."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    mesh = Mesh(
        np.concatenate([square, square + [0, 0, 0.05], square + [0, 0, 2]]), np.arange(9).reshape(3, 3)
    )
    middle = mesh.triangles.mean(axis=1)
    low, beside, high = cells_of(mesh, 0.16, patch=-1).at(np.arange(3), middle)
    assert low == beside != high
    assert len(set(cells_of(mesh, 0.16).at(np.arange(3), middle).tolist())) == 1


def test_some_faces_and_the_rest_are_all(turned):
    cells, count = turned.cells, len(turned.mesh.faces)
    order = np.random.default_rng(1).permutation(count)
    parts = [cells.take(order[: count // 3]), cells.take(order[count // 3 :])]
    both, known = parts[0][0].beside(parts[1][0]), np.concatenate([old for _, old in parts])
    face, point = places_on(turned.mesh, 2000)
    new = both.at(np.argsort(order)[face], point)
    np.testing.assert_array_equal(known[new], cells.at(face, point))
    assert both.element.max() + 1 == sum(part.element.max() + 1 for part, _ in parts)


def test_arrays_that_do_not_fit_are_refused(turned):
    c = turned.cells
    wrong = {
        "axis": c.axis + 3, "width_m": -c.width_m, "rows": c.rows + 1, "squares": c.squares[1:], "cell": c.cell - 1,
        "element": c.element + len(c), "first_row_m": np.full_like(c.first_row_m, np.nan), "first_square_m": c.squares,
    }  # fmt: skip
    assert wrong.keys() == ARRAYS.keys()
    for name, value in wrong.items():
        with pytest.raises(
            (TypeError, ValueError), match=name if name != "squares" else "squares|first_square_m"
        ):
            replace(c, **{name: value})
    with pytest.raises(ValueError, match="cells: got those of"):
        replace(turned, cells=c.take(np.arange(3))[0])


def test_a_field_of_a_file_that_names_a_cell_of_each_face_opens(tmp_path):
    """As fields were written whose faces were split."""
    field, path = known_field(), tmp_path / "field.safetensors"
    faces = len(field.surface.mesh.faces)
    rng = np.random.default_rng(2)
    cell = rng.permutation(faces).astype(np.int32)
    cells = Cells.of_faces(cell, rng.integers(0, 3, faces).astype(np.int32))
    residual = rng.normal(size=(2, faces))
    field = replace(field, surface=replace(field.surface, cells=cells), residual=residual)
    field = replace(field, effects=replace(field.effects, residual=True))
    field.save(path)
    tensors, about = tensor_files.read(path)
    tensors = {n: t for n, t in tensors.items() if not n.startswith("cells/")}
    tensor_files.write(path, tensors | {"surface/cell": cell, "surface/element": cells.element[cell]}, about)
    old, receiver = wr.RadioField.load(path), np.array([2.0, 1.5, 1.2])
    np.testing.assert_array_equal(old.spectrum(receiver).path_gain, field.spectrum(receiver).path_gain)
    old.save(path)
    assert wr.RadioField.load(path).surface.cells.element.tolist() == cells.element.tolist()
