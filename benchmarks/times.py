"""What each verb takes: wall clock, core seconds and the largest resident memory, each in a process of its own.

The room is the lobby's true mesh or a reconstruction of it; cities are Sionna RT's, at 3.5 GHz, with an assumed scattering
coefficient. Memory is the process's, with Python, the packages and what the call needs ready. To compare two versions, run
both in turns on one quiet machine.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA
from benchmarks.lobby.spectra import FILES, FREQUENCY_HZ, TRANSMITTER
from benchmarks.machine import machine, peak_memory
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.rf.scene_sionna import sionna_rt

HELP = """\
Every verb of the library in a process of its own: seconds of the first call and, where it is called twice, of the second, core
seconds, peak memory. Places: lobby, or Sionna RT's cities munich and san_francisco, which need the extra sionna.

examples:
  python -m benchmarks times
  python -m benchmarks times --geometry runs/lobby/reconstruction      on the room from photos
  python -m benchmarks times --verbs fit-few fit-many spectrum spectra map
  python -m benchmarks times --verbs simulate-large fit-large          seven hundred spectra: memory and time
  python -m benchmarks times --place munich --verbs load spectrum
"""
CITIES = {"munich": (8.5, 21.0, 27.0), "san_francisco": (0.0, 0.0, 45.0)}
"""Transmitters [m]."""
CITY_HZ, SCATTERING = 3.5e9, 0.4
FEW, MANY, HUNDREDS, MOST = 10, 50, 700, 1000
MAP_M = 0.25  # cells
CITY_MAP_M, HALF_M = 5.0, 150.0  # cells, and half the width of a city's map
BAND_HZ = np.linspace(299e9, 301e9, 64)
COLUMNS = (
    ("place", "place", "{}"), ("verb", "call", "{}"), ("wall_s", "first [s]", "{:.3g}"),
    ("again_wall_s", "again [s]", "{:.3g}"), ("core_s", "core [s]", "{:.3g}"), ("peak_gb", "peak memory [GB]", "{:.2f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the measurement.

    Attributes:
        place: lobby or a city.
        geometry: folder of a reconstruction of the lobby, in the place of its true mesh.
        truth: of the lobby's spectra.
        verbs: which; what they need is made for them.
    """

    place: str = option("lobby", "lobby or a city", choices=("lobby", *CITIES))
    geometry: str = option("", "folder of a reconstruction of the lobby")
    truth: str = option("exact", "of the lobby's spectra", choices=tuple(FILES))
    verbs: tuple[str, ...] = option((), "which verbs (all by default)")


@dataclass(frozen=True)
class Room:
    """Where verbs are asked, a folder in which one process leaves a field for the next, and one that is kept between runs."""

    options: Options
    folder: Path
    kept: Path

    @cached_property
    def is_city(self) -> bool:
        """Whether it is one of :data:`CITIES`."""
        return self.options.place in CITIES

    @cached_property
    def path(self) -> str:
        """The scene's file."""
        return str(getattr(sionna_rt().scene, self.options.place)) if self.is_city else f"{DATA}/scene.xml"

    @cached_property
    def scene(self) -> wr.Scene:
        """The true scene; a city's materials all scatter."""
        loaded = wr.Scene.load(self.path)
        if not self.is_city:
            return loaded
        return loaded.with_materials([replace(m, scattering=SCATTERING) for m in loaded.materials])

    @cached_property
    def geometry(self) -> Any:
        """What fields stand on."""
        return wr.Reconstruction.load(self.options.geometry) if self.options.geometry else self.scene

    @cached_property
    def link(self) -> dict[str, Any]:
        """Transmitter and carrier."""
        place = CITIES.get(self.options.place, TRANSMITTER)
        return {"transmitter": place, "frequency_hz": CITY_HZ if self.is_city else FREQUENCY_HZ}

    @cached_property
    def receivers(self) -> np.ndarray:
        """A thousand free places."""
        return wr.sample_receivers(self.scene, MOST, above_ground=self.is_city, seed=0)

    @cached_property
    def spectra(self) -> wr.SpectrumDataset:
        """Spectra to fit to: the lobby's, or a city's by the exact engine."""
        if not self.is_city:
            return wr.SpectrumDataset.load(Path(DATA) / FILES[self.options.truth])
        file = self.folder / "spectra.nc"
        if not file.is_file():
            wr.simulate(self.scene, receivers=self.receivers[:MANY], **self.link).save(file)
        return wr.SpectrumDataset.load(file)

    @cached_property
    def large(self) -> wr.SpectrumDataset:
        """Many spectra by the exact engine, of the paper's size."""
        return wr.simulate(
            self.scene, receivers=self.receivers[:HUNDREDS], workspace=self.kept / self.options.place, **self.link
        )  # fmt: skip

    def fit(self, count: int) -> Any:
        """A field on ``count`` spectra."""
        return wr.RadioField.fit(self.geometry, self.spectra.split(count)[0])

    @cached_property
    def field(self) -> Any:
        """A field on the smaller set, fitted once."""
        file = self.folder / "field.safetensors"
        if not file.is_file():
            self.fit(FEW).save(file)
        return wr.RadioField.load(file)

    def radio_map(self) -> Any:
        """A map of the lobby, or of the middle of a city."""
        if not self.is_city:
            return self.field.radio_map(1.5, MAP_M)
        middle = np.array(self.link["transmitter"][:2])
        bounds = [*(middle - HALF_M), *(middle + HALF_M)]
        return self.field.radio_map(1.5, CITY_MAP_M, bounds=bounds, above_ground=True)

    def responses(self) -> Any:
        """Responses of 8 x 8 by 4 x 4 elements at 64 frequencies, onto the disk."""
        arrays = {"rx_array": wr.PlanarArray(8, 8), "tx_array": wr.PlanarArray(4, 4)}
        return self.field.cfr(
            self.receivers, BAND_HZ, diffuse="random_phase", method="dense", max_paths=100,
            store=self.folder / f"responses-{os.getpid()}.nc", **arrays,
        )  # fmt: skip

    def drag(self) -> Any:
        """The viewer's answer to a receiver that is moved."""
        viewer = wr.view(self.field, port=8765)
        try:
            for place in self.receivers[:20]:
                viewer.receiver = place
                viewer.wait()
        finally:
            viewer.close()


