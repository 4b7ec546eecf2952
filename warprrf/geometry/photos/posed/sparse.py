"""Posed cameras with a sparse point cloud: brought to metres by a similarity, its points cleaned and given normals, and planes
found among them.

Structure from motion leaves units and axes of its own. A similarity fitted to surveyed camera positions brings both to
the world; without a survey a plausible one is assumed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from warprrf.checks import check_array, check_positive, check_similarity, some_of
from warprrf.geometry.photos.posed.photo_files import match_names
from warprrf.geometry.photos.posed.undistort import Lens
from warprrf.geometry.planes import Plane, PlaneConfig, detect_planes
from warprrf.geometry.splats.camera import Camera


@dataclass(frozen=True)
class SparseModel:
    """Posed cameras and a sparse point cloud.

    Attributes:
        cameras: photo name to :class:`Camera`, for the photos that were posed.
        points: 3D points, shape ``(P, 3)`` float64; metres once aligned, arbitrary units before.
        colors: colour of each point in [0, 1], shape ``(P, 3)``.
        reprojection_error: mean reprojection error of each point [pixels of ``cameras``], shape ``(P,)``.
        track_length: number of photos that see each point, shape ``(P,)`` int64.
        track_camera: photos (position in ``list(cameras)``) that see the points, point by point, shape
            ``(sum of track lengths,)``.
        unposed: names of the photos that no pose was found for, or that lie in a smaller, separate model.
        pieces: names of the photos of each model that too few features join to the others; ``cameras`` are those of the first.
        metric: whether lengths are metres.
        upright: whether z is up.
        causes, scale_rms_m, guessed: as of :class:`~warprrf.geometry.reconstruction.Reconstruction`.
        photos: the files that ``cameras`` show: undistorted, upright, reduced; by photo name.
        lenses: of the photos as they were taken, by photo name.
    """

    cameras: dict[str, Camera]
    points: np.ndarray
    colors: np.ndarray
    reprojection_error: np.ndarray
    track_length: np.ndarray
    track_camera: np.ndarray
    unposed: tuple[str, ...] = ()
    causes: Mapping[str, str] = field(default_factory=dict)
    pieces: tuple[tuple[str, ...], ...] = ()
    metric: bool = False
    upright: bool = False
    scale_rms_m: float = float("nan")
    guessed: tuple[str, ...] = ()
    photos: dict[str, Path] = field(default_factory=dict)
    lenses: dict[str, Lens] = field(default_factory=dict)

    @property
    def track_start(self) -> np.ndarray:
        """Where each point's photos begin in ``track_camera``, and where the last one's end, shape ``(P + 1,)`` int64."""
        return np.append(0, np.cumsum(self.track_length))

    def lines_of_sight(self) -> tuple[np.ndarray, np.ndarray]:
        """Eyes and points of all tracks [m], shape ``(sum of track lengths, 3)`` each."""
        positions = np.array([camera.position for camera in self.cameras.values()])
        return positions[self.track_camera], np.repeat(self.points, self.track_length, axis=0)

    def viewpoints(self) -> np.ndarray:
        """Mean position of the cameras that see each point, shape ``(P, 3)``: normals are turned towards it."""
        total = np.add.reduceat(self.lines_of_sight()[0], self.track_start[:-1], axis=0)
        return total / self.track_length[:, None]

    def subset(self, keep: np.ndarray) -> SparseModel:
        """The model with only the points where ``keep`` (boolean, shape ``(P,)``) is True."""
        return replace(
            self,
            points=self.points[keep],
            colors=self.colors[keep],
            reprojection_error=self.reprojection_error[keep],
            track_length=self.track_length[keep],
            track_camera=self.track_camera[np.repeat(keep, self.track_length)],
        )

    def transformed(
        self, *, scale: float = 1.0, rotation: ArrayLike | None = None, shift: ArrayLike = (0.0, 0.0, 0.0)
    ) -> SparseModel:
        """The model with every point ``x`` at ``scale rotation x + shift``; cameras move along.

        Arguments and errors: see :func:`warprrf.checks.check_similarity`.
        """
        scale, turn, moved = check_similarity(scale, rotation, shift)
        how: dict[str, Any] = {"scale": scale, "rotation": turn, "shift": moved}
        cameras = {name: camera.transformed(**how) for name, camera in self.cameras.items()}
        return replace(self, cameras=cameras, points=scale * self.points @ turn.T + moved)


def posed_in_words(sparse: SparseModel) -> str:
    """How many photos were posed, between which more are missing, and which are in no piece; empty where all were posed."""
    if not sparse.unposed:
        return ""
    order = sorted((*sparse.cameras, *sparse.unposed))
    said = f"photos: {len(sparse.cameras)} of {len(order)} posed"
    main, gaps = [order.index(name) for name in sparse.cameras], []
    for piece in sparse.pieces[1:]:
        near = min((abs(k - m), m, k) for k in map(order.index, piece) for m in main)
        gaps.append(" and ".join(order[k] for k in sorted(near[1:])))
    if gaps:
        said += (
            f" in the largest of {len(sparse.pieces)} pieces that too few features join: "
            f"add photos between {'; between '.join(gaps)}"
        )
    alone = [name for name in sparse.unposed if not any(name in piece for piece in sparse.pieces[1:])]
    return f"{said}; without a pose: {some_of(alone)}" if alone else said


def align_to_known(sparse: SparseModel, known_positions: Mapping[str, ArrayLike]) -> SparseModel:
    """``sparse`` in metres and world axes, by the similarity that best meets surveyed camera positions.

    Args:
        known_positions: photo name (or its file name, where that is unique) to camera position (3,) [m].

    Raises:
        ValueError: for fewer than three positions, positions on one line, a name that is no photo, or a surveyed
            photo that could not be posed.
    """
    scale, rotation, shift, rms_m = known_similarity(sparse.cameras, sparse.unposed, known_positions)
    moved = sparse.transformed(scale=scale, rotation=rotation, shift=shift)
    return replace(moved, metric=True, upright=True, scale_rms_m=rms_m)


def check_known(known_positions: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """Surveyed camera positions (3,) [m] by photo, three or more."""
    found = {n: check_array(f"known_positions[{n!r}]", p, (3,)) for n, p in known_positions.items()}
    if len(found) < 3:
        raise ValueError(
            f"known_positions: got {len(found)}, expected at least 3 camera positions that are not on a line"
        )
    return found


def known_similarity(
    cameras: Mapping[str, Camera], unposed: Sequence[str], known_positions: Mapping[str, ArrayLike]
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Scale, rotation and shift that bring ``cameras``, by photo name, to surveyed positions, and the rms distance that is
    left there [m]; see :func:`align_to_known` for both and errors."""
    known_positions = check_known(known_positions)
    names = match_names("known_positions", known_positions, (*cameras, *unposed))
    lost = [n for n in names if n not in cameras]
    usable = {n: p for n, p in zip(names, known_positions.values(), strict=True) if n in cameras}
    if len(usable) < 3:
        raise ValueError(
            f"known_positions: {len(cameras)} of {len(cameras) + len(unposed)} photos were posed, but only {len(usable)} of "
            "the surveyed ones, expected at least 3; "
            f"without pose: {some_of(lost)}"
        )
    source = np.array([cameras[n].position for n in usable])
    target = np.array(list(usable.values()))
    try:
        scale, rotation, shift = fit_similarity(source, target)
    except ValueError as error:
        raise ValueError(f"known_positions: {error}") from error
    rms = float(np.sqrt(((scale * source @ rotation.T + shift - target) ** 2).sum(axis=1).mean()))
    return scale, rotation, shift, rms


