"""The paper's evaluation on a small room: whole once, resumed, spread over workers of which one is killed, and read."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_room import SHAPE, small_room

import warprrf as wr
from benchmarks.data import Geometry
from benchmarks.evaluation import command, comparison, conference, protocol, report, runs
from benchmarks.evaluation.lpips import Lpips
from benchmarks.evaluation.paper_law import paper_law_spectra
from benchmarks.evaluation.protocol import Place, Run, Setting
from benchmarks.evaluation.runs import Rows, estimate_s, missing, pictures_of, sweep
from benchmarks.methods import METHODS, Effort, Task, score
from benchmarks.runner import Job, execute
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.spectra.metrics import angle_deg
from warprrf.rf.spectra.spectrum import pixel_directions
from warprrf.steps import digest

EFFORT = Effort(
    harmonic_iterations=40, nerf2_iterations=3, nerf2_rays=16, nerf2_samples=4, cgan_iterations=2, cgan_batch=2,
    calibration_s=1.0, sionna_samples=20_000,
)  # fmt: skip
OPTIONS: dict[str, Any] = {"counts": (4,), "splits": ("random",), "seeds": (0,), "effort": EFFORT}
FILLED = (
    "psnr_db", "psnr_db_min", "psnr_db_max", "ssim", "rmse_db", "seconds_per_spectrum", "peak_memory_gib", "model_mib",
)  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_room(tmp_path_factory.mktemp("room"))


def whole(out: Path, data: Path, **changed: Any) -> dict[str, Any]:
    options = {"data": (str(data),), "geometry": str(data / "reconstruction"), **OPTIONS, **changed}
    return execute(command.BENCHMARKS["paper"], command.Options(**options), Job(out, device="cpu"))


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Every method on four receivers of both truths that need no Sionna."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    return out, whole(out, data, truths=("exact", "paper-law"))


def test_every_method_has_a_row_that_is_filled(finished: tuple[Path, dict[str, Any]]) -> None:
    out, found = finished
    rows = {(row["truth"], row["method"]): row for row in found["rows"]}
    expected = {("exact", m) for m in METHODS if m != "sionna-again"}
    assert set(rows) == expected | {("paper-law", m) for m in protocol.LAW_METHODS}
    assert [(key, name) for key, row in rows.items() for name in FILLED if row.get(name) is None] == []
    for (_, method), row in rows.items():
        assert row["count"] == (0 if METHODS[method].untaught else 4)
        assert row["psnr_db_min"] <= row["psnr_db"] <= row["psnr_db_max"]
        assert row["receivers"] == 4
    assert json.loads((out / "paper.json").read_text()) == found
    assert rows["exact", "bistatic"]["psnr_db"] > rows["exact", "rf3dgs+"]["psnr_db"] + 3
    for method in ("rf3dgs+", "rf3dgs", "rf3dgs+alpha", "rf3dgs-alpha"):
        assert rows["exact", method]["loss_last"] < rows["exact", method]["loss_first"]
        assert rows["exact", method]["psnr_db"] > rows["exact", "constant"]["psnr_db"]


def test_tables_state_what_was_published_and_where_ours_stands(finished: tuple[Path, dict[str, Any]]) -> None:
    out, found = finished
    text = (out / "paper.md").read_text()
    assert "| published | RF-3DGS+ (published) | 19.68 |" in text
    assert "other data and other hardware" in text
    assert "LPIPS: not computed" in text
    for name in ("spectra-exact.png", "speed-exact.png", "law.png", "sparsity.png", "learning.png"):
        assert f"({name})" in text
        assert (out / name).read_bytes()[:4] == b"\x89PNG"
    with (out / "paper.csv").open() as lines:
        table = list(csv.DictReader(lines))
    assert len(table) == len(found["rows"]) + len(report.PUBLISHED)
    assert [row["psnr_db"] for row in table if row["published"] == "1"] == ["19.68", "13.5", "13.34", "10.33"]


def test_methods_that_see_no_spectrum_have_no_curve(
    finished: tuple[Path, dict[str, Any]], data: Path, tmp_path: Path
) -> None:
    ask = {"truths": ("exact",), "methods": ("zero", "transmitter"), "minutes": 0.0}
    whole(tmp_path, data, rows=str(finished[0] / "rows.jsonl"), **ask)
    text = (tmp_path / "paper.md").read_text()
    assert "| none |" in text and "(sparsity.png)" not in text and "(speed-exact.png)" not in text


def test_what_others_are_given_is_what_ours_took(finished: tuple[Path, dict[str, Any]]) -> None:
    out, _ = finished
    kept = {row["method"]: row for row in Rows(out / "rows.jsonl") if row["truth"] == "exact"}
    ours, other = kept["bistatic"], kept["sionna-calibrated"]
    assert other["details"]["budget_s"] == pytest.approx(ours["transport_s"] + ours["fit_s"])
    assert other["details"]["steps"] >= 1
    assert other["fit_s"] > 0.9 * other["details"]["budget_s"] or other["details"]["steps"] == 1


def test_what_ours_took_is_known_from_an_earlier_sweep(data: Path, tmp_path: Path) -> None:
    rows, setting, given = Rows(tmp_path / "rows.jsonl"), setting_of(data), []
    ours, other = (Run("exact", "random", 4, 0, method) for method in ("bistatic", "sionna-calibrated"))

    def work(run: Run, setting: Setting, budget_s: float | None, *progress: Any) -> Any:
        given.append(budget_s)
        return {**vars(run), "key": run.key, "transport_s": 2.0, "fit_s": 5.0}, {}

    for run in (ours, other):
        sweep([run], setting, rows, tmp_path, workers=0, work=work)
    assert given == [None, 7.0]


def test_curves_reach_over_all_counts_and_the_finding_has_the_sign_of_every_set(
    finished: tuple[Path, dict[str, Any]], data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(finished[0], out)
    done = counted(monkeypatch)
    methods = ("rf3dgs+", "rf3dgs", "bistatic", "nearest")
    found = whole(out, data, truths=("exact", "paper-law"), counts=(4, 7), methods=methods)
    assert done and all("-random-7-s0-" in key for key in done)  # those of 4 are there
    text = (out / "paper.md").read_text()
    assert "RF-3DGS+ is ahead on" in text and "The paper found RF-3DGS+ +6.2 dB above RF-3DGS" in text
    pairs = {(line["truth"], line["count"]) for line in found["finding"]}
    assert pairs == {(t, n) for t in ("exact", "paper-law") for n in (4, 7)}
    rows = {(row["method"], row["count"]): row["psnr_db"] for row in found["rows"] if row["truth"] == "exact"}
    margin = next(m for m in found["margins"] if m["method"] == "nearest" and m["count"] == 7)
    assert margin["psnr_db"] == pytest.approx(rows["bistatic", 7] - rows["nearest", 7])


def test_rows_travel_without_their_folder_and_none_is_begun_after_the_time(
    finished: tuple[Path, dict[str, Any]], data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = counted(monkeypatch)
    rows = tmp_path / "kept.jsonl"
    shutil.copy(finished[0] / "rows.jsonl", rows)
    ask = {
        "truths": ("exact",),
        "methods": ("nearest", "mean"),
        "rows": str(rows),
        "counts": (4, 7),
        "minutes": 0.0,
    }
    found = whole(tmp_path / "elsewhere", data, **ask)
    assert done == [] and {row["count"] for row in found["rows"]} == {4}
    assert sorted(found["missing"]) == ["exact-random-7-s0-mean", "exact-random-7-s0-nearest"]
    content = {row["data"] for row in Rows(rows) if row["truth"] == "exact"}
    assert content == {digest(data / "spectra.nc")[:12]}  # every row says which data it is of
    whole(tmp_path / "elsewhere", data, **{**ask, "minutes": None})
    assert sorted(done) == sorted(found["missing"])
    rows.write_text(rows.read_text() + '{"known": "')
    with pytest.raises(ValueError, match=r"rows: line \d+ of .*kept\.jsonl is damaged"):
        whole(tmp_path / "elsewhere", data, **ask)


def test_rows_of_other_data_stand_beside_each_other(tmp_path: Path) -> None:
    run, rows = Run("exact", "random", 10, 0, "nearest"), Rows(tmp_path / "rows.jsonl")
    for made, psnr in (("sample", 20.0), ("full", 30.0)):
        rows.put(run, made, {"key": run.key, "psnr_db": psnr})
    again = Rows(rows.path)
    found = [again.get(run, made) for made in ("sample", "full", "other")]
    assert [row and row["psnr_db"] for row in found] == [20.0, 30.0, None]


def test_weights_of_some_receivers_are_taken_from_those_of_all(data: Path) -> None:
    ds = wr.SpectrumDataset.load(data / "spectra.nc")
    place, alone = (Geometry(data / "reconstruction", data / "scene.xml", "cpu") for _ in range(2))
    seconds = place.weights(ds)[1]
    found, share = place.weights(ds.subset([5, 2]))
    expected = alone.weights(ds.subset([5, 2]))[0]
    assert share == pytest.approx(seconds * 2 / len(ds))
    for name in ("receivers", "start", "gaussian", "weight", "dominant", "expected_range"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_an_estimate_is_the_time_of_the_nearest_finished_run() -> None:
    runs = [Run("exact", "random", n, 0, "bistatic") for n in (10, 700)]
    rows = [
        {"method": "bistatic", "count": 20, "wall_s": 30.0},
        {"method": "bistatic", "count": 400, "wall_s": 500.0},
    ]
    assert estimate_s(runs, rows) == 530.0
    assert estimate_s([Run("exact", "random", 10, 0, "nerf2")], rows) > 900  # what no row tells of is guessed


def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys of the runs that are carried out."""
    done: list[str] = []
    original = runs.write_arrays

    def noted(file: Path, *rest: Any) -> None:
        done.append(file.stem)
        original(file, *rest)

    monkeypatch.setattr(runs, "write_arrays", noted)
    return done


