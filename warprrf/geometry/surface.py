"""Surfaces: cleaned points, their normals, depth maps fused into a mesh, and the planar patches of that mesh.

Wraps Open3D for neighbour queries, ray casting and TSDF fusion (Curless and Levoy, "A volumetric method for building
complex models from range images", 1996). Lengths in metres. Rooms are mostly planar, and a
plane fitted to thousands of points is far better than any depth map: the mesh is therefore snapped to its planes, with
sharp edges where two of them meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warprrf.device import check_array, require
from warprrf.geometry.camera import Camera
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.planes import Plane, detect_planes, occupancy

__all__ = [
    "Occluder",
    "PlanarPatch",
    "Plane",
    "clean_points",
    "detect_planes",
    "detect_room_planes",
    "estimate_normals",
    "flatten",
    "fuse_depth",
    "neighbours",
    "occupancy",
    "planar_patches",
    "simplify",
    "visible_from",
]

# Voxels along a block's side, and blocks to set aside for at first (the grid grows when it needs more).
BLOCK_VOXELS, BLOCKS = 16, 20_000
RAYS_AT_ONCE = 2_000_000


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


def neighbours(
    points: np.ndarray, count: int, queries: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Indices and distances [m] of the ``count`` nearest ``points`` to each query, nearest first, shape ``(Q, count)``.

    Without ``queries``, of every point among the others (itself left out).
    """
    o3d = require("open3d", extra="photos")
    itself = 1 if queries is None else 0
    # Float32 inside: centre first, so that far-off world coordinates cost no digits.
    centre = points.mean(axis=0)
    data = o3d.core.Tensor(np.ascontiguousarray(points - centre, dtype=np.float32))
    search = o3d.core.nns.NearestNeighborSearch(data)
    search.knn_index()
    asked = points if queries is None else queries
    wanted = min(count + itself, len(points))
    index, square = search.knn_search(
        o3d.core.Tensor(np.ascontiguousarray(asked - centre, dtype=np.float32)), wanted
    )
    return index.numpy()[:, itself:].astype(np.int64), np.sqrt(np.maximum(square.numpy()[:, itself:], 0.0))


def clean_points(
    points: Any,
    *,
    reprojection_error: Any = None,
    track_length: Any = None,
    max_reprojection_error: float = 1.0,
    min_track_length: int = 3,
    neighbour_count: int = 16,
    deviations: float = 2.5,
) -> np.ndarray:
    """Which points to keep, shape ``(P,)`` bool: seen often enough, reprojected well, not far from all others.

    A point is an outlier when its mean distance to its neighbours exceeds the average of that figure over all points
    by ``deviations`` standard deviations (Rusu et al., "Towards 3D point cloud based object maps", 2008).

    Args:
        points: shape ``(P, 3)``.
        reprojection_error: mean reprojection error of each point [pixels], shape ``(P,)``.
        track_length: number of photos that see each point, shape ``(P,)``.
    """
    points = check_array("points", points, (None, 3))
    keep = np.ones(len(points), dtype=bool)
    if reprojection_error is not None:
        keep &= (
            check_array("reprojection_error", reprojection_error, (len(points),)) <= max_reprojection_error
        )
    if track_length is not None:
        keep &= check_array("track_length", track_length, (len(points),)) >= min_track_length
    chosen = np.flatnonzero(keep)
    if len(chosen) > neighbour_count:
        _, gap = neighbours(points[chosen], neighbour_count)
        spacing = gap.mean(axis=1)
        keep[chosen[spacing > spacing.mean() + deviations * spacing.std()]] = False
    return keep


def estimate_normals(points: Any, viewpoints: Any, *, neighbour_count: int = 16) -> np.ndarray:
    """Unit normals from the neighbourhood of each point, turned to the side of ``viewpoints``, shape ``(P, 3)``.

    Args:
        points: shape ``(P, 3)``.
        viewpoints: a place each point was seen from, shape ``(P, 3)`` (or one for all, ``(3,)``).

    Raises:
        ValueError: for fewer than three points.
    """
    points = check_array("points", points, (None, 3))
    if len(points) < 3:
        raise ValueError(f"points: got {len(points)}, expected at least 3 to estimate normals")
    views = np.broadcast_to(np.asarray(viewpoints, dtype=np.float64), points.shape)
    index, gap = neighbours(points, neighbour_count)
    # Weights fall off with distance, so that a far neighbour on another surface counts little.
    weight = 1 / (1 + (gap / np.maximum(np.median(gap, axis=1, keepdims=True), 1e-9)) ** 2)
    local = points[index] - points[:, None]
    local -= (weight[..., None] * local).sum(axis=1, keepdims=True) / weight.sum(axis=1)[:, None, None]
    moments = np.einsum("nk,nki,nkj->nij", weight, local, local)
    normals = np.linalg.eigh(moments)[1][:, :, 0]
    away = ((views - points) * normals).sum(axis=1) < 0
    normals[away] *= -1
    return normals


