"""Fields fitted to training sets and scored at receivers that none of them has seen: the shape of most experiments.

An experiment is a sequence of rows: what was fitted to what, and the figures of that field. A row is kept once it is
there, so that a killed run loses one; it is made again if its data, geometry or options changed.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import TRUTHS, DataOptions, Truth, checked, files
from benchmarks.machine import machine
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.steps import Attempt, Steps, digest

VERSION = 4
"""Counted up by hand when a fit, or its figures, come out differently."""
LEFT_OUT = ("per_receiver", "lpips", "lpips_reason", "seconds_per_spectrum")  # of what wr.evaluate returns


@dataclass(frozen=True, kw_only=True)
class FitOptions(DataOptions):
    """Options of an experiment.

    Attributes:
        truths: ``"exact"``, ``"sionna"`` or both.
        counts: training receivers; those that a data set does not hold are left out.
        every: every n-th test receiver counts.
    """

    truths: tuple[str, ...] = option(TRUTHS, "exact, sionna or both")
    counts: tuple[int, ...] = option((10, 50), "training receivers")
    every: int = option(1, "every n-th test receiver counts")

    def __post_init__(self) -> None:
        checked("every", self.every, 1)

    def load(self) -> list[Truth]:
        """The data set of each truth."""
        return [Truth.load(file, self.counts, self.every) for file in files(self.data, self.truths)]

    @property
    def inputs(self) -> list[Any]:
        """What every row depends on: content of data, scene and reconstruction, and which receivers count."""
        read = [*files(self.data, self.truths), self.xml, Path(self.geometry)]
        return [*(path for path in read if path.exists()), self.every]


class Fits:
    """What an experiment makes its rows with.

    Attributes:
        job: where it runs, and for whom.
        steps: where finished rows are kept.
        key: digest of what every row depends on.
        pictures: of the report, which rows add to: file name to a function that draws, and the caption.
    """

    def __init__(self, job: Job, steps: Steps, key: str) -> None:
        self.job, self.steps, self.key = job, steps, key
        self.pictures: dict[str, tuple[Callable[[], Any], str]] = {}

    def row(self, name: str, make: Callable[[], Row], *inputs: Any) -> Row:
        """What ``make`` returns, kept under ``name``; ``inputs`` are what it depends on besides."""

        def step(attempt: Attempt) -> Row:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that readings are few is what is measured
                return make()

        file = "".join(c if c.isalnum() else "-" for c in name)
        return self.steps.run(file, step, version=VERSION, inputs=[self.key, self.job.seed, *inputs])

    def fit(self, geometry: Any, data: Any, **options: Any) -> Any:
        """A bistatic field on ``data``."""
        return wr.RadioField.fit(
            geometry, data, model="bistatic", device=self.job.device, progress=self.job.progress, **options
        )

    def score(self, field: Any, test: wr.SpectrumDataset) -> Row:
        """Figures of :func:`warprrf.evaluate`, and the rms error of total power, all and blocked receivers."""
        total: list[float] = []

        def predict(receiver: np.ndarray) -> Any:
            found = field.spectrum(receiver, test.transmitter)
            total.append(float(found.path_gain.sum()))
            return found

        row = wr.evaluate(test, predict, progress=self.job.progress)
        row = {name: value for name, value in row.items() if name not in LEFT_OUT}
        total_gain = np.maximum(
            total, test.floor
        )  # a part of the model alone may reach a receiver by no path
        error = 10.0 * np.log10(total_gain / test.path_gain.sum(axis=(1, 2), dtype=np.float64))
        blocked = ~np.asarray(test.line_of_sight, bool)
        row |= {"test": len(test), "total_rms_db": rms(error)}
        return row | {"total_rms_db_blocked": rms(error[blocked]) if blocked.any() else None}

    def scored(self, geometry: Any, data: Any, test: wr.SpectrumDataset, **options: Any) -> Row:
        """Figures of a field fitted to ``data``, and the seconds of its fit."""
        field = self.fit(geometry, data, **options)
        return {**self.score(field, test), "fit_s": fit_seconds(field)}


def fit_seconds(field: Any) -> float:
    """Seconds of tracing and fitting; none where nothing was fitted."""
    return sum(float(field.report.get(name, 0.0)) for name in ("transport_time_s", "fit_time_s"))


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def mean_row(rows: Sequence[Row]) -> Row:
    """Means of the figures that all ``rows`` have, the number of rows, and spread and least of their PSNR."""
    names = [name for name, value in rows[0].items() if isinstance(value, float)]
    mean: Row = {name: float(np.mean([row[name] for row in rows])) for name in names}
    psnr = [row["psnr_db"] for row in rows]
    return {**mean, "draws": len(rows), "psnr_std_db": float(np.std(psnr)), "psnr_least_db": float(min(psnr))}


def experiment(
    name: str,
    config: type[Any],
    rows: Callable[[Any, Fits], Iterator[Row]],
    columns: Mapping[str, Sequence[tuple[str, str, str]]],
    about: str,
    text: str,
) -> Benchmark:
    """A benchmark that makes a table of each part of its rows.

    Args:
        rows: generates them; the key ``part`` says to which of ``columns`` one belongs ("rows" where it has none).
        columns: of each part; key, title and format.
        about: what stands above the tables.
        text: the command's help.
    """

    def run(options: Any, job: Job) -> Report:
        found: dict[str, list[Row]] = {part: [] for part in columns}
        key = digest(*options.inputs)
        with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
            fits = Fits(job, steps, key)
            for row in rows(options, fits):
                found[row.get("part", "rows")].append({k: v for k, v in row.items() if k != "part"})
        tables = [columns_table(columns[part], own) for part, own in found.items() if own]
        figures = {"machine": machine(job.device), "seed": job.seed, **found}
        return Report(name.replace("-", "_"), figures, "\n\n".join([about, *tables]), fits.pictures)

    return Benchmark(name, config, run, text)
