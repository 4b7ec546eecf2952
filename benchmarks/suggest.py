"""Where to measure next: suggested receivers beside random ones, and the error as measurements come in from none on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import measurements
from benchmarks.data import DATA
from benchmarks.machine import machine
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.training import TrainingViews, trace
from warprrf.steps import Attempt, Steps

HELP = """\
Fields on the reconstruction of `make lobby` are fitted to spectra of no receiver, of one to ten drawn at random, and
to three that the field suggests: all from no measurement, or two after a first random one. Truth is Sionna RT's; the test
receivers score. Each fit is kept as soon as it is finished.

examples:
  python -m benchmarks suggest
  python -m benchmarks suggest --every 4 --draws 3     a first look, in minutes
"""
FIT_VERSION, CHOICE_VERSION = 1, 1
"""Counted up by hand when fits, or suggestions, come out differently."""
POOL = 60  # candidates: training receivers
SUB_PIXELS = 1  # square root of the rays per pixel; 3, the fit's default, takes twice the time
FIGURES = ("psnr_db", "direction_within_3deg_blocked", "beam_gain_loss_db", "total_rms_db")
COLUMNS = (
    ("readings", "spectra of", "{}"), ("draws", "draws", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("psnr_std_db", "spread [dB]", "{:.2f}"), ("psnr_least_db", "least [dB]", "{:.2f}"),
    ("direction_within_3deg_blocked", "blocked: within 3 degrees", "{:.0%}"),
    ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"), ("total_rms_db", "total power, rms [dB]", "{:.2f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        reconstruction: folder of the geometry.
        spectra: Sionna RT's spectra (NetCDF).
        every: each how-manieth test receiver counts.
        draws: random sets of each size.
        counts: their sizes.
        quick: quick fits in the place of default ones.
    """

    reconstruction: str = option("runs/lobby/reconstruction", "folder of the geometry")
    spectra: str = option(str(Path(DATA) / "spectra_sionna.nc"), "Sionna RT's spectra (NetCDF)")
    every: int = option(1, "each how-manieth test receiver counts")
    draws: int = option(10, "random sets of each size")
    counts: tuple[int, ...] = option((1, 2, 3, 5, 6, 10), "their sizes")
    quick: bool = option(False, "quick fits in the place of default ones")


class Fits:
    """Fields on some of the candidates, and their figures, which are kept.

    Attributes:
        lobby: the room and its test receivers.
        pool: spectra of the candidates.
    """

    def __init__(self, options: Options, job: Job, steps: Steps) -> None:
        common = {name: getattr(options, name) for name in ("reconstruction", "spectra", "every")}
        self.lobby = measurements.Lobby(measurements.Options(**common), job, steps)
        self.pool, self.quick = self.lobby.ds.split(POOL)[0], options.quick

    @cached_property
    def seen(self) -> TrainingViews:
        """What the candidates see."""
        lobby = self.lobby
        return trace(
            lobby.surface,
            self.pool,
            sub_pixels=SUB_PIXELS,
            device=lobby.job.device,
            progress=lobby.job.progress,
        )

    def field(self, chosen: Sequence[int]) -> BistaticField:
        """Fitted to the candidates ``chosen``."""
        part, seen = self.pool.subset(chosen), self.seen.subset(chosen) if len(chosen) else None
        return self.lobby.fit(part, transport=seen, quick=self.quick, sub_pixels=SUB_PIXELS)

    def scored(self, chosen: Sequence[int]) -> dict[str, Any]:
        """Figures of :meth:`field`."""
        own = sorted(chosen)
        return self._kept(
            "fit", FIT_VERSION, own, lambda: self.lobby.scored(self.field(own), self.lobby.test)
        )

    def suggested(self, measured: Sequence[int], n: int, among: np.ndarray) -> list[int]:
        """``n`` of the candidates ``among``, by the field fitted to ``measured``."""

        def make() -> dict[str, Any]:
            found = self.field(measured).suggest(
                self.pool.receivers[among], n, progress=self.lobby.job.progress
            )
            return {"chosen": among[found].tolist()}

        return list(self._kept("choice", CHOICE_VERSION, [*measured, -n, *among], make)["chosen"])

    def _kept(self, kind: str, version: int, of: Sequence[int], make: Any) -> dict[str, Any]:
        def step(attempt: Attempt) -> dict[str, Any]:
            return dict(make())

        inputs = [self.lobby.key, self.quick, SUB_PIXELS]
        name = "-".join([kind, *map(str, of)])
        return self.lobby.steps.run(name, step, version=version, inputs=inputs)


def run(options: Options, job: Job) -> Report:
    """Draw, suggest, fit and score.

    Raises:
        FileNotFoundError, ValueError: as the reconstruction and the spectra do.
    """
    rows: list[dict[str, Any]] = []

    def add(name: str, sets: Iterable[Sequence[int]]) -> None:
        each: list[dict[str, Any]] = []
        for chosen in sets:
            job.progress(name, len(each), options.draws)
            each.append(fits.scored(chosen))
        row = {key: float(np.mean([one[key] for one in each])) for key in FIGURES}
        psnr = [one["psnr_db"] for one in each]
        spread = {"psnr_std_db": float(np.std(psnr)), "psnr_least_db": float(np.min(psnr))}
        rows.append({"readings": name, "draws": len(each), **row, **spread})

    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        fits = Fits(options, job, steps)
        rng, every = np.random.default_rng(job.seed), np.arange(POOL)
        orders = [rng.permutation(POOL).tolist() for _ in range(options.draws)]
        add("no receiver", [[]])
        for count in options.counts:
            add(f"{count} random", (order[:count] for order in orders))
        add("3 suggested from none", [fits.suggested([], 3, every)])
        add(
            "3 suggested of half of them",
            (fits.suggested([], 3, np.sort(order[: POOL // 2])) for order in orders),
        )
        add("1 random and 2 suggested", ([k, *fits.suggested([k], 2, every)] for k, *_ in orders))
    test = fits.lobby.test
    head = (
        f"Lobby from photos, Sionna RT's truth with three bounces, {'quick' if options.quick else 'default'} fits, "
        f"{POOL} candidates, {len(test)} test receivers."
    )
    about = {"quick": options.quick, "sub_pixels": SUB_PIXELS, "test": len(test), "candidates": POOL}
    figures = {"machine": machine(job.device), **about, "rows": rows}
    return Report("suggest", figures, f"{head}\n\n{columns_table(COLUMNS, rows)}")


BENCHMARKS = {"suggest": Benchmark("suggest", Options, run, HELP)}
