"""Arrays by name as NetCDF-4 files (h5netcdf), sealed; encoded in memory, because HDF5 does not survive a full disk.

A file may have been edited by other tools, which reorder dimensions and coordinates, pack values and convert units. It is
read as what it states: dimensions and coordinates are put in order, empty values become NaN, and what cannot be put in
order is refused. The checksum tells damage before HDF5 sees it; what others wrote has none.
"""

from __future__ import annotations

import fcntl
import io
import json
import math
import mmap
import os
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from warprrf.checks import Expected, check_arrays
from warprrf.device import require
from warprrf.files import MOST_INFLATED, check_seal, end_with_seal, naming, partial_path, write_bytes

_CHUNK_BYTES = 2_000_000  # of packed variables, several rows to a chunk
# A store's rows are followed by the CRC-32 of each, 0 where it is not there, and a line that says where they are.
_SUMS = "checksums"
_LINE, _MOST_LINE = b"\nwarprrf rows ", 1 << 16
_SAME_PLACE = 1e-6  # of coordinates, in their unit
# HDF5's global heaps, with the lengths of 8 bytes that all its writers use: signature and size; index and size.
_HEAP, _HEAP_HEADER, _HEAP_OBJECT = b"GCOL\1\0\0\0", struct.Struct("<8sQ"), struct.Struct("<H6xQ")


@dataclass(frozen=True)
class Variable:
    """What a variable is.

    Attributes:
        dimensions: names, in the order of the array that is written and read.
        unit: by its symbol; None for text and flags.
        about: more attributes of it.
        packed: compress it, and do so in chunks of whole rows.
        optional: files may lack it.
        field: name of what it holds, if another; see :func:`encoded`. One of another number of axes is not held.
        codes: what the values 0, 1, ... stand for, if for anything.
        is_part: it holds the real part of its field, or the imaginary one, as its own name's end says.
        expected: limits of its values in a file.
    """

    dimensions: tuple[str, ...]
    unit: str | None = None
    about: Mapping[str, Any] = field(default_factory=dict)
    packed: bool = False
    optional: bool = False
    field: str = ""
    codes: tuple[Any, ...] = ()
    is_part: bool = False
    expected: Expected | None = None


@dataclass(frozen=True)
class Axis:
    """What stands along a dimension of known places.

    Attributes:
        expected: numbers or labels for a length, distinct.
        unit: of numbers; labels, without one, may be missing in a file.
        period: after which numbers mean the same again.
    """

    expected: Callable[[int], np.ndarray]
    unit: str | None = None
    period: float | None = None


@dataclass(frozen=True)
class Room:
    """Room for an array that a :class:`Store` fills row by row: its shape and type."""

    shape: tuple[int, ...]
    dtype: Any


def encoded(fields: Mapping[str, Any], variables: Mapping[str, Variable]) -> dict[str, np.ndarray]:
    """The arrays of ``variables`` that hold ``fields``, by name, those that are None apart."""
    arrays = dict[str, np.ndarray]()
    for name, it in variables.items():
        value = fields.get(it.field or name)
        if value is None or np.ndim(value) != len(it.dimensions):
            continue
        if it.codes:
            value = np.asarray(sum(k * (value == meant) for k, meant in enumerate(it.codes)), np.int8)
        arrays[name] = getattr(value, name.rpartition("_")[2]) if it.is_part else np.asarray(value)
    return arrays


def decoded(arrays: Mapping[str, np.ndarray], variables: Mapping[str, Variable]) -> dict[str, Any]:
    """The fields that ``arrays`` of ``variables`` hold, by name."""
    limits = {name: it.expected for name, it in variables.items() if name in arrays}
    check_arrays(arrays, {name: expected for name, expected in limits.items() if expected is not None})
    fields = dict[str, Any]()
    for name, array in arrays.items():
        it = variables[name]
        key = it.field or name
        if it.is_part:
            array = arrays[f"{key}_real"] + 1j * arrays[f"{key}_imag"]
        if it.codes:
            unknown = array[~np.isin(array, range(len(it.codes)))]
            if unknown.size:
                raise ValueError(
                    f"{name}: got {unknown[0]}, expected whole numbers from 0 to {len(it.codes) - 1}"
                )
            array = np.array(it.codes)[array.astype(int)]
        fields[key] = array
    return fields


