"""The table of channels, its quick rows."""

import json

import pytest

from benchmarks.channel import DISTANCES_M, SIDES, closed_forms, run_channel, table


def test_closed_forms_hold():
    for name, e in closed_forms(seed=1, trials=5).items():
        assert e["gain"] < 1e-6 and e["phase_rad"] < 1e-3, name


def test_quick_rows_are_written(tmp_path):
    seen = []
    report = run_channel(
        tmp_path, large=False, sionna=False, progress=lambda stage, done, total: seen.append((done, total))
    )
    assert seen[-1] == (2, 2)
    assert (
        json.loads((tmp_path / "channel.json").read_text())["closed_forms"].keys()
        == report["closed_forms"].keys()
    )
    text = (tmp_path / "channel.md").read_text()
    assert text == table(report) and "Friis" in text
    assert len(report["plane_wave"]) == len(SIDES) * len(DISTANCES_M)
    # The loss of a large array falls with distance and grows with size.
    loss = {(e["elements"], e["distance_m"]): e["beam_loss_db"] for e in report["plane_wave"]}
    assert loss[4096, 1.0] > 10 * loss[4096, 5.0] > 0 and loss[4096, 1.0] > 10 * loss[256, 1.0]
    assert loss[4096, 1.0] == pytest.approx(0.5, abs=0.1)