@dataclass(frozen=True)
class Verb:
    """One call that is measured.

    Attributes:
        name: as tables have it.
        call: what is measured.
        needs: attributes of :class:`Room` that stand ready before.
        times: how often it is called; the first and the last call are reported.
    """

    name: str
    call: Callable[[Room], Any]
    needs: tuple[str, ...] = ("scene", "receivers")
    times: int = 1


def _trace(room: Room, count: int) -> Any:
    return wr.trace_paths(room.scene, receivers=room.receivers[:count], mirror_order=2, **room.link)


def _simulate(room: Room, count: int, engine: str) -> Any:
    return wr.simulate(room.scene, receivers=room.receivers[:count], engine=engine, **room.link)


FIELD = ("field", "receivers")
VERBS: dict[str, Verb] = {
    "load": Verb("Scene.load", lambda r: wr.Scene.load(r.path), ("path",)),
    "trace": Verb("trace_paths, two mirrors, one receiver", lambda r: _trace(r, 1), times=2),
    "traces": Verb("trace_paths, two mirrors, 100 receivers", lambda r: _trace(r, 100), times=2),
    "simulate": Verb("simulate, exact, 12 receivers", lambda r: _simulate(r, 12, "exact")),
    "sionna": Verb("simulate, Sionna RT, depth 3, 3 receivers", lambda r: _simulate(r, 3, "sionna")),
    "relevance": Verb("relevance, 6 receivers", lambda r: wr.relevance(r.scene, receivers=r.receivers[:6], **r.link)),
    "fit-few": Verb(f"RadioField.fit, {FEW} spectra", lambda r: r.fit(FEW), ("geometry", "spectra")),
    "fit-many": Verb(f"RadioField.fit, {MANY} spectra", lambda r: r.fit(MANY), ("geometry", "spectra")),
    "simulate-large": Verb(f"simulate, exact, {HUNDREDS} receivers, or what is kept of it", lambda r: r.large),
    "fit-large": Verb(
        f"RadioField.fit, {HUNDREDS} spectra of 90 x 180", lambda r: wr.RadioField.fit(r.geometry, r.large), ("geometry", "large"),
    ),
    "spectrum": Verb("field.spectrum", lambda r: r.field.spectrum(r.receivers[20]), FIELD, 5),
    "spectra": Verb(f"field.spectra, {MOST} receivers", lambda r: r.field.spectra(r.receivers), FIELD),
    "paths": Verb("field.paths, 10 receivers", lambda r: r.field.paths(r.receivers[:10], max_paths=100), FIELD, 2),
    "responses": Verb(f"field.cfr, {MOST} receivers, onto the disk", Room.responses, FIELD),
    "map": Verb("field.radio_map", Room.radio_map, ("field",), 2),
    "viewer": Verb("viewer, 20 moves of the receiver", Room.drag, FIELD, 2),
}  # fmt: skip


def run(options: Options, job: Job) -> Report:
    """Measure verb by verb.

    Raises:
        ValueError: for an unknown verb.
    """
    unknown = sorted(set(options.verbs) - set(VERBS))
    if unknown:
        raise ValueError(f"verbs: got {', '.join(unknown)}, expected some of {', '.join(VERBS)}")
    names, rows, context = options.verbs or tuple(VERBS), [], multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        room = Room(options, Path(folder), job.out / "simulated")
        for k, name in enumerate(names):
            job.progress("verbs", k, len(names))
            with ProcessPoolExecutor(1, mp_context=context) as process:
                rows.append(process.submit(measured, name, room).result())
    figures = {"machine": machine(job.device), "load_average": os.getloadavg()[0], "rows": rows}
    return Report("times", figures, columns_table(COLUMNS, rows))


def measured(name: str, room: Room) -> Row:
    """One verb, in this process."""
    verb, walls, cores = VERBS[name], [], []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* not modelled, which matters")
        for need in verb.needs:
            getattr(room, need)
        with peak_memory() as peak:
            for _ in range(verb.times):
                clock = time.perf_counter(), time.process_time()
                verb.call(room)
                walls.append(time.perf_counter() - clock[0])
                cores.append(time.process_time() - clock[1])
    again = {"again_wall_s": walls[-1] if verb.times > 1 else None}
    row = {"place": room.options.place, "verb": verb.name, "wall_s": walls[0], "core_s": cores[0], **again}
    return {**row, "peak_gb": peak["peak_memory_bytes"] / 1e9}


BENCHMARKS = {"times": Benchmark("times", Options, run, HELP)}
