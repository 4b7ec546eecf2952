"""Experiments are rows of fits: whole once on a small room, then resumed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from small_room import small_room

from benchmarks import bistatic, fits
from benchmarks.runner import Job, execute

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


def test_every_part_is_worth_something_and_delays_are_right(finished: tuple[Path, dict[str, Any]]) -> None:
    _, found = finished
    psnr = {row["model"]: row["psnr_db"] for row in found["ablation"]}
    assert set(psnr) == {"everything", *LEFT_OUT, "true mesh, its materials as groups", "zero spectra"}
    assert psnr["no scattering"] < psnr["everything"] - 3 and psnr["zero spectra"] < psnr["everything"] - 3
    (row,) = found["delays"]  # on the true mesh
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
