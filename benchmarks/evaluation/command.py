"""`python -m benchmarks table1` and `sparsity`: the paper's evaluation; they share one folder and its finished runs."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.data import VERSIONS, DataOptions, Geometry, checked, files
from benchmarks.evaluation import comparison, report
from benchmarks.evaluation.paper_law import paper_law_spectra
from benchmarks.evaluation.protocol import SCALES, SPLITS, TRUTHS, Scale, Setting, plan, truth_of
from benchmarks.evaluation.runs import sweep
from benchmarks.machine import machine
from benchmarks.methods import METHODS, Effort
from benchmarks.report import Report, Row
from benchmarks.runner import Benchmark, Job, option
from warprrf.files import write_atomically, write_text
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.steps import Attempt, Steps, digest

HELP = """\
Every method on the same receivers: bistatic, RF-3DGS+ and RF-3DGS (opacity frozen and trained), NeRF2, a conditional
GAN, Sionna RT with assumed and with calibrated materials, lookups. Both commands share one folder: a finished run is
kept, a killed sweep loses the run at work, and a run is done again only if its data, geometry, options or version
changed. The truth `paper-law` is made: scattering that falls with the whole path's length, as the paper's law has it.
Needs the extras plots, baselines, sionna and cluster; --workers 0 does without the last.

examples:
  python -m benchmarks table1
  python -m benchmarks sparsity --workers 0
  python -m benchmarks table1 --methods bistatic rf3dgs+ rf3dgs --counts 10 --every 10      a first look, in minutes
  python -m benchmarks table1 --scale paper --data spectra_full.nc spectra_sionna_full.nc --scheduler tcp://lab:8786
