"""Triangle meshes to and from files (PLY, OBJ): the one module that touches trimesh.

Vertices are metres, faces are counter-clockwise seen from outside. Texture coordinates are those of Mitsuba: one pair
per vertex, so a vertex on a texture seam is stored once per side.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array
from warprrf.device import require
from warprrf.files import write_atomically


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
    """Read a PLY or OBJ file, vertices and faces in the file's own order.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file cannot be read, holds no triangles, or holds NaN or out-of-range indices.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no mesh file {path}")
    try:
        mesh = _trimesh().load(path, process=False, force="mesh")
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces, dtype=np.int32).reshape(-1, 3)
    except ImportError:
        raise
    except Exception as error:  # trimesh raises whatever its parsers trip over
        raise ValueError(f"path: {path} is not a readable mesh: {error}") from error
    if len(faces) == 0:
        raise ValueError(f"path: {path} holds no triangles")
    if not np.isfinite(vertices).all():
        raise ValueError(f"path: {path} holds vertices that are NaN or infinite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"path: {path} names vertex {faces.max()} but holds {len(vertices)}")
    uv = getattr(mesh.visual, "uv", None)
    if uv is None:
        attributes = getattr(mesh, "vertex_attributes", {})
        if "s" in attributes and "t" in attributes:
            uv = np.column_stack([np.ravel(attributes["s"]), np.ravel(attributes["t"])])
    return MeshFile(vertices, faces, None if uv is None else np.asarray(uv, dtype=np.float64))


def write_mesh(
    path: str | os.PathLike[str], vertices: ArrayLike, faces: ArrayLike, *, uv: ArrayLike | None = None
) -> None:
    """Write a mesh (the suffix of ``path`` picks the format) to a temporary name, then move it into place.

    Args:
        vertices: positions [m], shape ``(V, 3)``.
        faces: vertex indices, shape ``(F, 3)``.
        uv: texture coordinates, shape ``(V, 2)``.
    """
    path = Path(path)
    trimesh = _trimesh()
    vertices = check_array("vertices", vertices, (None, 3))
    mesh = trimesh.Trimesh(vertices, check_array("faces", faces, (None, 3), dtype=np.int32), process=False)
    if uv is not None:
        coordinates = check_array("uv", uv, (len(vertices), 2)).astype(np.float32)
        mesh.vertex_attributes["s"] = coordinates[:, 0]
        mesh.vertex_attributes["t"] = coordinates[:, 1]
    data = mesh.export(file_type=path.suffix.lstrip("."))
    write_atomically(path, lambda file: file.write_bytes(data.encode() if isinstance(data, str) else data))
