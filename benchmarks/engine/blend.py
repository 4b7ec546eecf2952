"""Blending, forward and backward: our rasteriser beside a torch renderer on a CPU, measured in one run.

The scene is a room of flat Gaussians seen by a pinhole camera inside: what photos are refined with. Both get the same
tensors and the same loss, a fixed weighted sum of the image, and both are called through torch's autograd; times cover
projection, binning, blending and the gradients of means, quaternions, scales, opacities and features. Each renderer
has a process of its own and they take turns (:mod:`benchmarks.engine.peers`). The peer is a vectorised torch renderer,
which computes the same image.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.engine.peers import RENDERERS, Measured, Scene, take_turns
from benchmarks.engine.scenes import photo
from benchmarks.engine.torch_renderer import render_with_torch
from benchmarks.report import Row
from warprrf.device import Progress, require, threads


def blend_figures(
    n: int = 20_000, width: int = 400, height: int = 300, *, repeats: int = 5, seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Time ours and torch's on a CPU in float32, on one thread each and on all; the fastest run of each counts.

    On a busy machine compare one thread with one, by processor time: each tensor operation waits for all of torch's
    threads.

    Args:
        n: Gaussians.
        repeats: turns of each renderer, of :data:`~benchmarks.engine.peers.RUNS` timed runs.

    Returns:
        ``runs``, one for each number of threads: ``threads`` and, for ``ours`` and ``torch``, seconds forward, backward
        and in all, by the wall clock and of processor time (``cpu_seconds``), and nanoseconds per pair of pixel and
        Gaussian that contribute; ``speedup`` (torch over ours, in all) and ``cpu_speedup``. ``speedup`` of the last
        run; the pairs that contribute; the largest and 99.9 % difference of our image from torch's, and the relative
        difference of the gradients.

    Raises:
        ImportError: without torch.
    """
    torch = require("torch", "baselines")
    scene = Scene(n, width, height, seed)
    measured = {
        count: take_turns(RENDERERS, scene, threads=count, turns=repeats, progress=progress)
        for count in sorted({1, threads()})
    }
    with torch.no_grad():
        means, quaternions, scales, opacities, colors = scene.tensors()
        counted = render_with_torch(means, quaternions, scales, opacities, colors, photo(width, height))
    runs = [_run(count, found, counted.passing) for count, found in measured.items()]
    found = measured[threads()]
    return {
        "torch_version": torch.__version__,
        "gaussians": n,
        "shape": [height, width],
        "passing_pairs": counted.passing,
        "pairs_tested_by_torch": counted.tested,
        "runs": runs,
        "speedup": runs[-1]["speedup"],
        **_differences(found["ours"], found["torch"]),
    }


def _run(count: int, found: dict[str, Measured], passing: int) -> Row:
    """The figures of both renderers on ``count`` threads."""
    row: Row = {name: measured.figures(passing) for name, measured in found.items()}
    for key, figure in (("speedup", "seconds"), ("cpu_speedup", "cpu_seconds")):
        row[key] = row["torch"][figure] / row["ours"][figure]
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
