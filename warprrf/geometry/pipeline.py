"""Stage 1: from photos and a few surveyed camera positions to Gaussians, a mesh and its planar patches, in metres.

Every finished step (see :mod:`warprrf.geometry.photos`) is kept in the workspace for the inputs that it was made from: a
stopped run continues, a change starts over from the first step that it changes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf import tensor_files
from warprrf.checks import check_choice, checked, warn
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh_files import UP
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.gaussians.initialise import initialise
from warprrf.geometry.photos.gaussians.refine import refine
from warprrf.geometry.photos.posed import sfm
from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.photos.posed.measured_depth import range_maps, with_points
from warprrf.geometry.photos.posed.photo_files import (
    Photos,
    find_photos,
    mask_beside,
    match_names,
    photo_facts,
    read_mask,
    read_photo,
)
from warprrf.geometry.photos.posed.poses import DepthFile, KnownPoses, find_depth, match_photos, read_poses
from warprrf.geometry.photos.posed.sparse import (
    SparseModel,
    align_to_known,
    assume_scale,
    check_known,
    check_scale,
    scaled,
)
from warprrf.geometry.photos.posed.upright import turned, upright
from warprrf.geometry.photos.surface.fusion import FEW_MAPS, depth_maps, depth_views, fuse_maps
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.reconstruction import (
    Arrays,
    Reconstruction,
    of_gaussians,
    of_patches,
    of_planes,
    to_gaussians,
    to_patches,
    to_planes,
)
from warprrf.geometry.report.sight import how_seen
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.steps import Attempt, Steps

VERSIONS = {**sfm.VERSIONS, "initial": 4, "refined": 2, "depth": 4, "surface": 12}
"""Of all steps: counted up by whoever changes what a step computes."""

MUCH_UNKNOWN = 0.25  # share of a surface that is worth a warning


@checked
def reconstruct(
    photos: Photos,
    *,
    workspace: str | os.PathLike[str],
    poses: str | os.PathLike[str] | None = None,
    depth: str | os.PathLike[str] | None = None,
    known_positions: Mapping[str, ArrayLike] | None = None,
    scale: float | tuple[str, str, float] | None = None,
    up: str | None = None,
    held_out: Sequence[str] = (),
    iterations: int | None = None,
    config: ReconstructionConfig | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    device: DeviceLike = None,
) -> Reconstruction:
    """Geometry of a static place from photos of it.

    Args:
        photos: a folder, or a sequence of image files, of any cameras and sizes. Lenses are estimated; EXIF's focal
            length and orientation are used; where ``NAME.mask.png`` beside a photo ``NAME.jpg`` is black, it is ignored.
        workspace: folder of unfinished and finished steps; a stopped run continues from it.
        poses: poses and lenses that are known already: a ``transforms.json`` of nerfstudio or instant-ngp (Polycam, Record3D
            and ARKit exports), the folder of a COLMAP model, or one of RGB-D frames as of 7-Scenes (``NAME.pose.txt``
            and ``camera-intrinsics.txt``). They are kept as they are; no structure from motion is done.
        depth: folder of depth images [mm], PNG of 16 bits named as the photos are, with ``poses``; by default those that
            ``poses`` names or that lie beside it. Depth is fused; lengths of ``poses`` are then metres.
        known_positions: photo name to surveyed camera position (3,) [m], three or more that are not on a line. Without
            them vertical edges, planes and the floor set z and its origin.
        scale: ``("a.jpg", "b.jpg", 1.52)``: how far apart the cameras of two photos were [m], where nobody surveyed
            positions; or metres for each unit of ``poses``, 1 where it is in metres. With none of these, the median
            distance that photos look is taken for 3 m.
        up: axis of ``poses`` that points up, ``"x"``, ``"y"`` or ``"z"``; its origin then stays, and with ``"z"`` all its axes.
        held_out: names of photos that get a pose but that the Gaussians are not fitted to.
        iterations: of the photometric refinement; default: the configuration's.
        config: all other settings.
        seed: seed of every random draw.
        progress: ``progress(stage, done, total)``.
        device: Warp device of the refinement and the depth maps.

    Raises:
        ValueError: for arguments that exclude or need one another, for files of poses or depth that are damaged, and for
            bad photos or positions (see
            :func:`~warprrf.geometry.photos.posed.sfm.structure_from_motion` and
            :func:`~warprrf.geometry.photos.posed.sparse.align_to_known`).
        ImportError: if the extra ``photos`` is not installed.
    """
    config = config or ReconstructionConfig()
    if iterations is None:
        iterations = config.refine.iterations
    refinement = replace(config.refine, seed=seed, iterations=iterations)
    config = replace(config, refine=refinement)
    named = find_photos(photos)
    skipped = set(match_names("held_out", dict.fromkeys(held_out), list(named)))
    _check_world(poses, depth, known_positions, scale, up)
    if known_positions is not None:
        match_names("known_positions", check_known(known_positions), list(named))
    if scale is not None:
        check_scale(scale, list(named))
    known = None
    if poses is not None:
        every = isinstance(photos, str | os.PathLike)  # of a list, the rest was left out on purpose
        known = _known_poses(Path(poses), None if depth is None else Path(depth), named, every)

    sparse = sfm.structure_from_motion(
        photos,
        workspace=workspace,
        config=config,
        poses=known,
        seed=seed,
        progress=progress,
    )
    measured = {} if known is None else known.depth
    if known_positions is not None:
        sparse = align_to_known(sparse, known_positions)
    sparse = _placed(sparse, measured, scale, up, seed)
    fitted = {name: photo for name, photo in sparse.photos.items() if name not in skipped}
    if not fitted:
        raise ValueError(
            f"held_out: all {len(sparse.cameras)} posed photos are held out; none is left to fit to"
        )
    with Steps(workspace, progress=progress) as steps:
        gaussians, patches, said = _steps(steps, sparse, fitted, measured, config, seed, device)
    return Reconstruction(
        gaussians,
        patches.mesh,
        sparse.cameras,
        patches=patches,
        scale_rms_m=sparse.scale_rms_m,
        metric=sparse.metric,
        unposed=sparse.unposed,
        held_out=sorted(skipped),
        guessed=(*sparse.guessed, *said),
        lenses=sparse.lenses,
        causes=sparse.causes,
        pieces=sparse.pieces,
        photos=sparse.photos,
    )


def _check_world(poses: object, depth: object, known_positions: object, scale: object, up: object) -> None:
    """Refuse arguments that exclude or need one another."""
    if known_positions is not None and (scale is not None or up is not None):
        name = "up" if scale is None else "scale"
        raise ValueError(
            f"{name}, known_positions: got both, expected one; surveyed positions set axes and scale"
        )
    for name, value in (("depth", depth), ("up", up)):
        if value is not None and poses is None:
            raise ValueError(f"{name}: got {value!r} without poses, expected both")
    if up is not None:
        check_choice("up", up, UP)
    if poses is None and not isinstance(scale, tuple | None):
        raise ValueError(
            f'scale: got {scale}, expected ("a.jpg", "b.jpg", metres); a number of metres for each unit goes with poses'
        )


def _placed(
    sparse: SparseModel,
    measured: Mapping[str, DepthFile],
    scale: float | tuple[str, str, float] | None,
    up: str | None,
    seed: int,
) -> SparseModel:
    """``sparse`` in metres, z up, unless surveyed positions have brought it there; with points of ``measured`` depth."""
    if not sparse.metric and scale is None and not measured:
        sparse = assume_scale(sparse)
    elif not sparse.metric:
        sparse = scaled(sparse, 1.0 if scale is None else scale)
    if measured:
        sparse = with_points(sparse, measured)
    if up is not None:
        return turned(sparse, up)
    photos = sparse.photos
    return sparse if sparse.upright else upright(sparse, lambda name: read_photo(photos[name]), seed=seed)


def _known_poses(poses: Path, depth: Path | None, photos: Mapping[str, Path], every: bool) -> KnownPoses:
    """Poses of ``photos``, and their depth where it is known.

    Args:
        every: whether every pose should have a photo.
    """
    model = poses if poses.is_dir() and sfm.is_colmap(poses) else None
    cameras = sfm.read_known(poses) if model else read_poses(poses)
    names = match_photos(cameras, photos, every=every)
    found = {photo: cameras[name] for photo, name in names.items()}
    files = {photo: camera.depth for photo, camera in found.items() if camera.depth is not None}
    if depth is not None:
        files = {photo: DepthFile(path) for photo, path in find_depth(depth, found).items()}
    files = {photo: replace(file, turns=photo_facts(photos[photo]).turns) for photo, file in files.items()}
    return KnownPoses(found, model, names, files)


def _steps(
    steps: Steps,
    sparse: SparseModel,
    fitted: Mapping[str, Path],
    measured: Mapping[str, DepthFile],
    config: ReconstructionConfig,
    seed: int,
    device: DeviceLike,
) -> tuple[Gaussians, PlanarPatches, tuple[str, ...]]:
    """The steps after structure from motion: planes and Gaussians to start from, Gaussians refined, mesh and patches;
    and what the mesh holds that no photo shows, in words.

    Args:
        fitted: the photos that Gaussians are fitted to, by name.
        measured: depth images by photo; with some, they make the surface.
    """
    cameras = [sparse.cameras[name] for name in fitted]
    masks = [mask_beside(photo) for photo in fitted.values()]

    @cache
    def photos() -> PosedPhotos:
        images = [read_photo(photo) for photo in fitted.values()]
        return PosedPhotos(images, cameras, [read_mask(photo) for photo in fitted.values()])

    def initial(attempt: Attempt) -> Arrays:
        planes, gaussians = initialise(
            sparse, photos(), config=config, seed=seed, progress=attempt.progress, device=device
        )
        return of_planes(planes) | of_gaussians(gaussians)

    def refined(attempt: Attempt) -> Arrays:
        gaussians = refine(
            to_gaussians(first),
            photos(),
            config=config.refine,
            planes=planes,
            progress=attempt.progress,
            checkpoint=attempt.folder / "checkpoint.safetensors",
            device=device,
        )
        return of_gaussians(gaussians)

    def depth(attempt: Attempt) -> Arrays:
        ranges = depth_maps(
            gaussians, cameras, photos=photos(), planes=planes, config=config, progress=attempt.progress,
            device=device,
        )  # fmt: skip
        return {str(k): map_ for k, map_ in enumerate(ranges)}

    def surface(attempt: Attempt) -> Arrays:
        if measured:
            maps = range_maps(sparse, measured).values()
            views, ranges = (list(part) for part in zip(*maps, strict=True))
        else:
            views = depth_views(cameras, config.surface)
            ranges = [rendered[str(k)] for k in range(len(views))]
        least_views = 2 if measured or len(views) > FEW_MAPS else 1
        patches, whole = fuse_maps(
            views, ranges, planes=planes, config=config, least_views=least_views, progress=attempt.progress
        )
        skipped = float(config.completion and not whole)
        seen = how_seen(patches.mesh, list(sparse.cameras.values()), device=device)
        return of_patches(patches) | {"shares": np.array([*seen.unseen_and_plain(planes), skipped])}

    computed = replace(sparse, causes={}, guessed=())  # without words, which name folders
    inputs = [
        computed,
        list(fitted),
        masks,
        config.planes,
        config.sweep,
        config.plain,
        config.gaussians,
        seed,
    ]
    first = _kept(steps, "initial", initial, inputs)
    planes = to_planes(first)
    gaussians = to_gaussians(_kept(steps, "refined", refined, [steps.key("initial"), config.refine]))
    inputs = [steps.key("refined"), config.surface, config.completion]
    if measured:
        inputs.append({name: [file.path, file.unit_m] for name, file in measured.items()})
    else:
        s = config.surface
        made_by = [steps.key("refined"), config.stereo, config.segments, s.depth_pixels, s.patch_distance_m]
        rendered = _kept(steps, "depth", depth, made_by)
        inputs.append(steps.key("depth"))
    kept = _kept(steps, "surface", surface, inputs)
    return gaussians, to_patches(kept), _said_of_surface(*kept["shares"])


def _said_of_surface(unseen: float, plain: float, skipped: float) -> tuple[str, ...]:
    """What no photo shows of the surface, a sentence each; a warning where it is much."""
    holes = (
        "holes: gaps of single planes were closed, the rest stays open; closing all of them wants half of the surface on "
        "planes along three perpendicular directions, and most of it in photos"
    )
    open_ones = (holes,) if skipped else ()
    if max(unseen, plain) < 0.005:
        return open_ones
    said = (
        f"surface: {plain:.0%} of it carries no feature and was found from its edges; {unseen:.0%} is seen by no photo "
        "and closes what is seen"
    )
    if unseen + plain > MUCH_UNKNOWN:
        warn(f"{said}; look at the mesh there, and take more photos of what is missing")
    return (said, *open_ones)


def _kept(steps: Steps, name: str, make: Callable[[Attempt], Arrays], inputs: Sequence[Any]) -> Arrays:
    path = steps.folder / f"{name}.safetensors"

    def write(attempt: Attempt) -> None:
        tensor_files.write(path, make(attempt), {}, None)

    steps.run(name, write, version=VERSIONS[name], inputs=inputs, outputs=[path.name])
    return tensor_files.read(path, None)[0]
