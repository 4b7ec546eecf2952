"""The paper's gap: its default is the library's field, other images lead back to path gain, and its law can win."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_room import small_room

import warprrf as wr
from benchmarks.data import Geometry
from benchmarks.evaluation import gap
from benchmarks.runner import Job, execute
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import pixel_solid_angles

STEPS = 30


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_room(tmp_path_factory.mktemp("room"))


def compare(data: Path, out: Path, *choices: str) -> dict[str, Any]:
    options = gap.Options(
        data=(str(data),), geometry=str(data / "reconstruction"), iterations=STEPS, choices=choices
    )
    return execute(gap.BENCHMARKS["gap"], options, Job(out, device="cpu"))


def test_the_default_is_the_librarys_field(data: Path, tmp_path: Path) -> None:
    rows = compare(data, tmp_path, "db", "linear")["rows"]
    train, test = SpectrumDataset.load(data / "spectra.nc").split(10)
    for row in rows:
        gain = "linear" if row["choice"] == "linear" else "exp"
        field = wr.RadioField.fit(
            wr.Reconstruction.load(data / "reconstruction"), train, model=row["model"], gain=gain,
            iterations=STEPS, device="cpu",
        )  # fmt: skip
        expected = wr.evaluate(test, field.spectrum)
        assert row["psnr_db"] == pytest.approx(expected["psnr_db"], abs=0.01)
        assert row["beam_gain_loss_db"] == pytest.approx(expected["beam_gain_loss_db"], abs=0.01)


def test_every_image_leads_back_to_path_gain(data: Path) -> None:
    ds = SpectrumDataset.load(data / "spectra.nc")
    ds = ds.subset([0, 0])  # of one receiver, so that the median range is its own
    strong = ds.path_gain > 1e3 * ds.floor
    for fitted, error_db in (("power", 1e-5), ("amplitude", 1e-5), ("set", 0.2), ("image", 0.2)):
        image, least, back, _ = gap.pictures(fitted, ds)
        assert 0 <= image.min() and 0.5 < image.max() <= 1 and least < 0.01
        wrong = 10 * np.log10(back(image)[strong] / ds.path_gain[strong])
        assert np.abs(wrong).max() < error_db, fitted
        if error_db == 0.2:
            assert np.array_equal(image * 255, np.rint(image * 255))


@pytest.mark.parametrize("choice", ["db", "power", "amplitude", "set-added"])
def test_where_the_papers_law_holds_its_model_wins_whatever_is_fitted(data: Path, choice: str) -> None:
    """Every surface has the same gain, so that power is solid angle times the squared inverse of the length."""
    ds = SpectrumDataset.load(data / "spectra.nc")
    geometry = Geometry(data / "reconstruction", data / "scene.xml", "cpu")
    lab = gap.Lab(ds, ds, geometry, Job(Path(), device="cpu"), 120)
    lengths = lab.lengths(lab.seen("all"))
    power = 1e-6 * pixel_solid_angles(ds.shape)[:, None] / np.nan_to_num(lengths, nan=np.inf) ** 2
    ds = SpectrumDataset.from_spectra(
        receivers=ds.receivers, transmitter=ds.transmitter, frequency_hz=ds.frequency_hz, path_gain=power,
        line_of_sight=ds.line_of_sight, beam_sigma_rad=ds.beam_sigma_rad, role=ds.role,
    )  # fmt: skip
    lab = gap.Lab(*ds.split(10), geometry, Job(Path(), device="cpu"), 120)
    found = {
        model: gap.fit_and_score(lab, gap.CHOICES[choice], model, lambda *_: None) for model in gap.NAMES
    }
    assert found["rf3dgs+"]["psnr_db"] > found["rf3dgs"]["psnr_db"] + 2


def test_pictures_by_their_own_range_know_no_level(data: Path) -> None:
    ds = SpectrumDataset.load(data / "spectra.nc")
    ds = replace(ds, floor=ds.floor * 1e-6)
    found = gap.scores(ds, 0.1 * np.asarray(ds.path_gain, np.float64))
    assert found["own_psnr_db"] > 60 > 30 > found["psnr_db"]


def test_finished_rows_are_kept(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = compare(data, tmp_path, "image-added")
    monkeypatch.setattr(gap, "fit_layer", None)
    again = compare(data, tmp_path, "image-added")
    assert again["differences"] == first["differences"]
    assert [row["choice"] for row in again["differences"]] == ["image-added"]
    assert {row["data"] for row in again["rows"]} == {first["truth"]["key"]}
