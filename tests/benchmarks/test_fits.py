"""Experiments are rows of fits: whole once on a small room."""

from small_room import small_room

from benchmarks import bistatic, fits
from benchmarks.runner import Job, execute

LEFT_OUT = ("no mirrors", "no scattering")


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
