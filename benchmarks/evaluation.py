"""The paper's evaluation on any data set: methods fitted to some of its receivers and scored at the others.

Test receivers are the same for every method, training subsets are nested. A method that leaves a choice open (the
domain of a gain, what an average is taken of) is run with each, and the better one counts. Runs are kept in one file,
``paper.json``: what is there is not done again, a killed command loses the run at work, and several data sets stand
beside each other by their names. Tables are means over the runs of a kind: :func:`summarise`, :func:`margins`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.data import DATA, GEOMETRY, Geometry, checked, scene_of
from benchmarks.machine import machine, peak_memory, processor_name
from benchmarks.methods import METHODS, Effort, Fitted, Task, score
from benchmarks.pictures import METHODS as NAMES
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import resolve, threads
from warprrf.files import plain, read_json, write_json
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.steps import digest

HELP = """\
Fits methods to spectra of some receivers and scores them at the test receivers of the same data set: bistatic, RF-3DGS+ and
RF-3DGS, NeRF2, a conditional GAN, Sionna RT with assumed and with calibrated materials, lookups. Takes any file of
spectra and any room: a reconstruction, a mesh, or a scene, of which only the mesh is given. Runs that are in
OUT/paper.json are not done again. Networks need the extra baselines, Sionna RT the extra sionna.

examples:
  python -m benchmarks paper --data spectra.nc --room room.ply --methods nerf2 cgan sionna-calibrated nearest
  python -m benchmarks paper --methods bistatic rf3dgs+ rf3dgs --counts 10 --every 10      a first look, in minutes

The paper's size, after `python -m benchmarks data --only spectra --full` and `python -m benchmarks newrf`, and beginning
from the runs that there are (cp benchmarks/results/paper.json runs/paper/); so for --name sionna, and with --region:
  python -m benchmarks paper --data data/lobby/spectra_full.nc --name exact --seeds 0 1 2
  python -m benchmarks paper --data runs/newrf/spectra.nc --name conference --room runs/newrf/scene.xml --counts 10 100
"""
COUNTS = (10, 20, 50, 100, 200, 400, 700)
HELD_OUT = 0.25  # of the receivers' extent along the longer side
SCORES = ("psnr_db", "ssim", "rmse_db", "direction_within_3deg", "beam_gain_loss_db")
COMPARED = (*SCORES, *(f"{name}_blocked" for name in SCORES))
"""What has a spread over seeds and a margin, at all test receivers and at the blocked ones."""
ABOUT = ("truth", "split", "count", "seed", "method")
"""What tells one run from another."""
MEASURED = (*COMPARED, "tof_error_median_ns", "transport_s", "fit_s", "seconds_per_spectrum")
COLUMNS = (
    *ABOUT,
    "variant",
    "version",
    "steps",
    "data",
    "room",
    "on",
    "cores",
    *MEASURED,
    "peak_memory_gib",
    "model_mib",
)
"""What is kept of a run."""
TABLE = (
    ("truth", "data set", "{}"), ("split", "test receivers", "{}"), ("count", "spectra", "{}"), ("name", "method", "{}"),
    ("psnr_db", "PSNR [dB]", "{:.2f}"), ("psnr_db_std", "over seeds", "{:.2f}"), ("psnr_db_blocked", "blocked", "{:.2f}"),
    ("ssim", "SSIM", "{:.3f}"), ("rmse_db", "RMSE [dB]", "{:.2f}"), ("direction_within_3deg", "within 3 deg", "{:.0%}"),
    ("direction_within_3deg_blocked", "blocked", "{:.0%}"), ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"),
    ("train_s", "training [s]", "{:.4g}"), ("seconds_per_spectrum", "a spectrum [s]", "{:.3g}"),
    ("peak_memory_gib", "memory [GiB]", "{:.2f}"), ("model_mib", "model [MiB]", "{:.3g}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the evaluation.

    Attributes:
        data: file of spectra with training and test receivers (NetCDF).
        room: what methods know of the room; see :class:`~benchmarks.data.Geometry`.
        scene: true scene, for the methods that are given it; the one beside the data by default.
        name: of the data set in the tables; that of its file by default.
        methods: which of :data:`METHODS`.
        counts: numbers of training receivers; those that the data do not hold are left out.
        seeds: orders of the training receivers.
        every: every n-th test receiver counts.
        region: hold out a quarter of the room, the farthest from the transmitter: no training receiver lies there, and no
            other test receiver is asked.
        steps: of NeRF2 and the GAN; 30 000 as published, which takes hours on a graphics card.
        effort: how long methods may work otherwise.
    """

    data: str = option(f"{DATA}/spectra.nc", "file of spectra (NetCDF)")
    room: str = option(GEOMETRY, "what is known of the room: a reconstruction, a mesh or a scene")
    scene: str | None = option(
        None, "true scene, where a method is given it: the one beside the data by default"
    )
    name: str = option("", "name of the data set in the tables (default: that of its file)")
    methods: tuple[str, ...] = option(
        ("bistatic", "rf3dgs+", "rf3dgs", "nearest", "idw", "mean", "constant"),
        "which",
        choices=tuple(METHODS),
    )
    counts: tuple[int, ...] = option(COUNTS, "training receivers")
    seeds: tuple[int, ...] = option((0,), "orders of the training receivers")
    every: int = option(1, "each K-th test receiver")
    region: bool = option(False, "hold out a quarter of the room")
    steps: int = option(Effort.network_steps, "training steps of NeRF2 and the GAN")
    effort: Effort = Effort()

    def __post_init__(self) -> None:
        for label, numbers, least in (
            ("counts", self.counts, 1),
            ("seeds", self.seeds, 0),
            ("every", (self.every,), 1),
            ("steps", (self.steps,), 1),
        ):
            for number in numbers:
                checked(label, number, least)


