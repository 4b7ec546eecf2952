"""Fuzzing for as long as it is told to: what was tried of every target, and every finding with what repeats it.

Goes on where it was stopped.

examples:
  python -m tests.fuzz --minutes 60
  python -m tests.fuzz --minutes 1 --only "file: splats|Gaussians" --fresh
  python -m tests.fuzz --again 'Mesh.cast: [["origins", "nan"]]'     one case, in this process
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import tests.conftest  # noqa: F401 (it says where helpers lie)
from fuzz.place import Place
from fuzz.trial import Case, Trial, stream, targets
from fuzz.workers import KINDS, LIMIT_S, Workers
from warprrf.cli.output import Output
from warprrf.device import threads
from warprrf.files import write_json

BATCH = 200
"""Cases between two looks at the clock."""


def _case(text: str) -> Case:
    target, _, edits = text.rpartition(": [[")
    if target not in targets():
        raise SystemExit(f"--again: got {text!r}, expected a case as it was reported")
    return Case(target, tuple(tuple(edit) for edit in json.loads(f"[[{edits}")))


def main() -> None:
    """Fuzz, and report."""
    parser = argparse.ArgumentParser(
        "python -m tests.fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="how long, earlier runs not counted")
    parser.add_argument("--only", default="", help="targets whose name has this regular expression in it")
    parser.add_argument("--again", help="try one case, as it was reported, in this process")
    parser.add_argument("--out", default="runs/fuzz", help="folder of the state (default runs/fuzz)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fresh", action="store_true", help="start over instead of continuing")
    parser.add_argument("--workers", type=int, default=threads(), help="processes that try cases")
    args = parser.parse_args()
    out = Path(args.out).resolve()
    place = Place(out / "place").make()
    if args.again:
        case, scratch = _case(args.again), out / "again"
        scratch.mkdir(exist_ok=True)
        os.chdir(scratch)
        print(Trial(place, scratch)(case))
        return
    new = {"seed": args.seed, "only": args.only, "done": 0, "seconds": 0.0, "tried": {}, "findings": {}}
    file, state = out / "state.json", new
    if file.is_file() and not args.fresh:
        known = json.loads(file.read_text())
        state = known if (known["seed"], known["only"]) == (args.seed, args.only) else new
    _run(place, state, args, file)
    print(_report(state))


def _run(place: Place, state: dict[str, Any], args: argparse.Namespace, file: Path) -> None:
    progress, whole, before = Output("fuzz"), int(60.0 * args.minutes), state["seconds"]
    start = time.monotonic()
    waiting = itertools.islice(stream(place, args.seed, args.only), state["done"], None)
    with Workers(partial(Trial, str(place.folder)), args.workers) as workers:
        while time.monotonic() < start + whole:
            for case, outcome in workers.run(itertools.islice(waiting, BATCH), start + whole):
                state["done"] += 1
                tried = state["tried"].setdefault(case.target, {})
                tried[outcome.kind] = tried.get(outcome.kind, 0) + 1
                if outcome.kind == "finding":
                    text = f"{case.target}: {outcome.text}"[:2000]
                    state["findings"].setdefault(text, []).append(str(case))
                passed = min(int(time.monotonic() - start), whole)
                progress(f"fuzz, {len(state['findings'])} findings", passed, whole)
            state["seconds"] = before + time.monotonic() - start
            write_json(file, state)


def _report(state: dict[str, Any]) -> str:
    """What was tried of every target, what was found, and what it comes to."""
    total: Counter[str] = Counter()
    lines = [f"{'target':44}" + "".join(f"{kind:>10}" for kind in KINDS)]
    for target, tried in sorted(state["tried"].items()):
        total.update(tried)
        lines.append(f"{target:44}" + "".join(f"{tried.get(kind, 0):10}" for kind in KINDS))
    for text, found in sorted(state["findings"].items()):
        lines.append(f"\n{text}\n  {len(found)} cases, one of them: --again '{found[0]}'")
    counts = ", ".join(f"{total[kind]} {kind}" for kind in KINDS[:3])
    lines.append(
        f"\n{sum(total.values())} cases of {len(state['tried'])} targets in {state['seconds'] / 60:.1f} minutes, seed "
        f"{state['seed']}, at most {LIMIT_S:g} s each: {counts}; {len(state['findings'])} findings"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
