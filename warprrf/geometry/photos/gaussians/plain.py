"""Plain surfaces: walls, ceilings and pillars without features, found from their edges.

Nothing can be matched on bare paint, but a plain region of a photo ends at edges, and edges can be placed in space
(:mod:`warprrf.geometry.photos.gaussians.edges`). A region lies on the plane that most of its border lies on; an edge behind that
plane speaks against it, an edge before it belongs to what stands there (in the spirit of Furukawa et al.,
"Manhattan-world stereo", 2009). A single photo can be wrong: the cells of a plane count the photos that put them on it
and those that see through them. What is seen through a pane alone and has its twin before it is a reflection.

Within this module cameras, lines and cells are in the room's frame, whose axes are its three directions. Metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from warprrf.device import threads
from warprrf.geometry.photos.gaussians.cells import BEHIND_M as SEEN_BEHIND_M
from warprrf.geometry.photos.gaussians.cells import contested, pieces, quarters
from warprrf.geometry.photos.gaussians.edges import (
    EDGE_DEG,
    FARTHEST_M,
    SEGMENT_PX,
    Edgels,
    Line,
    find_edgels,
    find_lines,
    lines_through,
)
from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.planes import Plane, dilate
from warprrf.geometry.splats.camera import Camera

SURE_VIEWS, LINE_M = 4, 0.4  # photos and length from which on an edge counts
FLAT, PLAIN_PX = 0.006, 7  # a pixel is plain where none in a square of this side changes by more than this
SAME_M = 0.04  # an edge this close to a plane lies on it
BEHIND_M = 0.15  # an edge, or a surface, this far behind a plane is behind it
STRIDE, CELL_M = 4, 0.1  # cells, of this side, look up every so many-th pixel


class Height(NamedTuple):
    """A plane across one of the directions, on which edges lie: direction, place along it [m], their weight, and the
    box that they span, shape ``(2, 3)`` [m]."""

    axis: int
    height: float
    weight: float
    bounds: np.ndarray


@dataclass(frozen=True)
class Pane:
    """A mirror: the rectangle ``low`` to ``high`` (both shape ``(3,)`` [m]) of the plane ``height`` across ``axis``, and
    on which side of it the room is."""

    axis: int
    height: float
    side: int
    low: np.ndarray
    high: np.ndarray

    def between(self, eyes: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Which lines of sight ``(L, 3)`` to ``(L, 3)`` go from the room through the pane, shape ``(L,)`` bool."""
        before = self.side * (eyes[:, self.axis] - self.height)
        behind = self.side * (targets[:, self.axis] - self.height)
        crossing = (before > 0) & (behind < -0.1)
        share = np.where(crossing, before / np.where(crossing, before - behind, 1.0), 0.0)[:, None]
        at = eyes + share * (targets - eyes)
        across = np.arange(3) != self.axis
        return crossing & ((at >= self.low) & (at <= self.high))[:, across].all(axis=1)


