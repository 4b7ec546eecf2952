"""Runs carried out one by one, here or on the workers of a dask cluster; each finished one is a row that is kept.

A worker takes a run and the setting, which is plain values and paths: on several machines they must see the same files.
It returns figures and pictures, and the process that started the sweep keeps them. A worker that dies has written
nothing: its run goes to another one. A sweep that is killed loses the runs at work; trainings of networks go on from
their checkpoint. Rows lie in one file, small enough to be kept with the code, so that a sweep goes on elsewhere.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.data import Geometry, Truth
from benchmarks.evaluation.lpips import Lpips
from benchmarks.evaluation.protocol import Place, Run, Setting, shown_receivers, truth_of
from benchmarks.machine import connected, peak_memory, processor_name
from benchmarks.methods import AFTER, METHODS, Fitted, Task, score
from benchmarks.report import Row
from warprrf.cluster import each
from warprrf.device import Progress, resolve, threads
from warprrf.files import plain, write_arrays, write_text
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import to_db
from warprrf.steps import digest

SPREAD = ("psnr_db", "ssim", "rmse_db", "beam_gain_loss_db")
"""Figures of which the smallest and the largest over the test receivers are kept."""

Result = tuple[Row, dict[str, np.ndarray]]
Execute = Callable[..., Result]


class Rows:
    """Finished runs in a file, a JSON object a line; runs on other data stand beside each other.

    Raises:
        ValueError: if the file is damaged.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._lines: dict[tuple[str, str], Row] = {}
        text = self.path.read_text() if self.path.is_file() else ""
        for number, line in enumerate(text.splitlines(), 1):
            try:
                one = json.loads(line)
                self._lines[one["row"]["key"], str(one["known"])] = dict(one["row"])
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(f"rows: line {number} of {self.path} is damaged: {error}") from error

    def get(self, run: Run, known: str) -> Row | None:
        """The row of ``run``, if what it depends on has the digest ``known``."""
        row = self._lines.get((run.key, known))
        return None if row is None else dict(row)

    def put(self, run: Run, known: str, row: Row) -> Row:
        """Keep a row, as JSON holds it; the file is replaced at once."""
        self._lines[run.key, known] = plain(row)
        lines = [
            json.dumps({"known": made, "row": one}, allow_nan=False)
            for (_, made), one in sorted(self._lines.items(), key=lambda item: item[0])
        ]
        write_text(self.path, "".join(f"{line}\n" for line in lines))
        return dict(self._lines[run.key, known])

    def __iter__(self) -> Iterator[Row]:
        return iter(self._lines.values())


class Lab:
    """What a process keeps between runs: data sets, and what receivers see of the geometry of one room."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self._data: dict[str, SpectrumDataset] = {}
        self._room: tuple[str, Geometry] | None = None

    def truth(self, name: str, split: str) -> Truth:
        """The data set of a truth, with the receivers of a split."""
        place = self.setting.place(name)
        if name not in self._data:
            self._data = {name: SpectrumDataset.load(place.file)}  # a set fills hundreds of megabytes
        return truth_of(name, place.content, self._data[name], split, self.setting.every)

    def geometry(self, place: Place) -> Geometry:
        """The room of a truth."""
        if self._room is None or self._room[0] != place.geometry:
            self._room = place.geometry, Geometry(Path(place.geometry), Path(place.xml), self.setting.device)
        return self._room[1]


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
    start, lab, method, place = time.monotonic(), _lab(setting), METHODS[run.method], setting.place(run.truth)
    truth = lab.truth(run.truth, run.split)
    test = truth.test
    lpips = Lpips.found(setting.lpips, test.shape)
    scratch = Path(setting.scratch) / run.key
    scratch.mkdir(parents=True, exist_ok=True)
    task = Task(
        train=truth.data.subset([]) if method.untaught else truth.train(run.count, run.seed),
        test=test,
        geometry=lab.geometry(place),
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
        fitted, found = score(run.method, task, perceptual=None if isinstance(lpips, str) else lpips)
    if isinstance(lpips, str):
        found["lpips_reason"] = lpips
    shown = shown_receivers(test)
    images = [to_db(fitted.predict(test.receivers[i]).path_gain, test.floor) for i in shown]
    shutil.rmtree(scratch)
    per_receiver = found.pop("per_receiver")
    row: Row = {
        **vars(run),
        "key": run.key,
        "data": place.content[:12],
        "room": place.geometry_content[:12],
        **found,
        **_extremes(per_receiver),
        **peak,
        "model_bytes": _size(fitted),
        **_ends(fitted.losses),
        "loss_curve": _curve(fitted.losses) if method.network else None,
        "details": fitted.details,
        "note": method.note,
        "processor": processor_name(),
        "device": str(resolve(setting.device)),
        "cores": threads(),
        "shown": {"receivers": test.receivers[shown], "blocked": ~test.line_of_sight[shown]},
        "wall_s": time.monotonic() - start,
    }
    arrays = {
        "prediction_db": np.stack(images).astype(np.float32),
        "truth_db": to_db(test.path_gain[shown], test.floor).astype(np.float32),
        "range_db": np.array(test.range_db),
    }
    return row, arrays


def _curve(losses: list[float] | None, points: int = 40) -> list[float]:
    """Mean loss of each of some equal parts of the steps."""
    parts = np.array_split(np.asarray(losses or [], np.float64), points)
    return [float(part.mean()) for part in parts if len(part)]


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


def pictures_of(run: Run) -> str:
    """The file of a run's pictures, in the folder of results."""
    return f"runs/{run.key}.npz"


