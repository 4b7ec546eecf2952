"""What each verb takes in a city: wall clock, core seconds and the largest resident memory, each in a process of its own.

The scenes are Sionna RT's Munich (39,000 triangles, 1.5 by 1.2 km) and San Francisco (268,000) at 3.5 GHz. Their files
say nothing of scattering; every material gets the coefficient :data:`SCATTERING`, assumed. Memory is the process's, with
Python, the packages and what the call needs ready.
"""

from __future__ import annotations

import multiprocessing
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
from benchmarks.machine import peak_memory

FREQUENCY_HZ = 3.5e9
SCATTERING = 0.4
SPECTRA = 12  # that a field is fitted to
MAP_M, CELL_M = 150.0, 5.0  # half the width of a map, and of its cells


@dataclass(frozen=True)
class City:
    """A scene, and where it is asked.

    Attributes:
        path: of its file.
        transmitter: position [m], shape ``(3,)``.
        receivers: in its streets [m], shape ``(R, 3)``.
        folder: where one process leaves spectra and a field for the next.
    """

    path: str
    transmitter: np.ndarray
    receivers: np.ndarray
    folder: Path

    @cached_property
    def scene(self) -> wr.Scene:
        """The scene; all of its materials scatter."""
        loaded = wr.Scene.load(self.path)
        return loaded.with_materials([replace(m, scattering=SCATTERING) for m in loaded.materials])

    @property
    def links(self) -> dict[str, Any]:
        """Arguments of verbs but for the receivers."""
        return {"transmitter": self.transmitter, "frequency_hz": FREQUENCY_HZ}

    @cached_property
    def spectra(self) -> wr.SpectrumDataset:
        """What an earlier process simulated."""
        return wr.SpectrumDataset.load(self.folder / "spectra.nc")

    @cached_property
    def field(self) -> wr.RadioField:
        """What an earlier process fitted."""
        return wr.RadioField.load(self.folder / "field.safetensors")


@dataclass(frozen=True)
class Verb:
    """One call that is measured.

    Attributes:
        name: as tables have it.
        call: what is measured.
        needs: attributes of :class:`City` that stand ready before.
        keep: what to do with the result, unmeasured.
        times: how often it is called; the first and the last call are told.
    """

    name: str
    call: Callable[[City], Any]
    needs: tuple[str, ...] = ("scene",)
    keep: Callable[[City, Any], None] | None = None
    times: int = 1


def _trace(city: City, count: int, order: int) -> Any:
    return wr.trace_paths(city.scene, receivers=city.receivers[:count], mirror_order=order, **city.links)


def _simulate(city: City, count: int, engine: str) -> Any:
    return wr.simulate(city.scene, receivers=city.receivers[:count], engine=engine, **city.links)


def _map(city: City) -> Any:
    low, high = city.transmitter[:2] - MAP_M, city.transmitter[:2] + MAP_M
    return city.field.radio_map(1.5, CELL_M, bounds=[*low, *high], above_ground=True)


LOAD = Verb("Scene.load", lambda c: wr.Scene.load(c.path), ())
VERBS: dict[str, tuple[Verb, ...]] = {
    "munich": (
        LOAD,
        Verb("trace_paths, one mirror, one receiver", lambda c: _trace(c, 1, 1), times=2),
        Verb("trace_paths, two mirrors, one receiver", lambda c: _trace(c, 1, 2), times=2),
        Verb("trace_paths, two mirrors, 100 receivers", lambda c: _trace(c, 100, 2), times=2),
        Verb(
            f"simulate, exact, {SPECTRA} receivers", lambda c: _simulate(c, SPECTRA, "exact"),
            keep=lambda c, found: found.save(c.folder / "spectra.nc"),
        ),
        Verb("simulate, Sionna RT, depth 3, 3 receivers", lambda c: _simulate(c, 3, "sionna")),
        Verb("relevance, 6 receivers", lambda c: wr.relevance(c.scene, receivers=c.receivers[:6], **c.links)),
        Verb(
            f"RadioField.fit, quick, {SPECTRA} spectra", lambda c: wr.RadioField.fit(c.scene, c.spectra, quick=True),
            ("scene", "spectra"),
        ),
        Verb(
            f"RadioField.fit, {SPECTRA} spectra", lambda c: wr.RadioField.fit(c.scene, c.spectra), ("scene", "spectra"),
            keep=lambda c, found: found.save(c.folder / "field.safetensors"),
        ),
        Verb("field.spectrum", lambda c: c.field.spectrum(c.receivers[20]), ("field",), times=2),
        Verb("field.paths, 10 receivers", lambda c: c.field.paths(c.receivers[20:30], max_paths=100), ("field",), times=2),
        Verb(f"field.radio_map, {2 * MAP_M:.0f} m wide, cells of {CELL_M:g} m", _map, ("field",)),
    ),
    "san_francisco": (LOAD, Verb("trace_paths, one mirror, 10 receivers", lambda c: _trace(c, 10, 1), times=2)),
}  # fmt: skip


def measure(name: str, path: str, transmitter: np.ndarray, receivers: np.ndarray) -> list[dict[str, Any]]:
    """Rows of one scene of :data:`VERBS`: what every verb takes there."""
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        city = City(str(path), transmitter, receivers, Path(folder))
        rows = []
        for k in range(len(VERBS[name])):
            with ProcessPoolExecutor(1, mp_context=context) as process:
                rows.append(process.submit(_measured, name, k, city).result())
        return rows


def _measured(name: str, k: int, city: City) -> dict[str, Any]:
    verb = VERBS[name][k]
    for need in verb.needs:
        getattr(city, need)
    walls, cores = [], []
    with peak_memory() as peak, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* not modelled, which matters")
        for _ in range(verb.times):
            clock = time.perf_counter(), time.process_time()
            found = verb.call(city)
            walls.append(time.perf_counter() - clock[0])
            cores.append(time.process_time() - clock[1])
    if verb.keep is not None:
        verb.keep(city, found)
    return {
        "scene": name,
        "verb": verb.name,
        "wall_s": walls[0],
        "core_s": cores[0],
        "again_wall_s": walls[-1] if verb.times > 1 else None,
        "peak_bytes": peak["peak_memory_bytes"],
    }