def detect_room_planes(
    points: np.ndarray,
    normals: np.ndarray,
    viewpoints: np.ndarray,
    *,
    distance_m: float = 0.015,
    min_points: int = 40,
    small_points: int = 16,
    seed: int = 0,
) -> list[Plane]:
    """Planes among sparse points in two passes: the large ones, then small ones among the points left over.

    Beside a wall the neighbourhood of a small surface is full of the wall's points, and its normals are poor; without
    them they are good enough for planes of ``small_points`` (compact ones: within 1.5 m of their middle).
    """
    large = detect_planes(points, normals, distance_m=distance_m, min_points=min_points, seed=seed)
    # A point on a large plane, seen from its front, belongs to it even where its own normal is off.
    free = np.ones(len(points), dtype=bool)
    for plane in large:
        on = np.abs(plane.distance(points)) < 2 * distance_m
        near = neighbours(points[plane.inliers], 1, points)[1][:, 0] < 0.3
        free &= ~(on & near & (plane.distance(viewpoints) > 0))
    rest = np.flatnonzero(free)
    if len(rest) < small_points:
        return large
    again = estimate_normals(points[rest], viewpoints[rest], neighbour_count=10)
    small = detect_planes(points[rest], again, distance_m=distance_m, min_points=small_points, seed=seed)
    compact = []
    for plane in small:
        own = points[rest[plane.inliers]]
        spread = np.linalg.norm(own - np.median(own, axis=0), axis=1)
        close = spread < 1.5
        if close.sum() >= small_points and close.mean() > 0.6:
            compact.append(replace(plane, inliers=rest[plane.inliers[close]]))
    return large + compact


