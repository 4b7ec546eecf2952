"""Argument checks that name the argument, what came and what was expected."""

from __future__ import annotations

import functools
import inspect
import numbers
import types
import typing
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Any, TypeVar

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


Public = TypeVar("Public", bound=Callable[..., Any])


def checked(public: Public) -> Public:
    """A function, or a class with its public methods, whose arguments must be what their annotations say.

    Numbers may be NumPy's, arrays Warp's, torch's or nested lists; what stands in a sequence or a mapping is not looked
    at. Values are checked by the function itself.

    Raises:
        TypeError: when called, naming the argument.
    """
    if isinstance(public, type):
        for name, member in list(vars(public).items()):
            inner = member.__func__ if isinstance(member, classmethod) else member
            if inspect.isfunction(inner) and (name == "__init__" or not name.startswith("_")):
                by_field = name == "__init__" and is_dataclass(
                    public
                )  # inherited ones have names of other modules
                wrapped = _checked_call(inner, public if by_field else inner)
                setattr(public, name, classmethod(wrapped) if isinstance(member, classmethod) else wrapped)
        return public
    return _checked_call(public, public)  # type: ignore[return-value]


def _checked_call(function: Callable[..., Any], annotated: Any) -> Callable[..., Any]:
    signature = inspect.signature(function)

    @functools.cache
    def kinds() -> dict[str, Any]:
        """By argument, when first asked for: annotations name what modules import last."""
        found = typing.get_type_hints(annotated)
        for one in signature.parameters.values():
            if one.kind is one.VAR_KEYWORD:
                options = found.pop(one.name, Any)
                if typing.get_origin(options) is typing.Unpack:
                    found |= typing.get_type_hints(typing.get_args(options)[0])
        return found

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        wanted, names = kinds(), signature.parameters
        for name, value in (*zip(names, args, strict=False), *kwargs.items()):
            kind = wanted.get(name, Any)
            if not _is(value, kind) and value is not (names[name].default if name in names else None):
                what = inspect.formatannotation(kind).replace("typing.", "").replace("collections.abc.", "")
                raise TypeError(f"{name}: got {_shown(value)}, expected {what}")
        return function(*args, **kwargs)

    return call


def _shown(value: object) -> str:
    """A value by its type, and as it is written where that is short."""
    written = f" {value!r}" if isinstance(value, (str, bytes, numbers.Number)) else ""
    return type(value).__name__ + (written if len(written) < 60 else "")


def _is(value: object, kind: Any) -> bool:
    """Whether a value may stand where an annotation says ``kind``."""
    origin, inside = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return any(_is(value, one) for one in inside if one is not bytes)  # which NumPy reads as text
    if kind in (bool, int, float, complex):
        return _is_number(value, kind)
    if getattr(origin, "__module__", "").startswith("numpy"):
        return _is_array(value)
    if origin is tuple:
        free = Ellipsis in inside
        return isinstance(value, (tuple, list, np.ndarray)) and (
            free or np.shape(value)[:1] == (len(inside),)
        )
    if origin is Callable:
        return callable(value)
    if origin is Any or not isinstance(origin, type) or getattr(origin, "_is_protocol", False):
        return True
    if isinstance(value, str) and origin is not object:
        return origin is str and "\0" not in value
    return isinstance(value, origin) and not (isinstance(value, bytes) and origin is not bytes)


def _is_number(value: object, kind: type) -> bool:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if kind is bool or isinstance(value, (bool, np.bool_)):
        return kind is bool and (isinstance(value, np.bool_) or value in (0, 1))
    wanted = {int: numbers.Integral, float: numbers.Real, complex: numbers.Complex}[kind]
    return isinstance(value, wanted) and not (isinstance(value, int) and abs(value) >= 2**63)


def _is_array(value: object) -> bool:
    if isinstance(value, wp.array) or hasattr(value, "detach"):
        return True
    try:
        array = np.asarray(value)
        array = array.astype(complex) if array.dtype.kind == "O" else array
    except (TypeError, ValueError, OverflowError):
        return False
    return array.dtype.kind in "biufcU"
