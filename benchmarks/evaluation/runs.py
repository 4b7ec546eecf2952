"""Runs carried out one by one, here or on the workers of a dask cluster; each finished one is a step that is kept.

A worker takes a run and the setting, which is plain values and paths: on several machines they must see the same files.
It returns figures and pictures, and the process that started the sweep keeps them. A worker that dies has written
nothing: its run goes to another one. A sweep that is killed loses the runs at work; trainings of networks go on from
their checkpoint.
"""

from __future__ import annotations

import os
import platform
import resource
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarks.data import Geometry, Truth
from benchmarks.evaluation.protocol import Run, Setting, shown_receivers, truth_of
from benchmarks.machine import processor_name
from benchmarks.methods import AFTER, METHODS, Fitted, Task, score
from benchmarks.report import Row
from warprrf.cluster import each
from warprrf.device import Progress, require, resolve, threads
from warprrf.files import write_arrays
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import to_db
from warprrf.steps import Attempt, Steps

SPREAD = ("psnr_db", "ssim", "rmse_db", "beam_gain_loss_db")
"""Figures of which the smallest and the largest over the test receivers are kept."""

Result = tuple[Row, dict[str, np.ndarray]]
Execute = Callable[..., Result]


class Lab:
    """What a process keeps between runs: data sets and what receivers see of the geometry."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.geometry = Geometry(Path(setting.geometry), Path(setting.scene), setting.device)
        self._data: dict[str, SpectrumDataset] = {}

    def truth(self, name: str, split: str) -> Truth:
        """The data set of a truth, with the receivers of a split."""
        if name not in self._data:
            self._data[name] = SpectrumDataset.load(self.setting.file(name))
        return truth_of(name, self.setting.key(name), self._data[name], split, self.setting.every)


@lru_cache(maxsize=1)
def _lab(setting: Setting) -> Lab:
    return Lab(setting)


def execute(
    run: Run, setting: Setting, budget_s: float | None = None, progress: Progress | None = None
) -> Result:
    """Carry out ``run``: its figures, and the dB images of the shown receivers.

    Args:
        run: what to do.
        setting: where everything lies.
        budget_s: seconds that the run may take, where another one sets them; see :data:`AFTER`.
        progress: called with ``"transport"``, ``"fit"`` and ``"evaluate"``.
    """
    lab, method = _lab(setting), METHODS[run.method]
    truth = lab.truth(run.truth, run.split)
    test = truth.test
    scratch = Path(setting.scratch) / run.key
    scratch.mkdir(parents=True, exist_ok=True)
    task = Task(
        train=truth.data.subset([]) if method.untaught else truth.train(run.count, run.seed),
        test=test,
        geometry=lab.geometry,
        scratch=scratch,
        progress=progress or (lambda stage, done, total: None),
        slot=f"{run.truth}-{run.split}",
        variant=run.variant,
        seed=run.seed,
        effort=setting.effort,
        depth=int(truth.data.attributes.get("depth", 1)),
        budget_s=budget_s,
    )
    with peak_memory(setting.device) as peak:
        fitted, found = score(run.method, task)
    shown = shown_receivers(test)
    images = [to_db(fitted.predict(test.receivers[i]).path_gain, test.floor) for i in shown]
    shutil.rmtree(scratch)
    row: Row = {
        **vars(run),
        "key": run.key,
        **found,
        **_extremes(found["per_receiver"]),
        **peak,
        "model_bytes": _size(fitted),
        **_ends(fitted.losses),
        "details": fitted.details,
        "note": method.note,
        "processor": processor_name(),
        "device": str(resolve(setting.device)),
        "cores": threads(),
        "host": platform.node(),
        "shown": {"receivers": test.receivers[shown], "blocked": ~test.line_of_sight[shown]},
    }
    arrays = {
        "prediction_db": np.stack(images).astype(np.float32),
        "truth_db": to_db(test.path_gain[shown], test.floor).astype(np.float32),
        "range_db": np.array(test.range_db),
    }
    return row, arrays


def _extremes(per_receiver: dict[str, np.ndarray]) -> Row:
    found: Row = {}
    for name in SPREAD:
        values = np.asarray(per_receiver[name], np.float64)
        values = values[np.isfinite(values)]
        found[f"{name}_min"] = float(values.min()) if len(values) else None
        found[f"{name}_max"] = float(values.max()) if len(values) else None
    return found


def _ends(losses: list[float] | None) -> Row:
    """Mean loss of the first and the last tenth of the steps."""
    if not losses:
        return {"loss_first": None, "loss_last": None}
    tenth = max(1, len(losses) // 10)
    return {"loss_first": float(np.mean(losses[:tenth])), "loss_last": float(np.mean(losses[-tenth:]))}


def _size(fitted: Fitted) -> int | None:
    """Bytes of the saved model."""
    if fitted.size_bytes is not None or fitted.field is None:
        return fitted.size_bytes
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "field.safetensors"
        fitted.field.save(file)
        return file.stat().st_size


@contextmanager
def peak_memory(device: Any = None) -> Iterator[Row]:
    """Fills what it yields with the process's largest resident memory inside the block, and the GPU's where one works.

    ``peak_memory_bytes`` is of the whole process, what was loaded before included. Where the kernel does not let the
    mark be reset it is that of the process's life.
    """
    found: Row = {}
    reset_mark = Path("/proc/self/clear_refs")
    try:
        reset_mark.write_text("5")  # resets VmHWM, man 5 proc
    except OSError:
        found["peak_memory_of_life"] = True
    where = resolve(device)
    torch = sys.modules.get("torch") if where.is_cuda else None
    if torch is not None:
        torch.cuda.reset_peak_memory_stats()
    yield found
    found["peak_memory_bytes"] = _high_water_mark()
    if where.is_cuda:
        torch = sys.modules.get("torch")
        warp_bytes = wp.get_mempool_used_mem_high(where)
        found["peak_gpu_bytes"] = int(warp_bytes) + (
            int(torch.cuda.max_memory_allocated()) if torch is not None else 0
        )


def _high_water_mark() -> int:
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def pictures_of(run: Run) -> str:
    """The file of a run's pictures, beside the steps."""
    return f"runs/{run.key}.npz"


