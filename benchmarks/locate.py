"""Where a receiver is, by what it read: the field asked backwards, beside the nearest measurement; and where transmitters go."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

import warprrf as wr
from benchmarks.fits import FitOptions, Fits, experiment
from benchmarks.measurements import OTHERS, POINTINGS, RANGE_DB
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.em.waves import NEPER, SPEED_OF_LIGHT
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine
from warprrf.rf.maps.placing import OBJECTIVES, best_set
from warprrf.rf.positions import is_free
from warprrf.rf.spectra.readings import tap_share
from warprrf.rf.spectra.spectrum import directions_from_angles, pixel_directions

HELP = """\
A field of the lobby is fitted to 50 of Sionna RT's spectra, on the reconstruction of `make lobby`, or on the true mesh where there
is none. Test receivers, which no fit has seen, are located: from their spectrum; from a horn's pointings at three elevations, of
unknown gain and zero of azimuth, with noise; from profiles of delay of three transmitters, under a clock of unknown zero, of
Sionna RT's paths with noise; from the powers of six transmitters, which the exact engine gives. Beside it stands
the place whose measurement is most alike: of Sionna's training receivers, or, for powers and profiles, of --prints that the exact
engine gives; for these also multilateration, as if all were in sight: by powers, or by first arrivals at the receiver's true
height, which three of them need. Then transmitters are chosen among 200 places under the
ceiling, by maps of single bounces in cells of a metre. Each receiver is kept as soon as it is found.

examples:
  python -m benchmarks locate
  python -m benchmarks locate --every 10 --field field.safetensors     a first look, with a field that was fitted before
