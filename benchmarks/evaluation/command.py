"""`python -m benchmarks paper`: the paper's evaluation at its own size, row by row."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.data import GEOMETRY, VERSIONS, DataOptions, Geometry, checked, files
from benchmarks.evaluation import comparison, conference, report
from benchmarks.evaluation.lpips import Lpips
from benchmarks.evaluation.paper_law import paper_law_spectra
from benchmarks.evaluation.protocol import EFFORT, SPLITS, TRUTHS, Place, Setting, plan, truth_of
from benchmarks.evaluation.runs import Rows, estimate_s, missing, sweep
from benchmarks.machine import machine
from benchmarks.methods import METHODS, Effort
from benchmarks.report import Report
from benchmarks.runner import Benchmark, Job, option
from warprrf.files import write_atomically, write_text
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.steps import Attempt, Steps, digest

HELP = """\
Every method on the same receivers: bistatic, RF-3DGS+ and RF-3DGS (opacity frozen and trained), NeRF2, a conditional
GAN, Sionna RT with assumed and with calibrated materials, lookups; in the lobby, and with --room in a second room. A
finished run is a row of the file --rows, a killed sweep loses the run at work, and a run is done again only if the way
that its data were made, its options or its version changed, or if --lpips names weights and its row has no LPIPS. The
truth `paper-law` is made: scattering that falls with the whole path's length, as the paper's law has it. Needs
the extras plots, baselines and sionna; cluster with --workers.

examples:
  python -m benchmarks data --only spectra --full                     the data of the paper's size first
  python -m benchmarks paper --room newrf --rows benchmarks/results/paper.jsonl
  python -m benchmarks paper --methods bistatic rf3dgs+ rf3dgs --counts 10 --every 10      a first look, in minutes
  python -m benchmarks paper --minutes 0 --rows benchmarks/results/paper.jsonl             what is there, no new run
  python -m benchmarks paper --scheduler tcp://lab:8786
