"""Fuzzing for as long as it is told to: what was tried of every target, and every finding with what repeats it."""

from __future__ import annotations

import itertools
import json
import re
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from benchmarks.fuzz import cases
from benchmarks.fuzz.place import Place
from benchmarks.fuzz.workers import LIMIT_S, Workers
from benchmarks.report import Report, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import threads
from warprrf.files import write_json

HELP = """\
Every public function with one or two arguments replaced by hostile values, and every file format with its bytes and
contents edited, in processes that may crash or hang. Right are an answer without NaN, and an error of the kinds
ValueError, TypeError, OSError or ImportError that names the argument or the file. Goes on where it was stopped.

examples:
  python -m benchmarks fuzz --minutes 60
  python -m benchmarks fuzz --minutes 1 --only "file: splats|Gaussians" --fresh
  python -m benchmarks fuzz --again 'Mesh.cast: [["origins", "nan"]]'     one case, in this process
"""
BATCH = 200
DRAWN = 40
"""Cases of every target between two looks at the clock, and of each that Hypothesis draws at a time."""


@dataclass(frozen=True)
class Options:
    """Options of the fuzzing.

    Attributes:
        minutes: how long.
        only: regular expression that a target's name has in it.
        again: a case as a report states it.
        workers: processes.
    """

    minutes: float = option(60.0, "how long, earlier runs not counted")
    only: str = option("", "only targets whose name has this regular expression in it")
    again: str = option("", "try one case, as the report states it, in this process")
    workers: int = option(threads(), "processes that try cases")


def stated(case: cases.Case) -> str:
    """A case as a report states it."""
    return f"{case.target}: {json.dumps(case.edits)}"


def _case(text: str) -> cases.Case:
    target, _, edits = text.rpartition(": [[")
    if target not in cases.targets():
        raise ValueError(f"again: got {text!r}, expected a case as a report states it")
    return cases.Case(target, tuple(tuple(edit) for edit in json.loads(f"[[{edits}")))


def stream(place: Place, seed: int, only: str) -> Iterator[cases.Case]:
    """All cases in their order: each argument replaced by everything and as many drawn ones, then drawn ones for ever."""
    single = cases.shuffled((case for case in cases.singles(place) if re.search(only, case.target)), seed)
    for k in itertools.count(seed * 1_000_000):
        drawn = cases.drawn(place, DRAWN, k, only)
        yield from itertools.chain.from_iterable(
            zip(itertools.islice(single, len(drawn)), drawn, strict=False)
        )
        yield from drawn[len(drawn) :]
        if not drawn:
            raise ValueError(f"only: got {only!r}, which is in no target's name")


def run(options: Options, job: Job) -> Report | None:
    """Fuzz, and report."""
    place = Place(job.out.resolve() / "place").make()  # cases run in folders of their own
    if options.again:
        print(cases.Trial(place, job.out.resolve() / "again")(_case(options.again)))
        return None
    state_file = job.out / "state.json"
    state: dict[str, Any] = {
        "seed": job.seed,
        "only": options.only,
        "done": 0,
        "seconds": 0.0,
        "tried": {},
        "findings": {},
    }
    if state_file.is_file() and not job.fresh:
        known = json.loads(state_file.read_text())
        state = known if (known["seed"], known["only"]) == (job.seed, options.only) else state
    waiting = itertools.islice(stream(place, job.seed, options.only), state["done"], None)
    start, until = time.monotonic(), time.monotonic() + 60.0 * options.minutes
    before, whole = state["seconds"], int(60.0 * options.minutes)
    with Workers(partial(cases.trial, str(place.folder)), cases.ended, options.workers) as workers:
        while time.monotonic() < until:
            batch = list(itertools.islice(waiting, BATCH))
            for case, outcome in workers.run(batch, until):
                state["done"] += 1
                tried = state["tried"].setdefault(case.target, {})
                tried[outcome.kind] = tried.get(outcome.kind, 0) + 1
                if outcome.kind == "finding":
                    state["findings"].setdefault(f"{case.target}: {outcome.text}"[:2000], []).append(
                        stated(case)
                    )
                job.progress(f"fuzz, {len(state['findings'])} findings", int(time.monotonic() - start), whole)
            state["seconds"] = before + time.monotonic() - start
            write_json(state_file, state)
    return _report(state)


def _report(state: dict[str, Any]) -> Report:
    total: Counter[str] = Counter()
    rows = []
    for target, tried in sorted(state["tried"].items()):
        total.update(tried)
        rows.append([target, *(str(tried.get(kind, 0)) for kind in cases.KINDS)])
    findings = [
        [" ".join(text.split())[:300].replace("|", "/"), str(len(found)), f"`{found[0]}`"]
        for text, found in sorted(state["findings"].items())
    ]
    text = (
        f"{sum(total.values())} cases in {state['seconds'] / 60:.1f} minutes, seed {state['seed']}, {len(rows)} targets: "
        f"{total['answered']} answered, {total['refused']} refused, {total['unfit']} cannot be; {len(findings)} findings; "
        f"a case may take {LIMIT_S:g} s.\n\n"
    )
    text += table(["finding", "cases", "one of them"], findings) + "\n\n" if findings else ""
    return Report("fuzz", state, text + table(["target", *cases.KINDS], rows))


BENCHMARKS = {"fuzz": Benchmark("fuzz", Options, run, HELP)}
