"""The lobby's radio map: a field fitted to few spectra beside Sionna RT's RadioMapSolver on the true scene.

Both are asked for the total path gain between isotropic antennas, averaged over vertical and horizontal transmit
polarisation, at one height. Sionna's map is a Monte Carlo estimate of each cell's mean on a horizontal plane; ours is
the value at the cell's centre. What is left of that difference is shown by averaging ours over four places a cell. The
reference is Sionna's own with many samples: half of them give its noise, from the two halves' difference. Cells count
that lie in the air of the true scene as a whole.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import machine
from benchmarks.pictures import figure_of
from benchmarks.report import Report, Row, cell, columns_table
from benchmarks.runner import Benchmark, Job, option
from benchmarks.sionna_map import SionnaMap
from warprrf.geometry.reconstruction import Reconstruction
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.maps.radio_map import RadioMap
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.steps import Steps

TRAINING = 50  # spectra that the field is fitted to
AT_ONCE = 10_000_000  # samples of one solve: bounds memory
DEPTH = 3
FEWER_MIRRORS = 2  # most reflections of the maps that leave longer chains out
ENOUGH_DB = 0.05  # a map is good enough if it is no worse than the finest one by more
LOWEST_DB = 20.0  # maps are clipped so far below the median of the reference: an empty cell has no level

HELP = """\
Total path gain over a floor plan by a field and by Sionna RT on the true scene, at several numbers of rays and samples,
against Sionna's own with very many. Needs the extra sionna; the reference is kept for the next run.

examples:
  python -m benchmarks map --field field.safetensors
