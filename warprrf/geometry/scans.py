"""A mesh fused from depth maps, or a scan, snapped to planes: faces find their plane, vertices move onto it, flat parts go coarse.

Rooms are mostly planar, and a plane fitted to thousands of points is far better than any depth map. Sharp edges come
out where two planes meet. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from scipy import sparse

from warprrf.checks import Count, checked, positive
from warprrf.geometry.mesh import Mesh, connected_pieces, face_neighbours, sides_of, smoothed_normals
from warprrf.geometry.planar_patches import PlanarPatches, vertex_noise
from warprrf.geometry.planes import Plane, PlaneConfig, detect_planes, drawn_by_place
from warprrf.rows import distinct_rows, sums_of


@checked
@dataclass(frozen=True)
class SurfaceConfig:
    """How Gaussians become a mesh with planar patches.

    Attributes:
        depth_pixels: depth maps have about so many pixels, or their photos' where these have fewer.
        voxel_m: largest side of a voxel of the fusion.
        truncation_voxels: the distance field is truncated at so many voxels.
        max_range_m: depths beyond this are left out.
        min_component_faces: connected pieces with fewer faces are dropped as floating debris.
        patch_distance_m: a face this close to a plane can belong to its patch: a depth map's error.
    """

    depth_pixels: Count = 320_000
    voxel_m: Annotated[float, positive("length in metres")] = 0.05
    truncation_voxels: float = 3.0
    max_range_m: float = 12.0
    min_component_faces: int = 200
    patch_distance_m: float = 0.06


PATCH_ANGLE_DEG = 35.0  # most between the smoothed normal of a face and that of its patch
NEARLY_PARALLEL_DEG = 2.0  # twice what small planes err by in films of rooms
MIN_PATCH_M2 = 0.15  # smallest planar patch
SIMPLIFY_M = 0.25  # flat parts are made of faces of about this size in the end
LONGEST_MOVE_M = 0.15  # of a vertex to its plane
ALIKE = 0.95  # cosine between the normals of planes that are nearly parallel
FLAT_M = 1e-6  # faces of a snapped patch lie this near to its plane
DRAWN = 100_000  # faces are enough to find planes among
SCAN_NOISE_M = 2e-3  # vertices whose errors are larger are a scanner's
SMOOTHED = 5  # rounds of smoothing
SHRINK, GROW = 0.5, -0.53  # Taubin (1995): noise goes, nothing shrinks


def find_patches(mesh: Mesh, planes: Sequence[Plane], config: SurfaceConfig) -> PlanarPatches:
    """Which faces of ``mesh`` lie on which of the given planes, and which others on planes found among them.

    A patch gathers the faces near its plane that face its way; islands too small to matter are left out. Patch k lies
    on ``planes[k]``, turned where it is nearly parallel to a larger one; those of planes found here come after them.
    """
    normals, areas = smoothed_normals(mesh, 3), mesh.areas
    centres = mesh.triangles.mean(axis=1)
    label = np.full(len(centres), -1, dtype=np.int64)

    def gather(planes: Sequence[Plane], first: int) -> None:
        best = np.where(label < 0, config.patch_distance_m, 0.0)
        for k, plane in enumerate(planes):
            gap = np.abs(plane.distance(centres))
            better = (gap < best) & (normals @ plane.normal > np.cos(np.radians(PATCH_ANGLE_DEG)))
            label[better], best[better] = first + k, gap[better]
        piece = connected_pieces(mesh, label)
        label[np.bincount(piece, weights=areas)[piece] < 0.2 * MIN_PATCH_M2] = -1

    gather(planes, 0)
    among_faces = PlaneConfig(
        distance_m=0.4 * config.patch_distance_m,
        angle_deg=PATCH_ANGLE_DEG,
        min_points=2 * MIN_PATCH_M2,
        max_planes=40,
    )
    free = np.flatnonzero(label < 0)
    drawn = free
    if len(free) > DRAWN:
        drawn = free[drawn_by_place(centres[free], np.ones(len(free)), DRAWN, 0)]
    weights = areas[drawn] * (areas[free].sum() / max(areas[drawn].sum(), 1e-30))
    found = detect_planes(centres[drawn], normals[drawn], weights=weights, config=among_faces)
    gather(found, len(planes))
    every = _parallel(planes, found, mesh, label, config.patch_distance_m)
    return PlanarPatches.from_planes(
        mesh, label, [p.normal for p in every], [p.offset for p in every], tolerance_m=FLAT_M
    )


def _parallel(
    given: Sequence[Plane], found: Sequence[Plane], mesh: Mesh, label: np.ndarray, reach_m: float
) -> list[Plane]:
    """All planes, of the faces of each ``label``, those of less area parallel to larger ones that they are nearly parallel
    to, and ``found`` to ``given`` ones: built rooms have few directions, and a small plane's is known badly. A plane turns
    about the middle of its faces, unless that moves more than a tenth of them by ``reach_m``; one that was found to be level
    stays so."""
    centres, directions = mesh.triangles.mean(axis=1), list[np.ndarray]()
    result = [*given, *found]
    area = np.bincount(label[label >= 0], mesh.areas[label >= 0], minlength=len(result))
    for k in np.lexsort((-area, np.arange(len(result)) >= len(given))):
        own, plane = label == k, result[k]
        if not own.any():
            continue
        if abs(plane.normal[2]) == 1.0:
            directions.append(plane.normal)
            continue
        middle = mesh.areas[own] @ centres[own] / area[k]
        for direction in directions:
            turned = np.sign(direction @ plane.normal) * direction
            moved = np.abs((centres[own] - middle) @ (turned - plane.normal))
            alike = turned @ plane.normal > np.cos(np.radians(NEARLY_PARALLEL_DEG))
            if alike and np.percentile(moved, 90) < reach_m:
                on_plane = middle - plane.distance(middle) * plane.normal
                result[k] = replace(plane, normal=turned, offset=float(turned @ on_plane))
                break
        else:
            directions.append(plane.normal)
    return result


def snapped(mesh: Mesh, planes: Sequence[Plane], config: SurfaceConfig) -> PlanarPatches:
    """Planar patches of a noisy mesh, on a mesh without its noise: smoothed, its patches flattened."""
    return flattened(find_patches(_smoothed(mesh), planes, config))


def is_scan(mesh: Mesh) -> bool:
    """Whether the vertices of ``mesh`` have errors like a scanner's: more than :data:`SCAN_NOISE_M`."""
    return vertex_noise(mesh, mesh.neighbours, mesh.rounding_m) > SCAN_NOISE_M


