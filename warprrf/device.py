"""Where work runs and how arrays cross the border: devices, split CPU launches, optional packages.

Warp runs a CPU launch on one thread. :func:`launch` splits the index range over a thread pool (Warp releases the
interpreter lock), so every kernel of ours takes ``offset`` first and works on index ``offset + wp.tid()``; an index
owns what it writes, and the result does not depend on the number of threads.
"""

from __future__ import annotations

import copyreg
import importlib
import os
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from copy import copy
from functools import cache, partial
from itertools import pairwise
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
import warp as wp

from warprrf.cache import loading, once

if wp.config.log_level == wp.LOG_INFO:  # Warp's default: it would announce devices and every compiled module
    wp.config.log_level = wp.LOG_ERROR

DeviceLike: TypeAlias = str | wp.Device | None
"""A Warp device or its name (``"cpu"``, ``"cuda:0"``); ``None``: Warp's preferred one, CUDA where there is a GPU."""

Progress = Callable[[str, int, int], None]
"""``progress(stage, done, total)``: called by long work; the library itself never prints.

Stages come one after the other. ``done`` never falls within one, and starts above zero where an earlier run's work is
kept; the last call of a stage has ``done == total``.
"""


def silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody asked for."""


def with_progress(items: Sequence[Any] | np.ndarray, stage: str, progress: Progress | None) -> Iterator[Any]:
    """``items`` one after another; ``progress`` is called once each is done with."""
    for done, item in enumerate(items, 1):
        yield item
        (progress or silent)(stage, done, len(items))


RECENT_S = 15.0  # the rate is that of so many seconds


class TimeLeft:
    """Seconds left of a stage, by its recent rate, for all that shows progress: bars, JSON lines, the viewer.

    What an earlier run did does not count. Nor does the first step once there is a second one: it may have compiled kernels.
    """

    def __init__(self) -> None:
        self._stage: str | None = None
        self._known: deque[tuple[float, int]] = deque()  # times and counts, the oldest first

    def __call__(self, stage: str, done: int, total: int) -> float | None:
        """Seconds until ``done`` is ``total``; None while nothing tells."""
        now, known = time.monotonic(), self._known
        if stage != self._stage or done < known[-1][1]:
            self._stage = stage
            known.clear()
        known.append((now, done))
        while len(known) > 3 and known[2][0] <= now - RECENT_S:
            known.popleft()
        then, before = known[1 if len(known) > 2 else 0]
        if done >= total:
            return 0.0
        return None if done <= before else (total - done) * (now - then) / (done - before)


# Below this many indices a launch is cheaper on one thread than split (a launch costs about 15 us).
MIN_SPLIT = 256
# More pieces than threads, so that an expensive stretch of the range does not leave the other threads idle.
PIECES_PER_THREAD = 4


def resolve(device: DeviceLike = None) -> wp.Device:
    """The Warp device that ``device`` names (``None``: Warp's preferred one, CUDA where there is a GPU).

    Raises:
        ValueError: if Warp has no such device; it says why there is no GPU.
    """
    try:
        start()
        return wp.get_device(device)
    except (ValueError, RuntimeError, TypeError) as error:
        known = ", ".join(str(d) for d in wp.get_devices())
        why = f"; {_why_no_gpu()}" if str(device).startswith("cuda") and not wp.is_cuda_available() else ""
        raise ValueError(f"device: got {device!r}, expected one of {known}{why}") from error


DRIVER_OF_CUDA = {12: "525", 13: "580"}
"""The first driver of each generation of CUDA (NVIDIA, "CUDA Toolkit release notes", minimum required drivers)."""


def _why_no_gpu() -> str:
    """Why Warp has no CUDA device, and what to do."""
    runtime = wp._src.context.runtime
    if not runtime.is_cuda_enabled:
        return f"this build of Warp {wp.__version__} is without CUDA: install PyPI's warp-lang"
    least, found = runtime.min_driver_version, runtime.driver_version
    name = DRIVER_OF_CUDA.get(least[0], f"for CUDA {least[0]}.{least[1]}")
    if found is None:
        return f"no NVIDIA driver was found, or it has no card: Warp needs driver {name} or later"
    if found < least:
        return (
            f"the NVIDIA driver is too old, of CUDA {found[0]}.{found[1]}: Warp {wp.__version__} needs driver {name} "
            f"or later, of CUDA {least[0]}.{least[1]}"
        )
    return "the NVIDIA driver has no card: nvidia-smi and CUDA_VISIBLE_DEVICES say which it may use"


_own = threading.local()


def threads() -> int:
    """CPU threads that one launch is split over: ``WARPRRF_THREADS`` if set, else the cores this process may use, or one
    within :func:`one_thread`."""
    return _threads(getattr(_own, "alone", False))


@contextmanager
def one_thread() -> Iterator[None]:
    """Launches of this thread stay on it, unless ``WARPRRF_THREADS`` is set: others work beside it."""
    before = getattr(_own, "alone", False)
    _own.alone = True
    try:
        yield
    finally:
        _own.alone = before


@cache
def _threads(alone: bool) -> int:
    wanted = os.environ.get("WARPRRF_THREADS")
    if wanted is None and alone:
        return 1
    if wanted is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not wanted.isdigit() or int(wanted) < 1:
        raise ValueError(f"WARPRRF_THREADS: got {wanted!r}, expected a whole number of at least 1")
    return int(wanted)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=max(threads() - 1, 1), thread_name_prefix="warprrf")


if hasattr(os, "register_at_fork"):  # a forked child has none of its parent's threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def launch(
    kernel: wp.Kernel,
    dim: int,
    inputs: Sequence[Any],
    device: DeviceLike = None,
    *,
    grain: int = MIN_SPLIT,
    pieces: int | None = None,
    cuts: Sequence[int] | None = None,
    adjoint: bool = False,
) -> None:
    """Launch ``kernel`` over ``dim`` indices; on a CPU the range is split over all cores.

    The kernel's first argument is ``offset: int`` and is supplied here; ``inputs`` are the others, in order. NumPy's arrays
    are copied to the device, as what the kernel takes.
    A CPU launch is cut into 4 equal parts a thread, of ``grain`` indices at least: few where one index is much work.
    ``pieces`` fixes how many parts and ``cuts`` where, for kernels that own one buffer a part. ``adjoint`` runs the
    kernel's adjoint on the arrays' ``.grad``.
    """
    if dim <= 0:
        return
    where = resolve(device)
    if where.is_cuda:
        bounds: Sequence[int] = [0, dim]
    elif cuts is not None:
        bounds = cuts
    else:
        count = 1
        if pieces is not None:
            count = min(pieces, dim)
        elif threads() > 1:
            count = min(PIECES_PER_THREAD * threads(), max(1, dim // grain))
        bounds = [dim * k // count for k in range(count + 1)]
    kinds = (argument.type for argument in kernel.adj.args[1:])
    arguments = [
        bounds[0],
        *(_as_taken(value, kind, where) for value, kind in zip(inputs, kinds, strict=True)),
    ]
    with loading:
        load_module(kernel.module, where, block_dim=256 if where.is_cuda else 1)
    extra = {"adjoint": True, "adj_inputs": [None] * len(arguments)} if adjoint else {}
    size = bounds[-1] - bounds[0]
    if len(bounds) == 2:
        wp.launch(kernel, dim=size, inputs=arguments, device=where, record_tape=False, **extra)
        return
    # Arguments are packed once; a piece differs in its offset and length.
    whole = wp.launch(
        kernel, dim=size, inputs=arguments, device=where, record_tape=False, record_cmd=True, **extra
    )
    _issue(whole, [(low, high) for low, high in pairwise(bounds) if high > low])


def filled(struct: Any, device: DeviceLike, **values: Any) -> Any:
    """A structure of a kernel, ``struct``, with ``values`` by name; NumPy's arrays are copied to ``device``."""
    where, result = resolve(device), struct()
    for name, value in values.items():
        setattr(result, name, _as_taken(value, struct.vars[name].type, where))
    return result


def _as_taken(value: Any, kind: Any, device: wp.Device) -> Any:
    if isinstance(value, np.ndarray) and isinstance(kind, wp.array):
        return wp.array(value, dtype=kind.dtype, device=device)
    return value


def _issue(whole: wp.Launch, stretches: Sequence[tuple[int, int]]) -> None:
    """Run a CPU launch on all cores, a stretch of its indices at a time: the threads share an iterator, each takes the next
    when it is free."""
    waiting = iter(stretches)

    def work() -> None:
        own = copy(whole)
        own.params, own.fwd_args = list(whole.params), list(whole.fwd_args)
        for low, high in waiting:
            own.set_param_at_index(0, low)
            own.set_dim(high - low)
            own.launch()

    others: list[Future[None]] = []
    try:
        with suppress(
            RuntimeError
        ):  # the main thread has ended, and the pool with it: this thread works alone
            for _ in range(min(threads(), len(stretches)) - 1):
                others.append(_pool().submit(work))
        work()
    finally:  # also after Ctrl-C: nothing that is still written to may be freed
        for other in others:
            if not other.cancel():
                other.result()


def require(module: str, extra: str) -> ModuleType:
    """Import an optional package, or say which extra brings it.

    Raises:
        ImportError: naming the package and the ``pip install`` line.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != module.split(".")[0]:
            raise
        raise ImportError(f'{module} is not installed: pip install "warprrf[{extra}]"') from error


copyreg.pickle(wp.array, lambda a: (partial(wp.array, dtype=a.dtype, device=str(a.device)), (a.numpy(),)))
# Warp's arrays have no pickles of their own, which workers of a cluster need.

_NO_CUDA = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"

_temporary: list[tempfile.TemporaryDirectory[str]] = []  # removed when the process ends


@once
def start() -> None:
    """Start Warp; a CPU is all it needs.

    Raises:
        OSError: if neither its cache nor a temporary folder can be written.

    Warns:
        UserWarning: of an NVIDIA driver that is too old for Warp.
    """
    with _without_cuda_warning():
        _with_kernel_cache(wp.init)
    runtime = wp._src.context.runtime  # Warp's own warning is silenced with its other words
    if runtime.driver_version is not None and runtime.driver_version < runtime.min_driver_version:
        warnings.warn(f"device: there is a CPU alone; {_why_no_gpu()}", UserWarning, stacklevel=2)


def load_module(module: wp.Module, device: wp.Device, block_dim: int) -> None:
    """Load a module of kernels, which is compiled if the cache lacks it."""
    _with_kernel_cache(partial(module.load, device, block_dim=block_dim))


def _with_kernel_cache(use: Callable[[], object]) -> None:
    """Use Warp's cache of kernels, which is in a temporary folder from now on if it cannot be written."""
    try:
        use()
    except OSError as error:
        folder = tempfile.TemporaryDirectory(prefix="warprrf-kernels-")
        _temporary.append(folder)
        warnings.warn(
            f"kernel cache: {error}; kernels are compiled anew by this process, into {folder.name}. Set WARP_CACHE_PATH to "
            "a folder that can be written",
            UserWarning,
            stacklevel=2,
        )
        wp.config.kernel_cache_dir = folder.name
        use()


@contextmanager
def _without_cuda_warning() -> Iterator[None]:
    """Hold standard error back, and give it out without the line about a missing CUDA driver."""
    try:
        held, shown = tempfile.TemporaryFile(), os.dup(2)
    except OSError:  # no temporary folder, or no standard error
        yield
        return
    with held:
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(shown, 2)
            os.close(shown)
            held.seek(0)
            for line in held:
                if not line.startswith(_NO_CUDA):
                    os.write(2, line)


def active_tape() -> wp.Tape | None:
    """The tape of the ``with wp.Tape()`` block that is running, or None."""
    return wp._src.context.runtime.tape


def record(
    tape: wp.Tape, adjoint: Callable[[], object], inputs: Sequence[wp.array], outputs: Sequence[wp.array]
) -> None:
    """Let ``adjoint`` run in the tape's backward pass: it reads the gradients of ``outputs`` and adds to those of
    ``inputs``. Empty arrays and those without a gradient are left out, which the tape would refuse."""

    def backward() -> None:
        adjoint()
        for array in outputs:  # as Warp's own adjoints do: a second backward adds the same again, not more
            if not array.retain_grad:
                array.grad.zero_()

    tape.record_func(backward, [a for a in (*inputs, *outputs) if a.requires_grad and a.size])


def gradient(array: wp.array) -> wp.array:
    """An array's gradient; zeros that nobody keeps if it has none."""
    return array.grad if array.requires_grad else wp.zeros_like(array)
