"""What is right of what came back: an answer without NaN, or an error that names what is wrong with what was given."""

from __future__ import annotations

import inspect
import itertools
import re
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from fuzz.values import is_numbers

Leaves = dict[str, np.ndarray]
"""Numbers of an answer, by where they stand in it."""
ERRORS = (ValueError, TypeError, OSError, ImportError)


def leaves(answer: Any) -> Leaves:
    """All numbers that ``answer`` holds."""
    return dict(_leaves(answer, "", 0))


def _leaves(value: Any, where: str, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    if depth > 6 or value is None or isinstance(value, (str, bytes, type)):
        return
    if isinstance(value, wp.array):
        value = value.numpy()
    elif hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    if is_numbers(value) or isinstance(value, (bool, int, float, complex, np.generic, np.ndarray)):
        array = np.asarray(value)
        if array.dtype.kind in "biufc":
            yield where, array
        return
    inside: Iterable[tuple[Any, Any]] = ()
    if isinstance(value, Mapping):
        inside = value.items()
    elif isinstance(value, (list, tuple)) or inspect.isgenerator(value):
        inside = enumerate(itertools.islice(value, 100))
    elif is_dataclass(value):
        inside = ((f.name, getattr(value, f.name)) for f in fields(value))
    elif type(value).__module__.startswith("warprrf"):
        # What is computed when first asked for is an attribute of the class too.
        own_names = [n for n in vars(value) if not (n.startswith("_") or hasattr(type(value), n))]
        inside = ((name, getattr(value, name)) for name in own_names)
    for name, own in inside:
        yield from _leaves(own, f"{where}.{name}", depth + 1)


def asked(ask: Callable[[], Any]) -> Leaves | Exception:
    """The answer, or what was raised in its place, whatever that is."""
    try:
        return leaves(ask())
    except Exception as error:  # noqa: BLE001
        return error


def complaint(error: BaseException, names: Collection[str]) -> str:
    """What is wrong with ``error`` as a refusal, where one of ``names`` is expected in its message; nothing if empty.

    Several words count as one name where one is part of another: ``sigma`` names ``beam_sigma_rad``.
    """
    kind, text = type(error).__name__, str(error)
    if not isinstance(error, ERRORS):
        return f"{kind}: {text}"
    if isinstance(error, OSError) and error.filename is not None:
        return ""
    first = re.match(r"(\w{4,}):", text)
    if first and any(first[1] in name or name in first[1] for name in names):
        return ""
    if not any(re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text) for name in names if name):
        return f"names nothing: {kind}: {text}"
    return ""


def origin(error: Exception) -> str:
    """The place in the library that an error came from."""
    own = [f for f in traceback.extract_tb(error.__traceback__) if "warprrf" in f.filename]
    return f"{Path(own[-1].filename).name}: {own[-1].name}" if own else "not in the library"


def wrong(answer: Leaves, usual: Leaves, unknown: tuple[str, ...] = ()) -> str:
    """Where ``answer`` holds NaN that the ``usual`` answer does not have there.

    NaN is right where names end in one of ``unknown``. Attributes of a data set are the caller's own.
    A pixel of a spectrum from which nothing comes has no delay and no direction: these are NaN there. So is a thickness that
    nobody knows, and a path has no points past its last interaction.
    """
    for where, array in answer.items():
        if not _holds_nan(array) or ".attributes." in where or where.endswith((".thickness_m", *unknown)):
            continue
        gain = answer.get(where.rpartition(".")[0] + ".path_gain")
        if (
            gain is not None
            and where.endswith((".delay_s", ".aod"))
            and gain.shape == array.shape[: gain.ndim]
            and not _holds_nan(array[gain > 0])
        ):
            continue
        codes = answer.get(where.rpartition(".")[0] + ".interactions")
        if codes is not None and where.endswith(".vertices") and not _holds_nan(array[codes > 0]):
            continue
        if where not in usual or not _holds_nan(usual[where]):
            return f"NaN in answer{where}"
    return ""


def _holds_nan(array: np.ndarray) -> bool:
    return array.dtype.kind in "fc" and bool(np.isnan(array).any())


def differs(answer: Leaves, usual: Leaves, tolerance: float = 0.0) -> str:
    """Where ``answer`` is another than the ``usual`` one."""
    if answer.keys() != usual.keys():
        return f"other parts: {sorted(answer.keys() ^ usual.keys())[:3]}"
    for where, array in answer.items():
        if re.search(r"(seconds|(time|trace|solve|full|reduced)_s)$", where):  # of the computation
            continue
        known = usual[where]
        if array.shape != known.shape:
            return f"shape {array.shape} instead of {known.shape} in answer{where}"
        scale = float(np.abs(known)[np.isfinite(known)].max(initial=0.0))
        if not np.allclose(array, known, rtol=tolerance, atol=tolerance * scale, equal_nan=True):
            return f"other values in answer{where}"
    return ""


def changes(answer: Leaves, usual: Leaves, part: str) -> int:
    """How many numbers differ in a part of the answer; all where shapes do."""
    count = 0
    for where in (w for w in usual if w.startswith(part)):
        a, b = answer.get(where, np.zeros(0)), usual[where]
        same = a.shape == b.shape
        count += int((~np.isclose(a, b, 0, 0, equal_nan=True)).sum()) if same else b.size + 5
    return count
