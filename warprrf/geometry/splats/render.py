"""Splat Gaussians into photos and panoramas: arrays in, arrays out; :mod:`warprrf.geometry.splats.rasterizer` does it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.checks import check_array, checked, one_line
from warprrf.device import DeviceLike, resolve
from warprrf.geometry.splats.camera import Camera, check_camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import RADIO, Blending, Rasterizer


@dataclass(frozen=True)
class Rendering:
    """What :func:`render` returns.

    Attributes:
        features: blended features, shape ``(H, W, C)`` float32.
        alpha: sum of blending weights, shape ``(H, W)``.
        depth: Euclidean range [m], the blended mean of each Gaussian's peak on the ray; inf where alpha is 0.
        dominant: Gaussian of largest weight, int32, -1 where none.
        peak: range of the dominant Gaussian's peak [m]; inf where none.
    """

    __repr__ = one_line

    features: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    dominant: np.ndarray
    peak: np.ndarray


@checked
@dataclass(frozen=True)
class BlendWeights:
    """The ``K`` largest blending weights of every pixel, front to back.

    Attributes:
        index: Gaussian, shape ``(H, W, K)`` int32, -1 where fewer than K.
        weight: alpha times transmittance, same shape, float32.
        range: distance of the Gaussian's peak on the ray [m], same shape.
        dominant: Gaussian of largest weight, shape ``(H, W)`` int32, -1 where none.
        alpha: sum of all weights, shape ``(H, W)``.
        dropped: sum of the weights left out by the limit K, shape ``(H, W)``.
    """

    __repr__ = one_line

    index: np.ndarray
    weight: np.ndarray
    range: np.ndarray
    dominant: np.ndarray
    alpha: np.ndarray
    dropped: np.ndarray


@checked
def render(
    g: Gaussians,
    cam: Camera,
    features: ArrayLike | None = None,
    background: ArrayLike = 0.0,
    device: DeviceLike = None,
    *,
    blending: Blending | None = None,
) -> Rendering:
    """Blend Gaussians front to back along every pixel's ray.

    Args:
        features: per Gaussian, shape ``(N, C)``; default: the colour that ``g.sh`` shows towards the camera.
        background: scalar or shape ``(C,)``, seen through what transmittance is left.
        blending: cutoffs and transmittance rule; default: those of photos.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
    """
    _check(g, cam)
    device = resolve(device)
    raster = Rasterizer(device=device, blending=blending)
    scene = raster.upload(g)
    if features is None:
        feature_array = raster.colors(scene[0], wp.array(g.sh, dtype=wp.float32, device=device), cam)
    else:
        feature_array = wp.array(
            check_array("features", features, (len(g), None), np.float32), dtype=wp.float32, device=device
        )
    back = check_array("background", background, None, np.float32)
    if back.ndim > 1 or (back.ndim == 1 and len(back) != feature_array.shape[1]):
        raise ValueError(
            f"background: got shape {back.shape}, expected a scalar or ({feature_array.shape[1]},)"
        )
    view = raster.prepare(*scene, cam)
    image = raster.blend(view, feature_array, np.broadcast_to(back, (feature_array.shape[1],)))
    alpha = image.alpha.numpy()
    dominant = image.dominant.numpy()
    depth = np.where(alpha > 0, image.depth.numpy(), np.inf).astype(np.float32)
    peak = np.where(dominant >= 0, image.peak.numpy(), np.inf).astype(np.float32)
    return Rendering(image.features.numpy(), alpha, depth, dominant, peak)


@checked
def blend_weights(
    g: Gaussians, cam: Camera, *, top_k: int = 16, blending: Blending = RADIO, device: DeviceLike = None
) -> BlendWeights:
    """Blending weights of every pixel as a sparse matrix; geometry that is frozen needs them only once.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
    """
    _check(g, cam)
    raster = Rasterizer(device=device, blending=blending)
    found = raster.strongest(raster.prepare(*raster.upload(g), cam), top_k)
    indices, weights, ranges, alpha = (array.numpy() for array in found)
    best = np.argmax(weights, axis=2)
    dominant = np.take_along_axis(indices, best[..., None], axis=2)[..., 0]
    dropped = np.maximum(alpha - weights.sum(axis=2), 0)
    return BlendWeights(indices, weights, ranges, dominant, alpha, dropped)


def _check(g: object, cam: object) -> None:
    if not isinstance(g, Gaussians):
        raise TypeError(f"g: got {type(g).__name__}, expected warprrf.Gaussians")
    check_camera(cam)
