"""Experiments are rows of fits: whole once on a small room, then resumed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_room import SHAPE, small_room

import warprrf as wr
from benchmarks import bistatic, fits
from benchmarks.methods import point_at_transmitter
from benchmarks.runner import Job, execute
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.spectra.metrics import angle_deg, strongest_direction

LEFT_OUT = ("no mirrors", "no scattering")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_room(tmp_path_factory.mktemp("room"))


def whole(out: Path, room: Path, **changed: Any) -> dict[str, Any]:
    options = {
        "data": (str(room),),
        "geometry": str(room / "reconstruction"),
        "truths": ("exact",),
        "counts": (8,),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bistatic, "ABLATION", {name: bistatic.ABLATION[name] for name in LEFT_OUT})
        return execute(
            bistatic.BENCHMARKS["bistatic"], fits.FitOptions(**options | changed), Job(out, device="cpu")
        )


@pytest.fixture(scope="module")
def finished(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("runs") / "whole"
    return out, whole(out, room)


def test_every_part_has_its_row_and_parts_are_worth_something(finished: tuple[Path, dict[str, Any]]) -> None:
    out, found = finished
    psnr = {row["model"]: row["psnr_db"] for row in found["ablation"]}
    assert set(psnr) == {"everything", *LEFT_OUT, "true mesh, its materials as groups", "zero spectra"}
    assert psnr["no scattering"] < psnr["everything"] - 3 and psnr["zero spectra"] < psnr["everything"] - 3
    assert [len(found[part]) for part in ("calibration", "delays")] == [1, 1]
    assert "| exact | 8 | no mirrors |" in (out / "bistatic.md").read_text()


def test_on_the_true_mesh_delays_are_right(finished: tuple[Path, dict[str, Any]]) -> None:
    (row,) = finished[1]["delays"]
    assert row["found"] > 0.9 and row["mirror_ns"] < 1e-6 and row["scattering_ns"] < 1.0  # 15 degrees a pixel


def test_finished_rows_are_not_made_again_and_a_killed_run_loses_one(
    finished: tuple[Path, dict[str, Any]], room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    real = fits.Fits.fit

    def fit(self: fits.Fits, geometry: Any, data: Any, **options: Any) -> Any:
        made.append(options)
        if len(made) == 3:
            raise KeyboardInterrupt
        return real(self, geometry, data, **options)

    monkeypatch.setattr(fits.Fits, "fit", fit)
    assert whole(finished[0], room) == finished[1] and made == []
    with pytest.raises(KeyboardInterrupt):
        whole(tmp_path, room)
    again = whole(tmp_path, room)
    assert len(made) == 3 + 3  # the third was lost; it and two more are made
    assert [row["psnr_db"] for row in again["ablation"]] == [
        row["psnr_db"] for row in finished[1]["ablation"]
    ]


def test_calibration_of_errors_that_are_as_large_as_stated(room: Path) -> None:
    ds = wr.SpectrumDataset.load(room / "spectra.nc")
    test = replace(ds, path_gain=np.full_like(ds.path_gain, 1e3 * ds.floor))
    rng = np.random.default_rng(0)

    def spectrum(receiver: np.ndarray, uncertainty: bool) -> Any:
        sigma = np.exp(rng.normal(0.0, 0.8, SHAPE))
        gain = (1e3 + 1) * test.floor * 10 ** (rng.normal(0.0, sigma) / 10) - test.floor
        return SimpleNamespace(path_gain=gain, std_db=sigma)

    row = bistatic.calibration(SimpleNamespace(spectrum=spectrum), test)
    # 14 x 288 independent pixels: the standard deviation of a share is at most 0.8 %
    assert row["within_1_sigma"] == pytest.approx(0.683, abs=0.03)
    assert row["within_2_sigma"] == pytest.approx(0.954, abs=0.02)
    assert row["rms_error_db"] == pytest.approx(np.exp(0.8**2), rel=0.1)  # root mean square of the deviations


def test_point_at_the_transmitter_is_a_beam_of_friis_gain(room: Path) -> None:
    ds = wr.SpectrumDataset.load(room / "spectra.nc")
    toward = ds.transmitter - ds.receivers[0]
    distance = np.linalg.norm(toward)
    gain = point_at_transmitter(ds)(ds.receivers[0]).path_gain
    assert gain.sum() == pytest.approx((SPEED_OF_LIGHT / 300e9 / (4 * np.pi * distance)) ** 2, rel=1e-5)
    assert angle_deg(strongest_direction(gain), toward / distance) < 180 / SHAPE[0]


def test_bad_options_are_named(room: Path, tmp_path: Path) -> None:
    for options, name in (
        ({"counts": (400,)}, "counts"),
        ({"every": 0}, "every"),
        ({"truths": ("measured",)}, "truths"),
    ):
        with pytest.raises(ValueError, match=f"^{name}: got"):
            whole(tmp_path, room, **options)
    with pytest.raises(ValueError, match=r"geometry: .*none.*benchmarks lobby"):
        whole(tmp_path, room, geometry=str(tmp_path / "none"))
