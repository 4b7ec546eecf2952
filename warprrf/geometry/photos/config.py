"""Settings of stage 1."""

from __future__ import annotations

from dataclasses import dataclass, field

from warprrf.geometry.photos.refine import RefineConfig


@dataclass(frozen=True)
class ReconstructionConfig:
    """Settings of :func:`warprrf.reconstruct`.

    Attributes:
        max_features: SIFT features per photo.
        pairs: which photos are matched, ``"auto"`` or ``"exhaustive"``.
        max_reprojection_error: sparse points above it are dropped [pixels].
        plane_distance_m: band of the plane detection.
        plane_points: fewest sparse points of a plane.
        cell_m: side of a plane's cells.
        sweep: correct and complete the planes by comparing the photos (see :mod:`warprrf.geometry.photos.sweep`).
        gaussians: Gaussians to start the refinement from (about).
        refine: settings of the photometric refinement.
        depth_downscale: depth maps are rendered at the photos' size divided by this.
        depth_views: at most so many depth maps are fused, spread over all cameras.
        alpha: a depth counts where at least so much light is blocked.
        depth_spread: and where the blended depth and that of the dominant Gaussian differ by no more than this part.
        voxel_m: side of a voxel of the fusion.
        patch_distance_m: a face this close to a plane can belong to its patch.
        min_patch_m2: smallest planar patch.
        complete: close holes and straighten borders where the planes allow it (see
            :mod:`warprrf.geometry.photos.completion`).
        complete_cell_m: largest side of the boxes that space is divided into for that.
    """

    max_features: int = 2400
    pairs: str = "auto"
    max_reprojection_error: float = 1.0
    plane_distance_m: float = 0.015
    plane_points: int = 40
    cell_m: float = 0.1
    sweep: bool = True
    gaussians: int = 32_000
    refine: RefineConfig = field(default_factory=RefineConfig)
    depth_downscale: int = 2
    depth_views: int = 120
    alpha: float = 0.6
    depth_spread: float = 0.05
    voxel_m: float = 0.05
    patch_distance_m: float = 0.06
    min_patch_m2: float = 0.15
    complete: bool = True
    complete_cell_m: float = 0.1
