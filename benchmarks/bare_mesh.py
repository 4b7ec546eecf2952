"""What a field loses where a mesh has neither names nor colours, or comes from a scanner, against the scene with names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import DATA, Truth
from benchmarks.lobby.spectra import FILES, SHAPE
from benchmarks.machine import machine
from benchmarks.newrf_rays import load_newrf
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import require
from warprrf.geometry.mesh import components, edge_pairs
from warprrf.rf.fields.bistatic.training import trace
from warprrf.rf.spectra import metrics
from warprrf.rf.spectra.dataset import assign_roles
from warprrf.steps import digest

HELP = """\
Fits the bistatic field on the true mesh with the names of its materials, on the same mesh without them, and on a scan
of it: faces of a few centimetres that were seen from the receivers, errors of their vertices, holes.

examples:
  python -m benchmarks bare-mesh
  python -m benchmarks bare-mesh --room shared/external/newrf     beside it, a room that was not made here
  python -m benchmarks bare-mesh --truths spectra.nc --counts 10 --every 5     a first look, in minutes
"""

OFF_M = 1e-4  # sight lines end this far before a face
LEFT_OUT = ("per_receiver", "seconds_per_spectrum")  # of a report's figures
TESTED = 40  # receivers in another room
MATERIALS = (
    wr.Material.custom("carpet", relative_permittivity=2.0, conductivity=0.5, scattering=0.9),
    wr.Material.custom("ceiling board", relative_permittivity=1.5, conductivity=0.2, scattering=0.7),
    wr.Material.custom("plaster", relative_permittivity=2.8, conductivity=0.7, scattering=0.5),
    wr.Material.custom("wood", relative_permittivity=2.0, conductivity=1.5, scattering=0.6),
    wr.Material.conductor(scattering=0.3),
)
"""Of another room's floor, ceiling and walls, and of the things in it."""
COLUMNS = (
    ("room", "room", "{}"), ("truth", "truth", "{}"), ("n_train", "spectra", "{}"), ("mesh", "mesh", "{}"),
    ("psnr_db", "PSNR [dB]", "{:.2f}"), ("lost_db", "lost [dB]", "{:.2f}"),
    ("psnr_db_blocked", "where blocked [dB]", "{:.2f}"), ("groups", "pieces", "{}"), ("materials", "materials", "{}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        scene: true scene (XML).
        truths: spectra (NetCDF), each in a file.
        room: folder of NeWRF's conference room (see :mod:`benchmarks.newrf_rays`), whose parts get materials.
        counts: training receivers.
        every: each how-manieth test receiver counts.
        edge_m: longest edge of a scan's faces.
        error_m: rms of the errors of its vertices.
        holes: how many it has, up to 30 cm in radius.
    """

    scene: str = option(str(Path(DATA) / "scene.xml"), "true scene (XML)")
    truths: tuple[str, ...] = option(
        tuple(str(Path(DATA) / file) for file in FILES.values()), "files of spectra (NetCDF)"
    )
    room: str = option(
        "", "folder of NeWRF's conference room, which gets materials by part and exact spectra"
    )
    counts: tuple[int, ...] = option((10, 50), "training receivers")
    every: int = option(1, "each how-manieth test receiver counts")
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
        seen &= np.linalg.norm(centre - centre[k], axis=1) > 0.3 * r.uniform(0.3, 1.0)
    used, faces = np.unique(fine.faces[seen], return_inverse=True)
    noise = options.error_m / np.sqrt(3.0) * r.normal(size=(len(used), 3))
    return wr.Mesh(fine.vertices[used] + noise, faces.reshape(-1, 3))


def named_by_part(mesh: wr.Mesh, materials: Sequence[wr.Material] = MATERIALS) -> wr.Scene:
    """``mesh`` with a material for its floor, ceiling and walls, and one for each size of the things in it."""
    part = components(len(mesh.faces), edge_pairs(mesh.welded_faces))
    area = np.bincount(part, mesh.areas)
    things = 3 + np.unique(np.round(area, 2), return_inverse=True)[1].reshape(-1) % (len(materials) - 3)
    upward = mesh.face_normals[:, 2]
    low = mesh.triangles[:, :, 2].max(axis=1) < mesh.center[2]
    side = np.where(np.abs(upward) < 0.5, 2, np.where(low, 0, 1))
    return wr.Scene(mesh, materials, np.where(part == area.argmax(), side, things[part]))


def furnished(folder: str, options: Options, job: Job) -> tuple[wr.Scene, Truth]:
    """NeWRF's conference room in ``folder``, its materials drawn by part, and exact spectra at some of its receivers."""
    rays = load_newrf(folder)
    scene, count = named_by_part(rays.mesh), max(options.counts) + TESTED
    low, high = scene.mesh.bounds
    ds = wr.simulate(
        scene,
        transmitter=low + [0.9, 0.9, 0.9] * (high - low),
        receivers=np.random.default_rng(job.seed).permutation(rays.receivers)[:count],
        frequency_hz=300e9,
        shape=SHAPE,
        engine="exact",
        roles=assign_roles(count, test=TESTED, seed=job.seed),
        device=job.device,
        progress=job.progress,
    )
    return scene, Truth(ds.engine, digest(Path(folder)), ds, tuple(sorted(options.counts)), (), 1)


def compare(room: str, scene: wr.Scene, truth: Truth, options: Options, job: Job) -> list[dict[str, Any]]:
    """A row for each mesh and number of training receivers."""
    places = np.concatenate([truth.data.transmitter[None], truth.data.receivers[::4]])
    meshes: dict[str, Any] = {
        "named": scene,
        "bare": wr.Mesh(scene.mesh.vertices, scene.mesh.faces),
        "scan": scanned(scene.mesh, places, options, job.seed),
    }
    rows: list[dict[str, Any]] = []
    for name, geometry in meshes.items():
        seen = trace(geometry, truth.train(max(truth.counts)), device=job.device, progress=job.progress)
        for count in truth.counts:
            field: Any = wr.RadioField.fit(
                seen.surface,
                truth.train(count),
                transport=seen.subset(range(count)),
                device=job.device,
                progress=job.progress,
            )
            found = metrics.evaluate(truth.test, field.spectrum, progress=job.progress)
            figures = {key: value for key, value in found.items() if key not in LEFT_OUT}
            row = {"room": room, "mesh": name, "truth": truth.name, "n_train": count, **figures}
            row |= {key: field.report[key] for key in ("groups", "materials", "elements", "choices")}
            rows.append(row)
            named = next(r for r in rows if r["n_train"] == count)
            row["lost_db"] = named["psnr_db"] - row["psnr_db"]
    return rows


def run(options: Options, job: Job) -> Report:
    """Fit and compare.

    Raises:
        FileNotFoundError, ValueError: as the scene, the room and the spectra do.
    """
    scene = wr.Scene.load(options.scene)
    cases = [
        ("lobby", scene, Truth.load(Path(file), options.counts, options.every)) for file in options.truths
    ]
    if options.room:
        cases.append(("conference room", *furnished(options.room, options, job)))
    rows = [row for room, place, truth in cases for row in compare(room, place, truth, options, job)]
    about = {"machine": machine(job.device), "error_m": options.error_m, "holes": options.holes}
    text = (
        f"Bistatic field on a room's true mesh: with its materials' names, without, and scanned (errors of "
        f"{1e3 * options.error_m:.0f} mm rms, {options.holes} holes).\n\n{columns_table(COLUMNS, rows)}"
    )
    return Report("bare_mesh", {**about, "rows": rows}, text)


BENCHMARKS = {"bare-mesh": Benchmark("bare-mesh", Options, run, HELP)}
