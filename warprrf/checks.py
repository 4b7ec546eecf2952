"""Argument checks that name the argument, what came and what was expected."""

from __future__ import annotations

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
        finite: refuse NaN and infinities.

    Raises:
        TypeError: if it cannot be read as numbers.
        ValueError: naming the argument, what came and what was expected.
    """
    if isinstance(value, wp.array):
        value = value.numpy()
    elif hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    try:
        array = np.ascontiguousarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name}: got {type(value).__name__} that does not read as an array of {np.dtype(dtype)}"
        ) from error
    if np.ndim(value) == 0:
        array = array.reshape(())
    if shape is not None and (
        array.ndim != len(shape)
        or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True))
    ):
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise ValueError(f"{name}: got shape {array.shape}, expected ({wanted})")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise ValueError(f"{name}: got {bad} values that are NaN or infinite, expected finite numbers")
    return array


def check_count(name: str, value: object, least: int = 1) -> int:
    """``value`` as a whole number of at least ``least``.

    Raises:
        ValueError: otherwise, naming the argument.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}: got {value!r}, expected a whole number of at least {least}")
    return int(value)


def check_positive(name: str, value: float | None, what: str = "number") -> float:
    """``value`` as a finite number above zero; ``what`` says of what kind it is.

    Raises:
        ValueError: otherwise, naming the argument.
    """
    if value is None or not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name}: got {value!r}, expected a positive {what}")
    return float(value)