"""
TRAIN = 50
PARTS = "spectrum", "horn", "profiles", "powers", "place"
HORN_DEG, NOISE_DB, CHAIN_DB, ZERO_DEG = 10.0, 1.0, -23.7, 143.0
PER_DEG = 1.0 / np.sqrt(
    8.0 * np.log(2.0)
)  # standard deviation of a Gaussian over its full width at half maximum
TURNS = 72  # zeros of azimuth that the nearest measurement is sought under
BANDWIDTH_HZ, TAPS, LATE_S = 2e9, 320, 137e-9
"""Of profiles: taps half as far apart as they are long, 24 m in all, by a clock that is late."""
PROFILE_SAMPLES = 200_000  # of Sionna RT's rays
SOUNDED_DB = 50.0  # range of profiles below the strongest tap of all transmitters
FIRST_DB = 15.0  # below the strongest tap of a transmitter is its first arrival at the least
MORE = (7.5, 1.5, 2.6), (7.5, 10.5, 2.6)
"""Transmitters [m] beside those of the data set and of the benchmark of measurements."""
NEAR = [0, 1, 2]  # transmitters that profiles are of
STORES = {"profiles": "maps-of-three.nc", "powers": "maps-of-six.nc"}
POWER_SHAPE = 30, 60  # of the spectra whose sums are powers
CEILING_M, PLACES, PER_METRE = 2.9, 200, {"cell": 1.0, "shape": (10, 20)}
"""Height and number of candidates, and options of their maps."""
OBJECTIVE = "worst tenth"
MAPPED = wr.Effects(
    mirrors=1, scatterings=1, mirror_scatter=False, scatter_mirror=False, transmissions=0, diffractions=0
)
COLUMNS = {
    "rows": (
        ("measured", "located from", "{}"), ("test", "receivers", "{}"), ("median_cm", "median [cm]", "{:.1f}"),
        ("p90_cm", "90th percentile [cm]", "{:.1f}"), ("blocked_median_cm", "blocked: median [cm]", "{:.1f}"),
        ("blocked_p90_cm", "blocked: 90th [cm]", "{:.1f}"), ("wrong", "beyond 30 cm", "{:.1%}"),
        ("wrong_told", "of these not known", "{:.0%}"), ("covered", "within 95 % ellipsoid", "{:.0%}"),
        ("cpu_s", "CPU seconds each", "{:.1f}"), ("nearest_cm", "nearest measurement [cm]", "{:.0f}"),
        ("lateration_cm", "multilateration [cm]", "{:.0f}"),
    ),
    "place": (
        ("objective", "objective", "{}"), ("candidates", "candidates", "{}"), ("n", "transmitters", "{}"),
        ("cpu_s", "core seconds", "{:.0f}"), ("chosen", "chosen", "{:.2f}"), ("added", "one added at a time", "{:.2f}"),
    ),
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
    parts: tuple[str, ...] = option(
        PARTS,
        "what is done",
        choices=PARTS,
    )
    prints: int = option(400, "places with whose powers those of six transmitters are compared")


def horn_readings(ds: wr.SpectrumDataset, turn: float = 0.0) -> np.ndarray:
    """Powers of the pointings at all receivers, turned by ``turn`` [rad], without noise, shape ``(R, N)``.

    The spectrum holds a beam already: a narrower horn over it is one of the stated width.
    """
    own = np.sqrt((HORN_DEG * PER_DEG) ** 2 - np.degrees(ds.beam_sigma_rad) ** 2) / PER_DEG
    toward = directions_from_angles(*(POINTINGS + [0.0, turn]).T)
    cosine = np.clip(toward @ pixel_directions(ds.shape).reshape(-1, 3).T, -1.0, 1.0)
    gain = wr.horn(np.radians(own)).gain_off_boresight(np.arccos(cosine))
    return np.asarray(ds.path_gain.reshape(len(ds), -1) @ gain.T)


def noise(count: int, seed: int, k: int) -> np.ndarray:
    """Factors by which readings of receiver ``k`` are wrong."""
    return np.asarray(10.0 ** (NOISE_DB / 10.0 * np.random.default_rng([seed, k]).normal(size=count)))


def horn_of(ds: wr.SpectrumDataset, k: int, seed: int) -> wr.Readings:
    """The same as a table of unknown gain and zero of azimuth."""
    gain, zero = 10.0 ** (CHAIN_DB / 10.0), np.radians(ZERO_DEG)
    power = gain * horn_readings(ds.subset([k]))[0]
    power *= noise(len(power), seed, k)
    floor = power.max() * 10.0 ** (-RANGE_DB / 10.0)
    return wr.Readings(
        ds.transmitter, ds.receivers[k], np.maximum(power, floor), ds.frequency_hz, floor, arrival=POINTINGS - [0.0, zero],
        receive_pattern=wr.horn(np.radians(HORN_DEG)), chain=["horn"] * len(power), std_db=NOISE_DB, azimuth_known=False,
    )  # fmt: skip


def nearest_spectrum(test: wr.SpectrumDataset, k: int, train: wr.SpectrumDataset) -> np.ndarray:
    """Place of the training receiver whose dB image is most alike [m]."""
    error = ((train.path_gain_db - test.path_gain_db[k]) ** 2).mean(axis=(1, 2))
    return np.asarray(train.receivers[int(error.argmin())])


def nearest_horn(one: wr.Readings, known: np.ndarray) -> int:
    """Which of the places with readings ``known`` (R, T, N) by turn has the most like those of ``one``, under any gain."""
    read, db = NEPER * np.log(one.power / one.power.max()), NEPER * np.log(known)
    db = np.maximum(db - db.max(axis=2, keepdims=True), -RANGE_DB)
    return int(np.abs(db - np.maximum(read, -RANGE_DB)).mean(axis=2).min(axis=1).argmin())


def multilaterated(one: wr.Readings, bounds: np.ndarray) -> np.ndarray:
    """Place within ``bounds`` (2, 3) from which transmitters of these powers would be as far as free space says [m]."""
    far_db = -NEPER * np.log(one.power) - 20.0 * np.log10(4.0 * np.pi * one.frequency_hz / SPEED_OF_LIGHT)

    def missed(at: np.ndarray) -> np.ndarray:
        return 20.0 * np.log10(np.linalg.norm(one.transmitters - at, axis=1)) - far_db

    low, high = bounds
    starts = low + (high - low) * np.array([(x, y, 0.3) for x in (0.2, 0.5, 0.8) for y in (0.2, 0.5, 0.8)])
    found = [least_squares(missed, start, bounds=(low, high)) for start in starts]
    return np.asarray(min(found, key=lambda one: one.cost).x)


def first_arrivals(one: wr.Readings) -> tuple[np.ndarray, np.ndarray]:
    """Transmitters (T, 3) of profiles and the length to each by its first tap, a clock's zero left in [m] (T,)."""
    sources, own = np.unique(one.transmitters, axis=0, return_inverse=True)
    strong = [one.power * (own.reshape(-1) == k) for k in range(len(sources))]
    first = [np.asarray(one.delay_s)[p > p.max() * 10.0 ** (-FIRST_DB / 10.0)].min() for p in strong]
    return sources, SPEED_OF_LIGHT * np.array(first)


