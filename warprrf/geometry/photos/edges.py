"""Where two planes meet: occupied cells reach into inner corners and stop at outer ones.

Photos prove little right at an edge: patches straddle it and features are rare. Two planes that stand on each other's
front side form an inner corner (wall and floor), and both reach up to their common line. Two that stand on each
other's back side form an outer corner (the faces of a pillar), and neither goes past it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warprrf.geometry.photos.planes import Plane, dilate

REACH_CELLS = 3  # a gap at an inner corner up to this wide is closed, an overhang of any width cut
NEAR_M = 0.5  # cells this close to the other plane tell on which side of it they stand
SURE = 0.8  # share of them that has to be on one side


def meeting(planes: Sequence[Plane]) -> list[Plane]:
    """``planes`` with cells added at inner corners and removed beyond outer ones."""
    wide = [_padded(plane, REACH_CELLS) for plane in planes]
    cells = [plane.cells() for plane in planes]
    result = []
    for a, plane in enumerate(wide):
        occupied = plane.occupied.copy()
        grid = np.moveaxis(np.indices(occupied.shape), 0, -1).reshape(-1, 2)
        centres = plane.to_world(plane.corner + (grid + 0.5) * plane.cell_m)
        reach = REACH_CELLS * plane.cell_m
        beyond = np.zeros(occupied.shape, dtype=bool)
        for b, other in enumerate(wide):
            if a == b or abs(other.normal @ plane.normal) > 0.5 or not occupied.any() or not len(cells[b]):
                continue
            height = other.distance(centres).reshape(occupied.shape)
            if not (np.abs(height[occupied]) < NEAR_M).any():
                continue
            along = replace(other, occupied=dilate(other.occupied, REACH_CELLS)).covers(centres)
            along = along.reshape(occupied.shape)
            mine = height[occupied & along & (np.abs(height) < NEAR_M)]
            gap = plane.distance(cells[b])
            close = np.abs(gap) < NEAR_M
            close[close] = replace(plane, occupied=dilate(plane.occupied, REACH_CELLS)).covers(
                cells[b][close]
            )
            theirs = gap[close]
            if len(mine) < 3 or len(theirs) < 3:
                continue
            if (mine > 0).mean() > SURE and (theirs > 0).mean() > SURE:
                strip = along & (height > -0.25 * plane.cell_m) & (height < reach)
                for _ in range(REACH_CELLS):
                    occupied |= strip & _higher_neighbour(occupied, height)
            elif (mine < 0).mean() > SURE - 0.2 and (theirs < 0).mean() > SURE - 0.2:
                beyond |= along & (height > 0.25 * plane.cell_m) & (height < NEAR_M)
        result.append(replace(plane, occupied=occupied & ~beyond))
    return result


def _higher_neighbour(occupied: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Cells with an occupied neighbour that is farther from the other plane: growth leads towards it only."""
    padded = np.pad(np.where(occupied, height, -np.inf), 1, constant_values=-np.inf)
    a, b = occupied.shape
    around = np.max([padded[i : i + a, j : j + b] for i in range(3) for j in range(3)], axis=0)
    return around > height + 0.02


def _padded(plane: Plane, cells: int) -> Plane:
    return replace(
        plane, occupied=np.pad(plane.occupied, cells), corner=np.asarray(plane.corner) - cells * plane.cell_m
    )