def run(options: Options, job: Job) -> Report:
    """Carry out the runs that ``paper.json`` does not hold.

    Raises:
        FileNotFoundError, ValueError: on missing or broken data; if the file holds runs of other data under this name.
        ImportError: if a method's extra is missing.
    """
    lab = _Lab.open(options, job)
    file = job.out / "paper.json"
    found: dict[str, Any] = {
        "machine": machine(job.device),
        "missing": [],
        "columns": list(COLUMNS),
        "runs": [],
    }
    kept = read_json(file) if file.is_file() and not job.fresh else found
    rows = {key_of(row): row for row in unpacked(kept)}
    known = {row["data"] for row in rows.values() if row["truth"] == lab.name}
    if known and lab.key not in known:
        raise ValueError(
            f"name: {file} holds runs of {lab.name} on other data ({', '.join(sorted(known))}, not {lab.key}); expected "
            "--fresh, or another --name"
        )
    planned = {key_of(about): about for about in lab.planned()}
    asked = [key for key, about in planned.items() if not lab.holds(rows.get(key), about["method"])]
    for done, key in enumerate(asked):
        job.progress("runs", done, len(asked))
        about = planned[key]
        rows[key] = lab.one(about, rows.get(key_of({**about, "method": "bistatic"})))
        left = {*kept["missing"], *asked[done + 1 :]} - set(rows)
        kept = found | {
            "missing": sorted(left),
            "runs": [[row[name] for name in COLUMNS] for row in rows.values()],
        }
        write_json(file, kept)
    job.progress("runs", len(asked), len(asked))
    summary = [{**row, "name": NAMES[row["method"]][0]} for row in summarise(rows.values())]
    order = list(METHODS)
    summary.sort(key=lambda row: (row["truth"], row["split"], row["count"], order.index(row["method"])))
    return Report("paper", kept, columns_table(TABLE, summary))


