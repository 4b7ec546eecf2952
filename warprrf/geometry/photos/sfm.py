"""Structure from motion: camera poses and a sparse point cloud from photo files.

Wraps pycolmap (COLMAP: Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016): SIFT on the image
files, matching, incremental mapping with one shared pinhole camera whose focal length is estimated. Photos must be
free of lens distortion. The model comes out in units and axes of its own; :mod:`warprrf.geometry.photos.sparse` brings it to
metres. Everything runs on the CPU and repeats itself for a given seed.
"""

from __future__ import annotations

import itertools
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from warprrf.device import Progress, require
from warprrf.geometry.photos.photo_files import MIN_PHOTOS, Photos, check_photos, find_photos, some
from warprrf.geometry.photos.sparse import SparseModel
from warprrf.geometry.splats.camera import Camera
from warprrf.steps import Attempt, Steps

VERSIONS = {"features": 1, "matches": 1, "model": 1}
"""Of the steps: counted up by whoever changes what a step computes."""

CAMERA_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")

# Above this many pairs matching them all takes minutes; a coarse comparison then picks the pairs worth matching.
MAX_EXHAUSTIVE_PAIRS = 2000
COARSE_FEATURES = 300  # the largest features of a photo take part in the coarse comparison
COARSE_NEIGHBOURS = 16  # pairs kept for a photo; on the lobby 24 takes half as long again for the same errors
PEAK_THRESHOLD = 0.004  # COLMAP's 0.0067 finds too little on bare walls
EXTRACT_BATCH = 12
MATCH_BATCH = 400


def structure_from_motion(
    photos: Photos,
    *,
    workspace: str | os.PathLike[str],
    max_features: int = 2400,
    camera_model: str = "SIMPLE_PINHOLE",
    pairs: str = "auto",
    seed: int = 0,
    progress: Progress | None = None,
) -> SparseModel:
    """Camera poses and sparse points of ``photos``, in the model's own units (see :mod:`~warprrf.geometry.photos.sparse`).

    Finished steps are kept in ``workspace`` and reused as long as photos, options and pycolmap stay the same, so that
    a stopped run goes on where it was.

    Args:
        photos: a folder, or a sequence of image files, all of one size and from one undistorted camera.
        workspace: folder for the feature database and the model; made if it is not there.
        max_features: SIFT features kept per photo (the largest ones).
        camera_model: COLMAP camera model, ``"SIMPLE_PINHOLE"`` (one focal length) or ``"PINHOLE"`` (two).
        pairs: ``"exhaustive"`` matches every pair of photos; ``"auto"`` only those that a coarse comparison of their
            largest features finds promising, once there are more than 2000 pairs.
        seed: seed of every random draw.
        progress: called as ``progress("features" | "comparing" | "matching" | "mapping", done, total)``.

    Raises:
        ValueError: for photos that are missing, unreadable, of different sizes or too few, an unknown camera model,
            or when the photos overlap too little to be posed; the message names the files.
        ImportError: if pycolmap is not installed.
    """
    if camera_model not in CAMERA_MODELS:
        raise ValueError(
            f"camera_model: got {camera_model!r}, expected one of {CAMERA_MODELS}; photos with lens distortion have "
            "to be undistorted first (for instance with COLMAP's image_undistorter)"
        )
    if pairs not in ("auto", "exhaustive"):
        raise ValueError(f'pairs: got {pairs!r}, expected "auto" or "exhaustive"')
    if max_features < 100:
        raise ValueError(f"max_features: got {max_features}, expected at least 100")
    colmap = require("pycolmap", extra="photos")
    named = find_photos(photos)
    check_photos(named)

    def features(attempt: Attempt) -> dict[str, Any]:
        _extract(colmap, folder, named, (max_features, camera_model), attempt)
        return {}

    def matches(attempt: Attempt) -> dict[str, Any]:
        _match(colmap, folder, list(named), pairs, seed, attempt)
        return {}

    def model(attempt: Attempt) -> dict[str, Any]:
        return {"other_models": _map(colmap, folder, named, seed, attempt)}

    folder = Path(workspace) / "sfm"
    with Steps(folder, progress=progress) as steps, _quiet(colmap):
        colmap.set_random_seed(seed)
        inputs = [list(named), list(named.values()), max_features, camera_model, colmap.__version__]
        steps.run("features", features, version=VERSIONS["features"], inputs=inputs, outputs=["features.db"])
        inputs = [steps.key("features"), pairs, seed]
        steps.run("matches", matches, version=VERSIONS["matches"], inputs=inputs, outputs=["matches.db"])
        inputs = [steps.key("matches"), seed]
        found = steps.run("model", model, version=VERSIONS["model"], inputs=inputs, outputs=["model"])
        result = _sparse_model(colmap.Reconstruction(str(folder / "model")), list(named))
        return replace(result, other_models=tuple(found["other_models"]))


