"""Planes in a room: found among oriented points, and the part of each plane where a surface really is.

A plane is ``normal . x = offset`` [m] with its unit normal on the side that was seen, so that the two faces of a thin
wall are two planes. Detection draws hypotheses from single oriented points, refines the best by least squares and
takes their points away, until no plane gathers enough (the scheme of Schnabel, Wahl and Klein, "Efficient RANSAC for
point-cloud shape detection", 2007). Plain NumPy, float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warprrf.device import check_array

HYPOTHESES = 192  # points tried as plane centres in each round
REFINED = 12  # best hypotheses of a round that are refined before one is chosen
REFITS = 8
ECHO_M, ECHO_CELL_M = (
    0.1,
    0.3,
)  # noise of a plane passes for a second one this close; compared by cells of this size
CONTESTED_M = 0.25  # a sign stands off its wall by less
DRAW = 6000  # points a hypothesis is scored on


@dataclass(frozen=True)
class Plane:
    """``normal . x = offset``.

    Attributes:
        normal: unit normal, on the side the surface was seen from, shape ``(3,)``.
        offset: [m].
        inliers: indices of the points it was fitted to, shape ``(K,)`` int64.
        rms_m: rms distance of those points from the plane [m].
        axes: unit vectors along the rows and columns of ``occupied``, shape ``(2, 3)``.
        corner: in-plane coordinates of the outer corner of cell (0, 0) [m], shape ``(2,)``.
        cell_m: side of a cell [m].
        occupied: cells where a surface is, shape ``(A, B)`` bool; empty until :func:`occupancy` has filled it.
    """

    normal: np.ndarray
    offset: float
    inliers: np.ndarray = field(repr=False)
    rms_m: float = 0.0
    axes: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)), repr=False)
    corner: np.ndarray = field(default_factory=lambda: np.zeros(2), repr=False)
    cell_m: float = 0.0
    occupied: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), dtype=bool), repr=False)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points ``(N, 3)``, positive on the side of the normal [m], shape ``(N,)``."""
        return points @ self.normal - self.offset

    def area(self) -> float:
        """Area of the occupied cells [m^2]."""
        return float(self.occupied.sum()) * self.cell_m**2

    def to_plane(self, points: np.ndarray) -> np.ndarray:
        """In-plane coordinates of points ``(N, 3)`` [m], shape ``(N, 2)``."""
        return points @ self.axes.T

    def to_world(self, uv: np.ndarray) -> np.ndarray:
        """World points of in-plane coordinates ``(N, 2)`` [m], shape ``(N, 3)``."""
        return uv @ self.axes + self.offset * self.normal

    def cells(self) -> np.ndarray:
        """World centres of the occupied cells [m], shape ``(K, 3)``."""
        return self.to_world(self.corner + (np.argwhere(self.occupied) + 0.5) * self.cell_m)

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Whether the foot of each point ``(N, 3)`` lies in an occupied cell, shape ``(N,)`` bool."""
        if self.occupied.size == 0:
            return np.zeros(len(points), dtype=bool)
        index = np.floor((self.to_plane(points) - self.corner) / self.cell_m).astype(np.int64)
        inside = ((index >= 0) & (index < self.occupied.shape)).all(axis=1)
        index = np.where(inside[:, None], index, 0)
        return inside & self.occupied[index[:, 0], index[:, 1]]


def fit_plane(points: np.ndarray, weights: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit normal and offset of the plane with the least weighted sum of squared distances to ``points``.

    The result faces the way of ``normal``; points on one line fix no plane, ``normal`` is then kept.
    """
    centre = weights @ points / weights.sum()
    local = points - centre
    values, vectors = np.linalg.eigh((local * weights[:, None]).T @ local)
    if values[1] > 1e-6 * values[2]:
        normal = vectors[:, 0] if vectors[:, 0] @ normal >= 0 else -vectors[:, 0]
    return normal, float(normal @ centre)


