"""From Gaussians to a surface: depth maps rendered at cameras, mended by photos, fused, snapped to planes, made whole.

Fusion is Open3D's truncated signed distance field (Curless and Levoy, "A volumetric method for building complex models
from range images", 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from warprrf.device import DeviceLike, Progress, silent, threads
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.posed.images import PosedPhotos, lens_matrix, shown_at
from warprrf.geometry.photos.posed.photo_files import spread
from warprrf.geometry.photos.surface.completion import complete
from warprrf.geometry.photos.surface.segments import segments_of, with_segments
from warprrf.geometry.photos.surface.stereo import mended
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.planes import Plane
from warprrf.geometry.rays import open3d
from warprrf.geometry.scans import SurfaceConfig, largest_first, simplified, snapped
from warprrf.geometry.splats.camera import Camera, slopes_of
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.render import render

FEW_MAPS = 80
"""Of no more depth maps of photos than this one is enough to keep a surface: photos far apart show much once only. Of some 35
photos of two films and of the lobby, and of 62 and 84 of the lobby, spectra of fields on the meshes are .2 to .9 dB better; of 120
of the lobby what only one map saw is wrong, and fields lose .2 to .7 dB."""
VIEWS = 120  # most depth maps that are fused, spread over all cameras
EDGE_TOLERANCE = 8.0
"""A pixel is left out where inverse depth bends by more than this part of itself, per focal length in pixels: on a plane
it is linear in the image, in a corner it bends, across an occluding edge it jumps."""
BLOCK_VOXELS, BLOCKS = 16, 20_000  # voxels along a block's side; blocks set aside at first, the grid grows


def depth_views(cameras: Sequence[Camera], config: SurfaceConfig) -> list[Camera]:
    """Cameras of the depth maps: some of ``cameras``, spread over all, with fewer pixels."""
    views = []
    for camera in spread(cameras, VIEWS):
        side = min(1.0, (config.depth_pixels / (camera.width * camera.height)) ** 0.5)
        views.append(camera.resized(max(1, round(side * camera.width)), max(1, round(side * camera.height))))
    return views


def depth_maps(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    photos: PosedPhotos | None = None,
    planes: Sequence[Plane] = (),
    config: ReconstructionConfig,
    progress: Progress | None = None,
    device: DeviceLike = None,
) -> list[np.ndarray]:
    """Ranges [m] that :func:`depth_views` of ``cameras`` see of Gaussians, 0 where none is reliable.

    Args:
        photos: what ``cameras`` saw, in the same order; the depth maps are mended by them.
        planes: that Gaussians were kept on: elsewhere only what photos prove is reliable.
    """
    report = progress or silent
    views, depths = depth_views(cameras, config.surface), []
    alpha = 0.6  # a depth counts where at least so much light is blocked,
    depth_spread = 0.05  # and where blended depth and dominant Gaussian differ by no more than this part
    for k, view in enumerate(views):
        report("depth", k, len(views))
        out = render(gaussians, view, features=np.zeros((len(gaussians), 1), dtype=np.float32), device=device)
        with np.errstate(invalid="ignore"):
            agree = np.abs(out.depth - out.peak) <= depth_spread * out.peak
        depths.append(np.where(agree & (out.alpha >= alpha), out.depth, 0.0))
    report("depth", len(views), len(views))
    if photos is None or not config.stereo:
        return depths
    seen = photos.subset(spread(range(len(cameras)), VIEWS))
    depths, proved = mended(depths, views, seen, progress=report, device=device)
    reach = partial(_sure, planes=planes, reach_m=config.surface.patch_distance_m)
    with ThreadPoolExecutor(threads()) as pool:
        depths = list(pool.map(reach, depths, proved, views))
    return _flat(depths, proved, views, seen, report) if config.segments else depths


def _sure(
    depth: np.ndarray, proved: np.ndarray, view: Camera, planes: Sequence[Plane], reach_m: float
) -> np.ndarray:
    """A depth map without what neither photos prove nor a plane within ``reach_m`` holds: Gaussians are vague there."""
    rest = (depth > 0) & ~proved
    points = view.position + depth[rest][:, None] * view.directions()[rest]
    held = np.zeros(len(points), dtype=bool)
    for plane in planes:
        held |= plane.holds(points, reach_m)
    result = depth.copy()
    result[rest] *= held
    return result


def _flat(
    depths: Sequence[np.ndarray],
    proved: Sequence[np.ndarray],
    views: Sequence[Camera],
    photos: PosedPhotos,
    progress: Progress,
) -> list[np.ndarray]:
    """``depths`` with the flat segments of their photos on planes."""
    progress("segments", 0, len(views))
    result = []
    # Planes are many small steps of Python's, which threads would not speed up.
    with ThreadPoolExecutor(threads()) as pool:
        cut = pool.map(segments_of, photos.images, views)
        for k, (depth, sure, segment, view) in enumerate(zip(depths, proved, cut, views, strict=True)):
            result.append(with_segments(depth, sure, shown_at(photos.mask(k), view), segment, view))
            progress("segments", len(result), len(views))
    return result


def fuse_maps(
    views: Sequence[Camera],
    depths: Sequence[np.ndarray],
    *,
    planes: Sequence[Plane] = (),
    config: ReconstructionConfig,
    least_views: int = 2,
    progress: Progress | None = None,
) -> tuple[PlanarPatches, bool]:
    """Mesh of depth maps with its planar patches, the largest first; and whether its holes were closed.

    Args:
        depths: ranges [m], 0 where unknown, each of one of ``views``.
        planes: known beforehand; the mesh is snapped to them.
        least_views: see :func:`fuse_depth`.
    """
    report = progress or silent
    report("surface", 0, 4)
    surface = _with_voxels(config.surface, views, depths)
    mesh = fuse_depth(depths, views, config=surface, least_views=least_views)
    report("surface", 1, 4)
    patches = snapped(mesh, planes, config.surface)
    report("surface", 2, 4)
    whole = False
    if config.completion:
        patches, whole = complete(patches, views, depths, planes=planes)
    report("surface", 3, 4)
    result = largest_first(simplified(patches))
    report("surface", 4, 4)
    return result, whole


def _with_voxels(
    config: SurfaceConfig, views: Sequence[Camera], depths: Sequence[np.ndarray]
) -> SurfaceConfig:
    """``config`` with smaller voxels where the views look from near by: they show finer things."""
    pixel_m = [np.median(d[d > 0]) / v.fx for v, d in zip(views, depths, strict=True) if (d > 0).any()]
    if not pixel_m:
        return config
    voxel_pixels = 5.0  # widest voxel, in pixels of the depth maps at their median range
    return replace(config, voxel_m=min(config.voxel_m, voxel_pixels * float(np.median(pixel_m))))


def fuse_depth(
    depths: Sequence[np.ndarray], cameras: Sequence[Camera], *, config: SurfaceConfig, least_views: int = 2
) -> Mesh:
    """One mesh from depth maps of pinhole cameras, by a truncated signed distance field.

    Args:
        depths: Euclidean range per pixel [m], each ``(height, width)`` of its camera; inf, NaN or 0 where unknown.
        least_views: depth maps that must have seen a surface.
    """
    o3d = open3d()
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), config.voxel_m, BLOCK_VOXELS, BLOCKS
    )
    filled = False
    # Open3D looks for blocks along every so many-th row and column, and refuses a map that shows none
    touched = 4
    for depth, camera in zip(depths, cameras, strict=True):
        x, y = slopes_of(camera)
        z = np.where(np.isfinite(depth), depth, 0.0) / np.sqrt(1 + x**2 + y**2)  # along the optical axis
        z[(depth >= config.max_range_m) | ~_smooth(z, EDGE_TOLERANCE / camera.fx)] = 0.0
        if not (z[::touched, ::touched] > 0).any():
            continue
        image = o3d.t.geometry.Image(core.Tensor(np.ascontiguousarray(z, dtype=np.float32)))
        # The grid reads the pixel that a voxel's projection falls into: pixel centres at +0.5, as ours.
        lens = core.Tensor(lens_matrix(camera))
        pose = core.Tensor(np.array(camera.world_to_camera, dtype=np.float64))
        limits = (1.0, config.max_range_m, config.truncation_voxels)
        blocks = grid.compute_unique_block_coordinates(image, lens, pose, *limits)
        grid.integrate(blocks, image, lens, pose, *limits)
        filled = True
    raw = grid.extract_triangle_mesh(least_views - 0.5).to_legacy() if filled else None
    if raw is None or len(raw.triangles) == 0:
        raise ValueError("depths: no surface came out; are the maps ranges in metres and the poses right?")
    return _without_debris(np.asarray(raw.vertices), np.asarray(raw.triangles), config)


def _without_debris(vertices: np.ndarray, faces: np.ndarray, config: SurfaceConfig) -> Mesh:
    """The mesh without small pieces, in an order of its own, not in that in which threads found vertices and faces."""
    order = np.lexsort(vertices.T[::-1])
    faces = np.argsort(order)[faces]
    turn = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])].astype(np.int32)
    o3d = open3d()
    vectors = o3d.utility.Vector3dVector(vertices[order]), o3d.utility.Vector3iVector(faces)
    found = o3d.geometry.TriangleMesh(*vectors)
    found.merge_close_vertices(1e-4 * config.voxel_m)
    found.remove_degenerate_triangles()
    label, count, _ = found.cluster_connected_triangles()
    found.remove_triangles_by_mask(np.asarray(count)[np.asarray(label)] < config.min_component_faces)
    found.remove_unreferenced_vertices()
    if len(found.triangles) == 0:
        raise ValueError(f"min_component_faces: no connected piece has {config.min_component_faces} faces")
    return Mesh(np.asarray(found.vertices), np.asarray(found.triangles))


def _smooth(z: np.ndarray, tolerance: float) -> np.ndarray:
    """Pixels with a depth whose inverse is nearly linear towards both neighbours, along rows and columns."""
    known = z > 0
    inverse = np.where(known, 1 / np.where(known, z, 1.0), np.nan)
    fine = known.copy()
    with np.errstate(invalid="ignore"):
        fine[1:-1] &= ~(np.abs(np.diff(inverse, n=2, axis=0)) > tolerance * inverse[1:-1])
        fine[:, 1:-1] &= ~(np.abs(np.diff(inverse, n=2, axis=1)) > tolerance * inverse[:, 1:-1])
    return fine
