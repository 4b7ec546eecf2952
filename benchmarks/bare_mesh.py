"""What a field loses where a mesh has neither names nor colours, or comes from a scanner, against the scene with names."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fits import FitOptions, Fits, experiment
from benchmarks.report import Row
from benchmarks.runner import option
from warprrf.device import require

HELP = """\
Fits the bistatic field on the true mesh with the names of its materials, on the same mesh without them, and on a scan
of it: faces of a few centimetres that were seen from the receivers, errors of their vertices, holes.

examples:
  python -m benchmarks bare-mesh
  python -m benchmarks bare-mesh --truths exact --counts 10 --every 5      a first look, in minutes
  python -m benchmarks bare-mesh --data room.nc --scene room.xml           another room
"""

OFF_M = 1e-4  # sight lines end this far before a face
HOLE_M = 0.3  # largest radius of a hole
COLUMNS = {
    "rows": (
        ("room", "room", "{}"), ("truth", "truth", "{}"), ("n_train", "spectra", "{}"), ("mesh", "mesh", "{}"),
        ("psnr_db", "PSNR [dB]", "{:.2f}"), ("lost_db", "lost [dB]", "{:.2f}"),
        ("psnr_db_blocked", "where blocked [dB]", "{:.2f}"),
    )
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options(FitOptions):
    """Options of the comparison.

    Attributes:
        edge_m: longest edge of a scan's faces.
        error_m: rms of the errors of its vertices.
        holes: how many it has, up to 30 cm in radius.
    """

    edge_m: float = option(0.07, "longest edge of a scan's faces")
    error_m: float = option(0.02, "rms of the errors of its vertices")
    holes: int = option(60, "holes of a scan")


def scanned(mesh: wr.Mesh, places: np.ndarray, options: Options, seed: int) -> wr.Mesh:
    """``mesh`` as a scanner gives it that stood at each of ``places`` (N, 3)."""
    r, remesh = np.random.default_rng(seed), require("trimesh.remesh", extra="test")
    vertices, faces = remesh.subdivide_to_size(mesh.vertices, mesh.faces, options.edge_m, max_iter=20)
    place, index = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    fine = wr.Mesh(place, index.reshape(-1)[faces])
    centre, seen = fine.triangles.mean(axis=1), np.zeros(len(fine.faces), bool)
    for scanner in places:
        front = np.flatnonzero(~seen & (np.einsum("fi,fi->f", scanner - centre, fine.face_normals) > 0))
        ends = np.broadcast_to(scanner, (len(front), 3))
        seen[front] = mesh.visible(centre[front] + OFF_M * fine.face_normals[front], ends)
    for k in r.integers(0, len(centre), options.holes):
        seen &= np.linalg.norm(centre - centre[k], axis=1) > HOLE_M * r.uniform(0.3, 1.0)
    used, faces = np.unique(fine.faces[seen], return_inverse=True)
    noise = options.error_m / np.sqrt(3.0) * r.normal(size=(len(used), 3))
    return wr.Mesh(fine.vertices[used] + noise, faces.reshape(-1, 3))


def rows(options: Options, fits: Fits) -> Iterator[Row]:
    """A row for each truth, number of training receivers and mesh."""
    scene = wr.Scene.load(options.xml)
    for truth in options.load():
        places = np.concatenate([truth.data.transmitter[None], truth.data.receivers[::4]])
        meshes: dict[str, Any] = {
            "named": scene,
            "bare": wr.Mesh(scene.mesh.vertices, scene.mesh.faces),
            "scan": scanned(scene.mesh, places, options, fits.job.seed),
        }
        for count in truth.counts:
            named = 0.0
            for name, geometry in meshes.items():
                make = partial(fits.scored, geometry, truth.train(count), truth.test)
                row = fits.row(
                    f"{truth.name} {count} {name}", make, options.edge_m, options.error_m, options.holes
                )
                named = row["psnr_db"] if name == "named" else named
                about = {"room": options.xml.resolve().parent.name, "mesh": name, "truth": truth.name}
                yield {**about, "n_train": count, **row, "lost_db": named - row["psnr_db"]}


ABOUT = "Bistatic field on a room's true mesh: with its materials' names, without, and scanned."
BENCHMARKS = {"bare-mesh": experiment("bare-mesh", Options, rows, COLUMNS, ABOUT, HELP)}
