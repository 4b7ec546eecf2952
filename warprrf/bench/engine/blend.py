"""Blending, forward and backward: our rasteriser beside the vectorised torch renderer, measured in one run.

The scene is a room of flat Gaussians, 18 x 12 x 4 m, seen by a pinhole camera inside: what photos are refined with.
Both get the same tensors and the same loss, a fixed weighted sum of the image, and both are called through torch's
autograd; times cover projection, binning, blending and the gradients of means, quaternions, scales, opacities and
features.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf.bench.engine.torch_renderer import render_with_torch
from warprrf.bench.machine import machine
from warprrf.bench.stages import write_json
from warprrf.device import Progress, require, threads
from warprrf.geometry import interop
from warprrf.geometry.camera import Camera

if TYPE_CHECKING:
    import torch

ASKED = {"speedup": 20.0, "image_difference": 1e-4}
"""How many times faster than the torch renderer ours must be, and how far apart their images may lie where no cutoff
decides differently."""

ROOM = (18.0, 12.0, 4.0)  # m


def run_blend(
    out: str | os.PathLike[str] | None = None,
    *,
    n: int = 20_000,
    width: int = 400,
    height: int = 300,
    repeats: int = 5,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Time ours and the torch renderer on a CPU in float32; the runs alternate and the fastest of each counts.

    Both use as many threads as ours does (``WARPRRF_THREADS`` where set). On a busy machine compare one thread with
    one: each tensor operation waits for all of torch's threads.

    Args:
        out: write the result to this JSON file.
        n: Gaussians.
        repeats: timed runs of each, after one that warms up.

    Returns:
        Seconds forward, backward and in all of both (``ours``, ``torch``), ``speedup`` (torch over ours, in all), pairs
        of pixel and Gaussian that contribute, nanoseconds per such pair, and the largest and 99.9 % difference of the
        images and the relative difference of the gradients.

    Raises:
        ImportError: without torch.
    """
    torch = require("torch", "baselines")
    parameters = [torch.tensor(v, requires_grad=True) for v in room(n, seed)]
    means, quaternions, scales, opacities, colors = parameters
    cam = photo(width, height)
    weights = torch.from_numpy(np.random.default_rng(seed).normal(size=(height, width, 3)).astype(np.float32))

    def ours() -> Any:
        return interop.rasterize(means, quaternions, scales, opacities, colors, cam)[0]

    def peer() -> Any:
        return render_with_torch(means, quaternions, scales, opacities, colors, cam).features

    before = torch.get_num_threads()
    torch.set_num_threads(threads())
    runs: dict[str, list[tuple[float, float]]] = {"ours": [], "torch": []}
    images: dict[str, Any] = {}
    gradients: dict[str, Any] = {}
    for k in range(repeats + 1):
        for name, function in (("ours", ours), ("torch", peer)):
            seconds, images[name], gradients[name] = _timed(function, parameters, weights)
            if k:
                runs[name].append(seconds)
        if progress:
            progress("blend", k + 1, repeats + 1)
    torch.set_num_threads(before)
    with torch.no_grad():
        counted = render_with_torch(means, quaternions, scales, opacities, colors, cam)
    result: dict[str, Any] = {
        "machine": machine("cpu"),
        "torch": {"version": torch.__version__},
        "threads": threads(),
        "gaussians": n,
        "shape": [height, width],
        "passing_pairs": counted.passing,
        "pairs_tested_by_torch": counted.tested,
        "asked": ASKED,
    }
    for name, times in runs.items():
        forward, backward = min(times, key=sum)
        result[name] = {
            **result.get(name, {}),
            "forward_s": forward,
            "backward_s": backward,
            "seconds": forward + backward,
            "ns_per_passing_pair": 1e9 * (forward + backward) / max(counted.passing, 1),
        }
    result["speedup"] = result["torch"]["seconds"] / result["ours"]["seconds"]
    difference = (images["ours"] - images["torch"]).abs().numpy()
    result["image_difference"] = {
        "largest": float(difference.max()),
        "quantile_99.9": float(np.quantile(difference, 0.999)),
    }
    result["gradient_difference"] = {
        name: float(torch.linalg.norm(a - b) / torch.linalg.norm(b))
        for name, a, b in zip(
            ("means", "quaternions", "scales", "opacities", "features"),
            gradients["ours"], gradients["torch"], strict=True,
        )
    }  # fmt: skip
    if out is not None:
        write_json(Path(out), result)
    return result


def room(n: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Flat Gaussians on the six sides of the room: means, quaternions, scales, opacities, colours, float32.

    In-plane scales are such that neighbours overlap whatever their number is; opacities are those of a refined scene.
    """
    rng = np.random.default_rng(seed)
    size = np.asarray(ROOM)
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, n, p=area / area.sum())
    means = rng.uniform(0, 1, (n, 3)) * size
    means[np.arange(n), axis] = rng.integers(0, 2, n) * size[axis]
    spacing = np.sqrt(2 * area.sum() / n)
    scales = spacing * np.exp(rng.uniform(np.log(0.3), np.log(1.0), (n, 3)))
    scales[np.arange(n), axis] = 0.05 * spacing
    quaternions = np.concatenate([np.ones((n, 1)), rng.normal(scale=0.05, size=(n, 3))], axis=1)
    values = (means, quaternions, scales, rng.uniform(0.3, 0.95, n), rng.uniform(size=(n, 3)))
    return tuple(v.astype(np.float32) for v in values)


def photo(width: int, height: int) -> Camera:
    """A camera in the room's corner, 80 degrees wide, looking along the diagonal."""
    position = np.array([1.5, 1.5, 1.7])
    forward = np.array([16.5, 10.5, 1.5]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    focal = 0.5 * width / np.tan(np.radians(40))
    return Camera.pinhole(
        width, height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, world_to_camera=pose
    )


def _timed(
    function: Callable[[], torch.Tensor], parameters: list[torch.Tensor], weights: torch.Tensor
) -> tuple[tuple[float, float], torch.Tensor, tuple[torch.Tensor, ...]]:
    """Seconds forward and backward, the image, and the gradients."""
    torch = require("torch", "baselines")
    start = time.perf_counter()
    image = function()
    middle = time.perf_counter()
    gradients = torch.autograd.grad((image * weights).sum(), parameters)
    end = time.perf_counter()
    return (middle - start, end - middle), image.detach(), gradients