def _inputs(run: Run, setting: Setting) -> list[Any]:
    """What a run's figures depend on, besides its method's version."""
    return [
        setting.key(run.truth),
        setting.geometry_key,
        setting.every if run.split == "random" else 1,
        _effort(run, setting),
    ]


def _effort(run: Run, setting: Setting) -> dict[str, Any]:
    """The part of the effort that a method feels."""
    heads: dict[str, tuple[str, ...]] = {
        "nerf2": ("nerf2",),
        "cgan": ("cgan",),
        "sionna": ("sionna",),
        "sionna-calibrated": ("calibration", "sionna"),
    }
    felt = heads.get(run.method, ("harmonic",) if METHODS[run.method].code == "harmonic" else ("none",))
    return {k: v for k, v in vars(setting.effort).items() if k.startswith(felt)}


def sweep(
    runs: Iterable[Run],
    setting: Setting,
    steps: Steps,
    *,
    scheduler: str | None = None,
    workers: int = 1,
    progress: Progress | None = None,
    work: Execute = execute,
) -> dict[Run, Row]:
    """Carry out the runs that ``steps`` does not hold and return the figures of all.

    Args:
        runs: what to do; see :func:`benchmarks.evaluation.protocol.plan`.
        setting: where everything lies.
        steps: where finished runs are kept, pictures in ``runs/``.
        scheduler: address of a running dask scheduler, such as ``"tcp://lab:8786"``.
        workers: processes of a local cluster otherwise, which share the cores; 0 works in this process, without dask.
        progress: called with ``"runs"``.
        work: what carries out one run; :func:`execute` but for tests.

    Raises:
        ImportError: without dask.distributed, where it is needed.
        RuntimeError: naming the run that failed; those that were finished are kept.
    """
    everything = list(dict.fromkeys(runs))
    tell = progress or (lambda stage, done, total: None)
    found: dict[Run, Row] = {}

    for run in everything:
        kept = steps.kept(run.key, **_known(run, setting))
        if kept is not None:
            found[run] = kept
    tell("runs", len(found), len(everything))
    pending = [run for run in everything if run not in found]
    # What takes another run's seconds comes after that run.
    parts = [[r for r in pending if (r.method in AFTER) == late] for late in (False, True)]
    with connected(scheduler, workers if pending else 0) as client:
        do = partial(_named, work, setting, () if client is not None else (tell,))
        for part in parts:
            jobs = [(run, _budget(run, found)) for run in part]
            for k, (row, arrays) in each(do, jobs, client):
                found[part[k]] = steps.run(
                    part[k].key,
                    partial(_keep, steps.folder, part[k], row, arrays),
                    **_known(part[k], setting),
                )
                tell("runs", len(found), len(everything))
    return {run: found[run] for run in everything}


def _known(run: Run, setting: Setting) -> dict[str, Any]:
    return {
        "version": METHODS[run.method].version,
        "inputs": _inputs(run, setting),
        "outputs": (pictures_of(run),),
    }


def _budget(run: Run, found: dict[Run, Row]) -> float | None:
    """Seconds that the run before took from raw spectra to a model."""
    if run.method not in AFTER:
        return None
    other = found.get(Run(run.truth, run.split, run.count, run.seed, AFTER[run.method]))
    return None if other is None else float(other["transport_s"]) + float(other["fit_s"])


def _named(
    work: Execute, setting: Setting, progress: tuple[Any, ...], job: tuple[Run, float | None]
) -> Result:
    """Carry out a run; an error names it."""
    try:
        return work(job[0], setting, job[1], *progress)
    except Exception as error:
        raise RuntimeError(f"{job[0].key}: {type(error).__name__}: {error}") from error


def _keep(folder: Path, run: Run, row: Row, arrays: dict[str, np.ndarray], _: Attempt) -> Row:
    write_arrays(folder / pictures_of(run), arrays)
    return row


@contextmanager
def connected(scheduler: str | None, workers: int, share: int | None = None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a local cluster of processes with ``share`` threads each, equal parts
    of the cores by default; None for no workers.

    Raises:
        ImportError: without dask.distributed, where it is needed.
    """
    if scheduler is None and workers == 0:
        yield None
        return
    distributed = require("distributed", extra="cluster")
    if scheduler is not None:
        with distributed.Client(scheduler, set_as_default=False) as client:
            yield client
        return
    threads_each = str(share or max(1, (os.cpu_count() or 1) // workers))
    with (
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,  # a part may need what the machine has: no worker is stopped for it
            dashboard_address=None,
            env={"WARPRRF_THREADS": threads_each, "OMP_NUM_THREADS": threads_each},
            silence_logs="CRITICAL",
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client
