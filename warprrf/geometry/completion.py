"""A mesh made whole: its planes divide space into boxes, and each box is free or solid.

Depth maps leave holes where walls are bare, ragged borders where surfaces meet, and islands in the air. Where most of a
mesh is planar along three perpendicular directions, its planes cut space into boxes. Lines of sight prove boxes free,
the surfaces they end on prove the boxes behind solid, and for the rest the surface between free and solid is made as
small as it can be, along known planes rather than elsewhere (Chauve, Labatut and Pons, "Robust piecewise-planar 3D
reconstruction and completion from large-scale unstructured point data", 2010; a minimum cut, found by SciPy). That
surface has no holes and lies exactly on the planes. Faces that no plane explains stay as they are, and a mesh that is
no such place stays whole as it is. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warprrf.geometry.camera import Camera
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.patches import (
    PlanarPatch,
    connected_pieces,
    simplify,
    smoothed_normals,
)
from warprrf.geometry.planes import Plane

ALIGNED = np.cos(np.radians(4.0))  # a plane this parallel to a direction counts as parallel
EXACT = np.cos(np.radians(0.1))  # and one this parallel keeps its own tilt: 2 cm over 12 m
LEAST_SHARE = 0.5  # of the mesh that has to lie on such planes
TWIN_M = 0.035  # planes facing one way and closer than this are two fits of one surface
THIN_M = 0.012  # planes facing opposite ways can be closer: the two faces of a board
STRONG_M2 = 2.0  # a plane with a proven area above this is fitted better than the directions are
PEAK_M2, PEAK_M = 0.08, 0.03  # so much area of left-over faces within so much height makes one more plane
REACH_M = 0.12  # a face this close to a part of a plane that the photos proved belongs to it
SNAP_M = 0.12  # a depth agrees with the mesh when both are this close
SHY_M = 0.1  # a line of sight proves nothing this close to an end that lies on no plane
STEP_M = 0.06  # mean spacing of samples along lines of sight
BESIDE_M = 0.006  # a hit votes for the boxes this far before and behind its plane: within the thinnest board
MARGIN_M = 0.3  # space kept around the mesh
RIM_M, RIM_SHARE = 0.6, 0.25  # a side is closed when planes this near to it cover so much of it
# A flat piece of surface is seen when hits lie on so much of it; where less than this of all the surface is, photos
# cover too little of the place for the rest to be inferred.
SEEN_PIECE, LEAST_SEEN = 0.1, 0.7
# Weights of the cut. All are costs in units of one square metre of surface where no plane is known.
KNOWN = 0.4  # a square metre of surface on a known plane
TRUST = 0.6  # a box that goes against all its votes, per square metre of its sides
SURE_VOTES = 10.0  # votes that make half a certainty
PRIOR = 0.3  # votes by which a box that nobody saw leans to solid
LEAK = 0.05  # share of the lines of sight that go astray: so many votes of a neighbour count for nothing
BEHIND = (
    2.0  # votes that a hit on a plane is worth: it is far more certain than one line of sight through a box
)
CAPACITY = 10_000  # the flow is in whole numbers
KEEP_M, KEEP_M2 = (
    0.12,
    0.3,
)  # pieces of the old mesh this far from every known plane, and this large, are kept


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


@dataclass(frozen=True)
class _Divider:
    """A known plane: ``sign`` times direction ``axis`` is its seen side, ``height`` its place along the direction."""

    axis: int
    sign: int
    height: float
    normal: np.ndarray
    offset: float


@dataclass(frozen=True)
class _Labels:
    """The plane that each face lies on: direction 0 to 2 or -1 for none, seen side, height [m]; shapes ``(F,)``."""

    axis: np.ndarray
    sign: np.ndarray
    height: np.ndarray

    def set(self, faces: np.ndarray, divider: _Divider) -> None:
        self.axis[faces], self.sign[faces] = divider.axis, divider.sign
        self.height[faces] = divider.height


def complete(
    mesh: Mesh,
    patches: Sequence[PlanarPatch],
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    *,
    planes: Sequence[Plane] = (),
    cell_m: float = 0.1,
    stride: int = 5,
    min_patch_m2: float = 0.15,
    seed: int = 0,
) -> tuple[Mesh, list[PlanarPatch]]:
    """``mesh`` with holes closed, borders straightened and islands in the air removed, where its planes allow it.

    Args:
        mesh: flattened onto its ``patches``.
        cameras, depths: what was seen: Euclidean range per pixel [m], 0 where unknown, each ``(height, width)``.
        planes: planes known beforehand; their occupied cells are evidence of their own.
        cell_m: largest side of a box.
        stride: every so many-th row and column of the depth maps is used.
        min_patch_m2: smallest patch returned.
        seed: of the places of samples.

    Returns:
        The mesh and its patches, largest first; what was given when most of the mesh lies on no planes along three
        perpendicular directions, or the photos show so little of the place that most of it would be a guess.

    Raises:
        ValueError: when the numbers of cameras and depth maps differ.
    """
    if len(depths) != len(cameras):
        raise ValueError(f"depths: got {len(depths)} maps for {len(cameras)} cameras, expected one for each")
    axes = directions(mesh, patches)
    if axes is None or not len(cameras):
        return mesh, list(patches)
    dividers, labels = _dividers(mesh, patches, planes, axes)
    proven = list(_proven(planes, axes, dividers))
    _claim_proven(mesh, labels, axes, proven)
    grid = divide(mesh, axes, dividers, cell_m)
    free, solid = _votes(grid, mesh, labels, cameras, depths, stride, seed)
    for plane, divider in proven:
        _vote_proven(grid, plane, divider, free, solid)
    filled = least_surface(grid, free, solid, _closed_sides(grid, mesh, labels))
    filled = without_hollows(grid, filled, np.array([c.position for c in cameras]))
    if filled.all():
        return mesh, list(patches)
    whole, parts, known = surface_of(grid, filled)
    if seen_share(grid, whole, parts, solid) < LEAST_SEEN:
        return mesh, list(patches)
    whole, parts = _with_rest(whole, parts, known, mesh, patches, labels)
    whole, parts = simplify(whole, parts)
    return whole, sorted((p for p in parts if p.area >= min_patch_m2), key=lambda p: -p.area)


def directions(mesh: Mesh, patches: Sequence[PlanarPatch]) -> np.ndarray | None:
    """Three perpendicular unit rows along which most of ``mesh`` is planar; None when there are none."""
    if not patches:
        return None
    normals = np.array([p.normal for p in patches])
    areas = np.array([p.area for p in patches])
    alike = (np.abs(normals @ normals.T) > ALIGNED) @ areas
    first = normals[alike.argmax()]
    across = np.where(np.abs(normals @ first) < np.sqrt(1 - ALIGNED**2), alike, 0.0)
    if across.max() == 0:
        return None
    second = normals[across.argmax()]
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    axes = np.stack([first, second, np.cross(first, second)])
    for _ in range(3):
        # The mean of what is parallel to each direction (large planes are fitted best), and the nearest rotation.
        fit = normals @ axes.T
        weight = np.where(np.abs(fit) > ALIGNED, np.sign(fit), 0.0) * areas[:, None] ** 2
        mean = weight.T @ normals
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        mean = np.where(length > 0, mean / np.where(length > 0, length, 1.0), axes)
        u, _, vt = np.linalg.svd(mean)
        axes = u @ vt
    if areas[(np.abs(normals @ axes.T) > ALIGNED).any(axis=1)].sum() < LEAST_SHARE * mesh.areas.sum():
        return None
    main = np.abs(axes).argmax(axis=1)
    if len(set(main)) == 3:  # in the order and sense of the world axes
        axes = axes[np.argsort(main)]
        axes = axes * np.sign(np.diag(axes))[:, None]
    elif np.linalg.det(axes) < 0:
        axes = -axes
    return axes


def divide(mesh: Mesh, axes: np.ndarray, dividers: Sequence[_Divider], cell_m: float) -> Grid:
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


def seen_share(grid: Grid, mesh: Mesh, patches: Sequence[PlanarPatch], solid: np.ndarray) -> float:
    """Share of the surface's area in flat pieces that hits lie on, by the votes ``solid`` of the boxes behind."""
    behind = grid.locate(mesh.triangles.mean(axis=1) - 0.5 * BESIDE_M * mesh.face_normals)
    hit = (behind >= 0) & (solid.ravel()[behind] > 0)
    label = np.full(len(mesh.faces), -1)
    for k, patch in enumerate(patches):
        label[patch.faces] = k
    piece = connected_pieces(mesh, label)
    area = np.bincount(piece, weights=mesh.areas)
    seen = np.bincount(piece, weights=mesh.areas * hit) > SEEN_PIECE * area
    return float(area[seen].sum() / area.sum())


