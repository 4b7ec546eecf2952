"""Measurements by others: pictures of an array over carriers (myWideGS), and received power in a furnished flat."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.arrays import normalised, psnr
from benchmarks.machine import machine
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.rf.fields.bistatic.field import BistaticField

HELP = """\
Data of others, which you fetch yourself (github.com/KINGAZ1019/myWideGS, folder data/example1; github.com/marckolak/
ble-rss-fingerprints-calib2021).

Pictures: 50 transmitters, 10 carriers, one array, a mesh. Which way its axes point is found from line of sight. A field of each
carrier is fitted to 40 transmitters, and predicts the others.

Flat: five anchors' received power is fitted, the sixth's is predicted, each in turn.

examples:
  python -m benchmarks outside --pictures myWideGS/data/example1 --flat ble-rss-fingerprints-calib2021
"""

CARRIERS_GHZ = (1, 2.4, 5, 10, 24.25, 37, 47, 60, 77, 94)
SENDERS = 50
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Positions of the pictures' tables, y up, in the axes of their mesh, z up."""
HEIGHT_M, TAG_M = 2.7, 1.3  # of the flat's ceiling (assumed), and of the tag on its robot (stated)
CELL_M = 0.5  # readings in a cell are averaged: it holds several wavelengths
FLOOR_DBM = -100.0
SHARP = wr.Effects(mirrors=2, scatterings=1, mirror_scatter=False, scatter_mirror=False)
"""Of the pictures: what an array tells apart."""
FURTHER = wr.Effects(mirrors=2, scatter_mirror=False)
"""Of the flat: power comes round corners."""
PICTURES = (
    ("carrier_ghz", "carrier [GHz]", "{:g}"), ("line_of_sight", "line of sight, correlation", "{:.2f}"),
    ("nearest_db", "nearest [dB]", "{:.2f}"), ("mean_db", "mean picture [dB]", "{:.2f}"), ("field_db", "field [dB]", "{:.2f}"),
)  # fmt: skip
FLAT = (
    ("anchor", "anchor", "{}"), ("field_db", "field, rms [dB]", "{:.1f}"), ("log_distance_db", "log-distance", "{:.1f}"),
    ("nearest_db", "nearest reading", "{:.1f}"), ("field_seen_db", "field where seen", "{:.1f}"),
    ("field_blocked_db", "behind walls", "{:.1f}"), ("field_blocked_bias_db", "behind walls, mean", "{:+.1f}"),
    ("dark_blocked", "behind walls, without any path", "{:.0%}"),
    ("log_distance_blocked_db", "log-distance behind walls", "{:.1f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        pictures: folder of the array's pictures; empty for none.
        flat: folder of the flat; empty for none.
        carriers: how many carriers.
        anchors: how many anchors in turn.
    """

    pictures: str = option("", "folder of the array's pictures")
    flat: str = option("", "folder of the flat")
    carriers: int = option(len(CARRIERS_GHZ), "how many carriers")
    anchors: int = option(6, "how many anchors are predicted in turn")


def run(options: Options, job: Job) -> Report:
    """Read what is there, fit and score.

    Raises:
        FileNotFoundError, ValueError: naming the file that does not fit.
    """
    figures: dict[str, Any] = {"machine": machine(job.device)}
    parts = ["Data of others."]
    if options.pictures:
        figures["pictures"] = pictures(Path(options.pictures), options.carriers, job)
        parts.append(columns_table(PICTURES, figures["pictures"]))
    if options.flat:
        figures["flat"] = flat(Path(options.flat), options.anchors, job)
        parts.append(columns_table(FLAT, figures["flat"]))
    return Report("outside", figures, "\n\n".join(parts))


def pictures(folder: Path, carriers: int, job: Job) -> list[dict[str, Any]]:
    """A row for each carrier.

    Rows of a picture are zeniths from 0 to 89 degrees, columns azimuths from 0.5 to 359.5; they are alike at azimuths a and
    180 - a, so that the array lies across their x. Of all ways to permute and reverse axes, line of sight agrees with one
    best (correlation 0.79 in front of the array, the next 0.60): x, -y, z of the tables; the gateway is at (2, 1, 0) there.
    """
    zenith, azimuth = np.radians(np.arange(90.0))[:, None], np.radians(np.arange(360) + 0.5)[None]
    own = np.stack(
        np.broadcast_arrays(
            np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)
        ),
        axis=-1,
    )
    directions = own * [1.0, -1.0, 1.0] @ TURN.T
    array = wr.PlanarArray(4, 4)  # in y and z of the mesh as of the tables
    data = wr.channel.ArraySpectra.load(folder, frequency_hz=1e9, array=array, directions=directions)
    data = replace(data, transmitters=data.transmitters @ TURN.T, receivers=data.receivers @ TURN.T)
    mesh = wr.Mesh.load(folder / "point_cloud.ply")
    train = np.sort(np.random.default_rng(job.seed).permutation(SENDERS)[: SENDERS * 4 // 5])
    test = np.setdiff1d(np.arange(SENDERS), train)
    rows = []
    for k, carrier in enumerate(CARRIERS_GHZ[:carriers]):
        part = replace(data.subset(SENDERS * k + np.arange(SENDERS)), frequency_hz=carrier * 1e9)
        known, asked = part.subset(train), part.subset(test)
        between = np.linalg.norm(asked.transmitters[:, None] - known.transmitters, axis=2)
        field = BistaticField.fit(
            mesh, known, quick=True, effects=SHARP, device=job.device, progress=job.progress
        )
        found = normalised(
            np.stack(
                [field.array_spectrum(part.receivers[0], array, directions, t) for t in asked.transmitters]
            )
        )
        away = part.transmitters - part.receivers
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        straight = (
            np.abs(
                np.einsum("hwm,sm->shw", array.response(directions, 1.0).conj(), array.response(away, 1.0))
            )
            ** 2
        )
        front = np.flatnonzero(away[:, 1] < 0)
        mean = np.broadcast_to(normalised(known.power.mean(axis=0)), asked.power.shape)
        rows.append(
            {
                "carrier_ghz": carrier,
                "line_of_sight": float(
                    np.mean([np.corrcoef(straight[s].ravel(), part.power[s].ravel())[0, 1] for s in front])
                ),
                "nearest_db": float(psnr(known.power[between.argmin(axis=1)], asked.power).mean()),
                "mean_db": float(psnr(mean, asked.power).mean()),
                "field_db": float(psnr(found, asked.power).mean()),
            }
        )
    return rows


def walls(corners: np.ndarray, height_m: float) -> wr.Mesh:
    """A flat of one outline (N, 2) with right angles: walls along it, floor and ceiling inside."""
    vertices: list[list[float]] = []

    def quad(points: list[list[float]]) -> None:
        vertices.extend(points)

    ends = np.roll(corners, -1, axis=0)
    for (ax, ay), (bx, by) in zip(corners, ends, strict=True):
        if (ax, ay) != (bx, by):
            quad([[ax, ay, 0.0], [bx, by, 0.0], [bx, by, height_m], [ax, ay, height_m]])
    xs, ys = (np.unique(corners[:, axis]) for axis in (0, 1))
    for x0, x1 in zip(xs[:-1], xs[1:], strict=True):
        for y0, y1 in zip(ys[:-1], ys[1:], strict=True):
            if inside(corners, np.array([[0.5 * (x0 + x1), 0.5 * (y0 + y1)]]))[0]:
                for z in (0.0, height_m):
                    quad([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    first = 4 * np.arange(len(vertices) // 4)[:, None, None]
    return wr.Mesh(np.array(vertices), (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3))


def inside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether ``points`` (N, 2) are within the outline."""
    ends = np.roll(corners, -1, axis=0)
    a, b = corners[None], ends[None]
    crossed = (a[..., 1] > points[:, None, 1]) != (b[..., 1] > points[:, None, 1])
    rise = np.where(b[..., 1] == a[..., 1], 1.0, b[..., 1] - a[..., 1])
    at = a[..., 0] + (points[:, None, 1] - a[..., 1]) / rise * (b[..., 0] - a[..., 0])
    return np.asarray((crossed & (points[:, None, 0] < at)).sum(axis=1) % 2 == 1)


def table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a CSV file by name; empty cells are NaN."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0] if name}


def flat(folder: Path, anchors: int, job: Job) -> list[dict[str, Any]]:
    """A row for each anchor that is predicted from the others."""
    outline = np.column_stack([table(folder / "layout.csv")[axis] for axis in "xy"])
    at = table(folder / "anchors.csv")
    places = np.column_stack([at[axis] for axis in "xyz"])
    read = table(folder / "calibration" / "calibration_df.csv")
    spots = np.column_stack([read["x"], read["y"], np.full(len(read["x"]), TAG_M)])
    level = np.column_stack([read[f"rssi_{k + 1}"] for k in range(len(places))])
    cells, own = np.unique(np.floor(spots[:, :2] / CELL_M), axis=0, return_inverse=True)
    own = own.reshape(-1)
    mesh = walls(outline, HEIGHT_M)
    centre, mean = np.zeros((len(cells), 3)), np.full((len(cells), len(places)), np.nan)
    for c in range(len(cells)):
        centre[c] = spots[own == c].mean(axis=0)
        power = 10.0 ** (level[own == c] / 10.0)
        heard = np.isfinite(power).sum(axis=0) >= 3
        mean[c, heard] = np.nanmean(power[:, heard], axis=0)
    free = inside(outline, centre[:, :2]) & (mesh.distance(centre) > 0.15)
    centre, mean = centre[free], mean[free]
    rows = []
    for out in range(min(anchors, len(places))):
        rows.append({"anchor": out + 1} | _predicted(mesh, places, centre, mean, out, job))
    each = {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "anchor"}
    return [*rows, {"anchor": "mean", **each}]


def _predicted(
    mesh: wr.Mesh, places: np.ndarray, spots: np.ndarray, power: np.ndarray, out: int, job: Job
) -> dict[str, float]:
    """Errors [dB] at anchor ``out`` of what was fitted to the others."""
    others = [k for k in range(len(places)) if k != out]
    sender = np.repeat(places[others], len(spots), axis=0)
    receiver, measured = np.tile(spots, (len(others), 1)), power[:, others].T.ravel()
    heard = np.isfinite(measured)
    readings = wr.Readings(
        sender[heard], receiver[heard], measured[heard], 2.45e9, 10.0 ** (FLOOR_DBM / 10.0), chain=["ble"] * int(heard.sum()),
        samples=6,
    )  # fmt: skip
    field = BistaticField.fit(
        mesh, readings, quick=True, effects=FURTHER, device=job.device, progress=job.progress
    )
    asked = np.isfinite(power[:, out])
    spots, truth = spots[asked], 10.0 * np.log10(power[asked, out])
    gain_db = field.report["chains"]["ble"]["gain_db"]
    gain = field.links(spots, places[out]).total_path_gain
    field_db = np.maximum(gain_db + 10.0 * np.log10(np.maximum(gain, 1e-30)), FLOOR_DBM)
    distance = np.linalg.norm(receiver - sender, axis=1)[heard]
    law = np.polyfit(np.log10(distance), 10.0 * np.log10(measured[heard]), 1)
    log_distance = np.polyval(law, np.log10(np.linalg.norm(spots - places[out], axis=1)))
    near = others[int(np.linalg.norm(places[others] - places[out], axis=1).argmin())]
    nearest = 10.0 * np.log10(power[asked, near])
    seen = mesh.visible(spots, np.broadcast_to(places[out], spots.shape))

    def rms(error: np.ndarray) -> float:
        return float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else float("nan")

    return {
        "field_db": rms(field_db - truth),
        "log_distance_db": rms(log_distance - truth),
        "nearest_db": rms(nearest - truth),
        "field_seen_db": rms((field_db - truth)[seen]),
        "field_blocked_db": rms((field_db - truth)[~seen]),
        "field_blocked_bias_db": float(np.mean((field_db - truth)[~seen])),
        "dark_blocked": float(np.mean(gain[~seen] == 0.0)),
        "log_distance_blocked_db": rms((log_distance - truth)[~seen]),
    }


BENCHMARKS = {"outside": Benchmark("outside", Options, run, HELP)}