def detect_planes(
    points: Any,
    normals: Any,
    *,
    weights: Any = None,
    distance_m: float = 0.015,
    angle_rad: float = np.radians(30.0),
    min_points: float = 60,
    max_planes: int = 80,
    seed: int = 0,
) -> list[Plane]:
    """Planes among oriented points, the best supported first.

    Args:
        points: shape ``(P, 3)`` [m].
        normals: unit normals on the seen side, shape ``(P, 3)``.
        weights: how many points each one counts for (an area, for the faces of a mesh), shape ``(P,)``.
        distance_m: a point within this distance is on the plane.
        angle_rad: the normal of a point on the plane differs by no more than this.
        min_points: a plane has at least this many points (or this much weight).
        max_planes: stop after so many.
        seed: seed of the draws.
    """
    points = check_array("points", points, (None, 3))
    normals = check_array("normals", normals, (len(points), 3))
    weight = np.ones(len(points)) if weights is None else check_array("weights", weights, (len(points),))
    if distance_m <= 0:
        raise ValueError(f"distance_m: got {distance_m}, expected a positive length in metres")
    rng = np.random.default_rng(seed)
    cosine = np.cos(angle_rad)
    free = np.arange(len(points))
    found: list[Plane] = []
    misses = 0
    while len(found) < max_planes and weight[free].sum() >= min_points and misses < 3:
        plane = _best_plane(points[free], normals[free], weight[free], distance_m, cosine, rng)
        if plane is None or weight[free[plane.inliers]].sum() < min_points:
            misses += 1
            continue
        misses = 0
        found.append(replace(plane, inliers=free[plane.inliers]))
        # A wider band goes with it, so that the plane's own fringe is not found again as a second plane.
        fringe = (np.abs(plane.distance(points[free])) < 2.5 * distance_m) & (
            normals[free] @ plane.normal > cosine
        )
        free = free[~fringe]
    return _merged(points, normals, weight, found, distance_m, cosine)


def _best_plane(
    points: np.ndarray,
    normals: np.ndarray,
    weight: np.ndarray,
    distance_m: float,
    cosine: float,
    rng: np.random.Generator,
) -> Plane | None:
    share = weight / weight.sum()
    seeds = rng.choice(len(points), size=min(HYPOTHESES, len(points)), replace=False, p=share)
    drawn = rng.choice(len(points), size=min(DRAW, len(points)), replace=False)
    n, d = normals[seeds], (points[seeds] * normals[seeds]).sum(axis=1)
    near = np.abs(points[drawn] @ n.T - d) < 3 * distance_m
    score = weight[drawn] @ (near & (normals[drawn] @ n.T > cosine))
    best: Plane | None = None
    best_weight = 0.0
    for k in np.argsort(-score, kind="stable")[:REFINED]:
        normal, offset = n[k], float(d[k])
        # From the neighbourhood of the hypothesis outwards: its normal is good to a few degrees only.
        reach = np.linalg.norm(points - points[seeds[k]], axis=1)
        on = np.zeros(len(points), dtype=bool)
        for step in range(REFITS):
            band = distance_m * max(1.0, 3.0 - 0.4 * step)
            residual = points @ normal - offset
            on = (np.abs(residual) < band) & (normals @ normal > cosine)
            if step < 4:
                on &= reach < 0.75 * 2**step
            if not on.any():
                break
            normal, offset = fit_plane(
                points[on], weight[on] / (1 + (residual[on] / distance_m) ** 2), normal
            )
        residual = points @ normal - offset
        on = (np.abs(residual) < distance_m) & (normals @ normal > cosine)
        if weight[on].sum() > best_weight:
            best_weight = float(weight[on].sum())
            rms = float(np.sqrt((weight[on] * residual[on] ** 2).sum() / best_weight))
            best = Plane(normal, offset, np.flatnonzero(on), rms)
    return best


def _merged(
    points: np.ndarray,
    normals: np.ndarray,
    weight: np.ndarray,
    planes: Sequence[Plane],
    distance_m: float,
    cosine: float,
) -> list[Plane]:
    """Planes that describe each other's points as well as their own become one; every plane is fitted once more."""
    kept: list[Plane] = []
    for plane in sorted(planes, key=lambda p: -weight[p.inliers].sum()):
        own = points[plane.inliers]
        twin = next(
            (
                i
                for i, other in enumerate(kept)
                if other.normal @ plane.normal > np.cos(np.radians(3.0))
                and np.sqrt(np.mean(other.distance(own) ** 2)) < 2 * distance_m
                and np.sqrt(np.mean(plane.distance(points[other.inliers]) ** 2)) < 4 * distance_m
            ),
            None,
        )
        if twin is None:
            kept.append(plane)
        else:
            kept[twin] = replace(kept[twin], inliers=np.union1d(kept[twin].inliers, plane.inliers))
    kept = [
        plane for i, plane in enumerate(kept) if not any(_echo(points, plane, strong) for strong in kept[:i])
    ]
    refitted: list[Plane] = []
    for plane in kept:
        normal, offset = plane.normal, plane.offset
        for _ in range(3):
            own = points[plane.inliers]
            w = weight[plane.inliers] / (1 + ((own @ normal - offset) / (0.5 * distance_m)) ** 2)
            normal, offset = fit_plane(own, w, normal)
        residual = points[plane.inliers] @ normal - offset
        refitted.append(
            replace(plane, normal=normal, offset=offset, rms_m=float(np.sqrt(np.mean(residual**2))))
        )
    return sorted(refitted, key=lambda p: -weight[p.inliers].sum())