# ------------------------------------------------------------------------------------------------ planes


def _dividers(
    mesh: Mesh, patches: Sequence[PlanarPatch], planes: Sequence[Plane], axes: np.ndarray
) -> tuple[list[_Divider], _Labels]:
    """Known planes along the directions, the best supported first, and the faces on each of them."""
    centres = mesh.triangles.mean(axis=1)
    candidates: list[tuple[float, _Divider, np.ndarray]] = []
    for p in patches:
        fit = axes @ p.normal
        axis = int(np.abs(fit).argmax())
        if abs(fit[axis]) < ALIGNED:
            continue
        # The area that photos proved counts in full; of a plane fitted to the mesh alone, a third.
        proven = [q.area() for q in planes if q.offset == p.offset and np.array_equal(q.normal, p.normal)]
        strength = proven[0] if proven else p.area / 3
        sign = 1 if fit[axis] > 0 else -1
        centre = mesh.areas[p.faces] @ centres[p.faces] / max(mesh.areas[p.faces].sum(), 1e-30)
        height = float((p.offset - p.normal @ centre) / fit[axis] + axes[axis] @ centre)
        if abs(fit[axis]) > EXACT and strength > STRONG_M2:
            divider = _Divider(axis, sign, height, sign * p.normal, sign * p.offset)
        else:
            divider = _Divider(axis, sign, height, axes[axis], height)
        candidates.append((strength, divider, p.faces))
    chosen: list[_Divider] = []
    count = len(mesh.faces)
    labels = _Labels(np.full(count, -1), np.zeros(count, dtype=np.int64), np.zeros(count))
    for _, divider, faces in sorted(candidates, key=lambda c: -c[0]):
        twin = _twin(divider, chosen)
        if twin is None:
            chosen.append(divider)
        labels.set(faces, replace(twin or divider, sign=divider.sign))
    for divider, faces in _peaks(mesh, labels, axes, chosen):
        labels.set(faces, divider)
        if _twin(divider, chosen) is None:
            chosen.append(divider)
    return chosen, labels


