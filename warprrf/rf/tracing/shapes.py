"""Groups of faces by shape alone: planar and smooth pieces of a mesh that has neither colours nor names.

A piece is a connected part of a plane, or of a smooth curved surface. Which pieces are of one material no shape can
tell, but things are mostly made of one: the pieces of a connected part are taken for one material before any
measurement. A part that reaches through the whole room (its shell, or a scan in which all hangs together) is no such
thing: there each piece stands for itself. The spectra then decide which of them are alike, and where they say nothing,
pieces of like extent, height and place are (:mod:`warprrf.rf.fields.bistatic.merging`).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from warprrf.geometry.mesh import Mesh, components, edge_pairs

SHAPES = 6  # numbers that tell shapes apart


def shape_groups(mesh: Mesh, patch: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Groups of faces by planar patch and connected part.

    Args:
        mesh: F faces.
        patch: planar patch of each, -1 for none, shape ``(F,)``.

    Returns:
        The group of each face, shape ``(F,)``; the material that each group is taken for, shape ``(G,)``; and its
        shape in steps: height and place of its body, and the body's extents upward, along and across, shape ``(G, 6)``.
    """
    shell = 0.5  # share of the mesh's extents along all axes that the room's shell has at least
    body_m2 = 0.5  # smaller bodies are taken for the material of the larger one that is most like them
    pairs = edge_pairs(mesh.welded_faces)
    part = components(len(mesh.faces), pairs)
    group = _without_crumbs(mesh, _pieces(mesh, patch, pairs), part)
    _, first = np.unique(group, return_index=True)
    through = _extents(mesh, part) >= shell * _extents(mesh, np.zeros(len(part), np.int64))
    lone = np.asarray(through.all(axis=1))[part[first]]
    body = np.unique(np.where(lone, np.arange(len(first)), len(first) + part[first]), return_inverse=True)[1]
    shape, area = _shape(mesh, body[group]), np.bincount(body[group], mesh.areas)
    large = np.flatnonzero(area >= min(body_m2, float(area.max())))
    material = cKDTree(shape[large]).query(shape)[1]
    material[large] = np.arange(len(large))
    return group.astype(np.int32), material[body].astype(np.int32), shape[body]


def _pieces(mesh: Mesh, patch: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Connected sheets of the patches, those that are facets of a smooth surface together, shape ``(F,)``."""
    # Pieces that are small enough to be facets of a curved one are, where they meet at a small angle.
    small_m2, smooth_rad = 1.5, 0.5
    a, b = pairs.T
    together = (patch[a] == patch[b]) & (patch[a] >= 0)
    sheet = components(len(patch), pairs[together])
    small = np.bincount(sheet, mesh.areas)[sheet] < small_m2
    n = mesh.face_normals
    bend = np.abs(np.einsum("ni,ni->n", n[a], n[b])) > np.cos(smooth_rad)
    return components(len(patch), pairs[together | (bend & small[a] & small[b])])


def _without_crumbs(mesh: Mesh, piece: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Pieces numbered without gaps, crumbs joined to the nearest piece of their part, or to each other, ``(F,)``."""
    crumb_m2 = 0.2  # from smaller ones nothing is learned
    crumb = np.bincount(piece, mesh.areas)[piece] < crumb_m2
    whole = np.zeros(int(part.max()) + 1, bool)
    whole[part[~crumb]] = True
    piece = np.where(crumb & ~whole[part], int(piece.max()) + 1 + part, piece)
    crumb &= whole[part]
    if crumb.any():
        reach = 2.0 * float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
        place = np.column_stack([mesh.triangles.mean(axis=1), reach * part])  # parts far apart
        keep = np.flatnonzero(~crumb)
        piece[crumb] = piece[keep[cKDTree(place[keep]).query(place[crumb])[1]]]
    return np.unique(piece, return_inverse=True)[1].reshape(-1)


def _moments(mesh: Mesh, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres ``(N, 3)`` [m] and covariances ``(N, 3, 3)`` [m^2] of the surfaces of each of ``owner`` (F,)."""
    x = 0.5 * (
        mesh.triangles + np.roll(mesh.triangles, 1, axis=1)
    )  # midpoints of edges are exact for squares
    weight = np.repeat(mesh.areas + 1e-12, 3) / 3.0
    who, x = np.repeat(owner, 3), x.reshape(-1, 3)
    total = np.bincount(who, weight)
    centre = np.stack([np.bincount(who, weight * c) for c in x.T], axis=1) / total[:, None]
    x = x - centre[who]
    second = [np.bincount(who, weight * x[:, i] * x[:, j]) / total for i in range(3) for j in range(3)]
    return centre, np.stack(second, axis=1).reshape(-1, 3, 3)


def _extents(mesh: Mesh, owner: np.ndarray) -> np.ndarray:
    """Extents upward, and horizontally along and across, of the surfaces of each of ``owner`` [m], shape ``(N, 3)``."""
    second = _moments(mesh, owner)[1]
    level = np.linalg.eigvalsh(second[:, :2, :2])[:, ::-1]
    return np.sqrt(12.0 * np.maximum(np.column_stack([second[:, 2, 2], level]), 0.0))


def _shape(mesh: Mesh, owner: np.ndarray) -> np.ndarray:
    """Shape of each of ``owner`` (F,) in steps, ``(N, 6)``; see :func:`shape_groups`."""
    # Distances of 1 m and ratios of extents of 10 count as much as a material's difference.
    place_m, ratio, thin_m = 1.0, 10.0, 0.03
    extents = np.log(np.maximum(_extents(mesh, owner), thin_m)) / np.log(ratio)
    return np.column_stack([(_moments(mesh, owner)[0] - mesh.center) / place_m, extents])
