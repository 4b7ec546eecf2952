"""Photographs of a scene: Mitsuba's path tracer behind pinhole cameras. The one module that renders with Mitsuba.

A Mitsuba camera looks along +z with x to the left and y up, an OpenCV camera along +z with x to the right and y down:
R_c2w(Mitsuba) = R_c2w(OpenCV) diag(-1, -1, 1). Pixel centres lie at +0.5 in both. Exposure and tone curve are fixed,
so that a surface has the same colour in every photo. A few paths a pixel are enough: the illumination is denoised.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import Progress, require
from warprrf.files import write_atomically
from warprrf.geometry.splats.camera import Camera
from warprrf.rf.scene_sionna import select_llvm

VARIANT = "llvm_ad_rgb"
SIONNA_VARIANT = (
    "llvm_ad_mono_polarized"  # Sionna RT registers its plugins with the variant it is imported in
)
JPEG_QUALITY = 90
PANE_SAMPLES = 4  # times as many paths a pixel where a pane mirrors the room: grain as of a sensor is left


@contextmanager
def _mitsuba(variant: str) -> Iterator[Any]:
    """Mitsuba in ``variant``; afterwards in what was set before, or in what Sionna RT has to be imported in."""
    select_llvm()
    mi = require("mitsuba", extra="sionna")
    before = mi.variant()
    if variant not in mi.variants():
        raise ValueError(f"variant: this Mitsuba lacks {variant!r}; it has {', '.join(mi.variants())}")
    mi.set_variant(variant)
    try:
        yield mi
    finally:
        mi.set_variant(before or SIONNA_VARIANT)


def _sensor(mi: Any, camera: Camera, spp: int) -> Any:
    if camera.kind != "pinhole" or not np.isclose(camera.fx, camera.fy):
        raise ValueError("cameras: expected pinhole cameras with fx = fy")
    if not (np.isclose(camera.cx, camera.width / 2) and np.isclose(camera.cy, camera.height / 2)):
        raise ValueError(
            f"cameras: got a principal point ({camera.cx}, {camera.cy}), expected the image's centre"
        )
    pose = np.linalg.inv(camera.world_to_camera)
    pose[:3, :3] = pose[:3, :3] @ np.diag([-1.0, -1.0, 1.0])
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))),
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 1000.0,
            "to_world": mi.ScalarTransform4f(pose),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "rgb",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter", "sample_count": spp},
        }
    )


def tone_map(radiance: np.ndarray, exposure: float = 1.5) -> np.ndarray:
    """Linear radiance to sRGB in [0, 1]: y = 1.3 e L / (1 + e L), then the sRGB curve.

    The curve keeps a luminous ceiling from clipping where walls are well exposed.
    """
    exposed = exposure * np.maximum(radiance, 0)
    y = np.clip(1.3 * exposed / (1 + exposed), 0, 1)
    return np.where(y <= 0.0031308, 12.92 * y, 1.055 * np.maximum(y, 1e-9) ** (1 / 2.4) - 0.055)


def render_positions(xml: str | os.PathLike[str], camera: Camera, *, spp: int = 4) -> np.ndarray:
    """Mean surface point that each pixel sees in Mitsuba [m], shape ``(height, width, 3)``; proves a pose."""
    with _mitsuba(VARIANT) as mi:
        return _layers(mi, mi.load_file(str(xml)), camera, "position:position", None, spp, 0)


def _layers(mi: Any, scene: Any, camera: Camera, names: str, inner: Any, spp: int, seed: int) -> np.ndarray:
    integrator: dict[str, Any] = {"type": "aov", "aovs": names}
    if inner is not None:
        integrator["inner"] = inner
    image = mi.render(
        scene, sensor=_sensor(mi, camera, spp), integrator=mi.load_dict(integrator), spp=spp, seed=seed
    )
    return np.array(image, dtype=np.float32)


def _radiance(mi: Any, scene: Any, camera: Camera, spp: int, seed: int, max_depth: int) -> np.ndarray:
    """Radiance of a view: illumination from ``spp`` paths a pixel, denoised; texture from four times as many rays."""
    guides = "albedo:albedo,normal:sh_normal,position:position"
    path = {"type": "path", "max_depth": max_depth}
    noisy = _layers(mi, scene, camera, guides, path, spp, seed)
    texture = _layers(mi, scene, camera, "albedo:albedo", None, 4 * spp, seed)[..., -3:]
    image = denoise(noisy[..., :3], noisy[..., -9:-6], noisy[..., -6:-3], noisy[..., -3:], texture)
    pane = _mirrors(mi, scene, camera)
    if pane.any():  # what a pane mirrors would be smoothed away
        image[pane] = _layers(mi, scene, camera, "position:position", path, PANE_SAMPLES * spp, seed)[
            pane, :3
        ]
    return image


def _mirrors(mi: Any, scene: Any, camera: Camera) -> np.ndarray:
    """Which pixels show a surface with a mirror reflection, shape ``(height, width)``, bool."""
    directions = camera.directions().reshape(-1, 3)
    origin = mi.Point3f(*(float(x) for x in camera.position))
    hit = scene.ray_intersect(
        mi.Ray3f(origin, mi.Vector3f(np.ascontiguousarray(directions.T, dtype=np.float32)))
    )
    smooth = mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.DeltaReflection) & hit.is_valid()
    return np.asarray(smooth, dtype=bool).reshape(camera.height, camera.width)


def denoise(
    radiance: np.ndarray,
    albedo: np.ndarray,
    normal: np.ndarray,
    position: np.ndarray,
    texture: np.ndarray | None = None,
    *,
    levels: int = 4,
) -> np.ndarray:
    """Smooth the illumination (radiance over albedo) within each plane of the picture; textures stay as they are.

    An edge-avoiding a-trous filter (Dammertz et al. 2010): 5 x 5 taps, spacing doubled ``levels`` - 1 times, taken
    where the normal agrees and the point lies in the pixel's own tangent plane.

    Args:
        radiance, albedo, normal, position: of every pixel, each ``(height, width, 3)``; position in metres.
        texture: a better sampled albedo for the result, same shape; default ``albedo``.
    """
    smallest = 0.02  # albedo below this is not divided out
    normal = normal / np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-6)
    light = radiance / np.maximum(albedo, smallest)
    taps = np.array([1, 4, 6, 4, 1], dtype=np.float32) / 16
    height, width = light.shape[:2]
    for level in range(levels):
        step = 2**level
        pad = [(2 * step, 2 * step), (2 * step, 2 * step), (0, 0)]
        lights, normals, positions = (np.pad(x, pad, mode="edge") for x in (light, normal, position))
        total, weights = np.zeros_like(light), np.zeros((height, width, 1), dtype=np.float32)
        for i in range(5):
            for j in range(5):
                window = np.s_[i * step : i * step + height, j * step : j * step + width]
                alike = np.einsum("hwc,hwc->hw", normal, normals[window]) > 0.95
                alike &= np.abs(np.einsum("hwc,hwc->hw", normal, positions[window] - position)) < 0.02  # m
                if i == 2 and j == 2:
                    alike[:] = True
                weight = (taps[i] * taps[j] * alike)[..., None]
                total += weight * lights[window]
                weights += weight
        light = total / weights
    return light * np.maximum(albedo if texture is None else texture, smallest)


def render_photos(
    xml: str | os.PathLike[str],
    cameras: Mapping[str, Camera],
    out_dir: str | os.PathLike[str],
    *,
    spp: int = 4,
    seed: int = 0,
    max_depth: int = 4,
    progress: Progress | None = None,
) -> list[Path]:
    """Render a JPEG for each camera; a file that is there already is kept, so a killed run goes on where it stopped.

    Args:
        xml: scene that ``mitsuba.load_file`` opens.
        cameras: pinhole cameras by file name.
        out_dir: folder of the photos.
        spp: paths a pixel; the surfaces' texture is sampled four times as often.
        seed: view k is sampled with ``seed + k``.
        max_depth: longest light path.

    Returns:
        the files, in the order of ``cameras``.

    Raises:
        FileNotFoundError: if there is no such scene.
        ImportError: if Mitsuba or Pillow is missing.
    """
    xml, out_dir = Path(xml), Path(out_dir)
    if not xml.is_file():
        raise FileNotFoundError(f"xml: there is no scene file {xml}")
    images = require("PIL.Image", extra="photos")
    out_dir.mkdir(parents=True, exist_ok=True)
    paths = [out_dir / name for name in cameras]
    if all(path.is_file() for path in paths):
        return paths
    with _mitsuba(VARIANT) as mi:
        scene = mi.load_file(str(xml))
        for k, (path, camera) in enumerate(zip(paths, cameras.values(), strict=True)):
            if not path.is_file():
                pixels = tone_map(_radiance(mi, scene, camera, spp, seed + k, max_depth))
                photo = images.fromarray(np.round(255 * pixels).astype(np.uint8))
                save = partial(photo.save, format="JPEG", quality=JPEG_QUALITY, optimize=True)
                write_atomically(path, save)
            if progress is not None:
                progress("photos", k + 1, len(paths))
    return paths
