"""The engine's evaluation: its references are right, its errors move as they must, and a run goes on where it was."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
from places import LOBBY

pytest.importorskip("matplotlib")
pytest.importorskip("open3d")

from benchmarks.engine import knobs, table
from benchmarks.engine.forms import FORMS, response_forms
from benchmarks.runner import Job, execute
from warprrf.geometry.splats.rasterizer import RADIO

TINY = table.Sizes(
    gaussians=600,
    shape=(12, 24),
    counts=(300, 1000),
    shapes=((6, 12), (12, 24)),
    top_k=(1, 4, 64),
    form_gaussians=100,
    rays=500,
    triangles=200,
    blend=(50, 20, 16),
    repeats=1,
)


@pytest.fixture(scope="module")
def scene():
    return knobs.Scene(2000, (16, 32), device="cpu")


def test_smaller_cutoffs_and_longer_lists_err_less(scene):
    errors = [r["error_rms_db"] for r in knobs.cutoff_rows(scene, (0.1, 1e-2, 1e-3, 1e-5), repeats=1)]
    assert (np.diff(errors) < 0).all() and errors[0] > 1 and errors[-1] < 0.02
    rows = knobs.top_k_rows(scene, (1, 4, 16, 64), repeats=1)
    errors = [r["error_rms_db"] for r in rows]
    assert (np.diff(errors) <= 0).all() and errors[0] > 0.5 and errors[-1] < 1e-4


def test_float64_agrees_with_rays_traced_one_by_one(scene):
    rows = {r["value"]: r for r in knobs.precision_rows(scene, pixels=300, repeats=1)}
    assert rows["float64"]["error_worst_db"] < 1e-9
    assert rows["float64"]["error_rms_db"] < rows["float32"]["error_rms_db"] < 1e-3


def test_finer_grids_and_more_discs_err_less(scene):
    rows = knobs.resolution_rows(scene, ((8, 16), (16, 32), (32, 64)), repeats=1)
    assert (np.diff([r["error_rms_db"] for r in rows]) < 0).all()
    few, many = (knobs.growth_row(n, (24, 48), repeats=1, device="cpu") for n in (500, 10_000))
    assert many["error_rms_db"] < 0.5 * few["error_rms_db"]
    assert many["range_error_median_m"] < few["range_error_median_m"] < 1e-3


def test_the_image_s_error_is_what_is_put_in():
    reference = np.array([[1.0, 1e-2], [1e-4, 0.0]])
    found = knobs.error_of(reference * 10**0.1, reference)
    assert found["error_total_db"] == pytest.approx(1.0)
    # The floor takes its share where there is little: 1e-6 of the brightest.
    expected = [1.0, 1.0, 10 * np.log10((1e-4 * 10**0.1 + 1e-6) / (1e-4 + 1e-6)), 0.0]
    assert found["error_rms_db"] == pytest.approx(np.sqrt(np.mean(np.square(expected))), rel=1e-3)


def test_forms_of_the_response_err_as_their_cancellation_says():
    rows = {(r["regime"], r["form"]): r for r in response_forms(gaussians=300, repeats=1)}
    assert len(rows) == 3 * len(FORMS)
    near, small, needle = dict.fromkeys(r for r, _ in rows)
    for form in ("offset first", "Gram, turned"):
        assert rows[near, form]["error_mean"] < 3e-6
        assert rows[small, form]["error_mean"] < 2e-4 and rows[needle, form]["error_mean"] < 1e-3
    assert rows[small, "textbook"]["negative"] > 0.2 and rows[small, "quadratic 3x3"]["error_mean"] > 0.1
    assert rows[needle, "Gram"]["error_mean"] > 20 * rows[needle, "Gram, turned"]["error_mean"]


def test_the_mesh_hit_is_exact_and_the_centre_errs_by_a_discs_size():
    rows = knobs.point_rows(1500, 2, (16, 32), device="cpu")
    error = {row["interaction_point"]: row["length_error_median_m"] for row in rows}
    assert list(error) == ["centre", "peak", "expected", "mesh"]
    assert error["mesh"] < 1e-9
    assert error["peak"] < error["centre"]
    spacing = np.sqrt(672.0 / 1500)  # m: 672 m^2 of surface
    assert 0.01 * spacing < error["centre"] < spacing
    assert all(row["milliseconds_per_receiver"] > 0 for row in rows)


@pytest.mark.slow
def test_a_run_writes_tables_and_pictures_and_is_not_measured_twice(tmp_path, monkeypatch):
    run = partial(
        execute, table.BENCHMARKS["engine"], table.Options(scene=str(LOBBY / "scene.xml"), sizes=TINY)
    )
    found = run(Job(tmp_path, device="cpu"))
    for name in ("engine.json", "engine.md", "knobs.png", "growth.png"):
        assert (tmp_path / name).stat().st_size > 500
    text = (tmp_path / "engine.md").read_text()
    for title in ("Alpha cutoff", "Top K", "Growth", "Interaction point", "Mesh rays", "knobs.png"):
        assert title in text
    assert json.loads((tmp_path / "engine.json").read_text()) == found

    def fail(*_, **__):
        raise AssertionError("measured again")

    for name in ("ray_rows", "response_forms", "blend_figures"):
        monkeypatch.setattr(table, name, fail)
    for name in ("cutoff_rows", "top_k_rows", "growth_row", "point_rows"):
        monkeypatch.setattr(knobs, name, fail)
    again = run(Job(tmp_path, device="cpu"))
    assert again["top_k"] == found["top_k"] and again["growth"] == found["growth"]


def test_the_coarsest_setting_within_the_tolerance_is_picked():
    def row(value, rms, worst):
        return {"value": value, "error_rms_db": rms, "error_worst_db": worst}

    figures = {
        "alpha_min": [row(1e-2, 0.3, 5), row(1e-3, 0.04, 1.5), row(1e-4, 0.01, 0.3)],
        "top_k": [row(8, 0.2, 3), row(16, 0.01, 3)],
        "precision": [row("float32", 1e-5, 1e-4), row("float64", 0, 0)],
    }
    assert table.choices(figures) == {"alpha_min": 1e-3, "top_k": None, "precision": "float32"}


def test_the_scene_s_reference_is_out_of_reach_of_the_cutoffs(scene):
    assert knobs.TIGHT.alpha_min < 1e-3 * RADIO.alpha_min
    tighter = scene.reference(knobs.Blending(alpha_min=1e-12, alpha_max=1 - 1e-12, transmittance_min=1e-12))
    assert knobs.error_of(scene.reference(), tighter)["error_worst_db"] < 1e-3
