"""Thousands of receivers: many at once beside one by one, responses onto the disk, memory, workers of which one is killed."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA
from benchmarks.lobby.spectra import FILES
from benchmarks.machine import connected, machine, peak_memory
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import require
from warprrf.files import read_arrays, write_arrays
from warprrf.rf.fields.batches import AT_ONCE
from warprrf.rf.spectra.spectrum import to_db
from warprrf.steps import Attempt, Steps

HELP = """\
Fields of the lobby's true mesh, fitted to 50 spectra of either engine, answer for places all over the room. What is finished
is kept, and a response half written is continued.

examples:
  python -m benchmarks batches
  python -m benchmarks batches --receivers 100 --responses 200 --queries 200      a first look, in minutes
"""
BAND_HZ = np.linspace(299e9, 301e9, 64)
ARRAYS: dict[str, Any] = {"rx_array": wr.PlanarArray(8, 8), "tx_array": wr.PlanarArray(4, 4)}
ALONE = 4  # of AT_ONCE receivers are asked one by one as well
COLUMNS = (
    ("figure", "figure", "{}"), ("receivers", "receivers", "{}"), ("wall_ms", "each [ms]", "{:.1f}"),
    ("core_ms", "each, core time [ms]", "{:.1f}"), ("over", "over one by one", "{:.2f}"),
    ("gigabytes", "written [GB]", "{:.2f}"), ("peak_gb", "peak memory [GB]", "{:.2f}"),
    ("growth_mb", "memory growth [MB]", "{:.1f}"), ("faster", "times one worker", "{:.2f}"), ("same_bits", "same bits", "{}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the measurement.

    Attributes:
        data: folder of scene and spectra.
        receivers: whose spectra are asked for.
        responses: receivers whose frequency responses are.
        max_paths: strongest paths of these.
        queries: single spectra after which memory is looked at.
    """

    data: str = option(DATA, "folder of scene and spectra")
    receivers: int = option(1000, "whose spectra are asked for")
    responses: int = option(10_000, "receivers whose frequency responses are")
    max_paths: int = option(100, "strongest paths of these")
    queries: int = option(2000, "single spectra after which memory is looked at")


def run(options: Options, job: Job) -> Report:
    """Fit, ask and time; ``job.out`` keeps what is finished."""
    folder = Path(options.data)
    scene = wr.Scene.load(folder / "scene.xml")
    rows: list[Row] = []
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:

        def step(
            name: str, make: Callable[[Attempt], Row], *inputs: Any, outputs: tuple[str, ...] = ()
        ) -> Row:
            found = steps.run(name, make, version=1, inputs=[job.seed, *inputs], outputs=outputs)
            rows.append(found)
            return found

        def places(count: int) -> np.ndarray:
            return wr.sample_receivers(scene, count, seed=job.seed, device=job.device)

        fields = {}
        for truth, file in FILES.items():
            name = f"field-{truth}.safetensors"
            make = _Fit(scene, folder / file, job.out / name, job.device)
            steps.run(name, make, version=1, inputs=[folder / file], outputs=[name])
            fields[truth] = wr.RadioField.load(job.out / name, device=job.device)
            spectra = f"spectra-{truth}.npz"
            make_spectra = _Spectra(truth, fields[truth], places(options.receivers), job.out / spectra)
            step(spectra, make_spectra, options.receivers, steps.key(name), outputs=(spectra,))
        quick = replace(fields["exact"], terms=replace(fields["exact"].terms, sub_pixels=1))  # type: ignore[type-var, attr-defined]
        known = steps.key("field-exact.safetensors")
        step("memory", _Memory(quick, places(options.queries)), options.queries, known)
        expected = read_arrays(job.out / "spectra-exact.npz")["path_gain"]
        of_workers = steps.run(
            "workers", _Workers(fields["exact"], places(options.receivers), expected), version=1,
            inputs=[options.receivers, known],
        )  # fmt: skip
        rows += of_workers["rows"]
        ask = _Responses(quick, places(options.responses), options.max_paths, job.device)
        found = step("responses", ask, options.responses, options.max_paths, known)
        found["wall_ms"] = 1e3 * steps.seconds("responses") / options.responses
    figures = {
        "machine": machine(job.device), "load_average": os.getloadavg()[0], "rows": rows,
        "sent": of_workers["sent"], "max_paths": options.max_paths,
    }  # fmt: skip
    return Report("batches", figures, columns_table(COLUMNS, rows))


@dataclass(frozen=True)
class _Fit:
    scene: Any
    spectra: Path
    out: Path
    device: Any

    def __call__(self, attempt: Attempt) -> Row:
        train, _ = wr.SpectrumDataset.load(self.spectra).split(50)
        wr.RadioField.fit(self.scene, train, device=self.device, progress=attempt.progress).save(self.out)
        return {}


class _Clock:
    """Wall and core seconds, added up."""

    def __init__(self) -> None:
        self.wall = self.core = 0.0
        self.count = 0

    @contextmanager
    def over(self, count: int) -> Iterator[None]:
        wall, core = time.perf_counter(), time.process_time()
        yield
        self.wall += time.perf_counter() - wall
        self.core += time.process_time() - core
        self.count += count

    @property
    def row(self) -> Row:
        each = 1e3 / max(self.count, 1)
        return {"wall_ms": each * self.wall, "core_ms": each * self.core}


