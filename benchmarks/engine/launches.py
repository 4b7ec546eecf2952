"""Blending apart from its peers: cost per contributing pair, all cores against one, a spectrum from many Gaussians.

Times of one core are processor time of the process, the least of many repeats: on a busy machine wall time measures
the neighbours. Where cores are compared, wall time is meant, and the two ways of using them take turns.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from benchmarks.engine.form_kernels import count_passing
from benchmarks.engine.scenes import gaussians, panorama, photo, room
from warprrf.device import launch, threads
from warprrf.geometry.splats.rasterizer import GRAIN, RADIO, Prepared, Rasterizer
from warprrf.geometry.splats.render import blend_weights, render
from warprrf.kernels.raster import blocks

PAIR_NS = {"dense": 4.0, "sparse": 2.0}
"""Asked: nanoseconds of one core per pair of pixel and Gaussian that reaches alpha_min, forward."""
CORES_THROUGHPUT = 0.9
"""Asked: throughput of one launch on all cores over that of as many one-core processes."""
SPECTRUM_S = 0.150
"""Asked: seconds for a spectrum of 90 x 180 from 100 000 Gaussians on two cores."""


def pair_costs(
    counts: dict[str, int], *, width: int = 400, height: int = 300, repeats: int = 30, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Processor time per contributing pair, in rooms of so many Gaussians.

    Fewer Gaussians are larger ones: each pixel sees as many, and a block of pixels is covered more evenly.

    Args:
        counts: name of the scene -> Gaussians.

    Returns:
        Per scene: ``gaussians``, ``passing_pairs``, those per pixel, nanoseconds per pair of blending alone
        (``forward_ns``), of projecting and listing (``prepare_ns``) and of the adjoint (``backward_ns``), and what is
        asked of ``forward_ns`` where something is (``asked_ns``).
    """
    found: dict[str, dict[str, Any]] = {}
    cam = photo(width, height)
    for name, n in counts.items():
        raster, inputs, features = _scene(n, seed)
        prepared = raster.prepare(*inputs, cam)
        _, adjoint = raster.blend_with_adjoint(prepared, features)
        passing = passing_pairs(prepared)
        times = {
            "forward_ns": _least(partial(raster.blend, prepared, features), repeats),
            "prepare_ns": _least(partial(raster.prepare, *inputs, cam), repeats),
            "backward_ns": _least(adjoint, repeats),
        }
        found[name] = {
            "gaussians": n,
            "passing_pairs": passing,
            "passing_pairs_per_pixel": passing / (width * height),
            **{key: 1e9 * seconds / max(passing, 1) for key, seconds in times.items()},
        }
        if name in PAIR_NS:
            found[name]["asked_ns"] = PAIR_NS[name]
    return found


def spectrum_times(
    n: int = 100_000, *, shape: tuple[int, int] = (90, 180), repeats: int = 10, seed: int = 0
) -> dict[str, Any]:
    """Wall and processor time of one spectrum from ``n`` Gaussians with radio's cutoffs, from the Gaussians on:
    one blended channel (``render_s``), and blending weights with their ranges for a fit (``weights_s``)."""
    g, cam = gaussians(n, seed), panorama(*shape)
    features = np.ones((n, 1), dtype=np.float32)
    found: dict[str, Any] = {"gaussians": n, "shape": shape, "threads": threads()}
    tasks: dict[str, Callable[[], Any]] = {
        "render": lambda: render(g, cam, features, blending=RADIO, device="cpu"),
        "weights": lambda: blend_weights(g, cam, device="cpu"),
    }
    for name, task in tasks.items():
        task()
        found[f"{name}_cpu_s"] = _least(task, repeats)
        found[f"{name}_s"] = _least(task, repeats, time.perf_counter)
    found["asked_s"] = SPECTRUM_S
    return found