Scale = float | tuple[str, str, float]
"""Metres for each unit of a model, or two photos and the distance between their cameras [m]."""


def check_scale(scale: Scale, names: Sequence[str]) -> Scale:
    """``scale`` with the full names of two of the photos ``names``."""
    if not isinstance(scale, (tuple, list)):
        return check_positive("scale", scale, "number of metres for each unit")
    if len(scale) != 3:
        raise ValueError(
            f'scale: got {scale!r}, expected ("a.jpg", "b.jpg", metres): two photos and how far apart their cameras were'
        )
    first, second = match_names("scale", scale[:2], names)
    return first, second, check_positive("scale", scale[2], "distance in metres between two cameras")


def scaled(sparse: SparseModel, scale: Scale) -> SparseModel:
    """``sparse`` in metres, axes as they are."""
    scale = check_scale(scale, (*sparse.cameras, *sparse.unposed))
    if isinstance(scale, tuple):
        lost = [name for name in scale[:2] if name not in sparse.cameras]
        if lost:
            raise ValueError(f"scale: no pose was found for {some_of(lost)}; name two photos that have one")
        positions = np.array([c.position for c in sparse.cameras.values()])
        gap = float(np.linalg.norm(sparse.cameras[scale[0]].position - sparse.cameras[scale[1]].position))
        if gap <= 1e-3 * float(np.ptp(positions, axis=0).max()):
            raise ValueError(
                f"scale: {scale[0]} and {scale[1]} were taken at one place; name two photos that are far apart"
            )
        scale = scale[2] / gap
    return replace(sparse.transformed(scale=scale), metric=True)


