"""Triangle meshes to and from files: PLY, and OBJ by trimesh, which no other module touches.

Vertices are metres, faces are counter-clockwise seen from outside. Texture coordinates are those of Mitsuba: one pair
per vertex, so a vertex on a texture seam is stored once per side.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import LARGEST_M, check_array
from warprrf.device import require
from warprrf.files import write_bytes
from warprrf.geometry.ply_files import Element, Lists, read_ply, write_ply

LARGEST_BYTES = 4 << 30
_CHECKSUM = b"# warprrf sha256 "  # the comment that begins an OBJ file of ours: a letter there may be a face
_OBJ = {
    "v": (3, 8), "vt": (1, 3), "vn": (3, 3), "vp": (1, 3), "f": (3, 4096), "l": (2, 4096), "p": (1, 4096), "o": (0, 99),
    "g": (0, 99), "s": (1, 1), "usemtl": (1, 99), "mtllib": (1, 99),
}  # fmt: skip
"""Statements of an OBJ file, and how many words may follow each."""


@dataclass(frozen=True)
class MeshFile:
    """What a mesh file holds.

    Attributes:
        vertices: positions [m], shape ``(V, 3)``, float64.
        faces: vertex indices, shape ``(F, 3)``, int32.
        uv: texture coordinates, shape ``(V, 2)``, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None


def _trimesh() -> Any:
    return require("trimesh", extra="mesh")


def read_mesh(path: str | os.PathLike[str]) -> MeshFile:
    """Read a PLY or OBJ file, vertices and faces in the file's own order; polygons become fans of triangles.

    Raises:
        OSError: naming the file, if it cannot be read.
        ValueError: naming it, if it is damaged, holds no triangles, or holds NaN or out-of-range indices.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no mesh file {path}")
    if path.stat().st_size > LARGEST_BYTES:
        raise ValueError(f"path: {path} has {path.stat().st_size} bytes, expected at most {LARGEST_BYTES}")
    content = _from_ply(path) if path.suffix.lower() == ".ply" else _from_obj(path)
    vertices, faces, uv = content.vertices, content.faces, content.uv
    if len(faces) == 0:
        raise ValueError(f"path: {path} holds no triangles")
    for name, values in (("vertices", vertices), ("texture coordinates", uv)):
        if values is not None and not (np.abs(values) < LARGEST_M).all():
            raise ValueError(f"path: {path} holds {name} that are NaN, infinite or above {LARGEST_M:g}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"path: {path} names vertices from {faces.min()} to {faces.max()} but holds {len(vertices)}"
        )
    return MeshFile(vertices, faces.astype(np.int32), uv)


def _from_ply(path: Path) -> MeshFile:
    held = read_ply(path)
    vertex, face = held.get("vertex", {}), held.get("face", {})
    corners = face.get("vertex_indices", face.get("vertex_index"))
    missing = [name for name in "xyz" if not isinstance(vertex.get(name), np.ndarray)]
    if missing or not isinstance(corners, Lists):
        raise ValueError(
            f"path: {path} holds no triangles: it lacks x, y, z of vertices or lists of their indices"
        )
    uv = next((names for names in (("s", "t"), ("u", "v")) if set(names) & set(vertex)), None)
    if uv is not None and not set(uv) <= set(vertex):
        raise ValueError(
            f"path: {path} holds one of the texture coordinates {' and '.join(uv)}, expected both"
        )
    return MeshFile(
        _columns(vertex, "xyz"), _fans(corners, path), None if uv is None else _columns(vertex, uv)
    )  # fmt: skip


def _columns(element: Element, names: Sequence[str]) -> np.ndarray:
    return np.column_stack([np.asarray(element[name], dtype=np.float64) for name in names])


def _fans(polygons: Lists, path: Path) -> np.ndarray:
    """Triangles ``(F, 3)`` around the first corner of each polygon."""
    n = polygons.lengths
    if (n < 3).any():
        raise ValueError(f"path: {path} holds {int((n < 3).sum())} faces of fewer than three corners")
    first = np.repeat(np.cumsum(n) - n, n - 2)
    place = np.arange(len(first)) - np.repeat(np.cumsum(n - 2) - (n - 2), n - 2)
    index = np.stack([first, first + place + 1, first + place + 2], axis=1)
    return np.asarray(polygons.values, dtype=np.int64)[index]


def _from_obj(path: Path) -> MeshFile:
    """By trimesh, once a checksum of ours holds and every line has as many words as the format gives it."""
    data = path.read_bytes()
    first, _, content = data.partition(b"\n")
    if first.startswith(_CHECKSUM) and first != _CHECKSUM + hashlib.sha256(content).hexdigest().encode():
        raise ValueError(
            f"path: {path} is damaged: its sha256 does not fit; take that line out if the file was edited"
        )
    try:
        lines = data.decode("utf-8").replace("\\\n", " ").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"path: {path} is not a readable mesh: {error}") from error
    triangles = 0
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].split()
        least, most = _OBJ.get(words[0], (0, -1)) if words else (0, 0)
        if words and not least <= len(words) - 1 <= most:
            raise ValueError(f"path: {path} is not a readable mesh: line {number} is {line[:60]!r}")
        triangles += len(words) - 3 if words[:1] == ["f"] else 0
    try:
        mesh = _trimesh().load(path, process=False, force="mesh")
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    except ImportError:
        raise
    except Exception as error:  # trimesh raises whatever its parsers trip over
        raise ValueError(f"path: {path} is not a readable mesh: {error}") from error
    if len(faces) != triangles:
        raise ValueError(f"path: {path} states {triangles} triangles, of which {len(faces)} can be read")
    uv = getattr(mesh.visual, "uv", None)
    return MeshFile(vertices, faces, None if uv is None else np.asarray(uv, dtype=np.float64))


def write_mesh(
    path: str | os.PathLike[str], vertices: ArrayLike, faces: ArrayLike, *, uv: ArrayLike | None = None
) -> None:
    """Write a mesh (the suffix of ``path`` picks the format), whole or not at all.

    Args:
        vertices: positions [m], shape ``(V, 3)``.
        faces: vertex indices, shape ``(F, 3)``.
        uv: texture coordinates, shape ``(V, 2)``, for PLY.
    """
    path = Path(path)
    vertices = check_array("vertices", vertices, (None, 3))
    triangles = check_array("faces", faces, (None, 3), dtype=np.int32)
    coordinates = None if uv is None else check_array("uv", uv, (len(vertices), 2))
    if path.suffix == ".ply":
        columns = dict(zip("xyz", vertices.T, strict=True))
        columns |= {} if coordinates is None else dict(zip("st", coordinates.T, strict=True))
        write_ply(path, columns, triangles)
        return
    data = _trimesh().Trimesh(vertices, triangles, process=False).export(file_type=path.suffix.lstrip("."))
    data = data.encode() if isinstance(data, str) else data
    if path.suffix == ".obj":
        data = _CHECKSUM + hashlib.sha256(data).hexdigest().encode() + b"\n" + data
    write_bytes(path, data)