def clocked(one: wr.Readings, bounds: np.ndarray, height_m: float) -> np.ndarray:
    """Place within ``bounds`` (2, 3) at a known height whose distances differ as first arrivals do [m]."""
    sources, length = first_arrivals(one)

    def missed(at: np.ndarray) -> np.ndarray:
        far = np.linalg.norm(sources - [*at, height_m], axis=1) - length
        return far - far.mean()

    low, high = bounds[:, :2]
    starts = low + (high - low) * np.array([(x, y) for x in (0.2, 0.5, 0.8) for y in (0.2, 0.5, 0.8)])
    found = [least_squares(missed, start, bounds=(low, high)) for start in starts]
    return np.array([*min(found, key=lambda one: one.cost).x, height_m])


def aligned(power: np.ndarray) -> np.ndarray:
    """Profiles (..., T, N) in decibels below the strongest tap, which comes first: whatever the clock's zero and the gain."""
    strongest = power.reshape(*power.shape[:-2], -1).argmax(axis=-1) % power.shape[-1]
    turn = (np.arange(power.shape[-1]) + strongest[..., None, None]) % power.shape[-1]
    db = NEPER * np.log(np.maximum(np.take_along_axis(power, turn, axis=-1), 1e-300))
    return np.asarray(np.maximum(db - db.max(axis=(-2, -1), keepdims=True), -SOUNDED_DB))


