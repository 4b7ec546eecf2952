"""What a field learns from readings that are no whole spectra: horns, power alone, delay profiles, one spectrum."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA, Truth
from benchmarks.machine import machine
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf import tensor_files
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine
from warprrf.rf.spectra.readings import path_weights
from warprrf.rf.spectra.spectrum import directions_from_angles
from warprrf.steps import Attempt, Steps

HELP = """\
Readings of the lobby are made from the paths that Sionna RT finds at training receivers, never from a field of ours: a horn that
turns, horns at both ends, power alone, power-delay profiles, with an unknown gain of the chain; then with wrong readings, places
and directions. Fields on the reconstruction of `make lobby` are scored at the test receivers.

examples:
  python -m benchmarks measurements
  python -m benchmarks measurements --every 4 --singles 2     a first look, in minutes
"""

KIND = "readings from Sionna RT's paths 1"
CHAIN_DB = {"horn": -23.7, "horns at both ends": -31.0, "power": 13.0}
"""Gains that the fits are to find."""
RANGE_DB = 30.0  # of a scan below its strongest reading
AZIMUTHS = np.radians(np.arange(-180, 180, 10.0))
ELEVATIONS = np.radians([-30.0, 0.0, 30.0])
SENT = np.radians(np.arange(-180, 180, 20.0))
BANDWIDTH_HZ, TAPS = 2e9, 120
SCANS, PROFILES, POWERS = 10, 20, 50  # receivers of each kind
AT_ONCE = 20_000  # paths
COLUMNS = (
    ("readings", "fitted to", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("direction_within_3deg_blocked", "blocked: within 3 degrees", "{:.0%}"),
    ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"), ("total_rms_db", "total power, rms [dB]", "{:.2f}"),
    ("total_rms_db_blocked", "blocked [dB]", "{:.2f}"), ("gain_error_db", "chain's gain off [dB]", "{:+.2f}"),
    ("named", "wrong ones named", "{}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        reconstruction: folder of the geometry.
        scene: true scene (XML).
        spectra: Sionna RT's spectra (NetCDF).
        every: each how-manieth test receiver counts.
        singles: receivers whose spectrum alone is fitted to.
    """

    reconstruction: str = option("runs/lobby/reconstruction", "folder of the geometry")
    scene: str = option(str(Path(DATA) / "scene.xml"), "true scene (XML)")
    spectra: str = option(str(Path(DATA) / "spectra_sionna.nc"), "Sionna RT's spectra (NetCDF)")
    every: int = option(1, "each how-manieth test receiver counts")
    singles: int = option(20, "receivers whose spectrum alone is fitted to")


def pointings() -> np.ndarray:
    """Zenith and azimuth of a scan, shape ``(108, 2)`` [rad]."""
    return np.array([(np.pi / 2 - up, around) for up in ELEVATIONS for around in AZIMUTHS])


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
            "arrival": np.tile(pointings(), (len(power), 1)),
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


KINDS = {
    "horn": (SCANS, 108), "horns at both ends": (SCANS, len(AZIMUTHS) * len(SENT)), "power": (POWERS, 1),
    "delay profile": (PROFILES, TAPS),
}  # fmt: skip
"""Receivers and readings at each, by kind."""


def measured(options: Options, ds: wr.SpectrumDataset, attempt: Attempt) -> dict[str, np.ndarray]:
    """Powers of every kind at the training receivers, shape ``(R, N)`` each, from Sionna RT's paths."""
    depth, samples = int(ds.attributes["depth"]), int(ds.attributes["samples"])
    engine = SionnaEngine(
        wr.Scene.load(options.scene), transmitter=ds.transmitter, frequency_hz=ds.frequency_hz, shape=ds.shape,
        sampling=Sampling(depth, samples, seed=7),
    )  # fmt: skip
    places = ds.split(POWERS)[0].receivers
    found: dict[str, list[np.ndarray]] = {kind: [] for kind in KINDS}
    for k, place in enumerate(places):
        attempt.progress("paths", k, len(places))
        paths = engine.solve(place)
        sent = directions_from_angles(*paths["aod"].T)
        for kind, (receivers, count) in KINDS.items():
            if k >= receivers:
                continue
            like = table_of(kind, ds, place[None], np.ones((1, count)))
            total = np.zeros(count)
            for first in range(0, len(sent), AT_ONCE):
                part = slice(first, first + AT_ONCE)
                weight = path_weights(
                    like, np.arange(count), paths["arrival"][part], sent[part], paths["tau"][part]
                )
                total += weight @ paths["power"][part]
            found[kind].append(total)
    attempt.progress("paths", len(places), len(places))
    return {kind: np.stack(rows) for kind, rows in found.items()}


