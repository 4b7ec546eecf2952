"""Planes in a room: found among oriented points, and the part of each plane where a surface is.

A plane is ``normal . x = offset`` [m] with its unit normal on the side that was seen, so that the two faces of a thin
wall are two planes. Detection draws hypotheses from single oriented points, refines the best by least squares and
takes their points away, until no plane gathers enough (the scheme of Schnabel, Wahl and Klein, "Efficient RANSAC for
point-cloud shape detection", 2007). Float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from scipy import ndimage

from warprrf.cache import cached_property
from warprrf.checks import checked, positive


@checked
@dataclass(frozen=True)
class PlaneConfig:
    """How planes are found among points, and how large their cells are.

    Attributes:
        distance_m: a point this close is on the plane; three times the noise of sparse points in a room.
        angle_deg: and its normal differs by no more than this: normals of sparse points are good to 10 degrees or so.
        min_points: fewest points of a plane (or the least weight, where points are weighted).
        max_planes: stop after so many.
        cell_m: side of a plane's cells.
        margin_m: cells reach so far beyond the hull of a plane's points.
    """

    distance_m: Annotated[float, positive("length in metres")] = 0.015
    angle_deg: float = 30.0
    min_points: float = 40
    max_planes: int = 80
    cell_m: float = 0.1
    margin_m: float = 0.12

    @property
    def cosine(self) -> float:
        """Of ``angle_deg``."""
        return float(np.cos(np.radians(self.angle_deg)))


HYPOTHESES = 192  # points tried as centres of planes in each round
SCORED_POINTS = 6000  # that a hypothesis is scored on
REFINED = 12  # hypotheses of a round that are refined before the best is chosen
ECHO_M = 0.1  # a parallel plane this close is the noise of a better one,
ECHO_CELL_M = 0.3  # where both have points in the same cells of this size
REFITS = 8  # of a hypothesis, from its neighbourhood outwards
ALIGNED_DEG = 4.0  # a plane this parallel to one of three perpendicular directions counts as parallel
AROUND = np.ones((3, 3), dtype=bool)  # a cell and its eight neighbours


@dataclass(frozen=True)
class Plane:
    """``normal . x = offset``, and the cells of a grid in it where a surface is.

    Attributes:
        normal: unit normal, on the side the surface was seen from, shape ``(3,)``.
        offset: [m].
        inliers: indices of the points it was fitted to, shape ``(K,)`` int64; default: none.
        rms_m: rms distance of those points from the plane [m].
        corner: in-plane coordinates of the outer corner of cell (0, 0) [m], shape ``(2,)``.
        cell_m: side of a cell [m].
        occupied: cells where a surface is, shape ``(A, B)`` bool.
        plain: whether no feature lies on it and its edges alone showed it.
    """

    normal: np.ndarray
    offset: float
    inliers: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64), repr=False)
    rms_m: float = 0.0
    corner: np.ndarray = field(default_factory=lambda: np.zeros(2), repr=False)
    cell_m: float = 0.1
    occupied: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), dtype=bool), repr=False)
    plain: bool = False

    @cached_property
    def axes(self) -> np.ndarray:
        """Unit vectors along the rows and columns of ``occupied``, shape ``(2, 3)``."""
        return plane_axes(self.normal)

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

    def cells(self, chosen: np.ndarray | None = None) -> np.ndarray:
        """World centres of the occupied cells, or of those ``chosen`` (a mask of the grid) [m], shape ``(K, 3)``."""
        index = np.argwhere(self.occupied if chosen is None else chosen)
        return self.to_world(self.corner + (index + 0.5) * self.cell_m)

    def cell_of(self, points: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Row and column of the cell at the foot of each point ``(N, 3)``, (0, 0) beyond the grid; and whether the grid
        has it, shapes ``(N,)``."""
        index = np.floor((self.to_plane(points) - self.corner) / self.cell_m).astype(np.int64)
        inside = ((index >= 0) & (index < self.occupied.shape)).all(axis=1)
        rows, columns = np.where(inside[:, None], index, 0).T
        return (rows, columns), inside

    def covers(self, points: np.ndarray, chosen: np.ndarray | None = None) -> np.ndarray:
        """Whether the foot of each point ``(N, 3)`` lies in an occupied (or ``chosen``) cell, shape ``(N,)`` bool."""
        cells = self.occupied if chosen is None else chosen
        if cells.size == 0:
            return np.zeros(len(points), dtype=bool)
        place, inside = self.cell_of(points)
        return inside & cells[place]

    def holds(self, points: np.ndarray, reach_m: float, chosen: np.ndarray | None = None) -> np.ndarray:
        """Which points ``(N, 3)`` lie closer than ``reach_m`` to an occupied (or ``chosen``) cell, shape ``(N,)`` bool."""
        near = np.abs(self.distance(points)) < reach_m
        near[near] = self.covers(points[near], chosen)
        return near

    def count(self, points: np.ndarray) -> np.ndarray:
        """Number of points ``(N, 3)`` whose foot lies in each cell, shape of ``occupied``."""
        place, inside = self.cell_of(points)
        counts = np.zeros(self.occupied.shape, dtype=np.int64)
        np.add.at(counts, tuple(p[inside] for p in place), 1)
        return counts

    def spanning(self, low: np.ndarray, high: np.ndarray) -> Plane:
        """The plane with occupied cells from in-plane coordinates ``low`` to ``high`` [m], shape ``(2,)`` each."""
        shape = np.ceil((high - low) / self.cell_m).astype(int)
        return replace(self, corner=low, occupied=np.ones(shape, dtype=bool))

    def widened(self, cells: int) -> Plane:
        """The plane with ``cells`` more rows and columns of empty cells on every side."""
        return replace(
            self, occupied=np.pad(self.occupied, cells), corner=np.asarray(self.corner) - cells * self.cell_m
        )

    def seen_through(self, eyes: np.ndarray, targets: np.ndarray, depth_m: float) -> np.ndarray:
        """Lines of sight ``(L, 3)`` each that cross each cell from the front to a target more than ``depth_m`` behind."""
        before, behind = self.distance(eyes), self.distance(targets)
        through = (before > 0) & (behind < -depth_m)
        share = (before[through] / (before[through] - behind[through]))[:, None]
        return self.count(eyes[through] + share * (targets[through] - eyes[through]))