"""


@dataclass(frozen=True, kw_only=True)
class Options(DataOptions):
    """Options of the evaluation; what is empty is the paper's.

    Attributes:
        room: folder of NeWRF's conference room (see :mod:`benchmarks.newrf_rays`); no second room without.
        rows: file of finished runs; ``rows.jsonl`` in the folder of results by default.
        minutes: runs are begun for so long; None: until all are done.
        methods, truths, splits: only these.
        counts: training receivers, instead of the paper's.
        seeds: only these orders of the training receivers.
        every: each how-manieth test receiver counts.
        scheduler: address of a dask scheduler; its workers must see the same files under the same names.
        workers: processes of a local cluster otherwise; 0 works in this process. More than one share the cores, and
            so do their times. Opacity trained on 700 spectra takes 20 GB a process.
        lpips: files of LPIPS' weights: AlexNet's and the metric's.
        effort: how long methods may work.
    """

    room: str = option("", "folder of NeWRF's conference room: the second room")
    rows: str = option("", "file of finished runs (default rows.jsonl in the folder of results)")
    minutes: float | None = option(None, "begin runs for so long", kind=float)
    methods: tuple[str, ...] = option((), "only these")
    truths: tuple[str, ...] = option((), f"only these of {', '.join(TRUTHS)}")
    splits: tuple[str, ...] = option((), f"only these of {', '.join(SPLITS)}")
    counts: tuple[int, ...] = option((), "training receivers, instead of the paper's", kind=int)
    seeds: tuple[int, ...] = option((), "only these orders of the training receivers", kind=int)
    every: int = option(1, "each K-th test receiver")
    scheduler: str | None = option(None, "address of a dask scheduler, such as tcp://lab:8786")
    workers: int = option(0, "processes of a local cluster without a scheduler; 0: in this process")
    lpips: tuple[str, ...] = option(
        (), "files of LPIPS' weights: AlexNet's (torchvision) and the metric's (v0.1)"
    )
    effort: Effort = EFFORT

    def __post_init__(self) -> None:
        for label, value, allowed in (
            ("methods", self.methods, tuple(METHODS)),
            ("truths", self.truths, tuple(TRUTHS)),
            ("splits", self.splits, SPLITS),
        ):
            unknown = [v for v in value if v not in allowed]
            if unknown:
                raise ValueError(f"{label}: got {', '.join(unknown)}, expected of {', '.join(allowed)}")
        for label, numbers, least in (
            ("counts", self.counts, 1),
            ("seeds", self.seeds, 0),
            ("every", (self.every,), 1),
            ("workers", (self.workers,), 0),
        ):
            for number in numbers:
                checked(label, number, least)
        if self.minutes is not None and not self.minutes >= 0:
            raise ValueError(f"minutes: got {self.minutes}, expected a number of at least 0")
        if "conference" in self.truths and not self.room:
            raise ValueError("truths: conference needs --room, the folder of NeWRF's conference room")

    @property
    def chosen(self) -> tuple[str, ...]:
        """The truths that are asked for."""
        return self.truths or tuple(t for t in TRUTHS if t != "conference" or self.room)


def run(options: Options, job: Job) -> Report:
    """Carry out the runs that are missing and gather all.

    Also leaves ``paper.csv`` and ``runs/``.

    Raises:
        ValueError: on missing or broken data, or another command at work in ``job.out``.
        ImportError: if an extra is missing: ``plots``; ``baselines``, ``sionna`` and ``cluster`` for what needs them.
        RuntimeError: naming the run that failed.
    """
    if options.lpips:
        Lpips.found(options.lpips)  # weights that do not serve are told of before any work
    rows_file = Path(options.rows) if options.rows else job.out / "rows.jsonl"
    if job.fresh:
        rows_file.unlink(missing_ok=True)
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        places = _places(options, job, steps)
        setting = Setting(
            places=tuple(places.items()),
            scratch=str((job.out / "scratch").resolve()),
            every=options.every,
            effort=options.effort,
            lpips=options.lpips,
            device=None if job.device is None else str(job.device),
        )
        about, held = _about(options, setting)
        runs = plan(held, methods=options.methods, counts=options.counts, seeds=options.seeds)
        if not runs:
            raise ValueError("counts, methods: nothing is left to do; expected counts that the data hold")
        rows = Rows(rows_file)
        hours = estimate_s(missing(runs, setting, rows), rows) / 3600.0
        job.progress(f"about {hours:.1f} h of runs", len(runs) - len(missing(runs, setting, rows)), len(runs))
        found = sweep(
            runs, setting, rows, job.out, minutes=options.minutes, scheduler=options.scheduler,
            workers=options.workers, progress=job.progress,
        )  # fmt: skip
    shutil.rmtree(job.out / "scratch", ignore_errors=True)
    summary = comparison.summarise(found.values())
    figures: dict[str, Any] = {
        "rows": summary,
        "margins": comparison.margins(found.values()),
        "finding": comparison.paper_finding(summary),
        "published": [dict(row) for row in report.PUBLISHED],
        "data": about,
        "missing": [run.key for run in runs if run not in found],
        "effort": asdict(options.effort),
        "machine": machine(job.device),
        "seconds": sum(row["wall_s"] for row in found.values()),
    }
    write_text(job.out / "paper.csv", report.csv_text(summary))
    pictures = report.pictures(figures, job.out, {run.key: run for run in runs})
    return Report("paper", figures, report.markdown(figures), pictures, dpi=110)


def _places(options: Options, job: Job, steps: Steps) -> dict[str, Place]:
    """Where the data of each truth lie; those that are made here are made now."""
    chosen, lobby = options.chosen, options.place(job.device)
    engines = [t for t in ("exact", "sionna") if t in chosen or (t == "exact" and "paper-law" in chosen)]
    measured: dict[str, Path] = (
        dict(zip(engines, files(options.data, engines), strict=True)) if engines else {}
    )
    if "paper-law" in chosen:
        measured["paper-law"] = _paper_law(steps, lobby, measured["exact"])
    # The lobby's own reconstruction is known by its version: each machine makes it anew, and not to the same bits.
    own = Path(options.geometry) == Path(GEOMETRY)
    found = {
        truth: Place(
            file=str(file.resolve()),
            made=_recipe(SpectrumDataset.load(file), lobby),
            content=digest(file),
            geometry=str(lobby.folder.resolve()),
            geometry_made=digest(VERSIONS["geometry"], lobby.scene_key) if own else lobby.key,
            geometry_content=lobby.key,
            xml=str(options.xml.resolve()),
        )
        for truth, file in measured.items()
        if truth in chosen
    }
    if "conference" in chosen:
        found["conference"] = conference.make(Path(options.room), steps, job.device)
    return found


def _recipe(data: SpectrumDataset, place: Geometry) -> str:
    """Digest of how a data set was made."""
    settings = {k: str(v) for k, v in data.attributes.items() if not k.startswith("version_")}
    return digest(
        data.receivers, data.role.astype(str).tolist(), data.transmitter, float(data.frequency_hz), list(data.shape),
        data.engine, settings, place.scene_key, VERSIONS[data.engine],
    )  # fmt: skip


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


def _about(options: Options, setting: Setting) -> tuple[dict[str, Any], dict[tuple[str, str], int]]:
    """What each truth and split consists of, and how many training receivers they hold."""
    about: dict[str, Any] = {}
    held: dict[tuple[str, str], int] = {}
    for truth, place in setting.places:
        data = SpectrumDataset.load(place.file)
        for split in options.splits or SPLITS:
            if split != "random" and truth not in ("exact", "sionna"):
                continue
            found = truth_of(truth, place.content, data, split, setting.every)
            held[truth, split] = len(found.counts)
            about[f"{truth}/{split}"] = {
                **found.about, "train": len(found.counts), "content": place.content[:12],
                "room": place.geometry_content[:12],
            }  # fmt: skip
    return about, held


BENCHMARKS = {"paper": Benchmark("paper", Options, run, HELP, "runs/paper")}
