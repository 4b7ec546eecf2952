"""Which lens model photos need: the simplest whose bundle adjustment comes close to the richest's.

More freedom always fits a little better and, where photos do not fix it, bends the whole place. A richer model is taken
only where it lowers the mean reprojection error by a share that the noise of features does not explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from warprrf.geometry.photos.undistort import COEFFICIENTS, Lens

FREE_MODEL = (
    "SIMPLE_RADIAL"  # of the mapping, where the model is free: one coefficient, which a few photos fix
)
CANDIDATES = (("SIMPLE_PINHOLE", False), ("SIMPLE_RADIAL", False), ("RADIAL", True), ("OPENCV", True))
"""Models tried, the simplest first, and whether the principal point is estimated with them."""

WORTH = 0.01  # of the reprojection error: on photos without distortion the richest model gains 0.0001


def choose_lens(colmap: ModuleType, model: Path, lens: str) -> Any:
    """The COLMAP model in the folder ``model``, adjusted with the lens that its photos need.

    Args:
        lens: COLMAP's name of a lens model, which is kept (the principal point alone is tried); or ``"auto"``.
    """
    tried: Sequence[tuple[str, bool]] = CANDIDATES if lens == "auto" else ((lens, False), (lens, True))
    *simpler, richest = tried
    best = _adjusted(colmap, model, *richest)
    enough = (1 + WORTH) * best.compute_mean_reprojection_error()
    for kind, principal_point in simpler:
        found = _adjusted(colmap, model, kind, principal_point)
        if found.compute_mean_reprojection_error() <= enough:
            return found
    return best


def lens_of(camera: Any) -> Lens:
    """A COLMAP camera's lens.

    Raises:
        ValueError: for a model that is not known here.
    """
    kind = camera.model.name
    if kind not in COEFFICIENTS:
        raise ValueError(
            f"colmap: camera {camera.camera_id} is a {kind}, expected one of {', '.join(COEFFICIENTS)}; undistort the "
            "photos first (COLMAP's image_undistorter writes a pinhole model)"
        )
    k = camera.calibration_matrix()
    bends = tuple(float(camera.params[i]) for i in camera.extra_params_idxs())
    return Lens(kind, camera.width, camera.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], bends)


def _adjusted(colmap: ModuleType, model: Path, kind: str, principal_point: bool) -> Any:
    """The model after a bundle adjustment with lenses of ``kind``."""
    found = colmap.Reconstruction(str(model))
    for camera in found.cameras.values():
        lens = lens_of(camera)
        focal = [lens.fx] if kind in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else [lens.fx, lens.fy]
        bends = [*lens.coefficients, 0.0, 0.0, 0.0, 0.0][: COEFFICIENTS[kind]]
        camera.model = getattr(colmap.CameraModelId, kind)
        camera.params = np.array([*focal, lens.cx, lens.cy, *bends])
    options = colmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = principal_point
    options.ceres.solver_options.num_threads = 1  # sums in a fixed order
    everything = colmap.BundleAdjustmentConfig()
    for key, image in found.images.items():
        if image.has_pose:
            everything.add_image(key)
    everything.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    colmap.create_default_bundle_adjuster(options, everything, found).solve()
    found.update_point_3d_errors()
    return found