def _twin(divider: _Divider, others: Sequence[_Divider]) -> _Divider | None:
    for other in others:
        gap = TWIN_M if other.sign == divider.sign else THIN_M
        if other.axis == divider.axis and abs(other.height - divider.height) < gap:
            return other
    return None


def _peaks(
    mesh: Mesh, labels: _Labels, axes: np.ndarray, known: Sequence[_Divider]
) -> Iterator[tuple[_Divider, np.ndarray]]:
    """Planes on which the faces that no patch took gather, and their faces; known planes take theirs first."""
    facing = smoothed_normals(mesh, 3) @ axes.T
    heights = mesh.triangles.mean(axis=1) @ axes.T
    for axis in range(3):
        for sign in (1, -1):
            own = np.flatnonzero((labels.axis < 0) & (sign * facing[:, axis] > np.cos(np.radians(25.0))))
            for divider in [d for d in known if (d.axis, d.sign) == (axis, sign)]:
                near = np.abs(heights[own, axis] - divider.height) < TWIN_M
                yield divider, own[near]
                own = own[~near]
            own = own[np.argsort(heights[own, axis], kind="stable")]
            x, area = heights[own, axis], mesh.areas[own]
            last = np.searchsorted(x, x + PEAK_M, side="right")
            while len(own):
                total = np.concatenate([[0.0], np.cumsum(area)])
                gathered = total[last] - total[:-1]
                k = int(gathered.argmax())
                if gathered[k] < PEAK_M2:
                    break
                height = float(x[k : last[k]] @ area[k : last[k]] / gathered[k])
                gap = np.abs(x - height)
                yield (
                    _Divider(axis, sign, height, axes[axis], height),
                    own[(gap < TWIN_M) & (area > 0)],
                )
                area = np.where(gap < 2 * TWIN_M, 0.0, area)


