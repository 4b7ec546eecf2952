"""Files that are whole or not there: written under a temporary name in their folder, then put in place in one step.

What others' formats leave unchecked is sealed: a line with the SHA-256 of all before it ends the file. Readers of NetCDF
pass over it, to those of NPZ it is the comment of a zip file, and an editor of such a file drops it. JSON holds its own
under the name ``sha256``.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import secrets
import shutil
import socket
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

MOST_INFLATED = 1100
"""Bytes that come of one compressed one at most; deflate reaches 1032."""

_SEAL = b"\nwarprrf sha256 "
_SEAL_BYTES = len(_SEAL) + 64 + 1  # with the digest in hexadecimal and a line's end
_PARTIAL = re.compile(r"\..*\.([0-9a-f]{8})-(\d{1,7})-[0-9a-f]{8}\.partial(\.[^.]*)?")


def write_atomically(
    path: str | os.PathLike[str], write: Callable[[Path], Any], *, seal: bool = False
) -> None:
    """Call ``write`` with a temporary name of the same suffix and folder, then put that file in the place of ``path``.

    A kill or an error leaves the old file or the new one, never half of one. The folder is made if it is missing. Who
    writes last wins; a library that does not survive a full disk is given memory instead (:func:`write_bytes`).

    Args:
        seal: end the file with a checksum, for :func:`check_seal`.

    Raises:
        OSError: naming ``path``, if the system does not take it.
        ValueError: for a path without a name.
    """
    partial = partial_path(path)
    try:
        with naming(path, partial):
            write(partial)
            if seal:
                end_with_seal(partial)
            os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def file_at(path: str | os.PathLike[str], what: str = "file") -> Path:
    """``path``, at which there must be a file; the FileNotFoundError says of ``what`` kind."""
    if os.path.isdir(path):
        raise FileNotFoundError(f"path: {os.fspath(path)} is a folder, expected a {what}")
    if not os.path.isfile(path):
        raise FileNotFoundError(f"path: there is no {what} {os.fspath(path)}")
    return Path(path)


@contextmanager
def folder_in_place(folder: Path) -> Iterator[Path]:
    """A new folder to fill, which then takes the place of ``folder``: a kill or an error leaves the earlier one or the new one."""
    part = partial_path(folder)
    # no partial file: the only one, if this is killed just then
    earlier = part.with_name(f"{part.name}.earlier.kept")
    try:
        part.mkdir()
        yield part
        if folder.exists():
            folder.rename(earlier)  # a folder cannot be renamed over one that holds something
        part.rename(folder)
    finally:
        if earlier.exists() and not folder.exists():
            earlier.rename(folder)
        for rest in (part, earlier):
            shutil.rmtree(rest, ignore_errors=True)


@contextmanager
def naming(path: str | os.PathLike[str], partial: Path) -> Iterator[None]:
    """What the system refuses of ``partial`` is said of ``path``."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(partial)):
            error.filename = os.fspath(path)
            del error.filename2
        raise


def end_with_seal(path: Path) -> None:
    """Write the checksum of a file to its end, for :func:`check_seal`."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    with path.open("ab") as file:
        file.write(_SEAL + digest.encode() + b"\n")


def partial_path(path: str | os.PathLike[str]) -> Path:
    """An unused name for what becomes ``path``: in the same folder, which is made, and of the same suffix.

    What dead processes of this machine left half written in the folder is removed.
    """
    target = Path(path)
    if not target.name:
        raise ValueError(f"path: got {os.fspath(path)!r}, expected the name of a file")
    target.parent.mkdir(parents=True, exist_ok=True)
    with suppress(OSError):  # a folder that may not be listed, a file of another user: theirs to remove
        for name in os.listdir(target.parent):
            left = _PARTIAL.fullmatch(name)
            if left and left[1] == _machine() and not _alive(int(left[2])):
                rest = target.parent / name
                shutil.rmtree(rest) if rest.is_dir() else rest.unlink()
    own = f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"
    return target.with_name(f".{target.stem[:30]}.{own}.partial{target.suffix[:20]}")  # 255 bytes are a name


@cache
def _machine() -> str:
    """What process numbers are counted in: this machine, and the container on it."""
    space = "/proc/self/ns/pid"
    text = socket.gethostname() + (os.readlink(space) if os.path.islink(space) else "")
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def check_seal(path: str | os.PathLike[str]) -> bool:
    """Whether ``path`` is sealed; a file that something else wrote or edited is not.

    Raises:
        OSError: naming ``path``, if it cannot be read.
        ValueError: if the file is not what was sealed.
    """
    total = hashlib.sha256()
    with open(path, "rb") as file:
        rest = os.fstat(file.fileno()).st_size - _SEAL_BYTES
        while rest > 0 and (part := file.read(min(rest, 1 << 20))):
            total.update(part)
            rest -= len(part)
        end = file.read() if rest == 0 else b""
    if not end.startswith(_SEAL):
        return False
    if end != _SEAL + total.hexdigest().encode() + b"\n":
        raise ValueError(
            f"{os.fspath(path)}: the checksum at its end does not fit: the file was damaged; copy or make it again"
        )
    return True


def write_bytes(path: str | os.PathLike[str], data: bytes | memoryview, *, seal: bool = False) -> None:
    """Write ``data``; see :func:`write_atomically`."""
    write_atomically(path, lambda file: file.write_bytes(data), seal=seal)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write ``text`` as UTF-8."""
    write_bytes(path, text.encode())


