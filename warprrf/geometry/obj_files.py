"""OBJ files with their materials: vertices and faces in the file's own order, names of materials and objects, colours.

What a line states is held against what the format gives it: a damaged line is an error, never a face less.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from warprrf.checks import warn
from warprrf.geometry.mesh_content import (
    Folder,
    MeshContent,
    material_name,
    numbered,
    read_picture,
    sampled,
    to_linear,
    to_srgb,
    triangulated,
)

_STATEMENTS = {
    "v": (3, 8), "vt": (1, 3), "vn": (3, 3), "vp": (1, 3), "f": (3, 4096), "l": (2, 4096), "p": (1, 4096), "o": (0, 99),
    "g": (0, 99), "s": (1, 1), "usemtl": (1, 99), "mtllib": (1, 99),
}  # fmt: skip
"""Statements of an OBJ file, and how many words may follow each."""


@dataclass
class _Lines:
    """What the lines of an OBJ file say: numbers one after the other, and where names begin to hold."""

    positions: array[float] = field(default_factory=lambda: array("d"))
    colours: array[float] = field(default_factory=lambda: array("d"))
    textures: array[float] = field(default_factory=lambda: array("d"))
    sizes: array[int] = field(default_factory=lambda: array("q"))
    corners: array[int] = field(default_factory=lambda: array("q"))
    corner_textures: array[int] = field(default_factory=lambda: array("q"))
    names: dict[str, str] = field(default_factory=dict)
    libraries: list[str] = field(default_factory=list)
    runs: list[tuple[int, str | None, str | None]] = field(default_factory=lambda: [(0, None, None)])

    def add(self, words: list[str]) -> None:
        least, most = _STATEMENTS.get(words[0], (0, -1))
        if not least <= len(words) - 1 <= most:
            raise ValueError(f"it is no statement of an OBJ file, or has {len(words) - 1} words after it")
        match words:
            case ["v", *numbers]:
                self.positions.extend(map(float, numbers[:3]))
                if len(numbers) in (6, 7):
                    self.colours.extend(map(float, numbers[-3:]))
            case ["vt", *numbers]:
                self.textures.extend(map(float, (numbers + ["0"])[:2]))
            case ["f", *corners]:
                self.sizes.append(len(corners))
                for corner in corners:
                    parts = corner.split("/")
                    self.corners.append(_index(parts[0], len(self.positions) // 3))
                    mapped = len(parts) > 1 and parts[1] != ""
                    self.corner_textures.append(_index(parts[1], len(self.textures) // 2) if mapped else -1)
            case ["usemtl" | "o" | "g" as kind, *name]:
                self.names[kind] = " ".join(name)
                thing = self.names.get("o") or self.names.get("g")
                self.runs.append((len(self.sizes), self.names.get("usemtl"), thing or None))
            case ["mtllib", *name]:
                self.libraries.append(" ".join(name))


_Material = tuple[np.ndarray, np.ndarray | None]
"""Of an MTL file: linear colour (3,), and the picture that stands for it."""


def read_obj(folder: Folder) -> MeshContent:
    """Read the OBJ file of ``folder``; polygons become triangles.

    Raises:
        ValueError: naming the file and the line, if it is damaged or names files outside its folder.

    Warns:
        UserWarning: if a file of materials or a texture is missing: those colours stay unknown.
    """
    lines = _lines(folder)
    if not np.isfinite(lines.textures).all():
        raise ValueError(f"path: {folder.path} holds texture coordinates that are not finite")
    if not all(0 <= colour <= 1 for colour in lines.colours):
        raise ValueError(f"path: {folder.path} holds colours outside 0 to 1")
    corners, sizes = np.array(lines.corners, np.int64), np.array(lines.sizes, np.int64)
    positions = np.array(lines.positions, dtype=np.float64).reshape(-1, 3)
    index, _ = triangulated(sizes, corners, positions)
    faces, textures = corners[index], np.array(lines.corner_textures, np.int64)[index]
    polygons, material, thing = zip(*lines.runs, strict=True)
    starts = np.append(0, np.cumsum(sizes - 2))[list(polygons)].tolist()
    ends = [*starts[1:], len(faces)]
    known: dict[str, _Material] = {}
    for library in lines.libraries if folder.colours else ():
        try:
            known |= _read_materials(folder, library)
        except FileNotFoundError as error:
            warn(f"{error}; its colours stay unknown")
    pages = {name for name, (_, picture) in known.items() if picture is not None}
    counts = np.subtract(ends, starts).tolist()
    names = numbered([material_name(name, name in pages) for name in material], counts)
    objects = numbered(thing, counts)
    runs = [(known[m], k, n) for m, k, n in zip(material, starts, ends, strict=True) if m in known and k < n]
    return MeshContent(
        positions, faces.astype(np.int32), face_colours=_colours(lines, faces, textures, runs),
        face_material=names[0], material_names=names[1], face_object=objects[0], object_names=objects[1],
    )  # fmt: skip


def _statements(text: str) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line that says something."""
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if words:
            yield number, words


