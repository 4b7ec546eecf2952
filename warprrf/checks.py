"""Argument checks that name the argument, what came and what was expected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, DTypeLike


def check_array(
    name: str,
    value: ArrayLike | wp.array,
    shape: tuple[int | None, ...] | None = None,
    dtype: DTypeLike = np.float64,
    finite: bool = True,
) -> np.ndarray:
    """``value`` (NumPy, Warp, torch or nested lists) as a contiguous NumPy array of ``shape`` and ``dtype``.

    Args:
        shape: expected shape, ``None`` for a free length; ``None`` altogether skips the check.
        dtype: of whole numbers: what is not whole, or too large for it, is refused.
        finite: refuse NaN and infinities.

    Raises:
        TypeError: if it cannot be read as numbers of that kind.
        ValueError: naming the argument, what came and what was expected.
    """
    if isinstance(value, wp.array):
        value = value.numpy()
    elif hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    wanted, what = np.dtype(dtype), type(value).__name__
    try:
        given = np.asarray(value)
        given = given.astype(np.float64) if given.dtype.kind == "O" else given
    except (TypeError, ValueError, OverflowError) as error:
        raise TypeError(f"{name}: got {what} that does not read as an array of {wanted}") from error
    if given.dtype.kind not in ("biufc" if wanted.kind == "c" else "biuf"):
        raise TypeError(f"{name}: got {what} of {given.dtype}, expected an array of {wanted}")
    with np.errstate(over="ignore", invalid="ignore"):  # both are found below
        array = np.asarray(given, dtype=wanted, order="C")
    if shape is not None and (
        array.ndim != len(shape)
        or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True))
    ):
        wished = ", ".join("any" if s is None else str(s) for s in shape)
        raise ValueError(f"{name}: got shape {array.shape}, expected ({wished})")
    if wanted.kind in "iu" and given.dtype != wanted and not np.array_equal(array, given):
        raise TypeError(f"{name}: got numbers that are not whole or too large, expected {wanted}")
    if finite and wanted.kind in "fc" and not np.isfinite(array).all():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise ValueError(f"{name}: got {bad} values that are NaN or infinite, expected finite numbers")
    return array


def check_count(name: str, value: object, least: int = 1, most: int = 2**31 - 1) -> int:
    """``value`` as a whole number from ``least`` to ``most``.

    Raises:
        ValueError: otherwise, naming the argument.
    """
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not least <= value <= most:  # type: ignore[operator]
        limit = f"{least} to {most}" if most < 2**31 - 1 else f"at least {least}"
        raise ValueError(f"{name}: got {value!r}, expected a whole number of {limit}")
    return int(value)  # type: ignore[call-overload]


def check_seed(seed: object) -> int:
    """``seed`` as a whole number of at least 0.

    Raises:
        ValueError: otherwise.
    """
    return check_count("seed", seed, 0, 2**63 - 1)


def check_number(name: str, value: object, least: float = -np.inf, most: float = np.inf) -> float:
    """``value`` as a finite number from ``least`` to ``most``.

    Raises:
        ValueError: otherwise, naming the argument.
    """
    number = _number(value)
    if not (np.isfinite(number) and least <= number <= most):
        limits = [f"at least {least:g}"] * (least > -np.inf) + [f"at most {most:g}"] * (most < np.inf)
        raise ValueError(
            f"{name}: got {value!r}, expected a finite number{' of ' * any(limits)}{', '.join(limits)}"
        )
    return number


def check_positive(name: str, value: object, what: str = "number") -> float:
    """``value`` as a finite number above zero; ``what`` says of what kind it is.

    Raises:
        ValueError: otherwise, naming the argument.
    """
    number = _number(value)
    if not (np.isfinite(number) and number > 0):
        raise ValueError(f"{name}: got {value!r}, expected a positive {what}")
    return number


def check_type(name: str, value: object, kind: type, hint: str = "") -> None:
    """Raise TypeError, naming the argument, unless ``value`` is a ``kind``; ``hint`` says how to get one."""
    if not isinstance(value, kind):
        raise TypeError(f"{name}: got {type(value).__name__}, expected a {kind.__name__}{hint}")


def _number(value: object) -> float:
    """A real number as a float, NaN for what is none."""
    try:
        array = np.asarray(value)
        return float(value) if array.ndim == 0 and array.dtype.kind in "iufO" else np.nan  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return np.nan


LARGEST_M = 1e8
"""No coordinate is larger [m]: beyond, single precision overflows in products of lengths."""
_KINDS = {"f": "real numbers", "i": "whole numbers", "u": "unsigned ones", "b": "truth values"}


@dataclass(frozen=True)
class Expected:
    """What an array must be: of a class and of its files, said in one place.

    Attributes:
        shape: its axes, numbers or names of sizes that arrays of one class share: ``"F 3"``; empty for one value.
        least, most: limits of its values; NaN is within none.
        index: name of the size that its values are indices to, from ``least`` on; -1 is none.
        kind: of its numbers, as in ``dtype.kind``: any of "f", "i", "u", "b".
        nan: whether NaN stands for what is unknown.
    """

    shape: str
    least: float = -np.inf
    most: float = 3.4e38  # all of single precision
    index: str = ""
    kind: str = "f"
    nan: bool = False


def check_arrays(
    arrays: Mapping[str, np.ndarray], expected: Mapping[str, Expected], **sizes: int
) -> dict[str, int]:
    """The sizes by name, once every array is as ``expected``; ``sizes`` are known beforehand.

    Raises:
        KeyError: if one is missing.
        TypeError, ValueError: naming the array, what came and what was expected.
    """
    for name, wanted in expected.items():
        array = np.asarray(arrays[name])
        if array.dtype.kind not in wanted.kind:
            kinds = " or ".join(_KINDS[k] for k in wanted.kind)
            raise TypeError(f"{name}: got an array of {array.dtype}, expected {kinds}")
        axes = wanted.shape.split()
        if len(axes) == array.ndim:
            sizes = dict(zip(axes, array.shape, strict=True)) | sizes
        shape = tuple(int(axis) if axis.isdigit() else sizes.get(axis) for axis in axes)
        if array.shape != shape:
            told = ", ".join(str(axis if n is None else n) for axis, n in zip(axes, shape, strict=True))
            raise ValueError(f"{name}: got shape {array.shape}, expected ({told})")
    for name, wanted in expected.items():
        array = np.asarray(arrays[name])
        most = sizes[wanted.index] - 1 if wanted.index else wanted.most
        within = (array >= wanted.least) & (array <= most)
        if not (within | np.isnan(array) if wanted.nan else within).all():
            bad = array[~within][0]
            raise ValueError(f"{name}: got {bad}, expected values from {wanted.least:g} to {most:g}")
    return sizes


def index_to(size: str, shape: str, least: int = 0) -> Expected:
    """Whole numbers that are indices to what there are ``size`` of."""
    return Expected(shape, least, index=size, kind="iu")


def lengths(shape: str, least: float = -LARGEST_M) -> Expected:
    """Coordinates or lengths [m]."""
    return Expected(shape, least, LARGEST_M)
