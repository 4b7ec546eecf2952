"""An edited surface: what stays of a surface when its geometry changes, with its groups, cells and patches, and what comes new.

A face stays if the new geometry has one with the same corners, however wound. Any other face is new, and cut into elements and
patches of its own; where it lies on the old surface, or is called as a part of that, it is of the same group.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warprrf.geometry.mesh import GeometryLike, Mesh, as_mesh
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.rf.tracing.surface import (
    LARGEST_FACE,
    Surface,
    element_width,
    largest_groups,
    named_faces,
    of_elements,
    split_long,
)

PARALLEL = 0.97
"""Least cosine between the normals of a face and of the surface that it lies on: faces of a photographed wall are bent by 14
degrees and more where errors of 2 cm meet elements of 10 cm, those of furniture stand across."""


@dataclass(frozen=True)
class Pieces:
    """Faces that come new, K of them.

    Attributes:
        mesh: the faces.
        group: of each, shape ``(K,)``: an index into the old surface's groups and ``names`` behind them.
        names: of groups that the old surface does not have.
        face_object: index into ``object_names`` of each face, -1 for none, shape ``(K,)``.
        object_names: of objects.
    """

    mesh: Mesh
    group: np.ndarray
    names: tuple[str, ...] = ()
    face_object: np.ndarray | None = None
    object_names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Edit:
    """An edited surface beside the old one.

    Attributes:
        surface: the edited one; its groups are all of the old one's, then new ones.
        cell: cell of the old surface that each of its cells is or lies on, -1 for none, shape ``(X,)``.
    """

    surface: Surface
    cell: np.ndarray


def pieces_of(surface: Surface, geometry: GeometryLike) -> tuple[np.ndarray, Pieces | None]:
    """What the faces of ``surface`` and of a ``geometry`` have in common.

    A face of the geometry is of the group that its material's name says; else of the group that it lies on, to within the
    surface's error of position; else of a new one, called by its material or ``"new"``.

    Returns:
        Which faces of ``surface`` stay, shape ``(F,)`` bool, and what is new, None for nothing.
    """
    patches = getattr(geometry, "patches", None)
    mesh = patches.mesh if isinstance(patches, PlanarPatches) else as_mesh(geometry, "geometry")
    named, names = named_faces(geometry, mesh)
    once = np.flatnonzero(mesh.first_at_place == np.arange(len(mesh.faces)))
    cut, parent = split_long(mesh, once, LARGEST_FACE * element_width(surface.mesh))
    count, own = len(surface.mesh.faces), [surface.mesh, cut]
    both = Mesh(
        np.concatenate([m.vertices for m in own]),
        np.concatenate([own[0].faces, own[1].faces + len(own[0].vertices)]),
    )
    first = both.first_at_place
    at = first[count:]  # the old face at each new one's place, if below count

    group = np.full(len(cut.faces), -1)
    near = surface.mesh.closest(cut.triangles.mean(axis=1))
    along = np.abs((surface.mesh.face_normals[near.face] * cut.face_normals).sum(axis=1))
    lies = (at < count) | ((near.distance <= surface.position_error_m) & (along > PARALLEL))
    old = np.where(at < count, np.minimum(at, count - 1), near.face)
    group[lies] = surface.group[old[lies]]
    things = tuple(getattr(geometry, "object_names", ()))
    thing = np.asarray(geometry.face_object, np.int32)[parent] if things else np.full(len(parent), -1)  # type: ignore[union-attr]
    new: list[str] = []
    material = np.full(len(parent), -1) if named is None else named[parent]
    for k, name in enumerate(names):
        mine = material == k
        if name in surface.group_names:
            group[mine] = surface.group_names.index(name)
        elif (mine & (group < 0)).any():
            group[mine & (group < 0)] = surface.groups + len(new)
            new.append(name)
    if (group < 0).any():
        group[group < 0] = surface.groups + len(new)
        new.append("new")
    stays = (at < count) & (group == surface.group[old])
    kept = np.isin(first[:count], at[stays])
    if stays.all():
        return kept, None
    rest = ~stays
    return kept, Pieces(Mesh(cut.vertices, cut.faces[rest]), group[rest], tuple(new), thing[rest], things)


def edited(surface: Surface, kept: np.ndarray, pieces: Pieces | None, **known: Any) -> Edit:
    """``surface`` of its faces ``kept`` (F,) and of ``pieces``.

    Args:
        surface: the old one.
        kept: which of its faces stay, shape ``(F,)`` bool.
        pieces: what is new.
        known: ``thickness_m`` and ``dispersion`` of the new groups.

    Raises:
        ValueError: if nothing is left.
    """
    if kept.all() and pieces is None:
        return Edit(surface, np.arange(surface.cells))
    if pieces is None and not kept.any():
        raise ValueError("geometry: got no face, expected at least one")
    s, face, names, things = surface, np.flatnonzero(kept), surface.group_names, surface.object_names
    vertices, corners, lies_on = s.mesh.vertices, s.mesh.faces[face], s.cell[face]
    own = {name: getattr(s, name)[face] for name in _OF_FACES}
    planes = s.plane_normal, s.plane_offset
    if pieces is not None:
        part, more, planes = _cut(s, pieces)
        own = {name: np.concatenate([own[name], more[name]]) for name in _OF_FACES}
        corners = np.concatenate([corners, part.faces + len(vertices)])
        vertices = np.concatenate([vertices, part.vertices])
        near = s.mesh.closest(part.triangles.mean(axis=1))
        same = (s.group[near.face] == more["group"]) & (near.distance <= s.position_error_m)
        lies_on = np.append(lies_on, np.where(same, s.cell[near.face], -1))
        names, things = (*names, *pieces.names), _objects(s, pieces)
    used, corners = np.unique(corners, return_inverse=True)
    mesh, new = Mesh(vertices[used], corners.reshape(-1, 3)), len(names) - s.groups
    plane, own["patch"] = _renumbered(own["patch"])
    element, own["element"] = _renumbered(own["element"])
    first, own["cell"] = np.unique(own["cell"], return_index=True, return_inverse=True)[1:]
    own["cell"] = own["cell"].reshape(-1).astype(np.int32)
    unknown: dict[str, Any] = {"thickness_m": np.full(new, np.nan), "dispersion": np.full((new, 4), np.nan)}
    slabs = {name: np.concatenate([getattr(s, name), more]) for name, more in (unknown | known).items()}
    surface = Surface(
        mesh=mesh, **own, **slabs, plane_normal=planes[0][plane], plane_offset=planes[1][plane],
        material=np.append(s.material, s.material.max() + 1 + np.arange(new)).astype(np.int32),
        appearance=np.concatenate([s.appearance, np.full((new, s.appearance.shape[1]), np.nan)]),
        patch_group=largest_groups(mesh, own["patch"], own["group"], len(plane)), cell_element=own["element"][first],
        **of_elements(mesh, own["element"], own["group"]), group_names=names, position_error_m=s.position_error_m,
        two_sided=s.two_sided, object_names=things,
    )  # fmt: skip
    return Edit(surface, lies_on[first])


_OF_FACES = "normal", "patch", "group", "element", "cell", "face_object"


def _renumbered(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of ``index`` there are, -1 apart, and each one's place among those, -1 staying -1."""
    used, own = np.unique(index[index >= 0]), np.full(len(index), -1, np.int32)
    own[index >= 0] = np.searchsorted(used, index[index >= 0])
    return used, own


