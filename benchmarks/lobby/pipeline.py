"""The main job: the lobby's photos and a few of its spectra become geometry, a radio field, and their errors.

Steps, each kept once finished (:mod:`warprrf.steps`): ``geometry`` (photos to cameras, Gaussians, mesh),
``geometry error``, then for each truth a ``fit`` of every model and an ``evaluation``, and ``pictures``. The true
poses and the true scene are read by the scoring steps alone.
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
from benchmarks.data import VERSIONS, Geometry
from benchmarks.lobby import report as page
from benchmarks.lobby import score as truth_scores
from benchmarks.lobby.photos import noise_psnr_db
from benchmarks.lobby.spectra import FILES as TRUTHS
from benchmarks.machine import machine
from benchmarks.methods import Fitted, fit_bistatic, fit_harmonic
from benchmarks.report import Report
from benchmarks.runner import Benchmark, Job, option
from warprrf.files import write_arrays, write_atomically, write_json
from warprrf.geometry import pipeline as stage_1
from warprrf.geometry.mesh_files import write_mesh
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.photo_files import read_photo
from warprrf.rf.spectra import lookups, metrics
from warprrf.rf.spectra.spectrum import to_db
from warprrf.steps import Attempt, Steps

MODELS = ("bistatic", "rf3dgs+", "rf3dgs")
LOOKUPS = {"nearest": lookups.nearest, "idw": lookups.idw, "constant": lookups.constant, "mean": lookups.mean}
MAP_POINTS = 40_000  # of the mesh, drawn in the report
SECTION_HEIGHT_M = 1.2

HELP = """\
Continues where a killed run stopped; each step is redone only if its inputs or its version changed. Writes report.html,
report.json (every figure), geometry.ply (Gaussians, opens in any splat viewer), mesh.ply, field.safetensors and
cameras.json. About 15 minutes on two cores, no GPU.

examples:
  python -m benchmarks lobby
  python -m benchmarks lobby --reduced --out runs/quick        few photos and steps, to see it run
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
        train: training receivers.
        test: test receivers.
    """

    views: tuple[int, ...] | None = None
    features: int | None = None
    gaussians: int | None = None
    iterations: int | None = None
    steps: int | None = None
    corner: tuple[float, float] = (0.0, 0.0)
    train: int = 50
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
    train=16,
    test=16,
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Options of the main job.

    Attributes:
        data: folder of the lobby's photos, scene and spectra.
        reduced: few photos and steps: shows that it runs, its figures mean little.
    """

    data: str = option("data/lobby", "the lobby's photos, scene and spectra")
    reduced: bool = option(False, "few photos and steps: shows that it runs, in minutes")


def run(options: Options, job: Job) -> Report:
    """Run every step that is not finished yet.

    Leaves in ``job.out``: ``report.json``, ``report.html``, ``geometry.ply`` (Gaussians), ``mesh.ply``,
    ``cameras.json``, ``field.safetensors`` (bistatic, exact truth) and the other fields.

    Raises:
        ValueError: if data are missing or broken, or another run is at work in ``job.out``.
        ImportError: if the extra ``photos`` or ``plots`` is not installed.
    """
    lobby = Lobby(Path(options.data), job, REDUCED if options.reduced else FULL)
    lobby.check_data()
    with Steps(job.out, fresh=job.fresh, progress=job.progress) as steps:
        figures = lobby.figures(steps)
    figures |= {"seed": job.seed, "reduced": options.reduced, "machine": machine(job.device)}
    look = f"in the browser: warprrf view {job.out} {Path(options.data) / TRUTHS['exact']}"
    return Report("report", figures, f"{summary(figures)}\n\n{look}", html=partial(page.draw, job.out))


def summary(report: dict[str, Any]) -> str:
    """The report's figures as Markdown tables."""
    lines = []
    for key, name, unit in page.FIGURES:
        value = report.get(key)
        lines.append(f"{name:<66} {'-' if value is None else f'{value:.4g} {unit}':>16}")
    parts = ["\n".join(lines)]
    for truth, key in (("exact", "methods"), ("Sionna RT", "methods_sionna")):
        parts.append(f"held-out receivers, truth: {truth}\n\n{page.method_table(report[key])}")
    return "\n\n".join(parts)