def read_colmap(folder: str | os.PathLike[str]) -> SparseModel:
    """A COLMAP model folder (``cameras``, ``images``, ``points3D``; ``.bin`` or ``.txt``) as a :class:`SparseModel`.

    Lengths are taken as metres.

    Raises:
        ValueError: if the folder holds no readable model, or a camera is not a pinhole.
        ImportError: if pycolmap is not installed.
    """
    colmap = require("pycolmap", extra="photos")
    root = Path(folder)
    if not any(
        all((root / f"{n}{ext}").is_file() for n in ("cameras", "images")) for ext in (".bin", ".txt")
    ):
        raise ValueError(
            f"colmap: {root} holds no COLMAP model; expected cameras, images and points3D (.bin or .txt)"
        )
    with _quiet(colmap):
        try:
            for name, walk in _RECORDS.items():
                if (root / name).is_file():
                    _check_whole(root / name, walk)
            model = colmap.Reconstruction(str(root))
        except Exception as error:  # pycolmap raises RuntimeError, ValueError or IndexError on a damaged file
            raise ValueError(f"colmap: {root} does not read as a COLMAP model: {error}") from error
        try:
            names = sorted(i.name for i in model.images.values())
            found = replace(_sparse_model(model, names), metric=True, upright=True)
        except (ValueError, TypeError) as error:  # cameras that are no pinholes, or damaged
            raise ValueError(f"colmap: {root}: {str(error).removeprefix('colmap: ')}") from error
    if not np.isfinite(found.points).all():
        raise ValueError(f"colmap: {root} holds points that are NaN or infinite")
    return found


_RECORDS: dict[str, Callable[[bytes, int], int]] = {
    "rigs.bin": lambda data, at: at + 8,
    "cameras.bin": lambda data, at: at + 48,
    "frames.bin": lambda data, at: at + 68,
    "images.bin": lambda data, at: _after(data, data.find(b"\0", at + 64) + 1 or len(data), 24),
    "points3D.bin": lambda data, at: _after(data, at + 43, 8),
}
"""Where a record ends that begins at a byte of a COLMAP file; of the first three, the least that it can take."""


def _after(data: bytes, at: int, size: int) -> int:
    """Where a list ends that begins with its length; its entries have ``size`` bytes."""
    return at + 8 + size * int.from_bytes(data[at : at + 8], "little")


def _check_whole(path: Path, walk: Callable[[bytes, int], int]) -> None:
    """COLMAP reads on behind the end of a file, for ever if need be: refuse one that holds less than it counts."""
    data, at = path.read_bytes(), 8
    for _ in range(int.from_bytes(data[:8], "little")):
        at = walk(data, at)
        if at > len(data):
            break
    if at > len(data):
        raise ValueError(f"{path.name} is cut short or damaged: its {len(data)} bytes end within a record")


@contextmanager
def _quiet(colmap: ModuleType) -> Iterator[None]:
    """COLMAP logs to stderr; keep only its fatal messages, and put the level back afterwards."""
    before = colmap.logging.minloglevel
    colmap.logging.minloglevel = int(colmap.logging.FATAL)
    try:
        yield
    finally:
        colmap.logging.minloglevel = before


def _root(named: Mapping[str, Path]) -> Path:
    """The folder that photos' names are relative to, which is where COLMAP looks for them."""
    name, path = next(iter(named.items()))
    return path.parents[name.count("/")]


def _copied(source: Path, target: Path) -> Path:
    """``target``, a fresh copy of a database."""
    for suffix in ("-wal", "-shm", "-journal"):
        Path(f"{target}{suffix}").unlink(missing_ok=True)
    shutil.copyfile(source, target)
    return target


