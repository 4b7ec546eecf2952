"""Where a receiver is, by what it read: the field asked backwards, beside the nearest measurement."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fits import FitOptions, Fits, experiment
from benchmarks.measurements import POINTINGS, RANGE_DB
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.spectra.spectrum import directions_from_angles, pixel_directions

HELP = """\
A field of the lobby is fitted to 50 of Sionna RT's spectra, on the reconstruction of `make lobby`, or on the true mesh where there
is none. Test receivers, which no fit has seen, are located: from their spectrum; from a horn's pointings at three elevations, of
unknown gain and zero of azimuth, with noise. Beside it stands the training receiver whose measurement is most alike. Each receiver
is kept as soon as it is found.

examples:
  python -m benchmarks locate
  python -m benchmarks locate --every 10 --field field.safetensors     a first look, with a field that was fitted before
"""
TRAIN = 50
HORN_DEG, NOISE_DB, CHAIN_DB, ZERO_DEG = 10.0, 1.0, -23.7, 143.0
PER_DEG = 1.0 / np.sqrt(
    8.0 * np.log(2.0)
)  # standard deviation of a Gaussian over its full width at half maximum
TURNS = 72  # zeros of azimuth that the nearest measurement is sought under
COLUMNS = {
    "rows": (
        ("measured", "located from", "{}"), ("test", "receivers", "{}"), ("median_cm", "median [cm]", "{:.1f}"),
        ("p90_cm", "90th percentile [cm]", "{:.1f}"), ("blocked_median_cm", "blocked: median [cm]", "{:.1f}"),
        ("blocked_p90_cm", "blocked: 90th [cm]", "{:.1f}"), ("wrong", "beyond 30 cm", "{:.1%}"),
        ("wrong_told", "of these not known", "{:.0%}"), ("covered", "within 95 % ellipsoid", "{:.0%}"),
        ("cpu_s", "CPU seconds each", "{:.1f}"), ("nearest_cm", "nearest measurement [cm]", "{:.0f}"),
    )
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(FitOptions):
    """Options of the comparison.

    Attributes:
        field: a saved field instead of a fit.
        parts: what receivers are located from.
    """

    truths: tuple[str, ...] = ("sionna",)
    counts: tuple[int, ...] = option((TRAIN,), "spectra that the field is fitted to")
    field: str | None = option(None, "a field's file that was fitted before")
    parts: tuple[str, ...] = option(("spectrum", "horn"), "from what", choices=("spectrum", "horn"))


def horn_readings(ds: wr.SpectrumDataset, k: int, seed: int | None, turn: float = 0.0) -> np.ndarray:
    """Powers of the pointings at receiver ``k``, turned by ``turn`` [rad]; with noise where there is a seed.

    The spectrum holds a beam already: a narrower horn over it is one of the stated width.
    """
    own = np.sqrt((HORN_DEG * PER_DEG) ** 2 - np.degrees(ds.beam_sigma_rad) ** 2) / PER_DEG
    toward = directions_from_angles(*(POINTINGS + [0.0, turn]).T)
    cosine = np.clip(toward @ pixel_directions(ds.shape).reshape(-1, 3).T, -1.0, 1.0)
    power = wr.horn(np.radians(own)).gain_off_boresight(np.arccos(cosine)) @ ds.path_gain[k].ravel()
    if seed is None:
        return np.asarray(power)
    return np.asarray(
        power * 10.0 ** (NOISE_DB / 10.0 * np.random.default_rng([seed, k]).normal(size=len(power)))
    )


def horn_of(ds: wr.SpectrumDataset, k: int, seed: int) -> wr.Readings:
    """The same as a table of unknown gain and zero of azimuth."""
    gain, zero = 10.0 ** (CHAIN_DB / 10.0), np.radians(ZERO_DEG)
    power = gain * horn_readings(ds, k, seed)
    floor = power.max() * 10.0 ** (-RANGE_DB / 10.0)
    return wr.Readings(
        ds.transmitter, ds.receivers[k], np.maximum(power, floor), ds.frequency_hz, floor, arrival=POINTINGS - [0.0, zero],
        receive_pattern=wr.horn(np.radians(HORN_DEG)), chain=["horn"] * len(power), std_db=NOISE_DB, azimuth_known=False,
    )  # fmt: skip


def nearest_spectrum(test: wr.SpectrumDataset, k: int, train: wr.SpectrumDataset) -> np.ndarray:
    """Place of the training receiver whose dB image is most alike [m]."""
    error = ((train.path_gain_db - test.path_gain_db[k]) ** 2).mean(axis=(1, 2))
    return np.asarray(train.receivers[int(error.argmin())])


def nearest_horn(
    test: wr.SpectrumDataset, k: int, known: np.ndarray, train: wr.SpectrumDataset, seed: int
) -> np.ndarray:
    """Place of the training receiver whose readings ``known`` (R, T, N) are most alike under any turn and gain [m]."""
    read = 10.0 * np.log10(horn_readings(test, k, seed))
    read = np.maximum(read - read.max(), -RANGE_DB)
    db = 10.0 * np.log10(known)
    error = np.abs(np.maximum(db - db.max(axis=2, keepdims=True), -RANGE_DB) - read).mean(axis=2).min(axis=1)
    return np.asarray(train.receivers[int(error.argmin())])


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """A row for each kind of measurement."""
    truth = options.load()[0]
    train, test = truth.data.split(options.counts[0])[0], truth.test
    folder = Path(options.geometry)
    room = (
        options.place(fits.job.device).reconstruction
        if folder.is_dir()
        else wr.Reconstruction(mesh=wr.Scene.load(options.xml).mesh)
    )
    name = "from photos" if folder.is_dir() else "true mesh"
    known = options.field
    field = wr.RadioField.load(known) if known else fits.fit(room, train)
    pool = truth.data.subset(truth.data.role == "train")
    turned = np.stack([
        [horn_readings(pool, r, None, turn) for turn in 2.0 * np.pi / TURNS * np.arange(TURNS)] for r in range(len(pool))
    ]) if "horn" in options.parts else np.zeros(0)  # fmt: skip
    ask: dict[str, Any] = {"store": fits.job.out / "map.nc", "progress": fits.job.progress}
    field.locate(test.subset([0]), **ask)  # makes the map, which does not count
    for part in options.parts:
        found = []
        for k in range(len(test)):

            def make(k: int = k, part: str = part) -> Row:
                true, seed = test.receivers[k], fits.job.seed
                one = test.subset([k]) if part == "spectrum" else horn_of(test, k, seed)
                start = time.process_time()
                answer = field.locate(one, **ask)
                spent, off = time.process_time() - start, answer.position - true
                rival = (
                    nearest_spectrum(test, k, pool)
                    if part == "spectrum"
                    else nearest_horn(test, k, turned, pool, seed)
                )
                return {
                    "error_m": float(np.linalg.norm(off)), "known": answer.known, "misfit": answer.misfit, "cpu_s": spent,
                    "squares": float(off @ np.linalg.pinv(answer.covariance) @ off),
                    "nearest_m": float(np.linalg.norm(rival - true)), "blocked": not bool(test.line_of_sight[k]),
                }  # fmt: skip

            found.append(fits.row(f"{part} {options.every * k}", make, known or name))
        yield {"measured": f"{part}, {name}", **summary(found)}


def summary(found: list[Row]) -> Row:
    """Figures of the receivers together."""
    error, blocked = (
        100.0 * np.array([one["error_m"] for one in found]),
        np.array([one["blocked"] for one in found]),
    )
    wrong, told = error > 30.0, np.array([not one["known"] for one in found])
    most = 7.81  # that three squared normal deviates sum to in 95 % of cases
    return {
        "test": len(found), "median_cm": float(np.median(error)), "p90_cm": float(np.quantile(error, 0.9)),
        "blocked_median_cm": float(np.median(error[blocked])) if blocked.any() else None,
        "blocked_p90_cm": float(np.quantile(error[blocked], 0.9)) if blocked.any() else None,
        "wrong": float(wrong.mean()), "wrong_told": float(told[wrong].mean()) if wrong.any() else None,
        "covered": float(np.mean([one["squares"] < most for one in found])),
        "cpu_s": float(np.median([one["cpu_s"] for one in found])),
        "nearest_cm": 100.0 * float(np.median([one["nearest_m"] for one in found])), "receivers": found,
    }  # fmt: skip


ABOUT = "Lobby, Sionna RT's truth with three bounces, test receivers that no fit has seen, located in three dimensions."
BENCHMARKS = {"locate": experiment("locate", Options, rows, COLUMNS, ABOUT, HELP)}
