"""What a field learns from readings that are no whole spectra, and from several transmitters, and at another carrier."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA, Truth
from benchmarks.machine import machine
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf import tensor_files
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine
from warprrf.rf.spectra.readings import path_weights
from warprrf.rf.spectra.spectrum import directions_from_angles
from warprrf.steps import Attempt, Steps, digest

HELP = """\
Readings of the lobby are made from the paths that Sionna RT finds at training receivers, never from a field of ours: a horn that
turns, horns at both ends, power alone, power-delay profiles, with an unknown gain of the chain; then with wrong readings, places
and directions, and a rotator whose zero is unknown. Spectra of three more transmitters and of another carrier are simulated.
Fields on the reconstruction of `make lobby` are scored at the test receivers. Each row is kept as soon as it is finished.

examples:
  python -m benchmarks measurements
  python -m benchmarks measurements --every 4 --singles 2     a first look, in minutes
"""

VERSION = 1
"""Counted up by hand when a row computes something else."""
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
ZERO_DEG = 143.0  # of a rotator whose zero is to be found
OTHERS = {"B": (1.2, 1.4, 2.6), "C": (13.8, 1.2, 2.4), "D": (2.0, 9.0, 2.5)}
"""Transmitters beside that of the data set [m]; nothing is fitted under the last."""
SHARE = 4  # spectra under each of three transmitters
OTHER_HZ = 140e9
FEWER = (
    5  # each how-manieth of the test receivers is simulated under other transmitters and at the other carrier
)
COLUMNS = (
    ("readings", "fitted to", "{}"), ("test", "receivers", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("direction_within_3deg_blocked", "blocked: within 3 degrees", "{:.0%}"),
    ("beam_gain_loss_db", "beam loss [dB]", "{:.2f}"), ("total_rms_db", "total power, rms [dB]", "{:.2f}"),
    ("total_rms_db_blocked", "blocked [dB]", "{:.2f}"), ("gain_error_db", "chain's gain off [dB]", "{:+.2f}"),
    ("zero_error_deg", "zero off [degrees]", "{:+.2f}"), ("named", "wrong ones named", "{}"),
    ("fit_s", "fit [s]", "{:.0f}"),
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
    own = own.reshape(-1)
    moved = readings.receivers + (0.05 / np.sqrt(3.0) * rng.normal(size=places.shape))[own]
    yield "horn, places off by 5 cm rms", replace(readings, receivers=moved), none
    searched = replace(readings, receivers=moved, position_std_m=0.05 / np.sqrt(3.0))
    yield "horn, places off by 5 cm rms and searched", searched, none
    if readings.arrival is not None:
        turn = np.radians(3.0) * rng.normal(size=len(places))[own]
        turned = readings.arrival + np.stack([0 * turn, turn], 1)
        yield "horn, yaw off by 3 degrees rms", replace(readings, arrival=turned), none
        turned = readings.arrival - [0.0, np.radians(ZERO_DEG)]
        yield "horn, zero of azimuth unknown", replace(readings, arrival=turned, azimuth_known=False), none


class Lobby:
    """The room, what was measured in it, and how fields of it are scored.

    Attributes:
        options, job: what was asked.
        surface: of the reconstruction; one for all fits, which share what they trace.
        ds, test: spectra of Sionna RT.
        steps: where finished rows are kept.
    """

    def __init__(self, options: Options, job: Job, steps: Steps) -> None:
        self.options, self.job, self.steps = options, job, steps
        self.truth = Truth.load(Path(options.spectra), (10,), options.every)
        self.ds, self.test = self.truth.data, self.truth.test
        self.train = self.ds.split(POWERS)[0]
        scene = Path(options.scene)
        self.key = digest(self.truth.key, Path(options.reconstruction), scene.read_text(), options.every)
        self._seen: dict[Any, Any] = {}

    @cached_property
    def surface(self) -> Surface:
        """Patches and groups of the reconstruction."""
        return Surface.of(wr.Reconstruction.load(self.options.reconstruction))

    @cached_property
    def tables(self) -> dict[str, wr.Readings]:
        """Readings of every kind."""

        def make(attempt: Attempt) -> dict[str, Any]:
            tensor_files.write(self._file, measured(self.options, self.ds, attempt), {}, KIND)
            return {}

        inputs = [self.truth.key, Path(self.options.scene).read_text()]
        self.steps.run("readings", make, version=1, inputs=inputs, outputs=[self._file.name])
        power = tensor_files.read(self._file, KIND)[0]
        places = self.train.receivers
        return {kind: table_of(kind, self.ds, places[: len(power[kind])], power[kind]) for kind in KINDS}

    @property
    def _file(self) -> Path:
        return self.job.out / "readings.safetensors"

    def simulated(self, name: str, receivers: np.ndarray, **ends: Any) -> wr.SpectrumDataset:
        """Sionna RT's spectra of ``receivers`` under another transmitter or at another carrier; kept."""
        file = self.job.out / f"{name}.nc"
        setting: dict[str, Any] = {
            "transmitter": self.ds.transmitter,
            "frequency_hz": self.ds.frequency_hz,
        } | ends

        def make(attempt: Attempt) -> dict[str, Any]:
            wr.simulate(
                wr.Scene.load(self.options.scene), **setting, receivers=receivers, shape=self.ds.shape, engine="sionna",
                depth=int(self.ds.attributes["depth"]), samples=int(self.ds.attributes["samples"]),
                beam_sigma_rad=self.ds.beam_sigma_rad, refraction=False, seed=7, progress=attempt.progress,
            ).save(file)  # fmt: skip
            return {}

        inputs = [self.key, receivers, list(setting["transmitter"]), float(setting["frequency_hz"])]
        self.steps.run(name, make, version=1, inputs=inputs, outputs=[file.name])
        return wr.SpectrumDataset.load(file)

    def fit(self, data: Any, **settings: Any) -> BistaticField:
        """A field on ``data``."""
        return BistaticField.fit(
            self.surface, data, device=self.job.device, progress=self.job.progress, **settings
        )

    def scored(self, field: BistaticField, test: wr.SpectrumDataset) -> dict[str, Any]:
        """Figures of a field at the receivers of ``test``; what those see is traced once for all fields."""
        total = []

        def predict(rx: np.ndarray) -> np.ndarray:
            transport = field.transport(test.transmitter)
            kind = field.frequency_hz, field.terms.sub_pixels, field.terms.mirror_order
            key = *kind, test.transmitter.tobytes(), rx.tobytes()
            if key not in self._seen:
                self._seen[key] = transport.view(rx, field.terms)
            seen = self._seen[key] = transport.complete(self._seen[key], field.terms)
            found = field.render(seen).image
            total.append(float(found.sum()))
            return np.asarray(found, np.float32)

        field = replace(field, shape=test.shape, beam_sigma_rad=test.beam_sigma_rad)
        found = wr.evaluate(test, predict, progress=self.job.progress)
        figures = {
            key: found[key] for key in ("psnr_db", "direction_within_3deg_blocked", "beam_gain_loss_db")
        }
        error = 10.0 * np.log10(np.array(total) / test.path_gain.sum(axis=(1, 2), dtype=np.float64))
        blocked = ~np.asarray(test.line_of_sight)
        figures |= {"test": len(test), "total_rms_db": _rms(error)}
        return figures | {"total_rms_db_blocked": _rms(error[blocked]) if blocked.any() else None}

    def row(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """A row of the table, kept when finished."""

        def step(attempt: Attempt) -> dict[str, Any]:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                return {"readings": name} | make()

        inputs = [self.key, self.options.singles, self.job.seed]
        file = "".join(c if c.isalnum() else "-" for c in name)
        return self.steps.run(f"row-{file}", step, version=VERSION, inputs=inputs)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def run(options: Options, job: Job) -> Report:
    """Read, fit and score.

    Raises:
        FileNotFoundError, ValueError: as the reconstruction, the scene and the spectra do.
    """
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        lobby = Lobby(options, job, steps)
        rows = [*_spectra(lobby), *_readings(lobby), *_transmitters(lobby), *_carriers(lobby)]
    head = "Lobby from photos, Sionna RT's truth with three bounces, test receivers that no field has seen."
    figures = {"machine": machine(job.device), "test": len(lobby.test), "rows": rows}
    return Report("measurements", figures, f"{head}\n\n{columns_table(COLUMNS, rows)}")


def _spectra(lobby: Lobby) -> Iterator[dict[str, Any]]:
    """No spectrum, one, and ten."""
    test, count = lobby.test, lobby.options.singles
    yield lobby.row("nothing", lambda: lobby.scored(BistaticField.prior(lobby.surface, lobby.ds), test))
    for name, settings in (("1 spectrum", {}), ("1 spectrum, quick", {"quick": True})):
        each = [
            lobby.row(f"{name}, receiver {k}", lambda k=k, settings=settings: _one(lobby, k, settings))  # type: ignore[misc]
            for k in range(count)
        ]
        names = [key for key, value in each[0].items() if isinstance(value, float)]
        mean = {key: float(np.mean([one[key] for one in each])) for key in names}
        worst = {"lowest_psnr_db": min(one["psnr_db"] for one in each)}
        yield {"readings": f"{name}, mean of {count}", "test": len(test), **mean, **worst}
    yield lobby.row("10 spectra", lambda: _scored_fit(lobby, lobby.train.subset(range(10)), test))


def _one(lobby: Lobby, k: int, settings: dict[str, Any]) -> dict[str, Any]:
    return _scored_fit(lobby, lobby.train.subset([k]), lobby.test, **settings)


def _scored_fit(lobby: Lobby, data: Any, test: wr.SpectrumDataset, **settings: Any) -> dict[str, Any]:
    """Figures of a fit to ``data``, and how long that took."""
    field = lobby.fit(data, **settings)
    found = lobby.scored(field, test)
    found["fit_s"] = field.report["fit_time_s"] + field.report["transport_time_s"]
    for chain, gain in field.report["chains"].items():
        found["gain_error_db"] = gain["gain_db"] - CHAIN_DB[chain]
    for turn in field.report["azimuth_zero_deg"].values():
        found["zero_error_deg"] = turn - ZERO_DEG
    found["unexplained"] = field.report["unexplained"]
    return found


def _readings(lobby: Lobby) -> Iterator[dict[str, Any]]:
    """Each kind of table, then a horn's with errors."""
    for kind in KINDS:
        yield lobby.row(kind, lambda kind=kind: _scored_fit(lobby, lobby.tables[kind], lobby.test))  # type: ignore[misc]
    for name, table, wrong in spoilt(lobby.tables["horn"], lobby.job.seed):
        row = lobby.row(name, lambda table=table: _scored_fit(lobby, table, lobby.test))  # type: ignore[misc]
        if len(wrong):
            named = np.array(row["unexplained"].get("horn", []), int)
            others = int((~np.isin(named, wrong)).sum())
            row["named"] = f"{int(np.isin(wrong, named).sum())} of {len(wrong)}, {others} others"
        yield row


def _transmitters(lobby: Lobby) -> Iterator[dict[str, Any]]:
    """Twelve spectra of one transmitter or of three, asked under a fourth."""
    count = 3 * SHARE
    sets = {"A": lobby.train.subset(range(count))}
    for name in "BC":
        sets[name] = lobby.simulated(
            f"transmitter-{name}", lobby.train.receivers[:count], transmitter=OTHERS[name]
        )
    asked = lobby.test.receivers[::FEWER]
    test = lobby.simulated("transmitter-D", asked, transmitter=OTHERS["D"])
    for name, one in sets.items():
        row = f"{count} spectra of transmitter {name}, asked under D"
        yield lobby.row(row, lambda one=one: _scored_fit(lobby, one, test))  # type: ignore[misc]
    for turn in range(len(sets)):  # which places stand under which transmitter
        order = [*sets.values()][turn:] + [*sets.values()][:turn]
        some = [one.subset(range(k * SHARE, (k + 1) * SHARE)) for k, one in enumerate(order)]
        row = f"{SHARE} of each of A, B, C, asked under D, turn {turn + 1}"
        yield lobby.row(row, lambda some=some: _scored_fit(lobby, some, test))  # type: ignore[misc]


def _carriers(lobby: Lobby) -> Iterator[dict[str, Any]]:
    """Ten spectra at one carrier, asked at the other, and ten there."""
    own = {
        lobby.ds.frequency_hz: (
            lobby.train.subset(range(10)),
            lobby.test.subset(range(0, len(lobby.test), FEWER)),
        )
    }
    places = np.concatenate([one.receivers for one in own[lobby.ds.frequency_hz]])
    both = lobby.simulated("carrier", places, frequency_hz=OTHER_HZ)
    own[OTHER_HZ] = both.subset(range(10)), both.subset(range(10, len(places)))
    fields: dict[float, BistaticField] = {}

    def asked(at: float, of: float) -> dict[str, Any]:
        if of not in fields:
            fields[of] = lobby.fit(own[of][0])
        return lobby.scored(fields[of].at_frequency(at), own[at][1])

    for of in own:
        for at in own:
            name = f"10 spectra at {of / 1e9:g} GHz, asked at {at / 1e9:g} GHz"
            yield lobby.row(name, lambda at=at, of=of: asked(at, of))  # type: ignore[misc]
    halves = [train.subset(range(5 * k, 5 * k + 5)) for k, (train, _) in enumerate(own.values())]
    together = cache(lambda: lobby.fit(halves))
    for at in own:
        name = f"5 spectra at each of both carriers, asked at {at / 1e9:g} GHz"
        yield lobby.row(name, lambda at=at: lobby.scored(together().at_frequency(at), own[at][1]))  # type: ignore[misc]


BENCHMARKS = {"measurements": Benchmark("measurements", Options, run, HELP)}
