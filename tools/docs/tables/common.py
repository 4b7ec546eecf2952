"""Result files, the names of methods and truths, and Markdown."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[3]
FOLDER = ROOT / "benchmarks" / "results"
sys.path.append(str(ROOT))  # for what the benchmarks compute of their results

from benchmarks.machine import DEPENDS, VERSIONS  # noqa: E402

NAMES = {
    "bistatic": "**bistatic**",
    "bistatic-quick": "**bistatic, quick fit**",
    "rf3dgs+": "RF-3DGS+",
    "rf3dgs+los": "RF-3DGS+ with line of sight",
    "rf3dgs": "RF-3DGS",
    "rf3dgs+alpha": "RF-3DGS+, opacity trained",
    "rf3dgs-alpha": "RF-3DGS, opacity trained",
    "nerf2": "NeRF2",
    "cgan": "conditional GAN",
    "sionna-calibrated": "Sionna RT, calibrated materials",
    "sionna": "Sionna RT, true mesh, assumed materials",
    "sionna-again": "Sionna RT, the truth under another seed",
    "nearest": "nearest receiver's spectrum",
    "idw": "inverse-distance average",
    "mean": "mean image",
    "constant": "constant image",
    "zero": "our geometry, no spectra",
    "transmitter": "point at the transmitter",
}
TRUTHS = {"exact": "our own engine, single bounces", "sionna": "Sionna RT, depth 3"}
Row = dict[str, Any]
TABLES: dict[str, Callable[[], str]] = {}


def table(name: str) -> str:
    """The Markdown of a table.

    Raises:
        KeyError: for a name that no table has.
    """
    if name.startswith("machine-"):
        return _machine(name.removeprefix("machine-"))
    return TABLES[name]()


@cache
def read(name: str) -> Row:
    """A result file; one of a settled question has its date, the commit that made it, question and answer beside it."""
    found: Row = json.loads(_file(name).read_text())
    return found


def _file(name: str) -> Path:
    settled = FOLDER / "settled" / f"{name}.json"
    return settled if settled.is_file() else FOLDER / f"{name}.json"


def measured(name: str) -> Row | None:
    """A result file that a checkout may lack; :func:`missing` is then what a page says."""
    return read(name) if _file(name).is_file() else None


def missing(command: str) -> str:
    """What a page says in the place of a table without a result file."""
    return f"*Not measured here yet: `{command}` makes these figures.*"


def entry(name: str) -> Callable[[Callable[[], str]], Callable[[], str]]:
    """Enters a table under its name."""

    def enter(function: Callable[[], str]) -> Callable[[], str]:
        TABLES[name] = function
        return function

    return enter


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Rows of cells under a head; all but the first column set right.

    Raises:
        ValueError: for a row that has not one cell a column.
    """
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    for line in lines:
        if len(line) != len(head):
            raise ValueError(f"rows: got {len(line)} cells, expected {len(head)}: {', '.join(head)}")
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def show(value: Any, form: str = "{:.1f}") -> str:
    """A value in a format, or nothing for None."""
    return "" if value is None else form.format(value)


def kind_of(name: str) -> str:
    """The kind of a result file: of ``gpu-CARD`` it is ``gpu``, of ``filmed-ROOM`` ``filmed``."""
    return name.partition("-")[0]


def older(name: str) -> list[str]:
    """What the code computes otherwise today than when a result file was made: of :data:`VERSIONS` those that it depends on."""
    then = read(name).get("machine", {}).get("computes", {})
    return [what for what in DEPENDS.get(kind_of(name), ()) if then.get(what) != VERSIONS[what]]


def _machine(name: str) -> str:
    m = read(name)["machine"]
    text = f"Every figure is in `{_file(name).relative_to(ROOT)}`."
    if "processor" in m:
        device = "" if m["device"] == "cpu" else f", {m['device']}"
        on = f"{m['processor']}, {m['cores']} cores{device}, Python {m['python']}, Warp {m['versions']['warp-lang']}"
        text = f"Measured on {on}. {text}"
    if old := older(name):
        text += f" **Not run since these parts of the code changed: {', '.join(old)}.** Today's code gives other figures."
    return text


def find(rows: list[Row], **wanted: Any) -> Row | None:
    """The first row with these values."""
    return next((r for r in rows if all(r.get(k) == v for k, v in wanted.items())), None)
