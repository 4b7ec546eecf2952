"""A staged run keeps what is finished, redoes what changed, and counts the time of killed attempts."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.stages import STATE_FILE, StagedRun, fingerprint, plain
from warprrf.files import write_text


def _once(folder: Path, calls: list[str], value: int, *, stage_input: object = 0, fresh: bool = False) -> int:
    with StagedRun(folder, fresh=fresh) as run:

        def work(progress: object) -> dict[str, int]:
            calls.append("work")
            write_text(folder / "out.txt", str(value))
            return {"value": value}

        return int(run.stage("one", work, inputs=[stage_input], outputs=["out.txt"])["value"])


def test_finished_stage_is_not_done_again(tmp_path: Path) -> None:
    calls: list[str] = []
    assert [_once(tmp_path, calls, 1), _once(tmp_path, calls, 2)] == [1, 1]
    assert len(calls) == 1


@pytest.mark.parametrize("change", ["input", "output", "fresh"])
def test_stage_is_redone_when_something_changed(tmp_path: Path, change: str) -> None:
    calls: list[str] = []
    _once(tmp_path, calls, 1)
    if change == "output":
        (tmp_path / "out.txt").unlink()
    redone = _once(tmp_path, calls, 2, stage_input=int(change == "input"), fresh=change == "fresh")
    assert (redone, len(calls)) == (2, 2)


def test_fingerprint_follows_content_and_names_not_dates(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(b"one")
    before = fingerprint([folder])
    os.utime(folder / "a.jpg", (0, 0))
    assert fingerprint([folder]) == before
    (folder / "a.jpg").rename(folder / "b.jpg")
    renamed = fingerprint([folder])
    (folder / "b.jpg").write_bytes(b"two")
    assert len({before, renamed, fingerprint([folder])}) == 3


def _slow(folder: str) -> None:
    def work(progress: object) -> dict[str, int]:
        for step in range(1000):
            time.sleep(0.02)
            progress("slow", step, 1000)  # type: ignore[operator]
        return {}

    from benchmarks import stages

    stages.HEARTBEAT_S = 0.05
    with StagedRun(folder) as run:
        run.stage("slow", work, inputs=[1])


def test_killed_attempt_is_continued_and_its_time_counted(tmp_path: Path) -> None:
    process = multiprocessing.get_context("spawn").Process(target=_slow, args=(str(tmp_path),))
    process.start()
    state = tmp_path / STATE_FILE
    deadline = time.monotonic() + 60
    recorded = 0.0
    while recorded < 0.2 and time.monotonic() < deadline:
        time.sleep(0.02)
        recorded = json.loads(state.read_text())["stages"]["slow"]["seconds"] if state.exists() else 0.0
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with StagedRun(tmp_path) as run:
        run.stage("slow", lambda progress: {}, inputs=[1])
        assert run.attempts("slow") == 2
        assert run.seconds() >= recorded >= 0.2


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    with StagedRun(tmp_path), pytest.raises(ValueError, match="another run is at work"), StagedRun(tmp_path):
        pass


def test_corrupt_state_says_how_to_go_on(tmp_path: Path) -> None:
    (tmp_path / STATE_FILE).write_text("{")
    with pytest.raises(ValueError, match="--fresh"), StagedRun(tmp_path):
        pass


def test_json_has_no_nan() -> None:
    assert plain({"a": np.array([1.0, np.nan]), "b": np.float32(2), "c": float("inf")}) == {
        "a": [1.0, None],
        "b": 2.0,
        "c": None,
    }
    with pytest.raises(TypeError):
        plain(object())
