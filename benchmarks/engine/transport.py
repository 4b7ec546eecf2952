"""Stage-2 transport of hundreds of receivers: bytes on disk, time and peak memory of storing and of fitting from disk.

A few receivers are stored for real; their files, linked again and again, stand for the rest, so that a fit of the
whole number is run and its memory measured, not estimated. Time to store the rest is extrapolated. Each step runs in a
process of its own, whose peak of resident memory the system reports.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.engine.scenes import ROOM, room
from warprrf.device import Progress
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.rf.fields import files as field_files
from warprrf.rf.fields.harmonic.field import HarmonicField
from warprrf.rf.fields.harmonic.store import FORMAT, HEADER, StoredTransport, store_transport
from warprrf.rf.fields.harmonic.transport import transport

ASKED = {"receivers": 800, "shape": (90, 180), "gaussians": 1_000_000, "memory_gb": 8.0}
BATCH = 10  # receivers a step of the fit, as by default


def run_transport(
    *,
    gaussians: int = ASKED["gaussians"],  # type: ignore[assignment]
    measured: int = 4,
    receivers: int = ASKED["receivers"],  # type: ignore[assignment]
    shape: tuple[int, int] = (90, 180),
    steps: int = 3,
    seed: int = 0,
    folder: str | os.PathLike[str] | None = None,
    device: Any = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Store ``measured`` receivers in a room of ``gaussians``, and fit ``receivers`` from disk for ``steps`` steps.

    Args:
        folder: on the disk to use; default: a temporary folder.
        progress: called with ("transport", steps done, 3).

    Returns:
        ``seconds_per_receiver`` and, for all, ``hours_to_store``; ``bytes_per_receiver``, ``bytes_per_pair``,
        ``pairs_per_pixel`` and ``disk_gb`` of all receivers, with and without the fit's sorted batches
        (``batches_gb``); ``store_peak_gb`` and ``fit_peak_gb`` of memory; ``first_pass_s`` to sort the batches and
        ``seconds_per_step`` afterwards; ``gaussians_seen`` by the measured receivers, which are what the fit learns;
        ``dropped_max``, ``dropped_mean``: blending weight a pixel that top-K leaves
        out; ``weight_error``: largest relative error of a stored weight.

    Raises:
        ValueError: if fewer receivers than ``measured`` are asked for.
    """
    if not 1 <= measured <= receivers:
        raise ValueError(f"measured: got {measured}, expected 1 to receivers ({receivers})")
    with tempfile.TemporaryDirectory(dir=folder) as name:
        first, whole = Path(name) / "measured", Path(name) / "whole"
        told = iter(range(1, 4))

        def tell() -> None:
            if progress is not None:
                progress("transport", next(told), 3)

        stored = _apart(_store, first, gaussians, measured, shape, seed, device)
        tell()
        error = _apart(_error, first, gaussians, shape, seed, device)
        tell()
        _repeat(first, whole, receivers)
        fitted = _apart(_fit, whole, gaussians, steps, seed, device)
        tell()
        store = StoredTransport(first)
        per_receiver = store.bytes / measured
        batches = sum(f.stat().st_size for f in whole.rglob("*.npy"))
        return {
            "asked": ASKED,
            "gaussians": gaussians,
            "measured": measured,
            "receivers": receivers,
            "shape": list(shape),
            "seconds_per_receiver": stored["seconds"] / measured,
            "hours_to_store": stored["seconds"] / measured * receivers / 3600,
            "bytes_per_receiver": per_receiver,
            "bytes_per_pair": store.bytes / max(store.pairs, 1),
            "pairs_per_pixel": store.pairs / (measured * shape[0] * shape[1]),
            "disk_gb": per_receiver * receivers / 1e9,
            "batches_gb": batches / 1e9,
            "gaussians_seen": fitted["gaussians_seen"],
            "store_peak_gb": stored["peak_gb"],
            "fit_peak_gb": fitted["peak_gb"],
            "first_pass_s": fitted["first_s"],
            "seconds_per_step": fitted["seconds_per_step"],
            "dropped_max": store.dropped[0],
            "dropped_mean": store.dropped[1],
            "weight_error": error["weight_error"],
        }


