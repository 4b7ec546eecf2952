"""Settings of stage 1. Lengths in metres; the defaults suit a furnished room that 50 to 150 photos show."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from warprrf.checks import Count, Seed, checked, one_of, whole
from warprrf.geometry.planes import PlaneConfig
from warprrf.geometry.scans import SurfaceConfig

LENSES = ("auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
"""COLMAP's lens models that photos can be taken through; "auto": the simplest that explains them."""


@checked
@dataclass(frozen=True)
class RefineConfig:
    """Settings of :func:`warprrf.geometry.photos.gaussians.refine.refine`; for about 100 photos on two CPU cores.

    Attributes:
        iterations: steps, one photo each.
        downscale: photos are averaged over squares of this many pixels while training, at the last over none.
        fit_exposure: whether every photo has a gain for each colour of its own.
        mean_rate: metres a step at the start.
        densify_from, densify_every: in iterations.
        max_gaussians: densification stops here.
        max_scale_m: larger ones are removed ("abnormally large"; the paper's centre approximation relies on it).
        thickness_m: upper bound of the smallest scale.
        checkpoint_every: iterations.
        seed: of the order of photos and of where clones go.
    """

    iterations: Count = 2400
    downscale: Count = 2
    fit_exposure: bool = True
    mean_rate: float = 4e-4
    densify_from: int = 300
    densify_every: Count = 200
    max_gaussians: Count = 60_000
    max_scale_m: float = 0.3
    thickness_m: float = 0.004
    checkpoint_every: Count = 300
    seed: Seed = 0


@checked
@dataclass(frozen=True)
class ReconstructionConfig:
    """Settings of :func:`warprrf.reconstruct`.

    Attributes:
        max_features: SIFT features kept per photo (the largest ones), 100 at least.
        lens: COLMAP's model of the lenses, one of :data:`LENSES`; ``"auto"`` takes the simplest of pinhole,
            ``"SIMPLE_RADIAL"``, ``"RADIAL"`` and ``"OPENCV"`` that explains the photos. A fisheye has to be named.
        max_pixels: undistorted photos are reduced to about so many pixels, 10,000 at least.
        planes: how planes are found among sparse points.
        sweep: whether planes are corrected and completed by comparing the photos; level ones are sought where the scale is known.
        plain: whether surfaces without features are found from their edges.
        gaussians: Gaussians to start the refinement from (about).
        refine: photometric refinement.
        stereo: whether depth maps are mended by comparing the photos, and emptied where neither photos nor planes hold them.
        segments: whether they are then made flat where one colour shows one surface. Measured depth is taken as it is.
        surface: from Gaussians to a mesh.
        completion: whether holes are closed and borders straightened where the planes allow it.
    """

    max_features: Annotated[int, whole(100)] = 2400
    lens: Annotated[str, one_of(*LENSES)] = "auto"
    max_pixels: Annotated[int, whole(10_000)] = 1_000_000
    planes: PlaneConfig = field(default_factory=PlaneConfig)
    sweep: bool = True
    plain: bool = True
    gaussians: int = 32_000
    refine: RefineConfig = field(default_factory=RefineConfig)
    stereo: bool = True
    segments: bool = True
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    completion: bool = True
