"""The main job: the lobby's photos and a few of its spectra become geometry, a radio field, and their errors.

Stages, each kept once finished (see :mod:`benchmarks.stages`): ``geometry`` (photos to cameras, Gaussians, mesh),
``geometry error``, then for each truth a ``fit`` of every model and an ``evaluation``, and ``pictures``. The true
poses and the true scene are read by the scoring stages alone.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.lobby import report as page
from benchmarks.lobby import score as truth_scores
from benchmarks.lobby.photos import noise_psnr_db
from benchmarks.lobby.spectra import FILES as TRUTHS
from benchmarks.machine import machine
from benchmarks.stages import StagedRun, fingerprint, plain, write_json
from warprrf.device import Progress
from warprrf.files import write_arrays, write_atomically
from warprrf.geometry.mesh_files import write_mesh
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.photo_files import read_photo
from warprrf.marks import code_mark
from warprrf.rf.fields.harmonic.transport import Transport, transport
from warprrf.rf.spectra import lookups, metrics
from warprrf.rf.spectra.spectrum import to_db

MODELS = ("bistatic", "rf3dgs+", "rf3dgs")
LOOKUPS = {"nearest": lookups.nearest, "idw": lookups.idw, "constant": lookups.constant, "mean": lookups.mean}
TRAIN_RECEIVERS = 50  # the training subset that the asked fit time is stated for
MAP_POINTS = 40_000  # of the mesh, drawn in the report
SECTION_HEIGHT_M = 1.2
GEOMETRY_CODE = ("warprrf.geometry", "warprrf.kernels")
RADIO_CODE = (*GEOMETRY_CODE, "warprrf.rf")


@dataclass(frozen=True)
class Sizes:
    """How much the run does; None is the library's default, or everything there is."""

    views: tuple[int, ...] | None = None  # photos, by their place in photos.json
    features: int | None = None  # per photo
    gaussians: int | None = None  # that the refinement starts from
    iterations: int | None = None  # of the photometric refinement
    steps: int | None = None  # of the radio fit
    corner: tuple[float, float] = (0.0, 0.0)  # receivers count where x and y [m] exceed these
    train: int = TRAIN_RECEIVERS
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


def run(
    out: str | os.PathLike[str] = "runs/lobby",
    data: str | os.PathLike[str] = "data/lobby",
    *,
    seed: int = 0,
    device: Any = None,
    progress: Progress | None = None,
    reduced: bool = False,
    fresh: bool = False,
) -> dict[str, Any]:
    """Run every stage that is not finished yet and return the content of ``report.json``.

    Args:
        out: folder of the results: ``report.json``, ``report.html``, ``geometry.ply`` (Gaussians), ``mesh.ply``,
            ``cameras.json``, ``field.safetensors`` (RF-3DGS+ on the exact truth).
        data: folder of the lobby's photos, scene and spectra.
        seed: every random choice follows from it.
        device: Warp device.
        progress: ``progress(stage, done, total)``.
        reduced: few photos and steps: shows that it runs, its figures mean little.
        fresh: start over instead of continuing.

    Raises:
        ValueError: if data are missing or broken, or another run is at work in ``out``.
        ImportError: if the extra ``photos`` or ``plots`` is not installed.
    """
    out, data = Path(out), Path(data)
    sizes = REDUCED if reduced else FULL
    _check_data(data)
    with StagedRun(out, fresh=fresh, progress=progress) as stages:
        inputs = [
            data / "photos",
            data / "photos.json",
            data / "surveyed.json",
            seed,
            asdict(sizes),
            code_mark(*GEOMETRY_CODE),
        ]
        geometry = stages.stage(
            "geometry",
            partial(_geometry, out, data, sizes, seed, device),
            inputs=inputs,
            outputs=("reconstruction", "geometry.ply", "mesh.ply", "cameras.json"),
        )
        errors = stages.stage(
            "geometry error",
            partial(_geometry_error, out, data, sizes, seed, device),
            inputs=[*inputs, data / "poses_true.json", data / "scene.xml", code_mark("benchmarks")],
            outputs=("geometry_error.npz",),
        )
        view = _View(out / "reconstruction", sizes, device)
        figures: dict[str, dict[str, Any]] = {}
        for truth, name in TRUTHS.items():
            radio = [*inputs, data / name, code_mark(*RADIO_CODE)]
            fits = {
                model: stages.stage(
                    f"fit {model}, {truth}",
                    partial(_fit, out, data / name, view, model, truth, seed),
                    inputs=[*radio, model],
                    outputs=(_field_name(model, truth),),
                )
                for model in MODELS
            }
            figures[truth] = stages.stage(
                f"evaluation, {truth}",
                partial(_evaluation, out, data / name, view, truth, seed),
                inputs=[*radio, MODELS, Path(__file__)],
            )
            for model in MODELS:
                figures[truth]["methods"][model] |= fits[model]
        stages.stage(
            "pictures",
            partial(_pictures, out, data, view, figures["exact"]["methods"], seed),
            inputs=[*radio, *(data / name for name in TRUTHS.values()), Path(__file__)],
            outputs=("pictures.npz",),
        )
        report: dict[str, Any] = {
            **{key: errors.get(key) for key, *_ in page.FIGURES},
            "fit_time_s": figures["exact"]["methods"]["rf3dgs+"]["fit_time_s"],
            "pipeline_time_s": stages.seconds(),
            "methods": figures["exact"]["methods"],
            "methods_sionna": figures["sionna"]["methods"],
            "data": {truth: figures[truth]["data"] for truth in TRUTHS},
            "geometry": {**geometry, **errors},
            "stages": {
                name: {
                    "seconds": stages.seconds(name),
                    "attempts": stages.attempts(name),
                    "steps": stages.steps(name),
                }
                for name in stages.order
            },
            "seed": seed,
            "reduced": reduced,
            "machine": machine(device),
        }
        write_json(out / "report.json", report)
        page.write(out)
    return plain(report)


