"""Measurements by others: pictures of an array over carriers (myWideGS)."""

from __future__ import annotations

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
Data of others, which you fetch yourself (github.com/KINGAZ1019/myWideGS, folder data/example1).

50 transmitters, 10 carriers, one array, a mesh. Which way its axes point is found from line of sight. A field of each carrier
is fitted to 40 transmitters, and predicts the others.

examples:
  python -m benchmarks outside --pictures myWideGS/data/example1
"""

CARRIERS_GHZ = (1, 2.4, 5, 10, 24.25, 37, 47, 60, 77, 94)
SENDERS = 50
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Positions of the pictures' tables, y up, in the axes of their mesh, z up."""
SHARP = wr.Effects(
    mirrors=2, scatterings=1, mirror_scatter=False, scatter_mirror=False, transmissions=0, diffractions=0
)
"""Of the pictures: what an array tells apart."""
PICTURES = (
    ("carrier_ghz", "carrier [GHz]", "{:g}"), ("line_of_sight", "line of sight, correlation", "{:.2f}"),
    ("nearest_db", "nearest [dB]", "{:.2f}"), ("mean_db", "mean picture [dB]", "{:.2f}"), ("field_db", "field [dB]", "{:.2f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        pictures: folder of the array's pictures.
        carriers: how many carriers.
    """

    pictures: str = option("myWideGS/data/example1", "folder of the array's pictures")
    carriers: int = option(len(CARRIERS_GHZ), "how many carriers")


def run(options: Options, job: Job) -> Report:
    """Read what is there, fit and score.

    Raises:
        FileNotFoundError, ValueError: naming the file that does not fit.
    """
    found = pictures(Path(options.pictures), options.carriers, job)
    figures = {"machine": machine(job.device), "pictures": found}
    return Report("outside", figures, "\n\n".join(["Data of others.", columns_table(PICTURES, found)]))


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


BENCHMARKS = {"outside": Benchmark("outside", Options, run, HELP)}
