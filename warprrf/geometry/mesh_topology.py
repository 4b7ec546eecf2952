"""Faces of a mesh and their neighbours across edges."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from warprrf.geometry.mesh import Mesh


def components(count: int, pairs: np.ndarray) -> np.ndarray:
    """Number of the connected component of each of ``count`` things, of which ``pairs`` (N, 2) are linked, ``(count,)``."""
    link = sparse.coo_array((np.ones(len(pairs), bool), pairs.T), shape=(count, count))
    found: np.ndarray = csgraph.connected_components(link, directed=False)[1]
    return found


def edge_pairs(corner: np.ndarray, face: np.ndarray | None = None) -> np.ndarray:
    """Pairs of the faces ``corner`` (F, 3), of ``face`` (K,) alone if given, that share an edge, shape ``(N, 2)``."""
    face = np.arange(len(corner)) if face is None else face
    edge = np.sort(corner[face][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(face, 3)
    order = np.lexsort((owner, edge[:, 1], edge[:, 0]))
    edge, owner = edge[order], owner[order]
    # Where more than two faces share an edge, neighbours in sorted order are not all pairs: look three ahead.
    pairs = [np.zeros((0, 2), int)]
    for step in (1, 2, 3):
        same = (edge[step:] == edge[:-step]).all(axis=1)
        pairs.append(np.column_stack([owner[:-step][same], owner[step:][same]]))
    return np.concatenate(pairs)


def face_neighbours(faces: np.ndarray) -> np.ndarray:
    """The face across each edge, -1 at a border (and at edges of more than two faces), shape ``(F, 3)`` int64."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), axis=1)
    key = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    lone = ~np.concatenate([[False], same[:-1]]) & same & ~np.concatenate([same[1:], [False]])
    a, b = order[:-1][lone], order[1:][lone]
    across = np.full(len(key), -1, dtype=np.int64)
    across[a], across[b] = b // 3, a // 3
    return across.reshape(-1, 3)


def connected_pieces(mesh: Mesh, label: np.ndarray) -> np.ndarray:
    """Numbers of the connected pieces of faces that share a label, shape ``(F,)``; a face labelled -1 is a piece."""
    ring = face_neighbours(mesh.faces)
    face, side = np.nonzero((ring >= 0) & (label >= 0)[:, None] & (label[ring] == label[:, None]))
    return components(len(label), np.column_stack([face, ring[face, side]]))


def smoothed_normals(mesh: Mesh, rounds: int) -> np.ndarray:
    """Face normals averaged, by area, with those of the faces across the edges, ``rounds`` times, shape ``(F, 3)``.

    A face across a sharp edge (more than 45 degrees) takes no part.
    """
    ring = face_neighbours(mesh.faces)
    normals = np.nan_to_num(mesh.face_normals)
    area = np.where(ring >= 0, mesh.areas[ring], 0.0)
    for _ in range(rounds):
        weight = np.where(np.einsum("fi,fki->fk", normals, normals[ring]) > np.sqrt(0.5), area, 0.0)[
            ..., None
        ]
        total = mesh.areas[:, None] * normals + (weight * normals[ring]).sum(axis=1)
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return normals