def plane_axes(normal: np.ndarray) -> np.ndarray:
    """Two unit vectors in each plane of unit ``normal`` (..., 3), shape ``(..., 2, 3)``: the first horizontal, along x for level
    planes."""
    first = np.cross([0.0, 0.0, 1.0], normal)
    level = np.linalg.norm(first, axis=-1, keepdims=True) < 0.1
    first = np.where(level, np.array([1.0, 0.0, 0.0]) - normal[..., :1] * normal, first)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(normal, first)], axis=-2)


def dilate(mask: np.ndarray, steps: int) -> np.ndarray:
    """``mask`` (2D, bool) grown by ``steps`` cells in all eight directions."""
    return ndimage.binary_dilation(mask, AROUND, iterations=steps) if steps else mask


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
    points: np.ndarray,
    normals: np.ndarray,
    *,
    weights: np.ndarray | None = None,
    config: PlaneConfig,
    seed: int = 0,
) -> list[Plane]:
    """Planes among oriented points, the best supported first.

    Args:
        points: shape ``(P, 3)`` [m].
        normals: unit normals on the seen side, shape ``(P, 3)``.
        weights: how many points each one counts for (an area, for the faces of a mesh), shape ``(P,)``.
    """
    weight = np.ones(len(points)) if weights is None else weights
    free = np.arange(len(points))
    found: list[Plane] = []
    misses = 0
    while len(found) < config.max_planes and weight[free].sum() >= config.min_points and misses < 3:
        salt = seed + 1000 * (len(found) + misses)
        plane = _best_plane(points[free], normals[free], weight[free], config, salt)
        if plane is None or weight[free[plane.inliers]].sum() < config.min_points:
            misses += 1
            continue
        misses = 0
        found.append(replace(plane, inliers=free[plane.inliers]))
        # A wider band goes with it, so that the plane's own fringe is not found again as a second plane.
        near = np.abs(plane.distance(points[free])) < 2.5 * config.distance_m
        free = free[~(near & (normals[free] @ plane.normal > config.cosine))]
    return _without_echoes(points, weight, found, config)


