"""What every stage of the reconstruction from photos is worth: each off, one at a time, on films and drawn rooms.

The reference is the fused depth of an RGB-D camera (:mod:`benchmarks.filmed`), or the scene that the photos were
rendered from. Everything is compared where reference rays meet a surface, after the mesh was laid on it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.filmed import Film, laid_on, score
from benchmarks.lobby.photos import read_poses
from benchmarks.lobby.pipeline import photos as lobby_photos
from benchmarks.report import Report, columns_table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import Progress
from warprrf.files import read_json
from warprrf.geometry import pipeline as stage_1
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.steps import Attempt, Steps

HELP = """\
Reconstructs each room as it is and with one stage off, and measures what that changes. Structure from motion is done
once a room. Rooms are folders of RGB-D frames (see `filmed`) or of the lobby's kind.

examples:
  python -m benchmarks stage1 --rooms data/redkitchen data/lobby data/lobby_plain
  python -m benchmarks stage1 --rooms data/redkitchen --photos 60 --off stereo
"""

FULL = ReconstructionConfig()
STAGES: Mapping[str, tuple[ReconstructionConfig, tuple[str, ...]]] = {
    "nothing": (FULL, ()),
    "sweep": (replace(FULL, sweep=False), ("photos.gaussians.sweep",)),
    "segments": (replace(FULL, segments=False), ("photos.surface.segments",)),
    "plain": (replace(FULL, plain=False), ("photos.gaussians.plain", "photos.gaussians.edges")),
    "refine": (
        replace(FULL, refine=replace(FULL.refine, iterations=1)),
        ("photos.gaussians.refine", "photos.gaussians.densify"),
    ),
    "stereo": (replace(FULL, stereo=False), ("photos.surface.stereo",)),
    "completion": (
        replace(FULL, completion=False),
        tuple(f"photos.surface.{name}" for name in ("completion", "boxes")),
    ),
}
"""What is off: the configuration without it, and the modules below ``warprrf.geometry`` that it takes."""

FUSED = 500  # depth maps are enough for a reference
STRIDE = 16  # every so many-th pixel of a drawn photo, along rows and columns, is a ray of its reference
COLUMNS = (
    ("room", "room", "{}"), ("off", "without", "{}"), ("posed", "posed", "{}"),
    ("f_5_cm", "F at 5 cm", "{:.3f}"), ("distance_median_m", "median [m]", "{:.4f}"),
    ("distance_p90_m", "p90 [m]", "{:.4f}"), ("normal_median_deg", "normals [degrees]", "{:.2f}"),
    ("holes", "holes", "{:.1%}"), ("seconds", "time [s]", "{:.0f}"), ("lines", "its lines", "{}"),
)  # fmt: skip
Rays = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Options:
    """Options of the ablation.

    Attributes:
        rooms: their folders.
        photos: of a film, spread over it.
        off: stages.
    """

    rooms: tuple[str, ...] = option(("data/lobby", "data/lobby_plain"), "folders of rooms")
    photos: int = option(125, "photos of a film, spread over it")
    off: tuple[str, ...] = option(tuple(STAGES), "stages that are off, one at a time", choices=tuple(STAGES))


@dataclass(frozen=True)
class Room:
    """Photos of a place, where some were taken, and its surface where the rays of a reference meet it."""

    files: list[Path]
    held_out: list[str]
    known: Mapping[str, Any]
    reference: Mesh
    rays: Rays

    @classmethod
    def open(cls, folder: str, count: int, progress: Progress) -> Room:
        """A film, or a room like the lobby.

        Raises:
            ValueError: if the folder holds neither.
        """
        root = Path(folder)
        if not (root / "scene.xml").is_file():
            film = Film.open(folder)
            every = max(1, round(len(film.stems) / count))
            fused = range(0, len(film.stems), max(1, len(film.stems) // FUSED))
            film, reference = film.levelled(film.surface(fused, progress))
            chosen = range(0, len(film.stems), every)
            known = {film.photo(k).name: film.poses[k][:3, 3] for k in chosen}
            return cls([film.photo(k) for k in chosen], [], known, reference, film.rays(every))
        files, held_out, known = lobby_photos(root)
        mesh, poses = wr.Scene.load(root / "scene.xml").mesh, read_poses(root / "poses_true.json")
        cameras = [poses[file.name] for file in files]
        part = (slice(STRIDE // 2, None, STRIDE),) * 2
        ahead = np.concatenate([c.directions()[part].reshape(-1, 3) for c in cameras])
        eyes = np.repeat([c.position for c in cameras], len(ahead) // len(cameras), axis=0)
        met = mesh.cast(eyes, ahead)
        return cls(files, held_out, known, mesh, (eyes[met.valid], ahead[met.valid], met.t[met.valid]))


def run(options: Options, job: Job) -> Report:
    """Reconstruct all rooms in all ways.

    Raises:
        ValueError: for a folder without photos and a reference.
    """
    rows = []
    for folder in options.rooms:
        room = Room.open(folder, options.photos, job.progress)
        with Steps(job.out / Path(folder).name, fresh=job.fresh, progress=job.progress) as steps:
            for off in options.off:
                config, modules = STAGES[off]
                inputs = [room.files, config, job.seed, stage_1.VERSIONS]
                one = steps.run(off, without(room, config, steps.folder, job), version=1, inputs=inputs)
                lines = sum(code_lines(f"warprrf.geometry.{name}") for name in modules)
                rows.append({"room": Path(folder).name, "off": off, "lines": lines, **one})
    return Report("stage1", {"rows": rows}, columns_table(COLUMNS, rows))


def without(
    room: Room, config: ReconstructionConfig, out: Path, job: Job
) -> Callable[[Attempt], dict[str, Any]]:
    """A step that reconstructs ``room`` and scores its mesh."""

    def make(attempt: Attempt) -> dict[str, Any]:
        found = wr.reconstruct(
            room.files, workspace=out / "workspace", known_positions=room.known, held_out=room.held_out,
            config=config, seed=job.seed, progress=attempt.progress, device=job.device,
        )  # fmt: skip
        steps = (out / "workspace/.steps").glob("*.json")  # those after structure from motion
        seconds = sum(read_json(step)["seconds"] for step in steps)
        mesh = found.mesh.transformed(**laid_on(found.mesh, room.reference, room.rays))
        figures = score(mesh, room.reference, room.rays)
        holes = 1 - figures["covered"]
        return {"posed": len(found.cameras), "seconds": seconds, "holes": holes, **figures}

    return make


def code_lines(module: str) -> int:
    """Lines of a module that are neither empty nor a comment."""
    text = Path(str(importlib.import_module(module).__file__)).read_text(encoding="utf-8")
    return sum(1 for line in text.splitlines() if line.strip() and not line.strip().startswith("#"))


BENCHMARKS = {"stage1": Benchmark("stage1", Options, run, HELP)}
