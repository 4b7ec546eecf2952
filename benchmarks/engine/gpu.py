"""Blending where there is a GPU: forward and backward beside gsplat, a spectrum, and what each kernel takes.

The scene and the loss are those of :mod:`benchmarks.engine.blend`, with a million Gaussians. Ours and gsplat
(Ye et al., "gsplat: An open-source library for Gaussian splatting", JMLR 26, 2025; version 1.5's ``rasterization``)
get the same tensors on the GPU, are called through torch's autograd and take turns in one process. gsplat blends
ellipses of a projection made affine, so its image is another one. Without a GPU the same code runs on the CPU, beside
no peer.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarks.engine.peers import Scene
from benchmarks.engine.scenes import gaussians, panorama, photo
from benchmarks.machine import machine
from warprrf.device import Progress, require, resolve
from warprrf.files import write_json
from warprrf.geometry.splats import torch_functions as interop
from warprrf.geometry.splats.rasterizer import RADIO, Rasterizer

ASKED = {"over_gsplat": 1.0, "spectrum_s": 1e-3}
"""Our time over gsplat's at most, and seconds of a spectrum."""


def run_gpu(
    out: str | os.PathLike[str] | None = None,
    *,
    n: int = 1_000_000,
    width: int = 800,
    height: int = 600,
    shape: tuple[int, int] = (90, 360),
    repeats: int = 10,
    seed: int = 0,
    device: Any = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Time ours and gsplat in float32, and a spectrum of ``shape`` with radio's cutoffs; the fastest run counts.

    Args:
        out: write the result to this JSON file.
        n: Gaussians.
        repeats: timed runs of each, in turns.

    Returns:
        ``ours`` and ``gsplat`` (None where it is not installed or there is no GPU), each ``forward_s``, ``backward_s``
        and ``seconds``; ``over_gsplat``; ``spectrum_s`` from Gaussians on the device to one blended channel there;
        ``kernels``: milliseconds of each GPU activity in a pass forward and backward, and of the spectrum, the largest
        first (empty on a CPU, which keeps no such record); ``asked``.

    Raises:
        ImportError: without torch.
        ValueError: if there is no such device.
    """
    torch = require("torch", "baselines")
    on = resolve(device)
    scene = Scene(n, width, height, seed)
    place = wp.device_to_torch(on)
    parameters = [t.detach().to(place).requires_grad_() for t in scene.tensors()]
    weights = scene.loss_weights().to(place)
    cam = photo(width, height)
    means, quaternions, scales, opacities, colors = parameters
    passes: dict[str, Callable[[], Any]] = {
        "ours": lambda: interop.rasterize(means, quaternions, scales, opacities, colors, cam)[0]
    }
    if on.is_cuda and importlib.util.find_spec("gsplat") is not None:
        passes["gsplat"] = _gsplat(parameters, cam)
    raster = Rasterizer(device=on, blending=RADIO)
    inputs = raster.upload(gaussians(n, seed))
    gains = wp.array(np.ones((n, 1)), dtype=wp.float32, device=on)
    receiver = panorama(*shape)

    def spectrum() -> None:
        raster.blend(raster.prepare(*inputs, receiver), gains)
        wp.synchronize_device(on)

    runs: dict[str, list[tuple[float, float]]] = {name: [] for name in passes}
    spectra = []
    for turn in range(repeats + 1):  # the first run compiles and is not counted
        for name, forward in passes.items():
            for parameter in parameters:
                parameter.grad = None
            start = time.perf_counter()
            image = forward()
            wp.synchronize_device(on)
            middle = time.perf_counter()
            (image * weights).sum().backward()
            wp.synchronize_device(on)
            runs[name].append((middle - start, time.perf_counter() - middle))
        start = time.perf_counter()
        spectrum()
        spectra.append(time.perf_counter() - start)
        if progress is not None:
            progress("blending on a GPU" if on.is_cuda else "blending", turn, repeats)
    result: dict[str, Any] = {
        "machine": machine(on),
        "torch_version": torch.__version__,
        "gaussians": n,
        "shape": [height, width],
        "spectrum_shape": list(shape),
        "gsplat": None,
        **{name: _fastest(found[1:]) for name, found in runs.items()},
        "spectrum_s": min(spectra[1:]),
        "kernels": {
            "forward and backward": _activities(lambda: (passes["ours"]() * weights).sum().backward()),
            "spectrum": _activities(spectrum),
        },
        "asked": ASKED,
    }
    if result["gsplat"] is not None:
        result["over_gsplat"] = result["ours"]["seconds"] / result["gsplat"]["seconds"]
    if out is not None:
        write_json(Path(out), result)
    return result


def _gsplat(parameters: list[Any], cam: Any) -> Callable[[], Any]:
    """A pass forward of gsplat over the same tensors."""
    torch, library = require("torch", "baselines"), importlib.import_module("gsplat")
    means, quaternions, scales, opacities, colors = parameters
    pose = torch.tensor(cam.world_to_camera, dtype=means.dtype, device=means.device)[None]
    lens = [[cam.fx, 0, cam.cx], [0, cam.fy, cam.cy], [0, 0, 1]]
    intrinsics = torch.tensor(lens, dtype=means.dtype, device=means.device)[None]
    return lambda: library.rasterization(
        means, quaternions, scales, opacities, colors, pose, intrinsics, cam.width, cam.height, packed=False
    )[0][0]


def _fastest(runs: list[tuple[float, float]]) -> dict[str, float]:
    forward, backward = min(runs, key=sum)
    return {"forward_s": forward, "backward_s": backward, "seconds": forward + backward}


def _activities(work: Callable[[], Any]) -> dict[str, float]:
    """Milliseconds on the GPU of each kernel and copy of ``work``, the largest first."""
    wp.timing_begin()
    work()
    total: dict[str, float] = {}
    for found in wp.timing_end():
        total[found.name] = total.get(found.name, 0.0) + found.elapsed
    return dict(sorted(total.items(), key=lambda item: -item[1]))
