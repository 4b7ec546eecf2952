"""From Gaussians to a surface: depth maps rendered at cameras, fused to a mesh, flattened onto planes, made whole."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos import surface
from warprrf.geometry.photos.completion import complete
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.planes import Plane
from warprrf.geometry.photos.surface import PlanarPatch
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.render import render


def fuse_gaussians(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    planes: Sequence[Plane] = (),
    config: ReconstructionConfig | None = None,
    progress: Progress | None = None,
    device: Any = None,
) -> tuple[Mesh, list[PlanarPatch]]:
    """Mesh of Gaussians from depth maps rendered at ``cameras``, and its planar patches; planes known beforehand are
    what the mesh snaps to first."""
    config = config or ReconstructionConfig()
    report = progress or (lambda stage, done, total: None)
    small, depths = _depth_maps(gaussians, cameras, config, report, device)
    report("surface", 0, 4)
    mesh = surface.fuse_depth(depths, small, voxel_m=config.voxel_m)
    report("surface", 1, 4)
    patches = surface.planar_patches(
        mesh, planes=planes, distance_m=config.patch_distance_m, min_area_m2=config.min_patch_m2
    )
    flat = surface.flatten(mesh, patches)
    report("surface", 2, 4)
    result = surface.simplify(flat, patches)
    report("surface", 3, 4)
    if config.complete:
        result = _complete(*result, small, depths, planes, config)
    report("surface", 4, 4)
    return result


def complete_seen(
    mesh: Mesh,
    patches: Sequence[PlanarPatch],
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    planes: Sequence[Plane] = (),
    config: ReconstructionConfig | None = None,
    progress: Progress | None = None,
    device: Any = None,
) -> tuple[Mesh, list[PlanarPatch]]:
    """``mesh`` and its patches made whole by depth maps of ``gaussians`` at ``cameras``."""
    config = config or ReconstructionConfig()
    report = progress or (lambda stage, done, total: None)
    small, depths = _depth_maps(gaussians, cameras, config, report, device)
    return _complete(mesh, patches, small, depths, planes, config)


def _complete(
    mesh: Mesh,
    patches: Sequence[PlanarPatch],
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    planes: Sequence[Plane],
    config: ReconstructionConfig,
) -> tuple[Mesh, list[PlanarPatch]]:
    return complete(
        mesh, patches, cameras, depths, planes=planes,
        cell_m=config.complete_cell_m, min_patch_m2=config.min_patch_m2,
    )  # fmt: skip


def _depth_maps(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    config: ReconstructionConfig,
    report: Progress,
    device: Any,
) -> tuple[list[Camera], list[np.ndarray]]:
    """Smaller cameras spread over all ``cameras``, and their depths, 0 where no Gaussian is reliable."""
    chosen = list(cameras)
    if len(chosen) > config.depth_views:
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, config.depth_views).round().astype(int)]
    small, depths = [], []
    for k, camera in enumerate(chosen):
        report("depth", k, len(chosen))
        view = camera.resized(
            max(1, camera.width // config.depth_downscale), max(1, camera.height // config.depth_downscale)
        )
        out = render(gaussians, view, features=np.zeros((len(gaussians), 1), dtype=np.float32), device=device)
        with np.errstate(invalid="ignore"):
            solid = (out.alpha >= config.alpha) & (
                np.abs(out.depth - out.peak) <= config.depth_spread * out.peak
            )
        depths.append(np.where(solid, out.depth, 0.0))
        small.append(view)
    report("depth", len(chosen), len(chosen))
    return small, depths
