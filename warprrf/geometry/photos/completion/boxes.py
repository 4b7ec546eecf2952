"""Space divided into boxes by planes, and the surface between free and solid ones that costs least."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.patches import PlanarPatch
from warprrf.geometry.photos.completion.dividers import Divider

MARGIN_M = 0.3  # space kept around the mesh
# Weights of the cut. All are costs in units of one square metre of surface where no plane is known.
KNOWN = 0.4  # a square metre of surface on a known plane
TRUST = 0.6  # a box that goes against all its votes, per square metre of its sides
SURE_VOTES = 10.0  # votes that make half a certainty
PRIOR = 0.3  # votes by which a box that nobody saw leans to solid
LEAK = 0.05  # share of the lines of sight that go astray: so many votes of a neighbour count for nothing
BEHIND = 2.0  # votes that a hit on a plane is worth: far more certain than a line of sight through a box
CAPACITY = 10_000  # the flow is in whole numbers


@dataclass(frozen=True)
class Grid:
    """Boxes between planes along three perpendicular directions.

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

    @property
    def size(self) -> int:
        """Number of boxes."""
        return int(np.prod(self.shape))

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Flat indices of the boxes that points ``(N, 3)`` lie in, -1 outside."""
        index = np.zeros(len(points), dtype=np.int64)
        inside = np.ones(len(points), dtype=bool)
        for a, count in enumerate(self.shape):
            k = np.searchsorted(self.heights[a], points @ self.axes[a], side="right") - 1
            inside &= (k >= 0) & (k < count)
            index = index * count + k
        return np.where(inside, index, -1)

    def count(self, points: np.ndarray) -> np.ndarray:
        """Number of points in each box, shape ``(size,)``."""
        index = self.locate(points)
        return np.bincount(index[index >= 0], minlength=self.size)


def divide(mesh: Mesh, axes: np.ndarray, dividers: Sequence[Divider], cell_m: float) -> Grid:
    """Boxes between ``dividers``, and between further planes where those are more than ``cell_m`` apart."""
    corners = mesh.vertices[np.unique(mesh.faces)] @ axes.T
    heights, normals, offsets, known = [], [], [], []
    for axis in range(3):
        own = sorted((d for d in dividers if d.axis == axis), key=lambda d: d.height)
        # A few stray vertices must not blow up the space.
        low, high = np.quantile(corners[:, axis], [0.002, 0.998])
        stops = [d.height for d in own]
        stops = [min([low, *stops]) - MARGIN_M, *stops, max([high, *stops]) + MARGIN_M]
        between_stops = zip(stops[:-1], stops[1:], strict=True)
        more = [np.linspace(a, b, max(1, int(np.ceil((b - a) / cell_m))) + 1) for a, b in between_stops]
        between = np.concatenate([m[1:-1] for m in more] + [[stops[0], stops[-1]]])
        height = np.concatenate([[d.height for d in own], between])
        normal = np.concatenate(
            [np.array([d.normal for d in own]).reshape(-1, 3), np.tile(axes[axis], (len(between), 1))]
        )
        offset = np.concatenate([[d.offset for d in own], between])
        order = np.argsort(height, kind="stable")
        heights.append(height[order])
        normals.append(normal[order])
        offsets.append(offset[order])
        known.append((np.arange(len(height)) < len(own))[order])
    return Grid(axes, heights, normals, offsets, known)


def least_surface(
    grid: Grid, free: np.ndarray, solid: np.ndarray, closed: np.ndarray | None = None
) -> np.ndarray:
    """Which boxes are solid, shape ``grid.shape`` bool: the labels of least cost.

    Args:
        free, solid: votes for each box, shape ``grid.shape``.
        closed: whether all beyond the lower and upper end of each direction is solid (else it is free), shape
            ``(3, 2)`` bool; default: all.
    """
    from scipy import sparse
    from scipy.sparse import csgraph as graph

    shape = grid.shape
    x, y, z = (np.diff(h) for h in grid.heights)
    sides = [
        np.broadcast_to(side, shape)
        for side in (y[None, :, None] * z, x[:, None, None] * z, (x[:, None] * y)[:, :, None])
    ]
    total = 2 * (sides[0] + sides[1] + sides[2])
    volume = x[:, None, None] * y[None, :, None] * z
    dense = np.pad(free / volume, 1)
    near = np.zeros(shape)
    for a in range(3):
        for end in (slice(None, -2), slice(2, None)):
            part = [slice(1, -1)] * 3
            part[a] = end
            near = np.maximum(near, dense[tuple(part)])
    against = BEHIND * solid + PRIOR + LEAK * near * volume
    cost = TRUST * total * (free - against) / (free + against + SURE_VOTES)
    for a in range(3):
        for k in (0, 1):
            rim = [slice(None)] * 3
            rim[a] = slice(-k, 1 - k or None)
            sure = -1.0 if closed is None or closed[a, k] else 1.0
            cost[tuple(rim)] = 10 * sure * total[tuple(rim)]
    number = np.arange(grid.size).reshape(shape)
    rows, columns, capacity = [], [], []
    for a in range(3):
        lower, upper = [slice(None)] * 3, [slice(None)] * 3
        lower[a], upper[a] = slice(None, -1), slice(1, None)
        weight = np.where(grid.known[a][1:-1], KNOWN, 1.0).reshape([-1 if k == a else 1 for k in range(3)])
        rows.append(number[tuple(lower)].ravel())
        columns.append(number[tuple(upper)].ravel())
        capacity.append(np.maximum(CAPACITY * weight * sides[a][tuple(lower)], 1).ravel())
    i, j, ways = np.concatenate(rows), np.concatenate(columns), np.concatenate(capacity)
    source, sink = grid.size, grid.size + 1
    flat = np.clip(np.rint(CAPACITY * cost.ravel()), -1e8, 1e8)
    up, down = np.flatnonzero(flat > 0), np.flatnonzero(flat < 0)
    begin = np.concatenate([i, j, np.full(len(up), source), down])
    finish = np.concatenate([j, i, up, np.full(len(down), sink)])
    size = np.concatenate([ways, ways, flat[up], -flat[down]]).astype(np.int32)
    matrix = sparse.csr_matrix((size, (begin, finish)), shape=(grid.size + 2, grid.size + 2))
    left = matrix - graph.maximum_flow(matrix, source, sink).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    filled = np.ones(grid.size + 2, dtype=bool)
    filled[graph.breadth_first_order(left, source, return_predecessors=False)] = False
    return filled[: grid.size].reshape(shape)


def without_hollows(grid: Grid, filled: np.ndarray, places: np.ndarray) -> np.ndarray:
    """``filled`` with every hollow filled that none of ``places`` (N, 3) lies in: no photo was taken there."""
    from scipy import ndimage as image

    piece, _ = image.label(~filled)
    index = grid.locate(places)
    own = np.unique(piece.ravel()[index[index >= 0]])
    return ~np.isin(piece, own[own > 0])


def surface_of(grid: Grid, filled: np.ndarray) -> tuple[Mesh, list[PlanarPatch], np.ndarray]:
    """The faces between free and solid boxes: the mesh, a patch for each plane and side, and for each face whether its
    plane is known, shape ``(F,)`` bool."""
    nodes = tuple(s + 1 for s in filled.shape)
    faces, tags = [], []
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        lower, upper = [slice(None)] * 3, [slice(None)] * 3
        lower[a], upper[a] = slice(None, -1), slice(1, None)
        step = filled[tuple(lower)].astype(np.int8) - filled[tuple(upper)].astype(np.int8)
        for sign in (1, -1):
            index = np.argwhere(step == sign)
            index[:, a] += 1
            quad = []
            for along in ((0, 0), (1, 0), (1, 1), (0, 1)):
                node = index.copy()
                node[:, [b, c]] += along
                quad.append(np.ravel_multi_index(node.T, nodes))
            corners = np.stack(quad[::sign], axis=1)
            faces += [corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]
            tags += [np.stack([np.full(len(index), a), index[:, a], np.full(len(index), sign)], axis=1)] * 2
    used, face = np.unique(np.concatenate(faces), return_inverse=True)
    node = np.stack(np.unravel_index(used, nodes), axis=1)
    normal = np.stack([grid.normals[a][node[:, a]] for a in range(3)], axis=1)
    offset = np.stack([grid.offsets[a][node[:, a]] for a in range(3)], axis=1)
    mesh = Mesh(np.linalg.solve(normal, offset[..., None])[..., 0], face.reshape(-1, 3))
    kinds, which = np.unique(np.concatenate(tags), axis=0, return_inverse=True)
    which = which.ravel()
    patches = []
    for k, (a, height, sign) in enumerate(kinds):
        own = np.flatnonzero(which == k)
        patches.append(
            PlanarPatch(
                sign * grid.normals[a][height],
                float(sign * grid.offsets[a][height]),
                own,
                float(mesh.areas[own].sum()),
            )
        )
    known = np.array([grid.known[a][height] for a, height, _ in kinds])[which]
    return mesh, patches, known
