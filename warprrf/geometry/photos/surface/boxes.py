"""Planes across three perpendicular directions of a room; space divided into boxes by them, what lines of sight prove of
these, and the surface between free and solid ones that costs least.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from warprrf.cache import cached_property
from warprrf.geometry.mesh import Mesh, connected_pieces, smoothed_normals
from warprrf.geometry.photos.gaussians.cells import quarters
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.planes import ALIGNED_DEG, Plane
from warprrf.geometry.splats.camera import Camera
from warprrf.rows import distinct_rows, spans

EXACT_DEG, STRONG_M2 = 0.1, 2.0
"""A plane this parallel, with a proven area above the second, keeps its own tilt (0.1 degrees are 2 cm over 12 m): it is
fitted better than the directions are."""
SAME_SIDE_M = 0.035  # planes facing one way and closer than this are two fits of one surface


class Level(NamedTuple):
    """Where a plane crosses one of the directions: ``height`` [m] along direction ``axis``, seen from the side of
    ``sign`` times it. Its exact equation is ``plane[:3] . x = plane[3]``, the normal nearly the direction itself."""

    axis: int
    sign: int
    height: float
    plane: np.ndarray


@dataclass(frozen=True)
class FaceLevels:
    """Faces of a mesh and the level that each lies on.

    Attributes:
        middle: along the directions [m], shape ``(F, 3)``.
        facing: smoothed normals along the directions, shape ``(F, 3)``.
        area: [m^2], shape ``(F,)``.
        axis, sign, height: of the level: direction 0 to 2 or -1 for none, seen side, height [m]; shapes ``(F,)``.
    """

    middle: np.ndarray
    facing: np.ndarray
    area: np.ndarray
    axis: np.ndarray
    sign: np.ndarray
    height: np.ndarray

    def set(self, faces: np.ndarray, level: Level) -> None:
        """Faces of these indices lie on ``level``."""
        self.axis[faces], self.sign[faces], self.height[faces] = level[:3]


def known_levels(
    patches: PlanarPatches, planes: Sequence[Plane], axes: np.ndarray
) -> tuple[list[Level], FaceLevels, list[tuple[Plane, Level]]]:
    """Levels of the patches that are parallel to the directions, the best supported first, then those on which other faces
    gather; the level of each face; and those of ``planes`` that became a level, with it.

    Args:
        patches: of the mesh; patch k lies on ``planes[k]`` as far as there are so many.
    """
    mesh, count = patches.mesh, len(patches.mesh.faces)
    centres = mesh.triangles.mean(axis=1)
    candidates: list[tuple[float, Level, np.ndarray]] = []
    for k in np.flatnonzero(patches.area > 0).tolist():
        axis, sign = _parallel_to(patches.normal[k], axes)
        if axis < 0:
            continue
        faces = patches.faces(k)
        centre = mesh.areas[faces] @ centres[faces] / patches.area[k]
        fit = float(axes[axis] @ patches.normal[k])
        height = float((patches.offset[k] - patches.normal[k] @ centre) / fit + axes[axis] @ centre)
        # The area that photos proved counts in full; of a plane fitted to the mesh alone, a third.
        proven = planes[k].area() if k < len(planes) else 0.0
        strength = proven or patches.area[k] / 3
        level = Level(axis, sign, height, np.append(axes[axis], height))
        if abs(fit) > np.cos(np.radians(EXACT_DEG)) and strength > STRONG_M2:
            level = level._replace(plane=sign * np.append(patches.normal[k], patches.offset[k]))
        candidates.append((strength, level, faces))
    chosen: list[Level] = []
    known = centres @ axes.T, smoothed_normals(mesh, 3) @ axes.T, mesh.areas
    found = FaceLevels(*known, np.full(count, -1), np.zeros(count, dtype=np.int64), np.zeros(count))
    for _, level, faces in sorted(candidates, key=lambda c: -c[0]):
        twin = _twin(level, chosen)
        if twin is None:
            chosen.append(level)
        found.set(faces, (twin or level)._replace(sign=level.sign))
    for level, faces in _gatherings(found, axes, list(chosen)):
        found.set(faces, level)
        if _twin(level, chosen) is None:
            chosen.append(level)
    return chosen, found, _proven(planes, axes, chosen, found, centres)


def _parallel_to(normal: np.ndarray, axes: np.ndarray) -> tuple[int, int]:
    """The direction that a plane crosses, -1 for none, and the sign of its seen side."""
    fit = axes @ normal
    axis = int(np.abs(fit).argmax())
    if abs(fit[axis]) < np.cos(np.radians(ALIGNED_DEG)):
        return -1, 0
    return axis, 1 if fit[axis] > 0 else -1


def _twin(level: Level, others: Sequence[Level]) -> Level | None:
    """The first of ``others`` that is the same surface."""
    for other in others:
        # 0.012: planes facing opposite ways can be closer, down to this: the two faces of a board
        gap = SAME_SIDE_M if other.sign == level.sign else 0.012
        if other.axis == level.axis and abs(other.height - level.height) < gap:
            return other
    return None


def _gatherings(
    faces: FaceLevels, axes: np.ndarray, known: Sequence[Level]
) -> Iterator[tuple[Level, np.ndarray]]:
    """Levels on which the faces that no patch took gather, and their faces; known levels take theirs first."""
    # so much area of left-over faces within so much height makes one more plane
    gather_m2, gather_m = 0.08, 0.03
    for axis in range(3):
        for sign in (1, -1):
            towards = sign * faces.facing[:, axis] > np.cos(np.radians(25.0))
            own = np.flatnonzero((faces.axis < 0) & towards)
            for level in [d for d in known if (d.axis, d.sign) == (axis, sign)]:
                near = np.abs(faces.middle[own, axis] - level.height) < SAME_SIDE_M
                yield level, own[near]
                own = own[~near]
            own = own[np.argsort(faces.middle[own, axis], kind="stable")]
            x, area = faces.middle[own, axis], faces.area[own]
            last = np.searchsorted(x, x + gather_m, side="right")
            while len(own):
                total = np.concatenate([[0.0], np.cumsum(area)])
                gathered = total[last] - total[:-1]
                k = int(gathered.argmax())
                if gathered[k] < gather_m2:
                    break
                height = float(x[k : last[k]] @ area[k : last[k]] / gathered[k])
                gap = np.abs(x - height)
                level = Level(axis, sign, height, np.append(axes[axis], height))
                yield level, own[(gap < SAME_SIDE_M) & (area > 0)]
                area = np.where(gap < 2 * SAME_SIDE_M, 0.0, area)


def _proven(
    planes: Sequence[Plane], axes: np.ndarray, levels: Sequence[Level], faces: FaceLevels, centres: np.ndarray
) -> list[tuple[Plane, Level]]:
    """Planes with occupied cells, each with the level that it became. The faces near these cells, of middles ``centres`` (F, 3),
    go to it, whichever plane they were snapped to."""
    result = []
    # 0.12: a face this close to a part of a plane that photos proved belongs to it
    least = np.full(len(centres), 0.12)
    for plane in planes:
        axis, sign = _parallel_to(plane.normal, axes)
        if axis < 0 or not plane.occupied.any():
            continue
        height = float(plane.cells().mean(axis=0) @ axes[axis])
        near = [level for level in levels if level[:2] == (axis, sign)]
        level = min(near, key=lambda level: abs(level.height - height), default=None)
        if level is None or abs(level.height - height) >= SAME_SIDE_M:
            continue
        result.append((plane, level))
        gap = np.abs(faces.middle[:, axis] - level.height)
        own = np.flatnonzero((gap < least) & (sign * faces.facing[:, axis] > np.cos(np.radians(35.0))))
        own = own[plane.covers(centres[own])]
        faces.set(own, level)
        least[own] = gap[own]
    return result


CELL_M, MARGIN_M = 0.1, 0.3  # largest side of a box, and space kept around the mesh
BEHIND = 2.0  # votes that a hit on a plane is worth: far more certain than a line of sight through a box
CAPACITY = 10_000  # the flow is in whole numbers: so many for a square metre
FINE_M = 0.002  # boxes are looked up in tables of this step: much faster than a search, and fine enough for evidence
STRIDE = 5  # every so many-th row and column of the depth maps is used
BESIDE_M = 0.006  # a hit votes for the boxes this far before and behind its plane: within the thinnest board


@dataclass(frozen=True)
class Grid:
    """Boxes between planes across three perpendicular directions.

    Attributes:
        axes: the directions, unit rows, shape ``(3, 3)``.
        heights: for each direction where its dividing planes lie, ascending [m], shape ``(N,)``.
        planes: their exact equations as :class:`Level` has them, shape ``(N, 4)``.
        known: whether a dividing plane is a surface (else it only makes boxes smaller), shape ``(N,)`` bool.
    """

    axes: np.ndarray
    heights: list[np.ndarray]
    planes: list[np.ndarray]
    known: list[np.ndarray]

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
    grid = Grid(axes, [], [], [])
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
        plane, known = np.column_stack([np.tile(axes[axis], (len(height), 1)), height]), height < -np.inf
        for k, level in zip(np.cumsum(steps), own, strict=False):
            plane[k], known[k] = level.plane, True
        grid.heights.append(height)
        grid.planes.append(plane)
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
    areas = y[None, :, None] * z, x[:, None, None] * z, (x[:, None] * y)[:, :, None]
    sides = [np.broadcast_to(side, grid.shape) for side in areas]  # of a box, across each direction
    around = 2 * (sides[0] + sides[1] + sides[2])
    volume = x[:, None, None] * y[None, :, None] * z
    cross = ndimage.generate_binary_structure(3, 1)
    cross[1, 1, 1] = False
    beside = ndimage.maximum_filter(free / volume, footprint=cross, mode="constant")
    # 0.3: votes by which a box that nobody saw leans to solid
    # 0.05: share of the lines of sight that go astray: so many votes of a neighbour count for nothing
    against = BEHIND * solid + 0.3 + 0.05 * beside * volume
    sure_votes = 10.0  # votes that make half a certainty
    # 0.6: cost of a box that goes against all its votes, per square metre of its sides
    cost = 0.6 * around * (free - against) / (free + against + sure_votes)
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
        square = np.zeros((4, 3), dtype=int)
        square[:, [b, c]] = [[0, 0], [1, 0], [1, 1], [0, 1]]
        for sign in (1, -1):
            index = np.argwhere(step == -sign)
            index[:, a] += 1
            corners = np.ravel_multi_index(tuple((index[:, None] + square[::sign]).T), nodes).T
            faces += [corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]
            tags += [np.stack([np.full(len(index), a), index[:, a], np.full(len(index), sign)], axis=1)] * 2
    used, face = np.unique(np.concatenate(faces), return_inverse=True)
    node = np.unravel_index(used, nodes)
    meeting = np.stack([grid.planes[a][node[a]] for a in range(3)], axis=1)
    vertices = np.linalg.solve(meeting[..., :3], meeting[..., 3:])[..., 0]
    tag = np.concatenate(tags)
    first, which, _ = distinct_rows(tag)
    kinds, mesh = tag[first], Mesh(vertices, face.reshape(-1, 3))
    plane = np.array([sign * grid.planes[a][k] for a, k, sign in kinds])
    patches = PlanarPatches.from_planes(mesh, which, plane[:, :3], plane[:, 3], tolerance_m=tolerance_m)
    known = np.array([grid.known[a][k] for a, k, _ in kinds])
    return patches, known[which]


def votes(
    grid: Grid,
    mesh: Mesh,
    faces: FaceLevels,
    proven: Sequence[tuple[Plane, Level]],
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Votes for free and for solid, shape ``grid.shape`` each.

    A line of sight counts where its depth agrees with the mesh. It votes free at samples along it, and where it ends on
    a plane also right before the plane, and solid right behind. So does each occupied cell of ``proven`` planes, four times.
    """
    o, d, ranges = _lines_of_sight(cameras, depths)
    hit = mesh.cast(o, d)
    snap_m = 0.12  # a depth agrees with the mesh when both are this close
    agree = np.abs(hit.t - ranges) < snap_m
    o, d, ranges, t, face = o[agree], d[agree], ranges[agree], hit.t[agree], hit.face[agree]
    axis, sign, height = faces.axis[face], faces.sign[face], faces.height[face]
    normal = sign[:, None] * grid.axes[axis]
    cosine = -np.einsum("ni,ni->n", d, normal)
    on = (axis >= 0) & (cosine > 0.05)
    slope = np.where(on, cosine, 1.0)
    t_plane = (np.einsum("ni,ni->n", o, normal) - sign * height) / slope
    on &= np.abs(t_plane - ranges) < snap_m / np.maximum(slope, 0.3)
    # 0.1: a line of sight proves nothing this close to an end that lies on no plane
    end = np.where(on, t_plane - BESIDE_M / slope, np.minimum(ranges, t) - 0.1)
    point = (o + t_plane[:, None] * d)[on]
    free = grid.count(point + BESIDE_M * normal[on]).astype(float)
    solid = grid.count(point - BESIDE_M * normal[on]).astype(float)
    step_m = 0.06  # spacing of samples along lines of sight
    # A sample in the middle of each step along the line. Nothing is drawn: one line more or less changes one vote.
    counts = np.ceil(np.maximum(end, 0) / step_m - 0.5).astype(np.int64)
    rays_at_once = 20_000
    for first in range(0, len(o), rays_at_once):
        count = counts[first : first + rays_at_once]
        ray, step = spans(0 * count, count)
        ray += first
        free += grid.count(o[ray] + ((step + 0.5) * step_m)[:, None] * d[ray])
    for plane, level in proven:
        points, across = quarters(plane).reshape(-1, 3), grid.axes[level.axis]
        points += (level.height - points @ across)[:, None] * across
        free += grid.count(points + level.sign * BESIDE_M * across)
        solid += grid.count(points - level.sign * BESIDE_M * across)
    return free, solid


