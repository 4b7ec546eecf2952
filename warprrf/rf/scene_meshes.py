"""Scenes in mesh files: materials by the names that the file gives, objects by its nodes, objects or groups.

Materials are known by name alone: those of ITU-R P.2040 (``concrete``, ``itu_glass``, ``Wood_01``), and what the caller
gives. Others keep their name and have no values: a radio field can be fitted to spectra there, nothing be simulated.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from functools import partial

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_files import MeshOptions, load_mesh
from warprrf.rf.em.itu import itu_material, itu_name
from warprrf.rf.em.materials import Material
from warprrf.rf.scene_parts import MaterialChoice

NAMELESS = "surface"
"""What faces are called whose file names no material."""


@dataclass(frozen=True)
class MeshScene:
    """Surfaces, materials and objects of a mesh file, as :class:`~warprrf.rf.scene.Scene` has them."""

    mesh: Mesh
    materials: list[Material]
    face_material: np.ndarray
    face_object: np.ndarray
    object_names: list[str]


def read_mesh_scene(path: str | os.PathLike[str], choice: MaterialChoice, options: MeshOptions) -> MeshScene:
    """Read a mesh file; errors as for :meth:`Mesh.load`.

    Where no material has a name, the objects' names stand for them.
    """
    content = load_mesh(path, options)
    mesh = Mesh(content.vertices, content.faces, **content.known)
    things, objects = _used(content.face_object, content.object_names, len(mesh.faces), "object")
    if content.face_material is None and len(objects) > 1:
        face, names = things, objects
    else:
        face, names = _used(content.face_material, content.material_names, len(mesh.faces), NAMELESS)
    return MeshScene(
        mesh, [choice.choose(name, partial(_declared, name)) for name in names], face, things, objects
    )  # fmt: skip


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
