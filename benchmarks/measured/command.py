"""`python -m benchmarks measured NAME`: fields and rivals fitted to some of a place's links, scored at those held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fits import rms
from benchmarks.machine import machine
from benchmarks.measured import flat, hall, office
from benchmarks.measured.links import DARK_DB, Links, Place, db
from benchmarks.measured.rivals import RIVALS
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.steps import Steps, digest

HELP = """\
Flat: six Bluetooth anchors' power in a furnished flat, which you fetch yourself (CC BY 4.0, repository
github.com/marckolak/ble-rss-fingerprints-calib2021): anchors.csv, calibration_df.csv and layout.csv in one folder. An anchor at
a time is held out, then a room at a time. Each row is fitted to the means of the others' links; the noise of these
means, from split halves, was frozen in benchmarks/results/measured_flat_noise.json before anything was fitted.

Office: impulse responses of 24 links over 3 to 7 GHz on a floor of offices (repository github.com/buguen/pylayers, MIT licence, of
which --source is a copy: data/meas/W1, data/struc/lay/WHERE1.lay, data/struc/furnitures/Furw1.ini, data/ant/defant.vsh3). First
and strong arrivals are compared with sharp paths of which nothing is fitted; then a receiver, two of the four, or one of two
heights is held out.

Hall: the paths between a transmitter and 45 places of a receiver at 60 GHz, with lengths, both directions and powers of pairs of
beams, and the hall's plan. --source is a folder with two files that you fetch yourself (no licence is stated):
Kampusareena_slam_measurements_svd_p999.mat (repository github.com/okaltiok/Robust-snapshot-radio-SLAM) and kampusarena_map.fig
(github.com/BaiLiping/radio_SLAM). Nine neighbouring places are held out at a time.

examples:
  python -m benchmarks measured flat --source external/ble_flat
  python -m benchmarks measured office --source external/pylayers
  python -m benchmarks measured hall --source external/kampusareena
  python -m benchmarks measured flat --noise-alone
