"""Settings of stage 1. Lengths in metres; the defaults suit a furnished room that 50 to 150 photos show."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from warprrf.checks import check_count, check_positive, check_seed
from warprrf.kernels.raster.sh import COEFFICIENTS

LENSES = ("auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
"""COLMAP's lens models that photos can be taken through; "auto": the simplest that explains them."""


@dataclass(frozen=True)
class PlaneConfig:
    """How planes are found among points, and which of their cells hold a surface.

    Attributes:
        distance_m: a point this close is on the plane; three times the noise of sparse points in a room.
        angle_deg: and its normal differs by no more than this: normals of sparse points are good to 10 degrees or so.
        min_points: fewest points of a plane (or the least weight, where points are weighted).
        small_points: fewest of a small plane, looked for among the points that the large ones leave.
        max_planes: stop after so many.
        hypotheses: points tried as centres of planes in each round.
        scored_points: points that a hypothesis is scored on.
        refined: hypotheses of a round that are refined before the best is chosen.
        echo_m, echo_cell_m: a parallel plane this close is the noise of a better one where both have points in the
            same cells of the second size.
        cell_m: side of a plane's cells.
        margin_m: cells reach so far beyond the hull of a plane's points.
        behind_m: a line of sight empties a cell when its target is more than this behind the plane.
        contested_m: of parallel planes closer than this, such as a sign and its wall, only one has a cell.
    """

    distance_m: float = 0.015
    angle_deg: float = 30.0
    min_points: float = 40
    small_points: int = 16
    max_planes: int = 80
    hypotheses: int = 192
    scored_points: int = 6000
    refined: int = 12
    echo_m: float = 0.1
    echo_cell_m: float = 0.3
    cell_m: float = 0.1
    margin_m: float = 0.12
    behind_m: float = 0.1
    contested_m: float = 0.25

    def __post_init__(self) -> None:
        check_positive("distance_m", self.distance_m, "length in metres")

    @property
    def cosine(self) -> float:
        """Of ``angle_deg``."""
        return float(np.cos(np.radians(self.angle_deg)))


@dataclass(frozen=True)
class SweepConfig:
    """How photos are compared to extend, cut and find planes (see :mod:`warprrf.geometry.photos.sweep`).

    Attributes:
        views: photos compared.
        min_angle_deg: between any two of them, seen from the patch: without parallax every height fits.
        patch_m: side of a patch.
        agrees, disagrees: mean correlation of a true patch, and of one that is certainly not.
        contrast: patches flatter than this part of white prove nothing.
        step_m: between heights of the sweep; a patch of ``patch_m`` shows a shift of that much.
        reach_m: a large plane is extended at most so far.
        large_m2: area of a large plane.
        contested_m: of parallel planes closer than this only one has a cell.
        min_cells: fewest cells of a plane found by the sweep.
        same_plane_m: a piece this close to a known plane belongs to it.
        up_m2, down_m2: least area of a new plane that faces up, or down.
    """

    views: int = 5
    min_angle_deg: float = 6.0
    patch_m: float = 0.12
    agrees: float = 0.6
    disagrees: float = 0.25
    contrast: float = 0.012
    step_m: float = 0.03
    reach_m: float = 2.5
    large_m2: float = 3.0
    contested_m: float = 0.25
    min_cells: int = 15
    same_plane_m: float = 0.008
    up_m2: float = 0.3
    down_m2: float = 2.0


