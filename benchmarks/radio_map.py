"""The lobby's radio map: a field fitted to few spectra beside Sionna RT's RadioMapSolver on the true scene.

Both are asked for the total path gain between isotropic antennas, averaged over vertical and horizontal transmit
polarisation, at one height. Sionna's map is a Monte Carlo estimate of each cell's mean on a horizontal plane; ours is
the value at the cell's centre. Cells count that lie in the air of the true scene as a whole.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fits import FitOptions, Fits, experiment, rms
from benchmarks.pictures import figure_of
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.rf.interop.sionna_engine import load_sionna_scene
from warprrf.rf.maps.radio_map import RadioMap
from warprrf.rf.scene_sionna import select_variant, sionna_rt

DEPTH = 3
AT_ONCE = 10_000_000  # samples of one solve: bounds memory
LOWEST_DB = 20.0  # maps are clipped so far below the median of the reference: an empty cell has no level
HELP = """\
Total path gain over a floor plan by a field and by Sionna RT on the true scene, at several numbers of rays and samples,
against Sionna's own with very many. Needs the extra sionna; the reference is kept for the next run.

examples:
  python -m benchmarks map
  python -m benchmarks map --cell 1 --reference 1000000 --samples 100000        a first look
"""
ERRORS = (
    ("rms_db", "rms [dB]", "{:.2f}"), ("median_db", "median [dB]", "{:.2f}"), ("rms_seen_db", "line of sight", "{:.2f}"),
    ("rms_blocked_db", "blocked", "{:.2f}"), ("core_s", "core seconds", "{:.1f}"),
)  # fmt: skip
COLUMNS = {
    "ours": (("rays", "rays a cell", "{}"), ("mirrors", "most mirrors", "{}"), *ERRORS),
    "sionna": (("samples", "samples", "{:.0e}"), *ERRORS),
}


@dataclass(frozen=True, kw_only=True)
class Options(FitOptions):
    """Options of the map.

    Attributes:
        cell: width of a cell [m].
        height: of the map [m].
        rows_of_rays: rows of our maps' grids of rays, with twice as many columns; also without chains of three mirrors.
        samples: numbers of Sionna's samples, both polarisations together.
        reference: samples of Sionna's reference.
    """

    truths: tuple[str, ...] = ("sionna",)
    counts: tuple[int, ...] = (50,)
    cell: float = option(0.25, "width of a cell [m]")
    height: float = option(1.5, "of the map [m]")
    rows_of_rays: tuple[int, ...] = option((5, 20), "rows of our maps' grids of rays")
    samples: tuple[int, ...] = option((100_000, 1_000_000), "numbers of Sionna's samples")
    reference: int = option(100_000_000, "samples of Sionna's reference")


def solver(scene: wr.Scene, like: RadioMap, frequency_hz: float) -> Callable[[int, int], np.ndarray]:
    """Sionna RT's RadioMapSolver on the cells of one of our maps: mean path gain (Y, X) from samples and a seed."""
    rt, mitsuba = sionna_rt(), select_variant()
    loaded, solve = load_sionna_scene(scene, frequency_hz=frequency_hz), rt.RadioMapSolver()
    array = partial(rt.PlanarArray, num_rows=1, num_cols=1, pattern="iso")
    loaded.rx_array = array(polarization="V")
    loaded.add(rt.Transmitter("tx", position=like.transmitter.tolist()))
    rows, columns = like.total_path_gain.shape
    middle = 0.5 * (like.x[0] + like.x[-1]), 0.5 * (like.y[0] + like.y[-1]), like.height_m

    def gain(samples: int, seed: int) -> np.ndarray:
        total = np.zeros((rows, columns))
        for k, polarisation in enumerate("VH"):
            loaded.tx_array = array(polarization=polarisation)
            found = solve(
                loaded, center=mitsuba.Point3f(*map(float, middle)), orientation=mitsuba.Point3f(0.0),
                # a little less, since Sionna rounds up to whole cells
                size=mitsuba.Point2f((columns - 1e-3) * like.cell_m, (rows - 1e-3) * like.cell_m),
                cell_size=mitsuba.Point2f(like.cell_m, like.cell_m), samples_per_tx=max(samples // 2, 1),
                max_depth=DEPTH, diffuse_reflection=True, refraction=False, seed=2 * seed + k,
            )  # fmt: skip
            total += 0.5 * np.asarray(found.path_gain.numpy(), np.float64)[0]
        return total

    return gain


def errors(values: np.ndarray, truth: np.ndarray, counted: np.ndarray, seen: np.ndarray) -> Row:
    """Errors of a map [dB] over the cells ``counted``, arrays (Y, X): rms, median, rms with line of sight and without."""
    lowest = np.median(truth[counted]) * 10.0 ** (-LOWEST_DB / 10.0)
    gap = 10.0 * np.log10(np.maximum(np.nan_to_num(values), lowest) / np.maximum(truth, lowest))
    parts = {"rms_seen_db": gap[counted & seen], "rms_blocked_db": gap[counted & ~seen]}
    some = {name: rms(part) if len(part) else None for name, part in parts.items()}
    return {"rms_db": rms(gap[counted]), "median_db": float(np.median(np.abs(gap[counted]))), **some}


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """Our maps, then Sionna's, against the reference."""
    (truth,), place = options.load(), options.place(fits.job.device)
    room, field = place.scene, fits.fit(place.reconstruction, truth.train(truth.few))
    low, high = np.floor(room.bounds[0] / options.cell), np.ceil(room.bounds[1] / options.cell)
    asked = {"bounds": options.cell * np.concatenate([low[:2], high[:2]])}
    field.radio_map(options.height, 8.0 * options.cell)  # kernels are loaded, the transmitter's part is made
    orders = sorted({field.effects.mirrors, min(field.effects.mirrors, 2)})
    ours: list[tuple[Row, RadioMap]] = []
    for order in orders:
        for n in options.rows_of_rays:
            started = time.process_time()
            found = field.radio_map(
                options.height, options.cell, shape=(n, 2 * n), mirror_order=order, **asked
            )
            spent = time.process_time() - started
            ours.append(
                ({"part": "ours", "rays": 8 * n * n, "mirrors": order, "average": 1, "core_s": spent}, found)
            )
    finest = ours[-1][1]
    gain = solver(room, finest, field.frequency_hz)

    def solved() -> dict[str, np.ndarray]:
        runs = max(1, -(-options.reference // AT_ONCE))
        return {"gain": np.mean([gain(options.reference // runs, 10_000 + k) for k in range(runs)], axis=0)}

    inputs = [fits.key, options.reference, options.height, finest.x, finest.y]
    reference = fits.steps.arrays("reference", solved, version=DEPTH, inputs=inputs)["gain"]
    places = finest.positions.reshape(-1, 3)
    air = room.is_free(places, clearance_m=options.cell / np.sqrt(2.0)).reshape(reference.shape)
    counted = air & finest.free & (reference > 0)
    seen = room.mesh.visible(np.broadcast_to(finest.transmitter, places.shape).copy(), places).reshape(
        air.shape
    )
    for row, found in ours:
        yield {**row, **errors(found.total_path_gain, reference, counted, seen)}
    for samples in options.samples:
        gain(samples, 1)  # kernels are compiled for this size
        started = time.process_time()
        values = gain(samples, 2)
        spent = time.process_time() - started
        yield {
            "part": "sionna",
            "samples": samples,
            "core_s": spent,
            **errors(values, reference, counted, seen),
        }
    caption = "Our field, RadioMapSolver's reference, and their difference."
    fits.pictures["radio_map.png"] = partial(_picture, finest, reference, counted), caption


def _picture(ours: RadioMap, truth: np.ndarray, counted: np.ndarray) -> Any:
    """Both maps and their difference."""
    figure, axes = figure_of(3, (15.0, 4.2))
    shown, reference = (10.0 * np.log10(np.where(counted, v, np.nan)) for v in (ours.total_path_gain, truth))
    low, high = np.nanpercentile(reference, [0.5, 99.5])
    half = 0.5 * ours.cell_m
    box = (ours.x[0] - half, ours.x[-1] + half, ours.y[0] - half, ours.y[-1] + half)
    gain = {"vmin": low, "vmax": high, "cmap": "viridis"}
    for ax, values, name, look in (
        (axes[0], shown, "our field", gain),
        (axes[1], reference, "RadioMapSolver, reference", gain),
        (axes[2], shown - reference, "difference", {"vmin": -6, "vmax": 6, "cmap": "RdBu_r"}),
    ):
        image = ax.imshow(values, extent=box, origin="lower", interpolation="nearest", **look)
        ax.set_title(name, fontsize=10)
        ax.plot(*ours.outline.transpose(2, 1, 0), color="#222222", linewidth=0.8)
        ax.plot(*ours.transmitter[:2], marker="*", markersize=13, color="#d7263d", markeredgecolor="white")
        ax.set_xlabel("x [m]")
        if ax is not axes[0]:
            figure.colorbar(image, ax=ax, label="[dB]", shrink=0.8)
    axes[0].set_ylabel("y [m]")
    return figure


ABOUT = "Total path gain over the floor plan, against RadioMapSolver with very many samples."
BENCHMARKS = {"map": experiment("map", Options, rows, COLUMNS, ABOUT, HELP)}
