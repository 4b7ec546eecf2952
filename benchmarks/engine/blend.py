"""Blending, forward and backward: our rasteriser beside its peers on a CPU, measured in one run.

The scene is a room of flat Gaussians seen by a pinhole camera inside: what photos are refined with. All get the same
tensors and the same loss, a fixed weighted sum of the image, and all are called through torch's autograd; times cover
projection, binning, blending and the gradients of means, quaternions, scales, opacities and features. Each renderer
has a process of its own and they take turns (:mod:`benchmarks.engine.peers`). The peers: the vectorised torch
renderer, which computes the same image, and OpenSplat's CPU rasteriser where a checkout is given. What is asked of
single launches stands beside: :mod:`benchmarks.engine.launches`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.engine.launches import cores, pair_costs, spectrum_times
from benchmarks.engine.peers import Measured, Scene, renderers, take_turns
from benchmarks.engine.scenes import photo
from benchmarks.engine.torch_renderer import render_with_torch
from benchmarks.machine import machine
from benchmarks.stages import write_json
from warprrf.device import Progress, require, threads

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
    opensplat: str | os.PathLike[str] | None = None,
    launches: bool = True,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Time ours and its peers on a CPU in float32, on one thread each and on all; the fastest run of each counts.

    On a busy machine compare one thread with one, by processor time: each tensor operation waits for all of torch's
    threads.

    Args:
        out: write the result to this JSON file.
        n: Gaussians.
        repeats: turns of each renderer, of :data:`~benchmarks.engine.peers.RUNS` timed runs.
        opensplat: folder of a checkout of OpenSplat, compiled and measured too.
        launches: measure single launches too: cost per pair, all cores, a spectrum.

    Returns:
        ``runs``, one for each number of threads: ``threads`` and, for ``ours`` and each peer, seconds forward, backward
        and in all, by the wall clock and of processor time (``cpu_seconds``), and nanoseconds per pair of pixel and
        Gaussian that contribute; ``speedup`` (peer over ours, in all) and ``cpu_speedup`` by peer. The pairs that
        contribute; the largest and 99.9 % difference of our image from torch's, and the relative difference of the
        gradients; ``opensplat_psnr_db``, its image against ours; ``pairs``, ``cores`` (where there are several) and
        ``spectrum`` of :mod:`~benchmarks.engine.launches`, each with what is asked.

    Raises:
        ImportError: without torch.
        ValueError, RuntimeError: if OpenSplat is asked for and cannot be compiled.
    """
    torch = require("torch", "baselines")
    scene, makers = Scene(n, width, height, seed), renderers(opensplat)
    measured = {
        count: take_turns(makers, scene, threads=count, turns=repeats, progress=progress)
        for count in sorted({1, threads()})
    }
    with torch.no_grad():
        means, quaternions, scales, opacities, colors = scene.tensors()
        counted = render_with_torch(means, quaternions, scales, opacities, colors, photo(width, height))
    result: dict[str, Any] = {
        "machine": machine("cpu"),
        "torch_version": torch.__version__,
        "gaussians": n,
        "shape": [height, width],
        "passing_pairs": counted.passing,
        "pairs_tested_by_torch": counted.tested,
        "asked": ASKED,
        "runs": [_run(count, found, counted.passing) for count, found in measured.items()],
    }
    found = measured[threads()]
    result.update(_differences(found["ours"], found["torch"]))
    if opensplat is not None:
        square = np.mean((found["ours"].image - found["opensplat"].image) ** 2)
        result["opensplat_psnr_db"] = float(-10 * np.log10(square))
    if launches:
        # Fewer Gaussians are larger ones; a tenth of the scene's own cover a block of pixels evenly.
        result["pairs"] = pair_costs({"dense": n, "sparse": n // 10}, width=width, height=height, seed=seed)
        result["spectrum"] = spectrum_times(5 * n, seed=seed)
        if threads() > 1:
            result["cores"] = cores(10 * n, width=4 * width, height=4 * height, seed=seed)
    if out is not None:
        write_json(Path(out), result)
    return result


def _run(count: int, found: dict[str, Measured], passing: int) -> dict[str, Any]:
    """The figures of all renderers on ``count`` threads."""
    row: dict[str, Any] = {name: measured.figures(passing) for name, measured in found.items()}
    peers = [name for name in found if name != "ours"]
    for key, figure in (("speedup", "seconds"), ("cpu_speedup", "cpu_seconds")):
        row[key] = {name: row[name][figure] / row["ours"][figure] for name in peers}
    return {"threads": count, **row}


def _differences(ours: Measured, peer: Measured) -> dict[str, Any]:
    """How far apart two images of one definition are, and their gradients."""
    difference = np.abs(ours.image - peer.image)
    names = ("means", "quaternions", "scales", "opacities", "features")
    return {
        "image_difference": {
            "largest": float(difference.max()),
            "quantile_99.9": float(np.quantile(difference, 0.999)),
        },
        "gradient_difference": {
            name: float(np.linalg.norm(a - b) / np.linalg.norm(b))
            for name, a, b in zip(names, ours.gradients, peer.gradients, strict=True)
        },
    }
