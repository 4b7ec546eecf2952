"""Which cells of a plane hold a surface: where its points lie, where nobody looks through, where planes meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.planes import Plane, PlaneConfig, dilate
from warprrf.geometry.splats.camera import Camera

BEHIND_M = 0.1  # a line of sight empties a cell when its target is more than this behind the plane
CONTESTED_M = 0.25  # of parallel planes closer than this, such as a sign and its wall, only one has a cell
PARALLEL = np.cos(np.radians(10.0))  # planes that face alike
INNER, OUTER = 0.8, 0.6  # share of them that has to be on one side


def occupancy(
    planes: Sequence[Plane],
    points: np.ndarray,
    eyes: np.ndarray,
    targets: np.ndarray,
    *,
    config: PlaneConfig,
) -> list[Plane]:
    """``planes`` with the cells where a surface may be.

    A cell is a candidate inside the convex hull of the plane's own points, widened by a margin, and empty where a
    line of sight passes through it to a point that lies well behind.

    Args:
        points: the points that the planes' ``inliers`` index, shape ``(P, 3)`` [m].
        eyes, targets: lines of sight, from a camera to a point it sees, shape ``(L, 3)`` each [m].
    """
    result = []
    for plane in planes:
        uv = plane.to_plane(points[plane.inliers])
        rim = config.margin_m + config.cell_m
        grid = replace(plane, cell_m=config.cell_m).spanning(uv.min(axis=0) - rim, uv.max(axis=0) + rim)
        inside = _in_hull(grid.to_plane(grid.cells()), uv, config.margin_m).reshape(grid.occupied.shape)
        supported = grid.count(points[plane.inliers]) > 0
        lines = grid.seen_through(eyes, targets, BEHIND_M)
        empty = dilate(lines > 0, 2) & ~dilate(supported, 1)
        empty |= (lines > 2) & ~supported
        result.append(replace(grid, occupied=inside & ~empty))
    return [_uncontested(k, result, points) for k in range(len(result))]


def _uncontested(k: int, planes: Sequence[Plane], points: np.ndarray) -> Plane:
    """Plane ``k`` without the cells that belong to a parallel plane close by, such as the wall behind a sign.

    Lines of sight cannot tell the two apart; of two planes the one with the nearest point of its own has the cell.
    """
    plane = planes[k]
    cells = plane.cells()
    uv = plane.to_plane(cells)
    own = cKDTree(plane.to_plane(points[plane.inliers])).query(uv)[0] if len(uv) else np.zeros(0)
    lost = np.zeros(len(cells), dtype=bool)
    for other in [*planes[:k], *planes[k + 1 :]]:
        both = contested(plane, other, cells)
        if both.any():
            theirs = cKDTree(plane.to_plane(points[other.inliers])).query(uv[both])[0]
            lost[both] |= theirs < own[both]
    return with_cells(plane, ~lost)


def contested(plane: Plane, other: Plane, cells: np.ndarray, held: np.ndarray | None = None) -> np.ndarray:
    """Which of the places ``cells`` (K, 3) of ``plane`` lie close to an occupied (or ``held``) cell of ``other``, which faces
    alike; shape ``(K,)`` bool."""
    if other.normal @ plane.normal < PARALLEL:
        return np.zeros(len(cells), dtype=bool)
    return other.holds(cells, CONTESTED_M, held)


def with_cells(plane: Plane, kept: np.ndarray) -> Plane:
    """``plane`` with those of its occupied cells that are ``kept``, in the order of :meth:`Plane.cells`."""
    occupied = plane.occupied.copy()
    occupied[plane.occupied] = kept
    return replace(plane, occupied=occupied)


def _in_hull(queries: np.ndarray, points: np.ndarray, margin: float) -> np.ndarray:
    """Whether 2D ``queries`` lie within ``margin`` of the convex hull of ``points``."""
    try:
        sides = ConvexHull(points).equations
    except (QhullError, ValueError):  # points on one line
        return cKDTree(points).query(queries)[0] <= margin
    return (queries @ sides[:, :2].T + sides[:, 2] <= margin).all(axis=1)


def quarters(plane: Plane) -> np.ndarray:
    """World centres of the four quarters of each occupied cell [m], shape ``(K, 4, 3)``."""
    off = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]]) * plane.cell_m
    return plane.cells()[:, None] + off @ plane.axes


def plane_mesh(planes: Sequence[Plane]) -> Mesh | None:
    """The occupied cells of all planes as one mesh of squares; None when there are none."""
    corners = []
    for plane in planes:
        cells = np.argwhere(plane.occupied)
        square = cells[:, None, :] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        corners.append(plane.to_world(plane.corner + square.reshape(-1, 2) * plane.cell_m))
    vertices = np.concatenate(corners) if corners else np.zeros((0, 3))
    first = np.arange(0, len(vertices), 4)[:, None]
    return Mesh(vertices, np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])) if len(vertices) else None


def visible_from(
    surface: Mesh | None,
    points: np.ndarray,
    normal: np.ndarray,
    cameras: Sequence[Camera],
    clearance_m: float = 0.05,
) -> np.ndarray:
    """Which cameras see which points, shape ``(P, cameras)`` bool: in the frame, from the front, nothing between.

    The line of sight starts ``clearance_m`` above the surface, along its ``normal`` (3,).
    """
    seen = np.zeros((len(points), len(cameras)), dtype=bool)
    for c, camera in enumerate(cameras):
        inside, _ = camera.in_frame(points, 0.05)
        seen[:, c] = inside & (((camera.position - points) * normal).sum(axis=1) > 0)
    if surface is not None:
        positions = np.array([camera.position for camera in cameras])
        point, eye = np.nonzero(seen)
        seen[point, eye] = surface.visible(points[point] + clearance_m * normal, positions[eye])
    return seen


def seen_cells(planes: Sequence[Plane], cameras: Sequence[Camera]) -> list[Plane]:
    """``planes`` with only those occupied cells that at least two cameras see past all the others."""
    surface = plane_mesh(planes)
    result = []
    for plane in planes:
        seen = visible_from(surface, plane.cells(), plane.normal, cameras)
        result.append(with_cells(plane, seen.sum(axis=1) >= 2))
    return result


def pieces(mask: np.ndarray, smallest: int) -> np.ndarray:
    """``mask`` without connected pieces (four neighbours) of fewer cells than ``smallest``."""
    label, _ = ndimage.label(mask)
    return mask & (np.bincount(label.ravel())[label] >= smallest)


def meeting(planes: Sequence[Plane]) -> list[Plane]:
    """``planes`` with cells added at inner corners and removed beyond outer ones.

    Photos prove little right at an edge. Two planes that stand on each other's front side form an inner corner (wall
    and floor), and both reach up to their common line. Two that stand on each other's back side form an outer corner
    (the faces of a pillar), and neither goes past it.
    """
    reach_cells = 3  # a gap at an inner corner up to this wide is closed, an overhang of any width cut
    wide = [plane.widened(reach_cells) for plane in planes]
    grown = [dilate(plane.occupied, reach_cells) for plane in wide]
    result = []
    near_m = 0.5  # cells this close to the other plane tell on which side of it they stand
    for a, plane in enumerate(wide):
        occupied, beyond = plane.occupied.copy(), np.zeros_like(plane.occupied)
        centres = plane.cells(np.ones_like(occupied))
        for b, other in enumerate(wide):
            if a == b or abs(other.normal @ plane.normal) > 0.5:
                continue
            height = other.distance(centres).reshape(occupied.shape)
            along = other.covers(centres, grown[b]).reshape(occupied.shape)
            cells = other.cells()
            mine = height[occupied & along & (np.abs(height) < near_m)]
            theirs = plane.distance(cells[plane.covers(cells, grown[a])])
            theirs = theirs[np.abs(theirs) < near_m]
            if len(mine) < 3 or len(theirs) < 3:
                continue
            if min((mine > 0).mean(), (theirs > 0).mean()) > INNER:
                strip = along & (height > -0.25 * plane.cell_m) & (height < reach_cells * plane.cell_m)
                for _ in range(reach_cells):  # towards the other plane only
                    higher = ndimage.maximum_filter(np.where(occupied, height, -np.inf), 3, mode="nearest")
                    occupied |= strip & (higher > height + 0.02)
            elif min((mine < 0).mean(), (theirs < 0).mean()) > OUTER:
                beyond |= along & (height > 0.25 * plane.cell_m) & (height < near_m)
        result.append(replace(plane, occupied=occupied & ~beyond))
    return result