def _proven(
    planes: Sequence[Plane], axes: np.ndarray, dividers: Sequence[_Divider]
) -> Iterator[tuple[Plane, _Divider]]:
    """Planes with occupied cells, each with the divider that it became."""
    for plane in planes:
        fit = axes @ plane.normal
        axis = int(np.abs(fit).argmax())
        if abs(fit[axis]) < ALIGNED or not plane.occupied.any():
            continue
        height = float(plane.cells().mean(axis=0) @ axes[axis])
        sign = 1 if fit[axis] > 0 else -1
        own = [d for d in dividers if (d.axis, d.sign) == (axis, sign) and abs(d.height - height) < TWIN_M]
        if own:
            yield plane, min(own, key=lambda d: abs(d.height - height))


def _claim_proven(
    mesh: Mesh, labels: _Labels, axes: np.ndarray, proven: Sequence[tuple[Plane, _Divider]]
) -> None:
    """Faces near occupied cells go to their plane, whichever plane they were snapped to."""
    if not proven:
        return
    facing = smoothed_normals(mesh, 3) @ axes.T
    centres = mesh.triangles.mean(axis=1)
    heights = centres @ axes.T
    least = np.full(len(centres), REACH_M)
    for plane, divider in proven:
        gap = np.abs(heights[:, divider.axis] - divider.height)
        towards = divider.sign * facing[:, divider.axis] > np.cos(np.radians(35.0))
        own = np.flatnonzero((gap < least) & towards)
        own = own[plane.covers(centres[own])]
        labels.set(own, divider)
        least[own] = gap[own]


# ------------------------------------------------------------------------------------------------ evidence


def _votes(
    grid: Grid,
    mesh: Mesh,
    labels: _Labels,
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    stride: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Votes for free and for solid, shape ``grid.shape`` each.

    A line of sight counts where its depth agrees with the mesh. It votes free at samples along it, and where it ends on
    a plane also right before the plane, and solid right behind.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for camera, depth in zip(cameras, depths, strict=True):
        i, j = rng.integers(0, stride, 2)
        ranges = np.asarray(depth, dtype=np.float64)[i::stride, j::stride].ravel()
        seen = np.isfinite(ranges) & (ranges > 0)
        towards = camera.directions()[i::stride, j::stride].reshape(-1, 3)[seen]
        parts.append((np.broadcast_to(camera.position, towards.shape), towards, ranges[seen]))
    o, d, ranges = (np.concatenate(p) for p in zip(*parts, strict=True))
    free, solid = np.zeros(grid.size), np.zeros(grid.size)
    if not len(o):
        return free.reshape(grid.shape), solid.reshape(grid.shape)
    hit = mesh.cast(o, d)
    agree = hit.valid & (np.abs(np.where(hit.valid, hit.t, 0.0) - ranges) < SNAP_M)
    o, d, ranges, t, face = o[agree], d[agree], ranges[agree], hit.t[agree], hit.face[agree]
    axis, sign, height = labels.axis[face], labels.sign[face], labels.height[face]
    normal = sign[:, None] * grid.axes[axis]
    cosine = -np.einsum("ni,ni->n", d, normal)
    on = (axis >= 0) & (cosine > 0.05)
    slope = np.where(on, cosine, 1.0)
    t_plane = (np.einsum("ni,ni->n", o, normal) - sign * height) / slope
    on &= np.abs(t_plane - ranges) < SNAP_M / np.maximum(slope, 0.3)
    end = np.where(on, t_plane - BESIDE_M / slope, np.minimum(ranges, t) - SHY_M)
    point = (o + t_plane[:, None] * d)[on]
    free += grid.count(point + BESIDE_M * normal[on])
    solid += grid.count(point - BESIDE_M * normal[on])
    _sample(grid, o, d, end, rng, free)
    return free.reshape(grid.shape), solid.reshape(grid.shape)


def _sample(
    grid: Grid, o: np.ndarray, d: np.ndarray, end: np.ndarray, rng: np.random.Generator, votes: np.ndarray
) -> None:
    """Add to ``votes`` the samples along rays up to ``end`` [m], one in each stretch of ``STEP_M``.

    Heights become boxes by a table of 2 mm: much faster than a search, and fine enough for evidence.
    """
    fine = 0.002
    tables = []
    for heights, count in zip(grid.heights, grid.shape, strict=True):
        middles = np.arange(heights[0] + fine / 2, heights[-1], fine)
        box = np.clip(np.searchsorted(heights, middles, side="right") - 1, 0, count - 1)
        tables.append(np.concatenate([[-(2**40)], box, [-(2**40)]]))  # outside stays negative
    low = np.array([h[0] for h in grid.heights])
    start = (((o @ grid.axes.T - low) / fine) + 1).T.astype(np.float32)
    along = (d @ grid.axes.T / fine).T.astype(np.float32)
    reach = np.maximum(end, 0).astype(np.float32)
    counts = np.ceil(reach / STEP_M).astype(np.int64)
    for first in range(0, len(o), 20_000):
        count = counts[first : first + 20_000]
        ray = np.repeat(np.arange(first, first + len(count)), count)
        step = np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)
        t = (step.astype(np.float32) + rng.random(len(ray), dtype=np.float32)) * np.float32(STEP_M)
        index = np.zeros(len(ray), dtype=np.int64)
        for a, boxes in enumerate(grid.shape):
            slot = start[a][ray] + t * along[a][ray]
            index *= boxes
            index += tables[a][np.clip(slot, 0, len(tables[a]) - 1).astype(np.int32)]
        votes += np.bincount(index[(index >= 0) & (t < reach[ray])], minlength=len(votes))