@dataclass(frozen=True)
class PlainConfig:
    """How surfaces without features are found from their edges (see :mod:`warprrf.geometry.photos.plain`).

    Attributes:
        blur_px: photos are smoothed by so much before they are differentiated.
        edge: an edge changes some colour by this part of white per pixel.
        edge_deg: its direction in the photo is good to this.
        segment_px, gap_px: shortest segment, and longest gap in one.
        side_px, alike: colours so far on either side of an edge are one surface's when they differ by no more than this.
        meeting_deg: two bearings that differ by less meet nowhere for sure.
        line_views: fewest photos that show an edge; from ``sure_views`` on it counts, when it is ``line_m`` long.
        line_m, sure_views: see above.
        plain, plain_px: a pixel is plain where no pixel in a square of this side changes by more than this.
        shown_share: where so much of an edge shows in a photo, all of it parts regions.
        least_share: photos with fewer plain pixels than this share, in a dozen of them, show no plain surface.
        region_px: fewest pixels of a plain region.
        votes_px: fewest pixels of its border on a plane.
        same_m: an edge this close to a plane lies on it.
        rival: of the planes with at least this share of the most votes, the nearest has the region.
        behind_m: an edge, or a surface, this far behind a plane is behind it.
        stride: cells look up every so many-th pixel.
        cell_m: side of a plane's cells.
        agreeing: fewest photos that put a cell on its plane; more than those that see through it.
        piece_m2: smallest piece of a plane.
        mirror_share: a pane is a mirror when so much of what is seen through it alone has its twin before it, by length
            times views, which must come to ``mirror_m`` [m].
    """

    blur_px: float = 1.5
    edge: float = 0.009
    edge_deg: float = 6.0
    segment_px: float = 24.0
    gap_px: float = 6.0
    side_px: float = 4.0
    alike: float = 0.08
    meeting_deg: float = 3.0
    line_views: int = 3
    line_m: float = 0.4
    sure_views: int = 4
    plain: float = 0.006
    plain_px: int = 7
    shown_share: float = 0.15
    least_share: float = 0.12
    region_px: int = 150
    votes_px: float = 25.0
    same_m: float = 0.04
    rival: float = 0.8
    behind_m: float = 0.15
    stride: int = 4
    cell_m: float = 0.1
    agreeing: int = 2
    piece_m2: float = 0.1
    mirror_share: float = 0.5
    mirror_m: float = 10.0


@dataclass(frozen=True)
class RefineConfig:
    """Settings of :func:`warprrf.geometry.photos.refine.refine`; for about 100 photos on two CPU cores.

    Loss and rates are those of Kerbl et al., "3D Gaussian Splatting", 2023, but for what is said here.

    Attributes:
        iterations: steps, one photo each.
        downscale: photos are averaged over squares of this many pixels while training.
        coarse_pixels, fine_from: until this share of the iterations squares are twice as wide, and twice again, as long
            as photos would have more pixels than this.
        full_from, full_pixels: share of the iterations after which photos are taken as they are; fewer iterations are if
            photos have more pixels than this, so that they take as long.
        sh_degree: of the colours; rendered rooms are nearly matt, so 1.
        ssim_share: weight of 1 - SSIM; L1 has the rest.
        fit_exposure: whether every photo has a gain for each colour of its own.
        mean_rate, final_mean_rate: metres a step at the start and the end, exponential in between.
        scale_rate, quaternion_rate, opacity_rate, color_rate: of the logarithms of scales, quaternions, logits of
            opacities, and constant colours; other coefficients take a twentieth.
        densify_from, densify_until, densify_every: in iterations; ``until`` as a share of all.
        densify_share: at most this share of the Gaussians is split or cloned at a time, those with the largest mean
            gradient of the projected position.
        densify_to: and more than that, up to half of them, where otherwise fewer than these would be there in the end.
        max_gaussians: densification stops here.
        split_above_m: larger ones are split, smaller ones cloned.
        prune_opacity: fainter ones are removed.
        max_scale_m: larger ones are removed ("abnormally large"; the paper's centre approximation relies on it).
        thickness_m: upper bound of the smallest scale.
        plane_distance_m, plane_angle_rad: a Gaussian this close to a plane belongs to it.
        plane_strength: share of the deviation from its plane removed after every step.
        checkpoint_every: iterations.
        seed: of the order of photos and of where clones go.
    """

    iterations: int = 2400
    downscale: int = 2
    coarse_pixels: int = 100_000
    fine_from: float = 0.8
    full_from: float = 0.9
    full_pixels: int = 400_000
    sh_degree: int = 1
    ssim_share: float = 0.2
    fit_exposure: bool = True
    mean_rate: float = 4e-4
    final_mean_rate: float = 4e-5
    scale_rate: float = 5e-3
    quaternion_rate: float = 2e-3
    opacity_rate: float = 3e-2
    color_rate: float = 5e-3
    densify_from: int = 300
    densify_until: float = 0.65
    densify_every: int = 200
    densify_share: float = 0.08
    densify_to: int = 30_000
    max_gaussians: int = 60_000
    split_above_m: float = 0.03
    prune_opacity: float = 0.02
    max_scale_m: float = 0.3
    thickness_m: float = 0.004
    plane_distance_m: float = 0.04
    plane_angle_rad: float = 0.6
    plane_strength: float = 0.1
    checkpoint_every: int = 300
    seed: int = 0

    def __post_init__(self) -> None:
        for name in (
            "iterations",
            "downscale",
            "coarse_pixels",
            "densify_every",
            "max_gaussians",
            "checkpoint_every",
        ):
            check_count(name, getattr(self, name))
        check_seed(self.seed)
        if self.sh_degree not in COEFFICIENTS:
            raise ValueError(f"sh_degree: got {self.sh_degree!r}, expected 0, 1, 2 or 3")


