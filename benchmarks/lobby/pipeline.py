"""The main job: the lobby's photos and a few of its spectra become geometry, a radio field, and their errors.

Steps, each kept once finished (:mod:`warprrf.steps`): ``geometry`` (photos to cameras, Gaussians, mesh),
``geometry error``, a step for each truth, method and number of spectra, and ``pictures``. The true poses and the true
scene are read by the scoring steps alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.data import Geometry
from benchmarks.lobby import report as page
from benchmarks.lobby.photos import noise_psnr_db, read_poses
from benchmarks.lobby.score import score_cameras, score_mesh
from benchmarks.lobby.spectra import FILES as TRUTHS
from benchmarks.machine import VERSIONS, machine
from benchmarks.methods import METHODS, Effort, Task, score
from benchmarks.report import Report
from benchmarks.runner import Benchmark, Job, option
from warprrf.files import write_arrays, write_atomically, write_json
from warprrf.geometry import pipeline as stage_1
from warprrf.geometry.mesh_files import write_mesh
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.posed.photo_files import read_photo
from warprrf.rf.spectra import lookups
from warprrf.rf.spectra.spectrum import to_db
from warprrf.steps import Attempt, Steps

MAIN = "bistatic"
MODELS = (MAIN, "rf3dgs+", "rf3dgs")
COMPARED = {**dict.fromkeys(MODELS, "exp"), MAIN: "", "nearest": "", "idw": "", "constant": "", "mean": ""}
"""Methods on the largest training set, and the variant of each."""
MAP_POINTS = 40_000  # of the mesh, drawn in the report
SECTION_HEIGHT_M = 1.2

HELP = """\
Continues where a killed run stopped; each step is redone only if its inputs or its version changed. Writes report.html,
report.json (every figure), geometry.ply (Gaussians, opens in any splat viewer), mesh.ply, field.safetensors and
cameras.json. Six to eighteen minutes on two cores, no GPU.

examples:
  python -m benchmarks lobby
  python -m benchmarks lobby --reduced --out runs/quick        few photos and steps, to see it run
  python -m benchmarks lobby --data data/lobby_plain --spectra data/lobby --out runs/plain       plain walls
"""


@dataclass(frozen=True)
class Sizes:
    """How much the run does; None is the library's default, or everything there is.

    Attributes:
        views: photos, by their place in photos.json.
        features: per photo.
        gaussians: that the refinement starts from.
        iterations: of the photometric refinement.
        steps: of the fit of RF-3DGS and RF-3DGS+.
        corner: receivers count where x and y [m] exceed these.
        counts: training receivers; all methods on the most, the bistatic field on each.
        test: test receivers.
    """

    views: tuple[int, ...] | None = None
    features: int | None = None
    gaussians: int | None = None
    iterations: int | None = None
    steps: int | None = None
    corner: tuple[float, float] = (0.0, 0.0)
    counts: tuple[int, ...] = (10, 50)
    test: int | None = None


FULL = Sizes()
# The north-eastern part of the room, where the transmitter hangs: photos that overlap enough for one stiff model.
REDUCED = Sizes(
    views=(
        *range(16, 30), *range(48, 62), 69, 70, 72, 75, 78, 79, 82, 83, 84, 86, 89, 92, 93, 94, 96, 97, 99, 100, 105,
        108, 110, 113, 114, 117, 119,
    ),
    features=1200,
    gaussians=8000,
    iterations=100,
    steps=60,
    corner=(8.0, 3.0),
    counts=(16,),
    test=16,
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the main job.

    Attributes:
        data: folder of the lobby's photos and scene.
        spectra: folder of its spectra; ``data`` by default.
        reduced: few photos and steps: shows that it runs, its figures mean little.
    """

    data: str = option("data/lobby", "the lobby's photos and scene")
    spectra: str | None = option(None, "folder of its spectra (that of the photos by default)")
    reduced: bool = option(False, "few photos and steps: shows that it runs, in minutes")


