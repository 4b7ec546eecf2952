"""What a mesh file holds, whatever its format, and the files beside it that it names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

LARGEST_BYTES = 4 << 30
LARGEST_FACES = 50_000_000
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

    def read(self, name: str) -> bytes:
        """The file that the model names.

        Raises:
            FileNotFoundError: if it is missing.
            ValueError: if it lies outside the model's folder, or is too large.
        """
        base, place = self.path.parent, self.path.parent / unquote(name).replace("\\", "/")
        try:
            outside = not place.resolve().is_relative_to(base.resolve())
            there = place.is_file()
        except (OSError, ValueError) as error:  # a name of bytes that no file can have
            raise ValueError(f"path: {self.path} names a file {name[:200]!r}: {error}") from error
        if outside and not self.allow_outside:
            raise ValueError(
                f"path: {self.path} names the file {name[:200]!r}, which lies outside its folder; move it there, or "
                "trust the model and load it with allow_outside=True"
            )
        if not there:
            raise FileNotFoundError(
                f"path: {self.path} needs the file {name[:200]!r} beside it, which is missing"
            )
        if place.stat().st_size > LARGEST_BYTES:
            raise ValueError(f"path: {self.path} names {place} of more than {LARGEST_BYTES} bytes")
        return place.read_bytes()


def numbered(names: Sequence[str | None], counts: Sequence[int]) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Index of each face's name, -1 for none, where ``counts`` faces after each other have each of ``names``, and the
    names in the order in which they come; None if no face has one."""
    index: dict[str, int] = {}
    own = [-1 if name is None else index.setdefault(name, len(index)) for name in names]
    return (np.repeat(np.array(own, dtype=np.int32), counts) if index else None), tuple(index)


def material_name(name: str | None, textured: bool) -> str | None:
    """The name of a material, None where it says nothing: scanners number the pages of their texture ``material_3``."""
    return None if not name or (textured and _PAGE.fullmatch(name)) else name