@dataclass(frozen=True)
class _Lab:
    """What all runs of one command share."""

    name: str
    key: str
    data: SpectrumDataset
    test: SpectrumDataset
    geometry: Geometry
    options: Options
    job: Job

    @classmethod
    def open(cls, options: Options, job: Job) -> _Lab:
        """Read data and room."""
        file = Path(options.data)
        data = SpectrumDataset.load(file)
        if options.region:
            data = region_held_out(data)
        held = int(np.count_nonzero(data.role == "train"))
        if min(options.counts) > held or held == len(data):
            raise ValueError(
                f"data: {file} holds {held} training and {len(data) - held} test receivers, expected some of both, and one "
                f"of counts {', '.join(map(str, options.counts))}"
            )
        if not Path(options.room).exists():
            raise ValueError(
                f"room: there is no {options.room}; expected a mesh, a scene, or a saved reconstruction such as "
                f"python -m benchmarks lobby leaves in {GEOMETRY}"
            )
        test = data.split(1)[1]
        scene = Path(options.scene) if options.scene else scene_of([options.data])
        return cls(
            name=options.name or file.stem,
            key=digest(file)[:12],
            data=data,
            test=test.subset(np.arange(0, len(test), options.every)),
            geometry=Geometry(Path(options.room), scene, job.device),
            options=options,
            job=job,
        )

    def planned(self) -> Iterable[Row]:
        """What is asked for, the largest sets first; other methods take the bistatic field's time, so it goes first."""
        held = int(np.count_nonzero(self.data.role == "train"))
        for seed in self.options.seeds:
            for count in sorted({n for n in self.options.counts if n <= held}, reverse=True):
                for name, method in METHODS.items():
                    # The order of all spectra, or of none, changes nothing but a network's batches.
                    same = seed > 0 and (method.untaught or count == held)
                    if name in self.options.methods and not same:
                        split = "region" if self.options.region else "random"
                        count_seen = 0 if method.untaught else count
                        yield dict(zip(ABOUT, (self.name, split, count_seen, seed, name), strict=True))

    def made(self, method: str) -> Row:
        """What its figures depend on besides: what it computes, a network's steps, and the data."""
        steps = self.options.steps if METHODS[method].network else None
        return {"version": METHODS[method].version, "steps": steps, "data": self.key}

    def holds(self, row: Row | None, method: str) -> bool:
        """Whether ``row`` is a run as it would be done now."""
        return row is not None and all(row[name] == value for name, value in self.made(method).items())

    def one(self, about: Row, ours: Row | None) -> Row:
        """A run with each variant of the method, of which the better one counts; ``ours``: the bistatic field's run on the
        same spectra, if there is one."""
        name, method = about["method"], METHODS[about["method"]]
        budget_s = None if ours is None else ours["transport_s"] + ours["fit_s"]
        rows = []
        for variant in method.variants:
            with tempfile.TemporaryDirectory() as scratch, peak_memory(self.job.device) as peak:
                task = Task(
                    train=self.data.split(about["count"], seed=about["seed"])[0]
                    if about["count"]
                    else self.data.subset([]),
                    test=self.test,
                    geometry=self.geometry,
                    scratch=Path(scratch),
                    progress=self.job.progress,
                    variant=variant,
                    seed=about["seed"],
                    effort=replace(self.options.effort, network_steps=self.options.steps),
                    depth=int(self.data.attributes.get("depth", 1)),
                    budget_s=budget_s,
                )
                fitted, scored = score(name, task)
            row = {
                **about,
                "variant": variant,
                **self.made(name),
                "room": self.geometry.key[:12],
                "on": f"{resolve(self.job.device)}, {threads()} cores, {processor_name()}",
                "cores": threads(),
                **{key: scored[key] for key in MEASURED},
                "peak_memory_gib": peak["peak_memory_bytes"] / 2**30,
                "model_mib": _bytes(fitted) / 2**20,
            }
            rows.append(
                {key: float(f"{v:.7g}") if isinstance(v, float) else v for key, v in plain(row).items()}
            )
        return max(rows, key=lambda row: row["psnr_db"])


def key_of(row: Row) -> str:
    """Name of a run."""
    return "-".join(str(row[name]) for name in ABOUT)