@dataclass(frozen=True)
class _Spectra:
    """Spectra of all places, and in turns some of them one by one."""

    truth: str
    field: Any
    places: np.ndarray
    out: Path

    def __call__(self, attempt: Attempt) -> Row:
        field, together, alone, found, apart = self.field, _Clock(), _Clock(), [], 0.0
        field.spectra(self.places[:AT_ONCE])  # kernels are loaded, what belongs to the transmitter is traced
        for first in range(0, len(self.places), AT_ONCE):
            some = self.places[first : first + AT_ONCE]
            with together.over(len(some)):
                found.append(field.spectra(some).path_gain)
            for image, place in zip(found[-1], some[:ALONE], strict=False):
                with alone.over(1):
                    single = field.spectrum(place).path_gain
                apart = max(
                    apart, float(np.abs(np.subtract(*(to_db(p, field.floor) for p in (image, single)))).max())
                )
            attempt.progress("spectra", min(first + AT_ONCE, len(self.places)), len(self.places))
        write_arrays(self.out, {"path_gain": np.concatenate(found)}, compress=False)
        share = {"over": together.wall / together.count / (alone.wall / alone.count)}
        share["over_core"] = together.core / together.count / (alone.core / alone.count)
        return {
            "figure": f"spectra, {self.truth} truth", "receivers": len(self.places), **together.row, **share,
            **{f"single_{name}": value for name, value in alone.row.items()}, "largest_difference_db": apart,
        }  # fmt: skip


@dataclass(frozen=True)
class _Memory:
    field: Any
    places: np.ndarray

    def __call__(self, attempt: Attempt) -> Row:
        held: list[float] = []
        for k, place in enumerate(self.places):
            self.field.spectrum(place)
            if k + 1 in (len(self.places) // 10, len(self.places)):
                pages = int(Path("/proc/self/statm").read_text().split()[1])
                held.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
            attempt.progress("queries", k + 1, len(self.places))
        return {
            "figure": "single spectra, one ray a pixel",
            "receivers": len(self.places),
            "growth_mb": held[-1] - held[0],
        }


@dataclass(frozen=True)
class _Responses:
    """Responses of 8 x 8 by 4 x 4 antennas at 64 frequencies, onto the disk."""

    field: Any
    places: np.ndarray
    max_paths: int
    device: Any

    def __call__(self, attempt: Attempt) -> Row:
        told: list[int] = []
        clock = _Clock()

        def tell(stage: str, done: int, total: int) -> None:
            told.append(done)
            attempt.progress(stage, done, total)

        with peak_memory(self.device) as peak, clock.over(0):
            found = self.field.cfr(
                self.places, BAND_HZ, diffuse="random_phase", method="dense", max_paths=self.max_paths,
                store=attempt.folder / "responses.nc", progress=tell, **ARRAYS,
            )  # fmt: skip
        done = len(self.places) - told[0]  # by this attempt
        return {
            "figure": f"cfr, 8 x 8 by 4 x 4, 64 frequencies, {self.max_paths} paths, one ray a pixel",
            "receivers": len(self.places), "core_ms": 1e3 * clock.core / max(done, 1), "gigabytes": found.nbytes / 1e9,
            "peak_gb": peak["peak_memory_bytes"] / 1e9,
        }  # fmt: skip


@dataclass(frozen=True)
class _Workers:
    """Spectra by one worker of one thread, by two, and by two of which one is killed on the way."""

    field: Any
    places: np.ndarray
    expected: np.ndarray

    def __call__(self, attempt: Attempt) -> Row:
        rows, one = [], 0.0
        for name, count, kill in (
            ("one worker", 1, False),
            ("two workers", 2, False),
            ("two, one killed", 2, True),
        ):
            with connected(None, count, 1) as client:
                self.field.spectra(self.places[: 4 * AT_ONCE], client=client)  # the library is loaded
                before = sum(client.run(time.process_time).values())
                start = time.perf_counter()
                found = self.field.spectra(
                    self.places,
                    client=client,
                    progress=_Killer(client, attempt.progress) if kill else attempt.progress,
                ).path_gain
                wall = time.perf_counter() - start
                core = sum(client.run(time.process_time).values()) - before
            one = one or wall
            rows.append(
                {
                    "figure": f"spectra, exact truth, {name}",
                    "receivers": len(self.places),
                    "wall_ms": 1e3 * wall / len(self.places),
                    "faster": one / wall,
                    "core_ms": None if kill else 1e3 * core / len(self.places),
                    "same_bits": np.array_equal(found, self.expected),
                }  # fmt: skip
            )
        code = require("distributed.protocol.pickle", extra="cluster")
        part = (self.places[:AT_ONCE], self.field.transmitter)
        sent = {
            "once_bytes": len(code.dumps(self.field)), "part_bytes": len(code.dumps(part)), "part_receivers": AT_ONCE,
            "back_bytes": int(self.expected[0].nbytes),
        }  # fmt: skip
        return {"rows": rows, "sent": sent}


class _Killer:
    """Ends a worker when a quarter of the work is done."""

    def __init__(self, client: Any, tell: Callable[[str, int, int], None]) -> None:
        self._tell, self._process = tell, next(iter(client.run(os.getpid).values()))
        self._killed = False

    def __call__(self, stage: str, done: int, total: int) -> None:
        if not self._killed and done >= total // 4:
            self._killed = True
            os.kill(self._process, signal.SIGKILL)
        self._tell(stage, done, total)


BENCHMARKS = {"batches": Benchmark("batches", Options, run, HELP)}
