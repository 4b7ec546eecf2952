"""Where Gaussians come and go: those that the photos pull hardest are split or cloned; faint, huge and unseen ones go;
and some are added where the photos show something and nothing is there yet.

Densification follows Kerbl et al., "3D Gaussian Splatting", 2023, with a bounded share at a time in place of a threshold.

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
from warprrf.geometry.photos.config import RefineConfig
from warprrf.geometry.photos.gaussians.initialise import SPREAD, discs
from warprrf.geometry.photos.posed.images import PosedPhotos, block_means
from warprrf.geometry.splats.gaussians import Gaussians, rotations_of
from warprrf.geometry.splats.render import render

Arrays = dict[str, np.ndarray]
"""State of a refinement, one row a Gaussian: parameters ``means``, ``quaternions``, ``log_scales``, ``logits`` and
``sh``; their moments ``first.NAME`` and ``second.NAME``; the statistics ``pull`` (sum of the gradients of the projected
position), ``hits`` (steps) and ``seen`` (sum of blending weights)."""

PARAMETERS = ("means", "quaternions", "log_scales", "logits", "sh")
STATISTICS = ("pull", "hits", "seen")
PRUNE_OPACITY = 0.02  # fainter ones are removed
DENSIFY_TO, LARGEST_SHARE = 30_000, 0.5
"""Up to this share of the Gaussians is split or cloned at a time where fewer than so many would be there in the end."""
JITTER = 0.3  # standard deviation of a clone's place, in those of the Gaussian


def opacity_and_scales(arrays: Arrays) -> tuple[np.ndarray, np.ndarray]:
    """Opacities, shape ``(N,)``, and standard deviations [m], shape ``(N, 3)``."""
    logits, log_scales = arrays["logits"][:, 0].astype(np.float64), arrays["log_scales"].astype(np.float64)
    return 1 / (1 + np.exp(-logits)), np.exp(log_scales)


def densified(
    arrays: Arrays, config: RefineConfig, rng: np.random.Generator, *, rounds_left: int = 1
) -> Arrays:
    """``arrays`` with Gaussians split, cloned and pruned; statistics start anew.

    Args:
        rounds_left: how often this is done still, this time included.
    """
    opacity, scales = opacity_and_scales(arrays)
    hits, seen, largest = arrays["hits"][:, 0], arrays["seen"][:, 0], scales.max(axis=1)
    unseen = (hits > 0) & (seen < 1e-3)
    keep = ~((largest > config.max_scale_m) | unseen | (opacity < PRUNE_OPACITY))
    if not keep.any():
        raise RuntimeError(
            "refine: every Gaussian would be pruned; do photos and camera poses belong together?"
        )
    pull = np.where(keep, arrays["pull"][:, 0] / np.maximum(hits, 1), 0.0)
    kept = int(keep.sum())
    catching_up = min((DENSIFY_TO - kept) / rounds_left, LARGEST_SHARE * kept)
    # 0.08: at most of the Gaussians is split or cloned at a time, those pulled hardest
    room = min(config.max_gaussians - kept, int(max(0.08 * kept, catching_up)))
    chosen = np.argsort(-pull, kind="stable")[: max(room, 0)]
    chosen = np.sort(chosen[pull[chosen] > 0])

    rows = {name: value[chosen].astype(np.float64) for name, value in arrays.items()}
    # 0.03: larger ones are split, smaller ones cloned
    split = (largest[chosen] > 0.03)[:, None]
    longest = np.eye(3)[scales[chosen].argmax(axis=1)]
    rotations = rotations_of(rows["quaternions"])
    jitter = JITTER * scales[chosen] * rng.normal(size=(len(chosen), 3)) * [1, 1, 0]  # in the surface
    # 0.7: of its largest standard deviation: how far the halves of a split Gaussian lie from its centre
    in_half = 0.7 * longest * scales[chosen]
    step = np.einsum("nij,nj->ni", rotations, np.where(split, in_half, jitter))
    # 1.6: the largest standard deviation of a split Gaussian is divided by this
    rows["log_scales"] -= split * longest * np.log(1.6)
    for name in PARAMETERS:
        for moment in ("first", "second"):
            rows[f"{moment}.{name}"][:] = 0
    clones = {**rows, "means": rows["means"] + step}
    rows["means"] = rows["means"] - split * step
    result = {}
    for name, value in arrays.items():
        value = value.copy()
        value[chosen] = rows[name]
        result[name] = np.concatenate([value[keep], clones[name].astype(value.dtype)])
    for name in STATISTICS:
        result[name][:] = 0
    return result


BLOCK = 4  # pixels of such a rendering: side of what one disc covers


def filled(gaussians: Gaussians, photos: PosedPhotos, *, device: DeviceLike = None) -> Gaussians:
    """``gaussians`` with discs added where photos see through them.

    Args:
        photos: each is looked at once, in order; masked pixels ask for nothing.
    """
    for k in range(len(photos.images)):
        found = _missing(gaussians, photos, k, device)
        if found is not None:
            gaussians = _joined(gaussians, found)
    return gaussians


def _missing(gaussians: Gaussians, photos: PosedPhotos, number: int, device: DeviceLike) -> Gaussians | None:
    """Discs for the holes of one photo; None if there are none, or nothing around them is known."""
    image, camera = photos.images[number], photos.cameras[number]
    # 60_000: of a rendering in which holes are looked for, about
    share = min(1.0, (60_000 / (camera.width * camera.height)) ** 0.5)
    rows, columns = (max(1, round(share * n / BLOCK)) for n in (camera.height, camera.width))
    small = camera.resized(columns * BLOCK, rows * BLOCK)
    seen = render(gaussians, small, device=device)
    alpha = block_means(seen.alpha, BLOCK, np.float64)
    nearness = block_means(seen.alpha / np.maximum(seen.depth, 1e-6), BLOCK, np.float64)  # 1 / m
    nearness /= np.maximum(alpha, 1e-6)
    # 0.5: a block that blocks less light than this is a hole
    known = alpha >= 0.5
    if not known.any():
        return None
    shown = np.stack([_shrunk(image[..., c], known.shape) for c in range(3)], axis=-1)
    hole = ~known & (_shrunk(photos.mask(number).astype(np.float32), known.shape) == 0)
    if not hole.any():
        return None
    depth = 1 / _continued(nearness, known)[hole]
    coarse = camera.resized(columns, rows)
    toward = coarse.directions()[hole]
    radius = SPREAD * depth / min(coarse.fx, coarse.fy)
    centres = camera.position + depth[:, None] * toward
    # 0.5: of a new disc: its depth is a guess, so others may be seen through it
    return replace(discs(centres, -toward, radius, shown[hole]), opacities=np.full(len(depth), 0.5))


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
    names = ("means", "quaternions", "scales", "opacities", "sh")
    return Gaussians(*(np.concatenate([getattr(a, name), getattr(b, name)]) for name in names))