def test_finished_runs_are_kept_and_changed_options_are_not_mistaken(
    finished: tuple[Path, dict[str, Any]], data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(finished[0], out)
    done = counted(monkeypatch)
    few = {"methods": ("rf3dgs", "nearest"), "truths": ("exact",)}
    whole(out, data, **few)
    assert done == []
    whole(out, data, **few, effort=replace(EFFORT, harmonic_iterations=41))
    # a lookup does not feel the effort
    assert done == [f"exact-random-4-s0-rf3dgs-{gain}" for gain in ("exp", "linear")]


# --------------------------------------------------------------------------------------------------- the sets


def test_plan_has_every_run_that_the_paper_asks_for_and_none_twice() -> None:
    held = {(t, "random"): 700 for t in ("exact", "sionna", "paper-law")} | {("conference", "random"): 100}
    planned = protocol.plan({**held, ("exact", "region"): 500})
    assert len(planned) == len(set(planned))
    where = lambda method: {(r.truth, r.split, r.count, r.seed) for r in planned if r.method == method}  # noqa: E731
    counts, both = (10, 20, 50, 100, 200, 400), ("exact", "sionna")
    seeds = {(t, "random", n, s) for t in both for n in counts for s in (0, 1, 2)}
    # With all 700 the order of a seed changes nothing but the batches.
    fields = seeds | {(t, "random", 700, 0) for t in both} | {("exact", "region", 100, 0)}
    conference = {("conference", "random", n, 0) for n in (10, 100)}
    assert where("bistatic") == where("nearest") == fields | conference
    assert where("rf3dgs+") == fields | conference | {("paper-law", "random", n, 0) for n in (10, 100, 700)}
    few = {(t, "random", n, 0) for t in both for n in (10, 100, 700)}
    assert where("nerf2") == where("rf3dgs-alpha") == where("sionna-calibrated") == few
    assert where("zero") == {(t, "random", 0, 0) for t in both}
    assert {r.variant for r in planned if r.method == "rf3dgs"} == {"exp", "linear"}
    few_held = protocol.plan({("exact", "random"): 60}, methods=("nearest", "nerf2"))
    assert {(r.method, r.count) for r in few_held} == {("nearest", n) for n in (10, 20, 50)} | {("nerf2", 10)}


def test_region_split_holds_out_a_part_of_the_room(data: Path) -> None:
    ds = wr.SpectrumDataset.load(data / "spectra.nc")
    part = protocol.split_data(ds, "region")
    border = ds.receivers[:, 0].min() + 0.75 * np.ptp(
        ds.receivers[:, 0]
    )  # the transmitter stands at the other end
    assert (part.receivers[part.role == "test", 0] > border).all()
    assert (part.receivers[part.role == "train", 0] <= border).all()
    assert 0 < np.count_nonzero(part.role == "train") < 10
    assert np.array_equal(protocol.split_data(ds, "random").receivers, ds.receivers)
    with pytest.raises(ValueError, match="split: got 'half'"):
        protocol.split_data(ds, "half")


@pytest.mark.slow
def test_another_seed_of_sionna_is_near_but_not_the_same(data: Path, tmp_path: Path) -> None:
    pytest.importorskip("sionna.rt", reason="Sionna RT is an extra", exc_type=ImportError)
    geometry = Geometry(data / "reconstruction", data / "scene.xml")
    like = wr.SpectrumDataset.load(data / "spectra.nc").subset([0])
    truth = wr.simulate(
        geometry.scene, transmitter=like.transmitter, receivers=like.receivers, frequency_hz=300e9, shape=SHAPE,
        engine="sionna", depth=2, samples=200_000, beam_sigma_rad=like.beam_sigma_rad, roles=["test"],
    )  # fmt: skip
    task = Task(
        train=truth.subset([]), test=truth, geometry=geometry, scratch=tmp_path, progress=lambda *_: None,
        effort=Effort(sionna_samples=200_000), depth=2,
    )  # fmt: skip
    assert 20 < score("sionna-again", task)[1]["psnr_db"] < 100


def test_a_region_alone_is_a_report(data: Path, tmp_path: Path) -> None:
    found = whole(tmp_path, data, truths=("exact",), splits=("region",), methods=("nearest",), counts=(2,))
    assert [(row["split"], row["count"]) for row in found["rows"]] == [("region", 2)]


def test_paper_law_scales_scattering_by_the_share_of_the_first_leg(data: Path) -> None:
    ds = wr.SpectrumDataset.load(data / "spectra.nc")
    scene = wr.Scene.load(data / "scene.xml")
    exact, law = ds.subset([0, 1]), paper_law_spectra(scene, ds.subset([0, 1]), device="cpu")
    directions = pixel_directions(SHAPE)
    checked = 0
    for i, receiver in enumerate(exact.receivers):
        beyond = scene.mesh.cast(np.tile(receiver, (directions[..., 0].size, 1)), directions.reshape(-1, 3)).t
        second = beyond.reshape(SHAPE)
        total = exact.delay_s[i] * SPEED_OF_LIGHT
        expected = ((total - second) / total) ** 2
        toward = (ds.transmitter - receiver) / np.linalg.norm(ds.transmitter - receiver)
        ratio = law.path_gain[i].astype(float) / np.maximum(exact.path_gain[i], 1e-30)
        # Scattering alone: away from line of sight, where the delay is that of the surface in the pixel's direction.
        bounced = np.linalg.norm(receiver + second[..., None] * directions - ds.transmitter, axis=-1) + second
        alone = (np.abs(bounced - total) < 0.15) & (angle_deg(directions, toward) > 60)
        alone &= exact.path_gain[i] > ds.floor
        checked += int(alone.sum())
        assert np.median(np.abs(ratio[alone] / expected[alone] - 1)) < 0.2  # pixels are 15 degrees wide
    assert checked > 30
    assert (law.path_gain <= exact.path_gain * (1 + 1e-5)).all()
    assert np.array_equal(law.role, exact.role)


# --------------------------------------------------------------------------------------- figures from given rows


def row(method: str, count: int, seed: int, variant: str = "", **figures: Any) -> dict[str, Any]:
    every = {"psnr_db": 20.0, "ssim": 0.5, "rmse_db": 5.0, "seconds_per_spectrum": 0.1, **figures}
    every |= {"data": "d", "room": "r", "wall_s": 1.0}
    ends = {f"{n}_{e}": every.get(n, 1.0) for n in runs.SPREAD for e in ("min", "max")}
    return {
        "truth": "exact", "split": "random", "count": count, "seed": seed, "method": method, "variant": variant,
        "key": f"{method}{variant}{seed}", "note": "", "receivers": 4, "receivers_blocked": 1, "device": "cpu",
        "cores": 2, "processor": "x", "transport_s": 1.0, "fit_s": 2.0, "peak_memory_bytes": 2**30,
        "model_bytes": 2**20, "lpips": None, **ends, **every,
    }  # fmt: skip


def test_the_better_variant_of_each_seed_counts_and_seeds_are_averaged() -> None:
    rows = [
        row("rf3dgs+", 10, 0, "exp", psnr_db=21.0, psnr_db_min=10.0),
        row("rf3dgs+", 10, 0, "linear", psnr_db=22.0, psnr_db_min=9.0),
        row("rf3dgs+", 10, 1, "exp", psnr_db=26.0, psnr_db_min=12.0, lpips=0.1),
        row("rf3dgs+", 10, 1, "linear", psnr_db=25.0, psnr_db_min=2.0),
    ]
    (found,) = comparison.summarise(rows)
    assert (found["psnr_db"], found["psnr_db_min"], found["seeds"]) == (24.0, 9.0, 2)
    assert found["variants"] == ["exp", "linear"]
    assert (found["train_s"], found["model_mib"], found["lpips"]) == (3.0, 1.0, None)
    assert report.name_of(found) == "RF-3DGS+ (gain exp or gain linear)"


def test_training_time_is_of_runs_that_had_all_cores() -> None:
    (found,) = comparison.summarise(
        [row("bistatic", 10, 0), row("bistatic", 10, 1, cores=1, transport_s=3.0, fit_s=20.0)]
    )
    assert (found["train_s"], found["seeds"]) == (3.0, 2)


def test_finding_has_the_sign_that_was_found() -> None:
    rows = comparison.summarise(
        [
            row("rf3dgs+", 10, 0, "exp", psnr_db=21.0, fit_s=5.0, seconds_per_spectrum=0.4),
            row("rf3dgs", 10, 0, "exp", psnr_db=22.5),
            row("zero", 0, 0, psnr_db=24.0, rmse_db=6.0, transport_s=None, fit_s=None),
            row("bistatic", 10, 0, psnr_db=23.0, rmse_db=4.0),
            row("nearest", 50, 0, psnr_db=40.0),
        ]
    )
    (finding,) = comparison.paper_finding(rows)
    assert finding["psnr_db"]["difference"] == -1.5


def test_the_second_rooms_scene_is_read_back_as_it_was(tmp_path: Path) -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    mesh = wr.Mesh(vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3]]))
    scene = wr.Scene(mesh, conference.MATERIALS, np.array([0, 4, 0]))
    conference.write_scene(scene, tmp_path)
    found = wr.Scene.load(tmp_path / "scene.xml")
    order = np.argsort(scene.face_material, kind="stable")
    assert np.array_equal(found.mesh.triangles, mesh.triangles[order])
    for k, face in enumerate(order):
        was, now = (s.materials[s.face_material[i]] for s, i in ((scene, face), (found, k)))
        assert (now.name, now.scattering, now.permittivity(300e9)) == (
            was.name, was.scattering, was.permittivity(300e9),
        )  # fmt: skip