def _settle(working: Path, final: Path) -> None:
    """Move a finished database into place, with nothing left in SQLite's write-ahead log."""
    with closing(sqlite3.connect(working)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        connection.execute("PRAGMA journal_mode=DELETE")
    os.replace(working, final)


def _extract(
    colmap: ModuleType, folder: Path, named: Mapping[str, Path], settings: tuple[int, str], attempt: Attempt
) -> None:
    """Features of the photos, into ``features.db``."""
    max_features, camera_model = settings
    names = list(named)
    images = _root(named)
    working = attempt.folder / "features.db"
    working.unlink(missing_ok=True)
    colmap.Database.open(str(working)).close()
    reader = colmap.ImageReaderOptions(camera_model=camera_model)
    # Importing first numbers the images by name; extraction alone numbers them as threads finish.
    colmap.import_images(working, images, colmap.CameraMode.SINGLE, image_names=names, options=reader)
    reader.existing_camera_id = 1
    extraction = colmap.FeatureExtractionOptions(use_gpu=False)
    extraction.sift.max_num_features = max_features
    extraction.sift.peak_threshold = PEAK_THRESHOLD
    for start in range(0, len(names), EXTRACT_BATCH):
        attempt.progress("features", start, len(names))
        colmap.extract_features(
            working,
            images,
            image_names=names[start : start + EXTRACT_BATCH],
            camera_mode=colmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=colmap.Device.cpu,
        )
    attempt.progress("features", len(names), len(names))
    _settle(working, folder / "features.db")


def _match(
    colmap: ModuleType, folder: Path, names: list[str], pairs: str, seed: int, attempt: Attempt
) -> None:
    """Verified matches of pairs of photos, into ``matches.db``."""
    working, listing = (
        _copied(folder / "features.db", attempt.folder / "matches.db"),
        attempt.folder / "pairs.txt",
    )
    with colmap.Database.open(str(working)) as database:
        counts = {i.name: database.num_keypoints_for_image(i.image_id) for i in database.read_all_images()}
        blank = [n for n in names if counts[n] < 8]
        if len(names) - len(blank) < MIN_PHOTOS:
            raise ValueError(
                f"photos: {len(blank)} of {len(names)} photos show fewer than 8 features (blank, dark or blurred?), "
                f"too few remain to work with: {some(blank)}"
            )
        chosen = list(itertools.combinations(names, 2))
        if pairs == "auto" and len(chosen) > MAX_EXHAUSTIVE_PAIRS:
            chosen = _promising_pairs(database, names, attempt.progress)
    matching = colmap.FeatureMatchingOptions(use_gpu=False)
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    for start in range(0, len(chosen), MATCH_BATCH):
        attempt.progress("matching", start, len(chosen))
        listing.write_text("".join(f"{a} {b}\n" for a, b in chosen[start : start + MATCH_BATCH]))
        colmap.match_image_pairs(
            working,
            matching_options=matching,
            pairing_options=colmap.ImportedPairingOptions(match_list_path=listing),
            verification_options=verification,
            device=colmap.Device.cpu,
        )
    attempt.progress("matching", len(chosen), len(chosen))
    _settle(working, folder / "matches.db")


def _promising_pairs(database: Any, names: list[str], report: Progress) -> list[tuple[str, str]]:
    """Pairs worth matching: each photo with those that share the most of its largest features.

    The largest features of two photos are compared by brute force, one matrix product a pair; a mutual nearest
    neighbour that passes the ratio test is a vote. Consecutive photos are always kept.
    """
    ids = {i.name: i.image_id for i in database.read_all_images()}
    descriptors = []
    for name in names:
        d = np.asarray(database.read_descriptors(ids[name]).data, dtype=np.float32)
        k = database.read_keypoints(ids[name])  # x, y and the 2x2 shape
        area = np.abs(k[:, 2] * k[:, 5] - k[:, 3] * k[:, 4])
        d = d[np.argsort(-area, kind="stable")[:COARSE_FEATURES]]
        descriptors.append(d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9))
    votes = np.zeros((len(names), len(names)))
    fewest = min(len(d) for d in descriptors)
    if fewest < COARSE_FEATURES:  # pad, so that all photos go through one product; zeros match nothing
        descriptors = [np.pad(d, ((0, COARSE_FEATURES - len(d)), (0, 0))) for d in descriptors]
    stack = np.stack(descriptors)
    for i in range(len(names) - 1):
        report("comparing", i, len(names))
        # One product of photo i with all later ones, shape (features of i, photos, features of j).
        cosine = (stack[i] @ stack[i + 1 :].reshape(-1, stack.shape[2]).T).reshape(
            COARSE_FEATURES, -1, COARSE_FEATURES
        )
        back = cosine.argmax(axis=0)
        first = cosine.argmax(axis=2)[..., None]
        top = np.take_along_axis(cosine, first, axis=2)[..., 0]
        np.put_along_axis(cosine, first, -1.0, axis=2)
        distinct = (1 - top) < 0.64 * (1 - cosine.max(axis=2))  # Lowe's ratio 0.8, on squared distances
        first = first[..., 0]
        mutual = np.take_along_axis(back, first.T, axis=1).T == np.arange(COARSE_FEATURES)[:, None]
        votes[i, i + 1 :] = (distinct & mutual & (top > 0.5)).sum(axis=0)
    votes += votes.T
    report("comparing", len(names), len(names))
    keep = np.zeros(votes.shape, dtype=bool)
    order = np.argsort(-votes, axis=1, kind="stable")[:, :COARSE_NEIGHBOURS]
    np.put_along_axis(keep, order, True, axis=1)
    keep &= votes >= 4
    step = np.arange(len(names) - 1)
    keep[step, step + 1] = True
    keep |= keep.T
    return [(names[i], names[j]) for i, j in itertools.combinations(range(len(names)), 2) if keep[i, j]]


