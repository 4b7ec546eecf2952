"""What verbs take is measured in a process of its own, which finds what another one left."""

from pathlib import Path

import pytest

from benchmarks import times
from benchmarks.runner import Job


def test_a_verb_is_told_with_its_seconds_and_memory(tmp_path: Path) -> None:
    found = times.run(times.Options(verbs=("load",)), Job(tmp_path)).figures["rows"]
    (row,) = found
    assert row["verb"] == "Scene.load" and row["again_wall_s"] is None
    assert row["wall_s"] > 0 and row["core_s"] > 0 and 0.1 < row["peak_gb"] < 16


def test_unknown_verbs_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="verbs: got sing, expected some of load"):
        times.run(times.Options(verbs=("sing",)), Job(tmp_path))