def scanned_patches(mesh: Mesh) -> PlanarPatches:
    """Planar patches of a scan, largest first, on a mesh without its noise: smoothed, snapped to planes, made coarse.

    Args:
        mesh: noisy, with holes, of any number of faces.
    """
    patches = simplified(snapped(mesh, (), SurfaceConfig()))
    return replace(largest_first(patches), two_sided=True)


def _smoothed(mesh: Mesh) -> Mesh:
    """``mesh`` with its noise smoothed away (Taubin, "A signal processing approach to fair surface design", 1995)."""
    faces, count = mesh.welded_faces, len(mesh.vertices)
    ends = sides_of(faces)
    link = sparse.coo_array((np.ones(len(ends)), ends.T), shape=(count, count)).tocsr()
    link = ((link + link.T) > 0).astype(float)
    degree = np.maximum(np.asarray(link.sum(axis=1)).reshape(-1, 1), 1.0)
    first = np.unique(faces, return_index=True)
    vertices = np.zeros((count, 3))
    vertices[first[0]] = mesh.vertices[mesh.faces.reshape(-1)[first[1]]]
    for _ in range(SMOOTHED):
        for share in (SHRINK, GROW):
            vertices = vertices + share * ((link @ vertices) / degree - vertices)
    return Mesh(vertices, faces)


def flattened(patches: PlanarPatches) -> PlanarPatches:
    """``patches`` of their mesh with the vertices of each moved onto its plane; where patches meet, onto their common
    edge or corner. A move longer than :data:`LONGEST_MOVE_M` is cut back to the nearest plane alone, or left undone."""
    mesh, own = patches.mesh, np.flatnonzero(patches.face_patch >= 0)
    vertices = mesh.vertices.copy()
    corners = np.stack([mesh.faces[own].ravel(), np.repeat(patches.face_patch[own], 3)], axis=1)
    pairs = np.unique(corners.astype(np.int64), axis=0)  # of a vertex and a patch
    start = np.searchsorted(pairs[:, 0], np.arange(len(vertices) + 1))
    count = np.diff(start)
    for size in range(1, int(count.max(initial=0)) + 1):
        which = np.flatnonzero(count == size)
        if not len(which):
            continue
        planes = pairs[start[which][:, None] + np.arange(size), 1]
        n, x = patches.normal[planes], vertices[which]
        residual = patches.offset[planes] - np.einsum("vki,vi->vk", n, x)
        nearest, rows = np.abs(residual).argmin(axis=1), np.arange(len(which))
        single = residual[rows, nearest][:, None] * n[rows, nearest]
        # Least move that meets every plane, but of nearly parallel ones, which may not meet near by, the nearest alone.
        nearer = np.abs(residual)[:, None, :] < np.abs(residual)[:, :, None]
        left = ~(nearer & (np.einsum("vki,vli->vkl", n, n) > ALIKE)).any(axis=2)
        move = np.einsum("vik,vk->vi", np.linalg.pinv(n * left[..., None], rcond=0.2), residual * left)
        for cut in (single, np.zeros_like(single)):
            far = np.linalg.norm(move, axis=1) > LONGEST_MOVE_M
            move[far] = cut[far]
        vertices[which] = x + move
    return replace(patches, mesh=Mesh(vertices, mesh.faces))