def run(options: Options, job: Job) -> Report:
    """Run every step that is not finished yet.

    Leaves in ``job.out``: ``report.json``, ``report.html``, ``geometry.ply`` (Gaussians), ``mesh.ply``,
    ``cameras.json``, ``field.safetensors`` (bistatic, exact truth, the most spectra) and the other fields.

    Raises:
        ValueError: if data are missing or broken, or another run is at work in ``job.out``.
        ImportError: if the extra ``photos`` or ``plots`` is not installed.
    """
    data, spectra = Path(options.data), Path(options.spectra or options.data)
    lobby = Lobby(data, spectra, job, REDUCED if options.reduced else FULL)
    lobby.check_data()
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        figures = lobby.figures(steps)
    figures |= {"seed": job.seed, "reduced": options.reduced, "machine": machine(job.device)}
    look = f"In the browser: `warprrf view {job.out} {spectra / TRUTHS['exact']}`"
    title = "The lobby: from photos and a few spectra to a radio field"
    pictures = page.pictures(figures, job.out / "pictures.npz")
    return Report("report", figures, f"{page.text(figures)}\n\n{look}", pictures, title=title)


@dataclass(frozen=True)
class Lobby:
    """One run: where its data lie, and its steps."""

    data: Path
    spectra: Path
    job: Job
    sizes: Sizes = FULL

    @cached_property
    def place(self) -> Geometry:
        """The reconstruction, once there is one."""
        return Geometry(self.job.out / "reconstruction", self.data / "scene.xml", self.job.device)

    def check_data(self) -> None:
        """Refuse folders that lack something; ValueError names it."""
        needed = ("photos", "photos.json", "surveyed.json", "poses_true.json", "scene.xml")
        paths = [*(self.data / name for name in needed), *(self.spectra / name for name in TRUTHS.values())]
        missing = [str(path) for path in paths if not path.exists()]
        if missing:
            raise ValueError(
                f"data: there is no {', '.join(missing)}; expected the folder of a checkout's data, or make it: "
                "python -m benchmarks data"
            )

    def figures(self, steps: Steps) -> dict[str, Any]:
        """Everything that the report holds, from the steps."""
        files = [self.data / name for name in ("photos", "photos.json", "surveyed.json")]
        geometry = steps.run(
            "geometry", self.geometry, version=VERSIONS["geometry"],
            inputs=[*files, self.job.seed, self.sizes, stage_1.VERSIONS],
            outputs=("reconstruction", "geometry.ply", "mesh.ply", "cameras.json"),
        )  # fmt: skip
        errors = steps.run(
            "geometry error", self.geometry_error, version=1, outputs=("geometry_error.npz",),
            inputs=[steps.key("geometry"), self.data / "poses_true.json", self.data / "scene.xml"],
        )  # fmt: skip
        most = max(self.sizes.counts)
        asked = [(MAIN, count) for count in sorted(self.sizes.counts)[:-1]] + [(m, most) for m in COMPARED]
        found: dict[str, dict[str, Any]] = {truth: {} for truth in TRUTHS}
        for truth, name in TRUTHS.items():
            for method, count in asked:
                row = steps.run(
                    f"{method} {count}, {truth}", partial(self.method, method, count, truth),
                    version=METHODS[method].version, inputs=[steps.key("geometry"), self.spectra / name, count],
                    outputs=(field_name(method, count, truth, most),) if method in MODELS else (),
                )  # fmt: skip
                found[truth][method if count == most else f"{method}-{count}"] = row
        scored = [steps.key(f"{model} {most}, exact") for model in MODELS]
        steps.run(
            "pictures", partial(self.pictures, found["exact"]["rf3dgs+"]), version=1, outputs=("pictures.npz",),
            inputs=[steps.key("geometry error"), *scored],
        )  # fmt: skip
        return {
            **{key: errors.get(key) for key, *_ in page.FIGURES},
            "pipeline_time_s": sum(record["seconds"] for record in steps.records.values()),
            "methods": found["exact"],
            "methods_sionna": found["sionna"],
            "data": {truth: self.about(truth) for truth in TRUTHS},
            "geometry": {**geometry, **errors},
            "stages": {
                name: {
                    "seconds": record["seconds"],
                    "attempts": record["attempts"],
                    "steps": record["stages"],
                }
                for name, record in steps.records.items()
            },
        }

    def split(self, truth: str, count: int | None = None) -> tuple[Any, Any]:
        """Training and test set of a run of these sizes, in the nested order of the data set.

        Raises:
            ValueError: if there are too few training receivers, or none to test.
        """
        ds = wr.SpectrumDataset.load(self.spectra / TRUTHS[truth])
        inside = (np.asarray(ds.receivers)[:, :2] > self.sizes.corner).all(axis=1)
        train, test = ds.subset(inside).split(count or max(self.sizes.counts), seed=self.job.seed)
        return train, test if self.sizes.test is None else test.subset(range(min(self.sizes.test, len(test))))

    def about(self, truth: str) -> dict[str, Any]:
        """What a truth's data are."""
        train, test = self.split(truth)
        return {
            "engine": test.engine, "train": len(train), "test": len(test),
            "blocked": int(np.count_nonzero(~np.asarray(test.line_of_sight))), "shape": list(test.shape),
            "frequency_hz": float(test.frequency_hz), "range_db": list(test.range_db),
            "beam_sigma_rad": float(test.beam_sigma_rad), "settings": dict(test.attributes),
        }  # fmt: skip

    def geometry(self, attempt: Attempt) -> dict[str, Any]:
        """Photos to cameras, Gaussians and mesh."""
        out = self.job.out
        files, held_out, surveyed = photos(self.data, self.sizes)
        found = wr.reconstruct(
            files,
            workspace=out / "workspace",
            known_positions=surveyed,
            held_out=held_out,
            iterations=self.sizes.iterations,
            config=config(self.sizes),
            seed=self.job.seed,
            device=self.job.device,
            progress=attempt.progress,
        )
        found.save(out / "reconstruction")
        write_atomically(out / "geometry.ply", found.gaussians.save_ply)
        write_atomically(
            out / "mesh.ply", lambda name: write_mesh(name, found.mesh.vertices, found.mesh.faces)
        )
        poses = {name: camera.world_to_camera for name, camera in found.cameras.items()}
        write_json(out / "cameras.json", {"about": "world_to_camera, OpenCV axes, metres", "cameras": poses})
        return {
            "scale_rms_m": found.scale_rms_m,
            "photos": len(files),
            "posed": len(found.cameras),
            "unposed": {name: found.causes.get(name, "") for name in found.unposed},
            "guessed": list(found.guessed),
            "held_out": len(held_out),
            "surveyed": len(surveyed),
            "gaussians": len(found.gaussians),
            "triangles": len(found.mesh.faces),
            "patches": len(found.patches or ()),
        }

    def geometry_error(self, attempt: Attempt) -> dict[str, Any]:
        """Cameras, mesh and held-out photos against the truth."""
        files, held_out, _ = photos(self.data, self.sizes)
        used = {file.name for file in files}
        known = read_poses(self.data / "poses_true.json")
        truth = {name: camera for name, camera in known.items() if name in used}
        found = self.place.reconstruction
        figures: dict[str, Any] = score_cameras(found.cameras, truth)
        true_mesh, seen = self.place.scene.mesh, list(truth.values())
        scored = score_mesh(found.mesh, true_mesh, seen, seed=self.job.seed, device=self.job.device)
        figures |= scored.figures
        names = [name for name in held_out if name in found.cameras]
        if not names:
            raise ValueError("photos: no held-out photo has a pose, so stage 1 cannot be scored")
        views, renders, psnr = [], [], []
        for done, name in enumerate(names):
            view = read_photo(found.photos[name])
            image = wr.render(found.gaussians, found.cameras[name], device=self.job.device).features
            image = np.clip(image, 0, 1)
            psnr.append(float(-10.0 * np.log10(np.mean((image - view) ** 2, dtype=np.float64))))
            views.append(np.round(255 * view).astype(np.uint8))
            renders.append(np.round(255 * image).astype(np.uint8))
            attempt.progress("held-out photos", done + 1, len(names))
        figures["photo_psnr_db"] = float(np.mean(psnr))
        figures["photo_psnr_db_by_view"] = dict(zip(names, psnr, strict=True))
        figures["photo_noise_psnr_db"] = noise_psnr_db(self.data)
        order = np.argsort(psnr)
        shown = sorted({int(order[0]), int(order[len(order) // 2]), int(order[-1])})
        rng = np.random.default_rng(self.job.seed)
        some = rng.choice(len(scored.points), min(MAP_POINTS, len(scored.points)), replace=False)
        arrays = {
            "photo_names": np.array([names[i] for i in shown]),
            "photo_psnr_db": np.array([psnr[i] for i in shown]),
            "photo_truth": np.stack([views[i] for i in shown]),
            "photo_render": np.stack([renders[i] for i in shown]),
            "mesh_points": scored.points[some].astype(np.float32),
            "mesh_error_m": scored.distance_m[some].astype(np.float32),
        }
        write_arrays(self.job.out / "geometry_error.npz", arrays)
        return figures

    def method(self, method: str, count: int, truth: str, attempt: Attempt) -> dict[str, Any]:
        """Figures of a method on ``count`` spectra; a field is left in its file."""
        train, test = self.split(truth, count)
        task = Task(
            train, test, self.place, attempt.folder, attempt.progress, variant=COMPARED[method],
            seed=self.job.seed, effort=Effort(harmonic_iterations=self.sizes.steps),
        )  # fmt: skip
        name = field_name(method, count, truth, max(self.sizes.counts))
        fitted, row = score(method, task, self.job.out / name)
        return {**row, "choices": fitted.field.report.get("choices")} if method in MODELS else row

    def pictures(self, scored: dict[str, Any], attempt: Attempt) -> dict[str, Any]:
        """What the report draws, as arrays."""
        train, test = self.split("exact")
        psnr = np.array(scored["per_receiver"]["psnr_db"], dtype=np.float64)
        blocked = ~np.asarray(test.line_of_sight, dtype=bool)
        chosen = _spread_by_score(psnr, blocked)
        mesh = self.place.scene.mesh
        arrays: dict[str, np.ndarray] = {
            "train_receivers": np.asarray(train.receivers),
            "test_receivers": np.asarray(test.receivers),
            "test_psnr_db": psnr,
            "test_blocked": blocked,
            "transmitter": np.asarray(test.transmitter),
            "range_db": np.asarray(test.range_db),
            "section": mesh.cross_section(SECTION_HEIGHT_M),
            "spectrum_receivers": np.asarray(test.receivers)[chosen],
            "spectrum_blocked": blocked[chosen],
            "spectrum_truth": to_db(np.asarray(test.path_gain)[chosen], test.floor).astype(np.float32),
        }
        most = max(self.sizes.counts)
        files = {m: self.job.out / field_name(m, most, "exact", most) for m in MODELS[:2]}
        predictors: dict[str, Any] = {
            m: wr.RadioField.load(file, device=self.job.device).spectrum for m, file in files.items()
        }
        predictors["nearest"] = lookups.nearest(train)
        for done, (name, predict) in enumerate(predictors.items()):
            images = [predict(test.receivers[i]).path_gain_db for i in chosen]
            arrays[f"spectrum_{name}"] = np.stack(images).astype(np.float32)
            attempt.progress("pictures", done + 1, len(predictors))
        with np.load(self.job.out / "geometry_error.npz", allow_pickle=False) as stored:
            arrays |= {name: stored[name] for name in stored.files}
        write_arrays(self.job.out / "pictures.npz", arrays)
        return {}


def _spread_by_score(score: np.ndarray, blocked: np.ndarray) -> np.ndarray:
    """Test receivers to show: the 15th, 50th and 85th percentile of PSNR, with and without line of sight."""
    chosen = []
    for where in (~blocked, blocked):
        index = np.flatnonzero(where)
        index = index[np.argsort(score[index])]
        chosen += [index[round(share * (len(index) - 1))] for share in (0.85, 0.5, 0.15) if len(index)]
    return np.array(sorted(set(chosen), key=chosen.index), dtype=np.int64)


def field_name(model: str, count: int, truth: str, most: int) -> str:
    """The main field is ``field.safetensors``; the others carry model, number of spectra and truth in their name."""
    main = (model, count, truth) == (MAIN, most, "exact")
    return "field.safetensors" if main else f"field-{model}-{count}-{truth}.safetensors"


def config(sizes: Sizes) -> ReconstructionConfig:
    """Settings of :func:`warprrf.reconstruct` for a run of these sizes."""
    asked: dict[str, Any] = {"max_features": sizes.features, "gaussians": sizes.gaussians}
    return ReconstructionConfig(**{name: value for name, value in asked.items() if value is not None})


def photos(data: Path, sizes: Sizes = FULL) -> tuple[list[Path], list[str], dict[str, Sequence[float]]]:
    """Photo files, names of the held-out ones, and surveyed camera positions."""
    roles = json.loads((data / "photos.json").read_text(encoding="utf-8"))
    surveyed = json.loads((data / "surveyed.json").read_text(encoding="utf-8"))
    names = roles["photos"] if sizes.views is None else [roles["photos"][index] for index in sizes.views]
    held_out = [name for name in roles["held_out"] if name in names]
    known = {n: p for n, p in surveyed.items() if n in names}
    return [data / "photos" / name for name in names], held_out, known


BENCHMARKS = {"lobby": Benchmark("lobby", Options, run, HELP)}
