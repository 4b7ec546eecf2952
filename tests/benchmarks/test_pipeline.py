"""The lobby run on a few tiny photos and spectra, with the true mesh in place of the reconstruction."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import LOBBY

import warprrf as wr
from benchmarks.lobby import pipeline, plain, seeds
from benchmarks.runner import Job, execute
from warprrf.files import write_json
from warprrf.geometry.splats.gaussians import discs_on_mesh

SIZES = pipeline.Sizes(steps=20, train=6, test=4)
MODELS = ("bistatic", "rf3dgs+", "rf3dgs")
KEYS = (
    "psnr_db",
    "ssim",
    "rmse_db",
    "direction_median_deg",
    "direction_within_3deg",
    "direction_within_3deg_blocked",
)
GEOMETRY_KEYS = (
    "photo_psnr_db",
    "photo_noise_psnr_db",
    "camera_rms_m",
    "mesh_distance_median_m",
    "mesh_distance_p90_m",
    "mesh_normal_median_deg",
    "pipeline_time_s",
    "fit_time_s",
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lobby of four photos of 64 x 48 pixels and ten spectra of 12 x 24."""
    images = pytest.importorskip("PIL.Image")
    folder = tmp_path_factory.mktemp("lobby")
    for name in ("scene.xml", "materials.json"):
        shutil.copy(LOBBY / name, folder)
    for name in ("meshes", "textures"):
        shutil.copytree(LOBBY / name, folder / name)
    scene = wr.Scene.load(folder / "scene.xml")
    lens = {"fx": 40.0, "fy": 40.0, "cx": 32.0, "cy": 24.0}
    views, rng = {}, np.random.default_rng(0)
    for sub in ("photos", "photos_noise"):
        (folder / sub).mkdir()
    for index in range(4):
        pose = np.array([[0, -1, 0, 5.0 + index], [0, 0, -1, 1.5], [1, 0, 0, -2.0], [0, 0, 0, 1.0]])
        views[f"v{index}.png"] = {"world_to_camera": pose.tolist()}
        for sub in ("photos", "photos_noise"):
            pixels = rng.integers(100, 140, (48, 64, 3)).astype(np.uint8)
            images.fromarray(pixels).save(folder / sub / f"v{index}.jpg")
    views = {name.replace("png", "jpg"): view for name, view in views.items()}
    names = list(views)
    write_json(folder / "poses_true.json", {"width": 64, "height": 48, **lens, "views": views})
    write_json(folder / "photos.json", {"photos": names, "held_out": names[1:3]})
    write_json(folder / "surveyed.json", {name: [0.0, 0.0, 0.0] for name in names})
    places = rng.uniform([1.0, 1.0, 1.0], [14.0, 11.0, 2.0], (200, 3))
    places = places[scene.is_free(places, clearance_m=0.3)][:10]
    dataset = wr.simulate(
        scene,
        transmitter=(13.6, 11.2, 2.5),
        receivers=places,
        frequency_hz=300e9,
        shape=(12, 24),
        roles=["train"] * 6 + ["test"] * 4,
    )
    for name in pipeline.TRUTHS.values():
        dataset.save(folder / name)
    return folder


def _true_geometry(lobby: pipeline.Lobby, attempt: Any) -> dict[str, Any]:
    out, mesh = lobby.job.out, lobby.place.scene.mesh
    cameras = pipeline.truth_scores.true_cameras(lobby.data / "poses_true.json")
    photos = {name: lobby.data / "photos" / name for name in cameras}
    reconstruction = wr.Reconstruction(discs_on_mesh(mesh), mesh, cameras, photos=photos)
    reconstruction.save(out / "reconstruction")
    reconstruction.gaussians.save_ply(out / "geometry.ply")
    for name in ("mesh.ply", "cameras.json"):
        (out / name).write_text("")
    return {
        "photos": 4,
        "posed": 4,
        "unposed": {"v9.jpg": "shows 3 features"},
        "guessed": ["surface: 5% of it carries no feature"],
        "held_out": 2,
        "gaussians": len(reconstruction.gaussians),
        "triangles": len(mesh.faces),
    }


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline.Lobby, "geometry", _true_geometry)
    monkeypatch.setattr(pipeline, "REDUCED", SIZES)


def whole(out: Path, data: Path, **job: Any) -> dict[str, Any]:
    options = pipeline.Options(data=str(data), reduced=True)
    return execute(pipeline.BENCHMARKS["lobby"], options, Job(out, device="cpu", **job))


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("runs") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.Lobby, "geometry", _true_geometry)
        patch.setattr(pipeline, "REDUCED", SIZES)
        return out, whole(out, data)


