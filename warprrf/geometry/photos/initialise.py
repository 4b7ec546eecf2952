"""Before the refinement: sparse points cleaned, their planes found, completed and covered with Gaussians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from warprrf.device import DeviceLike, Progress
from warprrf.geometry.photos.cells import meeting, occupancy, seen_cells
from warprrf.geometry.photos.completion.room_planes import directions
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.initial_gaussians import initial_gaussians
from warprrf.geometry.photos.plain import plain_surfaces, with_plain
from warprrf.geometry.photos.planes import Plane, aligned
from warprrf.geometry.photos.points import clean_points, detect_room_planes, estimate_normals
from warprrf.geometry.photos.sparse import SparseModel
from warprrf.geometry.photos.sweep import GreyPhotos, joined, level_planes, proven_cells
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians


def initialise(
    sparse: SparseModel,
    cameras: Mapping[str, Camera],
    images: Sequence[np.ndarray],
    *,
    config: ReconstructionConfig,
    seed: int = 0,
    progress: Progress | None = None,
    device: DeviceLike = None,
) -> tuple[list[Plane], Gaussians]:
    """Planes of the sparse points, and the Gaussians that refinement starts from.

    Args:
        sparse: posed cameras and points [m], those of held-out photos among them.
        cameras: of the photos that the Gaussians are fitted to.
        images: these photos, shape ``(H, W, 3)`` each, in [0, 1].
        config: settings.
        seed: of the plane detection.
        progress: called with ``"planes"``.
        device: Warp device of the sweeps.

    Raises:
        ValueError: for fewer than three points.
    """
    report = progress or (lambda stage, done, total: None)
    report("planes", 0, 6)
    if len(sparse.points) < 3:
        raise ValueError(
            f"photos: only {len(sparse.points)} points were reconstructed; more overlap is needed"
        )
    keep = clean_points(
        sparse.points,
        reprojection_error=sparse.reprojection_error,
        track_length=sparse.track_length,
    )
    if keep.sum() < 3:  # a handful of photos: few points are seen three times
        keep[:] = True
    sparse = sparse.subset(keep)
    points, viewpoints = sparse.points, sparse.viewpoints()
    normals = estimate_normals(points, viewpoints)
    planes = detect_room_planes(points, normals, viewpoints, config=config.planes, seed=seed)
    level = sparse.metric and sparse.upright
    planes = aligned(planes, points) if level else planes
    eyes = np.array([c.position for c in sparse.cameras.values()])[sparse.track_camera]
    lines = eyes, np.repeat(points, sparse.track_length, axis=0)
    planes = occupancy(planes, points, *lines, config=config.planes)
    report("planes", 1, 6)
    if config.sweep and len(cameras) > 2 and planes:
        photos = GreyPhotos.upload(list(cameras.values()), images, device)
        planes = proven_cells(planes, points, photos)
        report("planes", 2, 6)
        if level:
            levels = []
            for k, up in enumerate((True, False)):
                levels += level_planes(planes, points, photos, lines, cell_m=config.planes.cell_m, up=up)
                report("planes", 3 + k, 6)
            planes = joined(planes, levels)
    real = np.ones(len(points), dtype=bool)
    axes = _axes(planes) if config.plain else None
    if axes is not None:
        plain = plain_surfaces(list(cameras.values()), images, axes)
        reflected = plain.reflected(*lines)
        sight = lines[0][~reflected], lines[1][~reflected]
        planes = with_plain(planes, plain.planes, points, sight)
        real = np.add.reduceat(reflected, sparse.track_start[:-1]) < 0.5 * sparse.track_length
    report("planes", 5, 6)
    planes = seen_cells(meeting(planes), list(sparse.cameras.values()))
    gaussians = initial_gaussians(
        points[real],
        sparse.colors[real],
        normals[real],
        planes,
        list(cameras.values()),
        images,
        count=config.gaussians,
    )
    report("planes", 6, 6)
    return planes, gaussians


def _axes(planes: Sequence[Plane]) -> np.ndarray | None:
    """The three directions that most of the planes face along, shape ``(3, 3)``; None when there are none."""
    known = [plane for plane in planes if plane.occupied.any()]
    areas = np.array([plane.area() for plane in known])
    normals = np.array([plane.normal for plane in known])
    return directions(normals, areas, float(areas.sum()))