def spoilt(readings: wr.Readings, seed: int) -> Iterator[tuple[str, wr.Readings, np.ndarray]]:
    """A horn's readings with errors of each sort, and which are wrong by ten decibels and more at the instrument."""
    rng, none = np.random.default_rng(seed), np.zeros(0, int)
    floor = np.asarray(readings.floor)
    chosen, sign = rng.random(len(readings)) < 0.1, rng.choice([-1.0, 1.0], len(readings))
    power = np.maximum(np.where(chosen, readings.power * 100.0**sign, readings.power), floor)
    wrong = np.flatnonzero(np.abs(np.log10(power / readings.power)) > 1.0)
    yield "horn, 10 % wrong by 20 dB", replace(readings, power=power), wrong
    places, own = np.unique(readings.receivers, axis=0, return_inverse=True)
    moved = readings.receivers + (0.05 / np.sqrt(3.0) * rng.normal(size=places.shape))[own.reshape(-1)]
    yield "horn, places off by 5 cm rms", replace(readings, receivers=moved), none
    if readings.arrival is not None:
        turn = np.radians(3.0) * rng.normal(size=len(places))[own.reshape(-1)]
        yield (
            "horn, yaw off by 3 degrees rms",
            replace(readings, arrival=readings.arrival + np.stack([0 * turn, turn], 1)),
            none,
        )


def scored(field: wr.RadioField, test: wr.SpectrumDataset, job: Job) -> dict[str, Any]:
    """Figures of a field at the test receivers."""
    found = wr.evaluate(test, field.spectrum, progress=job.progress)
    figures = {key: found[key] for key in ("psnr_db", "direction_within_3deg_blocked", "beam_gain_loss_db")}
    total = np.array([field.spectrum(place).total_path_gain for place in test.receivers])
    error = 10.0 * np.log10(total / test.path_gain.sum(axis=(1, 2), dtype=np.float64))
    blocked = ~np.asarray(test.line_of_sight)
    figures |= {"total_rms_db": float(np.sqrt(np.mean(error**2)))}
    return figures | {
        "total_rms_db_blocked": float(np.sqrt(np.mean(error[blocked] ** 2))) if blocked.any() else None
    }


def run(options: Options, job: Job) -> Report:
    """Read, fit and score.

    Raises:
        FileNotFoundError, ValueError: as the reconstruction, the scene and the spectra do.
    """
    room = wr.Reconstruction.load(options.reconstruction)
    truth = Truth.load(Path(options.spectra), (10,), options.every)
    ds, test = truth.data, truth.test

    def readings(attempt: Attempt) -> dict[str, Any]:
        tensor_files.write(job.out / "readings.safetensors", measured(options, ds, attempt), {}, KIND)
        return {}

    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        inputs = [truth.key, Path(options.scene).read_text()]
        steps.run("readings", readings, version=1, inputs=inputs, outputs=["readings.safetensors"])
    power = tensor_files.read(job.out / "readings.safetensors", KIND)[0]
    places = ds.split(POWERS)[0].receivers
    tables = {kind: table_of(kind, ds, places[: len(power[kind])], power[kind]) for kind in KINDS}

    rows = [_single(room, ds, test, options.singles, job)]

    def add(name: str, data: Any, wrong: np.ndarray | None = None) -> None:
        field = wr.RadioField.fit(room, data, device=job.device, progress=job.progress)
        row: dict[str, Any] = {"readings": name, "gain_error_db": None, "named": ""} | scored(
            field, test, job
        )
        for chain, gain in field.report["chains"].items():
            row["gain_error_db"] = gain["gain_db"] - CHAIN_DB[chain]
        rows.append(row | (_named(field, wrong) if wrong is not None and len(wrong) else {}))

    add("10 spectra", truth.train(10))
    for kind, table in tables.items():
        add(kind, table)
    for name, table, wrong in spoilt(tables["horn"], job.seed):
        add(name, table, wrong)
    head = "Lobby from photos, Sionna RT's truth with three bounces, test receivers that no field has seen."
    figures = {"machine": machine(job.device), "test": len(test), "rows": rows}
    return Report("measurements", figures, f"{head}\n\n{columns_table(COLUMNS, rows)}")


def _single(
    room: wr.Reconstruction, ds: wr.SpectrumDataset, test: wr.SpectrumDataset, count: int, job: Job
) -> dict[str, Any]:
    """The mean over fields of one spectrum each."""
    train = ds.split(POWERS)[0]
    each = []
    for k in range(count):
        job.progress("one spectrum", k, count)
        field = wr.RadioField.fit(room, train.subset([k]), device=job.device)
        each.append(scored(field, test, job))
    mean = {name: float(np.mean([one[name] for one in each])) for name in each[0]}
    return {"readings": f"1 spectrum, mean of {count}", "gain_error_db": None, "named": "", **mean}


def _named(field: wr.RadioField, wrong: np.ndarray) -> dict[str, Any]:
    """How many of the wrong readings the report names, and how many others."""
    named = np.array(field.report["unexplained"].get("horn", []), int)
    return {
        "named": f"{int(np.isin(wrong, named).sum())} of {len(wrong)}, {int((~np.isin(named, wrong)).sum())} others"
    }


BENCHMARKS = {"measurements": Benchmark("measurements", Options, run, HELP)}
