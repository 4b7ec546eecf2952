"""Blending, forward and backward: our rasteriser beside the vectorised torch renderer, measured in one run.

The scene is a room of flat Gaussians seen by a pinhole camera inside: what photos are refined with. Both get the same
tensors and the same loss, a fixed weighted sum of the image, and both are called through torch's autograd; times cover
projection, binning, blending and the gradients of means, quaternions, scales, opacities and features. What is asked of
single launches stands beside: :mod:`warprrf.bench.engine.launches`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf.bench.engine.launches import cores, pair_costs, spectrum_times
from warprrf.bench.engine.scenes import photo, room
from warprrf.bench.engine.torch_renderer import render_with_torch
from warprrf.bench.machine import machine
from warprrf.bench.stages import write_json
from warprrf.device import Progress, require, threads
from warprrf.geometry import interop

if TYPE_CHECKING:
    import torch

ASKED = {"speedup": 20.0, "image_difference": 1e-4}
"""How many times faster than the torch renderer ours must be, and how far apart their images may lie where no cutoff
decides differently."""


def run_blend(
    out: str | os.PathLike[str] | None = None,
    *,
    n: int = 20_000,
    width: int = 400,
    height: int = 300,
    repeats: int = 5,
    seed: int = 0,
    launches: bool = True,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Time ours and the torch renderer on a CPU in float32; the runs alternate and the fastest of each counts.

    Both use as many threads as ours does (``WARPRRF_THREADS`` where set). On a busy machine compare one thread with
    one, by processor time: each tensor operation waits for all of torch's threads.

    Args:
        out: write the result to this JSON file.
        n: Gaussians.
        repeats: timed runs of each, after one that warms up.
        launches: measure single launches too: cost per pair, all cores, a spectrum.

    Returns:
        Seconds forward, backward and in all of both (``ours``, ``torch``), by the wall clock and of processor time
        (``cpu_seconds``), ``speedup`` (torch over ours, in all) and ``cpu_speedup``, pairs of pixel and Gaussian that
        contribute, nanoseconds per such pair, the largest and 99.9 % difference of the images, and the relative
        difference of the gradients; ``pairs``, ``cores`` (where there are several) and ``spectrum`` of
        :mod:`~warprrf.bench.engine.launches`, each with what is asked.

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
    runs: dict[str, list[tuple[float, float, float]]] = {"ours": [], "torch": []}
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
        forward, backward, _ = min(times, key=lambda t: t[0] + t[1])
        result[name] = {
            **result.get(name, {}),
            "forward_s": forward,
            "backward_s": backward,
            "seconds": forward + backward,
            "cpu_seconds": min(t[2] for t in times),
            "ns_per_passing_pair": 1e9 * (forward + backward) / max(counted.passing, 1),
        }
    result["speedup"] = result["torch"]["seconds"] / result["ours"]["seconds"]
    result["cpu_speedup"] = result["torch"]["cpu_seconds"] / result["ours"]["cpu_seconds"]
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
    if launches:
        # Fewer Gaussians are larger ones; a tenth of the scene's own cover a block of pixels evenly.
        result["pairs"] = pair_costs({"dense": n, "sparse": n // 10}, width=width, height=height, seed=seed)
        result["spectrum"] = spectrum_times(5 * n, seed=seed)
        if threads() > 1:
            result["cores"] = cores(10 * n, width=4 * width, height=4 * height, seed=seed)
    if out is not None:
        write_json(Path(out), result)
    return result


def _timed(
    function: Callable[[], torch.Tensor], parameters: list[torch.Tensor], weights: torch.Tensor
) -> tuple[tuple[float, float, float], torch.Tensor, tuple[torch.Tensor, ...]]:
    """Seconds forward and backward, processor time of both, the image, and the gradients."""
    torch = require("torch", "baselines")
    cpu = time.process_time()
    start = time.perf_counter()
    image = function()
    middle = time.perf_counter()
    gradients = torch.autograd.grad((image * weights).sum(), parameters)
    end = time.perf_counter()
    times = (middle - start, end - middle, time.process_time() - cpu)
    return times, image.detach(), gradients
