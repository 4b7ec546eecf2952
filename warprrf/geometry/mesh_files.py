"""Triangle meshes to and from files: PLY, OBJ, STL, glTF and GLB, with the colours and names that they hold.

Faces are counter-clockwise seen from outside. Texture coordinates are those of Mitsuba: one pair per vertex, so a vertex
on a texture seam is stored once per side.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import LARGEST_M, check_array, check_choice, check_count, warn
from warprrf.files import file_at
from warprrf.geometry.gltf_files import read_gltf
from warprrf.geometry.mesh_content import (
    LARGEST_BYTES,
    Folder,
    MeshContent,
    to_linear,
    to_srgb,
    triangulated,
)
from warprrf.geometry.obj_files import read_obj
from warprrf.geometry.ply_files import Element, Lists, read_ply, write_ply
from warprrf.geometry.rays import open3d
from warprrf.rows import distinct_rows

METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "ft": 0.3048}
"""Units of length [m]."""
UP = {
    "x": ([1, 2, 0], [1.0, 1.0, 1.0]),
    "y": ([0, 2, 1], [1.0, -1.0, 1.0]),
    "z": ([0, 1, 2], [1.0, 1.0, 1.0]),
}
"""The file's axes that become x, y, z, and their signs, by the name of that which points up. Of y-up files x stays, as
modelling programs have it that write z-up scenes so."""
USUAL_SIZE_M = (0.2, 5000.0)  # of what is in metres when nobody said so


def load_mesh(
    path: str | os.PathLike[str],
    *,
    unit: str | None = None,
    up: str | None = None,
    simplify: int | None = None,
    allow_outside: bool = False,
) -> MeshContent:
    """Read a mesh file into metres, z up; vertices at one place become one.

    Arguments, errors and warnings are those of :meth:`Mesh.load`.
    """
    for name, value, known in (("unit", unit, METRES), ("up", up, UP)):
        if value is not None:
            check_choice(name, value, known)
    if simplify is not None:
        check_count("simplify", simplify, 4)
    content = read_mesh(path, allow_outside=allow_outside)
    axes, signs = UP[up or ("y" if Path(path).suffix.lower() in GLTF else "z")]
    turned = content.vertices[:, axes] * np.array(signs) * METRES[unit or "m"]
    vertices, faces = _merged(turned, content.faces)
    if not (np.abs(vertices) < LARGEST_M).all():
        raise ValueError(f"unit: in {unit!r} {path} holds vertices beyond {LARGEST_M:g} m")
    size = float(np.ptp(vertices, axis=0).max())
    if unit is None and not USUAL_SIZE_M[0] <= size <= USUAL_SIZE_M[1]:
        warn(
            f"path: {path} is {size:.3g} m in size if its unit is the metre; give unit= ({', '.join(METRES)})"
        )
    content = replace(content, vertices=vertices, faces=faces, uv=None)
    if simplify is None or len(faces) <= simplify:
        return content
    return content.with_faces(*_simplified(vertices, faces, simplify))


def read_mesh(
    path: str | os.PathLike[str], *, allow_outside: bool = False, colours: bool = True
) -> MeshContent:
    """Read a mesh file as it stands, in its own unit and axes; polygons become triangles.

    Args:
        path, allow_outside: as for :meth:`Mesh.load`.
        colours: whether the files of materials and textures that it names are read.

    Raises:
        OSError: naming the file, if it cannot be read.
        ValueError: naming it, if it is damaged, holds no triangles, or holds NaN or out-of-range indices.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"path: got {path}, expected a mesh file: {', '.join(READERS)}")
    if file_at(path, "mesh file").stat().st_size > LARGEST_BYTES:
        raise ValueError(f"path: {path} has {path.stat().st_size} bytes, expected at most {LARGEST_BYTES}")
    content = reader(Folder(path, allow_outside, colours))
    vertices, faces = content.vertices, content.faces
    if len(faces) == 0:
        raise ValueError(f"path: {path} holds no triangles")
    if not (np.abs(vertices) < LARGEST_M).all():
        raise ValueError(f"path: {path} holds vertices that are NaN, infinite or above {LARGEST_M:g}")
    if content.uv is not None and not np.isfinite(content.uv).all():
        content = replace(content, uv=None)  # of faces without a texture, as some programs write them
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"path: {path} names vertices from {faces.min()} to {faces.max()} but holds {len(vertices)}"
        )
    return content


def _merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the same coordinates as one, in the order in which they come, and faces of those."""
    first, index, _ = distinct_rows(vertices)
    order = np.argsort(first)
    place = np.empty(len(first), np.int64)
    place[order] = np.arange(len(first))
    return vertices[first[order]], place[index][faces].astype(np.int32)


def _simplified(
    vertices: np.ndarray, faces: np.ndarray, target: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At most about ``target`` triangles by quadric decimation, and for each the face that it lies nearest to.

    Source: Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997, in Open3D.
    """
    o3d = open3d()
    middle = vertices.mean(axis=0)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices - middle), o3d.utility.Vector3iVector(faces)
    )
    fewer = mesh.simplify_quadric_decimation(target)
    points, triangles = np.asarray(fewer.vertices), np.asarray(fewer.triangles, dtype=np.int32)
    if len(triangles) == 0:
        raise ValueError(
            f"simplify: got {target}, but nothing is left of {len(faces)} triangles; ask for more"
        )
    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles((vertices - middle).astype(np.float32), faces.astype(np.uint32))
    centre = points[triangles].mean(axis=1).astype(np.float32)
    parent = rays.compute_closest_points(o3d.core.Tensor(centre))["primitive_ids"].numpy()
    return points + middle, triangles, parent.astype(np.int64)


