"""Photo files of stage 1: which there are, what they are called, whether they fit together, what they show."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warprrf.checks import some_of
from warprrf.device import require
from warprrf.files import UNREADABLE
from warprrf.steps import RECORDS

T = TypeVar("T")

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
MASK_SUFFIX = ".mask.png"
MIN_PHOTOS = 3
TURNS = {1: 0, 6: 1, 3: 2, 8: 3}
"""Quarter turns clockwise that bring a photo upright, by EXIF's orientation; the other four are mirrored."""

Photos = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A folder of photos, or image files."""


def find_photos(photos: Photos) -> dict[str, Path]:
    """Photo name to file, sorted by name, for a folder or a sequence of image files.

    A name is the path below the folder (or below the files' common folder), with forward slashes. Hidden files of a
    folder are left out: half-written ones, or another system's notes; and so are those that a workspace in it holds.
    ``NAME.mask.png`` is no photo but the mask of the photo ``NAME`` beside it (:func:`mask_beside`).
    """
    if isinstance(photos, str | os.PathLike):
        root = Path(photos).absolute()
        if not root.is_dir():
            raise ValueError(
                f"photos: {root} is not a folder; expected a folder of photos or a list of image files"
            )
        found = (p for p in root.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES and p.is_file())
        every = sorted(p for p in found if not p.name.startswith(".") and not _of_workspace(p, root))
        files = [p for p in every if not p.name.lower().endswith(MASK_SUFFIX)]
        stray = sorted(set(every) - set(files) - {mask_name(p) for p in files})
        if stray:
            names = some_of([p.relative_to(root).as_posix() for p in stray])
            raise ValueError(
                f"photos: {len(stray)} masks are of no photo: {names}; the mask of 0007.jpg is 0007.mask.png"
            )
    else:
        if odd := [p for p in photos if not isinstance(p, str | os.PathLike)]:
            raise TypeError(f"photos: got {type(odd[0]).__name__} in a list, expected image files")
        files = [Path(p) for p in photos if not str(p).lower().endswith(MASK_SUFFIX)]
        missing = [str(p) for p in files if not p.is_file()]
        if missing:
            raise ValueError(f"photos: {len(missing)} of {len(files)} files do not exist: {some_of(missing)}")
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


def _of_workspace(file: Path, root: Path) -> bool:
    """Whether ``file`` lies in a folder of finished steps below ``root``."""
    between = [folder for folder in file.parents if folder != root and folder.is_relative_to(root)]
    return any((folder / RECORDS).is_dir() for folder in between)


@dataclass(frozen=True)
class PhotoFacts:
    """What a photo's file says of it before its pixels are read.

    Attributes:
        width, height: as stored [pixels].
        turns: quarter turns clockwise that bring it upright.
        taken_with: EXIF's maker, model and focal length of the camera; empty where it says none.
    """

    width: int
    height: int
    turns: int
    taken_with: tuple[str, ...]


@contextmanager
def opened(path: str | os.PathLike[str], argument: str = "photos", kind: str = "an image") -> Iterator[Any]:
    """A picture file, as a Pillow image whose pixels are not read yet.

    Raises:
        ValueError: if it does not read, there or in the block: it is no such ``kind`` of picture.
    """
    image = require("PIL.Image", extra="photos")
    try:
        with image.open(path) as picture:
            yield picture
    except (OSError, *UNREADABLE, image.DecompressionBombError) as error:
        raise ValueError(f"{argument}: {path} does not read as {kind}: {error}") from error


def photo_facts(path: Path) -> PhotoFacts:
    """Size, orientation and camera of a photo, from its header."""
    with opened(path) as photo:
        exif = photo.getexif()
        width, height = photo.size
        lens = exif.get_ifd(0x8769)
        orientation = exif.get(0x0112, 1)
        names = [str(exif.get(tag, "")).strip("\0 ") for tag in (0x010F, 0x0110)]
        taken_with = (*names, str(lens.get(0x920A, ""))) if any(names) else ()
    if orientation not in TURNS:
        raise ValueError(
            f"photos: {path} has EXIF orientation {orientation}, expected 1, 3, 6 or 8: it is stored mirrored, or the "
            "entry is damaged; save it as it is to be seen"
        )
    return PhotoFacts(width, height, TURNS[orientation], taken_with)


def cameras_of(named: Mapping[str, Path]) -> list[list[str]]:
    """Names of the photos that each camera took.

    Photos of one size whose EXIF names one camera at one focal length are of one camera, wherever they lie; without
    EXIF those of one size in one folder are.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for name, path in named.items():
        facts = photo_facts(path)
        whose = facts.taken_with or name.rpartition("/")[0]
        groups.setdefault((facts.width, facts.height, whose), []).append(name)
    return list(groups.values())


def mask_name(photo: Path) -> Path:
    """Where the mask of ``photo`` lies, if it has one: ``0007.mask.png`` beside ``0007.jpg``."""
    return photo.with_name(photo.stem + MASK_SUFFIX)


def mask_beside(photo: Path) -> Path | None:
    """The mask of ``photo``: a grey picture, upright and of its size, black where the photo is to be ignored."""
    path = mask_name(photo)
    return path if path.is_file() else None


def check_photos(named: Mapping[str, Path]) -> None:
    """Refuse photos that do not read as images, and masks of another size than their photo or without white."""
    bad: list[str] = []
    for name, path in named.items():
        try:
            facts = photo_facts(path)
            open_photo(path, "RGB")
            if (mask := mask_beside(path)) is not None:
                size = open_photo(mask, "L").size
                upright = (facts.width, facts.height)[:: -1 if facts.turns % 2 else 1]
                if size != upright:
                    raise ValueError(
                        f"its mask is {size[0]} x {size[1]}, expected {upright[0]} x {upright[1]}"
                    )
                open_mask(mask)
        except ValueError as error:
            bad.append(f"{name} ({error})")
    if bad:
        raise ValueError(f"photos: {len(bad)} of {len(named)} files do not read as images: {some_of(bad)}")


def match_names(argument: str, wanted: Iterable[str], names: Sequence[str]) -> list[str]:
    """Full photo names of ``wanted``: each is a name, or a file name that only one of ``names`` has."""
    found, unknown, shared = list[str](), list[str](), list[str]()
    for key in map(str, wanted):
        hits = [key] if key in names else [n for n in names if n.rpartition("/")[2] == Path(key).name]
        if len(hits) == 1:
            found.append(hits[0])
        else:
            (shared if hits else unknown).append(key)
    if unknown:
        raise ValueError(
            f"{argument}: no such photo: {some_of(unknown)}; photos are named like {some_of(list(names), 2)}"
        )
    if shared:
        raise ValueError(
            f"{argument}: several photos have the file name of {some_of(shared)}; give the longer name"
        )
    if twice := sorted({name for name in found if found.count(name) > 1}):
        raise ValueError(f"{argument}: got {some_of(twice)} twice, expected each photo once")
    return found


def open_photo(path: str | os.PathLike[str], mode: str) -> Any:
    """A photo as it is stored, as a Pillow image of ``mode`` (``"RGB"`` or ``"L"``)."""
    with opened(path) as photo:
        if photo.mode[0] in "IF":
            raise ValueError(f"its pixels have more than 8 bits ({photo.mode}); save it with 8")
        shows_through = "A" in photo.getbands() or "transparency" in photo.info
        if shows_through and photo.convert("RGBA").getchannel("A").getextrema()[0] < 255:
            raise ValueError(
                f"some of its pixels are transparent; save it without, and with a mask (NAME{MASK_SUFFIX}) where a photo is "
                "to be ignored"
            )
        return photo.convert(mode)


def open_mask(path: str | os.PathLike[str]) -> Any:
    """The mask of a photo as a grey Pillow image.

    Raises:
        ValueError: if it does not read, or has neither black alone nor any white: others count from 0 to 1, say.
    """
    mask = open_photo(path, "L")
    brightest = mask.getextrema()[1]
    if 0 < brightest < 255:
        raise ValueError(
            f"the mask {path} is {brightest} where it is brightest, expected 255 (white) where a photo counts"
        )
    return mask


def read_photo(path: str | os.PathLike[str]) -> np.ndarray:
    """A photo as it is stored, RGB in [0, 1], shape ``(H, W, 3)`` float32."""
    return np.asarray(open_photo(path, "RGB"), dtype=np.float32) / 255


def read_mask(photo: str | os.PathLike[str]) -> np.ndarray | None:
    """Where ``photo`` is to be ignored, shape ``(H, W)`` bool, from the mask beside it; None without one."""
    path = mask_beside(Path(photo))
    return None if path is None else np.asarray(open_photo(path, "L")) < 128


def spread(items: Iterable[T], most: int) -> list[T]:
    """At most so many of ``items``, evenly spread."""
    every = list(items)
    return [every[k] for k in np.linspace(0, len(every) - 1, min(len(every), most)).round().astype(int)]
