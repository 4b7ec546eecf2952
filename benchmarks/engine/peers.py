"""Renderers of one scene, each in a process of its own, timed in turns.

A pool of threads that has worked spins for a while before it sleeps, on cores that another renderer is being timed on:
OpenMP's slows ours down by a quarter on two cores. Hence one process a renderer, one turn at a time, and a rest before
each in which the pools of the others fall asleep. A turn is an untimed run, which wakes its own threads, and
:data:`RUNS` timed ones.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.engine.scenes import photo, room
from benchmarks.engine.torch_renderer import render_with_torch
from warprrf.device import Progress, require
from warprrf.geometry.splats import torch_functions as interop

if TYPE_CHECKING:
    import torch

RUNS = 3
"""Timed runs a turn."""
REST_S = 0.3
"""Rest before a turn [s]: OpenMP's threads sleep after 0.2 s without work at the latest."""
_PATIENCE_S = 600.0


@dataclass(frozen=True)
class Scene:
    """What is rendered: ``n`` Gaussians of :func:`~benchmarks.engine.scenes.room` on a photo."""

    n: int
    width: int
    height: int
    seed: int = 0

    def tensors(self) -> list[torch.Tensor]:
        """Means, quaternions, scales, opacities and colours, each with a gradient."""
        torch = require("torch", "baselines")
        return [torch.tensor(value, requires_grad=True) for value in room(self.n, self.seed)]

    def loss_weights(self) -> torch.Tensor:
        """Of the image's elements in the loss, shape ``(height, width, 3)``."""
        torch = require("torch", "baselines")
        rng = np.random.default_rng(self.seed)
        return torch.from_numpy(rng.normal(size=(self.height, self.width, 3)).astype(np.float32))


@dataclass
class Measured:
    """Of one renderer: seconds forward, backward and of processor time of every timed run; its image, and the
    gradients of the five parameters."""

    runs: list[tuple[float, float, float]]
    image: np.ndarray
    gradients: list[np.ndarray]

    def figures(self, passing: int) -> dict[str, float]:
        """Those of the fastest run, and per pair of pixel and Gaussian of ``passing`` that contribute."""
        forward, backward, _ = min(self.runs, key=lambda run: run[0] + run[1])
        return {
            "forward_s": forward,
            "backward_s": backward,
            "seconds": forward + backward,
            "cpu_seconds": min(run[2] for run in self.runs),
            "ns_per_passing_pair": 1e9 * (forward + backward) / max(passing, 1),
        }


def _ours(scene: Scene, parameters: list[torch.Tensor]) -> Callable[[], torch.Tensor]:
    # Torch checks the tensors and takes the loss here; its threads would spin beside ours.
    require("torch", "baselines").set_num_threads(1)
    cam = photo(scene.width, scene.height)
    means, quaternions, scales, opacities, colors = parameters
    return lambda: interop.rasterize(means, quaternions, scales, opacities, colors, cam)[0]


def _torch(scene: Scene, parameters: list[torch.Tensor]) -> Callable[[], torch.Tensor]:
    cam = photo(scene.width, scene.height)
    means, quaternions, scales, opacities, colors = parameters
    return lambda: render_with_torch(means, quaternions, scales, opacities, colors, cam).features


RENDERERS: dict[str, Callable[..., Any]] = {"ours": _ours, "torch": _torch}
"""Ours and its peer by name: function of the scene and its tensors that returns the function to time."""


def take_turns(
    makers: dict[str, Callable[..., Any]],
    scene: Scene,
    *,
    threads: int,
    turns: int,
    progress: Progress | None = None,
) -> dict[str, Measured]:
    """Time forward and backward of each renderer on ``threads`` threads, ``turns`` times in turn.

    Args:
        makers: name -> function of the scene and its tensors that returns the function to time, as
            :data:`RENDERERS`.

    Raises:
        RuntimeError: if a process ends before it is done.
    """
    context = multiprocessing.get_context("spawn")
    workers = {}
    for name, make in makers.items():
        mine, other = context.Pipe()
        process = context.Process(target=_work, args=(other, make, scene, threads), daemon=True)
        process.start()
        other.close()
        workers[name] = (process, mine)
    runs: dict[str, list[tuple[float, float, float]]] = {name: [] for name in makers}
    try:
        for name in makers:
            _answer(name, workers)
        for turn in range(turns):
            for name in makers:
                time.sleep(REST_S)
                workers[name][1].send(RUNS)
                runs[name] += _answer(name, workers)
            if progress is not None:
                progress("blend", turn + 1, turns)
        found = {}
        for name in makers:
            workers[name][1].send(0)
            found[name] = Measured(runs[name], *_answer(name, workers))
    finally:
        for process, pipe in workers.values():
            pipe.close()
            process.join(10)
            if process.is_alive():
                process.terminate()
    return found


def _answer(name: str, workers: dict[str, tuple[Any, Any]]) -> Any:
    pipe = workers[name][1]
    try:
        if pipe.poll(_PATIENCE_S):
            return pipe.recv()
    except (EOFError, ConnectionError):
        pass
    raise RuntimeError(
        f"{name}: its process ended or did not answer within {_PATIENCE_S:g} s; see its error above"
    )


def _work(pipe: Any, make: Callable[..., Any], scene: Scene, threads: int) -> None:
    """A process: as many timed runs as each message asks for; at zero the image and the gradients, then the end."""
    os.environ["WARPRRF_THREADS"] = str(threads)  # read when the first kernel is launched
    torch = require("torch", "baselines")
    torch.set_num_threads(threads)
    parameters, weights = scene.tensors(), scene.loss_weights()
    render = make(scene, parameters)
    run = partial(_timed, render, parameters, weights)
    run()
    pipe.send("ready")
    while count := pipe.recv():
        run()
        pipe.send([run()[0] for _ in range(count)])
    _, image, gradients = run()
    pipe.send((image.numpy(), [g.numpy() for g in gradients]))


def _timed(
    render: Callable[[], torch.Tensor], parameters: list[torch.Tensor], weights: torch.Tensor
) -> tuple[tuple[float, float, float], torch.Tensor, Sequence[torch.Tensor]]:
    """Seconds forward and backward, processor time of both, the image, and the gradients."""
    torch = require("torch", "baselines")
    cpu = time.process_time()
    start = time.perf_counter()
    image = render()
    middle = time.perf_counter()
    gradients = torch.autograd.grad((image * weights).sum(), parameters)
    end = time.perf_counter()
    return (middle - start, end - middle, time.process_time() - cpu), image.detach(), gradients
