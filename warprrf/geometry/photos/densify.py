"""Densification: Gaussians that the photos pull hardest are split or cloned; faint, huge and unseen ones go.

The rules of Kerbl et al., "3D Gaussian Splatting", 2023, with a bounded share at a time in place of a threshold.
"""

from __future__ import annotations

import numpy as np

from warprrf.geometry.photos.config import RefineConfig
from warprrf.geometry.splats.gaussians import rotations_of

Arrays = dict[str, np.ndarray]
"""State of a refinement, one row a Gaussian: parameters ``means``, ``quaternions``, ``log_scales``, ``logits`` and
``sh``; their moments ``first.NAME`` and ``second.NAME``; the statistics ``pull`` (sum of the gradients of the projected
position), ``hits`` (steps) and ``seen`` (sum of blending weights)."""

PARAMETERS = ("means", "quaternions", "log_scales", "logits", "sh")
STATISTICS = ("pull", "hits", "seen")
APART = 0.7  # of its largest standard deviation: how far the halves of a split Gaussian lie from its centre
SMALLER = 1.6  # the largest standard deviation of a split Gaussian is divided by this
LARGEST_SHARE = 0.5  # of the Gaussians that is split or cloned at a time
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

    Raises:
        RuntimeError: if none would be left.
    """
    opacity, scales = opacity_and_scales(arrays)
    hits, seen, largest = arrays["hits"][:, 0], arrays["seen"][:, 0], scales.max(axis=1)
    unseen = (hits > 0) & (seen < 1e-3)
    keep = ~((largest > config.max_scale_m) | unseen | (opacity < config.prune_opacity))
    if not keep.any():
        raise RuntimeError(
            "refine: every Gaussian would be pruned; do photos and camera poses belong together?"
        )
    pull = np.where(keep, arrays["pull"][:, 0] / np.maximum(hits, 1), 0.0)
    kept = int(keep.sum())
    catching_up = min((config.densify_to - kept) / rounds_left, LARGEST_SHARE * kept)
    room = min(config.max_gaussians - kept, int(max(config.densify_share * kept, catching_up)))
    chosen = np.argsort(-pull, kind="stable")[: max(room, 0)]
    chosen = np.sort(chosen[pull[chosen] > 0])

    rows = {name: value[chosen].astype(np.float64) for name, value in arrays.items()}
    split = (largest[chosen] > config.split_above_m)[:, None]
    longest = np.eye(3)[scales[chosen].argmax(axis=1)]
    rotations = rotations_of(rows["quaternions"])
    jitter = JITTER * scales[chosen] * rng.normal(size=(len(chosen), 3)) * [1, 1, 0]  # in the surface
    in_half = APART * longest * scales[chosen]
    step = np.einsum("nij,nj->ni", rotations, np.where(split, in_half, jitter))
    rows["log_scales"] -= split * longest * np.log(SMALLER)
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
