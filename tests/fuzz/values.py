"""What arguments and contents of files are replaced with: hostile values, and the same value in other clothes."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from importlib import import_module
from typing import Any

import numpy as np
import warp as wp
from radio_scenes import box_mesh, joined, square

import warprrf as wr


class Array(np.ndarray):
    """An array of a class of its own."""


class Anything:
    """A class that takes any arguments, where a function is asked for, and is no answer to anything."""

    def __init__(self, *args: Any, **options: Any) -> None:
        pass


def _with(value: Any, one: float) -> np.ndarray:
    """``value`` as numbers, one of them replaced."""
    array = np.array(value, dtype=complex if np.iscomplexobj(value) else float)
    array.reshape(-1)[array.size // 2 : array.size // 2 + 1] = one
    return array


def _locked(value: Any) -> np.ndarray:
    array = np.array(value)
    array.setflags(write=False)
    return array


PLAIN: dict[str, Any] = {
    "none": None, "true": True, "zero": 0, "minus one": -1, "a half": 0.5, "nan": float("nan"), "inf": float("inf"),
    "huge": 1e300, "tiny": 5e-324, "2^31": 2**31, "2^63": 2**63, "10^40": 10**40, "no text": "", "text": "nonsense",
    "long text": "x" * 5000, "number as text": "1.0", "no list": [], "list": [1, 2], "ragged": [[1.0], [1.0, 2.0]],
    "nested": [[[[0.0]]]], "texts": ["a", "b", "c"], "dictionary": {"a": 1},
}  # fmt: skip
"""Values that JSON holds, more or less; what stood there before does not matter."""

OBJECTS: dict[str, Callable[[Any], Any]] = {
    "bytes": lambda v: b"\x00\xff",
    "null byte": lambda v: "a\0b",
    "complex": lambda v: 1j,
    "fraction": lambda v: Fraction(1, 3),
    "decimal": lambda v: Decimal("0.1"),
    "numpy scalar": lambda v: np.float32(1.5),
    "numpy integer": lambda v: np.int8(3),
    "function": lambda v: lambda *a, **k: None,
    "object": lambda v: object(),
    "class": lambda v: Anything,
    "generator": lambda v: iter([1.0, 2.0, 3.0]),
    "date": lambda v: np.array(["2020-01-01"], dtype="datetime64[s]"),
    "record": lambda v: np.zeros(3, dtype=[("a", "f8"), ("b", "i4")]),
    "warp array": lambda v: wp.zeros(3, dtype=wp.vec3, device="cpu"),
    "warp flat": lambda v: wp.zeros(3, dtype=float, device="cpu"),
    "repeated in a list": lambda v: [v, v],
    "horn": lambda v: wr.horn(0.2),
    "mirror": lambda v: np.diag([1.0, 1.0, -1.0]),
    "rf3dgs+": lambda v: "rf3dgs+",
    "readings": lambda v: wr.Readings([1.0, 1.0, 2.5], [2.0, 2.0, 1.5], [1e-8], 300e9, floor=1e-15),
}
"""Python's, other packages' and our own values, for arguments alone."""


def _of(vertices: Any, faces: Any) -> Callable[[Any], Any]:
    """A mesh, or a scene of it, as the one that stood there."""

    def make(value: Any) -> Any:
        mesh = wr.Mesh(vertices, faces)
        held = isinstance(value, wr.Scene)
        return wr.Scene(mesh, list(value.materials[:1]), np.zeros(len(faces), int)) if held else mesh

    return make


_ROOM = box_mesh([0, 0, 0], [5, 4, 3], inward=True)
_SHEETS = joined(*(square(2.0, z) for z in (0.0, 1.0, 2.5)))[0]
SCENES: dict[str, Callable[[Any], Any]] = {
    "one sheet": _of(*square(5.0)),
    "sheets": _of(_SHEETS.vertices, _SHEETS.faces),
    "one side open": _of(_ROOM[0], _ROOM[1][2:]),
    "a closed box": _of(*box_mesh([0, 0, 0], [5, 4, 3])),
    "no area": _of(np.outer([0.0, 1.0, 2.0], [1.0, 2.0, 3.0]), np.array([[0, 1, 2]])),
}
"""Meshes and scenes in the place of one."""

ARRAYS: dict[str, Callable[[Any], Any]] = {
    "empty": lambda v: np.zeros(0),
    "no rows": lambda v: np.asarray(v)[:0],
    "one row less": lambda v: np.asarray(v)[:-1],
    "one row more": lambda v: np.concatenate([np.asarray(v)] + [np.asarray(v)[:1]]),
    "one column less": lambda v: np.asarray(v)[..., :-1],
    "transposed": lambda v: np.asarray(v).T,
    "flat": lambda v: np.ravel(v),
    "deeper": lambda v: np.asarray(v)[None],
    **{f"with {x:g}": lambda v, x=x: _with(v, x) for x in (np.nan, -np.inf, 1e300, 1e20, 1e9, -1.0)},
    "zeros": lambda v: np.zeros_like(np.asarray(v)),
    "negated": lambda v: -np.asarray(v),
    "all alike": lambda v: np.broadcast_to(np.asarray(v)[:1], np.shape(v)),
    "as complex": lambda v: np.asarray(v) * (1 + 1j),
    **{
        f"as {t.__name__}": lambda v, t=t: np.asarray(v).astype(t)
        for t in (str, bool, np.int8, np.uint64, np.float16)
    },
}
"""Arrays made of the one that stood there."""

SAME: dict[str, Callable[[Any], Any]] = {
    "as list": lambda v: np.asarray(v).tolist(),
    "as objects": lambda v: np.asarray(v).astype(object),
    "strided": lambda v: np.repeat(np.asarray(v)[..., None], 2, axis=-1)[..., 0],
    "column-major": lambda v: np.asfortranarray(v),
    "read-only": _locked,
    "byte-swapped": lambda v: np.asarray(v).astype(np.asarray(v).dtype.newbyteorder()),
    "subclass": lambda v: np.asarray(v).view(Array),
    "masked": lambda v: np.ma.masked_array(v),
    "torch": lambda v: import_module("torch").from_numpy(np.array(v)),
}
"""The same array: the same answer is expected, or none."""

NOT_FINITE = {"nan", "inf", "with nan", "with -inf"}
"""What is given with these may come back."""

VALUES = {name: lambda v, x=x: x for name, x in PLAIN.items()} | OBJECTS | SCENES | ARRAYS | SAME


def is_numbers(value: Any) -> bool:
    """Whether ``value`` is an array of numbers, or a list or tuple of some."""
    if isinstance(value, np.ndarray):
        return bool(value.ndim) and value.dtype.kind in "biufc"
    try:
        array = np.asarray(value) if isinstance(value, (list, tuple)) else np.zeros(())
    except ValueError:
        return False
    return bool(array.size and array.ndim) and array.dtype.kind in "biufc"


def names_for(value: Any) -> list[str]:
    """Names of the values that ``value`` can be replaced with."""
    more = SCENES if isinstance(value, (wr.Mesh, wr.Scene)) else (*ARRAYS, *SAME) if is_numbers(value) else ()
    return [*PLAIN, *OBJECTS, *more]
