"""The exact engine beside Sionna RT, both to depth 3: processor time of a spectrum against the noise of what is sampled.

The noise of an engine is the rms over pixels of what two seeds differ by, in dB on the data set's floor, over the root of 2.
That of Sionna RT falls at best as the root of its rays, of which the least time at the exact engine's noise follows.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.lobby.spectra import FREQUENCY_HZ, TRANSMITTER
from benchmarks.machine import machine
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.rf.spectra.spectrum import to_db

HELP = """\
Spectra of the lobby by the exact engine, without and with light that is seen in mirrors after it was scattered, and by Sionna RT
with more and more rays, with two seeds each. Needs the extra sionna.

examples:
  python -m benchmarks truths
  python -m benchmarks truths --receivers 2 --samples 1000000      a first look
"""
BOTH_HAVE = wr.Effects(scatter_mirror=False, transmissions=0, residual=False)
"""Mirrors, scatterings and mirrors before them, three in all."""
SEEDS = (0, 1)
COLUMNS = (
    ("engine", "engine", "{}"), ("core_s", "processor time of a spectrum [s]", "{:.3g}"), ("noise_db", "noise, rms [dB]", "{:.2f}"),
    ("total_db", "total over the first row's [dB]", "{:+.2f}"), ("ratio", "least time at its noise, over its", "{:.1f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        receivers: places.
        samples: rays of Sionna RT, a row each.
        shape: rows and columns of the spectra.
    """

    receivers: int = option(6, "places")
    samples: tuple[int, ...] = option((1_000_000, 4_000_000), "rays of Sionna RT")
    shape: tuple[int, int] = (60, 120)


def run(options: Options, job: Job) -> Report:
    """Measure every engine.

    Raises:
        ImportError: without Sionna RT.
    """
    scene = wr.Scene.load("data/lobby/scene.xml")
    places = wr.sample_receivers(scene, options.receivers, seed=job.seed)
    engines: dict[str, dict[str, Any]] = {
        "exact": {"effects": BOTH_HAVE},
        "exact, scattered and then mirrored too": {"effects": wr.Effects(transmissions=0, residual=False)},
    }
    engines |= {
        f"Sionna RT, {n / 1e6:g} million rays": {"engine": "sionna", "samples": n} for n in options.samples
    }
    rows: list[Row] = []
    floor, total = 0.0, np.ones(1)
    for k, (name, how) in enumerate(engines.items()):
        job.progress("engines", k, len(engines))
        how |= {
            "transmitter": TRANSMITTER,
            "frequency_hz": FREQUENCY_HZ,
            "shape": options.shape,
            "device": job.device,
        }
        wr.simulate(scene, receivers=places[:1], **how)  # kernels are compiled
        clock = time.process_time()
        found = [wr.simulate(scene, receivers=places, **how, seed=seed) for seed in SEEDS]
        seconds = (time.process_time() - clock) / len(SEEDS) / len(places)
        own = np.mean([one.path_gain.sum(axis=(1, 2), dtype=np.float64) for one in found], axis=0)
        if not rows:
            floor, total = found[0].floor, own
        a, b = (to_db(one.path_gain, floor) for one in found)
        noise = float(np.sqrt(np.mean((a - b) ** 2) / 2.0))
        difference = float(np.mean(10.0 * np.log10(own / total)))
        rows.append({"engine": name, "core_s": seconds, "noise_db": noise, "total_db": difference})
    for row in rows[2:]:
        row["ratio"] = row["core_s"] * (row["noise_db"] / rows[0]["noise_db"]) ** 2 / rows[0]["core_s"]
    figures = {"machine": machine(job.device), "receivers": places, "shape": options.shape, "rows": rows}
    return Report("truths", figures, columns_table(COLUMNS, rows))


BENCHMARKS = {"truths": Benchmark("truths", Options, run, HELP)}
