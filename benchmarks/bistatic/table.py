"""All rows of the bistatic field's evaluation, each kept once it is there.

A killed run loses the row at which it stood. A row is made again only if something that it depends on changed: data,
geometry, its options, or the version of its own model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import warprrf as wr
from benchmarks.bistatic import checks, report
from benchmarks.data import TRUTHS, VERSIONS, DataOptions, Geometry, Truth, checked, files
from benchmarks.machine import machine
from benchmarks.methods import METHODS, Effort, Task, score
from benchmarks.report import Report, Row
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import Progress
from warprrf.files import write_atomically
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.steps import Attempt, Steps, digest

HARMONIC = ("rf3dgs+", "rf3dgs+los")
CHECKS_VERSION = 1  # counted up by hand when a check computes something else

HELP = """\
What each part of the bistatic model is worth, how often errors lie within the stated uncertainty, delays path by path,
and a transmitter that was never measured. Beside other methods it stands in `python -m benchmarks paper`. Every row is
kept: a killed run loses one, and a row is made again only if its data, geometry, options or version changed.

examples:
  python -m benchmarks bistatic
  python -m benchmarks bistatic --truths exact --counts 10 --every 4 --out runs/quick     a first look, in minutes
  python -m benchmarks bistatic --data spectra_full.nc spectra_sionna_full.nc --geometry room
