"""The bench of relevance: choosers and judges are apart, and its files say what it returned."""

import json
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from benchmarks import relevance as bench
from benchmarks.runner import Job, execute
from warprrf.rf.spectra.dataset import SpectrumDataset


def test_receivers_that_judge_did_not_choose_and_half_are_blocked() -> None:
    spectra = SpectrumDataset.load(ROOT / "data" / "lobby" / "spectra.nc")
    chosen, judging = bench._draw(spectra, 8, 6, 0)
    assert (len(chosen), len(judging)) == (8, 6)
    assert not set(chosen) & set(judging)
    for drawn in (chosen, judging):
        assert np.count_nonzero(~spectra.line_of_sight[drawn]) == len(drawn) // 2
    with pytest.raises(ValueError, match="choosers"):
        bench._draw(spectra, 1000, 6, 0)


@pytest.mark.slow
def test_a_small_run_writes_table_picture_and_figures(tmp_path: Path) -> None:
    options = bench.Options(
        data=str(ROOT / "data" / "lobby"), carriers_hz=(300e9,), roughness=(("smooth", 0.3),), tolerances_db=(1.0, 30.0),
        choosers=2, judges=2, shape=(16, 32), fit=False,
    )  # fmt: skip
    report = execute(bench.BENCHMARKS["relevance"], options, Job(tmp_path))
    tight, loose = report["cases"][0]["choices"]
    assert tight["own_image_db"] <= 1.0
    assert (
        tight["image_db"] < 2.0 < loose["image_db"]
    )  # others judge, so it may exceed the tolerance a little
    assert tight["psnr_db"] > loose["psnr_db"]
    assert set(loose["kept"]) < set(tight["kept"])
    stored = json.loads((tmp_path / "relevance.json").read_text())
    assert stored["cases"][0]["choices"][0]["psnr_db"] == pytest.approx(tight["psnr_db"])
    assert (tmp_path / "relevance.md").read_text().count("| 300 GHz |") == 2
    assert (tmp_path / "relevance.png").read_bytes()[:4] == b"\x89PNG"
