"""Space divided into boxes by planes, and the surface between free and solid ones that costs least."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from warprrf.cache import cached_property
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.completion.room_planes import Level
from warprrf.geometry.planar_patches import PlanarPatches

CELL_M, MARGIN_M = 0.1, 0.3  # largest side of a box, and space kept around the mesh
SURE_VOTES = 10.0  # votes that make half a certainty
BEHIND = 2.0  # votes that a hit on a plane is worth: far more certain than a line of sight through a box
CAPACITY = 10_000  # the flow is in whole numbers: so many for a square metre
FINE_M = 0.002  # boxes are looked up in tables of this step: much faster than a search, and fine enough for evidence


@dataclass(frozen=True)
class Grid:
    """Boxes between planes across three perpendicular directions.

    Attributes:
        axes: the directions, unit rows, shape ``(3, 3)``.
        heights: for each direction where its dividing planes lie, ascending [m], shape ``(N,)``.
        normals, offsets: the exact equations of the planes, ``normal . x = offset``, shapes ``(N, 3)`` and ``(N,)``.
        known: whether a dividing plane is a surface (else it only makes boxes smaller), shape ``(N,)`` bool.
    """

    axes: np.ndarray
    heights: list[np.ndarray]
    normals: list[np.ndarray] = field(repr=False)
    offsets: list[np.ndarray] = field(repr=False)
    known: list[np.ndarray] = field(repr=False)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of boxes along each direction."""
        a, b, c = (len(h) - 1 for h in self.heights)
        return a, b, c

    @cached_property
    def _tables(self) -> list[np.ndarray]:
        """Box at every ``FINE_M`` of each direction, with one entry for what lies beyond either end."""
        tables = []
        for heights in self.heights:
            middles = np.arange(heights[0] + FINE_M / 2, heights[-1], FINE_M)
            box = np.clip(np.searchsorted(heights, middles, side="right") - 1, 0, len(heights) - 2)
            tables.append(np.concatenate([[-(2**40)], box, [-(2**40)]]))  # stays negative when added to
        return tables

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Flat indices of the boxes that points ``(N, 3)`` lie in, to 2 mm; negative outside."""
        index = np.zeros(len(points), dtype=np.int64)
        for a, table in enumerate(self._tables):
            slot = (points @ self.axes[a] - self.heights[a][0]) / FINE_M + 1
            index = index * self.shape[a] + table[np.clip(slot, 0, len(table) - 1).astype(np.int64)]
        return index

    def count(self, points: np.ndarray) -> np.ndarray:
        """Number of points in each box, shape ``shape``."""
        index = self.locate(points)
        return np.bincount(index[index >= 0], minlength=int(np.prod(self.shape))).reshape(self.shape)


def divide(mesh: Mesh, axes: np.ndarray, levels: Sequence[Level]) -> Grid:
    """Boxes between ``levels``, and between further planes where those are more than a cell apart."""
    corners = mesh.vertices[np.unique(mesh.faces)] @ axes.T
    grid = Grid(axes, [], [], [], [])
    for axis in range(3):
        own = sorted((level for level in levels if level.axis == axis), key=lambda level: level.height)
        # A few stray vertices must not blow up the space.
        low, high = np.quantile(corners[:, axis], [0.002, 0.998])
        stops = [level.height for level in own]
        stops = [min([low, *stops]) - MARGIN_M, *stops, max([high, *stops]) + MARGIN_M]
        steps = np.maximum(1, np.ceil(np.diff(stops) / CELL_M).astype(int))
        between = zip(stops[:-1], stops[1:], steps, strict=True)
        parts = [np.linspace(a, b, n + 1)[:-1] for a, b, n in between]
        height = np.append(np.concatenate(parts), stops[-1])
        normal, offset, known = np.tile(axes[axis], (len(height), 1)), height.copy(), height < -np.inf
        for k, level in zip(np.cumsum(steps), own, strict=False):
            normal[k], offset[k], known[k] = level.normal, level.offset, True
        grid.heights.append(height)
        grid.normals.append(normal)
        grid.offsets.append(offset)
        grid.known.append(known)
    return grid


def least_surface(grid: Grid, free: np.ndarray, solid: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Which boxes are solid, shape ``grid.shape`` bool: the labels of least cost.

    Args:
        free, solid: votes for each box, shape ``grid.shape``.
        closed: whether all beyond the lower and upper end of each direction is solid (else it is free), shape
            ``(3, 2)`` bool.
    """
    x, y, z = (np.diff(h) for h in grid.heights)
    sides = [  # area of a box's side across each direction
        np.broadcast_to(side, grid.shape)
        for side in (y[None, :, None] * z, x[:, None, None] * z, (x[:, None] * y)[:, :, None])
    ]
    around = 2 * (sides[0] + sides[1] + sides[2])
    volume = x[:, None, None] * y[None, :, None] * z
    cross = ndimage.generate_binary_structure(3, 1)
    cross[1, 1, 1] = False
    beside = ndimage.maximum_filter(free / volume, footprint=cross, mode="constant")
    # 0.3: votes by which a box that nobody saw leans to solid
    # 0.05: share of the lines of sight that go astray: so many votes of a neighbour count for nothing
    against = BEHIND * solid + 0.3 + 0.05 * beside * volume
    # 0.6: cost of a box that goes against all its votes, per square metre of its sides
    cost = 0.6 * around * (free - against) / (free + against + SURE_VOTES)
    for a in range(3):
        for end, is_closed in zip((0, -1), closed[a], strict=True):
            rim = np.moveaxis(cost, a, 0)
            rim[end] = (-10 if is_closed else 10) * np.moveaxis(around, a, 0)[end]
    return _minimum_cut(grid, cost, sides)


