"""Planes that photos prove though few features lie on them: by sweeping patches through space and comparing photos.

Features are rare on surfaces seen at a grazing angle: floors, seats, table tops. A small patch at the right height
shows the same texture in all photos that see it, at a wrong height it does not (Collins, "A space-sweep approach to
true multi-image matching", 1996). The same test extends a known plane beyond its features and cuts it where it ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from scipy import ndimage

from warprrf.device import launch
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.gaussians.cells import contested, pieces, plane_mesh, visible_from
from warprrf.geometry.photos.posed.images import GreyPhotos, projections
from warprrf.geometry.planes import AROUND, Plane, dilate
from warprrf.geometry.splats.camera import Camera
from warprrf.kernels.photo_consistency import SIDE, patch_agreement
from warprrf.rows import distinct_rows

VIEWS = 5  # photos compared
MIN_ANGLE_DEG = 6.0  # between any two of them, seen from the patch: without parallax every height fits
AGREES, DISAGREES = 0.6, 0.25  # mean correlation of a true patch, and of one that is certainly not
CONTRAST = 0.012  # patches flatter than this part of white prove nothing
FINE_M = 0.005  # a plane's height is settled in steps of this length


def agreement_of(
    photos: GreyPhotos, centres: np.ndarray, axes: np.ndarray, views: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Correlation in [-1, 1] and contrast of the patches at ``centres`` (N, 3) over ``views`` (N, V), -1 padded."""
    n, device = len(centres), photos.device
    result, contrast = (wp.zeros(n, dtype=wp.float32, device=device) for _ in range(2))
    patch_m = 0.12  # side of a patch
    patch = [centres, *(wp.vec3(*axis) for axis in axes), patch_m / (SIDE - 1)]
    images = [projections(photos.cameras), photos.flat, photos.sizes]
    launch(patch_agreement, n, [*patch, views, *images, result, contrast], device=device)
    return result.numpy(), contrast.numpy()


def choose_views(
    surface: Mesh | None,
    points: np.ndarray,
    normal: np.ndarray,
    cameras: Sequence[Camera],
    clearance_m: float = 0.05,
) -> np.ndarray:
    """For each point on a plane of this ``normal`` the photos that show it largest among those that see it past ``surface``
    (see :func:`visible_from`), no two from nearly the same direction.

    Returns:
        Camera indices, shape ``(N, VIEWS)`` int32, -1 padded.
    """
    seen = visible_from(surface, points, normal, cameras, clearance_m)
    line = np.array([c.position for c in cameras])[None] - points[:, None]
    distance = np.linalg.norm(line, axis=2)
    line /= np.maximum(distance, 1e-9)[..., None]
    worth = np.where(seen, line @ normal / distance**2, -1.0)  # pixels on a square metre
    chosen = np.full((len(points), VIEWS), -1, dtype=np.int32)
    rows = np.arange(len(points))
    for k in range(VIEWS):
        best = worth.argmax(axis=1)
        good = worth[rows, best] > 0
        chosen[good, k] = best[good]
        close = np.einsum("nci,ni->nc", line, line[rows, best]) > np.cos(np.radians(MIN_ANGLE_DEG))
        worth = np.where(close, -1.0, worth)
    return chosen


@dataclass(frozen=True)
class _Scored:
    """A plane with all cells that might be its own, and for each of them, on the grid: whether it was occupied before,
    how well photos agree on it (NaN: nothing proved), whether any sees it, and whether a point of the plane lies there.
    """

    plane: Plane
    before: np.ndarray
    score: np.ndarray
    visible: np.ndarray
    own: np.ndarray


def proven_cells(planes: Sequence[Plane], points: np.ndarray, photos: GreyPhotos) -> list[Plane]:
    """``planes`` with their cells corrected by the photos: extended (large planes far, others little) where the photos
    agree, emptied where they disagree and no point of the plane is near. Of two parallel planes close to each other,
    such as a sign and its wall, the one that the photos agree on more has the cell."""
    surface = plane_mesh(planes)
    scored = [_scored(plane, surface, points, photos) for plane in planes]
    result = []
    for k, this in enumerate(scored):
        with np.errstate(invalid="ignore"):
            yes, no = this.score > AGREES, this.score < DISAGREES
        lost, taken = _rivals(this, scored[:k] + scored[k + 1 :])
        grown = _majority(yes, 5) & ~this.before & ~taken
        kept = this.before & ~(_majority(no, 3) & ~dilate(this.own, 1)) & ~lost
        attached = pieces(grown | kept, 6) & grown
        result.append(replace(this.plane, occupied=(kept | attached) & this.visible))
    return result