"""


@dataclass(frozen=True)
class Options:
    """Options of the map.

    Attributes:
        field: file of a fitted bistatic field; fitted to 50 of ``spectra`` on ``geometry`` by default.
        scene: true scene, which Sionna solves.
        spectra: data set of that scene by Sionna RT.
        geometry: folder of a reconstruction.
        cell: width of a cell [m].
        reference: samples of Sionna's reference.
        height: of the map [m].
        shapes: grids of rays of our maps; the last one's map is kept. If the field has chains of more than two mirrors,
            all but the last are also drawn without them.
        samples: numbers of Sionna's samples, both polarisations together.
    """

    field: str | None = option(None, "file of a bistatic field (fitted to 50 spectra by default)")
    scene: str = option("data/lobby/scene.xml", "true scene (XML)")
    spectra: str = option("data/lobby/spectra_sionna.nc", "what the field is fitted to")
    geometry: str = option("runs/lobby/reconstruction", "folder of a saved reconstruction")
    cell: float = option(0.25, "width of a cell [m]")
    reference: int = option(100_000_000, "samples of Sionna's reference")
    height: float = 1.5
    shapes: tuple[tuple[int, int], ...] = ((5, 10), (10, 20), (20, 40), (30, 60))
    samples: tuple[int, ...] = (10_000, 100_000, 1_000_000, 10_000_000)

    def __post_init__(self) -> None:
        if not self.shapes or not self.samples:
            raise ValueError(
                f"shapes, samples: got {self.shapes!r} and {self.samples!r}, expected at least one of each"
            )


def run(options: Options, job: Job, field: RadioField | None = None) -> Report:
    """Measure both maps; also leaves ``map.nc``, our finest one.

    Args:
        field: in place of the options' file.

    Raises:
        ImportError: if Sionna RT is missing.
        FileNotFoundError: if there is no such scene, data set or geometry.
        ValueError: if the field is not bistatic.
    """
    fitted, fit_time_s = (field, None) if field is not None else _field(options, job)
    if not isinstance(fitted, BistaticField):
        raise ValueError(f"field: got model {fitted.model!r}, expected 'bistatic'")
    measured = _Maps(options, job, fitted)
    ours, maps = measured.ours()
    finest = maps[len(options.shapes) - 1]
    halves = measured.reference(finest)
    truth = 0.5 * (halves[0] + halves[1])
    counted, blocked = _counted(measured.room, finest)
    lowest = float(np.median(10.0 * np.log10(truth[counted]))) - LOWEST_DB

    def error(values: np.ndarray, of: np.ndarray = truth) -> Row:
        return errors(values, of, counted, blocked, lowest)

    theirs = [
        {**row, **error(values), "empty": float(np.mean(values[counted] <= 0))}
        for row, values in measured.sionna(finest)
    ]
    for row, found in zip(ours, maps, strict=True):
        gain = found.total_path_gain
        row |= error(gain if row["average"] == 1 else _mean_of_four(gain))
        if row["average"] == 1:
            row["rms_to_finest_db"] = error(gain, finest.total_path_gain)["rms_db"]
    rms = error(halves[0], halves[1])
    good = [r for r in ours if r["rms_db"] <= ours[len(options.shapes) - 1]["rms_db"] + ENOUGH_DB]
    enough = min(good, key=lambda r: float(r["core_s"]))
    known = {name: enough[name] for name in ("rays", "mirrors", "average", "core_s")}
    figures = {
        "machine": machine(job.device),
        "seed": job.seed,
        "height_m": options.height,
        "cell_m": options.cell,
        "cells": int(finest.free.sum()),
        "cells_counted": int(counted.sum()),
        "cells_blocked": int((counted & blocked).sum()),
        "fit_time_s": fit_time_s,
        "ours": ours,
        "sionna": theirs,
        "reference": {
            "samples": options.reference,
            # the mean of two halves has half the spread of their difference
            "rms_db": 0.5 * rms["rms_db"],
            "rms_blocked_db": None if rms["rms_blocked_db"] is None else 0.5 * rms["rms_blocked_db"],
        },
        "at_equal_error": {"ours": known, **at_equal_error(enough, theirs)},
    }
    finest.save(job.out / "map.nc")
    pictures = {
        "map.png": (
            lambda: _map_picture(finest, truth, counted),
            "Our field, Sionna's reference, and their difference.",
        ),
        "speed_against_error.png": (lambda: _speed_picture(figures), "Error against core seconds."),
    }
    return Report("map", figures, text(figures), pictures, dpi=110)


class _Maps:
    """The maps of both sides, timed."""

    def __init__(self, options: Options, job: Job, field: BistaticField) -> None:
        self.options, self.job, self.field = options, job, field
        self.room = Scene.load(options.scene)

    @cached_property
    def wanted(self) -> list[tuple[tuple[int, int], int]]:
        """Grids of rays and most reflections of our maps."""
        own = self.field.terms.mirror_order
        wanted = [(shape, own) for shape in self.options.shapes]
        if own > FEWER_MIRRORS:
            wanted += [(shape, FEWER_MIRRORS) for shape in self.options.shapes[:-1]]
        return wanted

    def ours(self) -> tuple[list[Row], list[RadioMap]]:
        """Rows and maps; the last one has four places a cell."""
        options, bounds = self.options, _bounds(self.room, self.options.cell)
        self.field.radio_map(
            options.height, 8.0 * options.cell
        )  # kernels are loaded, the transmitter's part is made
        few = min(self.field.terms.mirror_order, FEWER_MIRRORS)
        asked = [(*one, 1) for one in self.wanted] + [(options.shapes[0], few, 4)]
        rows, maps = [], []
        for k, (shape, order, places) in enumerate(asked):
            self.job.progress("our maps", k, len(asked))
            cell = options.cell if places == 1 else 0.5 * options.cell
            started = time.perf_counter(), time.process_time()
            maps.append(
                self.field.radio_map(options.height, cell, bounds=bounds, shape=shape, mirror_order=order)
            )
            rows.append(
                {"rays": 4 * shape[0] * shape[1], "mirrors": order, "average": places, **_spent(started)}
            )
        self.job.progress("our maps", len(asked), len(asked))
        return rows, maps

    def solver(self, like: RadioMap) -> SionnaMap:
        """Sionna's solver on the cells of one of our maps."""
        return SionnaMap(
            self.room,
            transmitter=self.field.transmitter,
            frequency_hz=self.field.frequency_hz,
            x=like.x,
            y=like.y,
            height_m=self.options.height,
            depth=DEPTH,
        )

    def sionna(self, like: RadioMap) -> list[tuple[Row, np.ndarray]]:
        """Rows and maps of Sionna's solver, one a number of samples."""
        solver, found = self.solver(like), []
        for k, count in enumerate(self.options.samples):
            self.job.progress("Sionna's maps", k, len(self.options.samples))
            solver(count, seed=1000)  # kernels are compiled for this size
            started = time.perf_counter(), time.process_time()
            values = solver(count, seed=1001 + k)
            found.append(({"samples": count, **_spent(started)}, values))
        self.job.progress("Sionna's maps", len(found), len(found))
        return found

    def reference(self, like: RadioMap) -> np.ndarray:
        """Two maps of half the samples each, (2, Y, X); kept in ``reference.npz``."""
        samples, seed = self.options.reference, self.job.seed
        runs = max(1, -(-samples // (2 * AT_ONCE)))

        def make() -> dict[str, np.ndarray]:
            solver, halves = self.solver(like), []
            for half in range(2):
                maps = []
                for k in range(runs):
                    self.job.progress("reference", half * runs + k, 2 * runs)
                    maps.append(solver(samples // (2 * runs), seed=10_000 * (seed + 1) + half * runs + k))
                halves.append(np.mean(maps, axis=0))
            return {"halves": np.stack(halves)}

        inputs = [
            Path(self.options.scene),
            samples,
            self.options.height,
            like.x,
            like.y,
            seed,
            self.field.transmitter,
        ]
        with Steps(self.job.out, fresh=self.job.fresh, progress=self.job.progress) as steps:
            return steps.arrays("reference", make, version=DEPTH, inputs=inputs)["halves"]


def errors(
    values: np.ndarray, truth: np.ndarray, counted: np.ndarray, blocked: np.ndarray, lowest_db: float
) -> Row:
    """Errors in dB of a map over the cells ``counted``, all arrays (Y, X): rms, median, and rms where ``blocked``."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (np.maximum(10.0 * np.log10(np.nan_to_num(v)), lowest_db) for v in (values, truth))
    gap = a - b
    hidden = gap[counted & blocked]
    open_view = gap[counted & ~blocked]
    return {
        "rms_db": float(np.sqrt(np.mean(gap[counted] ** 2))),
        "median_db": float(np.median(np.abs(gap[counted]))),
        "bias_db": float(np.mean(gap[counted])),
        "rms_seen_db": float(np.sqrt(np.mean(open_view**2))) if len(open_view) else None,
        "rms_blocked_db": float(np.sqrt(np.mean(hidden**2))) if len(hidden) else None,
    }


def at_equal_error(ours: Row, theirs: Sequence[Row]) -> Row:
    """Core seconds and samples at which Sionna's rms error falls to ours, interpolated between rows; None if it does
    not."""
    found: Row = {}
    for key in ("rms_db", "rms_seen_db", "rms_blocked_db"):
        levels = [row[key] for row in theirs]
        found[key] = None
        if ours[key] is None or any(level is None for level in levels):
            continue
        below = [k for k, level in enumerate(levels) if level <= ours[key]]
        if not below:
            continue
        k = below[0]
        share = 0.0
        if k > 0:
            share = np.log(ours[key] / levels[k]) / np.log(levels[k - 1] / levels[k])
        before = theirs[max(k - 1, 0)]
        found[key] = {
            name: float(np.exp((1 - share) * np.log(theirs[k][name]) + share * np.log(before[name])))
            for name in ("samples", "core_s", "wall_s")
        }
    return found


def text(figures: dict[str, Any]) -> str:
    """The figures as Markdown."""
    rows = []
    for r in figures["ours"]:
        where = "centre" if r["average"] == 1 else "mean of 4 places"
        name = f"our field, {r['rays']} rays, {r['mirrors']} mirrors, {where}"
        rows.append({**r, "map": name, "empty": 0.0})
    rows += [{**r, "map": f"RadioMapSolver, {r['samples']:.0e} samples"} for r in figures["sionna"]]
    columns = (
        ("map", "map", "{}"), ("wall_s", "wall s", "{:.1f}"), ("core_s", "core s", "{:.1f}"),
        ("rms_db", "rms dB", "{:.2f}"), ("median_db", "median dB", "{:.2f}"), ("rms_seen_db", "seen, rms", "{:.2f}"),
        ("rms_blocked_db", "blocked, rms", "{:.2f}"), ("rms_to_finest_db", "rms to the finest", "{:.2f}"),
        ("empty", "empty cells", "{:.1%}"),
    )  # fmt: skip
    reference = figures["reference"]
    parts = [
        f"Total path gain at {figures['height_m']:g} m, {figures['cells']} cells of {figures['cell_m']:g} m; errors over "
        f"{figures['cells_counted']} cells that are air as a whole, {figures['cells_blocked']} of them without line of "
        f"sight, against RadioMapSolver with {reference['samples']:.0e} samples (itself {reference['rms_db']:.2f} dB, "
        f"blocked {cell(reference['rms_blocked_db'])} dB). The field was fitted in "
        f"{cell(figures['fit_time_s'], '{:.0f}')} s.",
        columns_table(columns, rows),
    ]
    for key, name in (("rms_db", "all cells"), ("rms_blocked_db", "blocked cells")):
        equal, o = figures["at_equal_error"][key], figures["at_equal_error"]["ours"]
        said = (
            "is never reached"
            if equal is None
            else f"takes RadioMapSolver {equal['samples']:.1e} samples, {equal['core_s']:.1f} core s"
        )
        parts.append(
            f"Our rms error over {name} with {o['rays']} rays, {o['mirrors']} mirrors ({o['core_s']:.1f} core s) {said}."
        )
    return "\n\n".join(parts)


def _field(options: Options, job: Job) -> tuple[RadioField, float | None]:
    """The field, and the seconds of its fit if it was fitted here."""
    if options.field is not None:
        return RadioField.load(options.field, device=job.device), None
    training = SpectrumDataset.load(options.spectra).split(TRAINING)[0]
    start = time.perf_counter()
    fitted = RadioField.fit(Reconstruction.load(options.geometry), training, seed=job.seed, device=job.device)
    return fitted, time.perf_counter() - start


def _bounds(room: Scene, cell: float) -> np.ndarray:
    """Where the air of a room of closed solids may be, on multiples of a cell [m]."""
    low, high = room.bounds[:, :2]
    return np.concatenate([np.floor(low / cell), np.ceil(high / cell)]) * cell


def _counted(room: Scene, like: RadioMap) -> tuple[np.ndarray, np.ndarray]:
    """Cells (Y, X) that are air as a whole in the true scene and free in ours, and those that don't see the
    transmitter."""
    places = like.positions.reshape(-1, 3)
    air = room.is_free(places, clearance_m=like.cell_m / np.sqrt(2.0)).reshape(like.free.shape)
    source = np.broadcast_to(like.transmitter, places.shape).copy()
    blocked = ~room.mesh.visible(source, places).reshape(air.shape)
    return air & like.free, blocked


def _mean_of_four(fine: np.ndarray) -> np.ndarray:
    """Means of the free ones among 2 x 2 places; NaN where none is."""
    blocks = fine.reshape(fine.shape[0] // 2, 2, fine.shape[1] // 2, 2)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)


def _spent(started: tuple[float, float]) -> Row:
    return {"wall_s": time.perf_counter() - started[0], "core_s": time.process_time() - started[1]}


def _map_picture(ours: RadioMap, truth: np.ndarray, counted: np.ndarray) -> Any:
    """Both maps and their difference."""
    figure, axes = figure_of(3, (15.0, 4.2))
    shown = np.where(counted, ours.total_path_gain, np.nan)
    reference = np.where(counted, truth, np.nan)
    low, high = np.nanpercentile(10.0 * np.log10(reference), [0.5, 99.5])
    half = 0.5 * ours.cell_m
    box = (ours.x[0] - half, ours.x[-1] + half, ours.y[0] - half, ours.y[-1] + half)
    common = {"extent": box, "origin": "lower", "interpolation": "nearest"}
    for ax, values, name in (
        (axes[0], shown, "our field"),
        (axes[1], reference, "RadioMapSolver, reference"),
    ):
        image = ax.imshow(10.0 * np.log10(values), vmin=low, vmax=high, cmap="viridis", **common)
        ax.set_title(name, fontsize=10)
    figure.colorbar(image, ax=axes[1], label="total path gain [dB]", shrink=0.8)
    gap = axes[2].imshow(10.0 * np.log10(shown / reference), vmin=-6, vmax=6, cmap="RdBu_r", **common)
    axes[2].set_title("difference", fontsize=10)
    figure.colorbar(gap, ax=axes[2], label="[dB]", shrink=0.8, extend="both")
    for ax in axes:
        ax.plot(*ours.outline.transpose(2, 1, 0), color="#222222", linewidth=0.8)
        ax.plot(*ours.transmitter[:2], marker="*", markersize=13, color="#d7263d", markeredgecolor="white")
        ax.set_xlabel("x [m]")
    axes[0].set_ylabel("y [m]")
    return figure


def _speed_picture(figures: dict[str, Any]) -> Any:
    """Error against core seconds, all cells and those without line of sight."""
    figure, axes = figure_of(2, (9.0, 4.0))
    centres = [r for r in figures["ours"] if r["average"] == 1]
    drawn = [(figures["sionna"], "RadioMapSolver, samples", "#0b6e99", "o", "samples")]
    for order, colour in zip(sorted({r["mirrors"] for r in centres}), ("#b3123c", "#e0843f"), strict=False):
        own = [r for r in centres if r["mirrors"] == order]
        drawn.append((own, f"our field, {order} mirrors, rays a cell", colour, "s", "rays"))
    names = {"rms_db": "all cells", "rms_blocked_db": "cells without line of sight"}
    for ax, (key, name) in zip(axes, names.items(), strict=True):
        for rows, label, colour, mark, size in drawn:
            if any(r[key] is None for r in rows):
                continue
            at, level = [r["core_s"] for r in rows], [r[key] for r in rows]
            ax.loglog(at, level, mark + "-", color=colour, label=label)
            for r in rows:
                ax.annotate(
                    f"{r[size]:g}", (r["core_s"], r[key]), (4, 4), textcoords="offset points", fontsize=7
                )
        noise = figures["reference"][key]
        if noise is not None:
            ax.axhline(noise, color="#8c8c8c", linestyle=":", label="noise of the reference")
        ax.set_title(name, fontsize=10)
        ax.set_xlabel("core seconds")
        ax.grid(True, which="both", alpha=0.25)
    axes[0].set_ylabel("rms error of total path gain [dB]")
    axes[0].legend(fontsize=8)
    return figure


BENCHMARKS = {"map": Benchmark("map", Options, run, HELP)}