def summary(report: dict[str, Any]) -> str:
    """The report's figures as aligned text."""
    lines = []
    for key, name, unit, asked, more in page.FIGURES:
        value = report.get(key)
        shown = "-" if value is None else f"{value:.4g} {unit}"
        wanted = "" if asked is None else f"(asked: at {'least' if more else 'most'} {asked:g})"
        lines.append(f"{name:<62} {shown:>16}  {wanted}".rstrip())
    return "\n".join(lines)


# ----------------------------------------------------------------------------------------------------- stages


class _View:
    """The reconstruction, and its blending weights for the receivers of a data set, each made once when first used."""

    def __init__(self, folder: Path, sizes: Sizes, device: Any) -> None:
        self.sizes, self.device = sizes, device
        self._folder = folder
        self._seen: dict[str, tuple[Transport, float]] = {}

    @cached_property
    def reconstruction(self) -> Any:
        return wr.Reconstruction.load(self._folder)

    def split(self, file: Path, seed: int) -> tuple[Any, Any]:
        """Training and test set; see :func:`receivers`."""
        return receivers(wr.SpectrumDataset.load(file), self.sizes, seed=seed)

    def transport(self, dataset: Any, progress: Progress | None) -> tuple[Transport, float]:
        """Blending weights of the receivers of `dataset`, and the seconds that they took."""
        # Cutoffs follow from the range, so two truths share weights only if receivers and range are the same.
        shape = dataset.path_gain.shape[1:]
        key = fingerprint([np.asarray(dataset.receivers), list(dataset.range_db), list(shape)])
        if key not in self._seen:
            start = time.perf_counter()
            weights = transport(
                self.reconstruction.gaussians,
                dataset.receivers,
                shape,
                range_db=dataset.range_db,
                device=self.device,
                progress=progress,
            )
            self._seen[key] = weights, time.perf_counter() - start
        return self._seen[key]


def _geometry(
    out: Path, data: Path, sizes: Sizes, seed: int, device: Any, progress: Progress
) -> dict[str, Any]:
    files, held_out, surveyed = photos(data, sizes)
    # Unfinished steps of other code are not continued: neither figures nor times would be this code's.
    workspace = out / "workspace" / code_mark(*GEOMETRY_CODE)[:12]
    for other in workspace.parent.glob("*"):
        if other != workspace:
            shutil.rmtree(other) if other.is_dir() else other.unlink()
    reconstruction = wr.reconstruct(
        files,
        workspace=workspace,
        known_positions=surveyed,
        seed=seed,
        device=device,
        progress=progress,
        **options(sizes, held_out),
    )
    reconstruction.save(out / "reconstruction")
    write_atomically(out / "geometry.ply", reconstruction.gaussians.save_ply)
    write_atomically(
        out / "mesh.ply",
        lambda name: write_mesh(name, reconstruction.mesh.vertices, reconstruction.mesh.faces),
    )
    poses = {name: camera.world_to_camera for name, camera in reconstruction.cameras.items()}
    write_json(out / "cameras.json", {"about": "world_to_camera, OpenCV axes, metres", "cameras": poses})
    return {
        "scale_rms_m": reconstruction.scale_rms_m,
        "photos": len(files),
        "posed": len(reconstruction.cameras),
        "held_out": len(held_out),
        "surveyed": len(surveyed),
        "gaussians": len(reconstruction.gaussians),
        "triangles": len(reconstruction.mesh.faces),
        "patches": len(reconstruction.patches or ()),
    }


