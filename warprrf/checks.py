"""Argument checks that name the argument, what came and what was expected."""

from __future__ import annotations

import functools
import inspect
import numbers
import types
import typing
from collections.abc import Callable
from dataclasses import is_dataclass
from types import EllipsisType
from typing import Any, TypeVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, DTypeLike


def check_array(
    name: str,
    value: ArrayLike | wp.array,
    shape: tuple[int | EllipsisType | None, ...] | None = None,
    dtype: DTypeLike = np.float64,
    finite: bool = True,
) -> np.ndarray:
    """``value`` (NumPy, Warp, torch or nested lists) as a contiguous NumPy array of ``shape`` and ``dtype``.

    Args:
        shape: expected shape, ``None`` for a free length, ``...`` at its beginning for any number of these; ``None``
            altogether skips the check.
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
    sizes = shape or ()
    if sizes and sizes[0] is Ellipsis:
        sizes = (*(None,) * (array.ndim + 1 - len(sizes)), *sizes[1:])
    if shape is not None and (
        array.ndim != len(sizes)
        or any(s is not None and s != n for s, n in zip(sizes, array.shape, strict=True))
    ):
        wished = ", ".join("any" if s is None else "..." if s is Ellipsis else str(s) for s in shape)
        raise ValueError(f"{name}: got shape {array.shape}, expected ({wished})")
    if wanted.kind in "iu" and given.dtype != wanted and not np.array_equal(array, given):
        raise TypeError(f"{name}: got numbers that are not whole or too large, expected {wanted}")
    if finite and wanted.kind in "fc" and not np.isfinite(array).all():
        bad = int(np.count_nonzero(~np.isfinite(array)))
        raise ValueError(f"{name}: got {bad} values that are NaN or infinite, expected finite numbers")
    return array


def check_alike(**arrays: ArrayLike) -> None:
    """Raise ValueError, naming the arguments, unless their shapes can be broadcast to one."""
    shapes = [np.shape(array) for array in arrays.values()]
    try:
        np.broadcast_shapes(*shapes)
    except ValueError as error:
        raise ValueError(
            f"{', '.join(arrays)}: got shapes {', '.join(map(str, shapes))}, expected ones that go together"
        ) from error


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


Public = TypeVar("Public", bound=Callable[..., Any])


def checked(public: Public) -> Public:
    """A function, or a class with its public methods, whose arguments come as their annotations say.

    Numbers of other kinds become Python's, arrays of other kinds (Warp's, torch's, lists, Python objects) NumPy's, unless
    an annotation names them. What a sequence or a mapping holds is not looked at, and values are checked by the function itself.

    Raises:
        TypeError: when called with something else, naming the argument.
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
    parameters = inspect.signature(function).parameters
    names = list(parameters)

    @functools.cache
    def kinds() -> dict[str, Any]:
        """By argument, when first asked for: annotations name what modules import last."""
        found = typing.get_type_hints(annotated)
        for one in parameters.values():
            if one.kind is one.VAR_KEYWORD:
                options = found.pop(one.name, Any)
                if typing.get_origin(options) is typing.Unpack:
                    found |= typing.get_type_hints(typing.get_args(options)[0])
        return found

    def taken(name: str, value: object) -> object:
        kind = kinds().get(name, Any)
        if name in parameters and value is parameters[name].default:
            return value
        found = _as(value, kind)
        if found is _OTHER:
            what = inspect.formatannotation(kind).replace("typing.", "").replace("collections.abc.", "")
            raise TypeError(f"{name}: got {_shown(value)}, expected {what}")
        return found

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        given = [taken(name, value) for name, value in zip(names, args, strict=False)]
        return function(
            *given, *args[len(given) :], **{name: taken(name, value) for name, value in kwargs.items()}
        )

    return call


_OTHER = object()  # what does not fit its annotation


def _shown(value: object) -> str:
    """A value by its type, and as it is written where that is short."""
    written = f" {value!r}" if isinstance(value, (str, bytes, numbers.Number)) else ""
    return type(value).__name__ + (written if len(written) < 60 else "")


def _as(value: object, kind: Any) -> object:
    """A value as the annotation ``kind`` says, or :data:`_OTHER`."""
    origin, inside = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if bytes in inside:  # those of ArrayLike
            inside = tuple(one for one in inside if one not in (bytes, str, complex))
        inside = tuple(sorted(inside, key=_is_of_numpy))  # what need not be turned into an array comes first
        return next((found for one in inside if (found := _as(value, one)) is not _OTHER), _OTHER)
    if kind in (bool, int, float, complex):
        return _as_number(value, kind)
    if _is_of_numpy(kind):  # an array, or one of what ArrayLike stands for
        found = _as_array(value, "U" if "str_" in repr(inside) else "biufc")
        plain = origin is np.ndarray and isinstance(found, (bool, int, float, complex))
        return np.asarray(found) if plain else found
    if origin is tuple:
        row = isinstance(value, (tuple, list)) or (isinstance(value, np.ndarray) and value.ndim)
        return value if row and (Ellipsis in inside or len(value) == len(inside)) else _OTHER  # type: ignore[arg-type]
    if origin is Callable:
        return value if callable(value) else _OTHER
    if origin is Any or not isinstance(origin, type) or getattr(origin, "_is_protocol", False):
        return value
    if isinstance(value, str):
        return value if origin is object or (origin is str and "\0" not in value) else _OTHER
    # One's own class may stand for one of ours, as long as it is an object with attributes.
    own = origin.__module__.startswith("warprrf.") and hasattr(value, "__dict__") and not callable(value)
    fits = isinstance(value, origin) or (own and not isinstance(value, wp.array))
    return value if fits and not isinstance(value, bytes) else _OTHER


def _is_of_numpy(kind: Any) -> bool:
    return str(getattr(typing.get_origin(kind) or kind, "__module__", "")).startswith("numpy")


def _as_number(value: object, kind: type) -> object:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, (bool, np.bool_)):
        return bool(value) if kind is bool else _OTHER
    if kind is bool:
        return bool(value) if isinstance(value, (int, np.integer)) and value in (0, 1) else _OTHER
    wanted = {int: numbers.Integral, float: numbers.Real, complex: numbers.Complex}[kind]
    if not isinstance(value, wanted):
        return _OTHER
    number = int(value) if isinstance(value, numbers.Integral) else kind(value)
    return number if not isinstance(number, int) or abs(number) < 2**63 else _OTHER


def _as_array(value: Any, letters: str) -> object:
    if isinstance(value, wp.array):
        value = value.numpy()
    try:
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
        if array.dtype.kind == "O":
            if not all(isinstance(one, numbers.Number) for one in array.flat):
                return _OTHER
            array = array.astype(complex)
            array = array if array.imag.any() else array.real
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return _OTHER
    if array.dtype.kind not in letters:
        return _OTHER
    if isinstance(value, (numbers.Number, np.generic)):
        return array[()].item()
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))
