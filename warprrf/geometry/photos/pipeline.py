"""Stage 1: from photos and a few surveyed camera positions to Gaussians, a mesh and its planar patches, in metres.

Structure from motion, similarity to metres, cleaning, planes, initial Gaussians, photometric refinement, depth maps,
fusion, planar patches. Every finished step is kept in the workspace for the inputs that it was made from: a stopped
run continues, a change starts over from the first step that it changes.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from warprrf.device import Progress
from warprrf.geometry import geometry_files as files
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.fusion import fuse_gaussians
from warprrf.geometry.photos.photo_files import find_photos, match_names, read_photo
from warprrf.geometry.photos.planes import Plane
from warprrf.geometry.photos.refine import refine
from warprrf.geometry.photos.sfm import structure_from_motion
from warprrf.geometry.photos.sparse import SparseModel, align_to_known, assume_scale
from warprrf.geometry.photos.start import start_of
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.reconstruction import Reconstruction
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.steps import Attempt, Steps

VERSIONS = {"start": 1, "refined": 1, "surface": 1}
"""Of the steps after structure from motion: counted up by whoever changes what a step computes."""


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
    if iterations is None:
        iterations = config.refine.iterations
    refinement = replace(config.refine, seed=seed, iterations=iterations)
    config = replace(config, refine=refinement)
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
    fitted = {name: named[name] for name in sparse.cameras if name not in skipped}
    if not fitted:
        raise ValueError(
            f"held_out: all {len(sparse.cameras)} posed photos are held out; none is left to fit to"
        )
    with Steps(workspace, progress=progress) as steps:
        planes, start = _start(steps, sparse, fitted, config, seed, device)
        gaussians = _refined(steps, sparse, fitted, planes, start, config, device)
        patches = _surface(steps, sparse, planes, gaussians, config, device)
    return Reconstruction(
        gaussians,
        patches.mesh,
        sparse.cameras,
        patches=patches,
        scale_rms_m=sparse.scale_rms_m,
        metric=sparse.metric,
        unposed=sparse.unposed,
        held_out=sorted(skipped),
    )


def _start(
    steps: Steps,
    sparse: SparseModel,
    fitted: Mapping[str, Path],
    config: ReconstructionConfig,
    seed: int,
    device: Any,
) -> tuple[list[Plane], Gaussians]:
    """Planes, and the Gaussians that refinement starts from."""
    path = steps.folder / "start.safetensors"

    def make(attempt: Attempt) -> dict[str, Any]:
        planes, gaussians = start_of(
            sparse,
            {name: sparse.cameras[name] for name in fitted},
            [read_photo(photo) for photo in fitted.values()],
            config=config,
            seed=seed,
            progress=attempt.progress,
            device=device,
        )
        files.write(path, {**files.of_planes(planes), **files.of_gaussians(gaussians)})
        return {"planes": len(planes), "gaussians": len(gaussians)}

    settings = [config.max_reprojection_error, config.planes, config.sweep, config.gaussians, seed]
    inputs = [sparse, list(fitted), list(fitted.values()), *settings]
    steps.run("start", make, version=VERSIONS["start"], inputs=inputs, outputs=[path.name])
    arrays, _ = files.read(path)
    return files.to_planes(arrays), files.to_gaussians(arrays)


def _refined(
    steps: Steps,
    sparse: SparseModel,
    fitted: Mapping[str, Path],
    planes: Sequence[Plane],
    start: Gaussians,
    config: ReconstructionConfig,
    device: Any,
) -> Gaussians:
    """The Gaussians that render the photos."""
    path = steps.folder / "refined.safetensors"

    def make(attempt: Attempt) -> dict[str, Any]:
        gaussians = refine(
            start,
            [read_photo(photo) for photo in fitted.values()],
            [sparse.cameras[name] for name in fitted],
            config=config.refine,
            planes=planes,
            progress=attempt.progress,
            checkpoint=attempt.folder / "checkpoint.safetensors",
            device=device,
        )
        files.write(path, files.of_gaussians(gaussians))
        return {"gaussians": len(gaussians)}

    inputs = [steps.key("start"), config.refine]
    steps.run("refined", make, version=VERSIONS["refined"], inputs=inputs, outputs=[path.name])
    return files.to_gaussians(files.read(path)[0])


def _surface(
    steps: Steps,
    sparse: SparseModel,
    planes: Sequence[Plane],
    gaussians: Gaussians,
    config: ReconstructionConfig,
    device: Any,
) -> PlanarPatches:
    """The mesh and its planar patches."""
    path = steps.folder / "surface.safetensors"

    def make(attempt: Attempt) -> dict[str, Any]:
        patches = fuse_gaussians(
            gaussians,
            list(sparse.cameras.values()),
            planes=planes,
            config=config,
            progress=attempt.progress,
            device=device,
        )
        files.write(path, files.of_patches(patches))
        return {"triangles": len(patches.mesh.faces), "patches": len(patches)}

    inputs = [steps.key("refined"), config.surface, config.completion]
    steps.run("surface", make, version=VERSIONS["surface"], inputs=inputs, outputs=[path.name])
    return files.to_patches(files.read(path)[0])
