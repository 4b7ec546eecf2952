"""PLY files: elements, tables of numbers whose columns have names; ASCII or binary, lists among them.

The format has no checksum. What it states is therefore held against what is there: sizes before anything is reserved,
types, names, and that the file ends where its header says.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.files import write_bytes

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_END = b"end_header"
_LONGEST_HEADER = 1 << 16


@dataclass(frozen=True)
class Lists:
    """A column of lists: their lengths, shape ``(N,)``, and all their values after each other."""

    lengths: np.ndarray
    values: np.ndarray


Element = dict[str, np.ndarray | Lists]
"""Columns of an element by name, shape ``(N,)``."""


@dataclass
class _Stated:
    """An element as the header states it: its columns as (name, type, type of lengths or None)."""

    name: str
    count: int
    columns: list[tuple[str, str, str | None]] = field(default_factory=list)

    def row(self, order: str, lengths: Mapping[str, int]) -> np.dtype[Any]:
        """Type of a row whose lists have ``lengths``, as bytes of ``order`` or as words of ASCII, read as floats."""
        fields: list[tuple[Any, ...]] = []
        for name, kind, counted in self.columns:
            value, count = (order + kind, order + (counted or "")) if order else ("f8", "f8")
            fields += [(f"#{name}", count), (name, value, (lengths[name],))] if counted else [(name, value)]
        return np.dtype(fields)


def read_ply(path: str | os.PathLike[str]) -> dict[str, Element]:
    """The elements of a PLY file by name.

    Raises:
        OSError: naming the file, if it cannot be read.
        ValueError: naming it, if it is no PLY file, cut short, longer than its header says, or states what cannot be.
    """
    data = Path(path).read_bytes()
    try:
        return _elements(data)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from error


def holds_gaussians(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a PLY whose header states Gaussians, which have scales."""
    if Path(path).suffix.lower() != ".ply" or Path(path).is_dir():
        return False
    with Path(path).open("rb") as file:
        data = file.read(_LONGEST_HEADER)
    try:
        _, stated, _ = _header(data)
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from error
    return any(e.name == "vertex" and "scale_0" in [name for name, _, _ in e.columns] for e in stated)


def write_ply(
    path: str | os.PathLike[str],
    columns: Mapping[str, np.ndarray],
    faces: np.ndarray | None,
    number: str = "float",
) -> None:
    """Write vertices by their ``columns``, each ``(V,)``, in single precision or as "double", and triangles ``(F, 3)``."""
    table = np.column_stack(list(columns.values())).astype("<f4" if number == "float" else "<f8")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {number} {name}" for name in columns]
    content = table.tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        rows = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", (3,))]))
        rows["count"], rows["corners"] = 3, faces
        content += rows.tobytes()
    write_bytes(path, "\n".join([*header, "end_header", ""]).encode("ascii") + content)


def _elements(data: bytes) -> dict[str, Element]:
    order, stated, body = _header(data)
    if order:
        rest = np.frombuffer(data, np.uint8, offset=body)
    else:
        rest = np.array(data[body:].split(), dtype=np.float64).view(np.uint8)
    found: dict[str, Element] = {}
    for element in stated:
        least = element.row(order, dict.fromkeys((name for name, _, _ in element.columns), 0)).itemsize
        if element.count * least > len(rest):
            raise ValueError(f"cut short: {element.count} rows of {element.name!r} are not there")
        found[element.name], rest = _rows(element, order, rest)
        if not order:
            _set_types(element, found[element.name])
    if len(rest) and (not order or bytes(rest).strip()):
        raise ValueError(f"holds more than its header states, {len(rest)} bytes")
    return found


def _set_types(stated: _Stated, element: Element) -> None:
    """Give the words of ASCII the types that the header states."""
    for name, kind, _ in stated.columns:
        column = element[name]
        words = column.values if isinstance(column, Lists) else column
        with np.errstate(invalid="ignore", over="ignore"):
            values = words.astype(kind)
        if values.dtype.kind in "iu" and not np.array_equal(values, words):
            raise ValueError(f"{name} of {stated.name!r} holds numbers that are not of type {kind}")
        element[name] = Lists(column.lengths, values) if isinstance(column, Lists) else values


def _header(data: bytes) -> tuple[str, list[_Stated], int]:
    """Byte order ("" for ASCII), elements, and where these begin."""
    end = data.find(b"\n" + _END)
    body = data.find(b"\n", end + 1) + 1
    if not data.startswith(b"ply") or end < 0 or body == 0 or data[end + 1 : body].strip() != _END:
        raise ValueError("not a PLY file (no 'ply' ... 'end_header')")
    order: str | None = None
    stated: list[_Stated] = []
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, _] if order is None and name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 12:
                stated.append(_Stated(name, int(count)))
            case ["property", kind, name] if stated and kind in _TYPES:
                stated[-1].columns.append((name, _TYPES[kind], None))
            case ["property", "list", counted, kind, name] if (
                stated and kind in _TYPES and _TYPES.get(counted, "f")[0] in "iu"
            ):
                stated[-1].columns.append((name, _TYPES[kind], _TYPES[counted]))
            case _:
                raise ValueError(f"cannot read the line {line!r} of the PLY header")
    if order is None or not stated:
        raise ValueError("the PLY header names no known format or no element")
    for element in stated:
        names = [name for name, _, _ in element.columns]
        if len(set(names)) < len(names) or not names:
            raise ValueError(f"element {element.name!r} has no property, or one twice")
    if len({element.name for element in stated}) < len(stated):
        raise ValueError("it states an element twice")
    return order, stated, body


def _rows(element: _Stated, order: str, rest: np.ndarray) -> tuple[Element, np.ndarray]:
    """An element and what follows it: read at once where all lists of a column are as long as the first one."""
    first, _ = _walk(element, order, rest, min(element.count, 1))
    alike = {name: int(column.lengths.sum()) for name, column in first.items() if isinstance(column, Lists)}
    row = element.row(order, alike)
    used = element.count * row.itemsize
    if used > len(rest):
        return _walk(element, order, rest, element.count)
    held = rest[:used].view(row)
    if any((held[f"#{name}"] != n).any() for name, n in alike.items()):
        return _walk(element, order, rest, element.count)
    found: Element = {}
    for name, _, counted in element.columns:
        column = held[name]
        found[name] = Lists(np.full(len(held), alike[name]), column.ravel()) if counted else column
    return found, rest[used:]


def _walk(element: _Stated, order: str, rest: np.ndarray, count: int) -> tuple[Element, np.ndarray]:
    """The first ``count`` rows one by one."""
    place = 0

    def take(kind: str, n: float) -> np.ndarray:
        nonlocal place
        dtype, n = np.dtype(order + kind if order else "f8"), float(n)  # a byte overflows
        if n != int(n) or n < 0 or place + n * dtype.itemsize > len(rest):
            raise ValueError(f"cut short: a list of {n} in {element.name!r} is not there")
        start, place = place, place + int(n) * dtype.itemsize
        return rest[start:place].view(dtype)

    columns: dict[str, list[np.ndarray]] = {name: [] for name, _, _ in element.columns}
    for _ in range(count):
        for name, kind, counted in element.columns:
            columns[name].append(take(kind, take(counted, 1)[0] if counted else 1))
    found: Element = {}
    for name, kind, counted in element.columns:
        values = np.concatenate([np.zeros(0, kind), *columns[name]])
        lengths = np.array([len(v) for v in columns[name]], np.int64)
        found[name] = Lists(lengths, values) if counted else values
    return found, rest[place:]