def _objects(surface: Surface, pieces: Pieces) -> tuple[str, ...]:
    return tuple(dict.fromkeys((*surface.object_names, *pieces.object_names)))


def _cut(
    surface: Surface, pieces: Pieces
) -> tuple[Mesh, dict[str, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """``pieces`` cut into small faces; what a surface knows of each, its indices behind those of ``surface``; and the planes of both.
    A piece of a patch, of one group in one plane, is of that patch."""
    s, objects = surface, _objects(surface, pieces)
    thing = np.array([objects.index(name) for name in pieces.object_names] + [-1])
    of_piece = np.full(len(pieces.group), -1) if pieces.face_object is None else pieces.face_object
    p = Surface.of_groups(
        pieces.mesh, pieces.group, (*s.group_names, *pieces.names), element_width(s.mesh),
        face_object=thing[of_piece].astype(np.int32), object_names=objects,
    )  # fmt: skip
    normal, offset = p.plane_normal, p.plane_offset
    if not s.two_sided:  # a patch is the side that its faces are wound for
        own = p.patch >= 0
        front = np.zeros_like(normal)
        np.add.at(front, p.patch[own], (p.mesh.areas[:, None] * p.mesh.face_normals)[own])
        sign = np.where((front * normal).sum(axis=1) < 0, -1.0, 1.0)
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
    found = {name: getattr(p, name) for name in _OF_FACES}
    found |= {"patch": label[p.patch], "element": p.element + len(s.element_area), "cell": p.cell + s.cells}
    return p.mesh, found, (np.concatenate([s.plane_normal, normal]), np.concatenate([s.plane_offset, offset]))
