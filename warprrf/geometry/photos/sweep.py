"""Planes that photos prove though few features lie on them: by sweeping patches through space and comparing photos.

Features are rare on surfaces seen at a grazing angle: floors, seats, table tops. A small patch at the right height
shows the same texture in all photos that see it, at a wrong height it does not (Collins, "A space-sweep approach to
true multi-image matching", 1996). The same test extends a known plane beyond its features and cuts it where it ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warprrf.device import launch, resolve
from warprrf.geometry.photos.initial_gaussians import plane_occluder
from warprrf.geometry.photos.planes import CONTESTED_M, Plane, dilate, plane_axes
from warprrf.geometry.photos.surface import visible_from
from warprrf.geometry.splats.camera import Camera
from warprrf.kernels.photo_consistency import SIDE, patch_agreement

VIEWS = 5  # photos compared
MIN_ANGLE = np.radians(
    6.0
)  # between any two of them, seen from the patch: without parallax every height fits
PATCH_M = 0.12  # side of a patch
AGREES, DISAGREES = 0.6, 0.25  # mean correlation of a true patch, and of one that is certainly not
CONTRAST = 0.012  # flatter patches prove nothing
STEP_M = 0.03  # between heights of the sweep
COARSE_M = 0.3  # cells that share the choice of photos


@dataclass(frozen=True)
class Photos:
    """Grey photos and their projections on a device.

    Attributes:
        cameras: pinhole cameras of one size.
        grey: all photos, flat float32.
        projections: rows of the 3x4 projection matrices, shape ``(cameras, 3)`` of vec4.
    """

    cameras: Sequence[Camera]
    grey: wp.array
    projections: wp.array
    device: Any

    @classmethod
    def upload(cls, cameras: Sequence[Camera], images: Sequence[np.ndarray], device: Any = None) -> Photos:
        """Photos ``(H, W, 3)`` in [0, 1] of ``cameras``."""
        device = resolve(device)
        grey = np.stack(
            [i @ np.array([0.299, 0.587, 0.114], dtype=np.float32) for i in images]
        )  # ITU-R BT.601 luma
        rows = np.zeros((len(cameras), 3, 4), dtype=np.float32)
        for k, c in enumerate(cameras):
            lens = np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]])
            rows[k] = lens @ c.world_to_camera[:3]
        return cls(
            cameras, wp.array(grey.ravel(), dtype=wp.float32, device=device),
            wp.array(rows, dtype=wp.vec4, device=device), device,
        )  # fmt: skip

    def agreement(
        self, centres: np.ndarray, axes: np.ndarray, views: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Correlation in [-1, 1] and contrast of the patches at ``centres`` (N, 3) over ``views`` (N, V), -1 padded."""
        n = len(centres)
        result = wp.zeros(n, dtype=wp.float32, device=self.device)
        contrast = wp.zeros(n, dtype=wp.float32, device=self.device)
        launch(
            patch_agreement,
            n,
            [
                wp.array(centres, dtype=wp.vec3, device=self.device), wp.vec3(*axes[0]), wp.vec3(*axes[1]),
                PATCH_M / (SIDE - 1), wp.array(views, dtype=wp.int32, device=self.device), self.projections, self.grey,
                self.cameras[0].width, self.cameras[0].height, result, contrast,
            ],
            device=self.device,
        )  # fmt: skip
        return result.numpy(), contrast.numpy()


def choose_views(
    points: np.ndarray, normals: np.ndarray, seen: np.ndarray, cameras: Sequence[Camera], count: int = VIEWS
) -> np.ndarray:
    """For each point the photos that show it largest among those that see it, no two from nearly the same direction.

    Returns:
        Camera indices, shape ``(N, count)`` int32, -1 padded.
    """
    positions = np.array([c.position for c in cameras])
    line = positions[None] - points[:, None]
    distance = np.linalg.norm(line, axis=2)
    line /= np.maximum(distance, 1e-9)[..., None]
    worth = np.where(seen, np.einsum("nci,ni->nc", line, normals) / distance**2, -1.0)
    chosen = np.full((len(points), count), -1, dtype=np.int32)
    rows = np.arange(len(points))
    for k in range(count):
        best = worth.argmax(axis=1)
        good = worth[rows, best] > 0
        chosen[good, k] = best[good]
        close = np.einsum("nci,ni->nc", line, line[rows, best]) > np.cos(MIN_ANGLE)
        worth = np.where(close, -1.0, worth)
    return chosen


