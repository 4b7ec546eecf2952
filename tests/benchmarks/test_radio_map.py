"""The radio map's benchmark: its arithmetic, and a small run of both maps on the lobby."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import LOBBY

from benchmarks import radio_map as bench
from benchmarks.runner import Job
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.materials import Terms
from warprrf.rf.maps.radio_map import RadioMap
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset


def test_errors_of_a_map_that_is_two_decibels_too_strong_where_blocked() -> None:
    truth = np.full((4, 5), 1e-10)
    blocked = np.zeros((4, 5), bool)
    blocked[0] = True
    counted = np.ones((4, 5), bool)
    counted[:, 4] = False
    values = np.where(blocked, truth * 10**0.2, truth)
    values[1, 4] = np.nan  # not counted
    found = bench.errors(values, truth, counted, blocked, -130.0)
    assert found["rms_blocked_db"] == pytest.approx(2.0)
    assert found["rms_seen_db"] == pytest.approx(0.0, abs=1e-12)
    assert found["rms_db"] == pytest.approx(2.0 * np.sqrt(4 / 16))
    assert found["bias_db"] == pytest.approx(0.5)
    assert found["median_db"] == pytest.approx(0.0, abs=1e-12)
    empty = bench.errors(np.zeros((4, 5)), truth, counted, blocked, -130.0)
    assert empty["rms_db"] == pytest.approx(30.0)  # an empty cell has the lowest level


def test_equal_error_is_found_between_rows_on_the_law_of_monte_carlo() -> None:
    theirs = [
        {"samples": n, "core_s": n * 1e-6, "wall_s": n * 2e-6, "rms_seen_db": None, "rms_blocked_db": 9.0}
        | {"rms_db": 1000.0 / np.sqrt(n)}
        for n in (10_000, 1_000_000)
    ]
    found = bench.at_equal_error({"rms_db": 2.5, "rms_seen_db": 1.0, "rms_blocked_db": 1.0}, theirs)
    assert found["rms_db"]["samples"] == pytest.approx((1000.0 / 2.5) ** 2)
    assert found["rms_db"]["core_s"] == pytest.approx(0.16)
    assert found["rms_seen_db"] is None  # not measured
    assert found["rms_blocked_db"] is None  # never reached


def test_mean_over_a_cell_leaves_out_what_is_no_air() -> None:
    fine = np.array([[1.0, 2.0, np.nan, np.nan], [3.0, np.nan, np.nan, np.nan]])
    np.testing.assert_array_equal(bench._mean_of_four(fine), [[2.0, np.nan]])


def test_both_maps_of_the_lobby_agree_where_the_transmitter_is_seen(tmp_path: Path) -> None:
    pytest.importorskip("sionna.rt")
    ds = SpectrumDataset.load(LOBBY / "spectra_sionna.nc")
    field = BistaticField.prior(Scene.load(LOBBY / "scene.xml"), ds, terms=Terms(mirror_order=1))
    options = bench.Options(
        scene=str(LOBBY / "scene.xml"), cell=1.5, shapes=((5, 10), (10, 20)), samples=(1_000, 100_000), reference=400_000
    )  # fmt: skip

    def run(field: BistaticField) -> dict[str, Any]:
        return bench.run(options, Job(tmp_path), field).write(tmp_path)

    report = run(field)
    # With line of sight the rest is worth a decibel, whatever the materials are taken for.
    assert report["ours"][1]["rms_seen_db"] < 1.5
    few, many = report["sionna"]
    assert few["rms_db"] > 2.0 * many["rms_db"]
    assert report["reference"]["rms_db"] < many["rms_db"] < 2.0
    assert abs(many["bias_db"]) < 1.0
    assert json.loads((tmp_path / "map.json").read_text())["cells"] == report["cells"]
    assert RadioMap.load(tmp_path / "map.nc").free.sum() == report["cells"]
    assert "RadioMapSolver, 1e+05 samples" in (tmp_path / "map.md").read_text()
    kept = (tmp_path / "reference.npz").stat().st_mtime_ns
    assert [(r["rays"], r["mirrors"], r["average"]) for r in report["ours"]] == [
        (200, 1, 1), (800, 1, 1), (200, 1, 4),
    ]  # fmt: skip
    longer = replace(field, terms=replace(field.terms, mirror_order=3))
    again = run(longer)
    assert [(r["rays"], r["mirrors"], r["average"]) for r in again["ours"]] == [
        (200, 3, 1), (800, 3, 1), (200, 2, 1), (200, 2, 4),
    ]  # fmt: skip
    assert again["ours"][2]["rms_to_finest_db"] > again["ours"][0]["rms_to_finest_db"]
    assert "200 rays, 2 mirrors, centre" in (tmp_path / "map.md").read_text()
    assert (tmp_path / "reference.npz").stat().st_mtime_ns == kept
    assert again["reference"] == report["reference"]


def test_a_run_asks_for_a_bistatic_field_and_something_to_measure(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shapes, samples: got"):
        bench.Options(shapes=())
    with pytest.raises(FileNotFoundError):
        bench.run(bench.Options(field=str(tmp_path / "none.safetensors")), Job(tmp_path))