def positions(count: int, seed: int) -> np.ndarray:
    """Receivers in the room, 1 m off its walls, shape ``(count, 3)`` [m]."""
    return np.random.default_rng(seed).uniform(1.0, np.asarray(ROOM) - 1.0, (count, 3))


def cover(count: int, seed: int) -> Gaussians:
    """The room of :func:`benchmarks.engine.scenes.room` as Gaussians."""
    means, quaternions, scales, opacities, _ = room(count, seed)
    return Gaussians(means, quaternions, scales, opacities, np.zeros((count, 1, 3), np.float32))


def _apart(work: Any, *arguments: Any) -> dict[str, float]:
    """What ``work`` returns in a fresh process, and that process' peak of resident memory."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        found: dict[str, float] = pool.apply(_measured, (work, arguments))
    return found


def _measured(work: Any, arguments: tuple[Any, ...]) -> dict[str, float]:
    import resource

    figures = work(*arguments)
    return {**figures, "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9}


def _store(
    folder: Path, gaussians: int, count: int, shape: tuple[int, int], seed: int, device: Any
) -> dict[str, float]:
    g = cover(gaussians, seed)
    transport(
        g[: min(1000, gaussians)], positions(1, seed), shape, device=device
    )  # compile outside the clock
    start = time.perf_counter()
    store_transport(folder, g, positions(count, seed), shape, device=device)
    return {"seconds": time.perf_counter() - start}


def _error(folder: Path, gaussians: int, shape: tuple[int, int], seed: int, device: Any) -> dict[str, float]:
    store = StoredTransport(folder)
    exact = transport(cover(gaussians, seed), store.receivers[:1], shape, device=device)
    return {"weight_error": float(np.abs(store.subset([0]).weight / exact.weight - 1).max(initial=0.0))}


def _repeat(source: Path, target: Path, count: int) -> None:
    """A store of ``count`` receivers whose files are links to those of ``source``, in turn."""
    tensors, about = field_files.read(source / HEADER, FORMAT)
    known = tensors["receivers"]
    moved = known[np.arange(count) % len(known)] + 1e-3 * np.arange(count)[:, None]
    field_files.write(target / HEADER, {"receivers": moved}, about, FORMAT)
    for i in range(count):
        name = "receiver_{:05d}.safetensors"
        os.link(source / name.format(i % len(known)), target / name.format(i))


def _fit(folder: Path, gaussians: int, steps: int, seed: int, device: Any) -> dict[str, float]:
    store = StoredTransport(folder)
    shape = (len(store.receivers), *store.shape)
    rng = np.random.default_rng(seed)
    spectra = SimpleNamespace(
        receivers=store.receivers,
        transmitter=np.array([2.0, 3.0, 3.2]),
        frequency_hz=300e9,
        path_gain=(10 ** rng.uniform(-14, -9, shape)).astype(np.float32),
        delay_s=None,
        aod=None,
        floor=1e-14,
        range_db=(-140.0, -90.0),
        beam_sigma_rad=np.radians(2.0),
    )
    marks: list[float] = []
    start = time.perf_counter()
    field = HarmonicField.fit(
        cover(gaussians, seed), spectra, "rf3dgs+", transport=store, iterations=steps, batch=BATCH, seed=seed,  # type: ignore[arg-type]
        device=device, progress=lambda *_: marks.append(time.perf_counter()),
    )  # fmt: skip
    return {
        "gaussians_seen": field.report["gaussians_seen"],
        "first_s": marks[0] - start,
        "seconds_per_step": float(np.mean(np.diff(marks))) if len(marks) > 1 else float("nan"),
    }
