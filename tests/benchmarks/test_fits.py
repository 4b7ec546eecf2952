"""Experiments are rows of fits: whole once on a small room."""

import pytest
from small_room import small_room

import warprrf as wr
from benchmarks import bistatic, fits
from benchmarks.runner import Job, execute

LEFT_OUT = ("no mirrors", "no scattering")


@pytest.mark.long
def test_every_part_is_worth_something_and_delays_are_right(tmp_path, monkeypatch):
    (tmp_path / "room").mkdir()
    room = small_room(tmp_path / "room")
    options = fits.FitOptions(
        data=(str(room),), geometry=str(room / "reconstruction"), truths=("exact",), counts=(8,)
    )
    monkeypatch.setattr(bistatic, "ABLATION", {name: bistatic.ABLATION[name] for name in LEFT_OUT})
    found = execute(bistatic.BENCHMARKS["bistatic"], options, Job(tmp_path / "out", device="cpu"))
    psnr = {row["model"]: row["psnr_db"] for row in found["ablation"]}
    assert set(psnr) == {"everything", *LEFT_OUT, "true mesh, its materials as groups", "zero spectra"}
    assert psnr["no scattering"] < psnr["everything"] - 3 and psnr["zero spectra"] < psnr["everything"] - 3
    (row,) = found["delays"]  # on the true mesh
    assert row["found"] > 0.9 and row["mirror_ns"] < 1e-6 and row["scattering_ns"] < 1.0  # 15 degrees a pixel


def test_a_field_is_asked_under_the_transmitter_of_what_it_is_scored_on(tmp_path):
    """Another transmitter than it was fitted to: with that one the room's exact spectra are missed by decibels."""
    room = small_room(tmp_path)
    scene, own = wr.Scene.load(room / "scene.xml"), wr.SpectrumDataset.load(room / "spectra.nc")
    field = wr.RadioField.fit(scene, own, model="bistatic", quick=True, device="cpu")
    link = {"frequency_hz": own.frequency_hz, "shape": own.shape, "beam_sigma_rad": own.beam_sigma_rad}
    other = wr.simulate(
        scene, transmitter=(4.5, 3.4, 0.6), receivers=own.receivers[10:], device="cpu", **link
    )
    asked = fits.Fits(Job(tmp_path, device="cpu"), None, "")
    assert asked.score(field, other)["total_rms_db"] < 1.0