def cores(
    n: int = 200_000, *, width: int = 1600, height: int = 1200, repeats: int = 20, seed: int = 0
) -> dict[str, Any]:
    """One launch of the forward kernel on all cores against as many processes of one core with equal shares of it.

    The processes start their shares together and the slowest counts; they and the launch take turns.

    Returns:
        ``launch_s``, ``processes_s``, ``throughput`` (of the launch over that of the processes), ``asked``, and
        whether image and gradients have the same bits on all cores and on one (``identical``).

    Raises:
        RuntimeError: if a process fails.
    """
    count = threads()
    settings = (n, width, height, seed)
    run, _ = _forward(*settings)
    run()
    context = multiprocessing.get_context("spawn")
    barrier, answers = context.Barrier(count + 1), context.Queue()
    before = os.environ.get("WARPRRF_THREADS")
    os.environ["WARPRRF_THREADS"] = "1"  # read by the new processes alone: this one has decided already
    workers = [
        context.Process(target=_share, args=(settings, k, count, repeats, barrier, answers), daemon=True)
        for k in range(count)
    ]
    try:
        for worker in workers:
            worker.start()
    finally:
        if before is None:
            del os.environ["WARPRRF_THREADS"]
        else:
            os.environ["WARPRRF_THREADS"] = before
    own, theirs = [], []
    try:
        for _ in range(repeats):
            start = time.perf_counter()
            run()
            own.append(time.perf_counter() - start)
            barrier.wait(600)  # they start
            barrier.wait(600)  # all are done
            theirs.append(max(answers.get(timeout=60) for _ in workers))
        digests = {answers.get(timeout=600) for _ in workers}
    except Exception as error:
        raise RuntimeError(f"processes: {count} were started and did not finish") from error
    finally:
        for worker in workers:
            worker.join(10)
            if worker.is_alive():
                worker.terminate()
    return {
        "gaussians": n,
        "shape": [height, width],
        "cores": count,
        "launch_s": min(own),
        "processes_s": min(theirs),
        "throughput": min(theirs) / min(own),
        "asked": CORES_THROUGHPUT,
        "identical": digests == {_digest(*settings)},
    }


def passing_pairs(prepared: Prepared) -> int:
    """Pairs of pixel and Gaussian that contribute with photos' cutoffs: those in front of where the light is spent."""
    rules = Rasterizer(device="cpu", per_pixel=True).blending.rules
    count = wp.zeros((prepared.camera.height, prepared.camera.width), dtype=int, device="cpu")
    launch(
        count_passing,
        prepared.tiles * prepared.view.tile**2,
        [prepared.splats, prepared.ids, prepared.starts, prepared.view, rules, count],
        device="cpu",
    )
    return int(count.numpy().sum(dtype=np.int64))


def _scene(n: int, seed: int) -> tuple[Rasterizer, tuple[wp.array, wp.array, wp.array, wp.array], wp.array]:
    raster = Rasterizer(device="cpu")
    inputs = raster.upload(gaussians(n, seed))
    for array in inputs:
        array.requires_grad = True
    return raster, inputs, wp.array(room(n, seed)[4], dtype=wp.float32, device="cpu", requires_grad=True)


def _forward(n: int, width: int, height: int, seed: int) -> tuple[Callable[..., None], np.ndarray]:
    """The bare launch of the forward kernel, and the work up to each tile."""
    raster, inputs, features = _scene(n, seed)
    prepared = raster.prepare(*inputs, photo(width, height))
    shape = (height, width)
    out = [wp.empty(s, dtype=wp.float32, device="cpu") for s in ((*shape, 3), shape, shape, shape)]
    out += [wp.empty(shape, dtype=kind, device="cpu") for kind in (int, wp.float32)]
    arguments = [
        prepared.splats, prepared.ids, prepared.starts, prepared.view, raster.blending.rules, features, 0,
        wp.zeros(3, dtype=wp.float32, device="cpu"), *out,
    ]  # fmt: skip
    kernel = blocks.build_blend(wp.float32, 3)

    def run(cuts: list[int] | None = None) -> None:
        launch(kernel, prepared.tiles, arguments, device="cpu", grain=GRAIN, cuts=cuts)

    return run, prepared.starts.numpy() + np.arange(prepared.tiles + 1)


def _share(
    settings: tuple[int, int, int, int], k: int, count: int, repeats: int, barrier: Any, answers: Any
) -> None:
    """A process: part ``k`` of ``count`` of the launch, as often as asked; then the digest of the whole pass."""
    run, work = _forward(*settings)
    tiles = np.searchsorted(work, work[-1] * np.array([k, k + 1]) / count)
    share = [int(t) for t in tiles]
    run(share)
    for _ in range(repeats):
        barrier.wait(600)
        start = time.perf_counter()
        run(share)
        seconds = time.perf_counter() - start
        barrier.wait(600)
        answers.put(seconds)
    answers.put(_digest(*settings))


def _digest(n: int, width: int, height: int, seed: int) -> str:
    """Of the bits of an image and of the gradients of its plain sum."""
    raster, inputs, features = _scene(n, seed)
    image, adjoint = raster.blend_with_adjoint(raster.prepare(*inputs, photo(width, height)), features)
    image.features.grad.fill_(1.0)
    adjoint()
    digest = hashlib.sha256(image.features.numpy().tobytes())
    for array in (*inputs, features):
        digest.update(array.grad.numpy().tobytes())
    return digest.hexdigest()


def _least(task: Callable[[], Any], repeats: int, clock: Callable[[], float] = time.process_time) -> float:
    """Fewest seconds of ``repeats`` calls, after one that warms up."""
    task()
    times = []
    for _ in range(repeats):
        start = clock()
        task()
        times.append(clock() - start)
    return min(times)
