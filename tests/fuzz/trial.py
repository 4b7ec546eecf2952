"""What is tried: one public call with arguments replaced, one file with edits, or a law on something made by edits."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import shutil
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from fuzz import calls
from fuzz.answers import Leaves, asked, changes, complaint, differs, origin, wrong
from fuzz.files import BYTES, FORMATS, TREE, Unfit, damage
from fuzz.laws import LAWS
from fuzz.place import Place
from fuzz.values import NOT_FINITE, SAME, VALUES, names_for
from fuzz.workers import Outcome

FILE, LAW = "file: ", "law: "
DRAWN = 40
"""Cases of each target that are drawn at a time."""


@dataclass(frozen=True)
class Case:
    """One thing to try.

    Attributes:
        target: name of a public call, or ``file: `` and that of a format, or ``law: `` and that of a law.
        edits: arguments with the names of their values, or names of edits with two numbers.
    """

    target: str
    edits: tuple[tuple[Any, ...], ...]

    def __str__(self) -> str:
        return f"{self.target}: {json.dumps(self.edits)}"


class Trial:
    """Tries cases, in a scratch folder that is the working directory.

    Args:
        place: what examples are made of, or the folder of its files.
        scratch: emptied again and again.
    """

    def __init__(self, place: Place | str, scratch: Path) -> None:
        self.place, self.scratch = Place(place) if isinstance(place, str) else place, scratch
        with suppress(ImportError):
            import_module("torch")  # its tens of seconds on a busy machine are no case's
        self._usual: dict[str, Leaves | None] = {}

    def __call__(self, case: Case) -> Outcome:
        """What comes of ``case``."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if case.target.startswith(LAW):
                return self._law(case)
            return self._file(case) if case.target.startswith(FILE) else self._call(case)

    def _call(self, case: Case) -> Outcome:
        changed = calls.example(case.target, self.place)
        given = calls.parameters(case.target, changed)
        usual = self._answer(case.target, lambda: calls.call(case.target, dict(changed)))
        for argument, value in case.edits:
            try:
                changed[argument] = VALUES[value](given[argument])
            except (TypeError, ValueError, IndexError, ImportError, OverflowError) as error:
                return Outcome("unfit", str(error))
        answer = asked(lambda: calls.call(case.target, changed))
        if isinstance(answer, Exception):
            paths = [changed[name] for name, _ in case.edits if isinstance(changed[name], str)]
            method = case.target.rpartition(".")[2]
            owner = ["field"] if "self" in changed else []
            return refused(answer, [*given, *paths, method, *calls.PARTS.get(method, ()), *owner])
        values = {value for _, value in case.edits}
        unknown = case.target in calls.SPREADS and not np.asarray(changed["power"]).any()
        bad = "" if unknown or values & NOT_FINITE else wrong(answer, usual or {})
        if not bad and values <= SAME.keys() and usual:
            bad = differs(answer, usual, 1e-6)
        return Outcome("finding" if bad else "answered", bad)

    def _file(self, case: Case) -> Outcome:
        form = FORMATS[case.target.removeprefix(FILE)]
        usual = self._answer(case.target, lambda: form.read(self._made(case.target))) or {}
        path = self._made(case.target)
        try:
            damage(path, form.codec, case.edits)
        except Unfit as error:
            return Outcome("unfit", str(error))
        answer = asked(lambda: form.read(path))
        if isinstance(answer, Exception):
            return refused(answer, [path.name, str(path.parent), *form.held])
        bad = wrong(answer, usual, form.unknown)
        edit = case.edits[0][0].removesuffix(" early")
        if not bad and form.law and len(case.edits) == 1 and edit in BYTES:
            if form.law == "sealed" or (edit == "cut" and form.law != "numbers"):
                bad = differs(answer, usual)
            elif form.law == "one value" and edit == "flip" and changes(answer, usual, ".0.") > 4:
                bad = f"{changes(answer, usual, '.0.')} values changed by one bit"
        return Outcome("finding" if bad else "answered", bad)

    def _law(self, case: Case) -> Outcome:
        try:
            bad = LAWS[case.target.removeprefix(LAW)].wrong(self.place, case.edits)
        except Unfit as error:
            return Outcome("unfit", str(error))
        except Exception as error:  # noqa: BLE001 (a law takes the errors that are right itself)
            bad = f"{type(error).__name__}: {error} ({origin(error)})"
        return Outcome("finding" if bad else "answered", bad)

    def _answer(self, target: str, ask: Callable[[], Any]) -> Leaves | None:
        """The answer without any change; None where that is refused, as an example may be."""
        if target not in self._usual:
            found = asked(ask)
            self._usual[target] = None if isinstance(found, Exception) else found
        return self._usual[target]

    def _made(self, target: str) -> Path:
        folder = self.scratch / "case"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return FORMATS[target.removeprefix(FILE)].make(self.place, folder)