def drawn_by_place(points: np.ndarray, weight: np.ndarray, count: int, salt: int) -> np.ndarray:
    """Indices of up to ``count`` points drawn without replacement, each by its weight.

    A point's luck is a hash of where it lies (to a millimetre) and of ``salt``: it does not depend on the other points,
    their number or their order, so that what rounding does to one of them changes one draw, not all.
    """
    x, y, z = np.floor(points * 1000.0).astype(np.int64).astype(np.uint64).T
    with np.errstate(over="ignore"):
        luck = x * np.uint64(0x9E3779B97F4A7C15) + y * np.uint64(0xC2B2AE3D27D4EB4F)
        luck += z * np.uint64(0x165667B19E3779F9) + np.uint64(salt) * np.uint64(0x27D4EB2F165667C5)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):  # mixer of SplitMix64
            luck = (luck ^ (luck >> np.uint64(shift))) * np.uint64(factor)
        luck ^= luck >> np.uint64(31)
    uniform = ((luck >> np.uint64(11)).astype(np.float64) + 0.5) / 2.0**53
    return np.argsort(-np.log(uniform) / np.maximum(weight, 1e-300), kind="stable")[:count]


def _best_plane(
    points: np.ndarray, normals: np.ndarray, weight: np.ndarray, config: PlaneConfig, salt: int
) -> Plane | None:
    """The plane of most weight among hypotheses through single points, the best of them refined."""
    seeds = drawn_by_place(points, weight, HYPOTHESES, salt)
    drawn = drawn_by_place(points, np.ones(len(points)), SCORED_POINTS, salt)
    n, d = normals[seeds], (points[seeds] * normals[seeds]).sum(axis=1)
    near = np.abs(points[drawn] @ n.T - d) < 3 * config.distance_m
    score = weight[drawn] @ (near & (normals[drawn] @ n.T > config.cosine))
    best: Plane | None = None
    best_weight = 0.0
    for k in np.argsort(-score, kind="stable")[:REFINED]:
        normal, offset = n[k], float(d[k])
        # From the neighbourhood of the hypothesis outwards: its normal is good to a few degrees only.
        reach = np.linalg.norm(points - points[seeds[k]], axis=1)
        for step in range(REFITS):
            residual = points @ normal - offset
            on = np.abs(residual) < config.distance_m * max(1.0, 3.0 - 0.4 * step)
            on &= normals @ normal > config.cosine
            if step < 4:
                on &= reach < 0.75 * 2**step
            if not on.any():
                break
            weights = weight[on] / (1 + (residual[on] / config.distance_m) ** 2)
            normal, offset = fit_plane(points[on], weights, normal)
        residual = points @ normal - offset
        on = (np.abs(residual) < config.distance_m) & (normals @ normal > config.cosine)
        if weight[on].sum() > best_weight:
            best_weight = float(weight[on].sum())
            rms = float(np.sqrt((weight[on] * residual[on] ** 2).sum() / best_weight))
            best = Plane(normal, offset, np.flatnonzero(on), rms)
    return best


def _without_echoes(
    points: np.ndarray, weight: np.ndarray, planes: Sequence[Plane], config: PlaneConfig
) -> list[Plane]:
    """``planes`` without those that are noise of better ones, each fitted once more, the best supported first."""

    def support(plane: Plane) -> float:
        return -float(weight[plane.inliers].sum())

    ranked = sorted(planes, key=support)
    refitted: list[Plane] = []
    for k, plane in enumerate(ranked):
        if any(_echo(points, plane, strong) for strong in ranked[:k]):
            continue
        normal, offset, own = plane.normal, plane.offset, points[plane.inliers]
        for _ in range(3):
            w = weight[plane.inliers] / (1 + ((own @ normal - offset) / (0.5 * config.distance_m)) ** 2)
            normal, offset = fit_plane(own, w, normal)
        residual = own @ normal - offset
        refitted.append(
            replace(plane, normal=normal, offset=offset, rms_m=float(np.sqrt(np.mean(residual**2))))
        )
    return sorted(refitted, key=support)