def proven_cells(
    planes: Sequence[Plane],
    points: np.ndarray,
    photos: Photos,
    *,
    reach_m: float = 2.5,
    large_m2: float = 3.0,
) -> list[Plane]:
    """``planes`` with their cells corrected by the photos: extended (large planes, up to ``reach_m``) where the photos
    agree, emptied where they disagree and no point of the plane is near. Of two parallel planes close to each other,
    such as a sign and its wall, the one that the photos agree on more has the cell."""
    surface = plane_occluder(planes)
    wide, candidates, insides, scores, visible, own = [], [], [], [], [], []
    for plane in planes:
        reach = int(round(reach_m / plane.cell_m)) if plane.area() >= large_m2 else 2
        padded = _padded(plane, reach)
        grid = dilate(padded.occupied, reach)
        full = replace(padded, occupied=grid)
        centres = full.cells()
        views, seen = _shared_views(full, surface, photos.cameras)
        agreement, contrast = photos.agreement(centres, plane.axes, views)
        score = np.full(grid.shape, np.nan)
        score[grid] = np.where((contrast > CONTRAST) & (views[:, 1] >= 0), agreement, np.nan)
        sees = np.zeros(grid.shape, dtype=bool)
        sees[grid] = seen
        feet = np.zeros(grid.shape, dtype=bool)
        index = np.floor((padded.to_plane(points[plane.inliers]) - padded.corner) / padded.cell_m).astype(int)
        feet[tuple(np.clip(index, 0, np.array(grid.shape) - 1).T)] = True
        wide.append(full)
        candidates.append(grid)
        insides.append(padded.occupied)
        scores.append(score)
        visible.append(sees)
        own.append(feet)
    result = []
    for k, plane in enumerate(wide):
        with np.errstate(invalid="ignore"):
            yes, no = scores[k] > AGREES, scores[k] < DISAGREES
        grown = _majority(yes, 5) & ~insides[k]
        cut = _majority(no, 3) & ~dilate(own[k], 1)
        lost = np.zeros_like(grown)
        cells = plane.cells()
        mine = np.nan_to_num(scores[k][candidates[k]], nan=0.3)
        for other in range(len(wide)):
            rival = wide[other]
            if other == k or rival.normal @ plane.normal < np.cos(np.radians(10.0)):
                continue
            near = np.abs(rival.distance(cells)) < CONTESTED_M
            index = np.floor((rival.to_plane(cells) - rival.corner) / rival.cell_m).astype(int)
            near &= ((index >= 0) & (index < rival.occupied.shape)).all(axis=1)
            index = np.where(near[:, None], index, 0)
            spot = (index[:, 0], index[:, 1])
            there = insides[other][spot]
            theirs = np.nan_to_num(scores[other][spot], nan=0.3)
            beaten = near & there & ((theirs > mine) | own[other][spot])
            lost[candidates[k]] |= beaten & ~own[k][candidates[k]]
            grown[candidates[k]] &= ~(near & there)
        kept = insides[k] & ~cut & ~lost
        attached = _pieces(grown | kept, 6) & grown
        result.append(replace(plane, occupied=(kept | attached) & visible[k]))
    return result


