"""The main job on a few tiny photos and spectra of a small room, with the true mesh in place of the reconstruction."""

import json
import re

import numpy as np
import pytest
from small_room import small_room

import warprrf as wr
from benchmarks.lobby import pipeline
from benchmarks.runner import Job, execute
from warprrf.files import write_json
from warprrf.geometry.splats.gaussians import discs_on_mesh

SIZES = pipeline.Sizes(steps=20, counts=(2, 4), test=3)
KEYS = ("psnr_db", "ssim", "rmse_db", "direction_within_3deg", "tof_error_median_ns", "fit_s")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A small room, and four photos of 64 x 48 pixels that show noise."""
    images = pytest.importorskip("PIL.Image")
    folder = small_room(tmp_path_factory.mktemp("lobby"))
    views, rng = {}, np.random.default_rng(0)
    for k in range(4):
        pose = np.array([[0, -1, 0, 2.0 + 0.3 * k], [0, 0, -1, 1.5], [1, 0, 0, -0.6], [0, 0, 0, 1.0]])
        views[f"v{k}.jpg"] = {"world_to_camera": pose.tolist()}
        for sub in ("photos", "photos_noise"):
            (folder / sub).mkdir(exist_ok=True)
            pixels = rng.integers(100, 140, (48, 64, 3)).astype(np.uint8)
            images.fromarray(pixels).save(folder / sub / f"v{k}.jpg")
    lens = {"width": 64, "height": 48, "fx": 40.0, "fy": 40.0, "cx": 32.0, "cy": 24.0}
    write_json(folder / "poses_true.json", {**lens, "views": views})
    write_json(folder / "photos.json", {"photos": list(views), "held_out": list(views)[1:3]})
    write_json(folder / "surveyed.json", {name: [0.0, 0.0, 0.0] for name in views})
    return folder


def _true_geometry(lobby, attempt):
    out, mesh = lobby.job.out, lobby.place.scene.mesh
    cameras = pipeline.read_poses(lobby.data / "poses_true.json")
    photos = {name: lobby.data / "photos" / name for name in cameras}
    reconstruction = wr.Reconstruction(discs_on_mesh(mesh, 800), mesh, cameras, photos=photos)
    reconstruction.save(out / "reconstruction")
    for name in ("geometry.ply", "mesh.ply", "cameras.json"):
        (out / name).write_text("")
    return {
        "photos": 4, "posed": 4, "unposed": {"v9.jpg": "shows 3 features"}, "guessed": ["5% carries no feature"],
        "held_out": 2, "gaussians": 800, "triangles": len(mesh.faces),
    }  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def small():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.Lobby, "geometry", _true_geometry)
        patch.setattr(pipeline, "REDUCED", SIZES)
        yield


def whole(out, data, **job):
    options = pipeline.Options(data=str(data), reduced=True)
    return execute(pipeline.BENCHMARKS["lobby"], options, Job(out, device="cpu", **job))


@pytest.fixture(scope="module")
def finished(data, small, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "whole"
    return out, whole(out, data)


def test_report_holds_every_figure_and_its_page_needs_no_other_file(finished):
    out, found = finished
    assert json.loads((out / "report.json").read_text()) == found
    assert [key for key, *_ in pipeline.page.FIGURES if not isinstance(found[key], float)] == []
    for methods in (found["methods"], found["methods_sionna"]):
        assert set(methods) == {*pipeline.COMPARED, "bistatic-2"}
        assert [(m, k) for m in (*pipeline.MODELS, "bistatic-2") for k in KEYS if methods[m][k] is None] == []
    assert found["mesh_distance_p90_m"] < 1e-4 and found["camera_rms_m"] == 0.0  # the mesh is the true one
    assert found["pipeline_time_s"] == pytest.approx(sum(s["seconds"] for s in found["stages"].values()))
    assert (out / "field.safetensors").is_file()
    text = (out / "report.html").read_text()
    sources = re.findall(r"(?:src|href)='([^']{0,30})", text)
    assert len(sources) >= 8 and all(source.startswith("data:image/") for source in sources)
    assert "v9.jpg: shows 3 features" in text and "<td>bistatic (ours), 2 spectra</td>" in text


@pytest.mark.long
def test_second_run_computes_nothing_and_a_killed_one_ends_with_the_same_figures(
    finished, data, tmp_path, monkeypatch
):
    out, first = finished

    def kill(stage, done, total):
        if stage == "fit" and done > 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        whole(tmp_path, data, progress=kill)
    again = whole(tmp_path, data)
    attempts = {name: stage["attempts"] for name, stage in again["stages"].items()}
    assert max(attempts.values()) == 2 and attempts["geometry"] == 1
    for name, figures in first["methods"].items():
        assert again["methods"][name]["psnr_db"] == figures["psnr_db"], name
    for name in ("geometry", "geometry_error", "method", "pictures"):
        monkeypatch.setattr(pipeline.Lobby, name, lambda *_: pytest.fail("computed again"))
    assert whole(out, data)["methods"] == first["methods"]