def _vote_proven(grid: Grid, plane: Plane, divider: _Divider, free: np.ndarray, solid: np.ndarray) -> None:
    """Four votes of each occupied cell for free space before it, and for a solid behind."""
    quarter = np.array([[i, j] for i in (-0.25, 0.25) for j in (-0.25, 0.25)]) * plane.cell_m
    points = (plane.cells()[:, None] + quarter @ plane.axes).reshape(-1, 3)
    axis = grid.axes[divider.axis]
    points += (divider.height - points @ axis)[:, None] * axis
    before = divider.sign * BESIDE_M * axis
    free += grid.count(points + before).reshape(grid.shape)
    solid += grid.count(points - before).reshape(grid.shape)


def _closed_sides(grid: Grid, mesh: Mesh, labels: _Labels) -> np.ndarray:
    """Whether planes cover the lower and upper end of each direction, seen from within, shape ``(3, 2)`` bool."""
    closed = np.zeros((3, 2), dtype=bool)
    extent = [h[-1] - h[0] for h in grid.heights]
    for a in range(3):
        across = extent[(a + 1) % 3] * extent[(a + 2) % 3]
        for k, (end, sign) in enumerate(((grid.heights[a][0], 1), (grid.heights[a][-1], -1))):
            own = (labels.axis == a) & (labels.sign == sign) & (np.abs(labels.height - end) < RIM_M)
            closed[a, k] = mesh.areas[own].sum() > RIM_SHARE * across
    return closed


# ------------------------------------------------------------------------------------------------ the rest


def _with_rest(
    whole: Mesh,
    parts: Sequence[PlanarPatch],
    known: np.ndarray,
    mesh: Mesh,
    patches: Sequence[PlanarPatch],
    labels: _Labels,
) -> tuple[Mesh, list[PlanarPatch]]:
    """The completed surface with round or oblique pieces of the old mesh in place of the steps made for them."""
    centres = mesh.triangles.mean(axis=1)
    rest = labels.axis < 0
    if known.any():
        rest[rest] = Mesh(whole.vertices, whole.faces[known]).distance(centres[rest]) > KEEP_M
    piece = connected_pieces(mesh, np.where(rest, 0, -1))
    rest &= np.bincount(piece, weights=mesh.areas * rest)[piece] >= KEEP_M2
    if not rest.any():
        return whole, list(parts)
    own = np.flatnonzero(rest)
    stays = known.copy()
    if not known.all():
        near = Mesh(mesh.vertices, mesh.faces[own]).distance(whole.triangles[~known].mean(axis=1))
        stays[~known] = near > KEEP_M
    old = np.flatnonzero(stays)
    place = np.full(len(whole.faces), -1)
    place[old] = np.arange(len(old))
    new = np.full(len(mesh.faces), -1)
    new[own] = len(old) + np.arange(len(own))
    faces = np.concatenate([whole.faces[old], mesh.faces[own] + len(whole.vertices)])
    used, faces = np.unique(faces, return_inverse=True)
    joint = Mesh(np.concatenate([whole.vertices, mesh.vertices])[used], faces.reshape(-1, 3))
    result = []
    for p, number in [(p, place) for p in parts] + [(p, new) for p in patches]:
        left = number[p.faces]
        left = left[left >= 0]
        if len(left):
            result.append(replace(p, faces=left, area=float(joint.areas[left].sum())))
    return joint, result