@dataclass(frozen=True)
class Lobby:
    """One run: where its data lie, and its steps."""

    data: Path
    job: Job
    sizes: Sizes = FULL

    @cached_property
    def place(self) -> Geometry:
        """The reconstruction, once there is one."""
        return Geometry(self.job.out / "reconstruction", self.data / "scene.xml", self.job.device)

    def check_data(self) -> None:
        """Refuse a folder that lacks something; ValueError names it."""
        self.check_photos(*TRUTHS.values())

    def check_photos(self, *more: str) -> None:
        """Refuse a folder that lacks a file that stage 1 or its score needs, or one of ``more``; ValueError names it."""
        needed = ("photos", "photos.json", "surveyed.json", "poses_true.json", "scene.xml", *more)
        missing = [name for name in needed if not (self.data / name).exists()]
        if missing:
            raise ValueError(
                f"data: {self.data} lacks {', '.join(missing)}; expected the folder {self.data.name} of a checkout's "
                "data, or make it: python -m benchmarks data"
            )

    def stage_1(self, steps: Steps) -> tuple[dict[str, Any], dict[str, Any]]:
        """What the geometry is and how far it is from the truth, from the steps."""
        inputs = [
            *(self.data / name for name in ("photos", "photos.json", "surveyed.json")),
            self.job.seed,
            self.sizes,
        ]
        geometry = steps.run(
            "geometry", self.geometry, version=VERSIONS["geometry"], inputs=[*inputs, stage_1.VERSIONS],
            outputs=("reconstruction", "geometry.ply", "mesh.ply", "cameras.json"),
        )  # fmt: skip
        errors = steps.run(
            "geometry error", self.geometry_error, version=1, outputs=("geometry_error.npz",),
            inputs=[steps.key("geometry"), self.data / "poses_true.json", self.data / "scene.xml"],
        )  # fmt: skip
        return geometry, errors

    def figures(self, steps: Steps) -> dict[str, Any]:
        """Everything that the report holds, from the steps."""
        v = VERSIONS
        geometry, errors = self.stage_1(steps)
        base = [steps.key("geometry")]
        found: dict[str, dict[str, Any]] = {}
        for truth, name in TRUTHS.items():
            radio = [*base, self.data / name]
            for model in MODELS:
                steps.run(
                    f"fit {model}, {truth}", partial(self.fit, model, truth), inputs=[*radio, model],
                    version=v["bistatic" if model == "bistatic" else "harmonic"],
                    outputs=(field_name(model, truth),),
                )  # fmt: skip
            fitted = [steps.key(f"fit {model}, {truth}") for model in MODELS]
            found[truth] = steps.run(
                f"evaluation, {truth}", partial(self.evaluation, truth), version=v["metrics"],
                inputs=[*radio, *fitted, v["lookups"]],
            )  # fmt: skip
            for model in MODELS:
                found[truth]["methods"][model] |= steps.figures(f"fit {model}, {truth}")
        steps.run(
            "pictures", partial(self.pictures, found["exact"]["methods"]), version=1, outputs=("pictures.npz",),
            inputs=[steps.key("geometry error"), *(steps.key(f"evaluation, {truth}") for truth in TRUTHS)],
        )  # fmt: skip
        return {
            **{key: errors.get(key) for key, *_ in page.FIGURES},
            "fit_time_s": found["exact"]["methods"]["rf3dgs+"]["fit_time_s"],
            "pipeline_time_s": steps.seconds(),
            "methods": found["exact"]["methods"],
            "methods_sionna": found["sionna"]["methods"],
            "data": {truth: found[truth]["data"] for truth in TRUTHS},
            "geometry": {**geometry, **errors},
            "stages": {
                name: {
                    "seconds": steps.seconds(name),
                    "attempts": steps.attempts(name),
                    "steps": steps.stages(name),
                }
                for name in steps.names
            },
        }

    def split(self, truth: str) -> tuple[Any, Any]:
        """Training and test set; see :func:`receivers`."""
        return receivers(wr.SpectrumDataset.load(self.data / TRUTHS[truth]), self.sizes, seed=self.job.seed)

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
        known = truth_scores.true_cameras(self.data / "poses_true.json")
        truth = {name: camera for name, camera in known.items() if name in used}
        found = self.place.reconstruction
        figures: dict[str, Any] = truth_scores.score_cameras(found.cameras, truth)
        scored = truth_scores.score_mesh(
            found.mesh,
            self.place.scene.mesh,
            list(truth.values()),
            seed=self.job.seed,
            device=self.job.device,
        )
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

    def fit(self, model: str, truth: str, attempt: Attempt) -> dict[str, Any]:
        """One field, and what its fit cost."""
        train, test = self.split(truth)
        fitted: Fitted
        if model == "bistatic":
            fitted = fit_bistatic(self.place, train, seed=self.job.seed, progress=attempt.progress)
        else:
            options: dict[str, Any] = {} if self.sizes.steps is None else {"iterations": self.sizes.steps}
            fitted = fit_harmonic(
                self.place, train, test, model, seed=self.job.seed, progress=attempt.progress,
                checkpoint=attempt.folder / "checkpoint", **options,
            )  # fmt: skip
        file = self.job.out / field_name(model, truth)
        write_atomically(file, fitted.field.save)
        transport_s, fit_s, report = fitted.transport_s or 0.0, fitted.fit_s or 0.0, fitted.field.report
        return {
            "transport_time_s": transport_s,
            "fit_time_s": transport_s + fit_s,
            "loss_first": {name: losses[0] for name, losses in report["losses"].items() if losses},
            "loss_last": {name: losses[-1] for name, losses in report["losses"].items() if losses},
            "gaussians_seen": report.get("gaussians_seen"),
            "terms": report.get("choices"),
            "model_bytes": file.stat().st_size,
        }

    def field(self, model: str, truth: str) -> Any:
        """A field that :meth:`fit` left."""
        return wr.RadioField.load(self.job.out / field_name(model, truth), device=self.job.device)

    def evaluation(self, truth: str, attempt: Attempt) -> dict[str, Any]:
        """Every model and lookup on the test receivers."""
        train, test = self.split(truth)
        weights, seconds = self.place.weights(test, slot="test", progress=attempt.progress)
        methods: dict[str, Any] = {}
        for model in MODELS:
            field = self.field(model, truth)

            def predict(receiver: Any, field: Any = field) -> Any:
                return field.spectrum(receiver, transport=weights.at(receiver))

            harmonic = model != "bistatic"
            methods[model] = metrics.evaluate(
                test, predict if harmonic else field.spectrum, progress=attempt.progress
            )
            # Weights were computed beforehand for all methods: the time of a spectrum from nothing includes them.
            methods[model]["seconds_per_spectrum"] += harmonic * seconds / len(test.receivers)
        for name, build in LOOKUPS.items():
            lookup = build(train)
            methods[name] = {
                **metrics.evaluate(test, lookup, progress=attempt.progress),
                "note": lookup.note,
            }
        gaps = np.linalg.norm(test.receivers[:, None] - train.receivers[None], axis=-1).min(axis=1)
        for figures in methods.values():
            figures["per_receiver"]["distance_to_training_m"] = gaps
        return {
            "methods": methods,
            "data": {
                "engine": test.engine,
                "train": len(train.receivers),
                "test": len(test.receivers),
                "blocked": int(np.count_nonzero(~np.asarray(test.line_of_sight))),
                "shape": list(test.path_gain.shape[1:]),
                "frequency_hz": float(test.frequency_hz),
                "range_db": list(test.range_db),
                "beam_sigma_rad": float(test.beam_sigma_rad),
                "settings": dict(test.attributes),
            },
        }

    def pictures(self, methods: dict[str, Any], attempt: Attempt) -> dict[str, Any]:
        """What the report draws, as arrays."""
        train, test = self.split("exact")
        score = np.array(methods["rf3dgs+"]["per_receiver"]["psnr_db"], dtype=np.float64)
        blocked = ~np.asarray(test.line_of_sight, dtype=bool)
        chosen = _spread_by_score(score, blocked)
        mesh = self.place.scene.mesh
        arrays: dict[str, np.ndarray] = {
            "train_receivers": np.asarray(train.receivers),
            "test_receivers": np.asarray(test.receivers),
            "test_psnr_db": score,
            "test_blocked": blocked,
            "transmitter": np.asarray(test.transmitter),
            "range_db": np.asarray(test.range_db),
            "section": mesh.cross_section(SECTION_HEIGHT_M),
            "spectrum_receivers": np.asarray(test.receivers)[chosen],
            "spectrum_blocked": blocked[chosen],
            "spectrum_truth": to_db(np.asarray(test.path_gain)[chosen], test.floor).astype(np.float32),
        }
        predictors: dict[str, Any] = {m: self.field(m, "exact").spectrum for m in MODELS}
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


def field_name(model: str, truth: str) -> str:
    """The main field is ``field.safetensors``; the others carry model and truth in their name."""
    main = (model, truth) == (MODELS[0], "exact")
    return "field.safetensors" if main else f"field-{model}-{truth}.safetensors"


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


def receivers(dataset: Any, sizes: Sizes = FULL, *, seed: int = 0) -> tuple[Any, Any]:
    """Training and test set of a run of these sizes, in the nested order of the data set.

    Raises:
        ValueError: if there are too few training receivers, or none to test.
    """
    inside = (np.asarray(dataset.receivers)[:, :2] > sizes.corner).all(axis=1)
    train, test = dataset.subset(inside).split(sizes.train, seed=seed)
    return train, test if sizes.test is None else test.subset(range(min(sizes.test, len(test))))


BENCHMARKS = {"lobby": Benchmark("lobby", Options, run, HELP)}