def test_margins_pair_runs_of_the_same_spectra() -> None:
    rows = [
        *(row("bistatic", 10, seed, psnr_db=psnr) for seed, psnr in enumerate((30.0, 34.0, 35.0))),
        *(row("nearest", 10, seed, psnr_db=psnr) for seed, psnr in enumerate((20.0, 24.0))),
        row("zero", 0, 0, psnr_db=24.0),
        row("mean", 50, 0, psnr_db=40.0),
    ]
    nearest, zero = sorted(comparison.margins(rows), key=lambda line: line["method"])
    assert (nearest["psnr_db"], nearest["psnr_db_std"], nearest["seeds"]) == (10.0, 0.0, 2)
    assert (zero["psnr_db"], zero["seeds"]) == (9.0, 3)
    assert zero["psnr_db_std"] == pytest.approx(np.std([6.0, 10.0, 11.0], ddof=1))


# ---------------------------------------------------------------------------------------- workers of a cluster


def slow_job(
    folder: str, run: Run, setting: Setting, budget_s: float | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Leaves a file named by run and process when it starts, and takes a while."""
    (Path(folder) / f"{run.count}.{os.getpid()}").touch()
    time.sleep(1.5)
    return {**vars(run), "key": run.key, "seconds": 1.5}, {
        "prediction_db": np.full((1, 2, 2), float(run.count))
    }


def setting_of(data: Path) -> Setting:
    place = Place(
        str(data / "spectra.nc"), "m", "c", str(data / "reconstruction"), "g", "h", str(data / "scene.xml")
    )
    return Setting(places=(("exact", place),), scratch=str(data / "scratch"), effort=EFFORT, device="cpu")


def test_a_killed_worker_loses_nothing(data: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    cloudpickle = pytest.importorskip("cloudpickle")
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    started = tmp_path / "started"
    started.mkdir()
    planned = [Run("exact", "random", n, 0, "nearest") for n in (1, 2, 3, 4)]
    killed: list[int] = []

    def kill_the_first() -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not killed:
            for file in started.iterdir():
                killed.append(int(file.suffix[1:]))
                os.kill(killed[0], signal.SIGKILL)
                break
            time.sleep(0.02)

    killer = threading.Thread(target=kill_the_first)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs="CRITICAL"
    ) as cluster:
        killer.start()
        rows = sweep(
            planned, setting_of(data), Rows(tmp_path / "rows.jsonl"), tmp_path, scheduler=cluster.scheduler_address,
            work=partial(slow_job, str(started)),
        )  # fmt: skip
    killer.join()
    assert killed
    assert [rows[run]["count"] for run in planned] == [1, 2, 3, 4]
    starts = [file.stem for file in started.iterdir()]
    again = [file.stem for file in started.iterdir() if file.suffix == f".{killed[0]}"]
    assert len(starts) > len(planned)  # what the killed one was at was done again, by another process
    assert all(starts.count(stem) >= 2 for stem in again[:1])
    for run in planned:
        with np.load(tmp_path / pictures_of(run)) as stored:
            assert stored["prediction_db"][0, 0, 0] == run.count
    assert not list(tmp_path.rglob("*.partial*"))


def test_a_killed_sweep_loses_the_run_it_was_at(data: Path, tmp_path: Path) -> None:
    planned = [Run("exact", "random", n, 0, "nearest") for n in (1, 2, 3)]
    done: list[int] = []

    def job(run: Run, setting: Setting, *_: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        done.append(run.count)
        if len(done) == 2:
            raise KeyboardInterrupt
        return {**vars(run), "key": run.key}, {"prediction_db": np.zeros((1, 2, 2))}

    options: dict[str, Any] = {"workers": 0, "work": job}
    file = tmp_path / "rows.jsonl"
    with pytest.raises(KeyboardInterrupt):
        sweep(planned, setting_of(data), Rows(file), tmp_path, **options)
    rows = sweep(planned, setting_of(data), Rows(file), tmp_path, **options)
    assert done == [1, 2, 2, 3]
    assert [rows[run]["count"] for run in planned] == [1, 2, 3]


def test_a_run_that_fails_is_named(data: Path, tmp_path: Path) -> None:
    def job(*_: Any) -> Any:
        raise OSError("disk full")

    planned = [Run("exact", "random", 1, 0, "nearest")]
    with pytest.raises(RuntimeError, match="exact-random-1-s0-nearest: OSError: disk full"):
        sweep(planned, setting_of(data), Rows(tmp_path / "rows.jsonl"), tmp_path, workers=0, work=job)


# ------------------------------------------------------------------------------------------------- the command


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"methods": ("nerf3",)}, "methods: got nerf3"),
        ({"counts": (0,)}, "counts: got"),
        ({"counts": (4000,), "methods": ("nearest",)}, "nothing is left to do"),
        ({"minutes": -1.0}, "minutes: got -1.0"),
        ({"truths": ("conference",)}, "truths: conference needs --room"),
        ({"lpips": ("one",), "methods": ("nearest",)}, "lpips: got 1 files"),
        ({"truths": ("sionna", "fake")}, "truths: got fake"),
        ({"workers": -1, "methods": ("nearest",)}, "workers: got -1"),
        ({"geometry": "nowhere"}, "geometry: there is no folder nowhere"),
    ],
)
def test_bad_options_are_named(data: Path, tmp_path: Path, wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        whole(tmp_path, data, **{"truths": ("exact",), **wrong})


@pytest.fixture
def weights(tmp_path: Path) -> tuple[Path, Path]:
    """Files of random weights, shaped as AlexNet's and LPIPS' are."""
    torch = pytest.importorskip("torch")
    r = torch.Generator().manual_seed(3)
    sizes = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
    backbone = {
        f"features.{k}.weight": torch.randn(n, m, w, w, generator=r) / (w * m**0.5)
        for k, (n, m, w) in sizes.items()
    }
    backbone |= {f"features.{k}.bias": torch.randn(n, generator=r) for k, (n, *_) in sizes.items()}
    layers = {
        f"lin{i}.model.1.weight": torch.rand(1, n, 1, 1, generator=r)
        for i, (n, *_) in enumerate(sizes.values())
    }
    files = tmp_path / "alexnet.pth", tmp_path / "lpips.pth"
    for state, file in zip((backbone, layers), files, strict=True):
        torch.save(state, file)
    return files


def test_lpips_is_the_distance_of_normalised_features_weighted_by_channel(
    weights: tuple[Path, Path],
) -> None:
    torch = pytest.importorskip("torch")
    assert "nothing is downloaded" in str(Lpips.found())
    backbone, layers = (torch.load(file, weights_only=True) for file in weights)
    found = Lpips.found([str(file) for file in weights])
    assert isinstance(found, Lpips)
    one, other = np.random.default_rng(4).random((2, 64, 70))
    # The same network from torch's own modules.
    net, taps = torch.nn, {1: 0, 4: 1, 7: 2, 9: 3, 11: 4}
    modules = [
        net.Conv2d(3, 64, 11, 4, 2), net.ReLU(), net.MaxPool2d(3, 2), net.Conv2d(64, 192, 5, padding=2), net.ReLU(),
        net.MaxPool2d(3, 2), net.Conv2d(192, 384, 3, padding=1), net.ReLU(), net.Conv2d(384, 256, 3, padding=1),
        net.ReLU(), net.Conv2d(256, 256, 3, padding=1), net.ReLU(),
    ]  # fmt: skip
    network = net.Sequential(*modules)
    network.load_state_dict({name.removeprefix("features."): value for name, value in backbone.items()})
    expected, now = 0.0, []
    for image in (one, other):
        grey = torch.tensor(image, dtype=torch.float32).expand(1, 3, 64, 70)
        shift, scale = (
            torch.tensor(v).view(3, 1, 1) for v in ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450])
        )
        now.append((2 * grey - 1 - shift) / scale)
    with torch.no_grad():
        for k, module in enumerate(network):
            now = [module(x) for x in now]
            if k in taps:
                a, b = (net.functional.normalize(x, dim=1) for x in now)
                weight = layers[f"lin{taps[k]}.model.1.weight"]
                expected += float(net.functional.conv2d((a - b) ** 2, weight).mean())
    assert found(one, other) == pytest.approx(expected, rel=1e-5) and expected > 0.01
    assert found(one, one) == 0.0
    weights[1].write_bytes(b"no weights")
    with pytest.raises(ValueError, match=r"lpips: .*lpips\.pth is no file of weights"):
        Lpips.found([str(file) for file in weights])


def test_rows_without_lpips_are_made_anew_once_its_weights_are_named(
    data: Path, weights: tuple[Path, Path], tmp_path: Path
) -> None:
    rows, planned = Rows(tmp_path / "rows.jsonl"), [Run("exact", "random", 1, 0, "nearest")]
    setting = setting_of(data)
    small = replace(setting, lpips=tuple(map(str, weights)))
    with pytest.raises(
        RuntimeError, match="lpips: got images of 12 x 24 pixels, AlexNet takes at least 31 x 31"
    ):
        sweep(planned, small, rows, tmp_path, workers=0)
    like = wr.SpectrumDataset.load(data / "spectra.nc")
    wr.simulate(
        wr.Scene.load(data / "scene.xml"), transmitter=like.transmitter, receivers=like.receivers[:3], shape=(31, 62),
        frequency_hz=300e9, beam_sigma_rad=like.beam_sigma_rad, roles=["train", "test", "test"], device="cpu",
    ).save(tmp_path / "spectra.nc")  # fmt: skip
    place = replace(setting.place("exact"), file=str(tmp_path / "spectra.nc"))
    without = replace(setting, places=(("exact", place),))
    named = replace(without, lpips=small.lpips)
    (first,) = sweep(planned, without, rows, tmp_path, workers=0).values()
    assert first["lpips"] is None and "nothing is downloaded" in first["lpips_reason"]
    assert sweep(planned, named, rows, tmp_path, workers=0, minutes=0.0) == {planned[0]: first}
    (second,) = sweep(planned, named, rows, tmp_path, workers=0).values()
    assert second["lpips"] > 0.0 and second["psnr_db"] == first["psnr_db"]
    assert not missing(planned, named, rows) and not missing(planned, without, rows)


def test_shown_receivers_are_one_with_line_of_sight_and_one_without() -> None:
    gain = np.arange(1, 6, dtype=float)[:, None, None] * np.ones((5, 2, 2))
    test: Any = SimpleNamespace(path_gain=gain, line_of_sight=np.array([True, True, False, False, True]))
    assert protocol.shown_receivers(test).tolist() == [1, 2]