def known(run: Run, setting: Setting) -> str:
    """Digest of what a run's figures depend on.

    Of data and reconstruction it holds how they were made: another machine makes them anew, and not to the same bits. A
    row says which ones it is of.
    """
    place = setting.place(run.truth)
    every = setting.every if run.split == "random" else 1
    version = METHODS[run.method].version
    return digest(version, place.made, place.geometry_made, every, _effort(run, setting))


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


_GUESS_S = {
    "harmonic": 120.0,
    "bistatic": 150.0,
    "lookups": 3.0,
    "networks": 1500.0,
    "sionna": 600.0,
    "metrics": 3.0,
}
"""Seconds of a run that no row tells of, by its method's code."""


def estimate_s(pending: Iterable[Run], finished: Iterable[Row]) -> float:
    """About how many seconds ``pending`` runs take: each as long as the finished one of its method whose number of
    training receivers is nearest."""
    times: dict[str, list[tuple[int, float]]] = {}
    for row in finished:
        times.setdefault(row["method"], []).append((row["count"], row["wall_s"]))
    total = 0.0
    for run in pending:
        near = min(times.get(run.method, []), key=lambda one: abs(one[0] - run.count), default=None)
        total += _GUESS_S[METHODS[run.method].code] if near is None else near[1]
    return total


def missing(runs: Iterable[Run], setting: Setting, rows: Rows) -> list[Run]:
    """The runs that ``rows`` does not hold, or holds without LPIPS where its weights are named."""

    def complete(row: Row | None) -> bool:
        return row is not None and not (setting.lpips and row.get("lpips") is None)

    return [run for run in dict.fromkeys(runs) if not complete(rows.get(run, known(run, setting)))]


def sweep(
    runs: Iterable[Run],
    setting: Setting,
    rows: Rows,
    pictures: Path,
    *,
    minutes: float | None = None,
    scheduler: str | None = None,
    workers: int = 1,
    progress: Progress | None = None,
    work: Execute = execute,
) -> dict[Run, Row]:
    """Carry out the runs that are :func:`missing` and return the figures of all that are finished, those without LPIPS
    among them.

    Args:
        runs: what to do; see :func:`benchmarks.evaluation.protocol.plan`.
        setting: where everything lies.
        rows: where finished runs are kept.
        pictures: folder in which ``runs/`` gets a file of pictures for each run.
        minutes: runs are begun for so long; those that were not are left out. None: all.
        scheduler: address of a running dask scheduler, such as ``"tcp://lab:8786"``.
        workers: processes of a local cluster otherwise, which share the cores; 0 works in this process, without dask.
        progress: called with ``"runs"``.
        work: what carries out one run; :func:`execute` but for tests.

    Raises:
        ImportError: without dask.distributed, where it is needed.
        RuntimeError: naming the run that failed; those that were finished are kept.
    """
    everything = list(dict.fromkeys(runs))
    end = None if minutes is None else time.time() + 60.0 * minutes
    tell = progress or (lambda stage, done, total: None)
    pending = missing(everything, setting, rows)
    done = len(everything) - len(pending)
    kept = ((run, rows.get(run, known(run, setting))) for run in everything)
    found = {run: row for run, row in kept if row is not None}
    tell("runs", done, len(everything))
    # What takes another run's seconds comes after that run.
    parts = [[r for r in pending if (r.method in AFTER) == late] for late in (False, True)]
    with connected(scheduler, workers if pending else 0) as client:
        do = partial(_named, work, setting, () if client is not None else (tell,), end)
        for part in parts:
            jobs = [(run, _budget(run, setting, rows)) for run in part]
            for k, result in each(do, jobs, client):
                if result is None:  # its time was over
                    continue
                write_arrays(pictures / pictures_of(part[k]), result[1])
                found[part[k]] = rows.put(part[k], known(part[k], setting), result[0])
                done += 1
                tell("runs", done, len(everything))
    return {run: found[run] for run in everything if run in found}


def _budget(run: Run, setting: Setting, rows: Rows) -> float | None:
    """Seconds that the run before took from raw spectra to a model, whenever that was."""
    if run.method not in AFTER:
        return None
    other = Run(run.truth, run.split, run.count, run.seed, AFTER[run.method])
    row = rows.get(other, known(other, setting))
    return None if row is None else float(row["transport_s"]) + float(row["fit_s"])


def _named(
    work: Execute,
    setting: Setting,
    progress: tuple[Any, ...],
    end: float | None,
    job: tuple[Run, float | None],
) -> Result | None:
    """Carry out a run unless the time ``end`` is behind us; an error names it."""
    if end is not None and time.time() >= end:
        return None
    try:
        return work(job[0], setting, job[1], *progress)
    except Exception as error:
        raise RuntimeError(f"{job[0].key}: {type(error).__name__}: {error}") from error
