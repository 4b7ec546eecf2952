"""Surfaces: cleaned points, their normals and planes, visibility, and depth maps fused into a mesh.

Wraps Open3D for neighbour queries, ray casting and TSDF fusion (Curless and Levoy, "A volumetric method for building
complex models from range images", 1996). Lengths in metres. Planar patches are in :mod:`warprrf.geometry.patches`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from warprrf.device import check_array
from warprrf.geometry import o3d as o3d_package
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.patches import PlanarPatch, flatten, planar_patches, simplify
from warprrf.geometry.photos.planes import Plane, detect_planes, occupancy
from warprrf.geometry.splats.camera import Camera

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


def neighbours(
    points: np.ndarray, count: int, queries: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Indices and distances [m] of the ``count`` nearest ``points`` to each query, nearest first, shape ``(Q, count)``.

    Without ``queries``, of every point among the others (itself left out).
    """
    o3d = o3d_package.load()
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
        o3d = o3d_package.load()
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
    o3d = o3d_package.load()
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
