"""Where to measure next: suggested receivers beside random ones, and the error as measurements come in from none on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA, Truth
from benchmarks.machine import machine
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.training import trace

HELP = """\
Fields on the reconstruction of `make lobby` are fitted to spectra of no receiver, of one to ten drawn at random, and
to three that the field suggests: all from no measurement, or two after a first random one. Truth is Sionna RT's; the test
receivers score.

examples:
  python -m benchmarks suggest
  python -m benchmarks suggest --every 4 --draws 3     a first look, in minutes
"""
POOL = 60  # candidates: training receivers
COLUMNS = (
    ("readings", "spectra of", "{}"), ("draws", "draws", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("psnr_std_db", "spread [dB]", "{:.2f}"), ("psnr_least_db", "least [dB]", "{:.2f}"),
    ("direction_within_3deg_blocked", "blocked: within 3 degrees", "{:.0%}"),
    ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"),
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
        sub_pixels: square root of the rays per pixel.
    """

    reconstruction: str = option("runs/lobby/reconstruction", "folder of the geometry")
    spectra: str = option(str(Path(DATA) / "spectra_sionna.nc"), "Sionna RT's spectra (NetCDF)")
    every: int = option(1, "each how-manieth test receiver counts")
    draws: int = option(10, "random sets of each size")
    counts: tuple[int, ...] = option((1, 2, 3, 5, 6, 10), "their sizes")
    quick: bool = option(False, "quick fits in the place of default ones")
    sub_pixels: int = option(
        1, "square root of the rays per pixel; 3, the fit's default, takes twice the time"
    )


def run(options: Options, job: Job) -> Report:
    """Draw, suggest, fit and score.

    Raises:
        FileNotFoundError, ValueError: as the reconstruction and the spectra do.
    """
    truth = Truth.load(Path(options.spectra), (POOL,), options.every)
    pool, test = truth.train(POOL), truth.test
    surface = Surface.of(wr.Reconstruction.load(options.reconstruction))
    rng = np.random.default_rng(job.seed)
    orders = [rng.permutation(len(pool)) for _ in range(options.draws)]
    rows: list[dict[str, Any]] = []
    nothing = pool.subset([])
    unmeasured = wr.RadioField.fit(surface, nothing, device=job.device)
    seen = trace(surface, pool, sub_pixels=options.sub_pixels, device=job.device)

    def fitted(chosen: Sequence[int] | np.ndarray) -> wr.RadioField:
        part = pool.subset(np.asarray(chosen, int))
        transport = seen.subset(chosen)
        return wr.RadioField.fit(surface, part, transport=transport, device=job.device, quick=options.quick)

    def add(name: str, fields: Iterable[wr.RadioField]) -> None:
        each: list[dict[str, Any]] = []
        for field in fields:
            job.progress(name, len(each), options.draws)
            each.append(wr.evaluate(test, field.spectrum))
        row: dict[str, Any] = {"readings": name, "draws": len(each)}
        for key in ("psnr_db", "direction_within_3deg_blocked", "beam_gain_loss_db"):
            row[key] = float(np.mean([one[key] for one in each]))
        psnr = [one["psnr_db"] for one in each]
        rows.append(row | {"psnr_std_db": float(np.std(psnr)), "psnr_least_db": float(np.min(psnr))})

    add("no receiver", [unmeasured])
    add("3 suggested from none", [fitted(unmeasured.suggest(pool.receivers, 3))])
    for count in options.counts:
        add(f"{count} random", (fitted(order[:count]) for order in orders))
    begun = ((order[0], fitted(order[:1])) for order in orders)
    add(
        "1 random and 2 suggested",
        (fitted([first, *field.suggest(pool.receivers, 2)]) for first, field in begun),
    )
    kind = "quick" if options.quick else "default"
    head = (
        f"Lobby from photos, Sionna RT's truth with three bounces, {kind} fits, {len(pool)} candidates, "
        f"{len(test)} test receivers."
    )
    about = {"quick": options.quick, "sub_pixels": options.sub_pixels}
    figures = {
        "machine": machine(job.device),
        **about,
        "test": len(test),
        "candidates": len(pool),
        "rows": rows,
    }
    return Report("suggest", figures, f"{head}\n\n{columns_table(COLUMNS, rows)}")


BENCHMARKS = {"suggest": Benchmark("suggest", Options, run, HELP)}
