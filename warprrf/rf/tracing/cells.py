"""Cells and elements of a surface: squares of a lattice on its planes, however large its faces are.

A face is looked at along the axis nearest to the normal of its plane. What lies in one square of the lattice, of one group and
patch, is a cell; squares of a few cells a side are elements. A face knows the squares that it touches, row by row, so the cell of a
point on it is looked up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from warprrf.cache import cached_property
from warprrf.checks import LARGEST_M, Expected, check_arrays, index_to, lengths
from warprrf.geometry.mesh import Mesh
from warprrf.rows import distinct_rows, spans, sums_of

ELEMENT_M = 0.5  # width of an element in a room; larger scenes have wider ones
_ACROSS = np.array([[1, 2], [0, 2], [0, 1]])  # the two other axes
_TOUCHING = 1e-9  # of a square's width: so near its border is not beyond it
ARRAYS = {
    "axis": Expected("F", 0, 2, kind="iu"),
    "width_m": Expected("F", 0.0, 2.0 * LARGEST_M),
    "first_row_m": lengths("F"),
    "rows": Expected("F", 1, kind="iu"),
    "first_square_m": lengths("R"),
    "squares": Expected("R", 1, kind="iu"),
    "cell": index_to("X", "T"),
    "element": index_to("X", "X"),
}
"""What the arrays of :class:`Cells` must be: F faces, R rows and T squares of all of them, X cells."""


@dataclass(frozen=True)
class Tiles:
    """What lies of each face of a surface in each square that it touches: convex polygons.

    Attributes:
        corners: [m], the last one repeated where there are fewer, shape ``(T, 7, 3)``.
        face: face that each is of, shape ``(T,)``.
        cell: cell that each is of, shape ``(T,)``.
    """

    corners: np.ndarray
    face: np.ndarray
    cell: np.ndarray

    @cached_property
    def fan(self) -> Mesh:
        """Triangles that each is made of, five for each; some have no area."""
        first = 7 * np.arange(len(self.face))[:, None, None]
        faces = first + [[0, k, k + 1] for k in range(1, 6)]
        return Mesh(self.corners.reshape(-1, 3), faces.reshape(-1, 3))

    @cached_property
    def area(self) -> np.ndarray:
        """Area of each [m^2], shape ``(T,)``."""
        return self.fan.areas.reshape(-1, 5).sum(axis=1)

    @cached_property
    def centre(self) -> np.ndarray:
        """Centroid of each [m], shape ``(T, 3)``."""
        share = np.maximum(self.fan.areas.reshape(-1, 5), 1e-30)
        share /= share.sum(axis=1, keepdims=True)
        return np.einsum("tk,tki->ti", share, self.fan.triangles.mean(axis=1).reshape(-1, 5, 3))

    @cached_property
    def off_centre(self) -> np.ndarray:
        """A place in each [m], on no wall that stands at a simple fraction of a square, shape ``(T, 3)``."""
        return 0.875 * self.centre + 0.0739 * self.corners[:, 0] + 0.0511 * self.corners[:, 1]

    def middles(self, piece: np.ndarray, preferred: np.ndarray | None = None) -> np.ndarray:
        """Of each piece of the surface, ``piece`` (T,) of each tile, the tile nearest to its middle; one of those ``preferred``
        (T,), if it has any."""
        whole = np.maximum(np.bincount(piece, self.area), 1e-12)
        middle = sums_of(self.area[:, None] * self.centre, piece) / whole[:, None]
        gap = np.linalg.norm(self.centre - middle[piece], axis=1)
        order = np.lexsort((gap, np.zeros(len(gap), bool) if preferred is None else ~preferred, piece))
        return order[np.searchsorted(piece[order], np.arange(len(whole)))]


@dataclass(frozen=True, eq=False)
class Cells:
    """Which cell each point of a surface's faces belongs to, and which element.

    Attributes:
        axis: that each face is looked along, shape ``(F,)``.
        width_m: of a square, shape ``(F,)``.
        first_row_m: where the first row of squares begins that it touches, along the first of the two other axes [m], ``(F,)``.
        rows: number of such rows, shape ``(F,)``.
        first_square_m: where the first of a row's squares begins, along the second axis [m], shape ``(R,)``.
        squares: number of each row's squares, shape ``(R,)``.
        cell: of each square, shape ``(T,)`` int32.
        element: of each cell, shape ``(X,)`` int32.
    """

    axis: np.ndarray
    width_m: np.ndarray
    first_row_m: np.ndarray
    rows: np.ndarray
    first_square_m: np.ndarray
    squares: np.ndarray
    cell: np.ndarray
    element: np.ndarray

    def __post_init__(self) -> None:
        sizes = check_arrays(vars(self), ARRAYS)
        for name, of in (("rows", "R"), ("squares", "T")):
            count = int(getattr(self, name).sum(dtype=np.int64))
            if count != sizes[of]:
                raise ValueError(f"{name}: got {count} in all, expected {sizes[of]}, as other arrays tell")

    def __len__(self) -> int:
        return len(self.element)

    @classmethod
    def of_faces(cls, cell: np.ndarray, element: np.ndarray) -> Cells:
        """Whole faces of the cells ``cell`` (F,) of the elements ``element`` (X,)."""
        low, one = np.full(len(cell), -LARGEST_M), np.ones(len(cell), np.int32)
        return cls(
            np.zeros(len(cell), np.int8), -2.0 * low, low, one, low, one, cell.astype(np.int32), element.astype(np.int32)
        )  # fmt: skip

    @classmethod
    def of(
        cls, mesh: Mesh, group: np.ndarray, patch: np.ndarray, normal: np.ndarray, element_m: float
    ) -> Cells:
        """Those of faces of groups and patches, ``(F,)`` each, the patches' normals being ``normal`` (P, 3): elements are
        ``element_m`` wide."""
        # Cells of an element's side: three double the memory of a fit to a town.
        along = 3 if element_m <= ELEMENT_M else 2
        width_m = element_m / along
        own, toward, low = patch >= 0, mesh.face_normals.copy(), mesh.bounds[0]
        toward[own] = normal[patch[own]]
        axis = np.abs(toward).argmax(axis=1).astype(np.int8)
        points = _flattened(mesh, axis)
        u, v = _ACROSS[axis].T
        face, row, rows = _squares(points[:, :, 0] - low[u, None], width_m)
        strips = _between(points[face], 0, low[u[face]] + width_m * row, width_m)
        strip, square, squares = _squares(strips[:, :, 1] - low[v[face], None], width_m)
        of, every = face[strip], np.arange(len(strip))
        # A patch has one layer of squares; a face of none is of that where its middle is.
        places = np.floor((mesh.triangles.mean(axis=1) - low) / width_m).astype(np.int64)[of]
        places[own[of]] = 0
        places[every, u[of]], places[every, v[of]] = row[strip], square
        element = distinct_rows(np.column_stack([group[of], patch[of], places // along]))[1]
        first, cell, _ = distinct_rows(np.column_stack([element, places]))
        each, begin = np.cumsum(rows) - rows, np.cumsum(squares) - squares
        return cls(
            axis, np.full(len(axis), width_m), low[u] + width_m * row[each], rows, low[v[face]] + width_m * square[begin],
            squares, cell.astype(np.int32), element[first].astype(np.int32),
        )  # fmt: skip

    def at(self, face: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Cell of each ``point`` (N, 3) on ``face`` (N,), shape ``(N,)``."""
        return self.cell[self.square_at(face, point)]

    def square_at(self, face: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Square, and so tile, of each ``point`` (N, 3) on ``face`` (N,), shape ``(N,)``."""
        u, v = np.take_along_axis(point, _ACROSS[self.axis[face]], axis=1).T
        width_m = self.width_m[face]
        row = np.clip((u - self.first_row_m[face]) / width_m, 0, self.rows[face] - 1).astype(np.int64)
        row += self._row[face]
        square = np.clip((v - self.first_square_m[row]) / width_m, 0, self.squares[row] - 1).astype(np.int64)
        return np.asarray(self._square[row] + square)

    def tiles(self, mesh: Mesh) -> Tiles:
        """What lies of the faces of ``mesh``, whose cells they are, in each square."""
        (face, row), (strip, square) = (spans(0 * count, count) for count in (self.rows, self.squares))
        wide_m = self.width_m[face]
        strips = _flattened(mesh, self.axis)[face]
        strips = _between(strips, 0, self.first_row_m[face] + wide_m * row, wide_m)[strip]
        wide_m = wide_m[strip]
        found = _between(strips, 1, self.first_square_m[strip] + wide_m * square, wide_m)
        return Tiles(found[:, :, 2:], face[strip], self.cell)

    def take(self, face: np.ndarray) -> tuple[Cells, np.ndarray]:
        """Those of some faces (N,), numbered anew, and which ones they are."""
        row = spans(self._row[face], self.rows[face])[1]
        square = spans(self._square[row], self.squares[row])[1]
        used, cell = np.unique(self.cell[square], return_inverse=True)
        element = np.unique(self.element[used], return_inverse=True)[1].astype(np.int32)
        faces = {name: getattr(self, name)[face] for name in ("axis", "width_m", "first_row_m", "rows")}
        rows = {name: getattr(self, name)[row] for name in ("first_square_m", "squares")}
        return Cells(**faces, **rows, cell=cell.astype(np.int32), element=element), used

    def beside(self, other: Cells) -> Cells:
        """Those of ``other``'s faces behind its own."""
        more = {"cell": len(self), "element": int(self.element.max(initial=-1)) + 1}
        every = {n: np.concatenate([getattr(self, n), getattr(other, n) + more.get(n, 0)]) for n in ARRAYS}
        return Cells(**every)

    @cached_property
    def _row(self) -> np.ndarray:
        return np.cumsum(self.rows, dtype=np.int64) - self.rows

    @cached_property
    def _square(self) -> np.ndarray:
        return np.cumsum(self.squares, dtype=np.int64) - self.squares


def _flattened(mesh: Mesh, axis: np.ndarray) -> np.ndarray:
    """Corners of faces (F, 3, 5): first what they are along the axes across that of each face, then all three."""
    across = np.take_along_axis(mesh.triangles, _ACROSS[axis][:, None], axis=2)
    return np.concatenate([across, mesh.triangles], axis=2)


def _squares(x: np.ndarray, width_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which stretches of ``width_m`` the corners ``x`` (N, V) of polygons span: the polygon that each is of, its number, and how
    many each polygon spans."""
    low = np.floor(x.min(axis=1) / width_m + _TOUCHING).astype(np.int64)
    high = np.ceil(x.max(axis=1) / width_m - _TOUCHING).astype(np.int64)
    count = np.maximum(high - low, 1).astype(np.int32)
    return *spans(low, count), count


def _between(points: np.ndarray, k: int, low: np.ndarray, width: ArrayLike) -> np.ndarray:
    """Convex polygons (N, V, D) cut to where their column ``k`` is from ``low`` (N,) to ``width`` more, (N, V + 2, D)."""
    return _below(_below(points, k, low + width, 1.0), k, low, -1.0)


def _below(points: np.ndarray, k: int, limit: np.ndarray, sign: float) -> np.ndarray:
    """Convex polygons (N, V, D) cut to where ``sign`` times column ``k`` is at most that of ``limit`` (N,), (N, V + 1, D): the last
    corner is repeated."""
    count, corners = points.shape[:2]
    over = sign * (points[:, :, k] - limit[:, None])
    inside, after = over <= 0, np.roll(over, -1, axis=1)
    crosses = inside != (after <= 0)
    share = np.divide(over, over - after, out=np.zeros_like(over), where=crosses)
    on = points + share[..., None] * (np.roll(points, -1, axis=1) - points)
    both = np.stack([points, on], axis=2).reshape(count, 2 * corners, -1)
    known = np.stack([inside, crosses], axis=2).reshape(count, -1)
    order = np.argsort(~known, axis=1, kind="stable")[:, : corners + 1]
    last = np.maximum(known.sum(axis=1) - 1, 0)
    order = np.take_along_axis(order, np.minimum(np.arange(corners + 1), last[:, None]), axis=1)
    return np.take_along_axis(both, order[..., None], axis=1)
