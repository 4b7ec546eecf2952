"""Gaussians where the photos show something and nothing is there yet.

Structure from motion finds no points on what is plain, shiny or seen by one photo alone. Where the Gaussians leave a
photo's light through, discs facing its camera are put at a depth that continues what is known around the hole; the
refinement then moves them to where the photos agree. Photos are taken one after another, and each is asked what those
before have left open, so that a hole that many of them see is filled once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from warprrf.device import DeviceLike
from warprrf.geometry.photos.initial_gaussians import SPREAD, discs
from warprrf.geometry.photos.targets import PosedPhotos
from warprrf.geometry.splats.blending import Blending
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.render import render

PIXELS = 60_000  # of a rendering in which holes are looked for, about
BLOCK = 4  # pixels of such a rendering: side of what one disc covers
OPEN = 0.5  # a block that blocks less light than this is a hole
OPACITY = 0.5  # of a new disc: its depth is a guess, so others may be seen through it


def filled(gaussians: Gaussians, photos: PosedPhotos, *, device: DeviceLike = None) -> Gaussians:
    """``gaussians`` with discs added where photos see through them.

    Args:
        photos: each is looked at once, in order; masked pixels ask for nothing.
    """
    for k, (image, camera) in enumerate(zip(photos.images, photos.cameras, strict=True)):
        mask = photos.masks[k] if photos.masks else None
        found = _missing(gaussians, image, mask, camera, device)
        if found is not None:
            gaussians = _joined(gaussians, found)
    return gaussians


def _missing(
    gaussians: Gaussians, image: np.ndarray, mask: np.ndarray | None, camera: Camera, device: DeviceLike
) -> Gaussians | None:
    """Discs for the holes of one photo; None if there are none, or nothing around them is known."""
    share = min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5)
    rows, columns = (max(1, round(share * n / BLOCK)) for n in (camera.height, camera.width))
    small = camera.resized(columns * BLOCK, rows * BLOCK)
    seen = render(gaussians, small, device=device, blending=Blending())
    alpha = _blocks(seen.alpha)
    nearness = _blocks(seen.alpha / np.maximum(seen.depth, 1e-6)) / np.maximum(alpha, 1e-6)  # 1 / m
    known = alpha >= OPEN
    if not known.any():
        return None
    shown = np.stack([_shrunk(image[..., c], known.shape) for c in range(3)], axis=-1)
    hole = ~known
    if mask is not None:
        hole &= _shrunk(np.asarray(mask, dtype=np.float32), known.shape) == 0
    if not hole.any():
        return None
    depth = 1 / _continued(nearness, known)[hole]
    coarse = camera.resized(columns, rows)
    toward = coarse.directions()[hole]
    radius = SPREAD * depth / min(coarse.fx, coarse.fy)
    centres = camera.position + depth[:, None] * toward
    return replace(discs(centres, -toward, radius, shown[hole]), opacities=np.full(len(depth), OPACITY))


def _blocks(pixels: np.ndarray) -> np.ndarray:
    """Means over blocks."""
    rows, columns = pixels.shape[0] // BLOCK, pixels.shape[1] // BLOCK
    return pixels.reshape(rows, BLOCK, columns, BLOCK).mean(axis=(1, 3), dtype=np.float64)


def _shrunk(pixels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Means over the parts of an image that make one of a smaller ``shape``."""
    for axis, count in enumerate(shape):
        length = pixels.shape[axis]
        starts = np.arange(count) * length // count
        sums = np.add.reduceat(pixels, starts, axis=axis, dtype=np.float64)
        sizes = np.diff(np.append(starts, length))
        pixels = sums / (sizes[:, None] if axis == 0 else sizes)
    return pixels


def _continued(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """``values`` where they are ``known``, continued smoothly elsewhere: averages over ever wider surroundings, the
    narrowest in which anything is known."""
    out = np.where(known, values, 0.0)
    done = known.copy()
    width = 1.0
    while not done.all():
        weight = ndimage.gaussian_filter(known.astype(float), width, mode="constant")
        total = ndimage.gaussian_filter(np.where(known, values, 0.0), width, mode="constant")
        now = ~done & (weight > 1e-3)
        out[now] = total[now] / weight[now]
        done |= now
        width *= 2
    return out


def _joined(a: Gaussians, b: Gaussians) -> Gaussians:
    """All Gaussians of both; ``b`` has degree 0."""
    sh = np.zeros((len(b), *a.sh.shape[1:]), np.float32)
    sh[:, :1] = b.sh
    pairs = (
        (a.means, b.means),
        (a.quaternions, b.quaternions),
        (a.scales, b.scales),
        (a.opacities, b.opacities),
    )
    return Gaussians(*(np.concatenate(pair) for pair in (*pairs, (a.sh, sh))))
