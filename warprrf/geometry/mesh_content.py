"""What a mesh file holds, whatever its format, the files beside it that it names, and colours of its faces.

Colours are those of a photo, sRGB with its transfer curve (IEC 61966-2-1) in [0, 1], averaged in linear light.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import require
from warprrf.rows import spans

LARGEST_BYTES = 4 << 30
LARGEST_FACES = 50_000_000
PARTS = 4  # along a triangle's edge, where its texture is sampled
_PAGE = re.compile(
    r"(default|material|mat|texture|tex|atlas|page|mesh|scan)?[ ._-]*(mat|material)?[ ._-]*\d*", re.I
)


@dataclass(frozen=True)
class MeshContent:
    """What a mesh file holds.

    Attributes:
        vertices: positions in the file's own unit and axes, shape ``(V, 3)``, float64.
        faces: vertex indices, shape ``(F, 3)``, int32.
        uv: texture coordinates of vertices, shape ``(V, 2)``, or None.
        face_colours: sRGB in [0, 1], shape ``(F, 3)`` float32, NaN where unknown; None without any.
        face_material: index into ``material_names``, -1 for none, shape ``(F,)`` int32; None without any.
        material_names: names that the file gives materials.
        face_object: index into ``object_names``, -1 for none, shape ``(F,)`` int32; None without any.
        object_names: names that the file gives objects, groups or nodes.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    face_colours: np.ndarray | None = None
    face_material: np.ndarray | None = None
    material_names: tuple[str, ...] = ()
    face_object: np.ndarray | None = None
    object_names: tuple[str, ...] = ()

    @property
    def known(self) -> dict[str, Any]:
        """What a mesh keeps of its faces, by the names that it has for it."""
        return {
            "face_colours": self.face_colours,
            "face_label": self.face_material,
            "labels": self.material_names,
        }

    def with_faces(self, vertices: np.ndarray, faces: np.ndarray, parent: np.ndarray) -> MeshContent:
        """Other vertices and faces, each made of its ``parent`` (F,) among the faces now."""
        colours, material, thing = (
            None if held is None else held[parent]
            for held in (self.face_colours, self.face_material, self.face_object)
        )
        return replace(
            self, vertices=vertices, faces=faces, uv=None, face_colours=colours, face_material=material,
            face_object=thing,
        )  # fmt: skip


@dataclass(frozen=True)
class Folder:
    """The files that the model at ``path`` may name: those below its folder, or any.

    Attributes:
        path: of the model.
        allow_outside: whether it may name files elsewhere too.
        colours: whether materials and textures are asked for.
    """

    path: Path
    allow_outside: bool = False
    colours: bool = True

    def find(self, name: str | None) -> Path:
        """The file that the model names.

        Raises:
            FileNotFoundError: if it is missing.
            ValueError: if there is no such name, it lies outside the model's folder, or is too large.
        """
        base, place = self.path.parent, self.path.parent / (name or "").replace("\\", "/")
        try:
            outside = not place.resolve().is_relative_to(base.resolve())
            there = place.is_file()
        except (OSError, ValueError) as error:  # a name of bytes that no file can have
            raise ValueError(f"path: {self.path} names a file {name!r:.200}: {error}") from error
        if outside and not self.allow_outside:
            raise ValueError(
                f"path: {self.path} names the file {name!r:.200}, which lies outside its folder; move it there, or "
                "trust the model and load it with allow_outside=True"
            )
        if not there:
            raise FileNotFoundError(
                f"path: {self.path} needs the file {name!r:.200} beside it, which is missing"
            )
        if place.stat().st_size > LARGEST_BYTES:
            raise ValueError(f"path: {self.path} names {place} of more than {LARGEST_BYTES} bytes")
        return place


