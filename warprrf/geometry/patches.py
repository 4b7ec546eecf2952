"""Planar patches of a mesh: found, flattened onto their planes, and made coarse where that changes nothing.

Rooms are mostly planar, and a plane fitted to thousands of points is far better than any depth map: a mesh fused from
depth maps is snapped to its planes, with sharp edges where two of them meet. Lengths in metres; NumPy only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.planes import Plane, detect_planes


@dataclass(frozen=True)
class PlanarPatch:
    """A planar part of a mesh: ``normal . x = offset``.

    Attributes:
        normal: unit normal on the seen side, shape ``(3,)``.
        offset: [m].
        faces: indices of the mesh faces that lie on it, shape ``(K,)`` int64.
        area: [m^2].
    """

    normal: np.ndarray
    offset: float
    faces: np.ndarray = field(repr=False)
    area: float


def planar_patches(
    mesh: Mesh,
    *,
    planes: Sequence[Plane] = (),
    distance_m: float = 0.06,
    angle_rad: float = np.radians(35.0),
    min_area_m2: float = 0.15,
    seed: int = 0,
) -> list[PlanarPatch]:
    """Planar patches of ``mesh``: first on the given planes, then on planes found among the faces left over.

    A patch gathers the faces near its plane that face its way; islands too small to matter are left out, and faces
    in a seam between patches join the patch whose plane they are nearest to.

    Args:
        planes: planes known beforehand (from structure-from-motion points, say), which take precedence.
        distance_m: a face within this distance (its centroid) can belong to a plane.
        angle_rad: and its smoothed normal differs by no more than this.
        min_area_m2: smallest patch on a given plane; patches found here have twice that.

    Returns:
        Patches, largest first.
    """
    normals, areas = smoothed_normals(mesh, 3), mesh.areas
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    ring = face_neighbours(mesh.faces)
    label = _nearest_plane(centres, normals, planes, distance_m, angle_rad)
    label = _without_islands(label, ring, areas, 0.2 * min_area_m2)
    rest = np.flatnonzero(label < 0)
    every = [(p.normal, p.offset) for p in planes]
    if areas[rest].sum() > min_area_m2:
        extra = detect_planes(
            centres[rest], normals[rest], weights=areas[rest], distance_m=0.4 * distance_m, angle_rad=angle_rad,
            min_points=2 * min_area_m2, max_planes=40, seed=seed,
        )  # fmt: skip
        found = _nearest_plane(centres[rest], normals[rest], extra, distance_m, angle_rad)
        label[rest] = np.where(found >= 0, found + len(every), -1)
        every += [(p.normal, p.offset) for p in extra]
        label = _without_islands(label, ring, areas, 0.2 * min_area_m2)
    label = _grown(label, ring, mesh, every, distance_m)
    patches = []
    for k, (normal, offset) in enumerate(every):
        faces = np.flatnonzero(label == k)
        area = float(areas[faces].sum())
        if area >= min_area_m2:
            patches.append(PlanarPatch(np.asarray(normal), float(offset), faces, area))
    return sorted(patches, key=lambda p: -p.area)


def flatten(mesh: Mesh, patches: Sequence[PlanarPatch], *, limit_m: float = 0.15) -> Mesh:
    """``mesh`` with the vertices of each patch moved onto its plane; where patches meet, onto their common edge or
    corner. A move longer than ``limit_m`` is cut back to the nearest plane alone, or left undone."""
    vertices = mesh.vertices.copy()
    pairs = np.unique(
        np.concatenate(
            [
                np.stack([mesh.faces[p.faces].ravel(), np.full(3 * len(p.faces), k)], axis=1)
                for k, p in enumerate(patches)
            ]
            or [np.zeros((0, 2), dtype=np.int64)]
        ),
        axis=0,
    )
    normal = np.array([p.normal for p in patches]).reshape(-1, 3)
    offset = np.array([p.offset for p in patches])
    start = np.searchsorted(pairs[:, 0], np.arange(len(vertices) + 1))
    count = np.diff(start)
    for size in range(1, int(count.max(initial=0)) + 1):
        which = np.flatnonzero(count == size)
        if not len(which):
            continue
        planes = pairs[start[which][:, None] + np.arange(size), 1]
        n, x = normal[planes], vertices[which]
        residual = offset[planes] - np.einsum("vki,vi->vk", n, x)
        # Least move that meets every plane; nearly parallel planes must not send a vertex far away.
        move = np.einsum("vik,vk->vi", np.linalg.pinv(n, rcond=0.2), residual)
        far = np.linalg.norm(move, axis=1) > limit_m
        nearest = np.abs(residual).argmin(axis=1)
        pick = np.arange(len(which))
        single = residual[pick, nearest][:, None] * n[pick, nearest]
        move[far] = np.where(np.linalg.norm(single[far], axis=1, keepdims=True) > limit_m, 0.0, single[far])
        vertices[which] = x + move
    return Mesh(vertices, mesh.faces)


def simplify(
    mesh: Mesh, patches: Sequence[PlanarPatch], *, cell_m: float = 0.25
) -> tuple[Mesh, list[PlanarPatch]]:
    """``mesh`` with the insides of its planar patches, and the straight edges between two of them, made coarse.

    Vertices inside a flattened patch are gathered by cells of ``cell_m`` into one of their number, those on an edge of
    two patches by stretches of that length. A continuous map of a plane piece onto itself that keeps its border leaves
    no hole, and no vertex leaves its plane: the surface stays the same. Elsewhere nothing changes.

    Returns:
        The coarser mesh, and the same patches with the indices of its faces.
    """
    label = np.full(len(mesh.faces), -1, dtype=np.int64)
    for k, patch in enumerate(patches):
        label[patch.faces] = k
    low, high = np.full(len(mesh.vertices), len(patches)), np.full(len(mesh.vertices), -2)
    third = np.zeros(len(mesh.vertices), dtype=bool)
    for corner in range(3):
        np.minimum.at(low, mesh.faces[:, corner], label)
        np.maximum.at(high, mesh.faces[:, corner], label)
    for corner in range(3):
        vertex = mesh.faces[:, corner]
        np.logical_or.at(third, vertex, (label != low[vertex]) & (label != high[vertex]))
    border = np.zeros(len(mesh.vertices), dtype=bool)
    ring = face_neighbours(mesh.faces)
    for side in range(3):
        rim = ring[:, side] < 0
        border[mesh.faces[rim][:, [side, (side + 1) % 3]]] = True
    movable = (low >= 0) & ~third & ~border & (high >= 0)
    origin = mesh.bounds[0]
    key = np.concatenate([np.stack([low, high], axis=1), np.zeros((len(low), 3), dtype=np.int64)], axis=1)
    cells = np.floor((mesh.vertices - origin) / cell_m).astype(np.int64)
    for k, patch in enumerate(patches):
        # Cells within the plane: the world axis nearest to the normal takes no part.
        inside = movable & (low == k) & (high == k)
        flat = np.arange(3) != np.abs(patch.normal).argmax()
        key[inside, 2:] = cells[inside] * flat
    edge = np.flatnonzero(movable & (low != high))
    if len(edge):
        normal = np.array([p.normal for p in patches])
        along = np.cross(normal[low[edge]], normal[high[edge]])
        size = np.linalg.norm(along, axis=1)
        straight = size > 0.2
        movable[edge[~straight]] = False
        edge, along = edge[straight], along[straight] / size[straight, None]
        key[edge, 2] = np.floor((mesh.vertices[edge] * along).sum(axis=1) / cell_m).astype(np.int64)
    target = np.arange(len(mesh.vertices))
    chosen = np.flatnonzero(movable)
    if len(chosen):
        _, group, size = np.unique(key[chosen], axis=0, return_inverse=True, return_counts=True)
        group = group.ravel()
        centre = (
            np.stack([np.bincount(group, mesh.vertices[chosen, a]) for a in range(3)], axis=1) / size[:, None]
        )
        gap = np.linalg.norm(mesh.vertices[chosen] - centre[group], axis=1)
        order = np.lexsort((gap, group))
        first = order[np.concatenate([[0], np.cumsum(size)[:-1]])]
        target[chosen] = chosen[first][group]
    faces = target[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces, label = faces[whole], label[whole]
    used, faces = np.unique(faces, return_inverse=True)
    coarse = Mesh(mesh.vertices[used], faces.reshape(-1, 3))
    faces, areas = coarse.faces.copy(), coarse.areas
    solid = areas > 1e-10
    result = []
    for k, patch in enumerate(patches):
        own = np.flatnonzero((label == k) & solid)
        turned = own[coarse.face_normals[own] @ patch.normal < 0]
        faces[turned] = faces[turned][:, ::-1]  # folded over within the plane
    kept = np.cumsum(solid) - 1
    for k, patch in enumerate(patches):
        own = np.flatnonzero((label == k) & solid)
        if len(own):
            result.append(replace(patch, faces=kept[own]))
    return Mesh(coarse.vertices, faces[solid]), result


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
    from scipy import sparse
    from scipy.sparse import csgraph

    ring = face_neighbours(mesh.faces)
    face, side = np.nonzero((ring >= 0) & (label >= 0)[:, None] & (label[ring] == label[:, None]))
    link = sparse.coo_matrix((np.ones(len(face)), (face, ring[face, side])), shape=(len(label),) * 2)
    piece: np.ndarray = csgraph.connected_components(link, directed=False)[1]
    return piece


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


def _nearest_plane(
    centres: np.ndarray, normals: np.ndarray, planes: Sequence[Plane], distance_m: float, angle_rad: float
) -> np.ndarray:
    label = np.full(len(centres), -1, dtype=np.int64)
    best = np.full(len(centres), distance_m)
    for k, plane in enumerate(planes):
        gap = np.abs(plane.distance(centres))
        better = (gap < best) & (normals @ plane.normal > np.cos(angle_rad))
        label[better], best[better] = k, gap[better]
    return label


def _without_islands(label: np.ndarray, ring: np.ndarray, areas: np.ndarray, min_area: float) -> np.ndarray:
    """Labels with connected pieces of one label set to -1 where their area is below ``min_area``."""
    piece = np.arange(len(label))
    same = (ring >= 0) & (label[ring] == label[:, None]) & (label >= 0)[:, None]
    while True:
        # Every face and the root of its piece take the smallest number around; then chains are cut short.
        least = np.where(same, piece[ring], piece[:, None]).min(axis=1)
        merged = np.minimum(piece, least)
        np.minimum.at(merged, piece, least)
        merged = merged[merged]
        if (merged == piece).all():
            break
        piece = merged
    total = np.bincount(piece, weights=areas)
    return np.where(total[piece] >= min_area, label, -1)


def _grown(
    label: np.ndarray,
    ring: np.ndarray,
    mesh: Mesh,
    planes: Sequence[tuple[np.ndarray, float]],
    distance_m: float,
) -> np.ndarray:
    """Seam faces join the neighbouring patch whose plane all their corners are nearest to, round by round."""
    if not planes:
        return label
    normal = np.array([n for n, _ in planes])
    offset = np.array([d for _, d in planes])
    corners = mesh.vertices[mesh.faces]
    label = label.copy()
    for _ in range(4):
        open_faces = np.flatnonzero(label < 0)
        near = np.where(ring[open_faces] >= 0, label[ring[open_faces]], -1)
        gap = np.full(near.shape, np.inf)
        for side in range(3):
            has = near[:, side] >= 0
            k = near[has, side]
            points = corners[open_faces[has]]
            gap[has, side] = np.abs(np.einsum("fvi,fi->fv", points, normal[k]) - offset[k, None]).max(axis=1)
        side = gap.argmin(axis=1)
        pick = np.arange(len(open_faces))
        joins = gap[pick, side] < distance_m
        if not joins.any():
            break
        label[open_faces[joins]] = near[pick, side][joins]
    return label
