"""Argument checks that name the argument, what came and what was expected: in a TypeError for another kind, else a ValueError."""

from __future__ import annotations

import functools
import inspect
import numbers
import types
import typing
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from types import EllipsisType
from typing import Annotated, Any, TypeAlias, TypeVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, DTypeLike

T = TypeVar("T")

LARGEST = 1e100
"""Beyond it a number counts as infinite, its inverse as zero: products of a few would leave double precision."""


def check_array(
    name: str,
    value: ArrayLike | wp.array,
    shape: tuple[int | EllipsisType | None, ...] | None = None,
    dtype: DTypeLike = np.float64,
    finite: bool = True,
    least: float | None = None,
) -> np.ndarray:
    """``value`` (NumPy, Warp, torch or nested lists) as a contiguous NumPy array of ``shape`` and ``dtype``.

    Args:
        shape: expected shape, ``None`` for a free length, ``...`` at its beginning for any number of these; ``None``
            altogether skips the check.
        dtype: of whole numbers: what is not whole, or too large for it, is refused.
        finite: refuse NaN and infinities.
        least: refuse smaller numbers, and infinities; not NaN.

    Raises:
        TypeError: if it cannot be read as numbers of that kind.
        ValueError: naming the argument, what came and what was expected.
    """
    _check_unmasked(name, value)
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
    most = min(LARGEST, float(np.finfo(wanted).max)) if wanted.kind in "fc" else np.inf
    usual = wanted.kind == "f" and array.size > 0 and -most <= array.min() and array.max() <= most
    if wanted.kind in "fc" and not usual:
        size = np.abs(array)
        bad = ~(size <= most) if finite else (size > most) & (size < np.inf)
        if bad.any():
            number, kinds = int(np.count_nonzero(bad)), "NaN, infinite or " if finite else ""
            raise ValueError(f"{name}: got {number} values that are {kinds}above {most:g}, expected finite")
    if least is not None and (bad := (array < least) | (array == np.inf)).any():
        linear = " (powers and gains are linear: of decibels, 10 ** (x / 10))" if least == 0 else ""
        raise ValueError(f"{name}: got {array[bad][0]:g}, expected numbers of at least {least:g}{linear}")
    return array


def _check_unmasked(name: str, value: object) -> None:
    """Raise ValueError for a masked array, as of netCDF4, with masked values: NumPy hands out what lies under the mask."""
    hidden = int(np.ma.count_masked(value)) if isinstance(value, np.ma.MaskedArray) else 0
    if hidden:
        raise ValueError(
            f"{name}: got a masked array with {hidden} masked values, expected plain numbers; .filled(np.nan) makes "
            "them NaN where that may stand for what is unknown"
        )


def check_each(name: str, value: ArrayLike, count: int, *shape: int) -> np.ndarray:
    """``value``, one of ``shape`` for all or one for each of ``count``, as a new array ``(count, *shape)``."""
    found = check_array(name, value)
    if found.shape not in (shape, (count, *shape)):
        raise ValueError(f"{name}: got shape {found.shape}, expected {shape} or {(count, *shape)}")
    return np.broadcast_to(found, (count, *shape)).copy()


def check_alike(**arrays: ArrayLike) -> None:
    """Raise ValueError, naming the arguments, unless their shapes can be broadcast to one."""
    shapes = [np.shape(array) for array in arrays.values()]
    if len({shape for shape in shapes if shape}) < 2:
        return
    try:
        np.broadcast_shapes(*shapes)
    except ValueError as error:
        raise ValueError(
            f"{', '.join(arrays)}: got shapes {', '.join(map(str, shapes))}, expected ones that go together"
        ) from error