def _lines_of_sight(
    cameras: Sequence[Camera], depths: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and directions, shape ``(N, 3)``, and ranges [m] of known pixels."""
    parts, some = [], (slice(STRIDE // 2, None, STRIDE),) * 2
    for camera, depth in zip(cameras, depths, strict=True):
        ranges = np.asarray(depth, dtype=np.float64)[some].ravel()
        seen = ranges > 0
        towards = camera.directions()[some].reshape(-1, 3)[seen]
        parts.append((np.broadcast_to(camera.position, towards.shape), towards, ranges[seen]))
    o, d, ranges = (np.concatenate(p) for p in zip(*parts, strict=True))
    return o, d, ranges


def closed_sides(grid: Grid, faces: FaceLevels) -> np.ndarray:
    """Whether planes cover the lower and upper end of each direction, seen from within, shape ``(3, 2)`` bool."""
    closed = np.zeros((3, 2), dtype=bool)
    extent = [h[-1] - h[0] for h in grid.heights]
    rim_m, rim_share = 0.6, 0.25  # a side is closed when planes this near to it cover so much of it
    for a in range(3):
        across = extent[(a + 1) % 3] * extent[(a + 2) % 3]
        for k, (end, sign) in enumerate(((grid.heights[a][0], 1), (grid.heights[a][-1], -1))):
            own = (faces.axis == a) & (faces.sign == sign) & (np.abs(faces.height - end) < rim_m)
            closed[a, k] = faces.area[own].sum() > rim_share * across
    return closed


def seen_share(grid: Grid, patches: PlanarPatches, solid: np.ndarray) -> float:
    """Share of the surface's area in flat pieces that hits lie on, by the votes ``solid`` of the boxes behind."""
    mesh = patches.mesh
    behind = grid.locate(mesh.triangles.mean(axis=1) - 0.5 * BESIDE_M * mesh.face_normals)
    hit = (behind >= 0) & (solid.ravel()[behind] > 0)
    piece = connected_pieces(mesh, patches.face_patch)
    area = np.bincount(piece, weights=mesh.areas)
    # 0.1: a flat piece of surface is seen when hits lie on so much of it
    seen = np.bincount(piece, weights=mesh.areas * hit) > 0.1 * area
    return float(area[seen].sum() / area.sum())