def simplified(patches: PlanarPatches) -> PlanarPatches:
    """``patches`` of their mesh with their insides, and the straight edges between two of them, made coarse.

    Vertices inside a flattened patch are gathered by cells of ``SIMPLIFY_M`` into one of their number, those on an edge of
    two patches by stretches of that length. A continuous map of a plane piece onto itself that keeps its border leaves
    no hole, and no vertex leaves its plane: the surface stays the same. Elsewhere nothing changes.
    """
    mesh, label = patches.mesh, patches.face_patch.astype(np.int64)
    target = _gathered(patches)
    faces = target[mesh.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    used, faces = np.unique(faces[whole], return_inverse=True)
    coarse, label = Mesh(mesh.vertices[used], faces.reshape(-1, 3)), label[whole]
    faces = coarse.faces.copy()
    normal = np.vstack([patches.normal, np.zeros(3)])[label]
    turned = (coarse.face_normals * normal).sum(axis=1) < 0  # folded over within the plane
    faces[turned] = faces[turned][:, ::-1]
    solid = coarse.areas > 1e-10
    return PlanarPatches.from_planes(
        Mesh(coarse.vertices, faces[solid]), label[solid], patches.normal, patches.offset, tolerance_m=FLAT_M
    )


def _gathered(patches: PlanarPatches) -> np.ndarray:
    """The vertex that each vertex moves to: itself, or the one nearest to the middle of its group, shape ``(V,)``."""
    mesh, label = patches.mesh, patches.face_patch.astype(np.int64)
    count = len(mesh.vertices)
    low, high, third = np.full(count, len(patches)), np.full(count, -2), np.zeros(count, dtype=bool)
    for vertex in mesh.faces.T:
        np.minimum.at(low, vertex, label)
        np.maximum.at(high, vertex, label)
    for vertex in mesh.faces.T:
        third[vertex[(label != low[vertex]) & (label != high[vertex])]] = True
    border = np.zeros(count, dtype=bool)
    face, side = np.nonzero(face_neighbours(mesh.faces) < 0)
    border[mesh.faces[face, side]] = border[mesh.faces[face, (side + 1) % 3]] = True
    movable = (low >= 0) & (high >= 0) & ~third & ~border
    key = np.concatenate([np.stack([low, high], axis=1), np.zeros((count, 3), dtype=np.int64)], axis=1)
    inside = np.flatnonzero(movable & (low == high))
    # Cells within the plane: the world axis nearest to the normal takes no part.
    flat = np.arange(3) != np.abs(patches.normal[low[inside]]).argmax(axis=1)[:, None]
    key[inside, 2:] = np.floor((mesh.vertices[inside] - mesh.bounds[0]) / SIMPLIFY_M) * flat
    edge = np.flatnonzero(movable & (low != high))
    along = np.cross(patches.normal[low[edge]], patches.normal[high[edge]])
    size = np.linalg.norm(along, axis=1)
    movable[edge[size <= 0.2]] = False  # of planes so alike that their edge is not straight
    stretch = (mesh.vertices[edge] * along).sum(axis=1) / np.maximum(size, 1e-30) / SIMPLIFY_M
    key[edge, 2] = np.floor(stretch)
    target, chosen = np.arange(count), np.flatnonzero(movable)
    _, group, members = distinct_rows(key[chosen])
    centre = sums_of(mesh.vertices[chosen], group) / members[:, None]
    gap = np.linalg.norm(mesh.vertices[chosen] - centre[group], axis=1)
    first = np.lexsort((gap, group))[np.cumsum(members) - members]
    target[chosen] = chosen[first][group]
    return target


def largest_first(patches: PlanarPatches) -> PlanarPatches:
    """``patches`` in the order of their area, without those below :data:`MIN_PATCH_M2`."""
    order = np.argsort(-patches.area, kind="stable")
    order = order[patches.area[order] >= MIN_PATCH_M2]
    number = np.full(len(patches) + 1, -1)
    number[order] = np.arange(len(order))
    return PlanarPatches.from_planes(
        patches.mesh,
        number[patches.face_patch],
        patches.normal[order],
        patches.offset[order],
        tolerance_m=patches.tolerance_m,
        two_sided=patches.two_sided,
    )
