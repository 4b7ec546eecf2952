"""Photographs of the lobby: Mitsuba's path tracer behind pinhole cameras, whose poses stand in ``poses_true.json``.

A Mitsuba camera looks along +z with x to the left and y up, an OpenCV camera along +z with x to the right and y down:
R_c2w(Mitsuba) = R_c2w(OpenCV) diag(-1, -1, 1). Pixel centres lie at +0.5 in both. Exposure and tone curve are fixed,
so that a surface has the same colour in every photo. A few paths a pixel are enough: the illumination is denoised.

The 120 views walk twice round the room at two heights, each overlapping the one before it, and fill its gaps; every
tenth is held out, eight have surveyed positions.
"""

from __future__ import annotations

import json
import os
import shutil
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

SOURCE = Path(__file__).parents[2] / "data" / "lobby"
ROLES = ("photos.json", "surveyed.json", "poses_true.json")
"""Which photos there are and what each is for; positions that count as known; true poses, for evaluation alone."""
VARIANT = "llvm_ad_rgb"
# Sionna RT registers its plugins with the variant it is imported in
SIONNA_VARIANT = "llvm_ad_mono_polarized"
JPEG_QUALITY = 90
SAMPLES, MAX_DEPTH = 4, 4  # paths a pixel and their most bounces
NOISE_SEED = 10_000  # of second renders


@contextmanager
def mitsuba(variant: str) -> Iterator[Any]:
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
    with mitsuba(VARIANT) as mi:
        return _layers(mi, mi.load_file(str(xml)), camera, "position:position", None, spp, 0)


def _layers(mi: Any, scene: Any, camera: Camera, names: str, inner: Any, spp: int, seed: int) -> np.ndarray:
    integrator: dict[str, Any] = {"type": "aov", "aovs": names}
    if inner is not None:
        integrator["inner"] = inner
    image = mi.render(
        scene, sensor=_sensor(mi, camera, spp), integrator=mi.load_dict(integrator), spp=spp, seed=seed
    )
    return np.array(image, dtype=np.float32)


def _radiance(mi: Any, scene: Any, camera: Camera, seed: int) -> np.ndarray:
    """Radiance of a view: illumination from a few paths a pixel, denoised; texture from four times as many rays."""
    guides = "albedo:albedo,normal:sh_normal,position:position"
    path = {"type": "path", "max_depth": MAX_DEPTH}
    noisy = _layers(mi, scene, camera, guides, path, SAMPLES, seed)
    texture = _layers(mi, scene, camera, "albedo:albedo", None, 4 * SAMPLES, seed)[..., -3:]
    return denoise(noisy[..., :3], noisy[..., -9:-6], noisy[..., -6:-3], noisy[..., -3:], texture)


def denoise(
    radiance: np.ndarray,
    albedo: np.ndarray,
    normal: np.ndarray,
    position: np.ndarray,
    texture: np.ndarray,
    *,
    levels: int = 4,
) -> np.ndarray:
    """Smooth the illumination (radiance over albedo) within each plane of the picture; textures stay as they are.

    An edge-avoiding a-trous filter (Dammertz et al. 2010): 5 x 5 taps, spacing doubled ``levels`` - 1 times, taken
    where the normal agrees and the point lies in the pixel's own tangent plane.

    Args:
        radiance, albedo, normal, position: of every pixel, each ``(height, width, 3)``; position in metres.
        texture: a better sampled albedo for the result, same shape.
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
    return light * np.maximum(texture, smallest)


def render_photos(
    xml: Path,
    cameras: Mapping[str, Camera],
    out_dir: Path,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> None:
    """Render a JPEG for each camera; a file that is there already is kept, so a killed run goes on where it stopped.

    Args:
        xml: scene that ``mitsuba.load_file`` opens.
        cameras: pinhole cameras by file name.
        out_dir: folder of the photos.
        seed: view k is sampled with ``seed + k``.

    Raises:
        ImportError: if Mitsuba or Pillow is missing.
    """
    images = require("PIL.Image", extra="photos")
    out_dir.mkdir(parents=True, exist_ok=True)
    if all((out_dir / name).is_file() for name in cameras):
        return
    with mitsuba(VARIANT) as mi:
        scene = mi.load_file(str(xml))
        for k, (name, camera) in enumerate(cameras.items()):
            if not (out_dir / name).is_file():
                pixels = tone_map(_radiance(mi, scene, camera, seed + k))
                photo = images.fromarray(np.round(255 * pixels).astype(np.uint8))
                save = partial(photo.save, format="JPEG", quality=JPEG_QUALITY, optimize=True)
                write_atomically(out_dir / name, save)
            if progress is not None:
                progress("photos", k + 1, len(cameras))


def read_poses(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """True cameras by file name, from ``poses_true.json``."""
    table = json.loads(Path(path).read_text(encoding="utf-8"))
    size = {key: table[key] for key in ("fx", "fy", "cx", "cy")}
    return {
        name: Camera.pinhole(table["width"], table["height"], world_to_camera=view["world_to_camera"], **size)
        for name, view in table["views"].items()
    }


def noise_psnr_db(directory: str | os.PathLike[str]) -> float:
    """PSNR [dB] between photos and renders of the same views with other seeds: the photos' own noise.

    Mean over the views in ``photos_noise``, both as decoded 8-bit JPEG.

    Raises:
        FileNotFoundError: if there are no second renders.
    """
    directory = Path(directory)
    images = require("PIL.Image", extra="photos")
    second = sorted((directory / "photos_noise").glob("*.jpg"))
    if not second:
        raise FileNotFoundError(f"directory: {directory / 'photos_noise'} holds no second renders")
    values = []
    for path in second:
        a, b = (
            np.asarray(images.open(p), dtype=np.float64) / 255
            for p in (path, directory / "photos" / path.name)
        )
        values.append(-10 * np.log10(np.mean((a - b) ** 2)))
    return float(np.mean(values))


def make_photos(directory: Path, *, seed: int = 0, progress: Progress | None = None) -> None:
    """Photograph ``directory/scene.xml`` from the lobby's poses: ``photos/``, ``photos_noise/``; resumable."""
    for name in ROLES:
        if not (directory / name).is_file():
            shutil.copy(SOURCE / name, directory)
    cameras, xml = read_poses(directory / "poses_true.json"), directory / "scene.xml"
    render_photos(xml, cameras, directory / "photos", seed=seed, progress=progress)
    roles = json.loads((directory / "photos.json").read_text(encoding="utf-8"))
    again = {name: cameras[name] for name in roles["noise"]}
    render_photos(xml, again, directory / "photos_noise", seed=seed + NOISE_SEED)
