"""Where Gaussians start: flat discs on the sparse points, and on the planes where photos see them.

The photos' colours decide how finely a plane is covered: blocks whose colour varies are cut into smaller ones, the
worst first, until the wanted number is reached. So bare walls take few Gaussians and posters many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warprrf.device import check_array
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.planes import Plane, plane_axes
from warprrf.geometry.photos.surface import Occluder, neighbours, visible_from
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians, quaternions_of

SH_DC = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
OPACITY = 0.95
SPREAD = 0.65  # standard deviation of a disc in units of the spacing: little light leaks between neighbours
FLATNESS = 0.05  # thickness over radius
MIN_SCALE, MAX_SCALE = 0.004, 0.12  # of a disc on a sparse point [m]
VIEWS = 6  # photos that a colour is taken from


@dataclass(frozen=True)
class _Blocks:
    """Square pieces of planes: world centre, plane number, side [m], colour, spread of the colour inside."""

    centre: np.ndarray
    plane: np.ndarray
    side: np.ndarray
    color: np.ndarray
    variance: np.ndarray


def initial_gaussians(
    points: Any,
    colors: Any,
    normals: Any,
    planes: Sequence[Plane] = (),
    cameras: Sequence[Camera] = (),
    images: Sequence[np.ndarray] = (),
    *,
    count: int = 32_000,
    on_plane_m: float = 0.02,
) -> Gaussians:
    """Flat Gaussians to start the photometric optimisation from, degree 0 colours.

    Args:
        points: sparse points [m], shape ``(P, 3)``.
        colors: in [0, 1], shape ``(P, 3)``.
        normals: unit normals, shape ``(P, 3)``.
        planes: planes with occupied cells (see :func:`~warprrf.geometry.photos.planes.occupancy`); cells that no camera sees
            are left out. Points on a plane give way to the plane's own Gaussians.
        cameras, images: the photos, ``(H, W, 3)`` in [0, 1].
        count: Gaussians wanted in all (about).
        on_plane_m: a point this close to an occupied cell is on the plane.

    Raises:
        ValueError: when shapes or numbers do not fit, or nothing is there to start from.
    """
    points = check_array("points", points, (None, 3))
    colors = check_array("colors", colors, (len(points), 3))
    normals = check_array("normals", normals, (len(points), 3))
    if len(cameras) != len(images):
        raise ValueError(f"images: got {len(images)} for {len(cameras)} cameras, expected one for each")
    free = np.ones(len(points), dtype=bool)
    for plane in planes:
        free &= ~((np.abs(plane.distance(points)) < on_plane_m) & plane.covers(points))
    if not len(planes) or not len(cameras):
        free[:] = True
    parts = []
    kept = int(free.sum())
    if kept:
        parts.append(_discs_on_points(points, colors, normals, free))
    if len(planes) and len(cameras):
        blocks = _plane_blocks(planes, cameras, images, max(count - kept, 1))
        if len(blocks.centre):
            normal = np.array([p.normal for p in planes])[blocks.plane]
            parts.append(_discs(blocks.centre, normal, SPREAD * blocks.side, blocks.color))
    if not parts:
        raise ValueError("points: got none, and no plane that a photo sees; nothing to start from")
    return Gaussians(
        *(
            np.concatenate([getattr(g, k) for g in parts])
            for k in ("means", "quaternions", "scales", "opacities", "sh")
        )
    )


def _discs_on_points(
    points: np.ndarray, colors: np.ndarray, normals: np.ndarray, chosen: np.ndarray
) -> Gaussians:
    if len(points) > 3:
        _, gap = neighbours(points, 4, points[chosen])
        radius = np.clip(gap[:, 1:].mean(axis=1), MIN_SCALE, MAX_SCALE)
    else:
        radius = np.full(int(chosen.sum()), MAX_SCALE)
    return _discs(points[chosen], normals[chosen], radius, colors[chosen])


def _discs(centres: np.ndarray, normals: np.ndarray, radius: np.ndarray, colors: np.ndarray) -> Gaussians:
    kinds, which = np.unique(normals, axis=0, return_inverse=True)
    axes = np.array([plane_axes(n) for n in kinds])[which.ravel()]
    rotation = np.stack([axes[:, 0], axes[:, 1], normals], axis=2)
    scales = np.stack([radius, radius, np.maximum(FLATNESS * radius, 1e-4)], axis=1)
    sh = ((colors - 0.5) / SH_DC)[:, None, :]
    return Gaussians(centres, quaternions_of(rotation), scales, np.full(len(centres), OPACITY), sh)


def plane_mesh(planes: Sequence[Plane]) -> Mesh | None:
    """The occupied cells of all planes as one mesh of squares; None when there are none."""
    vertices, faces = [], []
    total = 0
    for plane in planes:
        cells = np.argwhere(plane.occupied)
        corners = (cells[:, None, :] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])).reshape(-1, 2)
        vertices.append(plane.to_world(plane.corner + corners * plane.cell_m))
        first = total + 4 * np.arange(len(cells))[:, None]
        faces += [first + [0, 1, 2], first + [0, 2, 3]]
        total += 4 * len(cells)
    return Mesh(np.concatenate(vertices), np.concatenate(faces)) if total else None


def plane_occluder(planes: Sequence[Plane]) -> Occluder | None:
    """The occupied cells of all planes as an obstacle to sight; None when there are none."""
    mesh = plane_mesh(planes)
    return None if mesh is None else Occluder(mesh)


def seen_cells(planes: Sequence[Plane], cameras: Sequence[Camera], *, min_views: int = 2) -> list[Plane]:
    """``planes`` with only those occupied cells that at least ``min_views`` cameras see past all the others."""
    mesh = plane_mesh(planes)
    if mesh is None:
        return list(planes)
    surface = Occluder(mesh)
    result = []
    for plane in planes:
        cells = plane.cells()
        normals = np.broadcast_to(plane.normal, cells.shape)
        seen = visible_from(surface, cells, normals, cameras, clearance_m=0.05).sum(axis=1) >= min_views
        occupied = plane.occupied.copy()
        occupied[plane.occupied] = seen
        result.append(replace(plane, occupied=occupied))
    return result


def _plane_blocks(
    planes: Sequence[Plane], cameras: Sequence[Camera], images: Sequence[np.ndarray], count: int
) -> _Blocks:
    """Blocks of two, one or half a cell, as the colours ask, about ``count`` of them."""
    surface = plane_occluder(planes)
    levels: list[list[_Blocks]] = [[], [], []]
    parents: list[list[np.ndarray]] = [[], []]
    offset = [0, 0]
    for k, plane in enumerate(planes):
        index = np.argwhere(plane.occupied)
        if not len(index):
            continue
        centres = plane.to_world(plane.corner + (index + 0.5) * plane.cell_m)
        seen = visible_from(
            surface, centres, np.broadcast_to(plane.normal, centres.shape), cameras, clearance_m=0.05
        )
        some = seen.any(axis=1)
        index, centres, seen = index[some], centres[some], seen[some]
        if not len(index):
            continue
        quarter = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]]) * plane.cell_m
        fine = (centres[:, None, :] + (quarter @ plane.axes)[None]).reshape(-1, 3)
        color = sample_colors(fine, np.repeat(seen, 4, axis=0), plane.normal, cameras, images).reshape(
            -1, 4, 3
        )
        coarse_key, parent = np.unique(index // 2, axis=0, return_inverse=True)
        parent = parent.ravel()
        members = np.bincount(parent)

        def pooled(
            values: np.ndarray, parent: np.ndarray = parent, members: np.ndarray = members
        ) -> np.ndarray:
            return np.stack([np.bincount(parent, v) for v in values.T], axis=1) / members[:, None]

        middle = color.mean(axis=1)
        coarse = pooled(middle)
        n_fine, n_middle, n_coarse = len(fine), len(index), len(coarse_key)
        cell = plane.cell_m
        levels[0].append(
            _Blocks(
                pooled(centres), np.full(n_coarse, k), np.full(n_coarse, 2 * cell), coarse,
                np.bincount(parent, ((middle - coarse[parent]) ** 2).sum(axis=1)),
            )
        )  # fmt: skip
        levels[1].append(
            _Blocks(
                centres, np.full(n_middle, k), np.full(n_middle, cell), middle,
                ((color - middle[:, None]) ** 2).sum(axis=2).mean(axis=1),
            )
        )  # fmt: skip
        levels[2].append(
            _Blocks(
                fine, np.full(n_fine, k), np.full(n_fine, cell / 2), color.reshape(-1, 3), np.zeros(n_fine)
            )
        )
        parents[0].append(parent + offset[0])
        parents[1].append(np.repeat(np.arange(n_middle), 4) + offset[1])
        offset[0] += n_coarse
        offset[1] += n_middle
    if not levels[0]:
        empty = np.zeros((0, 3))
        return _Blocks(empty, np.zeros(0, dtype=int), np.zeros(0), empty, np.zeros(0))
    whole = [_joined(level) for level in levels]
    up = [np.concatenate(p) for p in parents]
    # A cut of the coarse level costs 3 Gaussians and removes about the variance between its cells, with a share of what
    # lies within them; the largest gains first.
    cut = [np.zeros(len(w.centre), dtype=bool) for w in whole[:2]]
    room = count - len(whole[0].centre)
    gain0 = whole[0].variance + np.bincount(up[0], whole[1].variance, minlength=len(cut[0]))
    order = np.argsort(-gain0, kind="stable")
    share = max(0, int(0.5 * room / 3))
    cut[0][order[:share]] = True
    room -= 3 * min(share, len(order))
    gain1 = np.where(cut[0][up[0]], whole[1].variance, -1.0)
    order = np.argsort(-gain1, kind="stable")[: max(0, room // 3)]
    cut[1][order[gain1[order] > 0]] = True
    use = [~cut[0], cut[0][up[0]] & ~cut[1], cut[1][up[1]]]
    return _joined([_picked(w, u) for w, u in zip(whole, use, strict=True)])


def _joined(blocks: Sequence[_Blocks]) -> _Blocks:
    names = ("centre", "plane", "side", "color", "variance")
    return _Blocks(*(np.concatenate([getattr(b, n) for b in blocks]) for n in names))


def _picked(blocks: _Blocks, use: np.ndarray) -> _Blocks:
    return _Blocks(
        blocks.centre[use], blocks.plane[use], blocks.side[use], blocks.color[use], blocks.variance[use]
    )


def sample_colors(
    points: np.ndarray,
    seen: np.ndarray,
    normal: np.ndarray,
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray],
) -> np.ndarray:
    """Median colour of each point over the photos that see it best (near and frontal), shape ``(N, 3)``.

    Args:
        seen: which cameras see which point, shape ``(N, cameras)``; every point is seen by one at least.
        normal: of the surface, shape ``(3,)``.
    """
    positions = np.array([c.position for c in cameras])
    best = np.full((len(points), VIEWS), -1, dtype=np.int64)
    merit = np.full((len(points), VIEWS), -np.inf)
    for c in range(len(cameras)):
        line = positions[c] - points
        distance = np.linalg.norm(line, axis=1)
        # Pixels per area: cosine over distance squared.
        worth = np.where(seen[:, c], (line @ normal) / distance**3, -np.inf)
        slot = merit.argmin(axis=1)
        rows = np.flatnonzero(worth > merit[np.arange(len(points)), slot])
        best[rows, slot[rows]], merit[rows, slot[rows]] = c, worth[rows]
    taken = np.full((len(points), VIEWS, 3), np.nan)
    for c, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        rows, slots = np.nonzero(best == c)
        if not len(rows):
            continue
        uv, _ = camera.project(points[rows])
        x = np.clip(uv[:, 0] - 0.5, 0, camera.width - 1.001)
        y = np.clip(uv[:, 1] - 0.5, 0, camera.height - 1.001)
        i, j = y.astype(np.int64), x.astype(np.int64)
        fy, fx = (y - i)[:, None], (x - j)[:, None]
        taken[rows, slots] = (1 - fy) * ((1 - fx) * image[i, j] + fx * image[i, j + 1]) + fy * (
            (1 - fx) * image[i + 1, j] + fx * image[i + 1, j + 1]
        )
    return np.nan_to_num(np.nanmedian(taken, axis=1), nan=0.5)
