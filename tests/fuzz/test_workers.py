"""Processes that try cases see a crash and a hang; each imports this file again, so it imports little."""

import os
import time

from fuzz.workers import Outcome, Workers


def misbehaving(scratch):
    asked = {"answers": Outcome, "dies": lambda case: os.abort(), "hangs": lambda case: time.sleep(60.0)}
    return lambda case: asked[case](case)


def test_a_crash_and_a_hang_are_seen_and_others_go_on():
    asked = ["answers", "dies", "answers", "hangs", "answers", "answers"]
    with Workers(misbehaving, 1, 2.0) as workers:
        found = dict(workers.run(asked))
    assert found["answers"] == Outcome("answers")
    assert "exit code -6" in found["dies"].text
    assert "took more than 2 s" in found["hangs"].text