class Question:
    """What receivers are located from, and what stands beside.

    Args:
        options, fits: of the benchmark.
        test: the receivers.
        pool: training receivers of the same truth.
    """

    def __init__(
        self, options: Options, fits: Fits, test: wr.SpectrumDataset, pool: wr.SpectrumDataset
    ) -> None:
        self.options, self.test, self.pool, self.job = options, test, pool, fits.job
        self.scene = wr.Scene.load(options.xml)

    def asked(self, part: str, k: int) -> Any:
        """What receiver ``k`` read."""
        if part == "spectrum":
            return self.test.subset([k])
        if part == "horn":
            return horn_of(self.test, k, self.job.seed)
        if part == "profiles":
            return self.profiles(k)
        power, at = (
            self.powers["test"][k] * noise(len(self.sources), self.job.seed, k),
            self.test.receivers[k],
        )
        floor = float(self.test.floor)
        return wr.Readings(
            self.sources, at, np.maximum(power, floor), self.test.frequency_hz, floor, std_db=NOISE_DB
        )

    def beside(self, part: str, k: int, asked: Any) -> dict[str, float]:
        """How far off others are [m]."""
        true, more = self.test.receivers[k], {}
        if part == "spectrum":
            rival = nearest_spectrum(self.test, k, self.pool)
        elif part == "horn":
            rival = self.pool.receivers[nearest_horn(asked, self.turned)]
        elif part == "profiles":
            alike = np.abs(self.profile_prints - aligned(asked.power.reshape(len(NEAR), TAPS)))
            rival = self.print_places[int(alike.mean(axis=(1, 2)).argmin())]
            found = clocked(asked, self.scene.mesh.bounds, float(true[2]))
            more["lateration_m"] = float(np.linalg.norm(found - true))
        else:
            off = np.abs(np.log(self.powers["prints"]) - np.log(asked.power)).mean(axis=1)
            rival = self.print_places[int(off.argmin())]
            found = multilaterated(asked, self.scene.mesh.bounds)
            more["lateration_m"] = float(np.linalg.norm(found - true))
        return {"nearest_m": float(np.linalg.norm(rival - true)), **more}

    def profiles(self, k: int) -> wr.Readings:
        """Taps of three transmitters at test receiver ``k`` by Sionna RT's paths, with noise."""
        test, taps, power = self.test, np.arange(TAPS) / (2.0 * BANDWIDTH_HZ), []
        for source in self.sources[NEAR]:
            engine = SionnaEngine(
                self.scene, transmitter=source, frequency_hz=test.frequency_hz, shape=test.shape,
                sampling=Sampling(samples=PROFILE_SAMPLES, seed=self.job.seed),
            )  # fmt: skip
            paths = engine.solve(test.receivers[k])
            share = tap_share(BANDWIDTH_HZ * (taps[:, None] - paths.tau), "hann")
            power.append(share @ paths.power)
        read = np.concatenate(power) * noise(len(NEAR) * TAPS, self.job.seed, k)
        floor = 10.0 ** (-SOUNDED_DB / 10.0) * read.max()
        return wr.Readings(
            np.repeat(self.sources[NEAR], TAPS, axis=0), test.receivers[k], np.maximum(read, floor), test.frequency_hz, floor,
            delay_s=np.tile(taps + LATE_S, len(NEAR)), bandwidth_hz=BANDWIDTH_HZ, window="hann", std_db=NOISE_DB,
            clock_known=False,
        )  # fmt: skip

    @cached_property
    def profile_prints(self) -> np.ndarray:
        """Profiles of three transmitters at fingerprints by the exact engine, see :func:`aligned`, shape ``(R, 3, N)``."""
        taps, found = np.arange(TAPS) / (2.0 * BANDWIDTH_HZ), []
        for source in self.sources[NEAR]:
            ds = self.simulated(source, self.print_places, POWER_SHAPE)
            late = np.nan_to_num(ds.delay_s).reshape(len(ds), 1, -1)
            share = (tap_share(BANDWIDTH_HZ * (taps[:, None] - one), "hann") for one in late)
            every = zip(share, ds.path_gain.reshape(len(ds), -1), strict=True)
            found.append(np.stack([s @ gain for s, gain in every]))
        return aligned(np.stack(found, axis=1))

    @cached_property
    def sources(self) -> np.ndarray:
        """The six transmitters [m]."""
        return np.array([self.test.transmitter, *OTHERS.values(), *MORE])

    @cached_property
    def print_places(self) -> np.ndarray:
        """Where fingerprints are [m]."""
        told = json.loads((self.options.xml.parent / "receivers.json").read_text())
        places = np.array(told["receivers_m"])[np.array(told["role"]) == "train"]
        return np.asarray(places[: self.options.prints])

    @cached_property
    def turned(self) -> np.ndarray:
        """What a horn reads at training receivers, by turn, shape ``(R, T, N)``."""
        turns = 2.0 * np.pi / TURNS * np.arange(TURNS)
        return np.stack([horn_readings(self.pool, turn) for turn in turns], axis=1)

    @cached_property
    def powers(self) -> dict[str, np.ndarray]:
        """Powers of the six transmitters at test receivers and at fingerprints, shape ``(R, 6)`` each."""
        found = {}
        for name, places in (("test", self.test.receivers), ("prints", self.print_places)):
            spectra = [self.simulated(source, places, POWER_SHAPE).path_gain for source in self.sources]
            found[name] = np.stack([gain.sum(axis=(1, 2)) for gain in spectra], axis=1)
        return found

    def simulated(self, source: np.ndarray, places: np.ndarray, shape: tuple[int, int]) -> wr.SpectrumDataset:
        """The exact engine's spectra."""
        return wr.simulate(
            self.scene, transmitter=source, receivers=places, frequency_hz=self.test.frequency_hz, shape=shape,
            progress=self.job.progress,
        )  # fmt: skip