class Occluder:
    """A surface ready for many visibility queries (the bounding volume hierarchy is built once)."""

    def __init__(self, mesh: Mesh) -> None:
        o3d = require("open3d", extra="photos")
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(mesh.vertices.astype(np.float32)), self._tensor(mesh.faces.astype(np.uint32))
        )

    def blocks(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Whether something lies between ``start`` and ``end`` (N, 3) [m], shape ``(N,)`` bool."""
        blocked = np.zeros(len(start), dtype=bool)
        for first in range(0, len(start), RAYS_AT_ONCE):
            part = slice(first, first + RAYS_AT_ONCE)
            rays = np.concatenate([start[part], end[part] - start[part]], axis=1).astype(np.float32)
            blocked[part] = self._scene.test_occlusions(self._tensor(rays), tnear=0.0, tfar=1.0).numpy()
        return blocked


def visible_from(
    surface: Occluder | None,
    points: np.ndarray,
    normals: np.ndarray,
    cameras: Sequence[Camera],
    *,
    clearance_m: float,
) -> np.ndarray:
    """Which cameras see which points, shape ``(P, cameras)`` bool: in the frame, from the front, nothing between.

    The line of sight starts ``clearance_m`` above the surface, along the normal.
    """
    seen = np.zeros((len(points), len(cameras)), dtype=bool)
    for c, camera in enumerate(cameras):
        uv, depth = camera.project(points)
        with np.errstate(invalid="ignore"):
            inside = (depth > 0.05) & (uv >= 0).all(axis=1) & (uv < (camera.width, camera.height)).all(axis=1)
        seen[:, c] = inside & (((camera.position - points) * normals).sum(axis=1) > 0)
    if surface is not None:
        positions = np.array([camera.position for camera in cameras])
        point, eye = np.nonzero(seen)
        seen[point, eye] = ~surface.blocks(points[point] + clearance_m * normals[point], positions[eye])
    return seen


def fuse_depth(
    depths: Sequence[Any],
    cameras: Sequence[Camera],
    colors: Sequence[Any] | None = None,
    *,
    voxel_m: float = 0.04,
    truncation_m: float | None = None,
    max_range_m: float = 12.0,
    edge_tolerance: float = 8.0,
    min_views: int = 2,
    min_component_faces: int = 200,
) -> Mesh:
    """One mesh from depth maps of pinhole cameras, by a truncated signed distance field.

    Args:
        depths: Euclidean range per pixel [m], each ``(height, width)`` of its camera; inf, NaN or 0 where unknown.
        cameras: pinhole cameras, one a depth map.
        colors: not used by the geometry; accepted so that images can be passed along.
        voxel_m: side of a voxel.
        truncation_m: the field is truncated at this distance (default four voxels).
        max_range_m: depths beyond this are left out.
        edge_tolerance: a pixel is left out where inverse depth bends by more than this part of itself, per focal length
            in pixels: on a plane it is linear in the image, in a corner it bends, across an occluding edge it jumps.
        min_views: a surface is kept where at least this many depth maps saw it.
        min_component_faces: connected pieces with fewer faces are dropped as floating debris.

    Raises:
        ValueError: when the numbers of maps and cameras differ, a camera is not a pinhole, a map has another shape
            than its camera, or no surface comes out.
    """
    o3d = require("open3d", extra="photos")
    if len(depths) != len(cameras) or not len(depths):
        raise ValueError(f"depths: got {len(depths)} maps for {len(cameras)} cameras, expected one for each")
    if voxel_m <= 0:
        raise ValueError(f"voxel_m: got {voxel_m}, expected a positive length in metres")
    core = o3d.core
    truncation = (truncation_m or 4 * voxel_m) / voxel_m
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), voxel_m, BLOCK_VOXELS, BLOCKS
    )
    filled = False
    for k, (given, camera) in enumerate(zip(depths, cameras, strict=True)):
        if camera.kind != "pinhole":
            raise ValueError(f"cameras[{k}]: got a {camera.kind} camera, expected pinhole cameras")
        depth = check_array(f"depths[{k}]", given, (camera.height, camera.width), np.float64, finite=False)
        z = range_to_depth(np.where(np.isfinite(depth), depth, 0.0), camera)
        z[(depth > max_range_m) | ~_smooth(z, edge_tolerance / camera.fx)] = 0.0
        image = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(z, dtype=np.float32)))
        # The grid reads the pixel that a voxel's projection falls into: pixel centres at +0.5, as ours.
        lens = core.Tensor(
            np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=np.float64)
        )
        pose = core.Tensor(np.array(camera.world_to_camera, dtype=np.float64))
        if not (z > 0).any():
            continue
        blocks = grid.compute_unique_block_coordinates(image, lens, pose, 1.0, max_range_m, truncation)
        grid.integrate(blocks, image, lens, pose, 1.0, max_range_m, truncation)
        filled = True
    raw = grid.extract_triangle_mesh(min_views - 0.5).to_legacy() if filled else None
    if raw is None or len(raw.triangles) == 0:
        raise ValueError("depths: no surface came out; are the maps ranges in metres and the poses right?")
    raw = _ordered(o3d, np.asarray(raw.vertices), np.asarray(raw.triangles))
    raw.merge_close_vertices(1e-4 * voxel_m)
    raw.remove_degenerate_triangles()
    if min_component_faces > 0:
        label, count, _ = raw.cluster_connected_triangles()
        small = np.asarray(count)[np.asarray(label)] < min_component_faces
        raw.remove_triangles_by_mask(small)
        raw.remove_unreferenced_vertices()
    if len(raw.triangles) == 0:
        raise ValueError(f"min_component_faces: no connected piece has {min_component_faces} faces")
    return Mesh(np.asarray(raw.vertices), np.asarray(raw.triangles))


def _ordered(o3d: Any, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """The mesh with vertices and faces in an order of their own, not in that in which threads found them."""
    order = np.lexsort(vertices.T[::-1])
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    faces = rank[faces]
    turn = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices[order]), o3d.utility.Vector3iVector(faces.astype(np.int32))
    )


def range_to_depth(distance: np.ndarray, camera: Camera) -> np.ndarray:
    """Depth along the optical axis [m] of Euclidean ranges ``(H, W)`` in a pinhole image."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return distance / np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)


def _smooth(z: np.ndarray, tolerance: float) -> np.ndarray:
    """Pixels with a depth whose inverse is nearly linear towards both neighbours, along rows and columns."""
    known = z > 0
    inverse = np.where(known, 1 / np.where(known, z, 1.0), np.nan)
    fine = known.copy()
    for axis in (0, 1):
        bend = np.zeros_like(inverse)
        middle = [slice(None), slice(None)]
        middle[axis] = slice(1, -1)
        bend[tuple(middle)] = np.diff(inverse, n=2, axis=axis)
        with np.errstate(invalid="ignore"):
            fine &= ~(np.abs(bend) > tolerance * inverse)
    return fine


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
    sparse = require("scipy.sparse", extra="photos")
    graph = require("scipy.sparse.csgraph", extra="photos")
    face = np.repeat(np.arange(len(label)), 3)
    other = ring.ravel()
    same = (other >= 0) & (label[face] == label[other]) & (label[face] >= 0)
    links = sparse.coo_matrix(
        (np.ones(same.sum()), (face[same], other[same])), shape=(len(label), len(label))
    )
    _, piece = graph.connected_components(links, directed=False)
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
