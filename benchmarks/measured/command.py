"""`python -m benchmarks measured NAME`: fields and rivals fitted to some of a place's links, scored at those held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fits import rms
from benchmarks.machine import machine
from benchmarks.measured import flat
from benchmarks.measured.links import Links, noise_db
from benchmarks.measured.rivals import RIVALS
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.steps import Steps, digest

HELP = """\
Flat: six Bluetooth anchors' power in a furnished flat, which you fetch yourself (CC BY 4.0, repository
github.com/marckolak/ble-rss-fingerprints-calib2021): anchors.csv, calibration_df.csv and layout.csv in one folder. An anchor at
a time is held out, then a room at a time. Each row is fitted to the means of the others' links; the noise of these
means, from split halves, was frozen in benchmarks/results/measured_flat_noise.json before anything was fitted.

examples:
  python -m benchmarks measured flat --source external/ble_flat
  python -m benchmarks measured flat --noise-alone
"""
PLACES = {"flat": flat}
VERSION = 1
"""Counted up by hand when a field's predictions come out differently."""
DARK_DB = -300.0  # path gain of what no path reaches
Predict = Callable[[Links, Links], np.ndarray]
COLUMNS = (
    ("held_out", "held out", "{}"), ("model", "model", "{}"), ("rms_db", "rms [dB]", "{:.2f}"), ("seen_db", "in sight", "{:.2f}"),
    ("behind_db", "behind walls", "{:.2f}"), ("behind_bias_db", "behind walls, mean", "{:+.2f}"), ("dark", "no path", "{:.1%}"),
    ("worst_db", "worst held out", "{:.2f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of a measured place.

    Attributes:
        place: which.
        source: folder of its files.
        hold_out: what is held out, one at a time.
        noise_alone: write the noise of the means, and fit nothing.
    """

    place: str = option("flat", "which place", choices=tuple(PLACES), positional=True)
    source: str = option("external/ble_flat", "folder of its files")
    hold_out: tuple[str, ...] = option(
        ("anchor", "room"), "what is held out, one at a time", choices=("anchor", "room")
    )
    noise_alone: bool = option(False, "write the noise of the means, and fit nothing")


def field(place: Any, effects: wr.Effects, job: Job, train: Links, test: Links) -> np.ndarray:
    """A bistatic field of the place's scene fitted to the links: materials and one gain [dB]."""
    readings = wr.Readings(
        train.senders, train.receivers, 10.0 ** (train.level_db / 10.0), place.FREQUENCY_HZ,
        10.0 ** (place.FLOOR_DBM / 10.0), chain=["chain"] * len(train), samples=place.FEWEST,
    )  # fmt: skip
    fitted = wr.RadioField.fit(
        place.scene(), readings, model="bistatic", quick=True, effects=effects, device=job.device, progress=job.progress,
    )  # fmt: skip
    gain = np.zeros(len(test))
    for anchor in np.unique(test.anchor):
        own = test.anchor == anchor
        gain[own] = fitted.links(test.receivers[own], test.senders[own][0]).total_path_gain
    return fitted.report["chains"]["chain"]["gain_db"] + _db(gain)


def traced(place: Any, options: Mapping[str, Any], train: Links, test: Links) -> np.ndarray:
    """Sharp paths through the scene as it was guessed, nothing fitted but one gain [dB]."""

    def power(links: Links) -> np.ndarray:
        ends: dict[str, Any] = {"transmitter": links.senders, "receivers": links.receivers}
        paths = wr.trace_paths(place.scene(), **ends, frequency_hz=place.FREQUENCY_HZ, **options)
        return _db(np.where(paths.valid, paths.power, 0.0).sum(axis=-1))

    known = power(train)
    lit = known > DARK_DB
    return power(test) + np.median(train.level_db[lit] - known[lit])


def _db(gain: np.ndarray) -> np.ndarray:
    return np.asarray(10.0 * np.log10(np.maximum(gain, 10.0 ** (DARK_DB / 10.0))))


BARE = wr.Effects(mirrors=2, scatter_mirror=False, transmissions=0, diffractions=0)
FIELDS = {
    "field": replace(BARE, transmissions=3, diffractions=1),
    "field, without diffraction": replace(BARE, transmissions=3), "field, without either": BARE,
}  # fmt: skip
"""Rows of fields by their effects."""
TRACED = {
    "traced": {"mirror_order": 2, "transmissions": 3, "diffractions": 1}, "traced, without either": {"mirror_order": 2}
}  # fmt: skip
"""Rows of sharp paths by the options of their tracing."""


def run(options: Options, job: Job) -> Report:
    """Read the place, freeze the noise or fit every model.

    Raises:
        FileNotFoundError, ValueError: naming the file that does not fit.
    """
    place, folder = PLACES[options.place], Path(options.source)
    links, readings = place.links(folder)
    parts = {"all": np.ones(len(links), bool), "behind walls": links.behind, "in sight": ~links.behind}
    noise = {"cells": len(np.unique(links.cell)), "links": len(links)} | {
        name: {"links": int(part.sum())} | noise_db([readings[k] for k in np.flatnonzero(part)], job.seed)
        for name, part in parts.items()
    }
    name = f"measured_{options.place}"
    if options.noise_alone:
        return Report(f"{name}_noise", noise, _said(noise))
    models: dict[str, tuple[Predict, str]] = {key: (predict, "") for key, predict in RIVALS.items()}
    models |= {key: (partial(traced, place, given), repr(given)) for key, given in TRACED.items()}
    models |= {key: (partial(field, place, given, job), repr(given)) for key, given in FIELDS.items()}
    rows: list[Row] = []
    known = digest(folder, place.scene().mesh.triangles, *map(repr, place.scene().materials))
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        for model, (predict, given) in models.items():
            error: dict[str, np.ndarray] = {}
            for kind, which, out in links.held_out(options.hold_out):
                step = f"{model} {kind} {which}"
                file = "".join(c if c.isalnum() else "-" for c in step)

                def make(predict: Predict = predict, out: np.ndarray = out) -> dict[str, np.ndarray]:
                    return {"level_db": predict(links.subset(~out), links.subset(out))}

                found = steps.arrays(file, make, version=VERSION, inputs=[known, given, out])["level_db"]
                error.setdefault(kind, np.zeros(len(links)))[out] = found - links.level_db[out]
            rows += [_row(links, kind, model, errors, place.FLOOR_DBM) for kind, errors in error.items()]
    rows.sort(key=lambda row: str(row["held_out"]))
    text = "\n\n".join([str(place.__doc__).split("\n")[0], _said(noise), columns_table(COLUMNS, rows)])
    return Report(
        name, {"machine": machine(job.device), "seed": job.seed, "noise": noise, "rows": rows}, text
    )


def _row(links: Links, kind: str, model: str, error: np.ndarray, floor_db: float) -> Row:
    """Errors of one model, no less than as if what it does not reach were at the floor."""
    dark = links.level_db + error < floor_db
    error = np.where(dark, floor_db - links.level_db, error)
    own = links.anchor.astype(str) if kind == "anchor" else links.room
    each = {str(one): rms(error[own == one]) for one in np.unique(own)}
    behind = links.behind
    return {
        "held_out": kind, "model": model, "rms_db": rms(error), "seen_db": rms(error[~behind]), "behind_db": rms(error[behind]),
        "behind_bias_db": float(error[behind].mean()), "dark": float(dark.mean()), "worst_db": max(each.values()), "each_db": each,
    }  # fmt: skip


def _said(noise: Mapping[str, Any]) -> str:
    every, behind = noise["all"], noise["behind walls"]
    return (
        f"{noise['links']} means of {noise['cells']} cells, {behind['links']} of them behind walls. Noise of a mean, from "
        f"halves in the order of time: {every['halves_by_time']:.2f} dB, behind walls {behind['halves_by_time']:.2f} dB; from "
        f"halves by chance: {every['halves_by_chance']:.2f} dB. A single reading scatters by {every['single_reading']:.2f} dB."
    )


BENCHMARKS = {"measured": Benchmark("measured", Options, run, HELP)}
