"""What a field learns from readings that are no whole spectra, from several transmitters, and at another carrier."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import Truth
from benchmarks.fits import FitOptions, Fits, experiment, fit_seconds, mean_row
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine
from warprrf.rf.spectra.readings import path_weights

HELP = """\
Readings of the lobby are made from the paths that Sionna RT finds at training receivers, never from a field of ours: a horn that
turns, horns at both ends, power alone, power-delay profiles, with an unknown gain of the chain; then with wrong readings, places
and directions, and a rotator whose zero is unknown. Spectra of three more transmitters and of another carrier are simulated.
Fields on the reconstruction of `make lobby` are scored at the test receivers. Each row is kept as soon as it is finished.

examples:
  python -m benchmarks measurements
  python -m benchmarks measurements --parts spectra horn power        one spectrum, a horn of 10 degrees, power alone
  python -m benchmarks measurements --every 4 --singles 2             a first look, in minutes
"""

SPECTRA, ERRORS, TRANSMITTERS, CARRIERS = "spectra", "errors", "transmitters", "carriers"
CHAIN_DB = {"horn": -23.7, "horns at both ends": -31.0, "power": 13.0}
"""Gains that the fits are to find."""
RANGE_DB = 30.0  # of a scan below its strongest reading
AZIMUTHS = np.radians(np.arange(-180, 180, 10.0))
POINTINGS = np.array(
    [(np.pi / 2 - np.radians(up), around) for up in (-30.0, 0.0, 30.0) for around in AZIMUTHS]
)
"""Zenith and azimuth of a scan [rad]."""
SENT = np.radians(np.arange(-180, 180, 20.0))
BANDWIDTH_HZ, TAPS = 2e9, 120
POWERS = 50
KINDS = {
    "horn": (10, len(POINTINGS)), "horns at both ends": (10, len(AZIMUTHS) * len(SENT)), "power": (POWERS, 1),
    "delay profile": (20, TAPS),
}  # fmt: skip
"""Receivers and readings at each, by kind."""
AT_ONCE = 20_000  # paths
ZERO_DEG = 143.0  # of a rotator whose zero is to be found
OTHERS = {"B": (1.2, 1.4, 2.6), "C": (13.8, 1.2, 2.4), "D": (2.0, 9.0, 2.5)}
"""Transmitters beside that of the data set [m]; nothing is fitted under the last."""
SHARE = 4  # spectra under each of three transmitters
OTHER_HZ = 140e9
FEWER = 5  # one test receiver in so many is simulated under another transmitter and at the other carrier
COLUMNS = {
    "rows": (
        ("readings", "fitted to", "{}"), ("test", "receivers", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
        ("direction_within_3deg_blocked", "blocked: within 3 degrees", "{:.0%}"),
        ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"), ("total_rms_db", "total power, rms [dB]", "{:.2f}"),
        ("total_rms_db_blocked", "blocked [dB]", "{:.2f}"), ("gain_error_db", "chain's gain off [dB]", "{:+.2f}"),
        ("zero_error_deg", "zero off [degrees]", "{:+.2f}"), ("named", "wrong ones named", "{}"),
        ("fit_s", "fit [s]", "{:.0f}"),
    )
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(FitOptions):
    """Options of the comparison.

    Attributes:
        singles: receivers whose spectrum alone is fitted to.
        parts: which rows: spectra, a kind of reading, a horn's errors, other transmitters, another carrier.
    """

    truths: tuple[str, ...] = ("sionna",)
    counts: tuple[int, ...] = (10,)
    singles: int = option(20, "receivers whose spectrum alone is fitted to")
    parts: tuple[str, ...] = option(
        (SPECTRA, *KINDS, ERRORS, TRANSMITTERS, CARRIERS), "which rows",
        choices=(SPECTRA, *KINDS, ERRORS, TRANSMITTERS, CARRIERS),
    )  # fmt: skip


def table_of(kind: str, ds: wr.SpectrumDataset, places: np.ndarray, power: np.ndarray) -> wr.Readings:
    """Readings of a kind, ``power`` (R, N) at ``places`` (R, 3), as a table."""
    count = power.shape[1]
    rows: dict[str, Any] = {
        "transmitters": ds.transmitter,
        "receivers": np.repeat(places, count, axis=0),
        "frequency_hz": ds.frequency_hz,
    }
    gain = 10.0 ** (CHAIN_DB.get(kind, 0.0) / 10.0)
    floor = np.broadcast_to(power.max(axis=1, keepdims=True) * 10.0 ** (-RANGE_DB / 10.0), power.shape) * gain
    rows |= {"floor": floor.ravel(), "power": np.maximum(power * gain, floor).ravel(), "name": kind}
    if kind in CHAIN_DB:
        rows["chain"] = [kind] * power.size
    if kind == "horn":
        rows |= {
            "arrival": np.tile(POINTINGS, (len(power), 1)),
            "receive_pattern": wr.horn(np.radians(10.0)),
        }
    elif kind == "horns at both ends":
        level, wide = np.full(count, np.pi / 2), wr.horn(np.radians(20.0))
        both = np.meshgrid(AZIMUTHS, SENT, indexing="ij")
        ends = (np.tile(np.column_stack([level, angle.ravel()]), (len(power), 1)) for angle in both)
        rows |= dict(zip(("arrival", "departure"), ends, strict=True))
        rows |= {"receive_pattern": wide, "transmit_pattern": wide}
    elif kind == "delay profile":
        delay = np.tile(np.arange(TAPS) / BANDWIDTH_HZ, len(power))
        rows |= {"delay_s": delay, "bandwidth_hz": BANDWIDTH_HZ, "window": "hann"}
    return wr.Readings(**rows)


def spoilt(readings: wr.Readings, seed: int) -> Iterator[tuple[str, wr.Readings, np.ndarray]]:
    """A horn's readings with errors of each kind, and which are wrong by ten decibels and more at the instrument."""
    rng, none = np.random.default_rng(seed), np.zeros(0, int)
    floor = np.asarray(readings.floor)
    chosen, sign = rng.random(len(readings)) < 0.1, rng.choice([-1.0, 1.0], len(readings))
    power = np.maximum(np.where(chosen, readings.power * 100.0**sign, readings.power), floor)
    wrong = np.flatnonzero(np.abs(np.log10(power / readings.power)) > 1.0)
    yield "horn, 10 % wrong by 20 dB", replace(readings, power=power), wrong
    places, own = np.unique(readings.receivers, axis=0, return_inverse=True)
    own = own.reshape(-1)
    moved = readings.receivers + (0.05 / np.sqrt(3.0) * rng.normal(size=places.shape))[own]
    yield "horn, places off by 5 cm rms", replace(readings, receivers=moved), none
    if readings.arrival is not None:
        turn = np.radians(3.0) * rng.normal(size=len(places))[own]
        turned = readings.arrival + np.stack([0 * turn, turn], 1)
        yield "horn, yaw off by 3 degrees rms", replace(readings, arrival=turned), none
        turned = readings.arrival - [0.0, np.radians(ZERO_DEG)]
        yield "horn, zero of azimuth unknown", replace(readings, arrival=turned, azimuth_known=False), none


