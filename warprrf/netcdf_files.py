"""Arrays by name as NetCDF-4 files (h5netcdf), sealed; encoded in memory, because HDF5 does not survive a full disk.

A file may have been edited by other tools, which reorder dimensions and coordinates, pack values and convert units. It is
read as what it states: dimensions and coordinates are put in order, empty values become NaN, and what cannot be put in
order is refused. The checksum tells damage before HDF5 sees it; what others wrote has none.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warprrf.device import require
from warprrf.files import MOST_INFLATED, check_seal, write_bytes

_CHUNK_BYTES = 2_000_000  # of packed variables, several rows to a chunk
_SAME_PLACE = 1e-6  # of coordinates, in their unit


@dataclass(frozen=True)
class Variable:
    """What a variable is.

    Attributes:
        dimensions: names, in the order of the array that is written and read.
        unit: by its symbol; None for text and flags.
        about: more attributes of it.
        packed: compress it, and do so in chunks of whole rows.
        optional: files may lack it.
    """

    dimensions: tuple[str, ...]
    unit: str | None = None
    about: Mapping[str, Any] = field(default_factory=dict)
    packed: bool = False
    optional: bool = False


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
    h5netcdf, h5py = require("h5netcdf", extra="all"), require("h5py", extra="all")
    data = io.BytesIO()
    with h5netcdf.File(data, "w") as file:
        sizes = {
            d: n for k, a in arrays.items() for d, n in zip(variables[k].dimensions, a.shape, strict=True)
        }
        file.dimensions = sizes
        for name, axis in axes.items():
            places = axis.expected(sizes[name])
            kind = h5py.string_dtype() if places.dtype.kind == "U" else places.dtype
            file.create_variable(name, (name,), kind, data=places.astype(kind))
            if axis.unit is not None:
                file.variables[name].attrs["units"] = axis.unit
        for name, array in arrays.items():
            it, packing = variables[name], {}
            if it.packed and array.size:
                rows = max(1, min(len(array), _CHUNK_BYTES // array[0].nbytes))
                packing = {"compression": "gzip", "compression_opts": level, "shuffle": True}
                packing["chunks"] = (rows, *array.shape[1:])
            made = file.create_variable(name, it.dimensions, array.dtype, data=array, **packing)
            for key, value in {**({} if it.unit is None else {"units": it.unit}), **it.about}.items():
                made.attrs[key] = value
        for key, value in attributes.items():
            file.attrs[key] = int(value) if isinstance(value, bool | np.bool_) else value
    write_bytes(path, data.getbuffer(), seal=True)


def read(
    path: str | os.PathLike[str], variables: Mapping[str, Variable], axes: Mapping[str, Axis]
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Those of ``variables`` that the file holds, in the order of their dimensions and of ``axes``, and its attributes.

    Raises:
        OSError: naming ``path``, if it cannot be read.
        ValueError: naming ``path``, if it is damaged, no NetCDF-4 file, or not to be put in order.
    """
    check_seal(path)
    h5netcdf, name = require("h5netcdf", extra="all"), os.fspath(path)
    try:
        with h5netcdf.File(name, "r") as file:
            there = {n: file.variables[n] for n in (*variables, *axes) if n in file.variables}
            stated = sum(math.prod(v.shape) * max(np.dtype(v.dtype).itemsize, 1) for v in there.values())
            if stated > MOST_INFLATED * os.path.getsize(path):
                raise ValueError(f"it states {stated} bytes of values")
            found = {n: _Found(n, v.dimensions, v[...], dict(v.attrs)) for n, v in there.items()}
            attributes = {n: _plain(value) for n, value in file.attrs.items()}
    except Exception as error:  # of a damaged file h5netcdf and h5py raise anything
        raise ValueError(f"{name}: damaged, or no NetCDF-4 file: {error}") from error
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


@dataclass(frozen=True)
class _Found:
    """A variable as a file holds it."""

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
    """An attribute as a Python value."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, np.generic):
        return value.item()
    return value.decode() if isinstance(value, bytes) else value
