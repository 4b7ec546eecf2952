"""The lobby's radio map: a field fitted to few spectra beside Sionna RT's RadioMapSolver on the true scene.

Both are asked for the total path gain between isotropic antennas, averaged over vertical and horizontal transmit
polarisation, at one height. Sionna's map is a Monte Carlo estimate of each cell's mean on a horizontal plane; ours is
the value at the cell's centre. What is left of that difference is shown by averaging ours over four places a cell. The
reference is Sionna's own with many samples: half of them give its noise, from the two halves' difference. Cells count
that lie in the air of the true scene as a whole.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import machine
from benchmarks.sionna_map import SionnaMap
from benchmarks.stages import fingerprint, write_json
from warprrf import device as _device
from warprrf.device import Progress
from warprrf.files import write_atomically, write_text
from warprrf.geometry.reconstruction import Reconstruction
from warprrf.rf.fields.base import RadioField
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.maps.radio_map import RadioMap
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset

SCENE = "data/lobby/scene.xml"
SPECTRA = "data/lobby/spectra_sionna.nc"
GEOMETRY = "runs/lobby/reconstruction"
TRAINING = 50  # spectra that the field is fitted to
SHAPES = ((5, 10), (10, 20), (20, 40), (30, 60))
SAMPLES = (10_000, 100_000, 1_000_000, 10_000_000)
REFERENCE = 100_000_000
AT_ONCE = 10_000_000  # samples of one solve: bounds memory
DEPTH = 3
FEWER_MIRRORS = 2  # most reflections of the maps that leave longer chains out
ENOUGH_DB = 0.05  # a map is good enough if it is no worse than the finest one by more
LOWEST_DB = 20.0  # maps are clipped so far below the median of the reference: an empty cell has no level

Row = dict[str, Any]


def run_map(
    out: str | os.PathLike[str] = "runs/map",
    *,
    field: str | os.PathLike[str] | RadioField | None = None,
    scene: str | os.PathLike[str] = SCENE,
    spectra: str | os.PathLike[str] = SPECTRA,
    geometry: str | os.PathLike[str] = GEOMETRY,
    height: float = 1.5,
    cell: float = 0.25,
    shapes: Sequence[tuple[int, int]] = SHAPES,
    samples: Sequence[int] = SAMPLES,
    reference: int = REFERENCE,
    seed: int = 0,
    device: Any = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure both maps; writes ``map.json``, ``map.md``, ``map.nc``, and with matplotlib ``map.png`` and
    ``speed_against_error.png``, to ``out``.

    Args:
        field: A fitted bistatic field or its file; fitted to 50 of ``spectra`` on ``geometry`` by default.
        scene: True scene, which Sionna solves.
        spectra: Data set of that scene by Sionna RT.
        geometry: Folder of a reconstruction.
        height: Of the map [m].
        cell: Width of a cell [m].
        shapes: Grids of rays of our maps; the last one's map is kept. If the field has chains of more than two mirrors,
            all but the last are also drawn without them.
        samples: Numbers of Sionna's samples, both polarisations together.
        reference: Samples of the reference; kept in ``reference.npz`` for the next run.
        seed: Of Sionna's rays and the fit.

    Raises:
        ImportError: if Sionna RT is missing.
        FileNotFoundError: if there is no such scene, data set or geometry.
        ValueError: if the field is not bistatic, or there are no shapes or samples.
    """
    if not shapes or not samples:
        raise ValueError(f"shapes, samples: got {shapes!r} and {samples!r}, expected at least one of each")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    fitted, fit_time_s = _field(field, spectra, geometry, seed, device)
    if not isinstance(fitted, BistaticField):
        raise ValueError(f"field: got model {fitted.model!r}, expected 'bistatic'")
    room = Scene.load(scene)
    ours: list[Row] = []
    own = fitted.terms.mirror_order
    wanted = [(shape, own) for shape in shapes]
    if own > FEWER_MIRRORS:
        wanted += [(shape, FEWER_MIRRORS) for shape in shapes[:-1]]
    steps = len(wanted) + len(samples) + 2
    started = time.perf_counter(), time.process_time()
    fitted.sent_radiance(fitted.transport())  # once for a transmitter, whatever the map
    fitted.transport().images.candidates(fitted.transmitter[None] + 0.1, fitted.terms.mirror_order)
    prepared = _spent(started)
    maps: list[RadioMap] = []
    fitted.radio_map(height, 8.0 * cell)  # kernels are loaded
    for k, (shape, order) in enumerate(wanted):
        _say(progress, k, steps)
        started = time.perf_counter(), time.process_time()
        maps.append(
            fitted.radio_map(height, cell, bounds=_bounds(room, cell), shape=shape, mirror_order=order)
        )
        ours.append({"rays": 4 * shape[0] * shape[1], "mirrors": order, "average": 1, **_spent(started)})
    finest = maps[len(shapes) - 1]
    _say(progress, len(wanted), steps)
    started = time.perf_counter(), time.process_time()
    few = min(own, FEWER_MIRRORS)
    fine = fitted.radio_map(height, 0.5 * cell, bounds=_bounds(room, cell), shape=shapes[0], mirror_order=few)
    ours.append({"rays": 4 * shapes[0][0] * shapes[0][1], "mirrors": few, "average": 4, **_spent(started)})

    solver = SionnaMap(
        room,
        transmitter=fitted.transmitter,
        frequency_hz=fitted.frequency_hz,
        x=maps[0].x,
        y=maps[0].y,
        height_m=height,
        depth=DEPTH,
    )
    marks = fingerprint(
        [Path(scene), reference, DEPTH, height, maps[0].x, maps[0].y, seed, fitted.transmitter]
    )
    halves = _reference(solver, folder / "reference.npz", marks, reference, seed, progress)
    truth = 0.5 * (halves[0] + halves[1])
    counted, blocked = _counted(room, maps[0])
    lowest = float(np.median(10.0 * np.log10(truth[counted]))) - LOWEST_DB

    def error(values: np.ndarray) -> Row:
        return errors(values, truth, counted, blocked, lowest)

    theirs: list[Row] = []
    for k, count in enumerate(samples):
        _say(progress, len(wanted) + 1 + k, steps)
        solver(count, seed=1000)  # kernels are compiled for this size
        started = time.perf_counter(), time.process_time()
        values = solver(count, seed=1001 + k)
        theirs.append(
            {"samples": count, **_spent(started), **error(values), "empty": _empty(values, counted)}
        )
    _say(progress, steps, steps)
    for row, found in zip(ours, maps, strict=False):
        row |= error(found.total_path_gain)
        row["rms_to_finest_db"] = errors(
            found.total_path_gain, finest.total_path_gain, counted, blocked, lowest
        )["rms_db"]
    ours[-1] |= error(_mean_of_four(fine.total_path_gain))
    rms = errors(halves[0], halves[1], counted, blocked, lowest)
    report = {
        "machine": machine(device),
        "seed": seed,
        "height_m": height,
        "cell_m": cell,
        "cells": int(finest.free.sum()),
        "cells_counted": int(counted.sum()),
        "cells_blocked": int((counted & blocked).sum()),
        "fit_time_s": fit_time_s,
        "prepared": prepared,
        "ours": ours,
        "sionna": theirs,
        "reference": {
            "samples": reference,
            # the mean of two halves has half the spread of their difference
            "rms_db": 0.5 * rms["rms_db"],
            "rms_blocked_db": None if rms["rms_blocked_db"] is None else 0.5 * rms["rms_blocked_db"],
        },
    }
    good = [r for r in ours if r["rms_db"] <= ours[len(shapes) - 1]["rms_db"] + ENOUGH_DB]
    enough = min(good, key=lambda r: r["core_s"])
    known = {name: enough[name] for name in ("rays", "mirrors", "average", "core_s")}
    report["at_equal_error"] = {"ours": known, **at_equal_error(enough, theirs)}
    write_json(folder / "map.json", report)
    finest.save(folder / "map.nc")
    text = table(report)
    write_text(folder / "map.md", text + "\n")
    _plots(folder, report, finest, truth, counted)
    return report


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


