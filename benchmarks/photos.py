"""Photos of any place: every eighth held out, rendered from where it was taken, compared with what it shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.machine import machine
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.geometry import pipeline as stage_1
from warprrf.geometry.photos.posed.photo_files import find_photos, read_photo
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import Blending
from warprrf.steps import Attempt, Steps

HELP = """\
Reconstructs the place with every eighth photo held out (those get a pose and nothing else), renders the held-out ones
and compares. A camera's exposure is no property of the place, so each held-out photo is compared after one affine
colour change (3 x 4, least squares) of its rendering, and as it is beside that.

examples:
  python -m benchmarks photos --photos fox/images --out runs/fox
"""

EVERY = 8
OPEN = 0.5  # a pixel that blocks less light than this is a hole
COLUMNS = (
    ("photo", "photo", "{}"), ("psnr_db", "PSNR [dB]", "{:.2f}"), ("ssim", "SSIM", "{:.3f}"),
    ("psnr_db_as_is", "as it is [dB]", "{:.2f}"), ("holes", "holes", "{:.1%}"),
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        photos: folder of photos.
        iterations: of the refinement; None: the library's default.
    """

    photos: str = option("photos", "folder of photos")
    iterations: int | None = option(None, "of the refinement", kind=int)


def run(options: Options, job: Job) -> Report:
    """Reconstruct, render the held-out photos, compare.

    Raises:
        ValueError: if the folder has too few photos, or none of the held-out ones could be posed.
    """
    named = find_photos(options.photos)
    held_out = list(named)[::EVERY]
    workspace = job.out / "workspace"

    def geometry(attempt: Attempt) -> dict[str, Any]:
        found = wr.reconstruct(
            options.photos, workspace=workspace, held_out=held_out, iterations=options.iterations, seed=job.seed,
            progress=attempt.progress, device=job.device,
        )  # fmt: skip
        found.save(job.out / "reconstruction")
        return {
            "photos": len(named), "unposed": list(found.unposed), "gaussians": len(found.gaussians),
            "faces": len(found.mesh.faces), "photo_size": [*_size(found.cameras)],
        }  # fmt: skip

    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        inputs = [list(named), list(named.values()), options.iterations, job.seed, stage_1.VERSIONS]
        figures = steps.run("geometry", geometry, version=1, inputs=inputs, outputs=["reconstruction"])
        compare = partial(compared, job, held_out)
        inputs = [steps.key("geometry")]
        figures |= steps.run("comparison", lambda attempt: compare(), version=1, inputs=inputs)
        figures |= {name: steps.records["geometry"][name] for name in ("seconds", "stages")}
    figures["machine"] = machine(job.device)
    return Report("photos", figures, summary(figures))


def compared(job: Job, held_out: list[str]) -> dict[str, Any]:
    """Held-out photos beside what is rendered from where they were taken."""
    place = wr.Reconstruction.load(job.out / "reconstruction")
    folder = job.out / "workspace" / "sfm" / "photos"
    rows = [
        {"photo": name} | score(place.gaussians, place.cameras[name], read_photo(folder / name), job.device)
        for name in held_out
        if name in place.cameras
    ]
    if not rows:
        raise ValueError(f"photos: none of the {len(held_out)} held-out photos could be posed")
    means = {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "photo"}
    return {"held_out": rows, **means}


def score(gaussians: Gaussians, camera: Camera, photo: np.ndarray, device: Any = None) -> dict[str, float]:
    """A photo ``(H, W, 3)`` in [0, 1] beside its rendering: PSNR [dB] and SSIM after an affine colour change, PSNR as it
    is, share of holes."""
    from skimage.metrics import structural_similarity

    seen = wr.render(gaussians, camera, blending=Blending(), device=device)
    shown = recoloured(seen.features, photo)
    similar = structural_similarity(
        shown, photo, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )  # fmt: skip
    return {
        "psnr_db": psnr(shown, photo), "ssim": float(similar),
        "psnr_db_as_is": psnr(np.clip(seen.features, 0, 1), photo), "holes": float((seen.alpha < OPEN).mean()),
    }  # fmt: skip


def recoloured(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """``image`` after the affine change of its colours (3 x 4) that brings it closest to ``photo``, in [0, 1]."""
    colors = np.c_[image.reshape(-1, 3), np.ones(image[..., 0].size)]
    change = np.linalg.lstsq(colors, photo.reshape(-1, 3), rcond=None)[0]
    return np.clip(colors @ change, 0, 1).reshape(photo.shape).astype(np.float32)


def psnr(image: np.ndarray, photo: np.ndarray) -> float:
    """Of images in [0, 1] [dB]."""
    return float(-10 * np.log10(max(np.mean((image.astype(np.float64) - photo) ** 2), 1e-12)))


def summary(figures: dict[str, Any]) -> str:
    """The tables."""
    width, height = figures["photo_size"]
    head = (
        f"{figures['photos']} photos, {len(figures['held_out'])} held out, compared at about {width} x {height}; "
        f"{figures['gaussians']} Gaussians, {figures['faces']} faces; photos to mesh {figures['seconds']:.0f} s"
    )
    times = [{"stage": stage, "seconds": seconds} for stage, seconds in figures["stages"].items()]
    rows = [*figures["held_out"], {"photo": "mean"} | {key: figures[key] for key, *_ in COLUMNS[1:]}]
    stages = columns_table((("stage", "stage", "{}"), ("seconds", "time [s]", "{:.1f}")), times)
    return f"{head}\n\n{columns_table(COLUMNS, rows)}\n\n{stages}"


def _size(cameras: dict[str, Camera]) -> tuple[int, int]:
    """Median width and height."""
    width, height = np.median([[c.width, c.height] for c in cameras.values()], axis=0)
    return int(width), int(height)


BENCHMARKS = {"photos": Benchmark("photos", Options, run, HELP)}
