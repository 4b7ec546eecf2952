"""Structure from motion: camera poses and a sparse point cloud from photo files.

Wraps pycolmap (COLMAP: Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016): SIFT on the image
files, matching, incremental mapping with one lens for each camera, which is estimated. Everything runs on the CPU and
repeats itself for a given seed.
"""

from __future__ import annotations

import itertools
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from warprrf.checks import some_of, warn
from warprrf.device import Progress, require
from warprrf.files import folder_in_place
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.posed.photo_files import (
    MIN_PHOTOS,
    Photos,
    cameras_of,
    check_photos,
    find_photos,
    mask_beside,
    open_photo,
    photo_facts,
)
from warprrf.geometry.photos.posed.poses import KnownCamera, KnownPoses
from warprrf.geometry.photos.posed.sparse import SparseModel, fit_similarity, posed_in_words
from warprrf.geometry.photos.posed.undistort import (
    FREE_MODEL,
    Lens,
    choose_lens,
    colmap_camera,
    lens_of,
    lenses_in_use,
    load_colmap,
    pinhole_of,
    write_undistorted,
)
from warprrf.steps import Attempt, Steps
from warprrf.tensor_files import named as naming

VERSIONS = {"features": 3, "matches": 2, "model": 4, "photos": 1}
"""Of the steps: counted up by whoever changes what a step computes."""


# Above this many pairs matching them all takes minutes; a coarse comparison then picks the pairs worth matching.
MAX_EXHAUSTIVE_PAIRS = 2000
COARSE_NEIGHBOURS = 16  # pairs kept for a photo; on the lobby 24 takes half as long again for the same errors
PEAK_THRESHOLD = 0.002
"""COLMAP's 0.0067 finds too little on bare and dark walls: of a walk through a dim lounge, 125 frames of 540 x 360, 0.004 poses 116
whose depths differ by 7 cm between distant photos, this 119 and 3 cm; 0.001 is as good and dearer."""
FEWEST_FEATURES = 8  # of a photo that can be matched
FEWEST_MATCHES = 15  # of a pair that COLMAP counts as matched
LENIENT = {
    "init_min_num_inliers": 40, "init_min_tri_angle": 4.0, "abs_pose_min_num_inliers": 15,
    "abs_pose_min_inlier_ratio": 0.15,
}  # fmt: skip
"""Of COLMAP's mapper, where its own limits leave photos without a pose: of a film of monitors and desks they pose 7 of 25, these
22; the largest model of 125 frames of a walk through a lounge has 44 photos by them, 118 by these. Taken alone, these put a
photo of ten into a wrong place where COLMAP's own leave it out."""


