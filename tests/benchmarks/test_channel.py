"""The table of channels, its quick rows."""

import json

import pytest

from benchmarks.channel import BENCHMARKS, DISTANCES_M, SIDES, Options, closed_forms
from benchmarks.runner import Job, execute


def test_closed_forms_hold():
    for name, e in closed_forms(seed=1, trials=5).items():
        assert e["gain"] < 1e-6 and e["phase_rad"] < 1e-3, name


def test_quick_rows_are_written(tmp_path):
    seen = []
    job = Job(tmp_path, progress=lambda stage, done, total: seen.append((done, total)))
    report = execute(BENCHMARKS["channel"], Options(large=False, sionna=False), job)
    assert seen[-1] == (2, 2)
    assert (
        json.loads((tmp_path / "channel.json").read_text())["closed_forms"].keys()
        == report["closed_forms"].keys()
    )
    text = (tmp_path / "channel.md").read_text()
    assert (
        "Friis" in text
        and "| friis, 100 m, relative gain | at most 1e-06 |" in text
        and "NOT met" not in text
    )
    assert (tmp_path / "plane_wave.png").read_bytes()[:4] == b"\x89PNG"
    assert len(report["plane_wave"]) == len(SIDES) * len(DISTANCES_M)
    # The loss of a large array falls with distance and grows with size.
    loss = {(e["elements"], e["distance_m"]): e["beam_loss_db"] for e in report["plane_wave"]}
    assert loss[4096, 1.0] > 10 * loss[4096, 5.0] > 0 and loss[4096, 1.0] > 10 * loss[256, 1.0]
    assert loss[4096, 1.0] == pytest.approx(0.5, abs=0.1)
