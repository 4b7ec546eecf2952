"""An edited surface: what stays of a surface when its geometry changes, with its groups, cells and patches, and what comes new.

A face stays if the new geometry has one with the same corners, however wound. Any other face is new, and cut into elements and
patches of its own; where it lies on the old surface, or is called as a part of that, it is of the same group.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warprrf.geometry.mesh import GeometryLike, Mesh, as_mesh, joined
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.rf.tracing.cells import Cells
from warprrf.rf.tracing.surface import (
    Surface,
    element_width,
    largest_groups,
    named_faces,
    objects_of,
)

PARALLEL = 0.97
"""Least cosine between the normals of a face and of what it lies on: errors of 2 cm turn elements of 10 cm by 14 degrees."""
_OF_FACES = "normal", "patch", "group", "face_object"


@dataclass(frozen=True)
class Called:
    """A material that is told apart by its name; no more is known of it here."""

    name: str
    thickness_m: float = np.nan


@dataclass(frozen=True)
class Room:
    """A whole room as it is now: a scene whose materials are the groups of a surface, then new ones.

    Attributes:
        mesh: its F faces.
        face_material: index into ``materials`` of each face, shape ``(F,)``.
        materials: all groups.
        face_object, object_names: as of :class:`Surface`.
    """

    mesh: Mesh
    face_material: np.ndarray
    materials: tuple[Called, ...]
    face_object: np.ndarray
    object_names: tuple[str, ...]

    @classmethod
    def of(cls, surface: Surface, geometry: GeometryLike) -> Room:
        """A geometry in the place of ``surface``.

        A face is of the group that its material's name says; else of the one that it lies on, to within the surface's error of
        position; else of a new one, called by its material or ``"new"``. One that lies on several is cut.
        """
        patches = None if isinstance(geometry, Surface) else getattr(geometry, "patches", None)
        mesh = patches.mesh if isinstance(patches, PlanarPatches) else as_mesh(geometry, "geometry")
        material, names = named_faces(geometry, mesh)
        once = mesh.distinct_faces
        cut, group, parent = _lying_on(surface, Mesh(mesh.vertices, mesh.faces[once]))
        parent, groups = once[parent], list(surface.group_names)
        label = np.full(len(parent), len(names)) if material is None else material[parent]
        for k, name in enumerate((*names, "new")):
            named = k < len(names) and name in surface.group_names
            own = (label == k) & ((group < 0) | named)
            if own.any():
                groups += [name] * (name not in groups)
                group[own] = groups.index(name)
        return cls(cut, group, tuple(map(Called, groups)), **objects_of(geometry, parent))


def edited(surface: Surface, room: Room, **slabs: np.ndarray) -> tuple[Surface, np.ndarray]:
    """The surface of ``room``, whose groups are all of the old one's, then new ones with ``thickness_m`` and ``dispersion`` of
    ``slabs``; and of each of its cells that of the old one that it is or lies on, -1 for none. Unchanged, it is the old one."""
    s, count, names = surface, len(surface.mesh.faces), tuple(material.name for material in room.materials)
    first = _first_at_place(s, room.mesh)
    at = first[count:]  # of each face the old one in its place, if that is below count
    stays = (at < count) & (room.face_material == np.append(s.group, -1)[np.minimum(at, count)])
    kept = np.isin(first[:count], at[stays])
    if kept.all() and stays.all():
        return surface, np.arange(len(s.cells))
    face = np.flatnonzero(kept)
    own = {name: getattr(s, name)[face] for name in _OF_FACES}
    vertices, corners, things = s.mesh.vertices, s.mesh.faces[face], s.object_names
    cells, lies_on = s.cells.take(face)
    planes = s.plane_normal, s.plane_offset
    if not stays.all():
        part, more, planes = _cut(s, room, ~stays)
        own = {name: np.concatenate([own[name], more[name]]) for name in _OF_FACES}
        corners = np.concatenate([corners, part.mesh.faces + len(vertices)])
        vertices, things = np.concatenate([vertices, part.mesh.vertices]), part.object_names
        tiles, cells = part.tiles, cells.beside(part.cells)
        tile = tiles.middles(tiles.cell)
        middle = tiles.centre[tile]
        near = s.mesh.closest(middle)
        same = s.group[near.face] == part.group[tiles.face[tile]]
        same &= near.distance <= s.position_error_m
        lies_on = np.append(lies_on, np.where(same, s.cells.at(near.face, middle), -1))
    used, corners = np.unique(corners, return_inverse=True)
    mesh, new = Mesh(vertices[used], corners.reshape(-1, 3)), len(names) - s.groups
    patch = own["patch"]
    plane = np.unique(patch[patch >= 0])
    own["patch"] = np.where(patch >= 0, np.searchsorted(plane, patch), -1).astype(np.int32)
    made = Surface(
        mesh=mesh, cells=cells, **own,
        **{name: np.concatenate([getattr(s, name), slabs[name]]) for name in ("thickness_m", "dispersion")},
        plane_normal=planes[0][plane], plane_offset=planes[1][plane], group_names=names, object_names=things,
        material=np.append(s.material, s.material.max() + 1 + np.arange(new)).astype(np.int32),
        appearance=np.concatenate([s.appearance, np.full((new, s.appearance.shape[1]), np.nan)]),
        patch_group=largest_groups(mesh, own["patch"], own["group"], len(plane)),
        position_error_m=s.position_error_m, two_sided=s.two_sided,
    )  # fmt: skip
    return made, lies_on


def _lying_on(s: Surface, mesh: Mesh) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """``mesh`` with those faces cut that lie on several groups of ``s``; the group that each face lies on, -1 for none; and
    the face that it is a piece of."""
    none, count = np.full(len(mesh.faces), -1), len(s.mesh.faces)
    cells = Cells.of(mesh, none, none, np.zeros((0, 3)), element_width(s.mesh))
    tiles, at = cells.tiles(mesh), _first_at_place(s, mesh)[count:]
    near = s.mesh.closest(tiles.centre)
    along = np.abs((s.mesh.face_normals[near.face] * mesh.face_normals[tiles.face]).sum(axis=1))
    lies = (near.distance <= s.position_error_m) & (along > PARALLEL)
    group, first = np.where(lies, s.group[near.face], -1), np.searchsorted(tiles.face, np.arange(len(none)))
    several = np.minimum.reduceat(group, first) < np.maximum.reduceat(group, first)
    several &= at >= count
    whole, part = np.flatnonzero(~several), np.flatnonzero(several[tiles.face])
    found = np.where(at < count, np.append(s.group, -1)[np.minimum(at, count)], group[first])
    fan = tiles.fan.faces.reshape(-1, 5, 3)[part].reshape(-1, 3)
    cut = joined([(mesh.vertices, mesh.faces[whole]), (tiles.fan.vertices, fan)])
    columns = (found, group), (np.arange(len(none)), tiles.face)
    label, parent = (np.concatenate([own[whole], np.repeat(more[part], 5)]) for own, more in columns)
    large = cut.areas > 0
    return Mesh(cut.vertices, cut.faces[large]), label[large], parent[large]


def _first_at_place(s: Surface, mesh: Mesh) -> np.ndarray:
    """Of the faces of ``s`` and of ``mesh``, one after the other, the first with the same corners."""
    return joined([(part.vertices, part.faces) for part in (s.mesh, mesh)]).first_at_place


def _cut(
    s: Surface, room: Room, face: np.ndarray
) -> tuple[Surface, dict[str, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Faces (F,) bool of ``room`` as a surface; what is known of its faces, with indices behind those of ``s``; and the planes of
    both. A piece of a patch, of one group in one plane, is of that patch."""
    objects = tuple(dict.fromkeys((*s.object_names, *room.object_names)))
    thing = np.array([objects.index(name) for name in room.object_names] + [-1], np.int32)[room.face_object]
    mesh = Mesh(room.mesh.vertices, room.mesh.faces[face])
    new = Room(mesh, room.face_material[face], room.materials, thing[face], objects)
    p = Surface.of(new, element_m=element_width(s.mesh))
    normal, offset = p.plane_normal, p.plane_offset
    if not s.two_sided:  # a patch is the side that its faces are wound for
        front = np.zeros((len(offset) + 1, 3))
        np.add.at(front, p.patch, p.mesh.areas[:, None] * p.mesh.face_normals)
        sign = np.where((front[:-1] * normal).sum(axis=1) < 0, -1.0, 1.0)
        normal, offset = normal * sign[:, None], offset * sign
    label = np.append(len(s.plane_offset) + np.arange(len(offset)), -1)
    for k in range(len(offset)):
        alike = np.flatnonzero(s.patch_group == p.patch_group[k])
        turn = s.plane_normal[alike] @ normal[k]
        corner = p.mesh.triangles[p.patch == k].reshape(-1, 3)
        apart = np.abs(corner @ s.plane_normal[alike].T - s.plane_offset[alike]).max(axis=0, initial=0.0)
        one = apart <= max(s.position_error_m, p.position_error_m)
        one &= (np.abs(turn) if s.two_sided else turn) > PARALLEL
        if one.any():
            label[k] = alike[np.argmin(np.where(one, apart, np.inf))]
    found: dict[str, Any] = {name: getattr(p, name) for name in _OF_FACES}
    found["patch"] = label[p.patch]
    return p, found, (np.concatenate([s.plane_normal, normal]), np.concatenate([s.plane_offset, offset]))