def _minimum_cut(grid: Grid, cost: np.ndarray, sides: Sequence[np.ndarray]) -> np.ndarray:
    """Solid boxes of the cut between what costs to be solid (``cost`` > 0) and to be free (``cost`` < 0)."""
    size = cost.size
    number = np.arange(size).reshape(grid.shape)
    rows, columns, capacity = [], [], []
    for a in range(3):
        box, side = np.moveaxis(number, a, 0), np.moveaxis(sides[a], a, 0)
        # 0.4: cost of a square metre of surface on a known plane; one where no plane is known costs 1
        weight = np.where(grid.known[a][1:-1], 0.4, 1.0)[:, None, None]
        rows.append(box[:-1].ravel())
        columns.append(box[1:].ravel())
        capacity.append(np.maximum(CAPACITY * weight * side[:-1], 1).ravel())
    i, j, ways = np.concatenate(rows), np.concatenate(columns), np.concatenate(capacity)
    flat = np.clip(np.rint(CAPACITY * cost.ravel()), -1e8, 1e8)
    up, down = np.flatnonzero(flat > 0), np.flatnonzero(flat < 0)
    source, sink = size, size + 1
    begin = np.concatenate([i, j, np.full(len(up), source), down])
    finish = np.concatenate([j, i, up, np.full(len(down), sink)])
    flow = np.concatenate([ways, ways, flat[up], -flat[down]]).astype(np.int32)
    matrix = sparse.csr_matrix((flow, (begin, finish)), shape=(size + 2, size + 2))
    left = matrix - csgraph.maximum_flow(matrix, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    filled = np.ones(size + 2, dtype=bool)
    filled[csgraph.breadth_first_order(left, source, return_predecessors=False)] = False
    return filled[:size].reshape(grid.shape)


def surface_of(grid: Grid, filled: np.ndarray, tolerance_m: float) -> tuple[PlanarPatches, np.ndarray]:
    """The faces between free and solid boxes, a patch for each plane and side, and for each face whether its plane is
    known, shape ``(F,)`` bool."""
    nodes = tuple(s + 1 for s in filled.shape)
    faces, tags = [], []
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        step = np.diff(filled.astype(np.int8), axis=a)
        for sign in (1, -1):
            index = np.argwhere(step == -sign)
            index[:, a] += 1
            quad = []
            for along in ((0, 0), (1, 0), (1, 1), (0, 1)):
                corner = index.copy()
                corner[:, [b, c]] += along
                quad.append(np.ravel_multi_index(tuple(corner.T), nodes))
            corners = np.stack(quad[::sign], axis=1)
            faces += [corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]
            tags += [np.stack([np.full(len(index), a), index[:, a], np.full(len(index), sign)], axis=1)] * 2
    used, face = np.unique(np.concatenate(faces), return_inverse=True)
    node = np.unravel_index(used, nodes)
    normal = np.stack([grid.normals[a][node[a]] for a in range(3)], axis=1)
    offset = np.stack([grid.offsets[a][node[a]] for a in range(3)], axis=1)
    vertices = np.linalg.solve(normal, offset[..., None])[..., 0]
    kinds, which = np.unique(np.concatenate(tags), axis=0, return_inverse=True)
    patches = PlanarPatches.from_planes(
        Mesh(vertices, face.reshape(-1, 3)),
        which.ravel(),
        [sign * grid.normals[a][k] for a, k, sign in kinds],
        [sign * grid.offsets[a][k] for a, k, sign in kinds],
        tolerance_m=tolerance_m,
    )
    known = np.array([grid.known[a][k] for a, k, _ in kinds])
    return patches, known[which.ravel()]