"""


@dataclass(frozen=True, kw_only=True)
class Options(DataOptions):
    """Options of the evaluation; what is empty or None is the scale's.

    Attributes:
        scale: ``"small"``: within an hour on two cores; ``"paper"``: all subsets, seeds and truths, full schedules.
        methods, truths, splits: only these.
        counts: training receivers.
        seeds: orders of the training receivers.
        every: each how-manieth test receiver counts.
        scheduler: address of a dask scheduler; its workers must see the same files under the same names.
        workers: processes of a local cluster otherwise; 0 works in this process. More than one share the cores, and
            so do their times.
        effort: how long methods may work.
    """

    scale: str = option(
        "small", "small: within an hour on two cores; paper: full schedules", choices=tuple(SCALES)
    )
    methods: tuple[str, ...] = option((), "only these")
    truths: tuple[str, ...] = option((), "exact, sionna, paper-law; the scale's by default")
    splits: tuple[str, ...] = option((), "random, region; the scale's by default")
    counts: tuple[int, ...] = option((), "training receivers; the scale's by default", kind=int)
    seeds: tuple[int, ...] = option((), "orders of the training receivers; the scale's by default", kind=int)
    every: int | None = option(None, "each K-th test receiver; the scale's by default", kind=int)
    scheduler: str | None = option(None, "address of a dask scheduler, such as tcp://lab:8786")
    workers: int = option(1, "processes of a local cluster without a scheduler; 0: in this process")
    effort: Effort | None = None

    def __post_init__(self) -> None:
        for label, value, allowed in (
            ("scale", (self.scale,), tuple(SCALES)),
            ("methods", self.methods, tuple(METHODS)),
            ("truths", self.truths, tuple(TRUTHS)),
            ("splits", self.splits, SPLITS),
        ):
            unknown = [v for v in value if v not in allowed]
            if unknown:
                raise ValueError(f"{label}: got {', '.join(unknown)}, expected of {', '.join(allowed)}")
        every = () if self.every is None else (self.every,)
        for label, numbers, least in (
            ("counts", self.counts, 1),
            ("seeds", self.seeds, 0),
            ("every", every, 1),
        ):
            for number in numbers:
                checked(label, number, least)
        checked("workers", self.workers, 0)

    @property
    def chosen(self) -> Scale:
        """The scale with what was asked for instead of its own."""
        own = tuple(sorted(set(self.counts)))
        names = ("table_counts", "curve_counts", "region_counts", "network_counts", "opacity_counts")
        asked: dict[str, Any] = dict.fromkeys(names, own) | {
            "truths": self.truths, "splits": self.splits, "seeds": self.seeds, "every": self.every,
            "effort": self.effort,
        }  # fmt: skip
        return replace(SCALES[self.scale], **{n: v for n, v in asked.items() if v not in ((), None)})


def run(kind: str, options: Options, job: Job) -> Report:
    """Carry out the runs that are missing and gather all.

    Also leaves ``<kind>.csv`` and ``runs/``.

    Args:
        kind: ``"table1"``: every method, beside the published figures; ``"sparsity"``: the paper's figure.

    Raises:
        ValueError: on missing or broken data, or another command at work in ``job.out``.
        ImportError: if an extra is missing: ``plots``; ``baselines``, ``sionna`` and ``cluster`` for what needs them.
        RuntimeError: naming the run that failed.
    """
    scale, place = options.chosen, options.place(job.device)
    measured = [
        t for t in ("exact", "sionna") if t in scale.truths or (t == "exact" and "paper-law" in scale.truths)
    ]
    known: dict[str, Path] = dict(zip(measured, files(options.data, measured), strict=True))
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        if "paper-law" in scale.truths:
            known["paper-law"] = _paper_law(steps, place, known["exact"])
        setting = Setting(
            files=tuple((name, str(file.resolve())) for name, file in known.items()),
            keys=tuple((name, digest(file)) for name, file in known.items()),
            geometry=str(place.folder.resolve()),
            geometry_key=digest(place.key, place.scene_key),
            scene=str(place.xml.resolve()),
            scratch=str((job.out / "scratch").resolve()),
            every=scale.every,
            effort=scale.effort,
            device=None if job.device is None else str(job.device),
        )
        about, held = _about(scale, setting)
        runs = plan(kind, scale, methods=options.methods or None, held=held)
        if not runs:
            raise ValueError("counts, methods: nothing is left to do; expected counts that the data hold")
        cluster = {"scheduler": options.scheduler, "workers": options.workers}
        rows = sweep(runs, setting, steps, progress=job.progress, **cluster)  # type: ignore[arg-type]
    shutil.rmtree(job.out / "scratch", ignore_errors=True)
    summary = comparison.summarise(rows.values())
    coarse = any(a < b for d in about.values() for a, b in zip(d["shape"], scale.least_shape, strict=True))
    figures: dict[str, Any] = {
        "kind": kind,
        "scale": scale.name,
        "coarse": scale.least_shape if coarse else None,
        "rows": summary,
        "published": [dict(row) for row in report.PUBLISHED],
        "finding": comparison.paper_finding(summary),
        "data": about,
        "effort": asdict(scale.effort),
        "machine": machine(job.device),
        "seconds": sum(_seconds(row) for row in rows.values()),
    }
    write_text(job.out / f"{kind}.csv", report.csv_text(summary))
    pictures = report.pictures(kind, figures, job.out, {run.key: run for run in runs})
    return Report(kind, figures, report.markdown(kind, figures), pictures, dpi=110)


def _paper_law(steps: Steps, place: Geometry, exact: Path) -> Path:
    """The file of targets by the paper's law, made from the exact truth's receivers if it is not there."""
    file = steps.folder / "spectra_paper_law.nc"

    def make(attempt: Attempt) -> dict[str, Any]:
        like = SpectrumDataset.load(exact)
        spectra = paper_law_spectra(place.scene, like, progress=attempt.progress, device=place.device)
        write_atomically(file, spectra.save)
        return {"receivers": len(spectra)}

    steps.run(
        "paper-law", make, version=VERSIONS["exact"], inputs=[exact, place.scene_key], outputs=(file.name,)
    )
    return file


def _about(scale: Scale, setting: Setting) -> tuple[dict[str, Any], dict[tuple[str, str], tuple[int, ...]]]:
    """What each truth and split consists of, and the numbers of training receivers that they hold."""
    about: dict[str, Any] = {}
    held: dict[tuple[str, str], tuple[int, ...]] = {}
    for truth in scale.truths:
        data = SpectrumDataset.load(setting.file(truth))
        for split in scale.splits:
            if split != "random" and truth == "paper-law":
                continue
            found = truth_of(truth, setting.key(truth), data, split, setting.every)
            held[truth, split] = found.counts
            wanted = scale.region_counts if split == "region" else (*scale.table_counts, *scale.curve_counts)
            left_out = sorted({n for n in wanted if n not in found.counts})
            about[f"{truth}/{split}"] = {**found.about, "train": len(found.counts), "left_out": left_out}
    return about, held


def _seconds(row: Row) -> float:
    """About what a run took."""
    each = (row["seconds_per_spectrum"] or 0.0) * row["receivers"]
    return float((row["transport_s"] or 0.0) + (row["fit_s"] or 0.0) + each)


BENCHMARKS = {
    kind: Benchmark(kind, Options, partial(run, kind), HELP, "runs/evaluation")
    for kind in ("table1", "sparsity")
}