def test_report_holds_every_figure(finished: tuple[Path, dict[str, Any]]) -> None:
    out, _ = finished
    figures = json.loads((out / "report.json").read_text())
    assert [key for key in GEOMETRY_KEYS if not isinstance(figures.get(key), float)] == []
    for methods in (figures["methods"], figures["methods_sionna"]):
        assert set(methods) == {*MODELS, "nearest", "idw", "constant", "mean"}
        assert [(name, key) for name in methods for key in KEYS if key not in methods[name]] == []
        assert all(methods[name]["tof_error_median_ns"] is not None for name in MODELS)
    assert figures["mesh_distance_p90_m"] < 1e-4  # the mesh is the true one
    assert figures["camera_rms_m"] == 0.0
    for name in ("geometry.ply", "mesh.ply", "field.safetensors", "report.html", "cameras.json"):
        assert (out / name).is_file()
    assert figures["pipeline_time_s"] == pytest.approx(sum(s["seconds"] for s in figures["stages"].values()))


def test_page_needs_no_other_file(finished: tuple[Path, dict[str, Any]]) -> None:
    text = (finished[0] / "report.html").read_text()
    assert text.count("<img ") >= 8
    sources = re.findall(r"(?:src|href)='([^']{0,30})", text)
    assert sources
    assert [source for source in sources if not source.startswith("data:image/")] == []


def test_second_run_computes_nothing(
    finished: tuple[Path, dict[str, Any]], data: Path, small: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, first = finished

    def refuse(*args: Any, **options: Any) -> None:
        raise AssertionError("computed again")

    for name in ("geometry", "geometry_error", "fit", "evaluation", "pictures"):
        monkeypatch.setattr(pipeline.Lobby, name, refuse)
    assert whole(out, data)["methods"] == first["methods"]


def test_killed_run_ends_with_the_same_figures(
    finished: tuple[Path, dict[str, Any]], data: Path, small: None, tmp_path: Path
) -> None:
    def kill(stage: str, done: int, total: int) -> None:
        if stage == "fit" and done > 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        whole(tmp_path, data, progress=kill)
    again = whole(tmp_path, data)
    assert again["stages"]["fit bistatic, exact"]["attempts"] == 2
    assert again["stages"]["geometry"]["attempts"] == 1
    for name, figures in finished[1]["methods"].items():
        for key in KEYS:
            assert again["methods"][name][key] == figures[key], (name, key)


def test_missing_data_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"photos.*benchmarks data"):
        whole(tmp_path / "out", tmp_path)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("small")
def test_the_plain_lobby_is_scored_and_says_what_is_guessed(data: Path, tmp_path: Path) -> None:
    options = plain.Options(data=str(data), spectra=str(data / pipeline.TRUTHS["exact"]), train=6)
    figures = execute(plain.BENCHMARKS["lobby-plain"], options, Job(tmp_path / "out", device="cpu"))
    assert figures["geometry"]["mesh_distance_median_m"] < 1e-3 and figures["bistatic"]["receivers"] == 4
    page = (tmp_path / "out" / "lobby_plain.md").read_text()
    assert "v9.jpg: shows 3 features" in page and "5% of it" in page and "at least 33 dB" in page


def test_spread_over_seeds_is_that_of_the_reports() -> None:
    def report(psnr: float, camera: float | None) -> dict[str, Any]:
        methods = {"bistatic": {"psnr_db": psnr, "ssim": None}}
        return {"camera_rms_m": camera, "methods": methods, "methods_sionna": methods}

    rows = {
        row["key"]: row for row in seeds.spread([report(30.0, 0.01), report(32.0, 0.01), report(34.0, 0.04)])
    }
    assert set(rows) == {"camera_rms_m", "methods.bistatic.psnr_db", "methods_sionna.bistatic.psnr_db"}
    found = rows["methods.bistatic.psnr_db"]
    assert (found["mean"], found["spread"], found["least"], found["most"]) == (32.0, 2.0, 30.0, 34.0)
    assert rows["camera_rms_m"]["mean"] == pytest.approx(0.02)


def test_seeds_have_runs_of_their_own_and_results_where_asked(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Path, int]] = []

    def run(options: Any, job: Job) -> Any:
        asked.append((job.out, job.seed))
        return pipeline.Report(
            "report", {"methods": {}, "methods_sionna": {}, "camera_rms_m": 0.01 * job.seed}, ""
        )

    monkeypatch.setattr(pipeline, "run", run)
    results = tmp_path / "results" / "lobby_seeds.json"
    options = seeds.Options(seeds=(1, 3), results=str(results))
    execute(seeds.BENCHMARKS["lobby-seeds"], options, Job(tmp_path / "out"))
    assert asked == [(tmp_path / "out/seed-1", 1), (tmp_path / "out/seed-3", 3)]
    (row,) = json.loads(results.read_text())["rows"]
    assert (row["key"], row["mean"], row["values"]) == ("camera_rms_m", 0.02, [0.01, 0.03])
    with pytest.raises(ValueError, match="seeds: got"):
        seeds.run(seeds.Options(seeds=(2,)), Job(tmp_path))
