"""What the parts of the bistatic field are worth on a small room: whole once, then resumed, changed, and read."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_room import SHAPE, small_room

import warprrf as wr
from benchmarks import __main__ as command
from benchmarks import data as setting
from benchmarks.bistatic import checks, table
from benchmarks.bistatic.table import HARMONIC
from benchmarks.methods import METHODS, Effort, point_at_transmitter
from benchmarks.runner import Job, execute
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.spectra.metrics import angle_deg, strongest_direction

COUNTS = {"exact": (4, 10), "sionna": (4,)}
SECOND_AT = (4.3, 3.2, 2.4)
OPTIONS: dict[str, Any] = {
    "counts": (4, 10, 400), "second_at": SECOND_AT, "effort": Effort(harmonic_iterations=40),
}  # fmt: skip
FILLED = (
    "psnr_db",
    "ssim",
    "rmse_db",
    "direction_within_3deg",
    "beam_gain_loss_db_blocked",
    "seconds_per_spectrum",
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_room(tmp_path_factory.mktemp("room"))


def whole(out: Path, room: Path, **changed: Any) -> dict[str, Any]:
    options = {"data": (str(room),), "geometry": str(room / "reconstruction"), **OPTIONS, **changed}
    return execute(table.BENCHMARKS["bistatic"], table.Options(**options), Job(out, device="cpu"))


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("runs") / "whole"
    return out, whole(out, data)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the rows that are computed, in order."""
    names: list[str] = []
    run = table.Steps.run

    def recorded(self: Any, name: str, make: Any, **options: Any) -> Any:
        def noted(attempt: Any) -> Any:
            names.append(name)
            return make(attempt)

        return run(self, name, noted, **options)

    monkeypatch.setattr(table.Steps, "run", recorded)
    monkeypatch.setattr(table.report, "pictures", lambda *_: {})  # pictures are looked at once
    return names


def test_every_field_has_a_row(finished: tuple[Path, dict[str, Any]]) -> None:
    out, found = finished
    rows = {(row["truth"], row["n_train"], row["method"]): row for row in found["rows"]}
    expected = {
        (truth, count, method)
        for truth, counts in COUNTS.items()
        for method, at in {
            "zero": (0,),
            "bistatic": counts,
            **dict.fromkeys(HARMONIC, counts[:1]),
        }.items()
        for count in at
    }
    assert set(rows) == expected
    assert len(found["rows"]) == len(expected)
    assert [(key, name) for key, row in rows.items() for name in FILLED if row.get(name) is None] == []
    assert [found["data"][truth]["left_out"] for truth in COUNTS] == [[400], [10, 400]]
    assert [len(found[name]) for name in ("calibration", "delays", "second")] == [3, 3, 3]
    assert len(found["ablation"]) == 2 * (3 + len(checks.ABLATION))
    assert json.loads((out / "bistatic.json").read_text()) == found


def test_the_better_variant_is_compared(finished: tuple[Path, dict[str, Any]]) -> None:
    _, found = finished
    harmonic = [row for row in found["rows"] if row["method"] in HARMONIC]
    for row in harmonic:
        assert set(row["variants"]) == {"exp", "linear"}
        assert row["psnr_db"] == row["variants"][row["variant"]] == max(row["variants"].values())


def test_on_the_true_mesh_delays_are_right_and_the_model_is_ahead(
    finished: tuple[Path, dict[str, Any]],
) -> None:
    _, found = finished
    for row in found["delays"]:
        assert row["line_of_sight"]["found"] == 1.0
        assert row["line_of_sight"]["p90_ns"] < 1e-6
        assert row["mirror"]["found"] > 0.9
        assert row["mirror"]["median_ns"] < 1e-6
        assert row["scattering"]["pixels"] > 100
        assert row["scattering"]["median_ns"] < 1.0  # pixels are 15 degrees wide
        assert row["scattering"]["median_by_power_ns"] < 1.0
    psnr = {(row["truth"], row["n_train"], row["method"]): row["psnr_db"] for row in found["rows"]}
    for (truth, count, method), value in psnr.items():
        if method in HARMONIC:
            assert psnr[truth, count, "bistatic"] > value + 3
    parts = {row["model"]: row["psnr_db"] for row in found["ablation"] if row["truth"] == "exact"}
    assert parts["no scattering"] < parts["everything"] - 3


def test_the_second_transmitter_is_scored_by_both_ranges(finished: tuple[Path, dict[str, Any]]) -> None:
    out, found = finished
    ours = found["second"][0]
    first = next(
        r for r in found["rows"] if (r["method"], r["truth"], r["n_train"]) == ("bistatic", "exact", 4)
    )
    second = wr.SpectrumDataset.load(out / "second_exact.nc")
    assert np.allclose(second.transmitter, SECOND_AT)
    assert ours["seen"]["psnr_db"] == first["psnr_db"]
    field = wr.RadioField.load(out / first["field"])
    assert (second.floor, second.range_db) != (field.floor, field.range_db)
    assert ours["psnr_db"] != ours["first_range"]["psnr_db"]
    assert ours["psnr_db"] > 22
    assert ours["psnr_db"] > max(row["psnr_db"] for row in found["second"][1:])


def test_text_has_what_was_asked_beside_what_was_measured(finished: tuple[Path, dict[str, Any]]) -> None:
    out, found = finished
    text = (out / "bistatic.md").read_text()
    measured = next(r for r in found["calibration"] if (r["truth"], r["n_train"]) == ("exact", 10))
    share = measured["within_1_sigma"]
    verdict = "met" if share >= 0.6 else "NOT met"
    assert f"| pixels within 1 sigma, exact, 10 spectra | at least 0.6 | {share:.4g} | {verdict} |" in text
    for name in ("ablation.png", "reliability.png"):
        assert f"({name})" in text
        assert (out / name).read_bytes()[:4] == b"\x89PNG"


