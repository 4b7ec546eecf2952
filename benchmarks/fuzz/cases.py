"""What is tried: one public call with one or two arguments replaced, or one file with a few edits."""

from __future__ import annotations

import hashlib
import re
import shutil
import traceback
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from benchmarks.fuzz import calls, judge
from benchmarks.fuzz.damage import BYTES, TREE, Unfit, damage
from benchmarks.fuzz.formats import FORMATS
from benchmarks.fuzz.place import Place
from benchmarks.fuzz.values import NOT_FINITE, SAME, VALUES, names_for

FILE = "file: "
KINDS = ("answered", "refused", "unfit", "finding")


@dataclass(frozen=True)
class Case:
    """One thing to try.

    Attributes:
        target: name of a public call, or ``file: `` and that of a format.
        edits: arguments with the names of their values, or edits of a file.
    """

    target: str
    edits: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Outcome:
    """What came of a case, one of :data:`KINDS`, and what it says; ``unfit``: there is no such value or file."""

    kind: str
    text: str = ""


class Trial:
    """Tries cases, in a scratch folder that is the working directory.

    Args:
        place: what examples are made of.
        scratch: emptied again and again.
    """

    def __init__(self, place: Place, scratch: Path) -> None:
        self.place, self.scratch = place, scratch
        with suppress(ImportError):
            import_module("torch")  # its tens of seconds on a busy machine are no case's
        self._usual: dict[str, judge.Leaves | None] = {}

    def __call__(self, case: Case) -> Outcome:
        """What comes of ``case``."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self._file(case) if case.target.startswith(FILE) else self._call(case)

    def _call(self, case: Case) -> Outcome:
        example = calls.EXAMPLES[case.target](self.place)
        given = calls.parameters(case.target, example)
        changed = dict(example)
        usual = self._answer(case.target, lambda: calls.call(case.target, example))
        for argument, value in case.edits:
            try:
                changed[argument] = VALUES[value](given[argument])
            except (TypeError, ValueError, IndexError, ImportError, OverflowError) as error:
                return Outcome("unfit", str(error))
        answer = _asked(lambda: calls.call(case.target, changed))
        if isinstance(answer, Exception):
            paths = [
                str(changed[argument]) for argument, _ in case.edits if isinstance(changed[argument], str)
            ]
            return _refused(answer, [*given, *paths])
        values = {value for _, value in case.edits}
        unknown = case.target in calls.SPREADS and not np.asarray(changed["power"]).any()
        bad = "" if unknown or values & NOT_FINITE else judge.wrong(answer, usual or {})
        if not bad and values <= SAME.keys() and usual:
            bad = judge.differs(answer, usual, 1e-6)
        return Outcome("finding" if bad else "answered", bad)

    def _file(self, case: Case) -> Outcome:
        form = FORMATS[case.target.removeprefix(FILE)]
        usual = self._answer(case.target, lambda: form.read(self._made(case.target)))
        path = self._made(case.target)
        try:
            damage(path, form.codec, case.edits)
        except Unfit as error:
            return Outcome("unfit", str(error))
        answer = _asked(lambda: form.read(path))
        if isinstance(answer, Exception):
            return _refused(answer, [path.name, str(path.parent), *form.held])
        bad = judge.wrong(answer, usual or {})
        if not bad and form.sealed and usual and len(case.edits) == 1 and case.edits[0][0] in BYTES:
            bad = judge.differs(answer, usual)
        return Outcome("finding" if bad else "answered", bad)

    def _answer(self, target: str, ask: Callable[[], Any]) -> judge.Leaves | None:
        """The answer without any change; None where that is refused, as an example may be."""
        if target not in self._usual:
            found = _asked(ask)
            self._usual[target] = None if isinstance(found, Exception) else found
        return self._usual[target]

    def _made(self, target: str) -> Path:
        folder = self.scratch / "case"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return FORMATS[target.removeprefix(FILE)].make(self.place, folder)


def _asked(ask: Callable[[], Any]) -> judge.Leaves | Exception:
    """The answer, or what was raised in its place, whatever that is."""
    try:
        return judge.leaves(ask())
    except Exception as error:  # noqa: BLE001
        return error


def _refused(error: Exception, names: Collection[str]) -> Outcome:
    """An error as an outcome, a bad one with the place in the library that it came from."""
    bad = judge.complaint(error, names)
    if not bad:
        return Outcome("refused", str(error))
    own = [f for f in traceback.extract_tb(error.__traceback__) if "warprrf" in f.filename]
    return Outcome("finding", f"{bad} ({Path(own[-1].filename).name}: {own[-1].name})" if own else bad)


def targets() -> list[str]:
    """Everything that is fuzzed."""
    return [*calls.EXAMPLES, *(FILE + name for name in FORMATS)]


def choices(place: Place) -> dict[str, dict[str, list[str]]]:
    """Arguments of every public call, and the values that each is replaced with."""
    found = {}
    for name in targets():
        if not name.startswith(FILE):
            given = calls.parameters(name, calls.EXAMPLES[name](place))
            found[name] = {argument: names_for(value) for argument, value in given.items()}
    return found


def singles(place: Place) -> Iterator[Case]:
    """Every call with every one of its arguments replaced by everything, one at a time."""
    for name, arguments in choices(place).items():
        for argument, values in arguments.items():
            yield from (Case(name, ((argument, value),)) for value in values)


def strategy(target: str, arguments: dict[str, list[str]]) -> st.SearchStrategy[Case]:
    """Cases of one target: one or two arguments, or one to three edits."""
    number = st.integers(0, 2**31 - 1)
    if target.startswith(FILE):
        codec = FORMATS[target.removeprefix(FILE)].codec
        names = [*BYTES, *(TREE * 3 if codec else ())]
        edits = st.lists(st.tuples(st.sampled_from(names), number, number), min_size=1, max_size=3)
    else:
        pairs = [(argument, value) for argument, values in arguments.items() for value in values]
        edits = st.lists(st.sampled_from(pairs), min_size=1, max_size=2, unique_by=lambda pair: pair[0])
    return edits.map(lambda found: Case(target, tuple(found)))


def trial(folder: str, scratch: Path) -> Trial:
    """What a worker tries cases with, on the place in ``folder``."""
    return Trial(Place(folder), scratch)


def ended(words: str) -> Outcome:
    """What came of a case that its process did not survive."""
    return Outcome("finding", words)


def drawn(place: Place, count: int, number: int, only: str = "") -> list[Case]:
    """``count`` cases that Hypothesis draws of every target, in an order by chance; ``number`` is the seed."""
    cases: list[Case] = []
    known = choices(place)
    for target in targets():
        if not re.search(only, target) or not (target.startswith(FILE) or known[target]):
            continue
        quiet = settings(
            max_examples=count, database=None, deadline=None, phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip

        @seed(int.from_bytes(_digest(number, target)[:8], "little"))
        @quiet
        @given(strategy(target, known.get(target, {})))
        def collect(case: Case) -> None:
            cases.append(case)

        collect()
    return shuffled(cases, number)


def shuffled(cases: Iterable[Case], number: int) -> list[Case]:
    """The cases in an order by chance."""
    return sorted(cases, key=lambda case: _digest(number, case.target, case.edits))


def _digest(*parts: object) -> bytes:
    """By what is tried alone, so that a new target changes nothing about the others."""
    return hashlib.sha256(repr(parts).encode()).digest()