XYZ = Axis(lambda _: np.array(["x", "y", "z"]))


def write(
    path: str | os.PathLike[str],
    arrays: Mapping[str, np.ndarray],
    variables: Mapping[str, Variable],
    axes: Mapping[str, Axis],
    attributes: Mapping[str, Any],
    *,
    level: int = 4,
) -> None:
    """Write ``arrays``, of which ``variables`` tells what they are, whole or not at all.

    Args:
        axes: by the dimensions that they belong to.
        attributes: of the file: text, numbers and lists of them.
        level: of compression, 1 to 9.

    Raises:
        OSError: naming ``path``, if the system does not take it.
    """
    data = io.BytesIO()
    with require("h5netcdf", extra="all").File(data, "w") as file:
        _fill(file, arrays, variables, axes, attributes, level)
    write_bytes(path, data.getbuffer(), seal=True)


def _fill(
    file: Any,
    arrays: Mapping[str, Any],
    variables: Mapping[str, Variable],
    axes: Mapping[str, Axis],
    attributes: Mapping[str, Any],
    level: int = 4,
) -> None:
    h5py = require("h5py", extra="all")
    sizes = {d: n for k, a in arrays.items() for d, n in zip(variables[k].dimensions, a.shape, strict=True)}
    file.dimensions = sizes
    for name, axis in axes.items():
        places = axis.expected(sizes[name])
        kind = h5py.string_dtype() if places.dtype.kind == "U" else places.dtype
        file.create_variable(name, (name,), kind, data=places.astype(kind))
        if axis.unit is not None:
            file.variables[name].attrs["units"] = axis.unit
    for name, array in arrays.items():
        it, how, data = variables[name], dict[str, Any](), array
        if isinstance(array, Room):  # in one piece and there from the start, so that its place never changes
            how["dcpl"], data = h5py.h5p.create(h5py.h5p.DATASET_CREATE), None
            how["dcpl"].set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
            how["dcpl"].set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        elif it.packed and array.size:
            rows = max(1, min(len(array), _CHUNK_BYTES // array[0].nbytes))
            how = {"compression": "gzip", "compression_opts": level, "shuffle": True}
            how["chunks"] = (rows, *array.shape[1:])
        made = file.create_variable(name, it.dimensions, array.dtype, data=data, **how)
        for key, value in {**({} if it.unit is None else {"units": it.unit}), **it.about}.items():
            made.attrs[key] = value
    for key, value in attributes.items():
        file.attrs[key] = int(value) if isinstance(value, bool | np.bool_) else value


class Store:
    """A NetCDF-4 file whose arrays are filled row by row, as a context manager: whole or not there.

    HDF5 lays it out with the first rows, as ``NAME.unfinished``; rows are then written past it into their places, so that a
    kill leaves the file sound and a full disk is an error of the system's. Who comes again goes on: rows whose checksums do
    not fit are missing. With the last row it is sealed and gets its name. One process at a time works on it.

    Args:
        known: arrays that are written at once.
        variables: what these and the rows' are.
        attributes: of the file; ``key`` among them, by which a store is known.
        count: rows that it will have.

    Attributes:
        missing: which rows are not there yet, shape ``(count,)``.

    Raises:
        OSError: naming the file, if the system does not take it.
        ValueError: naming ``path``, on entering: for a file of another key, none of these, a damaged one, or one that
            another process is at work on.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        known: Mapping[str, np.ndarray],
        variables: Mapping[str, Variable],
        attributes: Mapping[str, Any],
        count: int,
    ) -> None:
        self.path, self._unfinished = Path(path), Path(f"{os.fspath(path)}.unfinished")
        self._known, self._variables, self._attributes = known, variables, attributes
        self.missing = np.ones(count, bool)
        self._places: dict[str, tuple[int, Room]] = {}
        self._rest = 0
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Store:
        while not self.path.exists():
            try:
                self._open(self._unfinished)
            except FileNotFoundError:
                if not self.path.exists():
                    return self
                continue
            with ExitStack() as opened:
                opened.enter_context(self._stream)
                file = self._unfinished
                # Another process may have finished it since: then it is no longer what the name stands for.
                if file.exists() and os.path.samestat(os.fstat(self._stream.fileno()), file.stat()):
                    self._find(file)
                    self.missing = ~self._sound_rows()
                    opened.pop_all()
                    return self
            self._file = None
        if not check_seal(self.path):
            raise ValueError(f"store: {self.path} is no finished store; name another file, or remove it")
        self._find(self.path)
        self.missing[:] = False
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        if self._file is None:
            return
        with naming(self.path, self._unfinished), self._file:
            if kind is None and not self.missing.any():
                end_with_seal(self._unfinished)
                os.replace(self._unfinished, self.path)

    def put(self, rows: np.ndarray, arrays: Mapping[str, np.ndarray]) -> None:
        """Write ``rows`` (K,) of every array, ``(K, ...)`` each; they count once they are on the disk."""
        if self._file is None:
            self._lay_out(arrays)
        values = {n: np.ascontiguousarray(arrays[n], self._places[n][1].dtype) for n in self._row_names}
        values[_SUMS] = np.array([_row_sum(row) for row in zip(*values.values(), strict=True)], np.uint32)
        with naming(self.path, self._unfinished):
            for name, array in values.items():
                for row, value in zip(rows.tolist(), array, strict=True):
                    self._stream.seek(self._places[name][0] + row * value.nbytes)
                    self._stream.write(value.tobytes())
            self._stream.flush()
            os.fsync(self._stream.fileno())
        self.missing[rows] = False

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of the finished file that rows were written of, which stay on the disk."""
        return {name: self._mapped(self.path, name) for name in self._row_names}

    @property
    def _stream(self) -> IO[bytes]:
        if self._file is None:
            raise RuntimeError("a store is written within its with statement")
        return self._file

    @property
    def _row_names(self) -> list[str]:
        return sorted(self._places.keys() - {_SUMS})

    def _mapped(self, path: Path, name: str) -> np.ndarray:
        place, room = self._places[name]
        return np.memmap(path, room.dtype, "r", place, room.shape)

    def _lay_out(self, arrays: Mapping[str, np.ndarray]) -> None:
        count = len(self.missing)
        rooms: dict[str, Any] = {n: Room((count, *a.shape[1:]), a.dtype) for n, a in arrays.items()}
        partial = partial_path(self._unfinished)
        try:
            with naming(self.path, partial):
                with _FirstFailure(partial, "w+") as stream:
                    with require("h5netcdf", extra="all").File(stream, "w") as file:
                        _fill(file, rooms | dict(self._known), self._variables, {}, self._attributes)
                    if stream.failure is not None:
                        raise stream.failure
                with require("h5py", extra="all").File(partial, "r", locking=False) as file:
                    self._places = {n: (file[n].id.get_offset(), room) for n, room in rooms.items()}
                self._open(partial)  # and lock it, before anybody sees it
                end = self._stream.seek(0, os.SEEK_END)
                self._places[_SUMS] = end, Room((count,), np.dtype(np.uint32))
                held = {
                    n: (place, room.shape, np.dtype(room.dtype).str)
                    for n, (place, room) in self._places.items()
                }
                entry = {"key": self._attributes["key"], "places": held, "rest": self._sum_of_rest()}
                line = json.dumps(entry).encode()
                self._stream.seek(end)
                self._stream.write(bytes(4 * count) + _LINE + line + b" %08x\n" % zlib.crc32(line))
                self._stream.flush()
                os.link(partial, self._unfinished)
        except FileExistsError as error:
            raise ValueError(f"store: another process is at work on {self.path}; wait for it") from error
        finally:
            partial.unlink(missing_ok=True)

    def _open(self, path: Path) -> None:
        self._file = path.open("r+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._file.close()
            raise ValueError(f"store: another process is at work on {self.path}; wait for it") from error

    def _find(self, path: Path) -> None:
        """Where rows are in a file that was laid out, by the line behind what is HDF5's, which no damage gets past."""
        with path.open("rb") as file:
            file.seek(max(path.stat().st_size - _MOST_LINE, 0))
            line, _, digest = file.read().rpartition(_LINE)[2].partition(b"\n")[0].rpartition(b" ")
        if digest != b"%08x" % zlib.crc32(line):
            raise ValueError(f"store: {path} is damaged, or no store; name another file, or remove it")
        entry = json.loads(line)
        if entry["key"] != self._attributes["key"]:
            raise ValueError(
                f"store: {path} holds answers of another field, other places or other options; name another file, or "
                "remove it"
            )
        self._places = {
            n: (at, Room(tuple(s), np.dtype(kind))) for n, (at, s, kind) in entry["places"].items()
        }
        self._rest = entry["rest"]

    def _sound_rows(self) -> np.ndarray:
        """Which rows of the open file are there as they were written, shape ``(count,)`` bool.

        Raises:
            ValueError: if the rest of the file is not as it was laid out.
        """
        if self._rest != self._sum_of_rest():
            raise ValueError(f"store: {self._unfinished} was damaged; remove it, and begin anew")
        rows = zip(*(self._mapped(self._unfinished, n) for n in (_SUMS, *self._row_names)), strict=True)
        return np.array([known > 0 and known == _row_sum(values) for known, *values in rows])

    def _sum_of_rest(self) -> int:
        """Checksum of what is HDF5's in the open file but for the places of rows."""
        total, at = 0, 0
        for place, room in sorted(self._places.values(), key=lambda one: one[0]):
            self._stream.seek(at)
            total = zlib.crc32(self._stream.read(place - at), total)
            at = place + math.prod(room.shape) * np.dtype(room.dtype).itemsize
        return total


def _row_sum(values: Iterable[np.ndarray]) -> int:
    """Checksum of one row of every array; never 0, which stands for none."""
    total = 0
    for value in values:
        total = zlib.crc32(value.tobytes(), total)
    return total or 1


class _FirstFailure(io.FileIO):
    """A file that keeps what the system first refused for later: HDF5 does not survive it.

    Attributes:
        failure: that, or None.
    """

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        """As much as the system takes; all is said to be written."""
        left = memoryview(data).cast("B")
        try:
            while len(left) and self.failure is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.failure = error
        return memoryview(data).nbytes

    def truncate(self, size: int | None = None) -> int:
        """The size asked for, if the system takes it."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or error
        return self.tell() if size is None else size


def read(
    path: str | os.PathLike[str],
    variables: Mapping[str, Variable],
    axes: Mapping[str, Axis],
    kind: str | None = None,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Those of ``variables`` that the file holds, in the order of their dimensions and of ``axes``, and its attributes, among
    them a ``format`` of ``kind``.

    Raises:
        OSError: naming ``path``, if it cannot be read.
        ValueError: naming ``path``, if it is damaged, no NetCDF-4 file, or not to be put in order.
    """
    h5netcdf, name = require("h5netcdf", extra="all"), os.fspath(path)
    sealed = check_seal(path)
    try:
        if not sealed:
            check_heaps(path)
        with h5netcdf.File(name, "r") as file:
            there = {n: file.variables[n] for n in (*variables, *axes) if n in file.variables}
            stated = sum(math.prod(v.shape) * max(np.dtype(v.dtype).itemsize, 1) for v in there.values())
            if stated > MOST_INFLATED * os.path.getsize(path):
                raise ValueError(f"it states {stated} bytes of values")
            found = {n: _Found(n, v.dimensions, v[...], dict(v.attrs)) for n, v in there.items()}
            attributes = {n: _plain(value) for n, value in file.attrs.items()}
    except Exception as error:  # of a damaged file h5netcdf and h5py raise anything
        raise ValueError(f"{name}: damaged, or no NetCDF-4 file: {error}") from error
    if kind is not None and attributes.get("format") != kind:
        raise ValueError(f"{name}: holds {attributes.get('format')!r}, expected {kind!r}")
    if lacking := sorted(n for n, it in variables.items() if n not in found and not it.optional):
        raise ValueError(f"{name}: lacks {', '.join(lacking)}, expected a file saved by warprrf")
    try:
        arrays = {n: found[n].values(it) for n, it in variables.items() if n in found}
        for dimension, axis in axes.items():
            if dimension in found:
                order = found[dimension].order(axis)
                for n, array in arrays.items():
                    if dimension in variables[n].dimensions:
                        arrays[n] = array.take(order, axis=variables[n].dimensions.index(dimension))
            elif axis.unit is not None:
                raise ValueError(f"{dimension}: got no such coordinate, expected one that tells the order")
    except (ValueError, IndexError) as error:
        raise ValueError(f"{name}: {error}") from error
    return arrays, attributes


def check_heaps(path: str | os.PathLike[str]) -> None:
    """Raise ValueError for a damaged heap of texts and references, in which HDF5 would go round for ever.

    HDF5 steps from one object of a heap to the next by the sizes that they state (file format specification, III.E), nothing
    or past the end included.
    """
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        heap = data.find(_HEAP)
        while heap >= 0:
            at = heap + _HEAP_HEADER.size
            end = heap + _HEAP_HEADER.unpack(data[heap:at])[1]
            while at + _HEAP_OBJECT.size <= min(end, len(data)):
                index, size = _HEAP_OBJECT.unpack_from(data, at)
                step = (
                    _HEAP_OBJECT.size + -(-size // 8) * 8 if index else size
                )  # free space counts its own header
                if not _HEAP_OBJECT.size <= step <= end - at:
                    raise ValueError(f"its heap at byte {heap} states an object of {size} bytes at {at}")
                at += step
            heap = data.find(_HEAP, heap + 1)


@dataclass(frozen=True)
class _Found:
    name: str
    dimensions: tuple[str, ...]
    array: np.ndarray
    attributes: dict[str, Any]

    def values(self, it: Variable) -> np.ndarray:
        """Numbers in the order of the dimensions of ``it``; NaN where the file says that there is nothing."""
        array = self.array
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{self.name}: got values of type {array.dtype}, expected numbers")
        self._check_unit(it.unit)
        if sorted(self.dimensions) != sorted(it.dimensions):
            raise ValueError(f"{self.name}: got dimensions {self.dimensions}, expected {it.dimensions}")
        if packed := {"scale_factor", "add_offset"} & set(self.attributes):
            raise ValueError(
                f"{self.name}: got values packed by {' and '.join(sorted(packed))}, expected plain ones"
            )
        for key in ("_FillValue", "missing_value"):
            if (empty := array == self.attributes.get(key, np.nan)).any():
                if array.dtype.kind != "f":
                    raise ValueError(
                        f"{self.name}: got {np.count_nonzero(empty)} empty values, expected none"
                    )
                array = np.where(empty, array.dtype.type(np.nan), array)
        return array.transpose([self.dimensions.index(d) for d in it.dimensions])

    def order(self, axis: Axis) -> np.ndarray:
        """Where the places that ``axis`` expects stand."""
        held, expected = self.array, axis.expected(self.array.size)
        if expected.dtype.kind == "U":
            held = np.array([str(_plain(word)) for word in held.ravel()], dtype=str)
        elif held.dtype.kind not in "iuf":
            raise ValueError(f"{self.name}: got values of type {held.dtype}, expected numbers")
        elif axis.period is not None:
            low = expected.mean() - 0.5 * axis.period
            held = (held - low) % axis.period + low
        self._check_unit(axis.unit)
        if self.dimensions == (self.name,) and held.shape == expected.shape:
            order = np.argsort(held, kind="stable")[np.argsort(np.argsort(expected))]
            found = held[order]
            if (found == expected if axis.unit is None else np.abs(found - expected) < _SAME_PLACE).all():
                return order
        short = [np.array2string(a, threshold=6, edgeitems=2, precision=6) for a in (held, expected)]
        raise ValueError(f"{self.name}: got the places {short[0]}, expected {short[1]} in any order")

    def _check_unit(self, unit: str | None) -> None:
        stated = self.attributes.get("units", unit)
        if unit is not None and str(_plain(stated)) != unit:
            raise ValueError(f"{self.name}: got the unit {stated!r}, expected {unit!r}")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, np.generic):
        return value.item()
    return value.decode() if isinstance(value, bytes) else value