def assume_scale(sparse: SparseModel) -> SparseModel:
    """``sparse`` in a plausible size, axes as they are, where nobody measured any."""
    eyes, points = sparse.lines_of_sight()
    gap = np.linalg.norm(points - eyes, axis=1)
    # Without surveyed positions the scale is unknown: the median distance from a camera to a point it sees becomes this.
    assumed_distance_m = 3.0
    scale = assumed_distance_m / float(np.median(gap)) if len(gap) else 1.0
    said = f"scale: nobody measured one; the median distance that photos look is taken for {assumed_distance_m:g} m"
    return replace(sparse.transformed(scale=scale), guessed=(*sparse.guessed, said))


def fit_similarity(source: ArrayLike, target: ArrayLike) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale ``s``, rotation ``R`` (3, 3) and shift ``t`` (3,) that minimise ``sum |s R source + t - target|^2``.

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 13(4),
    1991, eqs. (40) to (43). Float64 throughout.
    """
    source = check_array("source", source, (None, 3))
    target = check_array("target", target, (len(source), 3))
    if len(source) < 3:
        raise ValueError(f"source: got {len(source)} points, expected at least 3")
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    for name, centred in (("source", a), ("target", b)):
        spread = np.linalg.svd(centred, compute_uv=False)
        if spread[1] <= 1e-6 * spread[0] or spread[0] == 0:
            raise ValueError(
                f"{name}: the points lie on one line (or coincide), so that the rotation is not fixed"
            )
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / (a**2).sum())
    return scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)


NEIGHBOURS = 16  # that a point is compared with


def neighbours(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices and distances [m] of the ``count`` nearest other points of each, nearest first, shape ``(P, count)``."""
    distance, index = cKDTree(points).query(points, k=np.arange(2, min(count + 1, len(points)) + 1))
    return index, distance


def cleaned(sparse: SparseModel, worst_px: float = np.inf) -> SparseModel:
    """``sparse`` with the points that are seen often enough, reprojected well and not far from all others; with all where
    fewer than three are, as of a handful of photos.

    A point is an outlier when its mean distance to its neighbours exceeds the average of that figure over all points
    by 2.5 standard deviations (Rusu et al., "Towards 3D point cloud based object maps", 2008).
    """
    min_track_length = 3  # photos that see a point which is kept
    keep = (sparse.reprojection_error <= worst_px) & (sparse.track_length >= min_track_length)
    chosen = np.flatnonzero(keep)
    deviations = 2.5  # by which an outlier is farther from its neighbours than others
    if len(chosen) > NEIGHBOURS:
        spacing = neighbours(sparse.points[chosen], NEIGHBOURS)[1].mean(axis=1)
        keep[chosen[spacing > spacing.mean() + deviations * spacing.std()]] = False
    return sparse if keep.sum() < 3 else sparse.subset(keep)


def estimate_normals(points: np.ndarray, viewpoints: np.ndarray, count: int) -> np.ndarray:
    """Unit normals from ``count`` neighbours of each point, turned to the side of ``viewpoints``; all of shape ``(P, 3)``."""
    index, gap = neighbours(points, count)
    # Weights fall off with distance, so that a far neighbour on another surface counts little.
    weight = 1 / (1 + (gap / np.maximum(np.median(gap, axis=1, keepdims=True), 1e-9)) ** 2)
    local = points[index] - points[:, None]
    local -= (weight[..., None] * local).sum(axis=1, keepdims=True) / weight.sum(axis=1)[:, None, None]
    normals = np.linalg.eigh(np.einsum("nk,nki,nkj->nij", weight, local, local))[1][:, :, 0]
    away = ((viewpoints - points) * normals).sum(axis=1) < 0
    normals[away] *= -1
    return normals


def detect_room_planes(sparse: SparseModel, config: PlaneConfig, seed: int) -> tuple[list[Plane], np.ndarray]:
    """Planes among sparse points, three or more, in two passes: the large ones, then small ones among the points left over;
    and the normals of all points.

    Beside a wall the neighbourhood of a small surface is full of the wall's points, and its normals are poor; without
    them they are good enough for small planes (compact ones: within 1.5 m of their middle).
    """
    points, viewpoints = sparse.points, sparse.viewpoints()
    normals = estimate_normals(points, viewpoints, NEIGHBOURS)
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
        return large, normals
    again = estimate_normals(points[rest], viewpoints[rest], 10)
    small = detect_planes(points[rest], again, config=replace(config, min_points=small_points), seed=seed)
    compact = []
    for plane in small:
        own = points[rest[plane.inliers]]
        close = np.linalg.norm(own - np.median(own, axis=0), axis=1) < 1.5
        if close.sum() >= small_points and close.mean() > 0.6:
            compact.append(replace(plane, inliers=rest[plane.inliers[close]]))
    return large + compact, normals
