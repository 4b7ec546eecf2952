"""Where to measure next: suggested receivers beside random ones, and the error as measurements come in from none on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.fits import FitOptions, Fits, experiment, mean_row
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.steps import digest

HELP = """\
Fields on the reconstruction of `make lobby` are fitted to spectra of no receiver, of one to ten drawn at random, and
to three that the field suggests: all from no measurement, or two after a first random one. Truth is Sionna RT's; the test
receivers score. Each fit is kept as soon as it is finished.

examples:
  python -m benchmarks suggest
  python -m benchmarks suggest --every 4 --draws 3     a first look, in minutes
"""
POOL = 60  # candidates: training receivers
SUB_PIXELS = 1  # square root of the rays per pixel; 3, the fit's default, takes twice the time
COLUMNS = {
    "rows": (
        ("readings", "spectra of", "{}"), ("draws", "draws", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
        ("psnr_std_db", "spread [dB]", "{:.2f}"), ("psnr_least_db", "least [dB]", "{:.2f}"),
        ("direction_within_3deg_blocked", "blocked: within 3 degrees", "{:.0%}"),
        ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"), ("total_rms_db", "total power, rms [dB]", "{:.2f}"),
    )
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(FitOptions):
    """Options of the comparison.

    Attributes:
        draws: random sets of each size.
        counts: their sizes.
    """

    truths: tuple[str, ...] = ("sionna",)
    counts: tuple[int, ...] = option((1, 2, 3, 5, 6, 10), "sizes of random sets")
    draws: int = option(10, "random sets of each size")


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """Means over draws: none, random sets of each size, and suggested ones."""
    truth, room = options.load()[0], options.place(fits.job.device).reconstruction
    pool, rng = truth.data.split(POOL)[0], np.random.default_rng(fits.job.seed)
    orders = [rng.permutation(POOL) for _ in range(options.draws)]

    def mean(name: str, sets: Sequence[Any]) -> Row:
        found = []
        for chosen in (sorted(map(int, one)) for one in sets):
            make = partial(fits.scored, room, pool.subset(chosen), truth.test, sub_pixels=SUB_PIXELS)
            found.append(fits.row(f"fit {chosen}", make))
        return {"readings": name, **mean_row(found)}

    def suggested(measured: list[int], n: int, among: np.ndarray) -> list[int]:
        def make() -> Row:
            field = fits.fit(room, pool.subset(measured), sub_pixels=SUB_PIXELS)
            return {"chosen": among[field.suggest(pool.receivers[among], n)].tolist()}

        return [*measured, *fits.row(f"choice {measured} {digest(among)[:8]}", make)["chosen"]]

    every, halves = np.arange(POOL), [np.sort(order[: POOL // 2]) for order in orders]
    yield mean("no receiver", [[]])
    for count in options.counts:
        yield mean(f"{count} random", [order[:count] for order in orders])
    yield mean("3 suggested from none", [suggested([], 3, every)])
    yield mean("3 suggested of half of them", [suggested([], 3, half) for half in halves])
    yield mean("1 random and 2 suggested", [suggested([int(order[0])], 2, every) for order in orders])


ABOUT = f"Lobby from photos, Sionna RT's truth with three bounces, {POOL} candidates."
BENCHMARKS = {"suggest": experiment("suggest", Options, rows, COLUMNS, ABOUT, HELP)}