def _scored(plane: Plane, surface: Mesh | None, points: np.ndarray, photos: GreyPhotos) -> _Scored:
    reach_m, large_m2 = 2.5, 3.0  # a plane of this area is extended at most so far
    reach = int(round(reach_m / plane.cell_m)) if plane.area() >= large_m2 else 2
    wide = plane.widened(reach)
    full = replace(wide, occupied=dilate(wide.occupied, reach))
    middle, group = _blocks(full, 2)  # photos are chosen once for each
    views = choose_views(surface, middle, full.normal, photos.cameras)[group]
    agreement, contrast = agreement_of(photos, full.cells(), full.axes, views)
    score = np.full(full.occupied.shape, np.nan)
    score[full.occupied] = np.where((contrast > CONTRAST) & (views[:, 1] >= 0), agreement, np.nan)
    visible = np.zeros_like(full.occupied)
    visible[full.occupied] = views[:, 0] >= 0
    return _Scored(full, wide.occupied, score, visible, full.count(points[plane.inliers]) > 0)


def _blocks(plane: Plane, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Middles of the blocks of ``side`` x ``side`` cells of a plane, and the block of each occupied cell."""
    blocks = np.argwhere(plane.occupied) // side
    first, group, _ = distinct_rows(blocks)
    return plane.to_world(plane.corner + (blocks[first] + 0.5) * side * plane.cell_m), group


def _rivals(this: _Scored, others: Sequence[_Scored]) -> tuple[np.ndarray, np.ndarray]:
    """Cells that a parallel plane close by has the better claim to, and cells that one holds already."""
    plane = this.plane
    lost, taken = (np.zeros_like(this.before) for _ in range(2))
    unproven = 0.3  # what photos that prove nothing count as, between agreement and disagreement
    cells, mine = plane.cells(), np.nan_to_num(this.score[plane.occupied], nan=unproven)
    for other in others:
        place, _ = other.plane.cell_of(cells)
        held = contested(plane, other.plane, cells, other.before)
        better = (np.nan_to_num(other.score[place], nan=unproven) > mine) | other.own[place]
        lost[plane.occupied] |= held & better
        taken[plane.occupied] |= held
    return lost & ~this.own, taken


def level_planes(
    planes: Sequence[Plane],
    points: np.ndarray,
    photos: GreyPhotos,
    lines: tuple[np.ndarray, np.ndarray],
    *,
    cell_m: float = 0.1,
    up: bool = True,
) -> list[Plane]:
    """Horizontal planes (z is up) that photos prove and ``planes`` lack: seats, table tops, platforms, soffits.

    Args:
        lines: lines of sight from cameras to points, shape ``(L, 3)`` each: what they cross is no surface.
        up: surfaces that face up; else those that face down.
    """
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    eyes = np.array([c.position[2] for c in photos.cameras])
    bottom, top = (low[2], min(high[2], eyes.max())) if up else (max(low[2], eyes.min()), high[2])
    step_m = 0.03  # between heights of the sweep; a patch shows a shift of that much
    levels = np.arange(bottom - 0.06, top + 0.06, step_m)
    if len(levels) < 3:
        return []
    level = Plane(np.array([0.0, 0.0, 1.0 if up else -1.0]), 0.0, rms_m=FINE_M, cell_m=cell_m)
    ends = level.to_plane(np.array([low, high]))
    whole = level.spanning(ends.min(axis=0), ends.max(axis=0) + cell_m)
    surface = plane_mesh(planes)
    agreement, known = _swept(whole, levels, surface, photos, planes)
    peak = _peaks(agreement) & ~known
    found: list[Plane] = []
    min_cells = 15  # of a plane found by the sweep
    while True:
        votes = ndimage.convolve1d(peak.sum(axis=(1, 2)), [1, 1, 1], mode="constant")
        k = int(votes.argmax())
        if votes[k] < min_cells:
            return found
        band = slice(max(0, k - 1), k + 2)
        mask = peak[band].any(axis=0)
        peak[max(0, k - 2) : k + 3] &= ~mask
        mask |= dilate(mask, 1) & (agreement[band].max(axis=0) > 0.8 * AGREES)
        label, count = ndimage.label(pieces(mask, min_cells))
        for number in range(1, count + 1):  # every connected piece has a height of its own
            piece = replace(whole, offset=float(levels[k] * whole.normal[2]), occupied=label == number)
            settled = _settled(piece, surface, photos)
            if settled is not None:
                crossed = (settled.seen_through(*lines, 0.05) > 0) & settled.occupied
                if crossed.sum() < 0.2 * settled.occupied.sum():
                    found.append(settled)


def _swept(
    whole: Plane, levels: np.ndarray, surface: Mesh | None, photos: GreyPhotos, planes: Sequence[Plane]
) -> tuple[np.ndarray, np.ndarray]:
    """Agreement of the photos at every level and cell, -1 where nothing is proved, and whether one of ``planes`` is there;
    shape ``(levels, A, B)`` each.

    Photos are chosen once for blocks of 3 x 3 cells and 3 levels.
    """
    middle, group = _blocks(whole, 3)
    cells, alike = whole.cells(), [plane for plane in planes if plane.normal @ whole.normal > 0.99]
    agreement = np.full((len(levels), len(cells)), -1.0, dtype=np.float32)
    known = np.zeros(agreement.shape, dtype=bool)
    for k, z in enumerate(levels):
        if k % 3 == 0:
            middle[:, 2] = levels[min(k + 1, len(levels) - 1)]
            views = choose_views(surface, middle, whole.normal, photos.cameras, clearance_m=0.03)[group]
            some = np.flatnonzero(views[:, 2] >= 0)  # three photos at least
        cells[:, 2] = z
        value, contrast = agreement_of(photos, cells[some], whole.axes, views[some])
        agreement[k, some] = np.where(contrast > CONTRAST, value, -1.0)
        for plane in alike:
            known[k] |= plane.holds(cells, 0.05)
    shape = len(levels), *whole.occupied.shape
    return agreement.reshape(shape), known.reshape(shape)


def _peaks(agreement: np.ndarray) -> np.ndarray:
    """Where a surface shows as a clear peak along the vertical."""

    def around(*steps: int) -> np.ndarray:
        footprint = np.isin(np.arange(-4, 5), steps)[:, None, None]
        return ndimage.maximum_filter(agreement, footprint=footprint, mode="constant", cval=-1.0)

    return (agreement > AGREES) & (agreement >= around(-1, 1)) & (agreement > around(-4, -3, 3, 4) + 0.15)


def _settled(piece: Plane, surface: Mesh | None, photos: GreyPhotos) -> Plane | None:
    """A horizontal piece moved to the height where its photos agree best; None where no height within 5 cm does."""
    centres = piece.cells()
    z = piece.offset * piece.normal[2]
    views = choose_views(surface, centres, piece.normal, photos.cameras)
    steps = np.arange(-0.05, 0.0501, FINE_M)
    moved = [centres + [0, 0, step] for step in steps]
    scores = [float(agreement_of(photos, place, piece.axes, views)[0].mean()) for place in moved]
    best = int(np.argmax(scores))
    if best in (0, len(steps) - 1) or scores[best] < 0.5:
        return None
    a, b, c = scores[best - 1 : best + 2]
    z += steps[best] + FINE_M * 0.5 * (a - c) / min(a - 2 * b + c, -1e-9)  # top of the parabola
    return replace(piece, offset=float(z * piece.normal[2]), occupied=_closed(piece.occupied))


def joined(planes: Sequence[Plane], levels: Sequence[Plane]) -> list[Plane]:
    """``planes`` and ``levels`` with pieces of one plane united; new planes need a least area, a larger one where they
    face down (seen from below, stripes on a wall pass for a soffit)."""
    result = united(planes, levels)
    up_m2, down_m2 = 0.3, 2.0  # least area of a new plane that faces up, or down
    new = [p for p in result[len(planes) :] if p.area() >= (up_m2 if p.normal[2] > 0 else down_m2)]
    return result[: len(planes)] + new


def united(planes: Sequence[Plane], others: Sequence[Plane]) -> list[Plane]:
    """``planes`` and ``others``, the largest first; those that one before them describes as well only add cells to it."""
    result = list(planes)
    same_plane_m, same_plane_deg = 0.02, 3.0  # what lies this close to a larger plane is part of it
    for other in sorted(others, key=lambda p: -p.area()):
        cells = other.cells()
        for k, plane in enumerate(result):
            near = np.abs(plane.distance(cells)).sum() < same_plane_m * len(cells)
            if near and plane.normal @ other.normal > np.cos(np.radians(same_plane_deg)):
                result[k] = _united(plane, other)
                break
        else:
            result.append(other)
    return result


def _united(plane: Plane, other: Plane) -> Plane:
    centres = np.concatenate([plane.cells(), other.cells()])
    index = np.round((plane.to_plane(centres) - plane.corner) / plane.cell_m - 0.5).astype(int)
    low = index.min(axis=0)
    occupied = np.zeros(index.max(axis=0) - low + 1, dtype=bool)
    occupied[tuple((index - low).T)] = True
    return replace(plane, corner=plane.corner + low * plane.cell_m, occupied=_closed(occupied))


def _majority(mask: np.ndarray, of_nine: int) -> np.ndarray:
    """Cells of ``mask`` that belong to at least so many with their neighbours, themselves counted."""
    return mask & (ndimage.convolve(mask.astype(int), AROUND.astype(int), mode="constant") >= of_nine)


def _closed(mask: np.ndarray) -> np.ndarray:
    """``mask`` with gaps of up to two cells closed."""
    return ndimage.binary_closing(np.pad(mask, 2), AROUND)[2:-2, 2:-2] | mask