"""


@dataclass(frozen=True, kw_only=True)
class Options(DataOptions):
    """Options of the evaluation.

    Attributes:
        counts: training receivers; those that a data set does not hold are left out.
        truths: ``"exact"``, ``"sionna"`` or both.
        every: each how-manieth test receiver counts.
        second: spectra of the test receivers under another transmitter; made by the exact engine by default.
        second_at: place of that transmitter [m], where its spectra are made: at the other end of the lobby.
        effort: how long RF-3DGS+ may work.
    """

    counts: tuple[int, ...] = option((10, 50, 400), "training receivers")
    truths: tuple[str, ...] = option(TRUTHS, "exact, sionna or both")
    every: int = option(1, "each K-th test receiver")
    second: str | None = option(None, "spectra under another transmitter (made by default)")
    second_at: tuple[float, float, float] = (2.2, 1.6, 2.5)
    effort: Effort = Effort()

    def __post_init__(self) -> None:
        checked("every", self.every, 1)


def run(options: Options, job: Job) -> Report:
    """Make every row that is missing; leaves fields in ``fields/``.

    Raises:
        ValueError: on missing or broken data, or another run at work in ``job.out``.
        ImportError: if the extra ``plots`` is missing.
    """
    place = options.place(job.device)
    found = [Truth.load(file, options.counts, options.every) for file in files(options.data, options.truths)]
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        figures = _Rows(options, job, steps, place, found).figures()
        figures["seconds"] = steps.seconds()
    return Report("bistatic", figures, report.text(figures), report.pictures(figures))


class _Rows:
    """Which rows there are, and what each depends on."""

    def __init__(
        self, options: Options, job: Job, steps: Steps, place: Geometry, truths: list[Truth]
    ) -> None:
        self.options, self.job, self.steps, self.place, self.truths = options, job, steps, place, truths

    def figures(self) -> dict[str, Any]:
        """Everything that the report holds."""
        table = self._table()
        return {
            "rows": [_brief(row) for row in table],
            "ablation": [_brief(row) for row in self._ablation(table)],
            "calibration": self._of_fields("calibration", checks.calibration),
            "delays": self._of_fields("delays", checks.delays, scene=True),
            "second": self._second(table),
            "data": {
                t.name: {"counts": t.counts, "left_out": t.left_out, "every": t.every, **t.about}
                for t in self.truths
            },
            "machine": machine(self.job.device),
            "seed": self.job.seed,
        }

    def _row(
        self, name: str, make: Callable[[Attempt], Row], version: int, inputs: list[Any], *files: str
    ) -> Row:
        return self.steps.run(name, make, version=version, inputs=inputs, outputs=files)

    def _inputs(self, truth: Truth, *more: Any) -> list[Any]:
        return [truth.key, self.place.key, truth.every, *more]

    def _check(self, name: str, make: Callable[[Progress], Row], truth: Truth, *inputs: Any) -> Row:
        """A row of :mod:`benchmarks.bistatic.checks`."""
        version = 1000 * METHODS["bistatic"].version + CHECKS_VERSION
        return self._row(name, lambda attempt: make(attempt.progress), version, self._inputs(truth, *inputs))

    def _field(self, file: str) -> Any:
        return wr.RadioField.load(self.job.out / file, device=self.job.device)

    # ------------------------------------------------------------------------------------------ fields

    def _table(self) -> list[Row]:
        """A row a truth and field: the bistatic one on every number of training receivers, others on the smallest."""
        rows = []
        for truth in self.truths:
            rows.append(self._method(truth, 0, "zero"))
            rows += [self._method(truth, count, "bistatic") for count in truth.counts]
            rows += [self._method(truth, truth.few, method) for method in HARMONIC]
        self.place.forget()
        return rows

    def _method(self, truth: Truth, count: int, method: str) -> Row:
        found = []
        for variant in METHODS[method].variants:
            file = _field_file(truth, count, method, variant)

            def make(attempt: Attempt, variant: str = variant, file: str | None = file) -> Row:
                task = Task(
                    train=truth.train(count) if count else truth.data.subset([]), test=truth.test,
                    geometry=self.place, scratch=attempt.folder, progress=attempt.progress, slot=truth.name,
                    variant=variant, effort=self.options.effort,
                )  # fmt: skip
                return score(method, task, None if file is None else self.job.out / file)[1]

            name = _slug(truth.name, count, method, variant)
            effort = self.options.effort if method in HARMONIC else None
            row = self._row(
                name, make, METHODS[method].version, self._inputs(truth, effort), *([file] if file else [])
            )
            about = {
                "truth": truth.name,
                "n_train": count,
                "method": method,
                "variant": variant,
                "field": file,
            }
            found.append({**about, **row})
        chosen = max(found, key=lambda row: float(row["psnr_db"]))
        return {**chosen, "variants": {row["variant"]: row["psnr_db"] for row in found if row["variant"]}}

    # ------------------------------------------------------------------------------------------ checks

    def _ablation(self, table: list[Row]) -> list[Row]:
        rows: list[Row] = []
        for truth in self.truths:
            for method, count, name in (
                ("bistatic", truth.few, report.WHOLE),
                ("zero", 0, "zero spectra"),
                ("rf3dgs+los", truth.few, "RF-3DGS+ with line of sight"),
            ):
                rows.append({**_find(table, truth.name, count, method), "model": name})
        for name, options in checks.ABLATION.items():
            scene = self.place.scene_key if name == checks.TRUE_MESH else ""
            for truth in self.truths:
                work = partial(checks.ablation, name, truth, truth.few, self.place)
                row = self._check(_slug("ablation", truth.name, truth.few, name), work, truth, options, scene)
                rows.append({"truth": truth.name, "n_train": truth.few, "model": name, **row})
        return rows

    def _of_fields(self, name: str, work: Callable[..., Row], *, scene: bool = False) -> list[Row]:
        """``work`` on the bistatic field of each truth and number of training receivers."""
        rows = []
        more = (self.place,) if scene else ()
        for truth in self.truths:
            for count in truth.counts:
                file = str(_field_file(truth, count, "bistatic", ""))

                def one(progress: Progress, truth: Truth = truth, file: str = file) -> Row:
                    return work(self._field(file), truth, *more, progress)

                key = self.place.scene_key if scene else ""
                row = self._check(_slug(name, truth.name, count), one, truth, key)
                rows.append({"truth": truth.name, "n_train": count, **row})
        return rows

    def _second(self, table: list[Row]) -> list[Row]:
        """Fields of the smallest training set of the exact truth, asked for another transmitter."""
        truth = next((t for t in self.truths if t.name == "exact"), None)
        if truth is None:
            return []
        file = Path(self.options.second) if self.options.second else self.job.out / "second_exact.nc"
        if self.options.second is None:

            def make(attempt: Attempt) -> Row:
                at = self.options.second_at
                ds = checks.second_spectra(truth, at, self.place, attempt)
                write_atomically(file, ds.save)
                return {"receivers": len(ds)}

            inputs = [truth.key, self.place.scene_key, self.options.second_at]
            self._row("second-spectra", make, VERSIONS["exact"], inputs, file.name)
        ds, rows = SpectrumDataset.load(file), []
        for method in ("bistatic", *HARMONIC):
            first = _find(table, truth.name, truth.few, method)

            def one(progress: Progress, field: str = first["field"]) -> Row:
                return checks.second_transmitter(self._field(field), ds, truth, self.place, progress)

            row = self._check(_slug("second", truth.few, method), one, truth, digest(file), first["field"])
            rows.append(
                {
                    "method": method,
                    "variant": first["variant"],
                    "n_train": truth.few,
                    "transmitter": ds.transmitter,
                    "seen": {n: value for n, value in _brief(first).items() if n.startswith("psnr_db")},
                    **_brief(row),
                    "first_range": _brief(row["first_range"]),
                }
            )
        return rows


def _find(table: list[Row], truth: str, count: int, method: str) -> Row:
    return next(
        row for row in table if (row["truth"], row["n_train"], row["method"]) == (truth, count, method)
    )


def _brief(row: Row) -> Row:
    """A row without what is kept per receiver."""
    return {
        name: value for name, value in row.items() if name not in ("per_receiver", "lpips", "lpips_reason")
    }


def _field_file(truth: Truth, count: int, method: str, variant: str) -> str | None:
    """Where a fitted field lies; None for methods that leave none."""
    if method not in ("bistatic", *HARMONIC):
        return None
    return f"fields/{_slug(truth.name, count, method, variant)}.safetensors"


def _slug(*parts: Any) -> str:
    return "-".join(str(part).replace(",", "").replace(" ", "_") for part in parts if part != "")


BENCHMARKS = {"bistatic": Benchmark("bistatic", Options, run, HELP)}
