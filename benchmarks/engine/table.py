"""The engine's speed against its error: spectra of more and more Gaussians beside rays cast at the mesh, and mesh rays.

The room is one of flat Gaussians (:mod:`benchmarks.engine.scenes`) whose gain varies over 60 dB. The error of an image is
the rms over pixels of its difference in dB on a floor 60 dB below the brightest pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

import warprrf as wr
from benchmarks.engine.rays import best_seconds, bumpy_sphere, ray_rows
from benchmarks.engine.scenes import RECEIVER, gain, gaussians, panorama, room_mesh
from benchmarks.machine import machine
from benchmarks.report import Report, Row, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import resolve
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.geometry.splats.rasterizer import RADIO, Rasterizer
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.spectrum import pixel_directions, to_db

HELP = """\
Times a spectrum of more and more Gaussians, with the error of as many discs that stand for the mesh, and mesh rays
against Embree's. For figures worth quoting leave the machine alone meanwhile.

examples:
  python -m benchmarks engine
"""
DEPTH_DB = 60.0  # the floor lies this far below the brightest pixel
GROWTH = (
    ("gaussians", "Gaussians", "{}"), ("seconds", "spectrum [s]", "{:.4g}"),
    ("error_rms_db", "discs: rms error [dB]", "{:.2g}"),
    ("range_error_median_m", "range error, median [m]", "{:.1e}"),
)  # fmt: skip
RAYS = (
    ("mesh", "mesh", "{}"), ("faces", "faces", "{}"), ("kind", "rays", "{}"), ("warp", "Warp's, over Embree", "{:.2f}"),
    ("chosen", "chosen, over Embree", "{:.2f}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the engine.

    Attributes:
        scene: scene whose mesh the rays are cast at, besides a bumpy sphere.
        gaussians: how many, one row each.
        shape: rows and columns of the spectra.
        rays, triangles: rays at once, and faces of the sphere.
        repeats: timed runs, of which the shortest counts.
    """

    scene: str = option("data/lobby/scene.xml", "scene that rays are cast at")
    gaussians: tuple[int, ...] = option(
        (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000), "how many"
    )
    shape: tuple[int, int] = (90, 180)
    rays: int = option(1_000_000, "rays at once")
    triangles: int = option(200_000, "faces of the sphere")
    repeats: int = option(5, "timed runs")


def run(options: Options, job: Job) -> Report:
    """Measure everything.

    Raises:
        ImportError: without Open3D.
    """
    growth = []
    for done, count in enumerate(options.gaussians):
        job.progress("growth", done, len(options.gaussians))
        growth.append(growth_row(count, options.shape, options.repeats, job))
    meshes = {"scene": Scene.load(options.scene).mesh, "bumpy sphere": bumpy_sphere(options.triangles)}
    rays = ray_rows(
        meshes,
        rays=options.rays,
        repeats=3 * options.repeats,
        seed=job.seed,
        device=job.device,
        progress=job.progress,
    )
    figures = {"machine": machine(job.device), "shape": options.shape, "growth": growth, "rays": rays}
    shown = [{**r, **{n: r[n]["over_bare"] for n in ("warp", "chosen")}} for r in rays]
    return Report("engine", figures, f"{columns_table(GROWTH, growth)}\n\n{columns_table(RAYS, shown)}")


def growth_row(count: int, shape: tuple[int, int], repeats: int, job: Job) -> Row:
    """What ``count`` Gaussians cost, and how well as many discs stand for the room.

    Returns:
        ``gaussians``; ``seconds`` of a spectrum of overlapping Gaussians that lie on the device; of the discs, against rays
        cast at the mesh: errors of the image, and ``range_error_median_m`` of the dominant disc's peak.
    """
    camera, on = panorama(*shape), resolve(job.device)
    raster, overlapping = Rasterizer(device=on, blending=RADIO), gaussians(count, job.seed)
    features = wp.array(gain(overlapping.means)[:, None], dtype=wp.float32, device=on)
    spectrum = partial(raster.rasterize, *raster.upload(overlapping), features, camera)
    mesh = room_mesh()
    discs = discs_on_mesh(mesh, count, seed=job.seed)
    image = wr.render(discs, camera, features=gain(discs.means)[:, None], blending=RADIO, device=on)
    hit = mesh.cast(np.asarray(RECEIVER), pixel_directions(shape).reshape(-1, 3), device=on)
    return {
        "gaussians": count,
        "seconds": best_seconds({"spectrum": lambda: spectrum().features.numpy()}, repeats)["spectrum"],
        **error_of(image.features[..., 0], gain(hit.point).reshape(shape)),
        "range_error_median_m": float(np.median(np.abs(image.peak - hit.t.reshape(shape)))),
    }


def error_of(image: np.ndarray, reference: np.ndarray) -> dict[str, Any]:
    """``error_rms_db`` and ``error_worst_db``, the largest."""
    floor = float(reference.max()) * 10 ** (-DEPTH_DB / 10)
    difference = to_db(image, floor) - to_db(reference, floor)
    return {
        "error_rms_db": float(np.sqrt(np.mean(difference**2))),
        "error_worst_db": float(np.abs(difference).max()),
    }


BENCHMARKS = {"engine": Benchmark("engine", Options, run, HELP)}
