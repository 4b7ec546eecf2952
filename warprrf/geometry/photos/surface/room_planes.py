"""Planes across three perpendicular directions of a room, and the faces of a mesh that lie on each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from warprrf.geometry.mesh import Mesh, smoothed_normals
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.planes import ALIGNED_DEG, Plane

EXACT_DEG, STRONG_M2 = 0.1, 2.0
"""A plane this parallel, with a proven area above the second, keeps its own tilt (0.1 degrees are 2 cm over 12 m): it is
fitted better than the directions are."""
SAME_SIDE_M = 0.035  # planes facing one way and closer than this are two fits of one surface


class Level(NamedTuple):
    """Where a plane crosses one of the directions: ``height`` [m] along direction ``axis``, seen from the side of
    ``sign`` times it. Its exact equation is ``normal . x = offset``, the normal nearly the direction itself."""

    axis: int
    sign: int
    height: float
    normal: np.ndarray
    offset: float


@dataclass(frozen=True)
class FaceLevels:
    """The level that each face lies on: direction 0 to 2 or -1 for none, seen side, height [m]; shapes ``(F,)``."""

    axis: np.ndarray
    sign: np.ndarray
    height: np.ndarray

    def set(self, faces: np.ndarray, level: Level) -> None:
        """Faces of these indices lie on ``level``."""
        self.axis[faces], self.sign[faces], self.height[faces] = level[:3]


def known_levels(
    patches: PlanarPatches, planes: Sequence[Plane], axes: np.ndarray
) -> tuple[list[Level], FaceLevels]:
    """Levels of the patches that are parallel to the directions, the best supported first, and of the faces on them;
    then those on which other faces gather.

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
        level = Level(axis, sign, height, axes[axis], height)
        if abs(fit) > np.cos(np.radians(EXACT_DEG)) and strength > STRONG_M2:
            level = level._replace(normal=sign * patches.normal[k], offset=sign * patches.offset[k])
        candidates.append((strength, level, faces))
    chosen: list[Level] = []
    found = FaceLevels(np.full(count, -1), np.zeros(count, dtype=np.int64), np.zeros(count))
    for _, level, faces in sorted(candidates, key=lambda c: -c[0]):
        twin = _twin(level, chosen)
        if twin is None:
            chosen.append(level)
        found.set(faces, (twin or level)._replace(sign=level.sign))
    for level, faces in _gatherings(mesh, found, axes, list(chosen)):
        found.set(faces, level)
        if _twin(level, chosen) is None:
            chosen.append(level)
    return chosen, found


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
    mesh: Mesh, found: FaceLevels, axes: np.ndarray, known: Sequence[Level]
) -> Iterator[tuple[Level, np.ndarray]]:
    """Levels on which the faces that no patch took gather, and their faces; known levels take theirs first."""
    facing = smoothed_normals(mesh, 3) @ axes.T
    heights = mesh.triangles.mean(axis=1) @ axes.T
    # so much area of left-over faces within so much height makes one more plane
    gather_m2, gather_m = 0.08, 0.03
    for axis in range(3):
        for sign in (1, -1):
            own = np.flatnonzero((found.axis < 0) & (sign * facing[:, axis] > np.cos(np.radians(25.0))))
            for level in [d for d in known if (d.axis, d.sign) == (axis, sign)]:
                near = np.abs(heights[own, axis] - level.height) < SAME_SIDE_M
                yield level, own[near]
                own = own[~near]
            own = own[np.argsort(heights[own, axis], kind="stable")]
            x, area = heights[own, axis], mesh.areas[own]
            last = np.searchsorted(x, x + gather_m, side="right")
            while len(own):
                total = np.concatenate([[0.0], np.cumsum(area)])
                gathered = total[last] - total[:-1]
                k = int(gathered.argmax())
                if gathered[k] < gather_m2:
                    break
                height = float(x[k : last[k]] @ area[k : last[k]] / gathered[k])
                gap = np.abs(x - height)
                yield (
                    Level(axis, sign, height, axes[axis], height),
                    own[(gap < SAME_SIDE_M) & (area > 0)],
                )
                area = np.where(gap < 2 * SAME_SIDE_M, 0.0, area)


def proven_levels(
    planes: Sequence[Plane], axes: np.ndarray, levels: Sequence[Level]
) -> list[tuple[Plane, Level]]:
    """Planes with occupied cells, each with the level that it became."""
    result = []
    for plane in planes:
        axis, sign = _parallel_to(plane.normal, axes)
        if axis < 0 or not plane.occupied.any():
            continue
        height = float(plane.cells().mean(axis=0) @ axes[axis])
        near = [level for level in levels if level[:2] == (axis, sign)]
        gaps = [abs(level.height - height) for level in near]
        if gaps and min(gaps) < SAME_SIDE_M:
            result.append((plane, near[int(np.argmin(gaps))]))
    return result


def claim_proven(
    mesh: Mesh,
    found: FaceLevels,
    axes: np.ndarray,
    proven: Sequence[tuple[Plane, Level]],
) -> None:
    """Faces near occupied cells go to their plane, whichever plane they were snapped to."""
    facing = smoothed_normals(mesh, 3) @ axes.T
    centres = mesh.triangles.mean(axis=1)
    heights = centres @ axes.T
    # 0.12: a face this close to a part of a plane that the photos proved belongs to it
    least = np.full(len(centres), 0.12)
    for plane, level in proven:
        gap = np.abs(heights[:, level.axis] - level.height)
        towards = level.sign * facing[:, level.axis] > np.cos(np.radians(35.0))
        own = np.flatnonzero((gap < least) & towards)
        own = own[plane.covers(centres[own])]
        found.set(own, level)
        least[own] = gap[own]