"""
PLACES = {"flat": flat.place, "office": office.place, "hall": hall.place}
SOURCES = {"flat": "external/ble_flat", "office": "external/pylayers", "hall": "external/kampusareena"}
VERSION = 2
"""Counted up by hand when a field's predictions come out differently."""
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
        source: folder of its files; that of :data:`SOURCES` if empty.
        hold_out: what is held out, one at a time; all that the place has if empty.
        noise_alone: write the noise of the means, and fit nothing.
    """

    place: str = option("flat", "which place", choices=tuple(PLACES), positional=True)
    source: str = option(
        "", "folder of its files; external/ble_flat, external/pylayers or external/kampusareena by default"
    )
    hold_out: tuple[str, ...] = option(
        (),
        "what is held out, one at a time; all that the place has by default",
        choices=("anchor", "pair", "room", "height", "block"),
    )
    noise_alone: bool = option(False, "write the noise of the means, and fit nothing")


def field(
    place: Place, job: Job, scene: wr.Scene, effects: wr.Effects, train: Links, test: Links
) -> np.ndarray:
    """A bistatic field of the scene fitted to the links: materials and one gain [dB]."""
    readings = wr.Readings(
        train.senders, train.receivers, 10.0 ** (train.level_db / 10.0), place.frequency_hz, 10.0 ** (place.floor_db / 10.0),
        chain=["chain"] * len(train), samples=place.samples,
    )  # fmt: skip
    fitted = wr.RadioField.fit(
        scene, readings, model="bistatic", quick=True, effects=effects, device=job.device, progress=job.progress,
    )  # fmt: skip
    gain = np.zeros(len(test))
    for anchor in np.unique(test.anchor):
        own = test.anchor == anchor
        gain[own] = fitted.links(test.receivers[own], test.senders[own][0]).total_path_gain
    return np.asarray(fitted.report["chains"]["chain"]["gain_db"] + db(gain))


def traced(
    place: Place, scene: wr.Scene, options: Mapping[str, Any], train: Links, test: Links
) -> np.ndarray:
    """Sharp paths through the scene as it was guessed, nothing fitted but one gain [dB]."""

    def power(links: Links) -> np.ndarray:
        ends: dict[str, Any] = {"transmitter": links.senders, "receivers": links.receivers}
        paths = wr.trace_paths(scene, **ends, frequency_hz=place.frequency_hz, **options)
        return db(np.where(paths.valid, paths.power, 0.0).sum(axis=-1))

    known = power(train)
    lit = known > DARK_DB
    return power(test) + np.median(train.level_db[lit] - known[lit])


def run(options: Options, job: Job) -> Report:
    """Read the place, freeze the noise or fit every model.

    Raises:
        FileNotFoundError, ValueError: naming the file that does not fit.
    """
    name, source = f"measured_{options.place}", Path(options.source or SOURCES[options.place])
    place = PLACES[options.place](source, job.seed)
    kinds = options.hold_out or place.kinds
    if set(kinds) - set(place.kinds):
        raise ValueError(
            f"hold_out: got {', '.join(kinds)}, expected some of {', '.join(place.kinds)} of the {options.place}"
        )
    if options.noise_alone:
        return Report(f"{name}_noise", place.noise, place.said)
    links = place.links
    models: dict[str, tuple[Predict, str]] = {key: (predict, "") for key, predict in RIVALS.items()}
    rows_of = ((partial(traced, place), place.traced), (partial(field, place, job), place.fields))
    models |= {
        name: (partial(predict, scene, given), digest(scene.mesh.triangles, *map(repr, scene.materials), repr(given)))
        for predict, known in rows_of for name, (scene, given) in known.items()
    }  # fmt: skip
    rows: list[Row] = []
    known = digest(*place.files)
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        for model, (predict, given) in models.items():
            error: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
            for kind, which, out in links.held_out(kinds):
                step = f"{model} {kind} {which}"
                file = "".join(c if c.isalnum() else "-" for c in step)

                def make(predict: Predict = predict, out: np.ndarray = out) -> dict[str, np.ndarray]:
                    return {"level_db": predict(links.subset(~out), links.subset(out))}

                found = steps.arrays(file, make, version=VERSION, inputs=[known, given, out])["level_db"]
                error.setdefault(kind, []).append((np.flatnonzero(out), found - links.level_db[out]))
            for kind, parts in error.items():
                own, errors = (np.concatenate(side) for side in zip(*parts, strict=True))
                rows.append(_row(links.subset(own), kind, model, errors, place.floor_db))
        more, said = place.fitted(job, steps) if place.fitted else ({}, "")
    rows.sort(key=lambda row: str(row["held_out"]))
    own_figures = {"machine": machine(job.device), "seed": job.seed, "noise": place.noise, "rows": rows}
    figures = {**own_figures, **place.more, **more}
    text = [place.about, place.said, columns_table(COLUMNS, rows), said]
    return Report(name, figures, "\n\n".join(filter(None, text)))


def _row(links: Links, kind: str, model: str, error: np.ndarray, floor_db: float) -> Row:
    """Errors of one model, no less than as if what it does not reach were at the floor, None in sight if none is."""
    dark = links.level_db + error < floor_db
    error = np.where(dark, floor_db - links.level_db, error)
    own = links.room if kind in ("room", "block") else links.anchor.astype(str)
    each = {str(one): rms(error[own == one]) for one in np.unique(own)}
    seen, behind = error[~links.behind], error[links.behind]
    return {
        "held_out": kind, "model": model, "rms_db": rms(error), "seen_db": rms(seen) if len(seen) else None,
        "behind_db": rms(behind), "behind_bias_db": float(behind.mean()), "dark": float(dark.mean()),
        "worst_db": max(each.values()), "each_db": each,
    }  # fmt: skip


BENCHMARKS = {"measured": Benchmark("measured", Options, run, HELP)}