def write_arrays(
    path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], *, compress: bool = True
) -> None:
    """Write ``arrays`` in NumPy's zipped format, whatever the file's suffix."""
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise TypeError(f"{name}: got an array of Python objects, expected numbers or text")
    data = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(data, **arrays)  # type: ignore[arg-type]
    data.seek(-2, io.SEEK_END)  # the length of the comment that ends a zip file
    data.write(struct.pack("<H", _SEAL_BYTES))
    write_bytes(path, data.getbuffer(), seal=True)


UNREADABLE = (
    zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, EOFError, ValueError, TypeError, KeyError,
    SyntaxError, RuntimeError, OverflowError, AttributeError,
)  # fmt: skip
"""What readers raise on damaged files, NumPy's among them."""


def read_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """All arrays of an NPZ file of anybody's, whose checksums hold; Python objects are not unpacked.

    Raises:
        OSError: naming ``path``, if it cannot be read.
        ValueError: if it is damaged or something else.
    """
    check_seal(path)
    content = io.BytesIO(Path(path).read_bytes())
    try:
        with zipfile.ZipFile(content) as archive:
            return {i.filename.removesuffix(".npy"): _member(archive, i) for i in archive.infolist()}
    except UNREADABLE as error:
        raise ValueError(f"{os.fspath(path)}: damaged, or no NPZ file: {error}") from error


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """An array of an NPZ file, read to its end: only there its checksum is compared."""
    if info.file_size > MOST_INFLATED * info.compress_size:
        raise ValueError(f"{info.filename} states {info.file_size} bytes in {info.compress_size}")
    content = io.BytesIO(archive.read(info))
    version = np.lib.format.read_magic(content)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    shape, _, dtype = read_header(content)
    held = len(content.getbuffer()) - content.tell()
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != held or min(shape, default=0) < 0:
        raise ValueError(f"{info.filename} states {dtype} of shape {shape} in {held} bytes")
    content.seek(0)
    return np.lib.format.read_array(content, allow_pickle=False)


def write_json(path: str | os.PathLike[str], value: object, *, seal: bool = False) -> None:
    """Write ``value`` as strict JSON: arrays become lists, NaN and infinities null.

    Args:
        seal: ``value`` is a mapping, and the file holds its checksum under ``sha256``, for :func:`read_json`.
    """
    held = plain(value)
    if seal:
        held = {**held, "sha256": _json_digest(held)}
    write_text(path, json.dumps(held, indent=1, allow_nan=False) + "\n")


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a strict JSON file, without the checksum that :func:`write_json` may have put there.

    Raises:
        OSError: naming ``path``, if it cannot be read.
        ValueError: if it does not read as a mapping, or its checksum does not fit.
    """
    text, name = Path(path).read_bytes(), os.fspath(path)
    try:
        held = json.loads(text, parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name}: damaged, or no JSON: {error}") from error
    if not isinstance(held, dict):
        raise ValueError(f"{name}: got JSON of type {type(held).__name__}, expected a mapping {{...}}")
    seal = held.pop("sha256", None)
    if seal is not None and seal != _json_digest(held):
        raise ValueError(
            f"{name}: its sha256 does not fit: the file was damaged, or edited; take that line out if it was edited"
        )
    return held


def _json_digest(held: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(held, allow_nan=False, sort_keys=True).encode()).hexdigest()


def _finite(word: str) -> float:
    number = float(word)
    if not math.isfinite(number):
        raise ValueError(f"got {word}, expected finite numbers")
    return number


def plain(value: Any) -> Any:
    """`value` in terms of what strict JSON holds; numbers keep their value, NaN and infinities become None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"value: got {type(value).__name__}, expected numbers, text, arrays, lists or mappings")
