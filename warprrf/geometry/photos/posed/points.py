"""Sparse points of structure from motion: cleaned, with normals, and the planes of a room among them. In metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from warprrf.checks import check_array
from warprrf.geometry.planes import Plane, PlaneConfig, detect_planes

NEIGHBOURS = 16  # that a point is compared with


def neighbours(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices and distances [m] of the ``count`` nearest other points of each, nearest first, shape ``(P, count)``."""
    distance, index = cKDTree(points).query(points, k=np.arange(2, min(count + 1, len(points)) + 1))
    return index, distance


def clean_points(
    points: ArrayLike,
    *,
    reprojection_error: ArrayLike | None = None,
    track_length: ArrayLike | None = None,
) -> np.ndarray:
    """Which points to keep, shape ``(P,)`` bool: seen often enough, reprojected well, not far from all others.

    A point is an outlier when its mean distance to its neighbours exceeds the average of that figure over all points
    by 2.5 standard deviations (Rusu et al., "Towards 3D point cloud based object maps", 2008).

    Args:
        points: shape ``(P, 3)``.
        reprojection_error: mean reprojection error of each point [pixels], shape ``(P,)``.
        track_length: number of photos that see each point, shape ``(P,)``.
    """
    points = check_array("points", points, (None, 3))
    keep = np.ones(len(points), dtype=bool)
    if reprojection_error is not None:
        error = check_array("reprojection_error", reprojection_error, (len(points),))
        # 1.0: of a sparse point that is kept [pixels]
        keep &= error <= 1.0
    min_track_length = 3  # photos that see a point which is kept
    if track_length is not None:
        keep &= check_array("track_length", track_length, (len(points),)) >= min_track_length
    chosen = np.flatnonzero(keep)
    deviations = 2.5  # by which an outlier is farther from its neighbours than others
    if len(chosen) > NEIGHBOURS:
        spacing = neighbours(points[chosen], NEIGHBOURS)[1].mean(axis=1)
        keep[chosen[spacing > spacing.mean() + deviations * spacing.std()]] = False
    return keep


def estimate_normals(
    points: ArrayLike, viewpoints: ArrayLike, *, neighbour_count: int = NEIGHBOURS
) -> np.ndarray:
    """Unit normals from the neighbourhood of each point, turned to the side of ``viewpoints``, shape ``(P, 3)``.

    Args:
        points: shape ``(P, 3)``.
        viewpoints: a place each point was seen from, shape ``(P, 3)`` (or one for all, ``(3,)``).

    Raises:
        ValueError: for fewer than three points.
    """
    points = check_array("points", points, (None, 3))
    if len(points) < 3:
        raise ValueError(f"points: got {len(points)}, expected at least 3 to estimate normals")
    index, gap = neighbours(points, neighbour_count)
    # Weights fall off with distance, so that a far neighbour on another surface counts little.
    weight = 1 / (1 + (gap / np.maximum(np.median(gap, axis=1, keepdims=True), 1e-9)) ** 2)
    local = points[index] - points[:, None]
    local -= (weight[..., None] * local).sum(axis=1, keepdims=True) / weight.sum(axis=1)[:, None, None]
    normals: np.ndarray = np.linalg.eigh(np.einsum("nk,nki,nkj->nij", weight, local, local))[1][:, :, 0]
    away = ((np.asarray(viewpoints, dtype=np.float64) - points) * normals).sum(axis=1) < 0
    normals[away] *= -1
    return normals


def detect_room_planes(
    points: np.ndarray,
    normals: np.ndarray,
    viewpoints: np.ndarray,
    *,
    config: PlaneConfig | None = None,
    seed: int = 0,
) -> list[Plane]:
    """Planes among sparse points in two passes: the large ones, then small ones among the points left over.

    Beside a wall the neighbourhood of a small surface is full of the wall's points, and its normals are poor; without
    them they are good enough for small planes (compact ones: within 1.5 m of their middle).
    """
    config = config or PlaneConfig()
    large = detect_planes(points, normals, config=config, seed=seed)
    # A point on a large plane, seen from its front, belongs to it even where its own normal is off.
    free = np.ones(len(points), dtype=bool)
    for plane in large:
        on = np.abs(plane.distance(points)) < 2 * config.distance_m
        near = cKDTree(points[plane.inliers]).query(points)[0] < 0.3
        free &= ~(on & near & (plane.distance(viewpoints) > 0))
    rest = np.flatnonzero(free)
    small_points = 16  # fewest points of a small plane, looked for among those that the large ones leave
    if len(rest) < small_points:
        return large
    again = estimate_normals(points[rest], viewpoints[rest], neighbour_count=10)
    small = detect_planes(points[rest], again, config=replace(config, min_points=small_points), seed=seed)
    compact = []
    for plane in small:
        own = points[rest[plane.inliers]]
        close = np.linalg.norm(own - np.median(own, axis=0), axis=1) < 1.5
        if close.sum() >= small_points and close.mean() > 0.6:
            compact.append(replace(plane, inliers=rest[plane.inliers[close]]))
    return large + compact
