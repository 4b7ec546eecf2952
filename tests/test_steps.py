"""Steps keep what is finished, redo what changed, go on where a killed attempt was, and count its time."""

import json
import multiprocessing
import os
import signal
import time
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np
import pytest

from warprrf import steps as module
from warprrf.files import write_text
from warprrf.steps import Steps, digest


def _ask(folder, made, value=1, *, given=0, version=1, fresh=False):
    """The step's value; ``made`` gets it where it is made."""

    def make(attempt):
        made.append(value)
        write_text(folder / "out.txt", "text")
        return {"value": value, "gain": 0.5}

    with Steps(folder, fresh=fresh) as steps:
        return int(steps.run("one", make, version=version, inputs=[given], outputs=["out.txt"])["value"])


REDONE = {
    "another input": {"given": 1},
    "another version": {"version": 2},
    "from the beginning": {"fresh": True},
    "no output": None,
    "another figure": lambda text: text.replace("0.5", "0.7"),
    "half a record": lambda text: text[: len(text) // 2],
    "no figures": lambda text: json.dumps(
        {k: v for k, v in json.loads(text).items() if k != "sha256"} | {"figures": None}
    ),
}


@pytest.mark.parametrize("change", REDONE)
def test_a_finished_step_is_done_again_only_when_something_changed(tmp_path, change):
    made = []
    assert [_ask(tmp_path, made, 1), _ask(tmp_path, made, 2)] == [1, 1] and made == [1]
    how = REDONE[change]
    if how is None:
        (tmp_path / "out.txt").unlink()
    elif callable(how):
        record = tmp_path / ".steps/one.json"
        record.write_text(how(record.read_text()))
    assert _ask(tmp_path, made, 3, **(how if isinstance(how, dict) else {})) == 3 and made == [1, 3]


def test_a_step_that_does_not_write_its_output_is_an_error_and_stays_unfinished(tmp_path):
    with Steps(tmp_path) as steps:
        with pytest.raises(RuntimeError, match="without writing gone.txt"):
            steps.run("one", lambda attempt: {}, version=1, inputs=[], outputs=["gone.txt"])
        assert not json.loads((tmp_path / ".steps/one.json").read_text())["finished"]


def test_scratch_stays_with_its_inputs_until_the_step_is_finished(tmp_path):
    seen = []

    def attempt_with(value, fail):
        def make(attempt):
            seen.append((attempt.folder / "half.txt").exists())
            (attempt.folder / "half.txt").write_text("half")
            if fail:
                raise KeyboardInterrupt
            return {}

        with Steps(tmp_path) as steps:
            steps.run("one", make, version=1, inputs=[value])

    for value, fail in ((1, True), (1, True), (2, True), (2, False), (3, False)):
        with pytest.raises(KeyboardInterrupt) if fail else nullcontext():
            attempt_with(value, fail)
    assert seen == [False, True, False, True, False]
    assert not (tmp_path / ".steps/one").exists()


def test_arrays_are_kept_by_key_and_made_again_when_damaged(tmp_path):
    made = []

    def ask(value):
        def make():
            made.append(value)
            return {"gain": np.full((2, 3), value, np.float32), "flag": np.array(True)}

        with Steps(tmp_path, shared=True) as steps:
            return steps.arrays("receiver", make, version=1, inputs=[np.array([value])])

    for value in (1, 1, 2, 2):
        found = ask(value)
        assert set(found) == {"gain", "flag"} and found["gain"].dtype == np.float32
        np.testing.assert_array_equal(found["gain"], value)
    assert made == [1, 2]
    with np.load(tmp_path / "receiver.npz") as known:
        held = dict(known)
    (tmp_path / "receiver.npz").write_bytes(b"")  # other damage is in tests/fuzz
    np.testing.assert_array_equal(ask(2)["gain"], 2)
    np.savez(tmp_path / "receiver.npz", **held | {"gain": np.full(6, np.nan)})  # without a checksum
    np.testing.assert_array_equal(ask(2)["gain"], 2)
    assert made == [1, 2, 2, 2]


def test_digest_follows_names_and_content_of_files_not_dates(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(b"one")
    before = digest(folder)
    os.utime(folder / "a.jpg", (0, 0))
    assert digest(folder) == before
    (folder / "a.jpg").rename(folder / "b.jpg")
    renamed = digest(folder)
    (folder / "b.jpg").write_bytes(b"two")
    assert len({before, renamed, digest(folder)}) == 3
    with pytest.raises(FileNotFoundError):
        digest(folder / "gone.jpg")


@dataclass(frozen=True)
class _Config:
    rate: float = 0.1
    shape: tuple[int, int] = (2, 3)


class _Other(_Config):
    """Equal in all but the class."""


def test_digest_tells_values_apart_and_equal_ones_not():
    different = [
        1, 1.0, "1", True, None, b"1", [1], [[1]], {"1": 1}, [1, 2], ["1", 2], [[1], 2], [1, [2]], float("nan"),
        np.zeros(4), np.zeros((2, 2)), np.zeros(4, np.float32), np.zeros(2), _Config(), _Other(), _Config(rate=0.2),
    ]  # fmt: skip
    assert len({digest(value) for value in different}) == len(different)
    assert digest("ab", "c") != digest("a", "bc")
    same = [
        ((1, 2), [1, 2]), ({"a": 1, "b": 2}, {"b": 2, "a": 1}), (np.float64(0.5), 0.5),
        (np.arange(6.0).reshape(2, 3).T, np.ascontiguousarray(np.arange(6.0).reshape(2, 3).T)), (_Config(), _Config(0.1)),
    ]  # fmt: skip
    assert all(digest(a) == digest(b) for a, b in same)
    with pytest.raises(TypeError, match="got object"):
        digest(object())


def _slow(folder):
    def make(attempt):
        for step in range(1000):
            time.sleep(0.02)
            attempt.progress("slow", step, 1000)
        return {}

    module.HEARTBEAT_S = 0.05
    with Steps(folder) as steps:
        steps.run("slow", make, version=1, inputs=[1])


def test_a_killed_attempt_is_continued_and_its_time_counted(tmp_path):
    process = multiprocessing.get_context("spawn").Process(target=_slow, args=(str(tmp_path),))
    process.start()
    state = tmp_path / ".steps/slow.json"
    deadline = time.monotonic() + 60
    recorded = 0.0
    while recorded < 0.2 and time.monotonic() < deadline:
        time.sleep(0.02)
        recorded = json.loads(state.read_text())["seconds"] if state.exists() else 0.0
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    told = []
    with Steps(tmp_path, progress=lambda *news: told.append(news)) as steps:

        def make(attempt):
            attempt.progress("slow", 1000, 1000)
            return {}

        steps.run("slow", make, version=1, inputs=[1])
        assert steps.records["slow"]["attempts"] == 2
        assert steps.records["slow"]["seconds"] >= recorded >= 0.2
        assert steps.records["slow"]["stages"]["slow"] >= 0.1
        assert len(steps.key("slow")) == 64
    assert told == [("slow", 1000, 1000)]


def test_two_jobs_do_not_share_a_folder_unless_told_to(tmp_path):
    with Steps(tmp_path), pytest.raises(ValueError, match="another process is at work"), Steps(tmp_path):
        pass
    with Steps(tmp_path, shared=True), Steps(tmp_path, shared=True):
        pass