def table(report: dict[str, Any]) -> str:
    """The report as Markdown."""

    def cell(value: float | None, form: str = "{:.2f}") -> str:
        return "-" if value is None else form.format(value)

    def row(name: str, r: Row, empty: str) -> str:
        return (
            f"| {name} | {r['wall_s']:.1f} | {r['core_s']:.1f} | {cell(r['rms_db'])} | {cell(r['median_db'])} "
            f"| {cell(r['rms_seen_db'])} | {cell(r['rms_blocked_db'])} | {empty} |"
        )

    lines = [
        f"Total path gain at {report['height_m']:g} m, {report['cells']} cells of {report['cell_m']:g} m; errors over "
        f"{report['cells_counted']} cells that are air as a whole, {report['cells_blocked']} of them without line of "
        f"sight, against RadioMapSolver with {report['reference']['samples']:.0e} samples (itself "
        f"{report['reference']['rms_db']:.2f} dB, blocked {cell(report['reference']['rms_blocked_db'])} dB).",
        "",
        "| map | wall s | core s | rms dB | median dB | seen, rms | blocked, rms | empty cells |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in report["ours"]:
        where = "centre" if r["average"] == 1 else "mean of 4 places"
        lines.append(row(f"our field, {r['rays']} rays, {r['mirrors']} mirrors, {where}", r, "0"))
    for r in report["sionna"]:
        lines.append(row(f"RadioMapSolver, {r['samples']:.0e} samples", r, f"{r['empty']:.1%}"))
    p = report["prepared"]
    lines += [
        "",
        f"Our field besides: fitted in {cell(report['fit_time_s'], '{:.0f}')} s, prepared for the transmitter in "
        f"{p['wall_s']:.1f} s ({p['core_s']:.1f} core s), once for all maps. "
        + "; ".join(
            f"{r['rays']} rays, {r['mirrors']} mirrors are {r['rms_to_finest_db']:.2f} dB rms from the finest"
            for r in report["ours"]
            if r.get("rms_to_finest_db")
        ),
    ]
    for key, name in (("rms_db", "all cells"), ("rms_blocked_db", "blocked cells")):
        equal = report["at_equal_error"][key]
        said = (
            "is never reached"
            if equal is None
            else f"takes RadioMapSolver {equal['samples']:.1e} samples, {equal['core_s']:.1f} core s"
        )
        o = report["at_equal_error"]["ours"]
        lines.append(
            f"Our rms error over {name} with {o['rays']} rays, {o['mirrors']} mirrors "
            f"({o['core_s']:.1f} core s) {said}."
        )
    return "\n".join(lines)


def _field(
    given: Any, spectra: str | os.PathLike[str], geometry: str | os.PathLike[str], seed: int, device: Any
) -> tuple[RadioField, float | None]:
    """The field, and the seconds of its fit if it was fitted here."""
    if isinstance(given, RadioField):
        return given, None
    if given is not None:
        return RadioField.load(given, device=device), None
    training = SpectrumDataset.load(spectra).split(TRAINING)[0]
    start = time.perf_counter()
    fitted = RadioField.fit(Reconstruction.load(geometry), training, seed=seed, device=device)
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


def _reference(
    solver: SionnaMap, path: Path, marks: str, samples: int, seed: int, progress: Progress | None
) -> np.ndarray:
    """Two maps of half the samples each, (2, Y, X); kept in ``path``."""
    if path.is_file():
        with np.load(path, allow_pickle=False) as kept:
            if str(kept["marks"]) == marks:
                return np.asarray(kept["halves"])
    runs = max(1, -(-samples // (2 * AT_ONCE)))
    halves = []
    for half in range(2):
        maps = []
        for k in range(runs):
            if progress is not None:
                progress("reference", half * runs + k, 2 * runs)
            maps.append(solver(samples // (2 * runs), seed=10_000 * (seed + 1) + half * runs + k))
        halves.append(np.mean(maps, axis=0))
    found = np.stack(halves)
    write_atomically(path, lambda name: np.savez(name, halves=found, marks=np.array(marks)))
    return found


def _mean_of_four(fine: np.ndarray) -> np.ndarray:
    """Means of the free ones among 2 x 2 places; NaN where none is."""
    blocks = fine.reshape(fine.shape[0] // 2, 2, fine.shape[1] // 2, 2)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0.0).sum(axis=(1, 3))
    return np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)


def _empty(values: np.ndarray, counted: np.ndarray) -> float:
    return float(np.mean(values[counted] <= 0))


def _spent(started: tuple[float, float]) -> Row:
    return {"wall_s": time.perf_counter() - started[0], "core_s": time.process_time() - started[1]}


def _say(progress: Progress | None, done: int, total: int) -> None:
    if progress is not None:
        progress("map", done, total)


def _plots(
    folder: Path, report: dict[str, Any], ours: RadioMap, truth: np.ndarray, counted: np.ndarray
) -> None:
    """Both maps and their difference, and speed against error; nothing without matplotlib."""
    try:
        figure_module = _device.require("matplotlib.figure", extra="plots")
    except ImportError:
        return
    figure = figure_module.Figure(figsize=(15.0, 4.2), layout="constrained")
    axes = figure.subplots(1, 3)
    shown = np.where(counted, ours.total_path_gain, np.nan)
    reference = np.where(counted, truth, np.nan)
    low, high = np.nanpercentile(10.0 * np.log10(reference), [0.5, 99.5])
    half = 0.5 * ours.cell_m
    box = (ours.x[0] - half, ours.x[-1] + half, ours.y[0] - half, ours.y[-1] + half)
    common = {"extent": box, "origin": "lower", "interpolation": "nearest"}
    for ax, values, title in (
        (axes[0], shown, "our field"),
        (axes[1], reference, "RadioMapSolver, reference"),
    ):
        image = ax.imshow(10.0 * np.log10(values), vmin=low, vmax=high, cmap="viridis", **common)
        ax.set_title(title, fontsize=10)
    figure.colorbar(image, ax=axes[1], label="total path gain [dB]", shrink=0.8)
    gap = axes[2].imshow(10.0 * np.log10(shown / reference), vmin=-6, vmax=6, cmap="RdBu_r", **common)
    axes[2].set_title("difference", fontsize=10)
    figure.colorbar(gap, ax=axes[2], label="[dB]", shrink=0.8, extend="both")
    for ax in axes:
        ax.plot(*ours.outline.transpose(2, 1, 0), color="#222222", linewidth=0.8)
        ax.plot(*ours.transmitter[:2], marker="*", markersize=13, color="#d7263d", markeredgecolor="white")
        ax.set_xlabel("x [m]")
    axes[0].set_ylabel("y [m]")
    write_atomically(folder / "map.png", lambda name: figure.savefig(name, dpi=110))

    figure = figure_module.Figure(figsize=(9.0, 4.0), layout="constrained")
    for ax, key, title in zip(
        figure.subplots(1, 2),
        ("rms_db", "rms_blocked_db"),
        ("all cells", "cells without line of sight"),
        strict=True,
    ):
        centres = [r for r in report["ours"] if r["average"] == 1]
        drawn = [(report["sionna"], "RadioMapSolver, samples", "#0b6e99", "o")]
        for order, colour in zip(
            sorted({r["mirrors"] for r in centres}), ("#b3123c", "#e0843f"), strict=False
        ):
            own = [r for r in centres if r["mirrors"] == order]
            drawn.append((own, f"our field, {order} mirrors, rays a cell", colour, "s"))
        for rows, name, colour, mark in drawn:
            if any(r[key] is None for r in rows):
                continue
            ax.loglog(
                [r["core_s"] for r in rows], [r[key] for r in rows], mark + "-", color=colour, label=name
            )
            for r in rows:
                label = f"{r['samples']:.0e}" if "samples" in r else f"{r['rays']}"
                ax.annotate(label, (r["core_s"], r[key]), (4, 4), textcoords="offset points", fontsize=7)
        if report["reference"][key] is not None:
            ax.axhline(
                report["reference"][key], color="#8c8c8c", linestyle=":", label="noise of the reference"
            )
        ax.set_title(title, fontsize=10)
        ax.set_xlabel("core seconds")
        ax.grid(True, which="both", alpha=0.25)
    figure.axes[0].set_ylabel("rms error of total path gain [dB]")
    figure.axes[0].legend(fontsize=8)
    write_atomically(folder / "speed_against_error.png", lambda name: figure.savefig(name, dpi=110))