def plain_surfaces(
    photos: PosedPhotos, axes: np.ndarray, sight: tuple[np.ndarray, np.ndarray]
) -> tuple[list[Plane], np.ndarray]:
    """Planes without features that photos prove by their edges, with the cells where photos agree on them; and which lines
    of sight end on what a mirror shows, shape ``(L,)`` bool.

    Args:
        axes: three perpendicular directions of the room, unit rows, right-handed, shape ``(3, 3)``.
        sight: lines of sight, from eyes to points, shape ``(L, 3)`` each.
    """
    turn, images = np.eye(4), photos.images
    turn[:3, :3] = axes.T
    cameras = [replace(c, world_to_camera=c.world_to_camera @ turn) for c in photos.cameras]
    eyes, targets = (ends @ axes.T for ends in sight)
    reflected = np.zeros(len(eyes), dtype=bool)
    some = images[:: -(-len(images) // 12)]
    # 0.33: of less plain photos features show the surfaces (share of plain pixels: plain lobby 0.5, a filmed lounge 0.26)
    if np.mean([_plain(find_edgels(image)).mean() for image in some]) < 0.33:
        return [], reflected
    with ThreadPoolExecutor(threads()) as pool:
        edgels = list(pool.map(find_edgels, images))
        plain = list(pool.map(_plain, edgels))
    lines = find_lines(cameras, images, edgels)
    lines = [x for x in lines if len(x.views) >= SURE_VIEWS and x.high - x.low >= LINE_M]
    panes, lines = _mirrors(lines, cameras)
    for pane in panes:
        reflected |= pane.between(eyes, targets)
    heights = _heights(lines)
    if not heights:
        return [], reflected
    on_planes = partial(_regions_on, heights, lines, _traced(lines), panes)
    with ThreadPoolExecutor(threads()) as pool:
        seen = list(pool.map(on_planes, cameras, edgels, plain))
    planes = [
        plane
        for number in np.unique(np.concatenate([plane[plane >= 0] for plane, _ in seen])).tolist()
        for side in (1, -1)
        for plane in _agreed(number, side, heights, cameras, seen)
    ]
    return [_in_world(plane, axes) for plane in planes], reflected


def _plain(edgels: Edgels) -> np.ndarray:
    """The pixels of a photo near which nothing changes, shape ``(H, W)`` bool."""
    return ndimage.maximum_filter(edgels.strength, PLAIN_PX) < FLAT


def _heights(lines: Sequence[Line]) -> list[Height]:
    """Planes that the lines lie on, one for lines closer than ``SAME_M``, the best supported first."""
    result = []
    for axis in range(3):
        own = [line for line in lines if line.axis != axis]
        place = np.array([line.height(axis) for line in own])
        weight, ends = np.array([line.weight for line in own]), np.array([line.ends for line in own])
        left = np.ones(len(own), dtype=bool)
        while left.any():
            near = (np.abs(place[:, None] - place) < SAME_M) & left & left[:, None]
            k = int((near @ weight).argmax())
            group = near[k]
            middle = float(np.average(place[group], weights=weight[group]))
            group = left & (np.abs(place - middle) < SAME_M) | group
            bounds = np.stack([ends[group].min(axis=(0, 1)), ends[group].max(axis=(0, 1))])
            result.append(Height(axis, middle, float(weight[group].sum()), bounds))
            left &= ~group
    return sorted(result, key=lambda h: -h.weight)


def _mirrors(lines: list[Line], cameras: Sequence[Camera]) -> tuple[list[Pane], list[Line]]:
    """Panes that show a reflection, and the lines that are none."""
    positions = np.array([camera.position for camera in cameras])
    panes: list[Pane] = []
    # a pane is a mirror when so much of what is seen through it alone has its twin before it,
    mirror_share = 0.5
    mirror_m = 10.0  # by length times views, which must come to this [m]
    for axis, height, _, (low, high) in _heights(lines):
        if np.delete(high - low, axis).min() < LINE_M:  # a pane has edges on several sides
            continue
        for side in (1, -1):
            pane = Pane(axis, height, side, low - 0.1, high + 0.1)
            parts = [part for x in lines for part in _parted(pane, x)]
            through = _only_through(pane, parts, positions)
            shown = [x for x, only in zip(parts, through, strict=True) if only]
            total = sum(x.weight for x in shown)
            twins = sum(x.weight for x in shown if _has_twin(pane, x, parts))
            behind = sum(x.weight for x in parts if side * (x.ends.mean(axis=0)[axis] - height) < -0.1)
            # A mirror bounds the room: what lies behind it is seen through it alone.
            if total > max(mirror_m, 0.8 * behind) and twins > mirror_share * total:
                panes.append(pane)
                lines = [x for x, only in zip(parts, through, strict=True) if not only]
    return panes, lines


def _parted(pane: Pane, line: Line) -> list[Line]:
    """A line cut where it goes through the plane of a pane: its reflection carries it on."""
    if line.axis != pane.axis or min(pane.height - line.low, line.high - pane.height) < 0.3:
        return [line]
    return [replace(line, high=pane.height), replace(line, low=pane.height)]


def _only_through(pane: Pane, lines: Sequence[Line], positions: np.ndarray) -> np.ndarray:
    """Of which lines nearly all is seen through the pane alone, shape ``(L,)`` bool."""
    points = np.array([line.points(np.linspace(line.low, line.high, 7)[1:-1]) for line in lines])
    views = [len(line.views) for line in lines]
    eyes = positions[np.concatenate([line.views for line in lines])]
    targets = np.repeat(points, views, axis=0)
    crossing = pane.between(np.repeat(eyes, points.shape[1], axis=0), targets.reshape(-1, 3))
    share = np.bincount(np.repeat(np.arange(len(lines)), views), crossing.reshape(len(eyes), -1).mean(axis=1))
    return share > 0.8 * np.array(views)


def _has_twin(pane: Pane, line: Line, lines: Sequence[Line]) -> bool:
    """Whether the mirror image of a line is a line too, for half of its length at least."""
    low, high, at = line.low, line.high, line.at.copy()
    if line.axis == pane.axis:
        low, high = 2 * pane.height - high, 2 * pane.height - low
    else:
        k = (pane.axis - line.axis) % 3 - 1
        at[k] = 2 * pane.height - at[k]
    alike = [x for x in lines if x.axis == line.axis and np.abs(x.at - at).max() < 2 * SAME_M]
    overlap = sum(max(0.0, min(high, x.high) - max(low, x.low)) for x in alike)
    return overlap > 0.5 * (high - low)


def _regions_on(
    heights: Sequence[Height],
    lines: Sequence[Line],
    traced: tuple[np.ndarray, np.ndarray],
    panes: Sequence[Pane],
    camera: Camera,
    edgels: Edgels,
    plain: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The plain regions of a photo, each on the plane that its border votes for, every so many-th pixel: number of the
    plane or -1, and range [m] or 0."""
    of_line, barrier = _shown(lines, traced, camera, edgels)
    region, count = ndimage.label(plain & ~ndimage.binary_dilation(barrier, np.ones((3, 3))))
    size = np.bincount(region.ravel(), minlength=count + 1)
    size[0] = 0
    region_px, votes_px = 150, 25.0  # fewest pixels of a plain region, and of its border on a plane
    region = np.where(size[region] >= region_px, region, 0)
    votes = _votes(heights, lines, camera, edgels, of_line, region)
    some = slice(STRIDE // 2, None, STRIDE)
    region, rays = region[some, some], camera.directions()[some, some]
    plane, ranges = np.full(region.shape, -1), np.zeros(region.shape)
    for k in np.flatnonzero(votes.max(axis=1) >= votes_px):
        own = region == k
        if not own.any():
            continue
        rivals = []
        # 0.8: of the planes with at least this share of the most votes, the nearest has the region
        for number in np.flatnonzero(votes[k] >= 0.8 * votes[k].max()).tolist():
            axis, height, weight, _ = heights[number]
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (height - camera.position[axis]) / rays[own][:, axis]
            good = (t > 0.1) & (t < FARTHEST_M)
            hits = camera.position + np.where(good, t, 0.0)[:, None] * rays[own]
            eyes = np.broadcast_to(camera.position, hits.shape)
            for pane in panes:
                good &= ~pane.between(eyes, hits)
            if good.mean() > 0.98:
                score = votes[k, number] * weight
                rivals.append((float(np.median(t[good])), score, number, np.where(good, t, 0.0)))
        if rivals:
            nearest = min(rivals, key=lambda r: r[0])[0]
            best = max((r for r in rivals if r[0] < nearest + BEHIND_M), key=lambda r: r[1])
            plane[own], ranges[own] = np.where(best[3] > 0, best[2], -1), best[3]
    return plane, ranges


def _shown(
    lines: Sequence[Line], traced: tuple[np.ndarray, np.ndarray], camera: Camera, edgels: Edgels
) -> tuple[np.ndarray, np.ndarray]:
    """The line that each edgel lies on (-1: none), and the pixels that part regions: lines, where enough of them shows
    in whole, else their shown parts with gaps bridged."""
    place = np.full(edgels.strength.shape, -1)
    x, y = edgels.position.astype(int).T
    place[y, x] = np.arange(len(edgels.position))
    off, (row, column) = ndimage.distance_transform_edt(place < 0, return_indices=True)
    of_line, barrier = np.full(len(edgels.position), -1), np.zeros(place.shape, dtype=bool)
    points, number = traced
    inside, pixels = camera.in_frame(points, 0.1)
    steps = np.c_[number[inside], pixels[inside]]
    number, y, x = steps[np.diff(steps, axis=0, prepend=-1).any(axis=1)].T
    near = place[row[y, x], column[y, x]]
    axis = np.array([line.axis for line in lines])[number]
    direction = lines_through(camera, np.stack([x, y], axis=1) + 0.5, axis)[1]
    straight = np.abs((edgels.across[near] * direction).sum(axis=1)) < np.sin(np.radians(2 * EDGE_DEG))
    shown = (off[y, x] < 3.5) & straight
    for own in np.split(np.arange(len(x)), np.flatnonzero(np.diff(number)) + 1):
        on = shown[own]
        if on.sum() < SEGMENT_PX / 2:
            continue
        of_line[near[own[on]]] = number[own[0]]
        # 0.15: where so much of an edge shows in a photo, all of it parts regions
        if on.mean() < 0.15:
            on = ndimage.binary_closing(np.pad(on, 40), np.ones(40))[40:-40]
            own = own[on]
        barrier[y[own], x[own]] = True
    return of_line, barrier


def _traced(lines: Sequence[Line]) -> tuple[np.ndarray, np.ndarray]:
    """Points along all lines, a centimetre apart, shape ``(N, 3)``; and the number of the line of each, ``(N,)``."""
    points = [x.points(np.linspace(x.low, x.high, int((x.high - x.low) / 0.01) + 2)) for x in lines]
    return np.concatenate(points), np.repeat(np.arange(len(lines)), [len(p) for p in points])


def _votes(
    heights: Sequence[Height],
    lines: Sequence[Line],
    camera: Camera,
    edgels: Edgels,
    of_line: np.ndarray,
    region: np.ndarray,
) -> np.ndarray:
    """For each region and plane: edgels of the border on the plane less those behind it, shape ``(regions, planes)``."""
    on = np.flatnonzero(of_line >= 0)
    beside = np.zeros((2, len(on)), dtype=int)  # on either side of an edgel
    for found, side in zip(beside, (1, -1), strict=True):
        for step in range(3, 12):  # pixels: where the smoothing and the square of a plain pixel end
            x, y = (edgels.position[on] + side * step * edgels.across[on]).astype(int).T
            ok = (found == 0) & (x >= 0) & (y >= 0) & (y < region.shape[0]) & (x < region.shape[1])
            found[ok] = region[y[ok], x[ok]]
    edgel, beside = np.tile(on, 2)[beside.ravel() > 0], beside[beside > 0]
    votes = np.zeros((region.max() + 1, len(heights)))
    places = np.array([[line.height(a) if a != line.axis else np.nan for a in range(3)] for line in lines])
    place, axis = places[of_line[edgel]], np.array([line.axis for line in lines])[of_line[edgel]]
    rays = lines_through(camera, edgels.position[edgel], 0)[0]
    across = np.arange(3) != axis[:, None]
    line_at = np.linalg.norm(np.where(across, place - camera.position, 0.0), axis=1)
    line_at /= np.maximum(np.linalg.norm(np.where(across, rays, 0.0), axis=1), 1e-9)
    for number, (a, height, *_) in enumerate(heights):
        with np.errstate(divide="ignore", invalid="ignore"):
            lies_on = np.abs(place[:, a] - height) < SAME_M
            plane_at = (height - camera.position[a]) / rays[:, a]
            behind = ~lies_on & (plane_at > 0) & (line_at > 1.03 * plane_at + 0.1)
        score = lies_on.astype(float) - behind
        votes[:, number] = np.bincount(beside, score, len(votes))
    return votes


def _agreed(
    number: int,
    side: int,
    heights: Sequence[Height],
    cameras: Sequence[Camera],
    seen: Sequence[tuple[np.ndarray, np.ndarray]],
) -> list[Plane]:
    """The plane with the cells that more photos put on it than see through it; none where those are few. ``seen`` is what
    :func:`_regions_on` found in each photo."""
    axis, height, _, bounds = heights[number]
    some = STRIDE // 2
    photos = [x for x in zip(cameras, seen, strict=True) if side * (x[0].position[axis] - height) > 0.1]
    found = [np.zeros((0, 3))]
    for camera, (planes, ranges) in photos:
        own = planes == number
        y, x = np.nonzero(own)
        rays = lines_through(camera, np.stack([x, y], axis=1) * STRIDE + some + 0.5, axis)[0]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        found.append(camera.position + ranges[own][:, None] * rays)
    hits = np.concatenate(found)
    if not len(hits):
        return []
    empty = Plane(side * np.eye(3)[axis], side * height, cell_m=CELL_M, plain=True)
    uv = empty.to_plane(hits)
    edges = empty.to_plane(bounds)  # a surface ends where its edges do
    low = np.maximum(uv.min(axis=0), edges.min(axis=0) - CELL_M)
    high = np.minimum(uv.max(axis=0), edges.max(axis=0) + CELL_M)
    if (low >= high).any():
        return []
    plane = empty.spanning(np.floor(low / CELL_M - 1) * CELL_M, high + CELL_M)
    cells = plane.cells()
    yes, no = (np.zeros(len(cells), dtype=int) for _ in range(2))
    for camera, (planes, ranges) in photos:
        inside, pixels = camera.in_frame(cells, 0.1)
        own = np.flatnonzero(inside)
        y, x = pixels[own].T // STRIDE
        y, x = np.minimum(y, planes.shape[0] - 1), np.minimum(x, planes.shape[1] - 1)
        here = planes[y, x] == number
        away = np.linalg.norm(cells[own] - camera.position, axis=1)
        yes[own] += here
        no[own] += ~here & (ranges[y, x] > away + BEHIND_M)
    # fewest photos that put a cell on its plane, and fewest cells of a piece of one: 0.1 square metres
    agreeing, piece_cells = 2, 10
    occupied = pieces(((yes >= agreeing) & (yes > no)).reshape(plane.occupied.shape), piece_cells)
    return [replace(plane, occupied=occupied)] if occupied.any() else []


def _in_world(plane: Plane, axes: np.ndarray) -> Plane:
    """A plane of the room's frame in the world's, on a grid of its own."""
    points = quarters(plane).reshape(-1, 3) @ axes
    turned = replace(plane, normal=plane.normal @ axes)
    uv = turned.to_plane(points)
    grid = turned.spanning(np.floor(uv.min(axis=0) / CELL_M) * CELL_M, uv.max(axis=0) + CELL_M)
    return replace(grid, occupied=grid.count(points) >= 2)


def with_plain(
    planes: Sequence[Plane],
    plain: Sequence[Plane],
    points: np.ndarray,
    sight: tuple[np.ndarray, np.ndarray],
) -> list[Plane]:
    """``planes`` and ``plain`` ones, each cell with one of them: of planes that face alike and lie closer than
    ``CONTESTED_M``, the one with points of its own there has it, else the plain one.

    Args:
        points: that the inliers of ``planes`` index, shape ``(P, 3)``.
        sight: lines of sight, from eyes to points, shape ``(L, 3)`` each: plain cells that some cross are none.
    """
    plain = [replace(p, occupied=p.occupied & (p.seen_through(*sight, SEEN_BEHIND_M) < 2)) for p in plain]
    theirs = []
    for plane in planes:
        own = dilate(plane.count(points[plane.inliers]) > 0, 1)
        theirs.append(replace(plane, occupied=plane.occupied & (own | ~_covered(plane, plain))))
    mine = [replace(p, occupied=p.occupied & ~_covered(p, theirs)) for p in plain]
    return theirs + [plane for plane in mine if plane.occupied.any()]


def _covered(plane: Plane, others: Sequence[Plane]) -> np.ndarray:
    """Which cells of the grid lie close to a cell of ``others`` that faces alike, shape of ``occupied``."""
    cells = plane.cells(np.ones_like(plane.occupied))
    covered = np.zeros(len(cells), dtype=bool)
    for other in others:
        covered |= contested(plane, other, cells)
    return covered.reshape(plane.occupied.shape)