class Room:
    """The room and what was measured in it.

    Attributes:
        fits: makes rows.
        geometry: the reconstruction.
        scene: the true scene, which Sionna RT solves.
        train, test: spectra of Sionna RT.
    """

    def __init__(self, options: Options, fits: Fits) -> None:
        place = options.place(fits.job.device)
        self.fits, self.geometry, self.scene = fits, place.reconstruction, place.scene
        truth: Truth = options.load()[0]
        self.ds, self.train, self.test = truth.data, truth.data.split(POWERS)[0], truth.test
        self.sampling: dict[str, Any] = {name: int(self.ds.attributes[name]) for name in ("depth", "samples")}

    def row(self, name: str, data: Any, test: wr.SpectrumDataset | None = None) -> Row:
        """The row of a fit to ``data``."""
        return {"readings": name, **self.fits.row(name, partial(self._scored, data, test or self.test))}

    def _scored(self, data: Any, test: wr.SpectrumDataset) -> Row:
        field = self.fits.fit(self.geometry, data)
        spectra = replace(field, shape=test.shape, beam_sigma_rad=test.beam_sigma_rad)
        spent, found = field.report, self.fits.score(spectra, test)
        found["fit_s"] = fit_seconds(field)
        for chain, gain in spent.get("chains", {}).items():
            found["gain_error_db"] = gain["gain_db"] - CHAIN_DB[chain]
        for turn in spent.get("azimuth_zero_deg", {}).values():
            found["zero_error_deg"] = turn - ZERO_DEG
        return {**found, "unexplained": spent.get("unexplained", {})}

    def readings(self, kind: str) -> wr.Readings:
        """A table of a kind at its receivers, from Sionna RT's paths; kept."""
        receivers, count = KINDS[kind]
        places = self.train.receivers[:receivers]
        make = partial(self._measured, kind, places, count)
        inputs = [self.fits.key, kind]
        power = self.fits.steps.arrays(f"readings-{kind.replace(' ', '-')}", make, version=1, inputs=inputs)[
            "power"
        ]
        return table_of(kind, self.ds, places, power)

    def _measured(self, kind: str, places: np.ndarray, count: int) -> dict[str, np.ndarray]:
        ds, found = self.ds, np.zeros((len(places), count))
        engine = SionnaEngine(
            self.scene, transmitter=ds.transmitter, frequency_hz=ds.frequency_hz, shape=ds.shape,
            sampling=Sampling(**self.sampling, seed=7),
        )  # fmt: skip
        for k, place in enumerate(places):
            self.fits.job.progress("paths", k, len(places))
            paths = engine.solve(place)
            departure = paths.departure
            like = table_of(kind, ds, place[None], np.ones((1, count)))
            for first in range(0, len(departure), AT_ONCE):
                part = slice(first, first + AT_ONCE)
                arrive = paths.arrival[part], departure[part], paths.tau[part]
                found[k] += path_weights(like, np.arange(count), *arrive) @ paths.power[part]
        return {"power": found}

    def simulated(self, name: str, receivers: np.ndarray, **changed: Any) -> wr.SpectrumDataset:
        """Sionna RT's spectra of ``receivers`` under another transmitter or at another carrier; kept."""
        ds, steps = self.ds, self.fits.steps
        file = steps.folder / f"{name}.nc"
        link: dict[str, Any] = {"transmitter": ds.transmitter, "frequency_hz": ds.frequency_hz, **changed}

        def make(attempt: Any) -> Row:
            wr.simulate(
                self.scene, **link, receivers=receivers, shape=ds.shape, engine="sionna", **self.sampling,
                beam_sigma_rad=ds.beam_sigma_rad, refraction=False, seed=7, progress=attempt.progress,
            ).save(file)  # fmt: skip
            return {}

        inputs = [self.fits.key, receivers, [*link["transmitter"]], link["frequency_hz"]]
        steps.run(name, make, version=1, inputs=inputs, outputs=[file.name])
        return wr.SpectrumDataset.load(file)


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """The parts that were asked for, in order."""
    room = Room(options, fits)
    if SPECTRA in options.parts:
        yield room.row("nothing", room.train.subset([]))
        each = [room.row(f"1 spectrum, receiver {k}", room.train.subset([k])) for k in range(options.singles)]
        yield {"readings": f"1 spectrum, mean of {options.singles}", "test": len(room.test), **mean_row(each)}
        yield room.row("10 spectra", room.train.subset(range(10)))
    for kind in KINDS:
        if kind in options.parts:
            yield room.row(kind, room.readings(kind))
    if ERRORS in options.parts:
        for name, table, wrong in spoilt(room.readings("horn"), fits.job.seed):
            row = room.row(name, table)
            if len(wrong):
                named = np.array(row["unexplained"].get("horn", []), int)
                others = int((~np.isin(named, wrong)).sum())
                row["named"] = f"{int(np.isin(wrong, named).sum())} of {len(wrong)}, {others} others"
            yield row
    if TRANSMITTERS in options.parts:
        yield from _transmitters(room)
    if CARRIERS in options.parts:
        yield from _carriers(room)