def aligned(
    planes: Sequence[Plane], points: np.ndarray, *, angle_rad: float = np.radians(3.0)
) -> list[Plane]:
    """``planes`` with weakly supported ones made exactly parallel or level, where their points allow it.

    Built rooms have few directions. A plane takes over the normal of a plane with five times its points, or the
    vertical, within ``angle_rad`` of its own, if its points then lie hardly further from it.
    """
    result: list[Plane] = []
    vertical = np.array([0.0, 0.0, 1.0])
    for plane in planes:
        own = points[plane.inliers]
        strong = [q.normal for q in planes if len(q.inliers) >= 5 * len(plane.inliers)]
        directions = [s * n for n in (*strong, vertical) for s in (1.0, -1.0)]
        directions = [n for n in directions if n @ plane.normal > np.cos(angle_rad)]
        best = plane
        for normal in sorted(directions, key=lambda n: -float(n @ plane.normal)):
            offset = float(np.median(own @ normal))
            rms = float(np.sqrt(np.mean((own @ normal - offset) ** 2)))
            if rms < 1.25 * plane.rms_m + 1e-3:
                best = replace(plane, normal=normal, offset=offset, rms_m=rms)
                break
        result.append(best)
    return result


def _echo(points: np.ndarray, plane: Plane, strong: Plane) -> bool:
    """Whether ``plane`` is only noise of a better supported parallel one: then points of both share the same places.

    A poster in front of a wall is no echo: behind it, the wall has no points.
    """
    own = points[plane.inliers]
    if (
        strong.normal @ plane.normal < np.cos(np.radians(10.0))
        or np.median(np.abs(strong.distance(own))) > ECHO_M
    ):
        return False
    axes = plane_axes(strong.normal)
    here = np.floor(own @ axes.T / ECHO_CELL_M).astype(np.int64)
    there = np.floor(points[strong.inliers] @ axes.T / ECHO_CELL_M).astype(np.int64)
    cells = {tuple(c) for c in here}
    return sum(tuple(c) in cells for c in there) > len(here)


def plane_axes(normal: np.ndarray) -> np.ndarray:
    """Two unit vectors in the plane, shape ``(2, 3)``: the first horizontal (along x for a level plane)."""
    first = np.cross([0.0, 0.0, 1.0], normal)
    if np.linalg.norm(first) < 0.1:
        first = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def occupancy(
    planes: Sequence[Plane],
    points: Any,
    eyes: Any,
    targets: Any,
    *,
    cell_m: float = 0.1,
    margin_m: float = 0.12,
    depth_m: float = 0.1,
) -> list[Plane]:
    """``planes`` with the cells where a surface may be.

    A cell is a candidate inside the convex hull of the plane's own points, widened by ``margin_m``, and empty where a
    line of sight passes through it to a point that lies well behind.

    Args:
        points: the points that the planes' ``inliers`` index, shape ``(P, 3)`` [m].
        eyes, targets: lines of sight, from a camera to a point it sees, shape ``(L, 3)`` each [m].
        cell_m: side of a cell.
        depth_m: a line of sight empties a cell when its target is more than this behind the plane.
    """
    points = check_array("points", points, (None, 3))
    eyes = check_array("eyes", eyes, (None, 3))
    targets = check_array("targets", targets, (len(eyes), 3))
    result = []
    for plane in planes:
        axes = plane_axes(plane.normal)
        uv = points[plane.inliers] @ axes.T
        corner = uv.min(axis=0) - margin_m - cell_m
        shape = np.ceil((uv.max(axis=0) + margin_m + cell_m - corner) / cell_m).astype(int)
        centres = corner + (np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 2) + 0.5) * cell_m
        inside = _in_hull(centres, uv, margin_m).reshape(shape)
        supported = np.zeros(shape, dtype=bool)
        index = np.floor((uv - corner) / cell_m).astype(int)
        supported[index[:, 0], index[:, 1]] = True

        before, behind = plane.distance(eyes), plane.distance(targets)
        through = (before > 0) & (behind < -depth_m)
        share = (before[through] / (before[through] - behind[through]))[:, None]
        crossing = (eyes[through] + share * (targets[through] - eyes[through])) @ axes.T
        index = np.floor((crossing - corner) / cell_m).astype(int)
        index = index[((index >= 0) & (index < shape)).all(axis=1)]
        seen_through = np.zeros(shape, dtype=int)
        np.add.at(seen_through, (index[:, 0], index[:, 1]), 1)
        empty = dilate(seen_through > 0, 2) & ~dilate(supported, 1)
        empty |= (seen_through > 2) & ~supported
        result.append(replace(plane, axes=axes, corner=corner, cell_m=cell_m, occupied=inside & ~empty))
    return [_uncontested(k, result, points) for k in range(len(result))]