def _map(
    colmap: ModuleType, folder: Path, named: Mapping[str, Path], seed: int, attempt: Attempt
) -> list[int]:
    """Poses and points from the matches, into the folder ``model``; returns how many photos smaller models hold."""
    working = _copied(folder / "matches.db", attempt.folder / "matches.db")
    images, report = _root(named), attempt.progress
    options = colmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.num_threads = 1  # sums in a fixed order: the same poses every time
    options.min_model_size = MIN_PHOTOS
    models: list[Any] = []
    for relaxed in (False, True):
        # Few photos, or all from nearly one direction: a weaker first pair, when COLMAP's own limits find none.
        if relaxed:
            options.mapper.init_min_num_inliers = 40
            options.mapper.init_min_tri_angle = 4.0
            options.mapper.abs_pose_min_num_inliers = 20
        posed = itertools.count(2)
        report("mapping", 0, len(named))
        output = attempt.folder / "mapping"
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir()
        found = colmap.incremental_mapping(
            working,
            images,
            output,
            options,
            next_image_callback=lambda posed=posed: report(
                "mapping", min(next(posed), len(named)), len(named)
            ),
        )
        models = [m for m in found.values() if m.num_reg_images() >= MIN_PHOTOS]
        if models:
            break
    if not models:
        with colmap.Database.open(str(working)) as database:
            inliers = np.array(database.read_two_view_geometry_num_inliers()[1])
        raise ValueError(
            f"photos: too few matches between the {len(named)} photos to pose any "
            f"({(inliers >= options.min_num_matches).sum()} pairs of photos match); expected photos of one textured "
            f"place that overlap by half or more: {some(list(named))}"
        )
    largest, *others = sorted(models, key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
    whole = attempt.folder / "model"
    shutil.rmtree(whole, ignore_errors=True)
    whole.mkdir()
    largest.write_binary(str(whole))
    shutil.rmtree(folder / "model", ignore_errors=True)
    os.replace(whole, folder / "model")
    report("mapping", len(named), len(named))
    return [m.num_reg_images() for m in others]


def _sparse_model(model: Any, names: Sequence[str]) -> SparseModel:
    images = {i.name: i for i in model.images.values() if i.has_pose}
    cameras = {}
    for name in sorted(images):
        image = images[name]
        lens = model.cameras[image.camera_id]
        kind = lens.model.name
        if kind not in CAMERA_MODELS:
            raise ValueError(
                f"colmap: camera {image.camera_id} is a {kind}, expected one of {CAMERA_MODELS}; undistort the photos "
                "first (COLMAP's image_undistorter writes a pinhole model)"
            )
        k = lens.calibration_matrix()
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        u, _, vt = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ vt
        cameras[name] = Camera.pinhole(
            lens.width, lens.height, fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2], world_to_camera=pose
        )
    position = {images[n].image_id: i for i, n in enumerate(cameras)}
    points = [model.points3D[i] for i in sorted(model.points3D)]
    tracks = [sorted({position[e.image_id] for e in p.track.elements}) for p in points]
    length = np.array([len(t) for t in tracks], dtype=np.int64)
    return SparseModel(
        cameras=cameras,
        points=np.array([p.xyz for p in points], dtype=np.float64).reshape(-1, 3),
        colors=np.array([p.color for p in points], dtype=np.float64).reshape(-1, 3) / 255,
        reprojection_error=np.array([p.error for p in points], dtype=np.float64),
        track_length=length,
        track_start=np.concatenate([[0], np.cumsum(length)]).astype(np.int64),
        track_camera=np.array([c for t in tracks for c in t], dtype=np.int64),
        unposed=tuple(n for n in names if n not in cameras),
    )