def test_finished_rows_are_not_made_again(
    finished: tuple[Path, dict[str, Any]], data: Path, made: list[str]
) -> None:
    out, found = finished
    again = whole(out, data)
    assert made == []
    assert again == found | {"seconds": again["seconds"]}


def test_a_lost_row_is_made_again_alone(
    finished: tuple[Path, dict[str, Any]], data: Path, made: list[str], tmp_path: Path
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(finished[0], out)
    (out / ".steps/exact-0-zero.json").unlink()
    whole(out, data)
    assert made == ["exact-0-zero"]


def test_a_killed_run_loses_the_row_it_was_at_and_a_changed_option_makes_all_again(
    finished: tuple[Path, dict[str, Any]],
    data: Path,
    made: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def killed(*_: Any) -> Any:
        raise KeyboardInterrupt

    out = tmp_path / "copy"
    shutil.copytree(finished[0], out)
    fewer = {"counts": (4,), "truths": ("exact",), "every": 2}
    with monkeypatch.context() as patch:
        patch.setattr(checks, "calibration", killed)
        with pytest.raises(KeyboardInterrupt):
            whole(out, data, **fewer)
        variants = [f"exact-4-{m}-{v}" for m in HARMONIC for v in METHODS[m].variants]
        ablation = [name for name in made if name.startswith("ablation-")]
        assert made == ["exact-0-zero", "exact-4-bistatic", *variants, *ablation, "calibration-exact-4"]
        assert len(ablation) == len(checks.ABLATION)
        made.clear()
        with pytest.raises(KeyboardInterrupt):
            whole(out, data, **fewer)
        assert made == ["calibration-exact-4"]
    record = json.loads((out / ".steps/exact-0-zero.json").read_text())
    assert record["figures"]["receivers"] == 2


def test_point_at_the_transmitter_is_a_beam_of_friis_gain(data: Path) -> None:
    ds = wr.SpectrumDataset.load(data / "spectra.nc")
    receiver = ds.receivers[0]
    spectrum = point_at_transmitter(ds)(receiver)
    toward = ds.transmitter - receiver
    distance = np.linalg.norm(toward)
    friis = (SPEED_OF_LIGHT / 300e9 / (4 * np.pi * distance)) ** 2
    assert spectrum.path_gain.sum() == pytest.approx(friis, rel=1e-5)
    assert angle_deg(strongest_direction(spectrum.path_gain), toward / distance) < 180 / SHAPE[0]
    lit = spectrum.path_gain > 0
    assert np.allclose(spectrum.delay_s[lit], distance / SPEED_OF_LIGHT)
    assert np.isnan(spectrum.delay_s[~lit]).all()


def test_calibration_of_errors_that_are_as_large_as_stated(data: Path) -> None:
    truth = setting.Truth.load(data / "spectra.nc", (4,), 1)
    flat = replace(truth.data, path_gain=np.full_like(truth.data.path_gain, 1e3 * truth.data.floor))
    truth = replace(truth, data=flat)
    rng = np.random.default_rng(0)

    def spectrum(receiver: np.ndarray, uncertainty: bool) -> Any:
        sigma = np.exp(rng.normal(0.0, 0.8, SHAPE))
        error = rng.normal(0.0, sigma)
        gain = (1e3 + 1) * flat.floor * 10 ** (error / 10) - flat.floor
        return SimpleNamespace(path_gain=gain, std_db=sigma)

    field: Any = SimpleNamespace(errors=SimpleNamespace(outlier_db=30.0), spectrum=spectrum)
    row = checks.calibration(field, truth, lambda *_: None)
    # 4 x 288 independent pixels: the standard deviation of a share is at most 1.5 %.
    assert row["within_1_sigma"] == pytest.approx(0.683, abs=0.05)
    assert row["within_1_sigma_lit"] == row["within_1_sigma"]  # all are 30 dB above the floor
    assert row["within_2_sigma"] == pytest.approx(0.954, abs=0.03)
    assert np.abs(np.array(row["shares"]) - row["levels"]).max() < 0.06
    assert row["nll_gaussian"] == pytest.approx(
        0.5 + 0.5 * np.log(2 * np.pi), abs=0.12
    )  # mean of ln sigma is 0
    assert row["nll"] == pytest.approx(row["nll_gaussian"] - np.log(0.95), abs=0.03)  # none is an outlier
    assert row["nll"] < row["nll_constant"] - 0.3


def test_bad_options_are_named(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options, name in (
        ({"counts": (11, 400)}, "counts"),
        ({"every": 0}, "every"),
        ({"truths": ("measured",)}, "truths"),
    ):
        with pytest.raises(ValueError, match=f"^{name}: got"):
            whole(tmp_path, data, **options)
    with pytest.raises(ValueError, match=r"geometry: .*none.*benchmarks lobby"):
        whole(tmp_path, data, geometry=str(tmp_path / "none"))
    with pytest.raises(ValueError, match="both exact"):
        whole(tmp_path, data, data=(str(data / "spectra.nc"),) * 2)
    words = ["bistatic", "--data", str(tmp_path), "--geometry", str(data), "--out", str(tmp_path), "--quiet"]
    assert command.main(words) == 2
    assert "spectra_full.nc or spectra.nc" in capsys.readouterr().err
