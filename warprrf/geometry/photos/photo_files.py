"""Photo files of stage 1: which there are, what they are called, whether they fit together, what they show."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from warprrf.device import require

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
MIN_PHOTOS = 3

Photos = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A folder of photos, or image files."""


def find_photos(photos: Photos) -> dict[str, Path]:
    """Photo name to file, sorted by name, for a folder or a sequence of image files.

    A name is the path below the folder (or below the files' common folder), with forward slashes. Hidden files of a
    folder are left out: half-written ones, or another system's notes.

    Raises:
        ValueError: if the folder or files do not exist, or too few photos are there.
    """
    if isinstance(photos, str | os.PathLike):
        root = Path(photos).absolute()
        if not root.is_dir():
            raise ValueError(
                f"photos: {root} is not a folder; expected a folder of photos or a list of image files"
            )
        found = (p for p in root.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES and p.is_file())
        files = sorted(p for p in found if not p.name.startswith("."))
    else:
        if odd := [p for p in photos if not isinstance(p, str | os.PathLike)]:
            raise TypeError(f"photos: got {type(odd[0]).__name__} in a list, expected image files")
        files = [Path(p) for p in photos]
        missing = [str(p) for p in files if not p.is_file()]
        if missing:
            raise ValueError(f"photos: {len(missing)} of {len(files)} files do not exist: {some(missing)}")
        parents = {str(p.resolve().parent) for p in files}
        root = Path(os.path.commonpath(parents)) if parents else Path()
        files = [p.resolve() for p in files]
    named = {p.relative_to(root).as_posix(): p for p in files}
    if len(named) < MIN_PHOTOS:
        raise ValueError(
            f"photos: got {len(named)} photos in {root}, expected at least {MIN_PHOTOS} "
            f"({', '.join(PHOTO_SUFFIXES)}); a room wants 60 or more that overlap"
        )
    return dict(sorted(named.items()))


def check_photos(named: Mapping[str, Path]) -> None:
    """Refuse photos that do not read as images, or differ in size.

    Raises:
        ValueError: naming the files.
    """
    image = require("PIL.Image", extra="photos")
    bad, sizes = [], {}
    for name, path in named.items():
        try:
            with image.open(path) as photo:
                photo.load()
                sizes[name] = photo.size
        except (OSError, SyntaxError, ValueError, image.DecompressionBombError) as error:
            bad.append(f"{name} ({error})")
    if bad:
        raise ValueError(f"photos: {len(bad)} of {len(named)} files do not read as images: {some(bad)}")
    common = max(set(sizes.values()), key=list(sizes.values()).count)
    odd = [f"{n} ({s[0]} x {s[1]})" for n, s in sizes.items() if s != common]
    if odd:
        raise ValueError(
            f"photos: {len(odd)} photos are not {common[0]} x {common[1]} as the others are; one camera with one "
            f"image size is expected: {some(odd)}"
        )


def match_names(argument: str, wanted: Iterable[str], names: Sequence[str]) -> list[str]:
    """Full photo names of ``wanted``: each is a name, or a file name that only one of ``names`` has.

    Raises:
        ValueError: naming the entries that are no photo, or that several photos share.
    """
    by_file: dict[str, list[str]] = {}
    for name in names:
        by_file.setdefault(name.rsplit("/", 1)[-1], []).append(name)
    found: list[str] = []
    unknown: list[str] = []
    shared: list[str] = []
    for key in wanted:
        key = str(key)
        if key in names:
            found.append(key)
        elif len(by_file.get(Path(key).name, ())) == 1:
            found.append(by_file[Path(key).name][0])
        else:
            (shared if Path(key).name in by_file else unknown).append(key)
    if unknown:
        raise ValueError(
            f"{argument}: no such photo: {some(unknown)}; photos are named like {some(list(names), 2)}"
        )
    if shared:
        raise ValueError(
            f"{argument}: several photos have the file name of {some(shared)}; give the longer name"
        )
    return found


def read_photo(path: str | os.PathLike[str]) -> np.ndarray:
    """A photo as RGB in [0, 1], shape ``(H, W, 3)`` float32.

    Raises:
        ValueError: if the file does not read as an image.
    """
    image = require("PIL.Image", extra="photos")
    try:
        with image.open(path) as photo:
            return np.asarray(photo.convert("RGB"), dtype=np.float32) / 255
    except (OSError, SyntaxError, ValueError, image.DecompressionBombError) as error:
        raise ValueError(f"photos: {path} does not read as an image: {error}") from error


def some(items: Sequence[str], limit: int = 5) -> str:
    """The first few of many names, for a message."""
    more = f" and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(str(i) for i in items[:limit]) + more
