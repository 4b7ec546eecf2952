"""Stage 1: from photos and a few surveyed camera positions to Gaussians, a mesh and its planar patches, in metres.

Structure from motion, similarity to metres, cleaning, planes, initial Gaussians, photometric refinement, depth maps,
fusion, planar patches. Every finished step is kept in the workspace under a fingerprint of all that it was made from:
a stopped run continues, a changed input starts over from the first step it changes.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import Progress, require
from warprrf.geometry import sfm, surface, sweep
from warprrf.geometry.camera import Camera
from warprrf.geometry.config import ReconstructionConfig
from warprrf.geometry.edges import meeting
from warprrf.geometry.fusion import fuse_gaussians
from warprrf.geometry.gaussians import Gaussians
from warprrf.geometry.initial import initial_gaussians, seen_cells
from warprrf.geometry.planes import Plane, aligned, occupancy
from warprrf.geometry.reconstruction import Reconstruction
from warprrf.geometry.refine import refine
from warprrf.geometry.stored import Steps

# Without surveyed positions the scale is unknown: the median distance from a camera to a point it sees becomes this.
ASSUMED_DISTANCE_M = 3.0


def reconstruct(
    photos: Any,
    *,
    workspace: str | os.PathLike[str],
    known_positions: Mapping[str, Any] | None = None,
    held_out: Sequence[str] = (),
    iterations: int | None = None,
    config: ReconstructionConfig | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    device: Any = None,
) -> Reconstruction:
    """Geometry of a static place from photos of it.

    Args:
        photos: a folder, or a sequence of image files: one size, one undistorted camera.
        workspace: folder of unfinished and finished steps; a stopped run continues from it.
        known_positions: photo name to surveyed camera position (3,) [m], three or more that are not on a line. Without
            them scale and axes are assumed: median viewing distance 3 m, z against the mean "down" of the photos.
        held_out: names of photos that get a pose but that the Gaussians are not fitted to.
        iterations: of the photometric refinement; default: the configuration's.
        config: all other settings.
        seed: seed of every random draw.
        progress: ``progress(stage, done, total)``.
        device: Warp device of the refinement and the depth maps.

    Raises:
        ValueError: for bad photos or positions (see :func:`~warprrf.geometry.sfm.structure_from_motion` and
            :func:`~warprrf.geometry.sfm.align_to_known`).
        ImportError: if the extra ``photos`` is not installed.
    """
    config = config or ReconstructionConfig()
    if iterations is not None:
        config = replace(config, refine=replace(config.refine, iterations=iterations))
    report = progress or (lambda stage, done, total: None)
    named = sfm.find_photos(photos)
    skipped = set(sfm.match_names("held_out", held_out, list(named)))
    if known_positions is not None:
        sfm.match_names("known_positions", known_positions, list(named))
    steps = Steps(Path(workspace))

    sparse = sfm.structure_from_motion(
        photos,
        workspace=workspace,
        max_features=config.max_features,
        pairs=config.pairs,
        seed=seed,
        progress=progress,
    )
    sparse = (
        sfm.align_to_known(sparse, known_positions) if known_positions is not None else _assumed_scale(sparse)
    )
    cameras = {n: c for n, c in sparse.cameras.items() if n not in skipped}
    if not cameras:
        raise ValueError(
            f"held_out: all {len(sparse.cameras)} posed photos are held out; none is left to fit to"
        )

    before = [
        (Path(workspace) / "sfm" / "photos.json").read_text(),
        [[n, c.world_to_camera.tolist()] for n, c in sparse.cameras.items()],
        sorted(skipped),
        asdict(config),
        seed,
    ]
    start_key = _fingerprint(before)
    images: list[np.ndarray] = []

    def photos_of(cameras: Mapping[str, Camera]) -> list[np.ndarray]:
        if not images:
            images.extend(read_photo(named[n]) for n in cameras)
        return images

    kept = steps.load("start", start_key)
    if kept is None:
        report("planes", 0, 5)
        planes, start = _start(sparse, cameras, photos_of(cameras), config, seed, report, device)
        steps.save("start", start_key, gaussians=start, planes=planes)
    else:
        planes, start = kept.planes, kept.gaussians

    kept = steps.load("refined", start_key)
    if kept is None:
        gaussians = refine(
            start,
            photos_of(cameras),
            list(cameras.values()),
            config=config.refine,
            planes=planes,
            seed=seed,
            progress=progress,
            checkpoint=steps.only(f"refine-{start_key[:12]}.checkpoint", "refine-*.checkpoint"),
            device=device,
        )
        steps.save("refined", start_key, gaussians=gaussians)
    else:
        gaussians = kept.gaussians
    images.clear()

    kept = steps.load("surface", start_key)
    if kept is None:
        mesh, patches = fuse_gaussians(
            gaussians,
            list(sparse.cameras.values()),
            planes=planes,
            config=config,
            progress=progress,
            device=device,
        )
        steps.save("surface", start_key, mesh=mesh, patches=patches)
    else:
        mesh, patches = kept.mesh, kept.patches
    return Reconstruction(
        gaussians,
        mesh,
        sparse.cameras,
        patches=patches,
        planes=planes,
        scale_rms_m=sparse.scale_rms_m,
        metric=sparse.metric,
        unposed=sparse.unposed,
        held_out=sorted(skipped),
    )


def read_photo(path: str | os.PathLike[str]) -> np.ndarray:
    """A photo as RGB in [0, 1], shape ``(H, W, 3)`` float32.

    Raises:
        ValueError: if the file does not read as an image.
    """
    image = require("PIL.Image", extra="photos")
    try:
        with image.open(path) as photo:
            return np.asarray(photo.convert("RGB"), dtype=np.float32) / 255
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"photos: {path} does not read as an image: {error}") from error


def _start(
    sparse: sfm.SparseModel,
    cameras: Mapping[str, Camera],
    images: Sequence[np.ndarray],
    config: ReconstructionConfig,
    seed: int,
    report: Progress,
    device: Any = None,
) -> tuple[list[Plane], Gaussians]:
    """Planes of the sparse points and the Gaussians that refinement starts from."""
    if len(sparse.points) < 3:
        raise ValueError(
            f"photos: only {len(sparse.points)} points were reconstructed; more overlap is needed"
        )
    keep = surface.clean_points(
        sparse.points,
        reprojection_error=sparse.reprojection_error,
        track_length=sparse.track_length,
        max_reprojection_error=config.max_reprojection_error,
    )
    if keep.sum() < 3:  # a handful of photos: few points are seen three times
        keep[:] = True
    sparse = sparse.subset(keep)
    normals = surface.estimate_normals(sparse.points, sparse.viewpoints())
    planes = surface.detect_room_planes(
        sparse.points,
        normals,
        sparse.viewpoints(),
        distance_m=config.plane_distance_m,
        min_points=config.plane_points,
        seed=seed,
    )
    planes = aligned(planes, sparse.points) if sparse.metric else planes
    eyes = np.array([c.position for c in sparse.cameras.values()])[sparse.track_camera]
    targets = np.repeat(sparse.points, sparse.track_length, axis=0)
    planes = occupancy(planes, sparse.points, eyes, targets, cell_m=config.cell_m)
    report("planes", 1, 5)
    if config.sweep and len(cameras) > 2 and planes:
        photos = sweep.Photos.upload(list(cameras.values()), images, device)
        planes = sweep.proven_cells(planes, sparse.points, photos)
        report("planes", 2, 5)
        if sparse.metric:  # else z is not up
            levels = []
            for k, up in enumerate((True, False)):
                levels += sweep.level_planes(
                    planes, sparse.points, photos, eyes, targets, cell_m=config.cell_m, up=up
                )
                report("planes", 3 + k, 5)
            planes = sweep.joined(planes, levels)
    planes = seen_cells(meeting(planes), list(sparse.cameras.values()))
    start = initial_gaussians(
        sparse.points, sparse.colors, normals, planes, list(cameras.values()), images, count=config.gaussians
    )
    report("planes", 5, 5)
    return planes, start


def _assumed_scale(sparse: sfm.SparseModel) -> sfm.SparseModel:
    """``sparse`` with z up and a plausible size, where nobody measured either."""
    poses = list(sparse.cameras.values())
    up = -np.mean([c.rotation[1] for c in poses], axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else np.array([0.0, 0.0, 1.0])
    ahead = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([ahead, np.cross(up, ahead), up])
    positions = np.array([c.position for c in poses])
    gap = np.linalg.norm(
        np.repeat(sparse.points, sparse.track_length, axis=0) - positions[sparse.track_camera], axis=1
    )
    scale = ASSUMED_DISTANCE_M / float(np.median(gap)) if len(gap) else 1.0
    return sfm.transformed(sparse, scale, rotation, -scale * rotation @ positions.mean(axis=0))


def _fingerprint(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()
