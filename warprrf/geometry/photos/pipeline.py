"""Stage 1: from photos and a few surveyed camera positions to Gaussians, a mesh and its planar patches, in metres.

Structure from motion, similarity to metres, cleaning, planes, initial Gaussians, photometric refinement, depth maps,
fusion, planar patches. Every finished step is kept in the workspace under a fingerprint of all that it was made from,
inputs and code: a stopped run continues, a change starts over from the first step that it changes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.geometry.geometry_files import Steps
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.fusion import fuse_gaussians
from warprrf.geometry.photos.photo_files import find_photos, match_names, read_photo
from warprrf.geometry.photos.refine import refine
from warprrf.geometry.photos.sfm import structure_from_motion
from warprrf.geometry.photos.sparse import align_to_known, assume_scale
from warprrf.geometry.photos.start import start_of
from warprrf.geometry.reconstruction import Reconstruction
from warprrf.geometry.splats.camera import Camera
from warprrf.marks import code_mark

STEP_CODE = {
    "start": (("warprrf.geometry.photos.start", "warprrf.geometry.photos.photo_files"), ("open3d", "PIL")),
    "refined": (("warprrf.geometry.photos.refine", "warprrf.geometry.photos.photo_files"), ("PIL",)),
    "surface": (("warprrf.geometry.photos.fusion",), ("open3d",)),
}
"""Modules that a step after structure from motion runs, and the packages whose version counts."""


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
        ValueError: for bad photos or positions (see :func:`~warprrf.geometry.photos.sfm.structure_from_motion` and
            :func:`~warprrf.geometry.photos.sparse.align_to_known`).
        ImportError: if the extra ``photos`` is not installed.
    """
    config = config or ReconstructionConfig()
    if iterations is not None:
        config = replace(config, refine=replace(config.refine, iterations=iterations))
    named = find_photos(photos)
    skipped = set(match_names("held_out", held_out, list(named)))
    if known_positions is not None:
        match_names("known_positions", known_positions, list(named))

    sparse = structure_from_motion(
        photos,
        workspace=workspace,
        max_features=config.max_features,
        pairs=config.pairs,
        seed=seed,
        progress=progress,
    )
    sparse = align_to_known(sparse, known_positions) if known_positions is not None else assume_scale(sparse)
    cameras = {n: c for n, c in sparse.cameras.items() if n not in skipped}
    if not cameras:
        raise ValueError(
            f"held_out: all {len(sparse.cameras)} posed photos are held out; none is left to fit to"
        )
    steps = Steps(
        Path(workspace),
        [
            (Path(workspace) / "sfm" / "photos.json").read_text(),
            [[n, c.world_to_camera.tolist()] for n, c in sparse.cameras.items()],
            sorted(skipped),
            asdict(config),
            seed,
        ],
    )
    images: list[np.ndarray] = []

    def photos_of(cameras: Mapping[str, Camera]) -> list[np.ndarray]:
        if not images:
            images.extend(read_photo(named[n]) for n in cameras)
        return images

    def make_start(key: str) -> dict[str, Any]:
        planes, gaussians = start_of(
            sparse, cameras, photos_of(cameras), config=config, seed=seed, progress=progress, device=device
        )
        return {"planes": planes, "gaussians": gaussians}

    def make_refined(key: str) -> dict[str, Any]:
        gaussians = refine(
            start.gaussians,
            photos_of(cameras),
            list(cameras.values()),
            config=config.refine,
            planes=planes,
            seed=seed,
            progress=progress,
            checkpoint=steps.only(f"refine-{key[:12]}.checkpoint", "refine-*.checkpoint"),
            device=device,
        )
        return {"gaussians": gaussians}

    def make_surface(key: str) -> dict[str, Any]:
        mesh, patches = fuse_gaussians(
            gaussians,
            list(sparse.cameras.values()),
            planes=planes,
            config=config,
            progress=progress,
            device=device,
        )
        return {"mesh": mesh, "patches": patches}

    start = steps.step("start", code_of("start"), make_start)
    planes = start.planes
    gaussians = steps.step("refined", code_of("refined"), make_refined).gaussians
    images.clear()
    surface = steps.step("surface", code_of("surface"), make_surface)
    return Reconstruction(
        gaussians,
        surface.mesh,
        sparse.cameras,
        patches=surface.patches,
        planes=planes,
        scale_rms_m=sparse.scale_rms_m,
        metric=sparse.metric,
        unposed=sparse.unposed,
        held_out=sorted(skipped),
    )


def code_of(step: str) -> str:
    """Mark of the code of a step of :data:`STEP_CODE`."""
    modules, packages = STEP_CODE[step]
    return code_mark(*modules, packages=packages)