def _echo(points: np.ndarray, plane: Plane, strong: Plane) -> bool:
    """Whether ``plane`` is only noise of a better supported parallel one: then points of both share the same places.

    A poster in front of a wall is no echo: behind it, the wall has no points.
    """
    own = points[plane.inliers]
    if strong.normal @ plane.normal < np.cos(np.radians(10.0)):
        return False
    if np.median(np.abs(strong.distance(own))) > ECHO_M:
        return False
    here, there = (
        np.floor(p @ plane_axes(strong.normal).T / ECHO_CELL_M).astype(np.int64)
        for p in (own, points[strong.inliers])
    )
    cells = {tuple(c) for c in here}
    return sum(tuple(c) in cells for c in there) > len(here)


def aligned(planes: Sequence[Plane], points: np.ndarray) -> list[Plane]:
    """``planes`` with weakly supported ones made exactly parallel or level, where their points allow it.

    Built rooms have few directions. A plane takes over the normal of a plane with five times its points, or the
    vertical, within 3 degrees of its own, if its points then lie hardly further from it.
    """
    result: list[Plane] = []
    vertical = np.array([0.0, 0.0, 1.0])
    for plane in planes:
        own = points[plane.inliers]
        strong = [q.normal for q in planes if len(q.inliers) >= 5 * len(plane.inliers)]
        directions = [s * n for n in (*strong, vertical) for s in (1.0, -1.0)]
        directions = [n for n in directions if n @ plane.normal > np.cos(np.radians(3.0))]
        best = plane
        for normal in sorted(directions, key=lambda n: -float(n @ plane.normal)):
            offset = float(np.median(own @ normal))
            rms = float(np.sqrt(np.mean((own @ normal - offset) ** 2)))
            if rms < 1.25 * plane.rms_m + 1e-3:
                best = replace(plane, normal=normal, offset=offset, rms_m=rms)
                break
        result.append(best)
    return result


def directions(normals: np.ndarray, areas: np.ndarray, whole_m2: float) -> np.ndarray | None:
    """Three perpendicular unit rows along which planes of these normals ``(P, 3)`` and areas [m^2] face, when they make
    up most of ``whole_m2``; None when there are none."""
    if not len(normals):
        return None
    parallel = np.cos(np.radians(ALIGNED_DEG))
    alike = (np.abs(normals @ normals.T) > parallel) @ areas
    first = normals[alike.argmax()]
    across = np.where(np.abs(normals @ first) < np.sqrt(1 - parallel**2), alike, 0.0)
    if across.max() == 0:
        return None
    second = normals[across.argmax()]
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    axes = np.stack([first, second, np.cross(first, second)])
    for _ in range(3):
        # The mean of what is parallel to each direction (large planes are fitted best), and the nearest rotation.
        fit = normals @ axes.T
        weight = np.where(np.abs(fit) > parallel, np.sign(fit), 0.0) * areas[:, None] ** 2
        mean = weight.T @ normals
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        mean = np.where(length > 0, mean / np.where(length > 0, length, 1.0), axes)
        u, _, vt = np.linalg.svd(mean)
        axes = u @ vt
    on = areas[(np.abs(normals @ axes.T) > parallel).any(axis=1)].sum()
    # 0.5: of the mesh that has to lie on such planes; else it is no place of boxes
    if on < 0.5 * whole_m2:
        return None
    main = np.abs(axes).argmax(axis=1)
    if len(set(main)) == 3:  # in the order and sense of the world axes
        axes = axes[np.argsort(main)]
        axes = axes * np.sign(np.diag(axes))[:, None]
    elif np.linalg.det(axes) < 0:
        axes = -axes
    return axes
