"""Lenses, and photos as an ideal pinhole camera would have taken them: undistorted, turned upright, reduced.

A lens bends directions before they meet the sensor: COLMAP's models (Schoenberger and Frahm, CVPR 2016, and COLMAP's
documentation) ``SIMPLE_RADIAL``, ``RADIAL``, ``OPENCV`` and ``OPENCV_FISHEYE``. Photos are resampled once, by COLMAP's own
undistorter, to the largest picture that has no blank pixels; everything after structure from motion sees these.

Where the model is not given, the simplest is taken whose bundle adjustment comes close to the richest's: more freedom always
fits a little better and, where photos do not fix it, bends the whole place.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import Count, check_array, checked, one_of, positive, within
from warprrf.device import require
from warprrf.geometry.photos.posed.photo_files import (
    mask_beside,
    mask_name,
    open_mask,
    open_photo,
    photo_facts,
)
from warprrf.geometry.splats.camera import Camera

COEFFICIENTS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 4,
    "FULL_OPENCV": 8,
}  # fmt: skip
"""COLMAP's lens models that are known here, and how many distortion coefficients each has."""


@checked
@dataclass(frozen=True)
class Lens:
    """A camera's lens and sensor, as COLMAP's models have it. Pixel centres lie at +0.5.

    Attributes:
        model: COLMAP's name of the model, one of :data:`COEFFICIENTS`.
        width, height: size of the photos as stored, before they are turned or reduced [pixels].
        fx, fy, cx, cy: focal lengths and principal point [pixels].
        coefficients: of the distortion: none; k1; k1, k2; k1, k2, p1, p2 (and k3 to k6); of the
            fisheye k1, k2, k3, k4.
    """

    model: Annotated[str, one_of(*COEFFICIENTS)]
    width: Count
    height: Count
    fx: Annotated[float, positive("focal length in pixels")]
    fy: Annotated[float, positive("focal length in pixels")]
    cx: Annotated[float, within()]
    cy: Annotated[float, within()]
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        found = check_array("coefficients", self.coefficients, (COEFFICIENTS[self.model],))
        object.__setattr__(self, "coefficients", tuple(float(c) for c in found))

    @property
    def straight(self) -> bool:
        """Whether photos need no undistorting."""
        return not any(self.coefficients)

    def resized(self, width: Count, height: Count) -> Lens:
        """The lens of photos of another size that show the same."""
        sx, sy = width / self.width, height / self.height
        fx, fy, cx, cy = self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def pinhole_of(lens: Lens, world_to_camera: ArrayLike, turns: int, max_pixels: int) -> Camera:
    """The pinhole camera of the undistorted, upright, reduced photo.

    Args:
        world_to_camera: pose of the photo as stored, shape ``(4, 4)``.
        turns: quarter turns clockwise that bring the stored photo upright.
        max_pixels: of the result, about; smaller photos keep their size.
    """
    flat = _undistorted(_reduced(lens, max_pixels))
    numbers = {name: getattr(flat, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    camera = Camera.pinhole(**numbers, world_to_camera=world_to_camera)
    quarter = np.eye(4)
    quarter[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    for _ in range(turns % 4):  # clockwise
        camera = Camera.pinhole(
            camera.height, camera.width, fx=camera.fy, fy=camera.fx, cx=camera.height - camera.cy, cy=camera.cx,
            world_to_camera=quarter @ camera.world_to_camera,
        )  # fmt: skip
    return camera


def stored_pixels(lens: Lens, slopes: np.ndarray, turns: int) -> np.ndarray:
    """Where a photo as stored shows directions of the upright camera, shape ``(N, 2)`` [pixels].

    Args:
        slopes: x / z and y / z of the directions, shape ``(N, 2)``.
        turns: as for :func:`pinhole_of`.
    """
    for _ in range(turns % 4):
        slopes = np.column_stack([slopes[:, 1], -slopes[:, 0]])
    if lens.straight:
        return slopes * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    rays = np.column_stack([slopes, np.ones(len(slopes))])
    return colmap_camera(lens).img_from_cam(rays)


def write_undistorted(source: Path, target: Path, lens: Lens, max_pixels: int) -> None:
    """``source`` as the camera of :func:`pinhole_of` shows it, written to ``target``, its mask beside it.

    A photo that needs nothing is copied as it is. A pixel of a mask counts as ignored if any part of it is.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    turns, mask, small = photo_facts(source).turns, mask_beside(source), _reduced(lens, max_pixels)
    if lens.straight and turns == 0 and small == lens:
        shutil.copyfile(source, target)
    else:
        straight = _resampled(open_photo(source, "RGB"), source, lens, small)
        finest = {"quality": 95, "subsampling": 0} if target.suffix.lower() in (".jpg", ".jpeg") else {}
        straight.rotate(-90 * turns, expand=True).save(target, **finest)
    if mask is not None:
        image = require("PIL.Image", extra="photos")
        stored = open_mask(mask).rotate(90 * turns, expand=True)  # a mask is upright, as its photo is seen
        counts = np.asarray(_resampled(stored, mask, lens, small)) > 254
        whole = image.fromarray(np.where(counts, 255, 0).astype(np.uint8))
        whole.rotate(-90 * turns, expand=True).save(mask_name(target))


def load_colmap() -> Any:
    """The package pycolmap. Pillow is loaded before it: the other way round its PNG files hang or crash the process."""
    if find_spec("pycolmap") is not None:
        require("PIL.Image", extra="photos")
    return require("pycolmap", extra="photos")


def colmap_camera(lens: Lens, number: int = 1) -> Any:
    """``lens`` as COLMAP's camera, in a model with two focal lengths, so that it scales without rounding."""
    colmap = load_colmap()
    model = lens.model if lens.model in ("OPENCV_FISHEYE", "FULL_OPENCV") else "OPENCV"
    params = _parameters(lens, model)
    return colmap.Camera(model=model, width=lens.width, height=lens.height, params=params, camera_id=number)


def _parameters(lens: Lens, kind: str) -> list[float]:
    """Numbers of ``lens`` as a lens model of COLMAP's that may have more freedom or less, ``kind``, orders them."""
    focal = [lens.fx] if kind in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else [lens.fx, lens.fy]
    return [*focal, lens.cx, lens.cy, *[*lens.coefficients, 0.0, 0.0, 0.0, 0.0][: COEFFICIENTS[kind]]]


def _reduced(lens: Lens, max_pixels: int) -> Lens:
    """``lens`` over fewer pixels, so that undistorted photos have ``max_pixels`` at most."""
    whole = _undistorted(lens)
    share = (max_pixels / (whole.width * whole.height)) ** 0.5
    if share >= 1:
        return lens
    return lens.resized(max(int(lens.width * share), 1), max(int(lens.height * share), 1))


def _undistorted(lens: Lens) -> Lens:
    if lens.straight:
        return lens
    colmap = load_colmap()
    found = colmap.undistort_camera(colmap.UndistortCameraOptions(), colmap_camera(lens))
    return Lens("PINHOLE", found.width, found.height, *found.params)


def _resampled(picture: Any, path: Path, lens: Lens, small: Lens) -> Any:
    """A Pillow image as stored, reduced to the size of ``small`` and undistorted."""
    if picture.size != (lens.width, lens.height):
        raise ValueError(
            f"photos: {path} is {picture.size[0]} x {picture.size[1]}, expected {lens.width} x {lens.height}"
        )
    if small != lens:  # reduced first, which averages; the undistorter alone would pick single pixels
        picture = picture.resize((small.width, small.height))
    if lens.straight:
        return picture
    colmap, image = load_colmap(), require("PIL.Image", extra="photos")
    bitmap = colmap.Bitmap.from_array(np.asarray(picture))
    flat, _ = colmap.undistort_image(colmap.UndistortCameraOptions(), bitmap, colmap_camera(small))
    return image.fromarray(flat.to_array().squeeze())


def lenses_in_use(lenses: Mapping[str, Lens]) -> dict[Lens, tuple[str, ...]]:
    """Each lens once, with the names of its photos."""
    found: dict[Lens, list[str]] = {}
    for name, lens in lenses.items():
        found.setdefault(lens, []).append(name)
    return {lens: tuple(names) for lens, names in found.items()}


FREE_MODEL = "SIMPLE_RADIAL"  # of the mapping where it is free: one coefficient, which a few photos fix
CANDIDATES = (("SIMPLE_PINHOLE", False), ("SIMPLE_RADIAL", False), ("RADIAL", True), ("OPENCV", True))
"""Models tried, the simplest first, and whether the principal point is estimated with them."""


def choose_lens(model: Path, lens: str) -> Any:
    """The COLMAP model in the folder ``model``, adjusted with the lens that its photos need.

    Args:
        lens: COLMAP's name of a lens model, which is kept (the principal point alone is tried); or ``"auto"``.
    """
    tried: Sequence[tuple[str, bool]] = CANDIDATES if lens == "auto" else ((lens, False), (lens, True))
    *simpler, richest = tried
    best = _adjusted(model, *richest)
    worth = 0.01  # of the reprojection error: on photos without distortion the richest model gains 0.0001
    enough = (1 + worth) * best.compute_mean_reprojection_error()
    for kind, principal_point in simpler:
        found = _adjusted(model, kind, principal_point)
        if found.compute_mean_reprojection_error() <= enough:
            return found
    return best


def lens_of(camera: Any) -> Lens:
    """A COLMAP camera's lens."""
    kind = camera.model.name
    if kind not in COEFFICIENTS:
        raise ValueError(
            f"colmap: camera {camera.camera_id} is a {kind}, expected one of {', '.join(COEFFICIENTS)}; undistort the "
            "photos first (COLMAP's image_undistorter writes a pinhole model)"
        )
    k = camera.calibration_matrix()
    bends = tuple(float(camera.params[i]) for i in camera.extra_params_idxs())
    return Lens(kind, camera.width, camera.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], bends)


def _adjusted(model: Path, kind: str, principal_point: bool) -> Any:
    """The model after a bundle adjustment with lenses of ``kind``."""
    colmap = load_colmap()
    found = colmap.Reconstruction(str(model))
    for camera in found.cameras.values():
        lens = lens_of(camera)
        camera.model = getattr(colmap.CameraModelId, kind)
        camera.params = np.array(_parameters(lens, kind))
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