def structure_from_motion(
    photos: Photos,
    *,
    workspace: str | os.PathLike[str],
    config: ReconstructionConfig | None = None,
    poses: KnownPoses | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> SparseModel:
    """Camera poses and sparse points of ``photos``, in the model's own units (see :mod:`~warprrf.geometry.photos.posed.sparse`).

    The cameras are those of the undistorted, upright, reduced photos, which lie in ``sfm/photos`` of the workspace under
    their own names. Photos of one camera (:func:`cameras_of`) share a lens. The estimate starts from EXIF's focal length, or
    from one that the matches agree on. Features are found in photos of 1600 pixels at most, and not where a mask
    (``NAME.mask.png``) is black.

    Finished steps are kept in ``workspace`` and reused as long as photos, options and pycolmap stay the same, so that
    a stopped run goes on where it was.

    Args:
        workspace: folder for the feature database, the model and the undistorted photos; made if it is not there.
        poses: poses and lenses that are known; points are triangulated, where they and depth are not known too.
        progress: called as ``progress("features" | "comparing" | "matching" | "mapping" | "undistorting", done, total)``.

    Raises:
        ValueError: for photos that are missing, unreadable or too few, or when the photos overlap too little to be posed;
            the message names the files.
    """
    config = config or ReconstructionConfig()
    lens, max_features = config.lens, config.max_features
    everything = named = find_photos(photos)
    known: Any = None
    match, first_lens = True, cast(str | dict[str, Lens], FREE_MODEL if lens == "auto" else lens)
    if poses is not None:
        named = {name: named[name] for name in poses.cameras}
        facts = {name: photo_facts(path) for name, path in named.items()}
        first_lens = {n: c.of_size(n, facts[n].width, facts[n].height) for n, c in poses.cameras.items()}
        with _quiet():
            known = _known_model(poses, first_lens)
        match = not poses.depth and not known.num_points3D()

    folder = Path(workspace).absolute() / "sfm"
    kept = folder / "photos"
    if any(path.resolve().is_relative_to(kept.resolve()) for path in named.values()):
        raise ValueError(f"workspace: {kept} holds the photos and would be overwritten; name another folder")
    with _quiet() as colmap, Steps(folder, progress=progress) as steps:
        colmap.set_random_seed(seed)
        inputs: list[Any] = []
        if match:
            masks = _masks(named)
            inputs = [list(named), list(named.values()), masks, max_features, first_lens, colmap.__version__]
            find = partial(_extract, folder, named, max_features, first_lens)
            steps.run("features", find, version=VERSIONS["features"], inputs=inputs, outputs=["features.db"])
            inputs, compare = [steps.key("features"), seed], partial(_match, folder, list(named), seed)
            steps.run("matches", compare, version=VERSIONS["matches"], inputs=inputs, outputs=["matches.db"])
            inputs = [steps.key("matches"), lens, seed]
        if known is None:
            make = partial(_map, folder, named, lens, seed)
        else:
            make = partial(_keep_known, folder, named, known, match, seed)
            inputs += [list(named.values()), *_content(known)]
        made = steps.run("model", make, version=VERSIONS["model"], inputs=inputs, outputs=["model"])
        result = _straightened(steps, named, config.max_pixels)
        unposed = [*result.unposed]
        if poses is not None:
            unposed += poses.unposed(everything)
            causes = dict.fromkeys(unposed, "the poses given have none of it")
        else:
            causes = _causes(folder / "matches.db", result) if unposed else {}
        for k, piece in enumerate(made["pieces"][1:], 2):
            text = f"one of {len(piece)} photos in a piece of their own; poses={folder / f'model-{k}'} gives that"
            causes |= dict.fromkeys(piece, text)
        pieces = tuple(map(tuple, made["pieces"]))
        result = replace(result, unposed=tuple(unposed), causes=causes, pieces=pieces)
        if said := posed_in_words(result):
            warn(said)
            result = replace(result, guessed=(said,))
        return result


def _masks(named: Mapping[str, Path]) -> dict[str, Path]:
    return {name: mask for name, path in named.items() if (mask := mask_beside(path))}


def _straightened(steps: Steps, named: Mapping[str, Path], max_pixels: int) -> SparseModel:
    """The model in the folder of ``steps``, with undistorted photos beside it."""
    model, kept = _open_model(steps.folder / "model"), steps.folder / "photos"
    lenses = lenses_of(model)

    def straight(attempt: Attempt) -> None:
        shutil.rmtree(kept, ignore_errors=True)  # of other photos, or with masks that are gone
        for k, name in enumerate(lenses):
            attempt.progress("undistorting", k, len(lenses))
            write_undistorted(named[name], kept / name, lenses[name], max_pixels)
        attempt.progress("undistorting", len(lenses), len(lenses))

    outputs = [f"photos/{name}" for name in lenses]
    inputs = [steps.key("model"), max_pixels, _masks(named)]
    steps.run("photos", straight, version=VERSIONS["photos"], inputs=inputs, outputs=outputs)
    turns = {name: photo_facts(named[name]).turns for name in lenses}
    result = _sparse_model(model, list(named), turns, max_pixels)
    return replace(result, photos={name: kept / name for name in lenses}, lenses=lenses)


def read_colmap(folder: str | os.PathLike[str]) -> SparseModel:
    """A COLMAP model folder (``cameras``, ``images``, ``points3D``; ``.bin`` or ``.txt``) as a :class:`SparseModel`.

    Lengths are taken as metres.

    Raises:
        ValueError: if the folder holds no readable model, or a camera is not a pinhole.
        ImportError: if pycolmap is not installed.
    """
    root = Path(folder)
    with _quiet():
        model = _open_model(root)
        try:
            names = sorted(i.name for i in model.images.values())
            bent = [lens for lens in lenses_of(model).values() if not lens.straight]
            if bent:
                raise ValueError(
                    f"colmap: a camera is a {bent[0].model}, expected SIMPLE_PINHOLE or PINHOLE; undistort the photos "
                    "first (COLMAP's image_undistorter writes a pinhole model)"
                )
            found = replace(_sparse_model(model, names), metric=True, upright=True)
        except (ValueError, TypeError) as error:  # cameras that are no pinholes, or damaged
            raise ValueError(f"colmap: {root}: {str(error).removeprefix('colmap: ')}") from error
    if not (np.isfinite(found.points).all() and np.isfinite(found.reprojection_error).all()):
        raise ValueError(f"colmap: {root} holds points, or errors of theirs, that are NaN or infinite")
    return found


def _open_model(root: Path) -> Any:
    """A COLMAP model folder, whose files are looked through first."""
    if not is_colmap(root):
        raise ValueError(
            f"colmap: {root} holds no COLMAP model; expected cameras, images and points3D (.bin or .txt)"
        )
    try:
        for name, walk in _RECORDS.items():
            if (root / name).is_file():
                _check_whole(root / name, walk)
        model = load_colmap().Reconstruction(str(root))
        if not all((root / f"{name}.bin").is_file() for name in ("cameras", "images", "points3D")):
            _name_whole(model, root / "images.txt")
        return model
    except Exception as error:  # pycolmap raises RuntimeError, ValueError or IndexError on a damaged file
        raise ValueError(f"colmap: {root} does not read as a COLMAP model: {error}") from error


def _name_whole(model: Any, path: Path) -> None:
    """Give images the names that a text file has for them, of which COLMAP reads one word."""
    lines = iter(path.read_text("utf-8").split("\n"))
    for line in lines:
        words = line.split(maxsplit=9)
        if words and not words[0].startswith("#"):
            model.images[int(words[0])].name = words[9].rstrip()
            next(lines, None)  # its points, or an empty line


def is_colmap(folder: Path) -> bool:
    """Whether a folder holds files named as those of a COLMAP model."""
    return any(
        all((folder / f"{n}{ext}").is_file() for n in ("cameras", "images")) for ext in (".bin", ".txt")
    )


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
def _quiet() -> Iterator[Any]:
    """pycolmap, which logs to stderr: its fatal messages alone, and at the level of before afterwards."""
    colmap = load_colmap()
    before = colmap.logging.minloglevel
    colmap.logging.minloglevel = int(colmap.logging.FATAL)
    try:
        yield colmap
    finally:
        colmap.logging.minloglevel = before


def _write_model(model: Any, folder: Path) -> None:
    """Write a COLMAP model; COLMAP itself says nothing of a full disk."""
    model.write_binary(str(folder))
    for name, walk in _RECORDS.items():
        try:
            _check_whole(folder / name, walk)
        except ValueError as error:
            raise OSError(f"{name} was not written whole in {folder.parent}: is the disk full?") from error


def _root(named: Mapping[str, Path]) -> Path:
    """The folder that photos' names are relative to, which is where COLMAP looks for them."""
    name, path = next(iter(named.items()))
    return path.parents[name.count("/")]


def _fresh(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _settled(working: Path, final: Path) -> None:
    """Move a finished database into place, with nothing left in SQLite's write-ahead log."""
    with closing(sqlite3.connect(working)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        connection.execute("PRAGMA journal_mode=DELETE")
    os.replace(working, final)


def _extract(
    folder: Path, named: Mapping[str, Path], max_features: int, lens: str | dict[str, Lens], attempt: Attempt
) -> None:
    """Features of the photos, into ``features.db``; ``lens``: lenses, or the model of all lenses."""
    check_photos(named)
    colmap, names, images = load_colmap(), list(named), _root(named)
    working = _fresh(attempt.folder) / "features.db"
    colmap.Database.open(str(working)).close()
    reader = colmap.ImageReaderOptions()
    # Importing first numbers the images by name; extraction alone numbers them as threads finish.
    if isinstance(lens, str):
        groups = [(group, lens, "") for group in cameras_of(named)]
    else:
        known = [(colmap_camera(own), group) for own, group in lenses_in_use(lens).items()]
        groups = [(list(group), camera.model.name, camera.params_to_string()) for camera, group in known]
    for group, reader.camera_model, reader.camera_params in groups:
        colmap.import_images(working, images, colmap.CameraMode.SINGLE, image_names=group, options=reader)
    if any(mask_beside(path) for path in named.values()):
        reader.mask_path = _write_masks(named, attempt.folder / "masks")
    # 1600: features are found in photos reduced to this length of their longer side [pixels]
    extraction = colmap.FeatureExtractionOptions(use_gpu=False, max_image_size=1600)
    extraction.sift.max_num_features = max_features
    extraction.sift.peak_threshold = PEAK_THRESHOLD
    extract_batch = 12
    for start in range(0, len(names), extract_batch):
        attempt.progress("features", start, len(names))
        colmap.extract_features(
            working,
            images,
            image_names=names[start : start + extract_batch],
            camera_mode=colmap.CameraMode.AUTO,
            reader_options=reader,
            extraction_options=extraction,
            device=colmap.Device.cpu,
        )
    attempt.progress("features", len(names), len(names))
    _settled(working, folder / "features.db")


def _write_masks(named: Mapping[str, Path], folder: Path) -> Path:
    """Masks where COLMAP looks for them, turned as the photos are stored; white for a photo without one."""
    image = require("PIL.Image", extra="photos")
    for name, path in named.items():
        facts, mask = photo_facts(path), mask_beside(path)
        target = folder / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        if mask is None:
            image.new("L", (facts.width, facts.height), 255).save(target)
        else:
            open_photo(mask, "L").rotate(90 * facts.turns, expand=True).save(target)
    return folder


def _match(folder: Path, names: list[str], seed: int, attempt: Attempt) -> None:
    """Verified matches of pairs of photos, into ``matches.db``."""
    colmap = load_colmap()
    working = shutil.copyfile(folder / "features.db", _fresh(attempt.folder) / "matches.db")
    listing = attempt.folder / "pairs.txt"
    with colmap.Database.open(str(working)) as database:
        number = {i.name: i.image_id for i in database.read_all_images()}
        counts = {name: database.num_keypoints_for_image(k) for name, k in number.items()}
        blank = [n for n in names if counts[n] < FEWEST_FEATURES]
        if len(names) - len(blank) < MIN_PHOTOS:
            raise ValueError(
                f"photos: {len(blank)} of {len(names)} photos show fewer than {FEWEST_FEATURES} features (blank, dark or "
                f"blurred?), too few remain to work with: {some_of(blank)}"
            )
        chosen = list(itertools.combinations(names, 2))
        if len(chosen) > MAX_EXHAUSTIVE_PAIRS:
            chosen = _promising_pairs(database, names, attempt.progress)
    # 1: pycolmap is built with an OpenBLAS that does not lock its buffers. Two threads that match at once may take the same one
    # and spoil each other's distances; a few pairs then get other matches, in one run of many.
    matching = colmap.FeatureMatchingOptions(use_gpu=False, num_threads=1)
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    match_batch = 400
    # COLMAP's list of pairs divides names at their blanks: photos go by numbers meanwhile.
    _rename(working, {k: str(k) for k in number.values()})
    for start in range(0, len(chosen), match_batch):
        attempt.progress("matching", start, len(chosen))
        pairs = chosen[start : start + match_batch]
        listing.write_text("".join(f"{number[a]} {number[b]}\n" for a, b in pairs))
        colmap.match_image_pairs(
            working,
            matching_options=matching,
            pairing_options=colmap.ImportedPairingOptions(match_list_path=listing),
            verification_options=verification,
            device=colmap.Device.cpu,
        )
    attempt.progress("matching", len(chosen), len(chosen))
    _rename(working, {k: name for name, k in number.items()})
    _settled(working, folder / "matches.db")


def _rename(working: Path, names: Mapping[int, str]) -> None:
    """Give images of a database other names, by their numbers."""
    with closing(sqlite3.connect(working)) as connection, connection:
        rows = [(name, k) for k, name in names.items()]
        connection.executemany("UPDATE images SET name = ? WHERE image_id = ?", rows)


def _promising_pairs(database: Any, names: list[str], report: Progress) -> list[tuple[str, str]]:
    """Pairs worth matching: each photo with those that share the most of its largest features.

    The largest features of two photos are compared by brute force, one matrix product a pair; a mutual nearest
    neighbour that passes the ratio test is a vote. Photos that follow one another are always kept.
    """
    ids = {i.name: i.image_id for i in database.read_all_images()}
    descriptors = []
    coarse_features = 300  # the largest features of a photo take part in the coarse comparison
    for name in names:
        d = np.asarray(database.read_descriptors(ids[name]).data, dtype=np.float32)
        k = database.read_keypoints(ids[name])  # x, y and the 2x2 shape
        area = np.abs(k[:, 2] * k[:, 5] - k[:, 3] * k[:, 4])
        d = d[np.argsort(-area, kind="stable")[:coarse_features]]
        d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9)
        # So that all photos go through one product; zeros match nothing.
        descriptors.append(np.pad(d, ((0, coarse_features - len(d)), (0, 0))))
    votes = np.zeros((len(names), len(names)))
    stack = np.stack(descriptors)
    for i in range(len(names) - 1):
        report("comparing", i, len(names))
        # One product of photo i with all later ones, shape (features of i, photos, features of j).
        later = stack[i + 1 :].reshape(-1, stack.shape[2])
        cosine = (stack[i] @ later.T).reshape(coarse_features, -1, coarse_features)
        back = cosine.argmax(axis=0)
        first = cosine.argmax(axis=2)[..., None]
        top = np.take_along_axis(cosine, first, axis=2)[..., 0]
        np.put_along_axis(cosine, first, -1.0, axis=2)
        distinct = (1 - top) < 0.64 * (1 - cosine.max(axis=2))  # Lowe's ratio 0.8, on squared distances
        first = first[..., 0]
        mutual = np.take_along_axis(back, first.T, axis=1).T == np.arange(coarse_features)[:, None]
        votes[i, i + 1 :] = (distinct & mutual & (top > 0.5)).sum(axis=0)
    votes += votes.T
    report("comparing", len(names), len(names))
    keep = np.zeros(votes.shape, dtype=bool)
    order = np.argsort(-votes, axis=1, kind="stable")[:, :COARSE_NEIGHBOURS]
    np.put_along_axis(keep, order, True, axis=1)
    keep &= votes >= 4
    in_order = (1, 2, 4, 8)  # photos so many places apart by name, as a film has them, are always matched
    for apart in in_order:
        step = np.arange(len(names) - apart)
        keep[step, step + apart] = True
    keep |= keep.T
    return [(names[i], names[j]) for i, j in itertools.combinations(range(len(names)), 2) if keep[i, j]]


def _map(folder: Path, named: Mapping[str, Path], lens: str, seed: int, attempt: Attempt) -> dict[str, Any]:
    """Poses and points from the matches, into the folder ``model``: the largest of the models found, with those that
    photos join to it; the others into ``model-2`` and so on. Names of the photos of each, as ``pieces``."""
    working = shutil.copyfile(folder / "matches.db", _fresh(attempt.folder) / "matches.db")
    colmap, images, report = load_colmap(), _root(named), attempt.progress
    options = colmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.num_threads = 1  # sums in a fixed order: the same poses every time
    options.min_model_size = MIN_PHOTOS
    if lens != "OPENCV_FISHEYE":  # of which no fundamental matrix speaks
        _calibrate(working, attempt.folder / "calibrated.db", seed)
    best: list[Any] = []
    for limits in ({}, LENIENT):
        for name, limit in limits.items():
            setattr(options.mapper, name, limit)
        posed = itertools.count(2)
        report("mapping", 0, len(named))
        found = colmap.incremental_mapping(
            working,
            images,
            _fresh(attempt.folder / "mapping"),
            options,
            next_image_callback=lambda posed=posed: report(
                "mapping", min(next(posed), len(named)), len(named)
            ),
        )
        models = [m for m in found.values() if m.num_reg_images() >= MIN_PHOTOS]
        models.sort(key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)
        if models and (not best or models[0].num_reg_images() > best[0].num_reg_images()):
            best = models
        if best and best[0].num_reg_images() == len(named):
            break
    if not best:
        with colmap.Database.open(str(working)) as database:
            inliers = np.array(database.read_two_view_geometry_num_inliers()[1])
        raise ValueError(
            f"photos: too few matches between the {len(named)} photos to pose any "
            f"({(inliers >= options.min_num_matches).sum()} pairs of photos match); expected photos of one textured "
            f"place that overlap by half or more: {some_of(list(named))}"
        )
    kept: list[Any] = []
    for model in best:
        if not _names(model) <= set().union(*map(_names, kept)):
            kept.append(model)
    for model in kept[1:]:
        both = _joined(kept[0], model, (working, images, options), _fresh(attempt.folder / "joined"))
        if both is not None:
            kept = [both, *(other for other in kept[1:] if other is not model)]
    pieces: list[list[str]] = []
    for old in folder.glob("model-*"):
        shutil.rmtree(old)
    for model in kept:
        names = sorted(_names(model).difference(*pieces))
        if len(names) < MIN_PHOTOS:
            continue
        pieces.append(names)
        with folder_in_place(folder / ("model" if len(pieces) == 1 else f"model-{len(pieces)}")) as whole:
            _write_model(model, whole)
            if len(pieces) == 1:
                _write_model(choose_lens(whole, lens), whole)
    report("mapping", len(named), len(named))
    return {"pieces": pieces}


def _calibrate(matches: Path, scratch: Path, seed: int) -> None:
    """Start each lens whose EXIF says nothing from the focal length that most fundamental matrices of its photos agree on.

    COLMAP would start from 1.2 times the longer side, where 0.6 to 0.9 are usual of phones and depth cameras. Source: C.
    Sweeney et al., "Optimizing the viewing graph for structure-from-motion", ICCV 2015. The file ``scratch`` is written over:
    COLMAP also sorts out pairs there, which the mapper can use.
    """
    colmap = load_colmap()
    options = colmap.ViewGraphCalibrationOptions(random_seed=seed, reestimate_relative_pose=False)
    colmap.calibrate_view_graph(shutil.copyfile(matches, scratch), options)
    with colmap.Database.open(str(scratch)) as found, colmap.Database.open(str(matches)) as database:
        for camera in found.read_all_cameras():
            database.update_camera(camera)


def _names(model: Any) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


def _joined(model: Any, other: Any, source: tuple[Path, Path, Any], scratch: Path) -> Any | None:
    """``model`` with the photos of ``other`` (which is moved), where they agree on points of a photo that both have; None
    elsewhere.

    Args:
        source: matches, photos and options of the mapping.
    """
    pairs = []
    for point in other.points3D.values():
        seen = [e for e in point.track.elements if model.exists_image(e.image_id)]
        there = [model.images[e.image_id].points2D[e.point2D_idx] for e in seen]
        same = [p.point3D_id for p in there if p.has_point3D()][:1]
        pairs += [(point.xyz, model.points3D[key].xyz) for key in same]
    if len(pairs) < FEWEST_MATCHES:
        return None
    ours, theirs = np.array(pairs).transpose(1, 0, 2)
    right = np.full(len(pairs), True)
    # 5: of fitting one model to another, each without what the last one fits badly
    for _ in range(5):
        scale, rotation, shift = fit_similarity(ours[right], theirs[right])
        error = np.linalg.norm(scale * ours @ rotation.T + shift - theirs, axis=1)
        right = error <= 3 * np.median(error)
    # 0.01: median of points that two models share, over their extent, up to which the two are one
    if np.median(error) > 0.01 * np.ptp(theirs, axis=0).max():
        return None
    colmap = load_colmap()
    other.transform(colmap.Sim3d(scale, colmap.Rotation3d(rotation), shift))
    both = colmap.Reconstruction()
    for part in (model, other):
        for key, camera in part.cameras.items():
            if not both.exists_camera(key):
                both.add_camera_with_trivial_rig(camera)
        for key, image in part.images.items():
            if image.has_pose and not both.exists_image(key):
                bare = colmap.Image(name=image.name, camera_id=image.camera_id, image_id=key)
                both.add_image_with_trivial_frame(bare, image.cam_from_world())
    both = colmap.triangulate_points(both, *source[:2], scratch, options=source[2])
    adjustment = colmap.BundleAdjustmentOptions()
    adjustment.ceres.solver_options.num_threads = 1  # as in _map
    colmap.bundle_adjustment(both, adjustment)
    both.extract_colors_for_all_images(str(source[1]))
    return both


def read_known(folder: Path) -> dict[str, KnownCamera]:
    """Lenses and poses of the photos of a COLMAP model, by name."""
    with _quiet(), naming(folder, "expected a COLMAP model"):
        model = _open_model(folder)
        lenses = lenses_of(model)
        poses = {i.name: _pose(i) for i in model.images.values() if i.name in lenses}
    cameras = {}
    for name, lens in lenses.items():
        numbers = lens.fx, lens.fy, lens.cx, lens.cy, *lens.coefficients
        cameras[name] = KnownCamera(lens.model, (lens.width, lens.height), numbers, 0.0, poses[name])
    return cameras


def _known_model(poses: KnownPoses, lenses: Mapping[str, Lens]) -> Any:
    """A COLMAP model of known poses, with its points where they come from one that has some and no camera's photos differ in
    size."""
    colmap = load_colmap()
    if poses.model is not None:
        model, photo_of = _open_model(poses.model), {name: photo for photo, name in poses.names.items()}
        images = [i for i in model.images.values() if photo_of.get(i.name) in lenses]
        sizes = {(i.camera_id, lenses[photo_of[i.name]]) for i in images}
        if model.num_points3D() and len(sizes) == len({i.camera_id for i in images}):  # one for each camera
            _renamed(model, photo_of, lenses)
            return model
    model = colmap.Reconstruction()
    for k, (lens, names) in enumerate(lenses_in_use(lenses).items()):
        model.add_camera_with_trivial_rig(colmap_camera(lens, k + 1))
        for name in names:
            image = colmap.Image(name=name, camera_id=k + 1, image_id=model.num_images() + 1)
            pose = poses.cameras[name].world_to_camera
            rigid = colmap.Rigid3d(colmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
            model.add_image_with_trivial_frame(image, rigid)
    return model


def _renamed(model: Any, photo_of: Mapping[str, str], lenses: Mapping[str, Lens]) -> None:
    """Give the images of a COLMAP model the names and sizes of photos; those without a photo lose their pose."""
    for image in list(model.images.values()):
        if photo_of.get(image.name) in lenses:
            image.name = photo_of[image.name]
            lens = lenses[image.name]
            model.cameras[image.camera_id].rescale(lens.width, lens.height)
        elif image.has_pose:
            model.deregister_frame(image.frame_id)


def _content(model: Any) -> list[Any]:
    """What a COLMAP model is made of, for a step's key."""
    posed = sorted((i for i in model.images.values() if i.has_pose), key=lambda image: image.name)
    rows = [[i.name, lens_of(model.cameras[i.camera_id]), i.cam_from_world().matrix()] for i in posed]
    points = sorted(model.points3D)
    return [rows, np.array([model.points3D[k].xyz for k in points]).reshape(-1, 3)]


def _keep_known(
    folder: Path, photos: Mapping[str, Path], model: Any, match: bool, seed: int, attempt: Attempt
) -> dict[str, Any]:
    """The ``model`` of known poses into the folder ``model``, its points triangulated from the matches where asked."""
    with folder_in_place(folder / "model") as whole:
        if match:
            attempt.progress("triangulating", 0, 1)
            colmap = load_colmap()
            options = colmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1)
            working = shutil.copyfile(folder / "matches.db", _fresh(attempt.folder) / "matches.db")
            root = _root(photos)
            model = colmap.triangulate_points(model, working, root, whole, options=options)
            model.extract_colors_for_all_images(str(root))
            attempt.progress("triangulating", 1, 1)
        _write_model(model, whole)
    return {"pieces": []}


def lenses_of(model: Any) -> dict[str, Lens]:
    """Lenses of the posed photos of a COLMAP model, by name."""
    lenses = {key: lens_of(camera) for key, camera in model.cameras.items()}
    posed = {i.name: lenses[i.camera_id] for i in model.images.values() if i.has_pose}
    return dict(sorted(posed.items()))


def _causes(matches: Path, sparse: SparseModel) -> dict[str, str]:
    colmap = load_colmap()
    with colmap.Database.open(str(matches)) as database:
        names = {i.image_id: i.name for i in database.read_all_images()}
        features = {name: database.num_keypoints_for_image(k) for k, name in names.items()}
        pairs, inliers = database.read_two_view_geometry_num_inliers()
    best: dict[str, tuple[int, str]] = {}
    for pair, count in zip(pairs, inliers, strict=True):
        ends = [names[k] for k in (pair if np.ndim(pair) else colmap.pair_id_to_image_pair(pair))]
        for one, other in (ends, ends[::-1]):
            if other in sparse.cameras:
                best[one] = max(best.get(one, (0, "")), (int(count), other))
    causes = {}
    for name in sparse.unposed:
        count, other = best.get(name, (0, ""))
        if features.get(name, 0) < FEWEST_FEATURES:
            causes[name] = f"shows {features.get(name, 0)} features: blank, dark or blurred"
        elif count < FEWEST_MATCHES:
            causes[name] = (
                f"shares {count or 'no'} features with any photo that has a pose: too little overlap"
            )
        else:
            causes[name] = (
                f"matches {other} in {count} features that do not fit the rest: too few, or of something alike"
            )
    return causes


def _pose(image: Any) -> np.ndarray:
    """World to camera of a posed image of COLMAP's, shape ``(4, 4)``."""
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ vt
    return pose


def _sparse_model(
    model: Any, names: Sequence[str], turns: Mapping[str, int] | None = None, max_pixels: int = 2**62
) -> SparseModel:
    """A COLMAP model with the cameras of the undistorted, upright, reduced photos."""
    images = {i.name: i for i in model.images.values() if i.has_pose}
    cameras, share = {}, {}
    for name, lens in lenses_of(model).items():
        cameras[name] = pinhole_of(lens, _pose(images[name]), (turns or {}).get(name, 0), max_pixels)
        share[images[name].image_id] = (cameras[name].fx + cameras[name].fy) / (lens.fx + lens.fy)
    position = {images[n].image_id: i for i, n in enumerate(cameras)}
    # What no photo shows is no use.
    points = [p for _, p in sorted(model.points3D.items()) if p.track.elements]
    tracks = [sorted({position[e.image_id] for e in p.track.elements}) for p in points]
    return SparseModel(
        cameras=cameras,
        points=np.array([p.xyz for p in points], dtype=np.float64).reshape(-1, 3),
        colors=np.array([p.color for p in points], dtype=np.float64).reshape(-1, 3) / 255,
        reprojection_error=np.array(
            [p.error * np.mean([share[e.image_id] for e in p.track.elements]) for p in points],
            dtype=np.float64,
        ),
        track_length=np.array([len(t) for t in tracks], dtype=np.int64),
        track_camera=np.array([c for t in tracks for c in t], dtype=np.int64),
        unposed=tuple(n for n in names if n not in cameras),
    )