@dataclass(frozen=True)
class SurfaceConfig:
    """How Gaussians become a mesh with planar patches.

    Attributes:
        downscale: depth maps are rendered at the photos' size divided by this.
        views: at most so many depth maps are fused, spread over all cameras.
        alpha: a depth counts where at least so much light is blocked.
        depth_spread: and where the blended depth and that of the dominant Gaussian differ by no more than this part.
        voxel_m: largest side of a voxel of the fusion.
        voxel_pixels: and how wide it is, in pixels of the depth maps, at their median range.
        truncation_voxels: the distance field is truncated at so many voxels.
        max_range_m: depths beyond this are left out.
        edge_tolerance: a pixel is left out where inverse depth bends by more than this part of itself, per focal length
            in pixels: on a plane it is linear in the image, in a corner it bends, across an occluding edge it jumps.
        min_views: a surface is kept where at least this many depth maps saw it.
        min_component_faces: connected pieces with fewer faces are dropped as floating debris.
        patch_distance_m: a face this close to a plane can belong to its patch: a depth map's error.
        patch_angle_deg: and its smoothed normal differs by no more than this.
        min_patch_m2: smallest planar patch.
        simplify_m: flat parts are made of faces of about this size in the end.
    """

    downscale: int = 2
    views: int = 120
    alpha: float = 0.6
    depth_spread: float = 0.05
    voxel_m: float = 0.05
    voxel_pixels: float = 4.0
    truncation_voxels: float = 4.0
    max_range_m: float = 12.0
    edge_tolerance: float = 8.0
    min_views: int = 2
    min_component_faces: int = 200
    patch_distance_m: float = 0.06
    patch_angle_deg: float = 35.0
    min_patch_m2: float = 0.15
    simplify_m: float = 0.25

    def __post_init__(self) -> None:
        check_positive("voxel_m", self.voxel_m, "length in metres")


@dataclass(frozen=True)
class StereoConfig:
    """How photos mend depth maps (see :mod:`warprrf.geometry.photos.stereo`). Costs are one minus a correlation.

    Attributes:
        downscale: photos are compared at the depth maps' size divided by this.
        sources: photos that one is compared with.
        turns: how often planes are handed on between pixels.
        settled: a depth of less cost stays as it is.
        proved: depths of more cost prove nothing.
        gain: a new depth has to cost less than the old one by this much.
        checked: maps of other photos that a depth is checked against.
        agreed: so many of them must confirm a new depth, or see through an old one.
        tolerance: up to this part of the range two depths agree.
    """

    downscale: int = 2
    sources: int = 3
    turns: int = 2
    settled: float = 0.2
    proved: float = 0.6
    gain: float = 0.05
    checked: int = 8
    agreed: int = 2
    tolerance: float = 0.02

    def __post_init__(self) -> None:
        for name in ("downscale", "sources", "turns", "checked", "agreed"):
            check_count(name, getattr(self, name))