def unpacked(found: Row) -> list[Row]:
    """The runs of a file's content, each by the names of :data:`COLUMNS`."""
    return [dict(zip(found["columns"], values, strict=True)) for values in found["runs"]]


def region_held_out(data: SpectrumDataset) -> SpectrumDataset:
    """The test receivers of the quarter of the room that is the farthest from the transmitter along the longer side, and the
    training receivers elsewhere."""
    low, high = data.receivers.min(axis=0), data.receivers.max(axis=0)
    axis = int(np.argmax((high - low)[:2]))
    along = (data.receivers[:, axis] - low[axis]) / (high[axis] - low[axis])
    near_end = data.transmitter[axis] < 0.5 * (low[axis] + high[axis])
    inside = along > 1.0 - HELD_OUT if near_end else along < HELD_OUT
    return data.subset(np.where(data.role == "test", inside, ~inside))


def _bytes(fitted: Fitted) -> int:
    """Size of the saved model."""
    if fitted.size_bytes is not None:
        return fitted.size_bytes
    with tempfile.TemporaryDirectory() as folder:
        fitted.field.save(Path(folder) / "field.safetensors")
        return (Path(folder) / "field.safetensors").stat().st_size


# ------------------------------------------------------------------------------------------------- what runs come to


def summarise(runs: Iterable[Row]) -> list[Row]:
    """One row a data set, split, count and method: means over seeds, and of :data:`COMPARED` the spread, ``..._std``.

    A mean is given only where every seed has the figure. ``train_s`` is the time of transport and fit, of the runs that
    had the most cores: runs side by side share them.
    """
    return [_mean(list(group.values())) for group in _by_seed(runs).values()]


def margins(runs: Iterable[Row]) -> list[Row]:
    """The bistatic field less every other method: mean and spread over seeds of the differences on the same spectra, or
    against the one run of a method that sees none."""
    groups, found = _by_seed(runs), []
    for (truth, split, count, method), ours in groups.items():
        if method != "bistatic":
            continue
        for place, theirs in groups.items():
            if place[:2] != (truth, split) or place[2] not in (count, 0) or place[3] == method:
                continue
            others = theirs if place[2] else dict.fromkeys(ours, theirs[0])
            pairs = [(row, others[seed]) for seed, row in ours.items() if seed in others]
            if not pairs:
                continue
            line: Row = {
                "truth": truth,
                "split": split,
                "count": count,
                "method": place[3],
                "seeds": len(pairs),
            }
            for name in COMPARED:
                both = [(own[name], other[name]) for own, other in pairs]
                given = [a - b for a, b in both if a is not None and b is not None]
                line[name] = float(np.mean(given)) if given else None
                line[f"{name}_std"] = _spread(given)
            found.append(line)
    return found


def _by_seed(runs: Iterable[Row]) -> dict[tuple[str, str, int, str], dict[int, Row]]:
    found: dict[tuple[str, str, int, str], dict[int, Row]] = {}
    for run in runs:
        found.setdefault((run["truth"], run["split"], run["count"], run["method"]), {})[run["seed"]] = run
    return found


def _mean(group: list[Row]) -> Row:
    merged: Row = {name: group[0][name] for name in ABOUT if name != "seed"} | {"seeds": len(group)}
    for name in (*MEASURED, "model_mib"):
        values = [run[name] for run in group]
        merged[name] = None if None in values else float(np.mean(values))
    for name in COMPARED:
        merged[f"{name}_std"] = _spread([run[name] for run in group if run[name] is not None])
    most = max(run["cores"] for run in group)
    spent = [
        [run[k] for k in ("transport_s", "fit_s") if run[k] is not None]
        for run in group
        if run["cores"] == most
    ]
    merged["train_s"] = float(np.mean([sum(s) for s in spent])) if any(spent) else None
    merged["peak_memory_gib"] = max(run["peak_memory_gib"] for run in group)
    return merged


def _spread(values: list[float]) -> float | None:
    """Standard deviation; of fewer than two there is none."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


BENCHMARKS = {"paper": Benchmark("paper", Options, run, HELP)}
