"""A mesh made whole: its planes divide space into boxes, and each box is free or solid.

Depth maps leave holes where walls are bare, ragged borders where surfaces meet, and islands in the air. Where most of a
mesh is planar along three perpendicular directions, its planes cut space into boxes. Lines of sight prove boxes free,
the surfaces they end on prove the boxes behind solid, and for the rest the surface between free and solid is made as
small as it can be, along known planes rather than elsewhere (Chauve, Labatut and Pons, "Robust piecewise-planar 3D
reconstruction and completion from large-scale unstructured point data", 2010; a minimum cut, found by SciPy). That
surface has no holes and lies exactly on the planes. Faces that no plane explains stay as they are, and a mesh that is
no such place stays whole as it is. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.patches import PlanarPatch, connected_pieces, simplify
from warprrf.geometry.photos.completion.boxes import divide, least_surface, surface_of, without_hollows
from warprrf.geometry.photos.completion.dividers import (
    Labels,
    claim_proven,
    directions,
    known_planes,
    proven_planes,
)
from warprrf.geometry.photos.completion.evidence import closed_sides, seen_share, vote_proven, votes
from warprrf.geometry.photos.planes import Plane
from warprrf.geometry.splats.camera import Camera

# Where less than this of all the surface is seen, photos cover too little of the place for the rest to be inferred.
LEAST_SEEN = 0.7
# Pieces of the old mesh this far from every known plane, and this large, are kept.
KEEP_M, KEEP_M2 = 0.12, 0.3


def complete(
    mesh: Mesh,
    patches: Sequence[PlanarPatch],
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    *,
    planes: Sequence[Plane] = (),
    cell_m: float = 0.1,
    stride: int = 5,
    min_patch_m2: float = 0.15,
    seed: int = 0,
) -> tuple[Mesh, list[PlanarPatch]]:
    """``mesh`` with holes closed, borders straightened and islands in the air removed, where its planes allow it.

    Args:
        mesh: flattened onto its ``patches``.
        cameras, depths: what was seen: Euclidean range per pixel [m], 0 where unknown, each ``(height, width)``.
        planes: planes known beforehand; their occupied cells are evidence of their own.
        cell_m: largest side of a box.
        stride: every so many-th row and column of the depth maps is used.
        min_patch_m2: smallest patch returned.
        seed: of the places of samples.

    Returns:
        The mesh and its patches, largest first; what was given when most of the mesh lies on no planes along three
        perpendicular directions, or the photos show so little of the place that most of it would be a guess.

    Raises:
        ValueError: when the numbers of cameras and depth maps differ.
    """
    if len(depths) != len(cameras):
        raise ValueError(f"depths: got {len(depths)} maps for {len(cameras)} cameras, expected one for each")
    axes = directions(mesh, patches)
    if axes is None or not len(cameras):
        return mesh, list(patches)
    dividers, labels = known_planes(mesh, patches, planes, axes)
    proven = list(proven_planes(planes, axes, dividers))
    claim_proven(mesh, labels, axes, proven)
    grid = divide(mesh, axes, dividers, cell_m)
    free, solid = votes(grid, mesh, labels, cameras, depths, stride, seed)
    for plane, divider in proven:
        vote_proven(grid, plane, divider, free, solid)
    filled = least_surface(grid, free, solid, closed_sides(grid, mesh, labels))
    filled = without_hollows(grid, filled, np.array([c.position for c in cameras]))
    if filled.all():
        return mesh, list(patches)
    whole, parts, known = surface_of(grid, filled)
    if seen_share(grid, whole, parts, solid) < LEAST_SEEN:
        return mesh, list(patches)
    whole, parts = _with_rest(whole, parts, known, mesh, patches, labels)
    whole, parts = simplify(whole, parts)
    return whole, sorted((p for p in parts if p.area >= min_patch_m2), key=lambda p: -p.area)


def _with_rest(
    whole: Mesh,
    parts: Sequence[PlanarPatch],
    known: np.ndarray,
    mesh: Mesh,
    patches: Sequence[PlanarPatch],
    labels: Labels,
) -> tuple[Mesh, list[PlanarPatch]]:
    """The completed surface with round or oblique pieces of the old mesh in place of the steps made for them."""
    centres = mesh.triangles.mean(axis=1)
    rest = labels.axis < 0
    if known.any():
        rest[rest] = Mesh(whole.vertices, whole.faces[known]).distance(centres[rest]) > KEEP_M
    piece = connected_pieces(mesh, np.where(rest, 0, -1))
    rest &= np.bincount(piece, weights=mesh.areas * rest)[piece] >= KEEP_M2
    if not rest.any():
        return whole, list(parts)
    own = np.flatnonzero(rest)
    stays = known.copy()
    if not known.all():
        near = Mesh(mesh.vertices, mesh.faces[own]).distance(whole.triangles[~known].mean(axis=1))
        stays[~known] = near > KEEP_M
    old = np.flatnonzero(stays)
    place = np.full(len(whole.faces), -1)
    place[old] = np.arange(len(old))
    new = np.full(len(mesh.faces), -1)
    new[own] = len(old) + np.arange(len(own))
    faces = np.concatenate([whole.faces[old], mesh.faces[own] + len(whole.vertices)])
    used, faces = np.unique(faces, return_inverse=True)
    joint = Mesh(np.concatenate([whole.vertices, mesh.vertices])[used], faces.reshape(-1, 3))
    result = []
    for p, number in [(p, place) for p in parts] + [(p, new) for p in patches]:
        left = number[p.faces]
        left = left[left >= 0]
        if len(left):
            result.append(replace(p, faces=left, area=float(joint.areas[left].sum())))
    return joint, result