@dataclass(frozen=True)
class CompletionConfig:
    """How a mesh is made whole (see :mod:`warprrf.geometry.photos.completion`). Votes count lines of sight.

    Attributes:
        cell_m: largest side of a box.
        margin_m: space kept around the mesh.
        aligned_deg: a plane this parallel to one of three perpendicular directions counts as parallel.
        exact_deg, strong_m2: one this parallel, with a proven area above the second, keeps its own tilt (0.1 degrees
            are 2 cm over 12 m): it is fitted better than the directions are.
        least_share: of the mesh that has to lie on such planes; else it is no place of boxes.
        same_side_m: planes facing one way and closer than this are two fits of one surface.
        board_m: planes facing opposite ways can be closer, down to this: the two faces of a board.
        gather_m2, gather_m: so much area of left-over faces within so much height makes one more plane.
        reach_m: a face this close to a part of a plane that the photos proved belongs to it.
        stride: every so many-th row and column of the depth maps is used.
        snap_m: a depth agrees with the mesh when both are this close.
        shy_m: a line of sight proves nothing this close to an end that lies on no plane.
        step_m: spacing of samples along lines of sight.
        beside_m: a hit votes for the boxes this far before and behind its plane: within the thinnest board.
        sure_votes: votes that make half a certainty.
        prior: votes by which a box that nobody saw leans to solid.
        leak: share of the lines of sight that go astray: so many votes of a neighbour count for nothing.
        behind: votes that a hit on a plane is worth: far more certain than a line of sight through a box.
        trust: cost of a box that goes against all its votes, per square metre of its sides.
        known: cost of a square metre of surface on a known plane; one where no plane is known costs 1.
        rim_m, rim_share: a side is closed when planes this near to it cover so much of it.
        seen_piece, least_seen: a flat piece of surface is seen when hits lie on so much of it, and at least so much of
            all the surface must be; else the photos cover too little of the place for the rest to be inferred.
        keep_m, keep_m2: pieces of the old mesh this far from every known plane, and this large, are kept.
    """

    cell_m: float = 0.1
    margin_m: float = 0.3
    aligned_deg: float = 4.0
    exact_deg: float = 0.1
    strong_m2: float = 2.0
    least_share: float = 0.5
    same_side_m: float = 0.035
    board_m: float = 0.012
    gather_m2: float = 0.08
    gather_m: float = 0.03
    reach_m: float = 0.12
    stride: int = 5
    snap_m: float = 0.12
    shy_m: float = 0.1
    step_m: float = 0.06
    beside_m: float = 0.006
    sure_votes: float = 10.0
    prior: float = 0.3
    leak: float = 0.05
    behind: float = 2.0
    trust: float = 0.6
    known: float = 0.4
    rim_m: float = 0.6
    rim_share: float = 0.25
    seen_piece: float = 0.1
    least_seen: float = 0.7
    keep_m: float = 0.12
    keep_m2: float = 0.3


@dataclass(frozen=True)
class ReconstructionConfig:
    """Settings of :func:`warprrf.reconstruct`.

    Attributes:
        max_features: SIFT features kept per photo (the largest ones).
        lens: COLMAP's model of the lenses, one of :data:`LENSES`; ``"auto"`` takes the simplest of pinhole,
            ``"SIMPLE_RADIAL"``, ``"RADIAL"`` and ``"OPENCV"`` that explains the photos. A fisheye has to be named.
        max_pixels: undistorted photos are reduced to about so many pixels.
        pairs: ``"exhaustive"`` matches every pair of photos; ``"auto"`` only those that a coarse comparison of their
            largest features finds promising, once there are more than 2000 pairs.
        max_reprojection_error: sparse points above it are dropped [pixels].
        planes: how planes are found among sparse points.
        sweep: how planes are corrected and completed by comparing the photos; None: not at all.
        plain: how surfaces without features are found from their edges; None: not at all.
        gaussians: Gaussians to start the refinement from (about).
        refine: photometric refinement.
        stereo: how depth maps are mended by comparing the photos; None: not at all.
        surface: from Gaussians to a mesh.
        completion: how holes are closed and borders straightened where the planes allow it; None: not at all.
    """

    max_features: int = 2400
    lens: str = "auto"
    max_pixels: int = 1_000_000
    pairs: str = "auto"
    max_reprojection_error: float = 1.0
    planes: PlaneConfig = field(default_factory=PlaneConfig)
    sweep: SweepConfig | None = field(default_factory=SweepConfig)
    plain: PlainConfig | None = field(default_factory=PlainConfig)
    gaussians: int = 32_000
    refine: RefineConfig = field(default_factory=RefineConfig)
    stereo: StereoConfig | None = field(default_factory=StereoConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    completion: CompletionConfig | None = field(default_factory=CompletionConfig)