def numbered(names: Sequence[str | None], counts: Sequence[int]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Index of each face's name, -1 for none, where ``counts`` faces after each other have each of ``names``, and the
    names in the order in which they come; None if no face has one."""
    index: dict[str, int] = {}
    own = [-1 if name is None else index.setdefault(name, len(index)) for name in names]
    return (np.repeat(np.array(own, dtype=np.int32), counts) if index else None), tuple(index)


def triangulated(
    lengths: np.ndarray, corners: np.ndarray, vertices: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles ``(F, 3)`` of polygons as indices into all their ``corners``, and the polygon of each, ``(F,)``.

    A polygon becomes a fan around its first corner, or, where that would cover what lies outside, as a doorway in its wall,
    ears are cut off it one by one (Meisters, "Polygons have ears", 1975).
    """
    n = np.asarray(lengths, np.int64)
    first, start = np.cumsum(n) - n, np.cumsum(n - 2) - (n - 2)
    polygon, place = spans(0 * n, n - 2)
    index = first[polygon, None] + np.stack([0 * place, place + 1, place + 2], axis=1)
    if corners.min(initial=0) < 0 or corners.max(initial=0) >= len(vertices):
        return index, polygon  # refused by whoever reads them
    some, normal = np.flatnonzero(n[polygon] > 3), np.zeros((len(n), 3))
    own = polygon[some]
    with np.errstate(invalid="ignore", over="ignore"):  # so are vertices that are not finite
        a, b, c = np.moveaxis(vertices[corners[index[some]]], 1, 0)
        cross = np.cross(b - a, c - a)
        np.add.at(normal, own, cross)
        outside = (cross * normal[own]).sum(axis=1) < -1e-6 * (normal[own] ** 2).sum(axis=1)
    for k in np.unique(own[outside]):
        points = vertices[corners[first[k] : first[k] + n[k]]]
        index[start[k] : start[k] + n[k] - 2] = first[k] + _ears(points - points[0], normal[k])
    return index, polygon


def _ears(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles ``(N - 2, 3)`` of a polygon (N, 3) that may be concave."""
    left, found = np.arange(len(points)), []

    def leftward(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        turn: np.ndarray = np.cross(points[b] - points[a], points[c] - points[a]) @ normal
        return turn > 0

    while len(left) > 3:
        corner = np.stack([np.roll(left, 1), left, np.roll(left, -1)], axis=1)
        convex = np.flatnonzero(leftward(*corner.T))
        inside = (
            leftward(a, b, left) & leftward(b, c, left) & leftward(c, a, left) for a, b, c in corner[convex]
        )
        k = next((k for k, met in zip(convex, inside, strict=True) if not met.any()), None)
        if k is None:  # what is left crosses itself, or has no area
            break
        found.append(corner[k])
        left = np.delete(left, k)
    return np.array([*found, *([left[0], b, c] for b, c in pairwise(left[1:]))])


def material_name(name: str | None, textured: bool) -> str | None:
    """The name of a material, None where it says nothing: scanners number the pages of their texture ``material_3``."""
    return None if not name or (textured and _PAGE.fullmatch(name)) else name


def read_picture(data: bytes, what: str) -> np.ndarray:
    """A picture's pixels, ``(H, W, 3)`` uint8, first row on top."""
    pillow = require("PIL.Image", extra="mesh")
    try:
        with pillow.open(io.BytesIO(data)) as picture:
            return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError, EOFError, pillow.DecompressionBombError) as error:
        raise ValueError(f"{what}: no picture that can be read: {error}") from error


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values (IEC 61966-2-1)."""
    x = np.asarray(srgb, dtype=np.float64).clip(0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB values of linear light, NaN where that is unknown."""
    x = np.asarray(linear, dtype=np.float64).clip(0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)


def sampled(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Mean linear colour of triangles ``uv`` (F, 3, 2) of a picture that repeats, v upward, shape ``(F, 3)``.

    It is taken at the centres of sixteen equal parts of each triangle.
    """
    height, width = picture.shape[:2]
    curve = to_linear(np.arange(256) / 255.0)
    place = np.array([(i, j) for i in range(PARTS) for j in range(PARTS - i)], dtype=np.float64)
    up = (place + 1 / 3) / PARTS  # centres of the parts that point as the triangle does, and of the others
    down = (place[place.sum(axis=1) < PARTS - 1] + 2 / 3) / PARTS
    centres = np.concatenate([up, down])
    total = np.zeros((len(uv), 3))
    for weight in np.column_stack([centres, 1.0 - centres.sum(axis=1)]):
        at = np.einsum("k,fkc->fc", weight, uv) % 1.0
        column = np.minimum((at[:, 0] * width).astype(np.int64), width - 1)
        row = np.minimum(((1.0 - at[:, 1]) * height).astype(np.int64), height - 1)
        total += curve[picture[row, column]]
    return total / len(centres)