def _uncontested(k: int, planes: Sequence[Plane], points: np.ndarray) -> Plane:
    """Plane ``k`` without the cells that belong to a parallel plane close by, such as the wall behind a sign.

    Lines of sight cannot tell the two apart; of two planes the one with the nearest point of its own has the cell.
    """
    plane = planes[k]
    cells = plane.cells()
    own: np.ndarray | None = None
    lost = np.zeros(len(cells), dtype=bool)
    for other in [*planes[:k], *planes[k + 1 :]]:
        if other.normal @ plane.normal < np.cos(np.radians(10.0)):
            continue
        contested = (np.abs(other.distance(cells)) < CONTESTED_M) & other.covers(cells)
        if not contested.any():
            continue
        if own is None:
            own = _nearest_gap(plane.to_plane(cells), plane.to_plane(points[plane.inliers]))
        theirs = np.full(len(cells), np.inf)
        theirs[contested] = _nearest_gap(
            plane.to_plane(cells[contested]), plane.to_plane(points[other.inliers])
        )
        lost |= theirs < own
    occupied = plane.occupied.copy()
    occupied[plane.occupied] = ~lost
    return replace(plane, occupied=occupied)


def _nearest_gap(queries: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of each query to the nearest of some of the points, shape ``(N,)``."""
    some = points[:: max(1, len(points) // 500)]
    pieces = np.array_split(queries, len(queries) * len(some) // 2_000_000 + 1)
    return np.concatenate([np.sqrt(((q[:, None] - some[None]) ** 2).sum(axis=2).min(axis=1)) for q in pieces])


def dilate(mask: np.ndarray, steps: int) -> np.ndarray:
    """``mask`` (2D, bool) grown by ``steps`` cells in all eight directions."""
    for _ in range(steps):
        padded = np.pad(mask, 1)
        rows = padded[:-2] | padded[1:-1] | padded[2:]
        mask = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return mask


def _in_hull(queries: np.ndarray, points: np.ndarray, margin: float) -> np.ndarray:
    """Whether 2D ``queries`` lie within ``margin`` of the convex hull of ``points`` (Andrew's monotone chain)."""
    ordered = np.unique(points, axis=0)
    if len(ordered) < 3:
        return np.linalg.norm(queries[:, None] - ordered[None], axis=2).min(axis=1) <= margin

    def chain(sequence: np.ndarray) -> list[np.ndarray]:
        kept: list[np.ndarray] = []
        for p in sequence:
            while len(kept) > 1:
                a, b = kept[-1] - kept[-2], p - kept[-1]
                if a[0] * b[1] - a[1] * b[0] > 0:
                    break
                kept.pop()
            kept.append(p)
        return kept[:-1]

    hull = np.array(chain(ordered) + chain(ordered[::-1]))
    edge = np.roll(hull, -1, axis=0) - hull
    outward = (
        np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.maximum(np.linalg.norm(edge, axis=1), 1e-12)[:, None]
    )
    return ((queries @ outward.T) <= (hull * outward).sum(axis=1) + margin).all(axis=1)