def _shared_views(plane: Plane, surface: Any, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Photos to compare at each occupied cell, chosen once for every 2 x 2 cells, and whether any photo sees it."""
    index = np.argwhere(plane.occupied)
    key, group = np.unique(index // 2, axis=0, return_inverse=True)
    group = group.ravel()
    centres = plane.to_world(plane.corner + (2 * key + 1.0) * plane.cell_m)
    normals = np.broadcast_to(plane.normal, centres.shape)
    seen = visible_from(surface, centres, normals, cameras, clearance_m=0.05)
    return choose_views(centres, normals, seen, cameras)[group], np.asarray(seen.any(axis=1))[group]


def level_planes(
    planes: Sequence[Plane],
    points: np.ndarray,
    photos: Photos,
    eyes: np.ndarray,
    targets: np.ndarray,
    *,
    cell_m: float = 0.1,
    min_cells: int = 15,
    up: bool = True,
) -> list[Plane]:
    """Horizontal planes (z is up) that photos prove and ``planes`` lack: seats, table tops, platforms, soffits.

    Args:
        points: sparse points; the sweep spans their extent.
        min_cells: fewest cells of a plane.
        eyes, targets: lines of sight from cameras to points, shape ``(L, 3)``: what they cross is no surface.
        up: surfaces that face up; else those that face down.
    """
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    heights = np.array([c.position[2] for c in photos.cameras])
    bottom, top = (low[2], min(high[2], heights.max())) if up else (max(low[2], heights.min()), high[2])
    levels = np.arange(bottom - 0.06, top + 0.06, STEP_M)
    if len(levels) < 3:
        return []
    normal = np.array([0.0, 0.0, 1.0 if up else -1.0])
    axes = plane_axes(normal)
    shape = np.ceil((high[:2] - low[:2]) / cell_m).astype(int) + 1
    cells = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 2)
    ground = np.zeros((len(cells), 3))
    ground[:, :2] = low[:2] + (cells + 0.5) * cell_m
    coarse = max(1, int(round(COARSE_M / cell_m)))
    key, group = np.unique(cells // coarse, axis=0, return_inverse=True)
    group = group.ravel()
    middle = np.zeros((len(key), 3))
    middle[:, :2] = low[:2] + (key + 0.5) * coarse * cell_m
    surface = plane_occluder(planes)
    every = max(1, int(round(0.09 / STEP_M)))
    agreement = np.full((len(levels), len(cells)), -1.0, dtype=np.float32)
    views = np.zeros((len(cells), VIEWS), dtype=np.int32)
    for k, z in enumerate(levels):
        if k % every == 0:
            middle[:, 2] = levels[min(k + every // 2, len(levels) - 1)]
            normals = np.broadcast_to(normal, middle.shape)
            seen = visible_from(surface, middle, normals, photos.cameras, clearance_m=0.03)
            views = choose_views(middle, normals, seen, photos.cameras)[group]
        some = np.flatnonzero(views[:, 2] >= 0)  # three photos at least
        if not len(some):
            continue
        ground[:, 2] = z
        value, contrast = photos.agreement(ground[some], axes, views[some])
        agreement[k, some] = np.where(contrast > CONTRAST, value, -1.0)
    # A surface is a clear peak along the vertical.
    padded = np.pad(agreement, ((4, 4), (0, 0)), constant_values=-1.0)
    near = np.max([padded[4 + s : 4 + s + len(levels)] for s in (-1, 1)], axis=0)
    far = np.max([padded[4 + s : 4 + s + len(levels)] for s in (-4, -3, 3, 4)], axis=0)
    peak = (agreement > AGREES) & (agreement >= near) & (agreement > far + 0.15)
    known = np.zeros_like(peak)
    for plane in planes:
        if plane.normal @ normal > 0.99:
            for k, z in enumerate(levels):
                ground[:, 2] = z
                known[k] |= (np.abs(plane.distance(ground)) < 0.05) & plane.covers(ground)
    peak &= ~known
    found: list[Plane] = []
    while True:
        votes = peak.sum(axis=1)
        votes = votes + np.concatenate([votes[1:], [0]]) + np.concatenate([[0], votes[:-1]])
        k = int(votes.argmax())
        if votes[k] < min_cells:
            return found
        band = slice(max(0, k - 1), k + 2)
        columns = peak[band].any(axis=0)
        mask = np.zeros(shape, dtype=bool)
        mask[tuple(cells[columns].T)] = True
        strong = agreement[band].max(axis=0) > 0.8 * AGREES
        soft = np.zeros(shape, dtype=bool)
        soft[tuple(cells[strong].T)] = True
        mask = _pieces((mask | (dilate(mask, 1) & soft)), min_cells)
        peak[max(0, k - 2) : k + 3] &= ~columns[None]
        if mask.sum() < min_cells:
            continue
        # Every connected piece has a height of its own.
        for piece in _split(mask):
            level = _settled(piece, levels[k], low[:2], cell_m, normal, axes, photos, surface)
            if level is not None and _crossed(level, eyes, targets) < 0.2:
                found.append(level)


def _crossed(plane: Plane, eyes: np.ndarray, targets: np.ndarray) -> float:
    """Share of the plane's cells that a line of sight passes through, to a point more than 5 cm behind."""
    before, behind = plane.distance(eyes), plane.distance(targets)
    through = (before > 0) & (behind < -0.05)
    share = (before[through] / (before[through] - behind[through]))[:, None]
    crossing = plane.to_plane(eyes[through] + share * (targets[through] - eyes[through]))
    index = np.floor((crossing - plane.corner) / plane.cell_m).astype(int)
    index = index[((index >= 0) & (index < plane.occupied.shape)).all(axis=1)]
    hit = np.zeros(plane.occupied.shape, dtype=bool)
    hit[tuple(index.T)] = True
    return float((hit & plane.occupied).sum() / max(1, plane.occupied.sum()))


def joined(
    planes: Sequence[Plane],
    levels: Sequence[Plane],
    *,
    offset_m: float = 0.008,
    up_m2: float = 0.3,
    down_m2: float = 2.0,
) -> list[Plane]:
    """``planes`` and ``levels`` with pieces of one plane united; new planes need an area of ``up_m2``, or ``down_m2``
    where they face down (seen from below, stripes on a wall pass for a soffit)."""
    result = list(planes)
    for level in sorted(levels, key=lambda p: -p.area()):
        twin = next(
            (
                k
                for k, p in enumerate(result)
                if p.normal @ level.normal > np.cos(np.radians(1.0))
                and np.abs(p.distance(level.cells())).mean() < offset_m
            ),
            None,
        )
        if twin is None:
            result.append(level)
        else:
            result[twin] = _united(result[twin], level)
    least = [0.0] * len(planes) + [up_m2 if p.normal[2] > 0 else down_m2 for p in result[len(planes) :]]
    return [p for p, area in zip(result, least, strict=True) if p.area() >= area]


def _united(plane: Plane, other: Plane) -> Plane:
    uv = np.concatenate([plane.to_plane(plane.cells()), plane.to_plane(other.cells())])
    cell = plane.cell_m
    index = np.round((uv - plane.corner) / cell - 0.5).astype(int)
    low = index.min(axis=0)
    occupied = np.zeros(index.max(axis=0) - low + 1, dtype=bool)
    occupied[tuple((index - low).T)] = True
    return replace(plane, corner=plane.corner + low * cell, occupied=_closed(occupied))


def _settled(
    mask: np.ndarray,
    z: float,
    corner: np.ndarray,
    cell_m: float,
    normal: np.ndarray,
    axes: np.ndarray,
    photos: Photos,
    surface: Any,
) -> Plane | None:
    """The plane of a piece found near height ``z``, at the height where its photos agree best (to 5 mm)."""
    cells = np.argwhere(mask)
    centres = np.zeros((len(cells), 3))
    centres[:, :2] = corner + (cells + 0.5) * cell_m
    centres[:, 2] = z
    normals = np.broadcast_to(normal, centres.shape)
    seen = visible_from(surface, centres, normals, photos.cameras, clearance_m=0.05)
    views = choose_views(centres, normals, seen, photos.cameras)
    steps = np.arange(-0.05, 0.0501, 0.005)
    scores = []
    for step in steps:
        centres[:, 2] = z + step
        scores.append(float(photos.agreement(centres, axes, views)[0].mean()))
    best = int(np.argmax(scores))
    if best in (0, len(steps) - 1) or scores[best] < 0.5:
        return None
    a, b, c = scores[best - 1 : best + 2]
    z = z + steps[best] + 0.005 * 0.5 * (a - c) / min(a - 2 * b + c, -1e-9)
    # In the plane's own axes: for a level plane they are x and +-y.
    uv = centres[:, :2] * np.array([axes[0][0], axes[1][1]])
    first = uv.min(axis=0) - 0.5 * cell_m
    index = np.round((uv - first) / cell_m - 0.5).astype(int)
    occupied = np.zeros(index.max(axis=0) + 1, dtype=bool)
    occupied[tuple(index.T)] = True
    return Plane(
        normal,
        float(z * normal[2]),
        np.zeros(0, dtype=np.int64),
        0.005,
        axes,
        first,
        cell_m,
        _closed(occupied),
    )


def _padded(plane: Plane, cells: int) -> Plane:
    return replace(
        plane, occupied=np.pad(plane.occupied, cells), corner=np.asarray(plane.corner) - cells * plane.cell_m
    )


def _majority(mask: np.ndarray, of_nine: int) -> np.ndarray:
    padded = np.pad(mask, 1).astype(int)
    a, b = mask.shape
    return mask & (sum(padded[i : i + a, j : j + b] for i in range(3) for j in range(3)) >= of_nine)


def _closed(mask: np.ndarray) -> np.ndarray:
    grown = np.pad(mask, 1)
    return (~dilate(~dilate(grown, 1), 1))[1:-1, 1:-1] | mask


def _labels(mask: np.ndarray) -> np.ndarray:
    """Connected pieces (four neighbours) numbered from 1, by spreading the largest number."""
    label = np.where(mask, np.arange(1, mask.size + 1).reshape(mask.shape), 0)
    while True:
        padded = np.pad(label, 1)
        spread = np.max(
            [padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:], label], axis=0
        )
        spread = np.where(mask, spread, 0)
        if (spread == label).all():
            return label
        label = spread


def _pieces(mask: np.ndarray, smallest: int) -> np.ndarray:
    label = _labels(mask)
    values, counts = np.unique(label[label > 0], return_counts=True)
    return np.isin(label, values[counts >= smallest])


def _split(mask: np.ndarray) -> list[np.ndarray]:
    label = _labels(mask)
    return [label == v for v in np.unique(label[label > 0])]