def _transmitters(room: Room) -> Iterator[Row]:
    """Twelve spectra of one transmitter or of three, asked under a fourth."""
    count = 3 * SHARE
    own = room.train.subset(range(count))
    sets = {"A": own}
    sets |= {n: room.simulated(f"transmitter-{n}", own.receivers, transmitter=OTHERS[n]) for n in "BC"}
    test = room.simulated("transmitter-D", room.test.receivers[::FEWER], transmitter=OTHERS["D"])
    for name, one in sets.items():
        yield room.row(f"{count} spectra of transmitter {name}, asked under D", one, test)
    some = [one.subset(range(k * SHARE, (k + 1) * SHARE)) for k, one in enumerate(sets.values())]
    yield room.row(f"{SHARE} of each of A, B, C, asked under D", some, test)


def _carriers(room: Room) -> Iterator[Row]:
    """Ten spectra at one carrier, or five at each of both, asked at both."""
    train, test = room.train.subset(range(10)), room.test.subset(range(0, len(room.test), FEWER))
    both = room.simulated("carrier", np.concatenate([train.receivers, test.receivers]), frequency_hz=OTHER_HZ)
    tests = {room.ds.frequency_hz: test, OTHER_HZ: both.subset(range(10, len(both)))}
    sets = {room.ds.frequency_hz: train, OTHER_HZ: both.subset(range(10))}
    fitted: dict[str, Any] = {f"10 spectra at {hz / 1e9:g} GHz": one for hz, one in sets.items()}
    fitted["5 spectra at each of both carriers"] = [
        one.subset(range(5 * k, 5 * k + 5)) for k, one in enumerate(sets.values())
    ]
    for name, data in fitted.items():

        def make(data: Any = data) -> Row:
            field = room.fits.fit(room.geometry, data)
            return {str(hz): room.fits.score(field.at_frequency(hz), one) for hz, one in tests.items()}

        found = room.fits.row(name, make)
        for hz in tests:
            yield {"readings": f"{name}, asked at {hz / 1e9:g} GHz", **found[str(hz)]}


ABOUT = "Lobby from photos, Sionna RT's truth with three bounces, test receivers that no field has seen."
BENCHMARKS = {"measurements": experiment("measurements", Options, rows, COLUMNS, ABOUT, HELP)}
