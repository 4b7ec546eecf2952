"""Planes that divide space, along three perpendicular directions, and the faces of a mesh that lie on each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.patches import PlanarPatch, smoothed_normals
from warprrf.geometry.photos.planes import Plane

ALIGNED = np.cos(np.radians(4.0))  # a plane this parallel to a direction counts as parallel
EXACT = np.cos(np.radians(0.1))  # and one this parallel keeps its own tilt: 2 cm over 12 m
LEAST_SHARE = 0.5  # of the mesh that has to lie on such planes
TWIN_M = 0.035  # planes facing one way and closer than this are two fits of one surface
THIN_M = 0.012  # planes facing opposite ways can be closer: the two faces of a board
STRONG_M2 = 2.0  # a plane with a proven area above this is fitted better than the directions are
PEAK_M2, PEAK_M = 0.08, 0.03  # so much area of left-over faces within so much height makes one more plane
REACH_M = 0.12  # a face this close to a part of a plane that the photos proved belongs to it


@dataclass(frozen=True)
class Divider:
    """A known plane: ``sign`` times direction ``axis`` is its seen side, ``height`` its place along the direction."""

    axis: int
    sign: int
    height: float
    normal: np.ndarray
    offset: float


@dataclass(frozen=True)
class Labels:
    """The plane that each face lies on: direction 0 to 2 or -1 for none, seen side, height [m]; shapes ``(F,)``."""

    axis: np.ndarray
    sign: np.ndarray
    height: np.ndarray

    def set(self, faces: np.ndarray, divider: Divider) -> None:
        """Faces of these indices lie on ``divider``."""
        self.axis[faces], self.sign[faces] = divider.axis, divider.sign
        self.height[faces] = divider.height


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


def known_planes(
    mesh: Mesh, patches: Sequence[PlanarPatch], planes: Sequence[Plane], axes: np.ndarray
) -> tuple[list[Divider], Labels]:
    """Known planes along the directions, the best supported first, and the faces on each of them."""
    centres = mesh.triangles.mean(axis=1)
    candidates: list[tuple[float, Divider, np.ndarray]] = []
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
            divider = Divider(axis, sign, height, sign * p.normal, sign * p.offset)
        else:
            divider = Divider(axis, sign, height, axes[axis], height)
        candidates.append((strength, divider, p.faces))
    chosen: list[Divider] = []
    count = len(mesh.faces)
    labels = Labels(np.full(count, -1), np.zeros(count, dtype=np.int64), np.zeros(count))
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


def _twin(divider: Divider, others: Sequence[Divider]) -> Divider | None:
    for other in others:
        gap = TWIN_M if other.sign == divider.sign else THIN_M
        if other.axis == divider.axis and abs(other.height - divider.height) < gap:
            return other
    return None


def _peaks(
    mesh: Mesh, labels: Labels, axes: np.ndarray, known: Sequence[Divider]
) -> Iterator[tuple[Divider, np.ndarray]]:
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
                    Divider(axis, sign, height, axes[axis], height),
                    own[(gap < TWIN_M) & (area > 0)],
                )
                area = np.where(gap < 2 * TWIN_M, 0.0, area)


def proven_planes(
    planes: Sequence[Plane], axes: np.ndarray, dividers: Sequence[Divider]
) -> Iterator[tuple[Plane, Divider]]:
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


def claim_proven(
    mesh: Mesh, labels: Labels, axes: np.ndarray, proven: Sequence[tuple[Plane, Divider]]
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
