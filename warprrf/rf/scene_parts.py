"""What a scene is put together from: objects of one material each, or a mesh file; and which material a name stands for.

Materials of a mesh file are known by name alone: those of ITU-R P.2040 (``concrete``, ``itu_glass``, ``Wood_01``), and what
the caller gives. Others keep their name and have no values: a field can be fitted to spectra there, nothing be simulated.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.checks import check_type
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_files import load_mesh
from warprrf.rf.em.materials import Material, itu_material, itu_name, load_materials

Materials = Mapping[str, Material] | str | os.PathLike[str]
"""Materials by the name of what they replace, or a table's file."""


@dataclass(frozen=True)
class ScenePart:
    """One object.

    Attributes:
        name: its name.
        vertices: positions [m], shape ``(V, 3)``.
        faces: vertex indices, shape ``(F, 3)``.
        material: what it is made of.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    material: Material


class MaterialChoice:
    """Materials by name: the caller's, then a table's, then what the scene says.

    Args:
        given: a mapping, every name of which must be asked for, or a table's file, which may hold more.
        beside: the file of the scene's own table, which may be missing; read when a name is not among ``given``.
        extrapolate: see :meth:`Material.extrapolated`.
    """

    def __init__(self, given: Materials | None, beside: Path | None, extrapolate: bool) -> None:
        self._beside = beside
        self._given: dict[str, Material] = {}
        self._wanted: set[str] = set()
        if isinstance(given, Mapping):
            for name, material in given.items():
                check_type(f"materials[{name!r}]", material, Material)
            self._wanted = set(given)
            self._given = dict(given)
        elif given is not None:
            self._given = load_materials(given)
        self._extrapolate = extrapolate
        self._chosen: dict[str, list[tuple[Material, Material]]] = {}  # as stated, as made

    @cached_property
    def _table(self) -> dict[str, Material]:
        return {} if self._beside is None or not self._beside.is_file() else load_materials(self._beside)

    @property
    def names(self) -> list[str]:
        """Names that are known whatever the scene says."""
        return sorted(self._table | self._given)

    def choose(self, name: str, declared: Callable[[], Material]) -> Material:
        """The material of ``name``; ``declared`` is asked where neither the caller nor a table has it. What is declared
        otherwise under the same name is another material, and numbered."""
        known = self._given if name in self._given else self._table
        stated = known[name] if name in known else declared()
        alike = self._chosen.setdefault(name, [])
        for before, material in alike:
            if before == stated:
                return material
        material = stated.extrapolated() if self._extrapolate else stated
        alike.append((stated, replace(material, name=f"{name}_{len(alike) + 1}") if alike else material))
        return alike[-1][1]

    def check_used(self) -> None:
        """Refuse names that nothing is made of."""
        for name in sorted(self._wanted - set(self._chosen)):
            raise ValueError(
                f"materials: got {name!r}, of which nothing in the scene is made; it has "
                f"{', '.join(sorted(self._chosen))}"
            )


def read_mesh_scene(path: str | os.PathLike[str], choice: MaterialChoice, **options: Any) -> dict[str, Any]:
    """Arguments of :class:`~warprrf.rf.scene.Scene` for a mesh file; options and errors are those of :meth:`Mesh.load`.

    Where no material has a name, the objects' names stand for them.
    """
    content = load_mesh(path, **options)
    mesh = Mesh(content.vertices, content.faces, **content.known)
    things, objects = _used(content.face_object, content.object_names, len(mesh.faces), "object")
    if content.face_material is None and len(objects) > 1:
        face, names = things, objects
    else:
        face, names = _used(content.face_material, content.material_names, len(mesh.faces), "surface")
    materials = [choice.choose(name, partial(_declared, name)) for name in names]
    return {
        "mesh": mesh, "materials": materials, "face_material": face, "face_object": things, "object_names": objects
    }  # fmt: skip


def _used(
    index: np.ndarray | None, names: tuple[str, ...], faces: int, nameless: str
) -> tuple[np.ndarray, list[str]]:
    """Index of each face into the names that some face has, ``nameless`` among them if one has none."""
    if index is None:
        return np.zeros(faces, np.int32), [nameless]
    while nameless in names:
        nameless += "_"
    used, own = np.unique(np.where(index < 0, len(names), index), return_inverse=True)
    return own.reshape(-1).astype(np.int32), [(*names, nameless)[k] for k in used]


def _declared(name: str) -> Material:
    """The material of P.2040 that a name says, numbers behind it left out; else one of which nothing is known."""
    plain = re.sub(r"[ ._-]*\d*$", "", name.strip()).lower().replace(" ", "_")
    itu = itu_name(name) or itu_name(plain)
    return itu_material(itu, name=name) if itu is not None else Material(name, ())
