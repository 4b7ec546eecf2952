"""What a field loses where a mesh has neither names nor colours, or comes from a scanner, against the scene with names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA, Truth
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import require
from warprrf.rf.spectra import metrics

HELP = """\
Fits the bistatic field on the true mesh with the names of its materials, on the same mesh without them, and on a scan
of it: faces of a few centimetres that were seen from the receivers, errors of their vertices, holes.

examples:
  python -m benchmarks bare-mesh
  python -m benchmarks bare-mesh --truths spectra.nc --counts 10 --every 5     a first look, in minutes
"""

OFF_M = 1e-4  # sight lines end this far before a face
COLUMNS = (
    ("mesh", "mesh", "{}"), ("truth", "truth", "{}"), ("n_train", "spectra", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"),
    ("lost_db", "lost [dB]", "{:.2f}"), ("psnr_db_blocked", "where blocked [dB]", "{:.2f}"),
    ("groups", "pieces", "{}"), ("materials", "materials", "{}"), ("fit_s", "fit [s]", "{:.1f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        scene: true scene (XML).
        truths: spectra (NetCDF), each in a file.
        counts: training receivers.
        every: each how-manieth test receiver counts.
        edge_m: longest edge of a scan's faces.
        error_m: rms of the errors of its vertices.
        holes: how many it has, up to 30 cm in radius.
    """

    scene: str = option(str(Path(DATA) / "scene.xml"), "true scene (XML)")
    truths: tuple[str, ...] = option((str(Path(DATA) / "spectra_sionna.nc"),), "files of spectra (NetCDF)")
    counts: tuple[int, ...] = option((10, 50), "training receivers")
    every: int = option(1, "each how-manieth test receiver counts")
    edge_m: float = option(0.07, "longest edge of a scan's faces")
    error_m: float = option(0.02, "rms of the errors of its vertices")
    holes: int = option(60, "holes of a scan")


def scanned(mesh: wr.Mesh, places: np.ndarray, options: Options, seed: int) -> wr.Mesh:
    """``mesh`` as a scanner gives it that stood at each of ``places`` (N, 3)."""
    r, remesh = np.random.default_rng(seed), require("trimesh.remesh", extra="mesh")
    vertices, faces = remesh.subdivide_to_size(mesh.vertices, mesh.faces, options.edge_m, max_iter=20)
    place, index = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    fine = wr.Mesh(place, index.reshape(-1)[faces])
    centre, seen = fine.triangles.mean(axis=1), np.zeros(len(fine.faces), bool)
    for scanner in places:
        front = np.flatnonzero(~seen & (np.einsum("fi,fi->f", scanner - centre, fine.face_normals) > 0))
        ends = np.broadcast_to(scanner, (len(front), 3))
        seen[front] = mesh.visible(centre[front] + OFF_M * fine.face_normals[front], ends)
    for k in r.integers(0, len(centre), options.holes):
        seen &= np.linalg.norm(centre - centre[k], axis=1) > 0.3 * r.uniform(0.3, 1.0)
    used, faces = np.unique(fine.faces[seen], return_inverse=True)
    noise = options.error_m / np.sqrt(3.0) * r.normal(size=(len(used), 3))
    return wr.Mesh(fine.vertices[used] + noise, faces.reshape(-1, 3))


def run(options: Options, job: Job) -> Report:
    """Fit and compare.

    Raises:
        FileNotFoundError, ValueError: as the scene and the spectra do.
    """
    scene = wr.Scene.load(options.scene)
    rows: list[dict[str, Any]] = []
    for file in options.truths:
        truth = Truth.load(Path(file), options.counts, options.every)
        places = np.concatenate([truth.data.transmitter[None], truth.data.receivers[::4]])
        meshes: dict[str, Any] = {
            "named": scene,
            "bare": wr.Mesh(scene.mesh.vertices, scene.mesh.faces),
            "scan": scanned(scene.mesh, places, options, job.seed),
        }
        for count in truth.counts:
            for name, geometry in meshes.items():
                field: Any = wr.RadioField.fit(
                    geometry, truth.train(count), device=job.device, progress=job.progress
                )
                found = metrics.evaluate(truth.test, field.spectrum, progress=job.progress)
                row = {"mesh": name, "truth": truth.name, "n_train": count, **found}
                row |= {key: field.report[key] for key in ("groups", "materials", "elements", "choices")}
                row["fit_s"] = field.report["fit_time_s"]
                rows.append(row)
                named = next(r for r in rows if (r["truth"], r["n_train"]) == (truth.name, count))
                row["lost_db"] = named["psnr_db"] - row["psnr_db"]
    text = (
        f"Bistatic field on the lobby's true mesh: with its materials' names, without, and scanned (errors of "
        f"{1e3 * options.error_m:.0f} mm rms, {options.holes} holes).\n\n{columns_table(COLUMNS, rows)}"
    )
    return Report("bare_mesh", {"error_m": options.error_m, "holes": options.holes, "rows": rows}, text)


BENCHMARKS = {"bare-mesh": Benchmark("bare-mesh", Options, run, HELP)}