def _lines(folder: Folder) -> _Lines:
    try:
        text = folder.path.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"path: {folder.path} is not a readable mesh: {error}") from error
    found = _Lines()
    for number, words in _statements(text):
        try:
            found.add(words)
        except (ValueError, OverflowError) as error:
            raise ValueError(
                f"path: {folder.path} is not a readable mesh: line {number} is {' '.join(words)[:60]!r}: {error}"
            ) from error
    return found


def _index(word: str, count: int) -> int:
    """From 0, of ``count`` rows so far, of a number from 1 or from -1 backward."""
    number = int(word)
    index = number - 1 if number > 0 else count + number
    if number == 0 or not 0 <= index < 2**31:
        raise ValueError(f"index {number} of {count}")
    return index


def _read_materials(folder: Folder, library: str) -> dict[str, _Material]:
    known: dict[str, _Material] = {}
    name: str | None = None

    @lru_cache(None)  # materials share them
    def picture(file: Path) -> np.ndarray:
        return read_picture(file.read_bytes(), f"path: {folder.path}, texture {file}")

    for number, words in _statements(folder.find(library).read_text("utf-8-sig", "replace")):
        try:
            match words:
                case ["newmtl", *parts]:
                    name = " ".join(parts)
                    known[name] = (np.full(3, np.nan), None)
                case ["Kd", red, green, blue] if name is not None:
                    colour = to_linear(np.array([float(red), float(green), float(blue)]))
                    known[name] = (colour, known[name][1])
                case ["map_Kd", *parts] if name is not None and parts:
                    file = parts[-1] if parts[0].startswith("-") else " ".join(parts)
                    known[name] = (known[name][0], picture(folder.find(file)))
        except FileNotFoundError as error:
            warn(f"{error}; its colours stay unknown")
        except ValueError as error:
            raise ValueError(f"{error} (line {number} of {library}, which {folder.path} names)") from error
    return known


def _colours(
    lines: _Lines, faces: np.ndarray, corner: np.ndarray, runs: list[tuple[_Material, int, int]]
) -> np.ndarray | None:
    """sRGB of faces: of the texture, else of the vertices, else of the material; None without any.

    Args:
        corner: texture coordinates of corners, shape ``(F, 3)``, -1 for none.
        runs: faces that have a material, from a first one to behind a last one.
    """
    colour = np.full((len(faces), 3), np.nan)
    if len(lines.colours) == len(lines.positions):
        vertex = to_linear(np.array(lines.colours).reshape(-1, 3))
        own = (faces < len(vertex)).all(axis=1)  # the others are refused by whoever reads them
        colour[own] = vertex[faces[own]].mean(axis=1)
    uv = np.array(lines.textures, dtype=np.float64).reshape(-1, 2)
    for (plain, picture), low, high in runs:
        part, at = colour[low:high], corner[low:high]
        part[np.isnan(part[:, 0])] = plain
        mapped = (at >= 0).all(axis=1) & (at < len(uv)).all(axis=1)
        if picture is not None and mapped.any():
            part[mapped] = sampled(picture, uv[at[mapped]])
    return None if np.isnan(colour).all() else to_srgb(colour).astype(np.float32)