def _from_ply(folder: Folder) -> MeshContent:
    path = folder.path
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
    vertices = _columns(vertex, "xyz")
    faces, polygon = _triangles(corners, vertices, path)
    own, seen = _ply_colours(face, path), _ply_colours(vertex, path)
    colours = None
    if own is not None:
        colours = own[polygon]
    elif seen is not None and faces.min(initial=0) >= 0 and faces.max(initial=0) < len(vertices):
        colours = to_srgb(to_linear(seen)[faces].mean(axis=1)).astype(np.float32)
    return MeshContent(vertices, faces, None if uv is None else _columns(vertex, uv), colours)


def _ply_colours(element: Element, path: Path) -> np.ndarray | None:
    """Red, green and blue in [0, 1] of an element that has them, ``(N, 3)``."""
    columns = [element.get(name) for name in ("red", "green", "blue")]
    if any(column is None or isinstance(column, Lists) for column in columns):
        return None
    kind = np.asarray(columns[0]).dtype
    most = 65535.0 if kind == np.uint16 else 255.0 if kind.kind in "iu" else 1.0
    found = _columns(element, ("red", "green", "blue")) / most
    if not ((found >= 0) & (found <= 1)).all():
        raise ValueError(f"path: {path} holds colours outside 0 to {most:g}")
    return found.astype(np.float32)


def _columns(element: Element, names: Sequence[str]) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # NaN, whose bits are what they are
        return np.column_stack([np.asarray(element[name], dtype=np.float64) for name in names])


def _triangles(polygons: Lists, vertices: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Triangles ``(F, 3)`` of polygons, and the polygon of each, ``(F,)``."""
    n, corners = polygons.lengths, np.asarray(polygons.values)
    if (n < 3).any():
        raise ValueError(f"path: {path} holds {int((n < 3).sum())} faces of fewer than three corners")
    if not (np.abs(corners) < 2**31).all():
        raise ValueError(f"path: {path} names vertices beyond {2**31}")
    corners = corners.astype(np.int32)
    index, polygon = triangulated(n, corners, vertices)
    return corners[index], polygon


def _from_stl(folder: Folder) -> MeshContent:
    """Binary or ASCII; three vertices a face, as they stand."""
    path = folder.path
    data = path.read_bytes()
    count = int(np.frombuffer(data[80:84], "<u4")[0]) if len(data) >= 84 else 0
    if len(data) == 84 + 50 * count:
        rows = np.frombuffer(data, np.uint8, offset=84).reshape(count, 50)[:, 12:48]
        corners = np.ascontiguousarray(rows).view("<f4").astype(np.float64)
    else:
        corners = _ascii_stl(data, path)
    return MeshContent(corners.reshape(-1, 3), np.arange(corners.size // 3, dtype=np.int32).reshape(-1, 3))


def _ascii_stl(data: bytes, path: Path) -> np.ndarray:
    """Corners of facets, shape ``(3 F, 3)``."""
    words = data.split()
    if data[:5].lower() != b"solid" or b"endsolid" not in words:
        raise ValueError(
            f"path: {path} has {len(data)} bytes, expected a binary STL file (84 bytes and 50 a triangle) or text from "
            "'solid' to 'endsolid'"
        )
    lines = [line.split() for line in data.splitlines()]
    corners = [line[1:] for line in lines if line[:1] == [b"vertex"]]
    facets = sum(line[:1] == [b"facet"] for line in lines)
    try:
        found = np.array(corners, dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise ValueError(f"path: {path} is not a readable mesh: {error}") from error
    if len(found) != 3 * facets:
        raise ValueError(f"path: {path} states {facets} facets, but {len(found)} corners")
    return found


READERS: dict[str, Callable[[Folder], MeshContent]] = {
    ".ply": _from_ply, ".obj": read_obj, ".stl": _from_stl, ".glb": read_gltf, ".gltf": read_gltf,
}  # fmt: skip
"""What reads each format, by its suffix."""
GLTF = (".glb", ".gltf")


def is_mesh_file(path: str | os.PathLike[str]) -> bool:
    """Whether the name of a file says that it is a mesh."""
    return Path(path).suffix.lower() in READERS


def write_mesh(
    path: str | os.PathLike[str], vertices: ArrayLike, faces: ArrayLike, *, uv: ArrayLike | None = None
) -> None:
    """Write a mesh as a PLY file, whole or not at all: in single precision, or double where that would err by 10 um.

    Args:
        vertices: positions [m], shape ``(V, 3)``.
        faces: vertex indices, shape ``(F, 3)``.
        uv: texture coordinates, shape ``(V, 2)``.

    Raises:
        ValueError: for another suffix than ``.ply``, or arrays of another shape.
    """
    if Path(path).suffix != ".ply":
        raise ValueError(f"path: got {path}, expected a name that ends in .ply")
    vertices = check_array("vertices", vertices, (None, 3))
    triangles = check_array("faces", faces, (None, 3), dtype=np.int32)
    columns = dict(zip("xyz", vertices.T, strict=True))
    if uv is not None:
        columns |= dict(zip("st", check_array("uv", uv, (len(vertices), 2)).T, strict=True))
    far = np.abs(vertices - vertices.astype(np.float32)).max(initial=0.0) > 1e-5
    write_ply(path, columns, triangles, "double" if far else "float")
