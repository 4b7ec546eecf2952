"""A mesh completed to a closed one: the space of a room divided by its planes, each part free or solid.

Depth maps leave holes where walls are bare, ragged borders where two surfaces meet, and islands in the air. Where most
of a mesh is planar along three perpendicular directions, the planes divide space into boxes, and each box is free or
solid: lines of sight that pass through prove it free, surfaces behind which it lies prove it solid, and of the rest the
surface in between is made as small as it can be, along known planes rather than elsewhere (Chauve, Labatut and Pons,
"Robust piecewise-planar 3D reconstruction and completion from large-scale unstructured point data", 2010; the least
surface is a minimum cut, found by SciPy). The surface of the solid boxes has no holes, lies exactly on the
planes, and takes the place of the faces near it. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warprrf.device import require
from warprrf.geometry.camera import Camera
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.patches import PlanarPatch, simplify, smoothed_normals
from warprrf.geometry.planes import Plane

ALIGNED = np.cos(np.radians(4.0))  # a plane this parallel to one of the three directions counts as parallel
LEAST_SHARE = 0.5  # of the mesh that has to lie on such planes; else the place is no room of boxes
TWIN_M = 0.035  # a plane this close to a stronger one is a bad fit of the same surface
THIN_M = 0.012  # planes facing opposite ways are apart by more: the two faces of a board
STEP_M = 0.06  # spacing of samples along lines of sight
SNAP_M = 0.12  # a depth agrees with the mesh when it is this close
SHY_M = 0.1  # a line of sight proves nothing nearer to an uncertain end than this
UNIT = 1000  # capacities are whole numbers: so many to a square metre times weight


@dataclass(frozen=True)
class Grid:
    """Boxes between planes along three perpendicular directions.

    Attributes:
        axes: the directions, unit rows, shape ``(3, 3)``.
        normals: for each direction the unit normals of its dividing planes, shape ``(N_a, 3)``, near ``axes[a]``.
        offsets: and their offsets, ascending [m], shape ``(N_a,)``.
        known: whether a dividing plane is a surface found before (else it only makes boxes smaller), ``(N_a,)`` bool.
    """

    axes: np.ndarray
    normals: list[np.ndarray]
    offsets: list[np.ndarray]
    known: list[np.ndarray]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of boxes along each direction."""
        a, b, c = (len(o) - 1 for o in self.offsets)
        return a, b, c

    def widths(self, axis: int) -> np.ndarray:
        """Widths of the boxes along one direction [m]."""
        return np.diff(self.offsets[axis])

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flat indices of the boxes that points ``(N, 3)`` lie in, and whether they lie in any."""
        index = np.zeros(len(points), dtype=np.int64)
        inside = np.ones(len(points), dtype=bool)
        for a, count in enumerate(self.shape):
            k = _Lookup.of(self.offsets[a])(points @ self.axes[a])
            inside &= (k >= 0) & (k < count)
            index = index * count + k
        return np.where(inside, index, 0), inside


class _Lookup:
    """Interval of a sorted list for many numbers, by a fine table."""

    FINE_M = 0.002

    def __init__(self, edges: np.ndarray) -> None:
        self.low = edges[0]
        count = int(np.ceil((edges[-1] - edges[0]) / self.FINE_M)) + 1
        middle = self.low + (np.arange(count) + 0.5) * self.FINE_M
        self.table = np.concatenate([[-1], np.searchsorted(edges, middle, side="right") - 1, [len(edges)]])

    @staticmethod
    def of(edges: np.ndarray) -> _Lookup:
        return _Lookup(edges)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        slot = ((x - self.low) * (1 / self.FINE_M) + 1).clip(0, len(self.table) - 1).astype(np.int64)
        return self.table[slot]


def complete(
    mesh: Mesh,
    patches: Sequence[PlanarPatch],
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    *,
    planes: Sequence[Plane] = (),
    cell_m: float = 0.15,
    stride: int = 5,
    min_patch_m2: float = 0.15,
    seed: int = 0,
    debug: dict | None = None,
) -> tuple[Mesh, list[PlanarPatch]]:
    axes = directions(mesh, patches)
    if axes is None:
        return mesh, list(patches)
    grid, face_plane, proven = divided(mesh, patches, planes, axes, cell_m)
    free, solid = evidence(grid, mesh, face_plane, proven, cameras, depths, stride, seed)
    label = least_surface(grid, free, solid)
    label = reachable(grid, label, np.array([c.position for c in cameras]))
    if debug is not None:
        debug.update(grid=grid, free=free, solid=solid, label=label, face_plane=face_plane)
    return surface_of(grid, label, cell_m=0.25, min_patch_m2=min_patch_m2)


def directions(mesh: Mesh, patches: Sequence[PlanarPatch]) -> np.ndarray | None:
    """Three perpendicular unit rows along which most of ``mesh`` lies in planes; None when there are none."""
    if not patches:
        return None
    normals = np.array([p.normal for p in patches])
    areas = np.array([p.area for p in patches])
    around = (np.abs(normals @ normals.T) > ALIGNED) @ areas
    first = normals[around.argmax()]
    cosine = np.abs(normals @ first)
    across = np.where(cosine < np.sin(np.radians(4.0)), around, 0.0)
    if across.max() == 0:
        return None
    second = normals[across.argmax()]
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    axes = np.stack([first, second, np.cross(first, second)])
    # Weighted mean of what is parallel to each direction, made perpendicular again (the nearest rotation).
    for _ in range(3):
        fit = normals @ axes.T
        near = np.where(np.abs(fit) > ALIGNED, np.sign(fit), 0.0) * areas[:, None] ** 2
        mean = near.T @ normals + 1e-9 * axes
        u, _, vt = np.linalg.svd(mean / np.linalg.norm(mean, axis=1, keepdims=True))
        axes = u @ vt
    share = areas[(np.abs(normals @ axes.T) > ALIGNED).any(axis=1)].sum() / mesh.areas.sum()
    if share < LEAST_SHARE:
        return None
    main = np.abs(axes).argmax(axis=1)
    if len(set(main)) == 3:  # in the order and sense of the world axes
        axes = axes[np.argsort(main)]
        axes = axes * np.sign(np.diag(axes))[:, None]
    return axes


def divided(
    mesh: Mesh, patches: Sequence[PlanarPatch], planes: Sequence[Plane], axes: np.ndarray, cell_m: float
) -> tuple[Grid, np.ndarray]:
    """The boxes, and for each face of the mesh which way its plane faces and where: ``(F, 2)``, the signed axis
    (1 to 3, 0 for none) and the height of its plane along the axis [m]."""
    centres = mesh.triangles.mean(axis=1)
    every = []  # strength, axis, sign, height, normal, offset, faces
    for p in patches:
        fit = axes @ p.normal
        axis = int(np.abs(fit).argmax())
        sign = 1 if fit[axis] > 0 else -1
        if abs(fit[axis]) < ALIGNED:
            continue
        source = next((q for q in planes if q.offset == p.offset and np.array_equal(q.normal, p.normal)), None)
        weight = mesh.areas[p.faces]
        centre = weight @ centres[p.faces] / weight.sum()
        # Of a plane that the sparse points and the photos proved, that part counts; of others, a third.
        strength = source.area() + len(source.inliers) / 100 if source is not None and source.occupied.size else p.area / 3
        height = (p.offset - p.normal @ centre) / fit[axis] + axes[axis] @ centre
        if abs(fit[axis]) > np.cos(np.radians(0.1)) and strength > 2.0:
            normal, offset = sign * p.normal, sign * p.offset
        else:
            normal, offset = axes[axis], height
        every.append((strength, axis, sign, height, normal, offset, p.faces))
    every.sort(key=lambda e: -e[0])
    face_plane = np.zeros((len(mesh.faces), 2))
    chosen: list[list[tuple]] = [[], [], []]
    for e in every:
        _, axis, sign, height, normal, offset, faces = e
        twin = next(
            (c for c in chosen[axis] if abs(c[1] - height) < (TWIN_M if c[0] == sign else THIN_M)), None
        )
        if twin is None:
            twin = (sign, height, normal, offset)
            chosen[axis].append(twin)
        face_plane[faces, 0] = sign * (axis + 1)
        face_plane[faces, 1] = twin[1]
    _more_planes(mesh, face_plane, axes, chosen)
    normals, offsets, known = [], [], []
    _covered(mesh, face_plane, axes, chosen, planes)
    corners = mesh.vertices[np.unique(mesh.faces)] @ axes.T
    for axis in range(3):
        planes_here = sorted(chosen[axis], key=lambda c: c[1])
        heights = [c[1] for c in planes_here]
        low, high = np.quantile(corners[:, axis], [0.002, 0.998])
        low, high = min([low, *heights]) - 0.3, max([high, *heights]) + 0.3
        marks = [(h, n, d, True) for _, h, n, d in planes_here]
        stops = [low, *heights, high]
        for a, b in zip(stops[:-1], stops[1:], strict=True):
            parts = max(1, int(np.ceil((b - a) / cell_m)))
            marks += [(a + k * (b - a) / parts, axes[axis], a + k * (b - a) / parts, False) for k in range(1, parts)]
        marks += [(low, axes[axis], low, False), (high, axes[axis], high, False)]
        marks.sort(key=lambda m: m[0])
        normals.append(np.array([m[1] for m in marks]))
        offsets.append(np.array([m[0] for m in marks]))
        known.append(np.array([m[3] for m in marks]))
        # vertices use the plane equations
        grid_d = np.array([m[2] for m in marks])
        normals[-1] = np.concatenate([normals[-1], grid_d[:, None]], axis=1)
    return Grid(axes, normals, offsets, known), face_plane, list(_proven(planes, axes, chosen))


PEAK_M2 = 0.08


def _more_planes(mesh, face_plane, axes, chosen):
    """Planes among the faces that no patch took: peaks of area over height."""
    rest = face_plane[:, 0] == 0
    smooth = smoothed_normals(mesh, 3) @ axes.T
    heights = mesh.triangles.mean(axis=1) @ axes.T
    for axis in range(3):
        for sign in (1, -1):
            own = np.flatnonzero(rest & (sign * smooth[:, axis] > np.cos(np.radians(25.0))))
            old = [c for c in chosen[axis] if c[0] == sign]
            if len(own):  # faces near planes known already join them
                for _, h, *_ in old:
                    near = np.abs(heights[own, axis] - h) < TWIN_M
                    face_plane[own[near]] = sign * (axis + 1), h
                own = own[face_plane[own, 0] == 0]
            if not len(own):
                continue
            x, area = heights[own, axis], mesh.areas[own]
            order = np.argsort(x)
            own, x, area = own[order], x[order], area[order]
            free = np.ones(len(own), dtype=bool)
            while True:
                cum = np.concatenate([[0], np.cumsum(area * free)])
                window = cum[np.searchsorted(x, x + 0.03, side="right")] - cum[:-1]
                k = int(window.argmax())
                if window[k] < PEAK_M2:
                    break
                inside = free & (x >= x[k]) & (x <= x[k] + 0.03)
                h = float((x * area)[inside].sum() / area[inside].sum())
                close = free & (np.abs(x - h) < 2 * TWIN_M)
                free &= ~close
                face_plane[own[free_near(x, h, close)]] = sign * (axis + 1), h
                if not any(abs(c[1] - h) < (TWIN_M if c[0] == sign else THIN_M) for c in chosen[axis]):
                    chosen[axis].append((sign, h, axes[axis], h))


REACH_M = 0.12


def _covered(mesh, face_plane, axes, chosen, planes):
    """Faces go to the plane whose occupied cells, proven by the photos, they lie at."""
    smooth = smoothed_normals(mesh, 3)
    centres = mesh.triangles.mean(axis=1)
    best = np.full(len(centres), REACH_M)
    for plane, axis, sign, height in _proven(planes, axes, chosen):
        gap = np.abs(centres @ axes[axis] - height)
        own = np.flatnonzero((gap < best) & (sign * smooth @ axes[axis] > np.cos(np.radians(35.0))))
        own = own[plane.covers(centres[own])]
        face_plane[own] = sign * (axis + 1), height
        best[own] = gap[own]


def _proven(planes, axes, chosen):
    """Given planes that are dividing planes: plane, axis, sign, height of the divider."""
    for plane in planes:
        fit = axes @ plane.normal
        axis = int(np.abs(fit).argmax())
        if abs(fit[axis]) < ALIGNED or not plane.occupied.any():
            continue
        sign = 1 if fit[axis] > 0 else -1
        height = float(plane.cells().mean(axis=0) @ axes[axis])
        own = [c[1] for c in chosen[axis] if c[0] == sign and abs(c[1] - height) < TWIN_M]
        if own:
            yield plane, axis, sign, min(own, key=lambda h: abs(h - height))


def free_near(x, h, close):
    return close & (np.abs(x - h) < TWIN_M)


def evidence(grid, mesh, face_plane, proven, cameras, depths, stride, seed):
    rng = np.random.default_rng(seed)
    size = int(np.prod(grid.shape))
    free, solid = np.zeros(size), np.zeros(size)
    lookups = [_Lookup(o) for o in grid.offsets]

    def locate(points):
        index = np.zeros(len(points), dtype=np.int64)
        inside = np.ones(len(points), dtype=bool)
        for a, count in enumerate(grid.shape):
            k = lookups[a](points @ grid.axes[a])
            inside &= (k >= 0) & (k < count)
            index = index * count + k
        return index[inside], inside

    origins, dirs, ranges = [], [], []
    for camera, depth in zip(cameras, depths, strict=True):
        d = camera.directions()
        i0, j0 = rng.integers(0, stride, 2)
        r = np.asarray(depth, dtype=np.float64)[i0::stride, j0::stride].ravel()
        d = d[i0::stride, j0::stride].reshape(-1, 3)
        ok = np.isfinite(r) & (r > 0)
        origins.append(np.broadcast_to(camera.position, d[ok].shape))
        dirs.append(d[ok])
        ranges.append(r[ok])
    o, d, r = np.concatenate(origins), np.concatenate(dirs), np.concatenate(ranges)
    hit = mesh.cast(o, d)
    t_mesh = np.where(hit.valid, hit.t, np.inf)
    agree = np.abs(t_mesh - r) < SNAP_M
    plane = np.where(hit.valid[:, None], face_plane[hit.face], 0.0)
    on_plane = agree & (plane[:, 0] != 0)
    axis = np.abs(plane[:, 0]).astype(int) - 1
    n = np.sign(plane[:, :1]) * grid.axes[axis]
    slope = -(d * n).sum(axis=1)
    on_plane &= slope > 0.05
    # Depth to the (merged) plane.
    t_plane = ((o * grid.axes[axis]).sum(axis=1) - plane[:, 1]) * np.sign(plane[:, 0]) / np.where(slope > 0.05, slope, 1.0)
    on_plane &= np.abs(t_plane - r) < SNAP_M / np.maximum(slope, 0.3)
    end = np.where(on_plane, t_plane - 0.004 / np.maximum(slope, 0.05), np.minimum(r, t_mesh) - SHY_M)
    # Samples of free space.
    for first in range(0, len(o), 50_000):
        part = slice(first, first + 50_000)
        count = np.maximum(np.floor(end[part] / STEP_M).astype(int), 0)
        which = np.repeat(np.arange(len(count)), count)
        k = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        t = (k + rng.random(len(which))) * STEP_M
        p = o[part][which] + t[:, None] * d[part][which]
        index, _ = locate(p)
        free += np.bincount(index, minlength=size)
    point = o + t_plane[:, None] * d
    p = point[on_plane]
    nn = n[on_plane]
    index, _ = locate(p + 0.006 * nn)
    free += np.bincount(index, minlength=size)
    index, _ = locate(p - 0.006 * nn)
    solid += np.bincount(index, minlength=size)
    for plane, axis, sign, height in proven:
        cells = plane.cells()
        quarter = np.array([[i, j] for i in (-1, 1) for j in (-1, 1)]) / 4 * plane.cell_m
        cells = (cells[:, None] + quarter @ plane.axes).reshape(-1, 3)
        cells += (height - cells @ grid.axes[axis])[:, None] * grid.axes[axis]
        shift = sign * 0.006 * grid.axes[axis]
        solid += PROOF * np.bincount(locate(cells - shift)[0], minlength=size)
        free += PROOF * np.bincount(locate(cells + shift)[0], minlength=size)
    return free.reshape(grid.shape), solid.reshape(grid.shape)


PROOF = 1.0
SURE_VOTES = 3.0
KNOWN, OTHER = 0.4, 1.0
TRUST = 0.6
LEAK = 0.05
PRIOR = 0.3


def least_surface(grid: Grid, free: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """Which boxes are solid."""
    sparse = require("scipy.sparse", extra="photos")
    graph = require("scipy.sparse.csgraph", extra="photos")
    w = [grid.widths(a) for a in range(3)]
    sides = [
        np.multiply.outer(w[1], w[2])[None] * np.ones(len(w[0]))[:, None, None],
        w[0][:, None, None] * w[2][None, None] * np.ones(len(w[1]))[None, :, None],
        w[0][:, None, None] * w[1][None, :, None] * np.ones(len(w[2])),
    ]
    total = 2 * sum(sides)
    volume = w[0][:, None, None] * w[1][None, :, None] * w[2]
    padded = np.pad(free / volume, 1)
    n = free.shape
    around = np.max(
        [padded[1 + i : 1 + i + n[0], 1 + j : 1 + j + n[1], 1 + k : 1 + k + n[2]]
         for i, j, k in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))], axis=0)
    leak = LEAK * around * volume
    against = 2 * solid + leak + PRIOR
    lean = (free - against) / (free + against + SURE_VOTES)
    unary = TRUST * total * lean
    # Beyond the grid all is solid.
    unary -= 0.0
    rim = np.zeros(free.shape, dtype=bool)
    for a in range(3):
        s = [slice(None)] * 3
        s[a] = [0, -1]
        rim[tuple(s)] = True
    unary[rim] = -10.0 * total[rim]
    ids = np.arange(free.size).reshape(free.shape)
    rows, cols, caps = [], [], []
    for a in range(3):
        lo, hi = [slice(None)] * 3, [slice(None)] * 3
        lo[a], hi[a] = slice(None, -1), slice(1, None)
        weight = np.where(grid.known[a][1:-1], KNOWN, OTHER)
        shape = [1, 1, 1]
        shape[a] = -1
        cap = np.maximum(sides[a][tuple(lo)] * weight.reshape(shape) * UNIT * 10, 1).astype(np.int32)
        rows.append(ids[tuple(lo)].ravel())
        cols.append(ids[tuple(hi)].ravel())
        caps.append(cap.ravel())
    i, j, c = np.concatenate(rows), np.concatenate(cols), np.concatenate(caps)
    source, sink = free.size, free.size + 1
    u = np.round(unary.ravel() * UNIT * 10).astype(np.int64)
    u = np.clip(u, -(10**8), 10**8).astype(np.int32)
    up, down = np.flatnonzero(u > 0), np.flatnonzero(u < 0)
    row = np.concatenate([i, j, np.full(len(up), source), down])
    col = np.concatenate([j, i, up, np.full(len(down), sink)])
    cap = np.concatenate([c, c, u[up], -u[down]])
    matrix = sparse.csr_matrix((cap, (row, col)), shape=(free.size + 2,) * 2)
    flow = graph.maximum_flow(matrix, source, sink).flow
    residual = matrix - flow
    residual.data[residual.data < 0] = 0
    residual.eliminate_zeros()
    reach = graph.breadth_first_order(residual, source, return_predecessors=False)
    label = np.ones(free.size + 2, dtype=bool)
    label[reach] = False
    return label[: free.size].reshape(free.shape)


def reachable(grid: Grid, solid: np.ndarray, places: np.ndarray) -> np.ndarray:
    """``solid`` with every hollow filled that none of ``places`` (N, 3) lies in."""
    image = require("scipy.ndimage", extra="photos")
    piece, _ = image.label(~solid)
    index, inside = grid.locate(places)
    own = np.unique(piece.ravel()[index[inside]])
    return ~np.isin(piece, own[own > 0])


def surface_of(grid: Grid, solid: np.ndarray, *, cell_m: float, min_patch_m2: float) -> tuple[Mesh, list[PlanarPatch]]:
    """The faces between free and solid boxes as a mesh, with one patch a plane and side."""
    nodes = tuple(s + 1 for s in solid.shape)
    faces, tags = [], []
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        lo, hi = [slice(None)] * 3, [slice(None)] * 3
        lo[a], hi[a] = slice(None, -1), slice(1, None)
        change = solid[tuple(lo)].astype(int) - solid[tuple(hi)].astype(int)  # +1: normal along +axis
        for sign in (1, -1):
            index = np.argwhere(change == sign)
            index[:, a] += 1
            corner = []
            for db, dc in ((0, 0), (1, 0), (1, 1), (0, 1)):
                node = index.copy()
                node[:, b] += db
                node[:, c] += dc
                corner.append(np.ravel_multi_index(node.T, nodes))
            q = np.stack(corner, axis=1)
            if sign < 0:
                q = q[:, ::-1]
            odd = (index.sum(axis=1) % 2 == 1)[:, None]
            t1 = np.where(odd, q[:, [0, 1, 2]], q[:, [1, 2, 3]])
            t2 = np.where(odd, q[:, [0, 2, 3]], q[:, [1, 3, 0]])
            faces += [t1, t2]
            tag = (index[:, a] * 2 + (sign > 0)) * 3 + a
            tags += [tag, tag]
    face, tag = np.concatenate(faces), np.concatenate(tags)
    used, face = np.unique(face, return_inverse=True)
    node = np.stack(np.unravel_index(used, nodes), axis=1)
    system = np.stack([grid.normals[a][node[:, a], :3] for a in range(3)], axis=1)
    offset = np.stack([grid.normals[a][node[:, a], 3] for a in range(3)], axis=1)
    mesh = Mesh(np.linalg.solve(system, offset[..., None])[..., 0], face.reshape(-1, 3))
    patches = []
    for value in np.unique(tag):
        own = np.flatnonzero(tag == value)
        a, sign, k = value % 3, 1 if (value // 3) % 2 else -1, value // 6
        area = float(mesh.areas[own].sum())
        plane = grid.normals[a][k]
        patches.append(PlanarPatch(sign * plane[:3], float(sign * plane[3]), own, area))
    mesh, patches = simplify(mesh, patches, cell_m=cell_m)
    return mesh, sorted((p for p in patches if p.area >= min_patch_m2), key=lambda p: -p.area)