def _geometry_error(
    out: Path, data: Path, sizes: Sizes, seed: int, device: Any, progress: Progress
) -> dict[str, Any]:
    files, held_out, _ = photos(data, sizes)
    used = {file.name for file in files}
    truth = {
        name: camera
        for name, camera in truth_scores.true_cameras(data / "poses_true.json").items()
        if name in used
    }
    reconstruction = wr.Reconstruction.load(out / "reconstruction")
    figures: dict[str, Any] = truth_scores.score_cameras(reconstruction.cameras, truth)
    scored = truth_scores.score_mesh(
        reconstruction.mesh,
        wr.Scene.load(data / "scene.xml").mesh,
        list(truth.values()),
        seed=seed,
        device=device,
    )
    figures |= scored.figures
    names = [name for name in held_out if name in reconstruction.cameras]
    if not names:
        raise ValueError("photos: no held-out photo has a pose, so stage 1 cannot be scored")
    views, renders, psnr = [], [], []
    for done, name in enumerate(names):
        view = read_photo(data / "photos" / name)
        image = np.clip(
            wr.render(reconstruction.gaussians, reconstruction.cameras[name], device=device).features, 0, 1
        )
        psnr.append(float(-10.0 * np.log10(np.mean((image - view) ** 2, dtype=np.float64))))
        views.append(np.round(255 * view).astype(np.uint8))
        renders.append(np.round(255 * image).astype(np.uint8))
        progress("held-out photos", done + 1, len(names))
    figures["photo_psnr_db"] = float(np.mean(psnr))
    figures["photo_psnr_db_by_view"] = dict(zip(names, psnr, strict=True))
    figures["photo_noise_psnr_db"] = noise_psnr_db(data)
    order = np.argsort(psnr)
    shown = sorted({int(order[0]), int(order[len(order) // 2]), int(order[-1])})
    rng = np.random.default_rng(seed)
    some = rng.choice(len(scored.points), min(MAP_POINTS, len(scored.points)), replace=False)
    arrays = {
        "photo_names": np.array([names[i] for i in shown]),
        "photo_psnr_db": np.array([psnr[i] for i in shown]),
        "photo_truth": np.stack([views[i] for i in shown]),
        "photo_render": np.stack([renders[i] for i in shown]),
        "mesh_points": scored.points[some].astype(np.float32),
        "mesh_error_m": scored.distance_m[some].astype(np.float32),
    }
    write_arrays(out / "geometry_error.npz", arrays)
    return figures


def _fit(
    out: Path, file: Path, view: _View, model: str, truth: str, seed: int, progress: Progress
) -> dict[str, Any]:
    train, _ = view.split(file, seed)
    options: dict[str, Any] = {} if view.sizes.steps is None else {"iterations": view.sizes.steps}
    seconds = 0.0
    if model != "bistatic":  # which traces rays of its own, in seconds
        options["transport"], seconds = view.transport(train, progress)
        options["checkpoint"] = out / f"{_field_name(model, truth)}.checkpoint"
    field = wr.RadioField.fit(
        view.reconstruction,
        train,
        model=model,
        seed=seed,
        device=view.device,
        progress=progress,
        **options,
    )
    write_atomically(out / _field_name(model, truth), field.save)
    seconds = seconds or field.report["transport_time_s"]
    return {
        "transport_time_s": seconds,
        "fit_time_s": seconds + field.report["fit_time_s"],
        "loss_first": {name: losses[0] for name, losses in field.report["losses"].items() if losses},
        "loss_last": {name: losses[-1] for name, losses in field.report["losses"].items() if losses},
        "gaussians_seen": field.report.get("gaussians_seen"),
        "terms": field.report.get("choices"),
        "model_bytes": (out / _field_name(model, truth)).stat().st_size,
    }


def _evaluation(
    out: Path, file: Path, view: _View, truth: str, seed: int, progress: Progress
) -> dict[str, Any]:
    train, test = view.split(file, seed)
    weights, seconds = view.transport(test, progress)
    order = {
        tuple(position): index for index, position in enumerate(np.asarray(test.receivers, dtype=np.float64))
    }
    methods: dict[str, Any] = {}
    for model in MODELS:
        field = wr.RadioField.load(out / _field_name(model, truth), device=view.device)

        def predict(receiver: np.ndarray, field: Any = field) -> Any:
            return field.spectrum(receiver, transport=weights.subset([order[tuple(receiver)]]))

        if model == "bistatic":
            methods[model] = metrics.evaluate(test, field.spectrum, progress=progress)
            continue
        methods[model] = metrics.evaluate(test, predict, progress=progress)
        # Weights were computed beforehand for all methods: the time of a spectrum from nothing includes them.
        methods[model]["seconds_per_spectrum"] += seconds / len(test.receivers)
    for name, build in LOOKUPS.items():
        lookup = build(train)
        methods[name] = {**metrics.evaluate(test, lookup, progress=progress), "note": lookup.note}
    gaps = np.linalg.norm(test.receivers[:, None] - np.asarray(train.receivers)[None], axis=-1).min(axis=1)
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


def _pictures(
    out: Path, data: Path, view: _View, methods: dict[str, Any], seed: int, progress: Progress
) -> dict[str, Any]:
    train, test = view.split(data / TRUTHS["exact"], seed)
    score = np.array(methods["rf3dgs+"]["per_receiver"]["psnr_db"], dtype=np.float64)
    blocked = ~np.asarray(test.line_of_sight, dtype=bool)
    chosen = _spread_by_score(score, blocked)
    arrays: dict[str, np.ndarray] = {
        "train_receivers": np.asarray(train.receivers),
        "test_receivers": np.asarray(test.receivers),
        "test_psnr_db": score,
        "test_blocked": blocked,
        "transmitter": np.asarray(test.transmitter),
        "range_db": np.asarray(test.range_db),
        "section": page.section(*_true_mesh(data), SECTION_HEIGHT_M),
        "spectrum_receivers": np.asarray(test.receivers)[chosen],
        "spectrum_blocked": blocked[chosen],
        "spectrum_truth": to_db(np.asarray(test.path_gain)[chosen], test.floor).astype(np.float32),
    }
    predictors: dict[str, Any] = {
        m: wr.RadioField.load(out / _field_name(m, "exact"), device=view.device).spectrum for m in MODELS
    }
    predictors["nearest"] = lookups.nearest(train)
    for done, (name, predict) in enumerate(predictors.items()):
        images = [predict(test.receivers[i]).path_gain_db for i in chosen]
        arrays[f"spectrum_{name}"] = np.stack(images).astype(np.float32)
        progress("pictures", done + 1, len(predictors))
    with np.load(out / "geometry_error.npz", allow_pickle=False) as stored:
        arrays |= {name: stored[name] for name in stored.files}
    write_arrays(out / "pictures.npz", arrays)
    return {}


def _spread_by_score(score: np.ndarray, blocked: np.ndarray) -> np.ndarray:
    """Test receivers to show: the 15th, 50th and 85th percentile of PSNR, with and without line of sight."""
    chosen = []
    for where in (~blocked, blocked):
        index = np.flatnonzero(where)
        index = index[np.argsort(score[index])]
        chosen += [index[round(share * (len(index) - 1))] for share in (0.85, 0.5, 0.15) if len(index)]
    return np.array(sorted(set(chosen), key=chosen.index), dtype=np.int64)


def _true_mesh(data: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = wr.Scene.load(data / "scene.xml").mesh
    return mesh.vertices, mesh.faces


def _field_name(model: str, truth: str) -> str:
    """The main field is `field.safetensors`; the others carry model and truth in their name."""
    return (
        "field.safetensors"
        if (model, truth) == (MODELS[0], "exact")
        else f"field-{model}-{truth}.safetensors"
    )


def options(sizes: Sizes, held_out: Sequence[str]) -> dict[str, Any]:
    """Arguments of :func:`warprrf.reconstruct` for a run of these sizes."""
    asked: dict[str, Any] = {"max_features": sizes.features, "gaussians": sizes.gaussians}
    config = ReconstructionConfig(**{name: value for name, value in asked.items() if value is not None})
    return {"held_out": held_out, "iterations": sizes.iterations, "config": config}


def photos(data: Path, sizes: Sizes = FULL) -> tuple[list[Path], list[str], dict[str, Sequence[float]]]:
    """Photo files, names of the held-out ones, and surveyed camera positions."""
    roles = json.loads((data / "photos.json").read_text(encoding="utf-8"))
    surveyed = json.loads((data / "surveyed.json").read_text(encoding="utf-8"))
    names = roles["photos"] if sizes.views is None else [roles["photos"][index] for index in sizes.views]
    held_out = [name for name in roles["held_out"] if name in names]
    return (
        [data / "photos" / name for name in names],
        held_out,
        {n: p for n, p in surveyed.items() if n in names},
    )


def receivers(dataset: Any, sizes: Sizes = FULL, *, seed: int = 0) -> tuple[Any, Any]:
    """Training and test set of a run of these sizes, in the nested order of the data set.

    Raises:
        ValueError: if there are too few training receivers, or none to test.
    """
    inside = (np.asarray(dataset.receivers)[:, :2] > sizes.corner).all(axis=1)
    train, test = dataset.subset(inside).split(sizes.train, seed=seed)
    return train, test if sizes.test is None else test.subset(range(min(sizes.test, len(test))))


def _check_data(data: Path) -> None:
    needed = ("photos", "photos.json", "surveyed.json", "poses_true.json", "scene.xml", *TRUTHS.values())
    missing = [name for name in needed if not (data / name).exists()]
    if missing:
        raise ValueError(
            f"data: {data} lacks {', '.join(missing)}; expected the folder data/lobby of a checkout, or make it: "
            "warprrf data"
        )
