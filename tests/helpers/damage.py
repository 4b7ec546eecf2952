"""Damaged copies of a file, and what becomes of reading each: in one process of its own, within a time limit.

``read`` is the name ``module:function`` of a function from a path to plain values and arrays by name, importable from
``tests/helpers``. Run as a script this is that process.
"""

from __future__ import annotations

import faulthandler
import importlib
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

FLIPS, CUTS = 200, 60
HELPERS = Path(__file__).parent


@dataclass
class Survey:
    """What became of reading damaged copies of one file.

    Attributes:
        copies: how many were read.
        refused: by ValueError or OSError that names the file.
        equal: gave what the whole file gives.
        changed: gave something else: the damage, and of each value that differs how many numbers did.
        wrong: damage and outcome of those that ended otherwise: another error, a value that is NaN only now.
        slowest_s: longest time that one took.
    """

    copies: int = 0
    refused: int = 0
    equal: int = 0
    changed: list[tuple[str, dict[str, int]]] = field(default_factory=list)
    wrong: list[tuple[str, str]] = field(default_factory=list)
    slowest_s: float = 0.0


def damaged(data: bytes, flips: int = FLIPS, cuts: int = CUTS, seed: int = 0) -> Iterator[tuple[str, bytes]]:
    """Copies of ``data`` with one bit flipped, a third of them among the first 512 bytes, and copies cut short."""
    rng = np.random.default_rng(seed)
    for k in range(flips):
        bit = int(rng.integers(8 * (min(512, len(data)) if k % 3 == 0 else len(data))))
        copy = bytearray(data)
        copy[bit // 8] ^= 1 << bit % 8
        yield f"bit {bit}", bytes(copy)
    for length in rng.choice(len(data), size=min(cuts, len(data)), replace=False):
        yield f"cut to {length}", data[:length]


def survey(
    path: Path,
    read: str,
    *,
    flips: int = FLIPS,
    cuts: int = CUTS,
    seed: int = 0,
    seconds: float = 60.0,
) -> Survey:
    """Read damaged copies of the file ``path``, each put in its place in turn; the file is whole again at the end.

    Raises:
        AssertionError: naming the damage at which the process crashed, or was when its time was up.
    """
    whole = path.read_bytes()
    command = [sys.executable, __file__, str(path), read, str(flips), str(cuts), str(seed)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired as error:
        at = (error.stdout or b"").decode().splitlines()[-1:]
        raise AssertionError(f"{path.name}: no end after {seconds:g} s, at {at}") from error
    finally:
        path.write_bytes(whole)
    *told, last = done.stdout.splitlines() or [""]
    if done.returncode != 0:
        raise AssertionError(f"{path.name}: exit {done.returncode} at {last!r}\n{done.stderr[-3000:]}")
    return Survey(**json.loads(last))


def differences(found: dict[str, Any], expected: dict[str, Any]) -> dict[str, int]:
    """How many numbers differ in each value; -1 where kind, shape or the names do."""
    if found.keys() != expected.keys():
        return {"names": -1}
    count = {}
    for name, value in expected.items():
        a, b = np.asarray(found[name]), np.asarray(value)
        if a.shape != b.shape or a.dtype.kind != b.dtype.kind:
            count[name] = -1
        elif a.dtype.kind in "fc":
            count[name] = int((~((a == b) | (np.isnan(a) & np.isnan(b)))).sum())
        else:
            count[name] = int((a != b).sum())
    return {name: n for name, n in count.items() if n}


def new_nan(found: dict[str, Any], expected: dict[str, Any]) -> list[str]:
    """Values that hold NaN and held none before."""

    def holds(value: Any) -> bool:
        array = np.asarray(value)
        return array.dtype.kind in "fc" and bool(np.isnan(array).any())

    return [name for name, value in found.items() if holds(value) and not holds(expected.get(name, 0.0))]


def _main(path: Path, read: str, flips: int, cuts: int, seed: int) -> None:
    faulthandler.enable()
    warnings.simplefilter("ignore")  # damage may warn; what is asked is how it ends
    module, function = read.split(":")
    reader = getattr(importlib.import_module(module), function)
    whole = path.read_bytes()
    expected, result = reader(path), Survey()
    for damage, copy in damaged(whole, flips, cuts, seed):
        print(damage, flush=True)
        path.write_bytes(copy)
        result.copies += 1
        start = time.perf_counter()
        try:
            found = reader(path)
        except (ValueError, OSError) as error:
            if path.name in str(error) or path.name in str(getattr(error, "filename", "")):
                result.refused += 1
            else:
                result.wrong.append((damage, f"does not name the file: {type(error).__name__}: {error}"))
        except Exception as error:  # noqa: BLE001 (whatever it is, it is reported)
            result.wrong.append((damage, f"{type(error).__name__}: {error}"))
        else:
            differ = differences(found, expected)
            if nan := new_nan(found, expected):
                result.wrong.append((damage, f"NaN in {', '.join(nan)}"))
            elif differ:
                result.changed.append((damage, differ))
            else:
                result.equal += 1
        result.slowest_s = max(result.slowest_s, time.perf_counter() - start)
    print(json.dumps(asdict(result)))


if __name__ == "__main__":
    _main(Path(sys.argv[1]), sys.argv[2], *(int(word) for word in sys.argv[3:]))