def placed(field: Any, job: Any) -> list[Row]:
    """One and two transmitters of the candidates under the ceiling, as :func:`warprrf.place` chooses them."""
    low, high = field.mesh.bounds[:, :2]
    axes = [np.linspace(a + 0.3, b - 0.3, 40) for a, b in zip(low, high, strict=True)]
    every = np.stack([*(a.ravel() for a in np.meshgrid(*axes)), np.full(1600, CEILING_M)], axis=1)
    free = every[is_free(field.mesh, every, field.transmitter, clearance_m=0.1)]
    candidates = free[np.linspace(0, len(free) - 1, PLACES).astype(int)]
    rough, maps, start = replace(field, effects=MAPPED), list[np.ndarray](), time.process_time()
    for k, source in enumerate(candidates):
        maps.append(rough.radio_map(1.5, transmitter=source, **PER_METRE).best_beam_snr_db)
        job.progress("place", k + 1, PLACES)
    snr_db, spent, rows = np.stack(maps), time.process_time() - start, list[Row]()
    cells = snr_db[:, ~np.isnan(snr_db).all(axis=0)]
    for n in (1, 2):
        start = time.process_time()
        chosen = best_set(snr_db, n, OBJECTIVE)
        whole, added = spent + time.process_time() - start, best_set(snr_db, n, OBJECTIVE, most=0)
        best, one = (OBJECTIVES[OBJECTIVE](cells[some].max(axis=0), 0.0) for some in (chosen, added))
        rows.append(
            {
                "objective": OBJECTIVE,
                "candidates": PLACES,
                "n": n,
                "cpu_s": whole,
                "chosen": best,
                "added": one,
            }
        )
    return rows


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
    question = Question(options, fits, test, pool)
    ask: dict[str, Any] = {"progress": fits.job.progress}
    for part in options.parts:
        if part == "place":
            for row in fits.row("place", lambda: {"rows": placed(field, fits.job)}, known or name)["rows"]:
                yield {"part": part, **row}
            continue
        ask["store"] = fits.job.out / STORES.get(part, "map.nc")
        field.locate(question.asked(part, 0), **ask)  # makes the map, which does not count
        found = []
        for k in range(len(test)):

            def make(k: int = k, part: str = part) -> Row:
                asked, true = question.asked(part, k), test.receivers[k]
                start = time.process_time()
                answer = field.locate(asked, **ask)
                spent, off = time.process_time() - start, answer.position - true
                return {
                    "error_m": float(np.linalg.norm(off)), "known": answer.known, "misfit": answer.misfit, "cpu_s": spent,
                    "squares": float(off @ np.linalg.pinv(answer.covariance) @ off), **question.beside(part, k, asked),
                    "blocked": not bool(test.line_of_sight[k]),
                }  # fmt: skip

            found.append(fits.row(f"{part} {options.every * k}", make, known or name, options.prints))
        prints = {"prints": len(question.print_places)} if part in STORES else {}
        yield {"measured": f"{part}, {name}", **prints, **summary(found)}


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
        **{
            f"{name}_cm": 100.0 * float(np.median([one[f"{name}_m"] for one in found]))
            for name in ("nearest", "lateration") if f"{name}_m" in found[0]
        },
        "receivers": found,
    }  # fmt: skip


ABOUT = "Lobby, Sionna RT's truth with three bounces, test receivers that no fit has seen, located in three dimensions."
BENCHMARKS = {"locate": experiment("locate", Options, rows, COLUMNS, ABOUT, HELP)}