def refused(error: Exception, names: Collection[str]) -> Outcome:
    """An error as an outcome; a bad one says where it came from."""
    bad = complaint(error, names)
    return Outcome("finding", f"{bad} ({origin(error)})") if bad else Outcome("refused", str(error))


def targets() -> list[str]:
    """Everything that is fuzzed."""
    return [*calls.public(), *(FILE + name for name in FORMATS), *(LAW + name for name in LAWS)]


def choices(place: Place, target: str) -> list[tuple[str, str]]:
    """Arguments of a public call, each with every value that it is replaced with."""
    if target.startswith((FILE, LAW)):
        return []
    known = calls.parameters(target, calls.example(target, place))
    return [(argument, name) for argument, value in known.items() for name in names_for(value)]


def drawn(target: str, known: list[tuple[str, str]], count: int, number: int) -> list[Case]:
    """``count`` cases of one target by chance, of one or two arguments, or one to three edits; ``number`` is the seed."""
    rng = np.random.default_rng(int.from_bytes(_digest(number, target)[:8], "little"))
    if not target.startswith((FILE, LAW)):
        pairs = [[known[k] for k in rng.integers(len(known), size=rng.integers(1, 3))] for _ in range(count)]
        return [Case(target, tuple(dict(found).items())) for found in pairs]
    law = LAWS.get(target.removeprefix(LAW))
    names = law.edits if law else [*BYTES, *(TREE * 3 if FORMATS[target.removeprefix(FILE)].codec else ())]
    # Small numbers as often as large ones.
    numbers = 2.0 ** rng.uniform(0.0, 31.0, (count, law.most if law else 3, 2)) - 1.0
    edits = [[(names[rng.integers(len(names))], int(a), int(b)) for a, b in one] for one in numbers]
    return [Case(target, tuple(found[: rng.integers(1, len(found) + 1)])) for found in edits]


def stream(place: Place, number: int, only: str = "") -> Iterator[Case]:
    """All cases in their order: each argument replaced by everything and as many drawn ones, then drawn ones for ever."""
    known = {target: choices(place, target) for target in targets() if re.search(only, target)}
    known = {target: found for target, found in known.items() if found or target.startswith((FILE, LAW))}
    if not known:
        raise ValueError(f"only: got {only!r}, which is in no target's name")
    single = iter(_shuffled((Case(t, (pair,)) for t, pairs in known.items() for pair in pairs), number))
    for k in itertools.count(number * 1_000_000):
        more = _shuffled((case for t, pairs in known.items() for case in drawn(t, pairs, DRAWN, k)), k)
        for case in more:
            yield from itertools.islice(single, 1)
            yield case


def _shuffled(cases: Iterable[Case], number: int) -> list[Case]:
    """The cases in an order by chance."""
    return sorted(cases, key=lambda case: _digest(number, case.target, case.edits))


def _digest(*parts: object) -> bytes:
    """By what is tried alone, so that a new target changes nothing about the others."""
    return hashlib.sha256(repr(parts).encode()).digest()