def check_count(name: str, value: object, least: int = 1, most: int = 2**31 - 1) -> int:
    """``value`` as a whole number from ``least`` to ``most``."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not least <= value <= most:  # type: ignore[operator]
        limit = f"{least} to {most}" if most < 2**31 - 1 else f"at least {least}"
        raise ValueError(f"{name}: got {value!r}, expected a whole number of {limit}")
    return int(value)  # type: ignore[call-overload]


def check_choice(name: str, value: T, allowed: Iterable[object]) -> T:
    """``value``, if it is one of those ``allowed``."""
    known = tuple(allowed)
    if value not in known:
        raise ValueError(f"{name}: got {value!r}, expected one of {', '.join(map(str, known))}")
    return value


def check_chosen(name: str, value: ArrayLike, count: int, least: int = 0) -> np.ndarray:
    """Indices, ``least`` or more, of ``count`` rows that ``value`` names by whole numbers or a mask."""
    chosen = np.asarray(value)
    if chosen.dtype == bool and chosen.shape == (count,):
        chosen = np.flatnonzero(chosen)
    whole = chosen.dtype.kind in "iu" or chosen.size == 0
    if chosen.ndim != 1 or not whole or len(chosen) < least or (np.abs(chosen + 0.5) > count).any():
        raise ValueError(
            f"{name}: got {value!r}, expected indices from 0 to {count - 1} or a mask ({count},)"
        )
    return chosen.astype(np.int64)


def check_seed(seed: object) -> int:
    """``seed`` as a whole number from 0 to 2^63 - 1."""
    return check_count("seed", seed, 0, 2**63 - 1)


def check_number(name: str, value: object, least: float = -np.inf, most: float = np.inf) -> float:
    """``value`` as a finite number from ``least`` to ``most``."""
    number = _number(value)
    if not (abs(number) <= LARGEST and least <= number <= most):
        limits = [f"at least {least:g}"] * (least > -np.inf) + [f"at most {most:g}"] * (most < np.inf)
        raise ValueError(
            f"{name}: got {value!r}, expected a finite number{' of ' * any(limits)}{', '.join(limits)}"
        )
    return number


def check_positive(name: str, value: object, what: str = "number") -> float:
    """``value`` as a finite number above zero; ``what`` says of what kind it is."""
    number = _number(value)
    if not 1 / LARGEST <= number <= LARGEST:
        raise ValueError(f"{name}: got {value!r}, expected a positive {what}")
    return number


def check_type(name: str, value: object, kind: type, hint: str = "") -> None:
    """Raise TypeError, naming the argument, unless ``value`` is a ``kind``; ``hint`` says how to get one."""
    if not isinstance(value, kind):
        raise TypeError(f"{name}: got {type(value).__name__}, expected a {kind.__name__}{hint}")


def check_items(name: str, values: Iterable[T], kind: type, least: int = 0) -> list[T]:
    """``values`` as a list of at least ``least``, each of them a ``kind``."""
    found = list(values)
    if len(found) < least:
        raise ValueError(f"{name}: got {len(found) or 'none'}, expected at least {least}")
    for k, value in enumerate(found):
        check_type(f"{name}[{k}]", value, kind)
    return found


def _number(value: object) -> float:
    """A real number as a float, NaN for what is none; a decimal one is none: it does not go together with floats."""
    try:
        array = np.asarray(value)
        real = array.dtype.kind in "iuf" or isinstance(value, numbers.Real)
        return float(value) if array.ndim == 0 and real else np.nan  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return np.nan


def check_similarity(scale: object, rotation: object, shift: object) -> tuple[float, np.ndarray, np.ndarray]:
    """What moves points ``x`` to ``scale rotation x + shift``.

    Args:
        scale: from 1e-6 to 1e6.
        rotation: shape ``(3, 3)``; None for none.
        shift: shape ``(3,)``, each up to 20,000 km [m].
    """
    turn = np.eye(3) if rotation is None else check_array("rotation", rotation, (3, 3))
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0:
        raise ValueError(f"rotation: got {turn.tolist()}, expected a rotation: orthonormal, not mirrored")
    moved = check_array("shift", shift, (3,))
    if np.abs(moved).max() > 0.2 * LARGEST_M:
        raise ValueError(f"shift: got {moved.tolist()}, expected at most {0.2 * LARGEST_M:g} m")
    return check_number("scale", scale, 1e-6, 1e6), turn, moved


def users_level() -> int:
    """Frames from the caller to the first one outside this package: ``stacklevel`` of a warning there."""
    frame, level = inspect.currentframe(), 0
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == "warprrf":
        frame, level = frame.f_back, level + 1
    return level


def warn(text: str) -> None:
    """Warn of ``text``, a UserWarning, at the line outside this package that called it."""
    warnings.warn(text, UserWarning, stacklevel=users_level())


def some_of(items: Sequence[object] | np.ndarray, most: int = 8) -> str:
    """Names, or rows of a table, for a message: the first ones and how many more."""
    return ", ".join(map(str, items[:most])) + f" and {len(items) - most} more" * (len(items) > most)


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
    """The sizes by name, once every array is as ``expected``; ``sizes`` are known beforehand."""
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
            text = ", ".join(str(axis if n is None else n) for axis, n in zip(axes, shape, strict=True))
            raise ValueError(f"{name}: got shape {array.shape}, expected ({text})")
    for name, wanted in expected.items():
        array = np.asarray(arrays[name])
        most = sizes[wanted.index] - 1 if wanted.index else wanted.most
        within = (array >= wanted.least) & (array <= most)
        if not (within | np.isnan(array) if wanted.nan else within).all():
            bad = array[~within][0]
            raise ValueError(f"{name}: got {bad}, expected values from {wanted.least:g} to {most:g}")
    return sizes


def check_known_whole(name: str, array: np.ndarray, axes: int = 1) -> None:
    """Raise ValueError, naming the array, unless NaN is in all or none of the numbers along each row of its last ``axes``.

    A point, a direction, a matrix is known whole or not at all.
    """
    unknown, last = np.isnan(array), tuple(range(-axes, 0))
    some = int((unknown.any(last) != unknown.all(last)).sum())
    if some:
        raise ValueError(f"{name}: got {some} that are NaN in part, expected each known whole or not at all")


def index_to(size: str, shape: str, least: int = 0) -> Expected:
    """Whole numbers that are indices to what there are ``size`` of."""
    return Expected(shape, least, index=size, kind="iu")


def lengths(shape: str, least: float = -LARGEST_M) -> Expected:
    """Coordinates or lengths [m]."""
    return Expected(shape, least, LARGEST_M)


@dataclass(frozen=True)
class Shaped:
    """What an array must be, in the annotation of an argument or a field: ``Annotated[np.ndarray, Shaped("R 3")]``.

    Attributes:
        shape: its axes, numbers or names of sizes that the arguments of one call share; ``...`` first for any number of them.
        dtype, finite, least: as for :func:`check_array`.
    """

    shape: str
    dtype: type[np.generic] = np.float64
    finite: bool = True
    least: float | None = None

    def __call__(self, name: str, value: ArrayLike, sizes: dict[str, int]) -> np.ndarray:
        """``value`` as such an array; its sizes go into ``sizes``, where those of arguments before it stand."""
        axes = self.shape.split()
        wanted = tuple(
            ... if axis == "..." else int(axis) if axis.isdigit() else sizes.get(axis) for axis in axes
        )
        array = check_array(name, value, wanted, self.dtype, self.finite, self.least)
        sizes.update(zip(reversed(axes), reversed(array.shape), strict=False))
        return array


def within(least: float = -np.inf, most: float = np.inf) -> Callable[[str, object], float]:
    """In an annotation: a finite number from ``least`` to ``most``; see :func:`checked`."""
    return functools.partial(check_number, least=least, most=most)


def whole(least: int = 1, most: int = 2**31 - 1) -> Callable[[str, object], int]:
    """In an annotation: a whole number from ``least`` to ``most``."""
    return functools.partial(check_count, least=least, most=most)


def positive(what: str = "number") -> Callable[[str, object], float]:
    """In an annotation: a finite number above zero; ``what`` says of what kind it is."""
    return functools.partial(check_positive, what=what)


def one_of(*allowed: object) -> Callable[[str, Any], Any]:
    """In an annotation: one of those ``allowed``."""
    return functools.partial(check_choice, allowed=allowed)


Count: TypeAlias = Annotated[int, whole()]
Number: TypeAlias = Annotated[float, within()]
Seed: TypeAlias = Annotated[int, whole(0, 2**63 - 1)]
Positive: TypeAlias = Annotated[float, positive()]
NotNegative: TypeAlias = Annotated[float, within(0.0)]

Public = TypeVar("Public", bound=Callable[..., Any])


def checked(public: Public) -> Public:
    """A function, or a class with its public methods, whose arguments come as their annotations say.

    Numbers of other kinds become Python's, arrays of other kinds (Warp's, torch's, lists, Python objects) NumPy's. What
    is ``Annotated`` is what stands behind its type too: functions of name and value that return what is to be taken
    (:func:`within`, :func:`whole`, :func:`one_of`, ...), or :class:`Shaped`. What a sequence or a mapping holds is not looked
    at, and other values are checked by the function itself. Defaults are taken as they are.

    Raises:
        TypeError: when called with something else, naming the argument.
        ValueError: for a value that its annotation does not allow, likewise.
    """
    if not isinstance(public, type):
        return _checked_call(public, public)  # type: ignore[return-value]
    for name, member in list(vars(public).items()):
        inner = getattr(member, "__func__", member)  # of a class method
        if inspect.isfunction(inner) and (name == "__init__" or not name.startswith("_")):
            # A field's annotation names what the module of its own class imports.
            call = _checked_call(inner, public if name == "__init__" and is_dataclass(public) else inner)
            setattr(public, name, call if member is inner else type(member)(call))
    return public


def _checked_call(function: Callable[..., Any], annotated: Any) -> Callable[..., Any]:
    parameters = inspect.signature(function).parameters
    names = tuple(parameters)

    @functools.cache
    def kinds() -> dict[str, Any]:
        """By argument, when first called: annotations name what modules import last."""
        found = typing.get_type_hints(annotated, include_extras=True)
        for one in parameters.values():
            if one.kind is one.VAR_KEYWORD and typing.get_origin(found[one.name]) is typing.Unpack:
                found |= typing.get_type_hints(typing.get_args(found[one.name])[0], include_extras=True)
        return found

    @functools.cache
    def converters() -> dict[str, Callable[[Any], object]]:
        return {name: _converter(kind, name) for name, kind in kinds().items()}

    @functools.cache
    def shapes() -> dict[str, Shaped]:
        """Of arrays, in the order of the arguments, which share sizes."""
        found = {name: _shape_of(kinds().get(name)) for name in names}
        return {name: shape for name, shape in found.items() if shape is not None}

    def refused(name: str, value: object) -> object:
        if name in parameters and value is parameters[name].default:
            return value
        text = function.__annotations__.get(name, "another type")
        raise TypeError(f"{name}: got {_described(value)}, expected {_written(kinds()[name], text)}")

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        known = converters()
        given = list(args)
        for k, name in enumerate(names[: len(args)]):
            if name in known and (found := known[name](args[k])) is not args[k]:
                given[k] = refused(name, args[k]) if found is _OTHER else found
        for name, value in kwargs.items():
            if name in known and (found := known[name](value)) is not value:
                kwargs[name] = refused(name, value) if found is _OTHER else found
        sizes: dict[str, int] = {}
        for name, shape in shapes().items():
            at = names.index(name)
            if at < len(given) and given[at] is not None:
                given[at] = shape(name, given[at], sizes)
            elif kwargs.get(name) is not None:
                kwargs[name] = shape(name, kwargs[name], sizes)
        return function(*given, **kwargs)

    return call


def _shape_of(kind: Any) -> Shaped | None:
    """What an annotation, or one of those that it may be, says of an array."""
    if typing.get_origin(kind) is Annotated:
        return next((one for one in typing.get_args(kind) if isinstance(one, Shaped)), None)
    return next(filter(None, map(_shape_of, typing.get_args(kind))), None)


def _written(kind: Any, text: str) -> str:
    """An annotation as it is written, ``text``; of one with checks the types alone."""
    inside = typing.get_args(kind)
    if typing.get_origin(kind) is Annotated:
        return _written(inside[0], inspect.formatannotation(inside[0]).replace("numpy.", "np."))
    if any(typing.get_origin(one) is Annotated for one in inside):
        return " | ".join(_written(one, inspect.formatannotation(one)) for one in inside)
    return "None" if kind is types.NoneType else text


_OTHER = object()  # what does not fit its annotation


def _described(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}"
    written = f" {value!r}" if isinstance(value, (str, bytes, numbers.Number)) else ""
    return type(value).__name__ + (written if len(written) < 60 else "")


@functools.cache
def _converter(kind: Any, name: str) -> Callable[[Any], object]:
    """What turns a value into one of the annotation ``kind`` of the argument ``name``, or into :data:`_OTHER`."""
    origin, inside = typing.get_origin(kind) or kind, typing.get_args(kind)
    if origin is Annotated:
        checks = tuple(one for one in inside[1:] if not isinstance(one, Shaped))
        convert = _converter(inside[0], name)

        def as_allowed(value: object) -> object:
            found = convert(value)
            for check in checks:
                found = found if found is _OTHER else check(name, found)
            return found

        return as_allowed
    if origin in (typing.Union, types.UnionType):
        if bytes in inside:  # ArrayLike, whose numbers are arrays too
            inside = tuple(one for one in inside if one not in _NUMBERS and one not in (bool, str, bytes))
        # What need not become an array comes before what must, None, which is rarely given, last.
        order = sorted(inside, key=lambda one: (one is types.NoneType, _is_of_numpy(one)))
        every = [_converter(one, name) for one in order]
        return lambda value: next((found for one in every if (found := one(value)) is not _OTHER), _OTHER)
    if kind is bool:
        return _as_bool
    if kind in _NUMBERS:
        return functools.partial(_as_number, kind)
    if _is_of_numpy(kind):
        return functools.partial(
            _as_array, name, "U" if "str_" in repr(inside) else "biufc", origin is np.ndarray
        )
    if origin is tuple:
        length = None if Ellipsis in inside else len(inside)
        return functools.partial(_as_row, length)
    if origin is Callable:
        return lambda value: value if callable(value) else _OTHER
    if origin is Any or not isinstance(origin, type):
        return lambda value: value
    if getattr(origin, "_is_protocol", False):
        known = getattr(origin, "_is_runtime_protocol", False)
        return lambda value: value if not known or isinstance(value, origin) else _OTHER
    return functools.partial(_as_object, origin)


def _is_of_numpy(kind: Any) -> bool:
    return str(getattr(typing.get_origin(kind) or kind, "__module__", "")).startswith("numpy")


def _as_row(length: int | None, value: Any) -> object:
    row = np.ndim(value) > 0 if isinstance(value, np.ndarray) else isinstance(value, (tuple, list))
    if not row or length not in (None, len(value)):
        return _OTHER
    if isinstance(value, np.ndarray):
        return tuple(value.tolist() if value.ndim == 1 else value)
    return value


def _as_bool(value: object) -> object:
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    whole = isinstance(value, (int, np.integer)) and value in (0, 1)
    return bool(value) if whole or isinstance(value, np.bool_) else _OTHER


_NUMBERS: dict[type, type] = {int: numbers.Integral, float: numbers.Real, complex: numbers.Complex}


def _as_number(kind: type, value: object) -> object:
    if type(value) is kind and (kind is not int or abs(value) < 2**63):  # type: ignore[arg-type]
        return value  # in a hurry
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, _NUMBERS[kind]):
        return _OTHER
    number = int(value) if isinstance(value, numbers.Integral) else kind(value)
    return number if not isinstance(number, int) or abs(number) < 2**63 else _OTHER


def _as_array(name: str, letters: str, of_axes: bool, value: Any) -> object:
    """An array of one of the kinds ``letters``, a Python number where that is enough, or :data:`_OTHER`."""
    if type(value) is np.ndarray and value.dtype.kind in letters and value.dtype.isnative:
        return value  # in a hurry
    _check_unmasked(name, value)
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
    if isinstance(value, (numbers.Number, np.generic)) and not of_axes:
        return array[()].item()
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def _as_object(kind: type, value: object) -> object:
    if isinstance(value, str):
        return value if kind is object or (kind is str and "\0" not in value) else _OTHER
    # One's own class may stand for one of ours, as long as it is an object with attributes; another of ours may not.
    own = kind.__module__.startswith("warprrf.") and hasattr(value, "__dict__") and not callable(value)
    own = own and not type(value).__module__.startswith("warprrf.")
    fits = isinstance(value, kind) or (own and not isinstance(value, wp.array))
    return value if fits and not isinstance(value, bytes) else _OTHER


def one_line(self: Any) -> str:
    """The ``__repr__`` of a dataclass of arrays: shapes of all but short ones, other values as they are, None left out."""
    parts = []
    for field in (one for one in fields(self) if not one.name.startswith("_")):
        value = getattr(self, field.name)
        if hasattr(value, "shape") and (np.size(value) > 3 or np.ndim(value) > 1 or len(repr(value)) > 40):
            parts.append(f"{field.name} {tuple(value.shape)}")
        elif value is not None and len(text := repr(value)) <= 60:
            parts.append(f"{field.name}={text}")
    return f"{type(self).__name__}({', '.join(parts)})"
