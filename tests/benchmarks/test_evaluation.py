"""One evaluation on two small data sets: every method, finished runs are kept, and means and margins are what they say."""

import json

import numpy as np
import pytest
from radio_scenes import box_mesh
from small_room import small_room

import warprrf as wr
from benchmarks import evaluation, newrf
from benchmarks.evaluation import COLUMNS, COMPARED, margins, region_held_out, summarise, unpacked
from benchmarks.machine import VERSIONS
from benchmarks.methods import METHODS, Effort
from benchmarks.runner import Job, execute
from warprrf.geometry.mesh_files import write_mesh
from warprrf.rf.em.materials import itu_material

EFFORT = Effort(
    harmonic_iterations=40, nerf2_rays=16, nerf2_samples=4, calibration_s=1.0, sionna_samples=20_000
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return small_room(tmp_path_factory.mktemp("room"))


def evaluate(out, folder, job=None, **changed):
    options = {
        "data": str(folder / "spectra.nc"), "room": str(folder / "reconstruction"), "counts": (4,), "steps": 3,
        "effort": EFFORT, **changed,
    }  # fmt: skip
    at = Job(out, device="cpu", **job or {})
    return execute(evaluation.BENCHMARKS["paper"], evaluation.Options(**options), at)


def carried_out(found):
    return [(row["truth"], row["method"], row["count"]) for row in unpacked(found)]


@pytest.mark.long
def test_every_method_has_a_run_and_what_others_are_given_is_what_ours_took(data, tmp_path):
    pytest.importorskip("sionna.rt", reason="Sionna RT is an extra", exc_type=ImportError)
    methods = tuple(m for m in METHODS if m != "sionna-again")
    found = evaluate(tmp_path, data, methods=methods)
    rows = {row["method"]: row for row in unpacked(found)}
    assert list(rows) == list(methods) and found["missing"] == []
    for method, row in rows.items():
        assert row["count"] == (0 if METHODS[method].untaught else 4)
        given = ("psnr_db", "ssim", "rmse_db", "seconds_per_spectrum", "model_mib")
        assert None not in [row[name] for name in given]
    for method in ("rf3dgs+", "rf3dgs", "rf3dgs+alpha", "rf3dgs-alpha"):
        assert rows["constant"]["psnr_db"] < rows[method]["psnr_db"] < rows["bistatic"]["psnr_db"] - 3
    ours, other = rows["bistatic"], rows["sionna-calibrated"]
    assert other["fit_s"] > 0.9 * (ours["transport_s"] + ours["fit_s"])
    assert "| RF-3DGS+ |" in (tmp_path / "paper.md").read_text()


def test_data_sets_of_any_room_stand_beside_each_other_and_no_run_is_done_twice(data, tmp_path, monkeypatch):
    methods = ("cgan", "nearest", "idw")
    evaluate(tmp_path, data, methods=methods)
    receivers = np.random.default_rng(0).uniform([0.3, 0.3, 0.5], [2.7, 1.7, 2.2], (6, 3))
    box = wr.Mesh(*box_mesh([0, 0, 0], [3, 2, 2.5], inward=True))
    write_mesh(tmp_path / "box.ply", box.vertices, box.faces)
    wr.simulate(
        wr.Scene(box, [itu_material("concrete")], np.zeros(len(box.faces), int)), transmitter=(0.5, 0.4, 2.0),
        receivers=receivers, frequency_hz=28e9, shape=(8, 16), roles=["train"] * 4 + ["test"] * 2, device="cpu",
    ).save(tmp_path / "box.nc")  # fmt: skip
    other = {"data": str(tmp_path / "box.nc"), "room": str(tmp_path / "box.ply"), "counts": (2, 4, 400)}
    found = evaluate(tmp_path, data, methods=(*methods, "zero"), **other)
    assert carried_out(found)[:3] == [("spectra", m, 4) for m in methods]
    wanted = [*(("box", m, n) for m in methods for n in (2, 4)), ("box", "zero", 0)]
    assert sorted(carried_out(found)[3:]) == sorted(wanted)

    done = []
    whole = evaluation._Lab.one

    def noted(lab, about, ours):
        done.append(about["method"])
        return whole(lab, about, ours)

    monkeypatch.setattr(evaluation._Lab, "one", noted)
    again = evaluate(tmp_path, data, methods=methods)
    assert done == [] and again == found
    evaluate(tmp_path, data, methods=methods, steps=4)
    assert done == ["cgan"]  # a lookup does not feel the steps
    monkeypatch.setitem(VERSIONS, "lookups", 99)
    evaluate(tmp_path, data, methods=methods, steps=4)
    assert done == ["cgan", "nearest", "idw"]


def test_a_name_stands_for_data_that_some_of_its_runs_are_of(data, tmp_path):
    first = evaluate(tmp_path, data, methods=("nearest",))
    ds = wr.SpectrumDataset.load(data / "spectra.nc")
    ds.subset(np.arange(1, len(ds))).save(tmp_path / "fewer.nc")
    fewer = {"data": str(tmp_path / "fewer.nc"), "name": "spectra", "counts": (3,), "methods": ("idw",)}
    with pytest.raises(ValueError, match="name: .*holds runs of spectra on other data"):
        evaluate(tmp_path, data, **fewer)
    assert json.loads((tmp_path / "paper.json").read_text()) == first
    more = evaluate(tmp_path / "fewer", data, **fewer)
    both = first | {"runs": first["runs"] + more["runs"]}
    (tmp_path / "paper.json").write_text(json.dumps(both))
    assert evaluate(tmp_path, data, **fewer) == both | {"machine": more["machine"]}
    again = evaluate(
        tmp_path, data, **fewer | {"data": str(data / "spectra.nc")}
    )  # of the first data, not yet done
    assert again["runs"][0] == first["runs"][0] and again["runs"][1] != more["runs"][0]


def test_a_killed_command_loses_the_run_at_work_and_says_what_is_missing(data, tmp_path):
    def killed(stage, done, total):
        if (stage, done) == ("runs", 1):
            raise KeyboardInterrupt

    methods = ("nearest", "mean", "constant")
    with pytest.raises(KeyboardInterrupt):
        evaluate(tmp_path, data, {"progress": killed}, methods=methods)
    left = json.loads((tmp_path / "paper.json").read_text())
    assert [m for _, m, _ in carried_out(left)] == ["nearest"]
    assert left["missing"] == ["spectra-random-4-0-constant", "spectra-random-4-0-mean"]
    found = evaluate(tmp_path, data, methods=methods[1:])
    assert len(found["runs"]) == 3 and found["missing"] == [] and found["runs"][0] == left["runs"][0]


def test_the_region_that_is_held_out_has_no_training_receiver(data, tmp_path):
    ds = wr.SpectrumDataset.load(data / "spectra.nc")
    part, x = region_held_out(ds), ds.receivers[:, 0]
    border = x.min() + 0.75 * np.ptp(x)  # the transmitter stands at the other end
    assert (part.receivers[part.role == "test", 0] > border).all()
    assert (part.receivers[part.role == "train", 0] <= border).all()
    found = evaluate(tmp_path, data, methods=("nearest",), counts=(2,), region=True)
    assert [(row["split"], row["count"]) for row in unpacked(found)] == [("region", 2)]


def run(method, count, seed, **figures):
    every = dict.fromkeys(COLUMNS) | dict.fromkeys(COMPARED, 1.0)
    about = {"truth": "exact", "split": "random", "count": count, "seed": seed, "method": method}
    return {**every, **about, "cores": 2, "peak_memory_gib": 1.0, "model_mib": 1.0, **figures}


def test_a_mean_is_of_every_seed_or_not_given_and_times_are_of_runs_that_had_all_cores():
    given = [
        run("rf3dgs+", 10, 0, psnr_db=22.0, transport_s=1.0, fit_s=2.0, tof_error_median_ns=1.0),
        run("rf3dgs+", 10, 1, psnr_db=26.0, transport_s=3.0, fit_s=20.0, cores=1, peak_memory_gib=3.0),
    ]
    (found,) = summarise(given)
    assert (found["psnr_db"], found["seeds"]) == (24.0, 2)
    assert (found["train_s"], found["peak_memory_gib"]) == (3.0, 3.0)
    assert found["psnr_db_std"] == pytest.approx(np.sqrt(8.0)) and found["tof_error_median_ns"] is None


def test_margins_pair_runs_of_the_same_spectra():
    rows = [
        *(run("bistatic", 10, seed, psnr_db=psnr) for seed, psnr in enumerate((30.0, 34.0, 35.0))),
        *(run("nearest", 10, seed, psnr_db=psnr) for seed, psnr in enumerate((20.0, 24.0))),
        run("zero", 0, 0, psnr_db=24.0),
        run("mean", 50, 0, psnr_db=40.0),
    ]
    nearest, zero = sorted(margins(rows), key=lambda line: line["method"])
    assert (nearest["psnr_db"], nearest["psnr_db_std"], nearest["seeds"]) == (10.0, 0.0, 2)
    assert (zero["psnr_db"], zero["seeds"]) == (9.0, 3)
    assert zero["psnr_db_std"] == pytest.approx(np.std([6.0, 10.0, 11.0], ddof=1))


def test_the_second_rooms_scene_and_spectra_are_read_back_as_they_were(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    source = tmp_path / "source"
    source.mkdir()
    trimesh.Trimesh(*box_mesh([0, 0, 0], [5, 4, 3], inward=True)).export(source / "conferenceroom.stl")
    options = newrf.Options(source=str(source), receivers=2, engine="exact", shape=(6, 12))
    receivers = np.random.default_rng(1).uniform(1, 2, (6, 3))
    np.savez(source / "newrf_conference.npz", receivers=receivers)
    execute(newrf.BENCHMARKS["newrf"], options, Job(tmp_path / "out", device="cpu"))
    ds = wr.SpectrumDataset.load(tmp_path / "out" / "spectra.nc")
    assert sorted(ds.role) == ["test"] * 2 + ["train"] * 2
    assert all(np.isclose(receivers, at).all(axis=1).any() for at in ds.receivers)
    scene = wr.Scene.load(tmp_path / "out" / "scene.xml")
    for name, upward in (("floorboard", 1.0), ("ceiling_board", -1.0), ("plasterboard", 0.0)):
        own = [scene.materials[k].name == name for k in scene.face_material]
        assert scene.mesh.face_normals[own, 2] == pytest.approx(upward, abs=1e-6)
        used = scene.materials[scene.face_material[own][0]]
        assert used.scattering == newrf.SCATTERING[name] and used.permittivity(300e9)
