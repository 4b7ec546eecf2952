"""Arrays by name on disk: safetensors (no pickle), plain values as JSON in the header, replaced at once.

Files carry a SHA-256 of all that they hold, in their metadata: other tools open them as they are, and what a disk or a
transfer changed is found before anything is computed from it. Files without one, of other tools, are read too.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.files import UNREADABLE, write_bytes

FORMAT = "warprrf field 1"
"""Of radio fields."""
_CHECKSUM = "sha256"


def write(
    path: str | os.PathLike[str],
    tensors: Mapping[str, np.ndarray],
    header: Mapping[str, Any],
    kind: str | None = FORMAT,
) -> None:
    """Write ``tensors`` and ``header`` (plain values) to ``path``, as a file of a ``kind``."""
    from safetensors.numpy import save

    whole = {name: np.asarray(value, order="C") for name, value in tensors.items()}
    about = {"header": json.dumps(dict(header))} | ({} if kind is None else {"format": kind})
    about[_CHECKSUM] = _checksum(whole, about)
    write_bytes(path, save(whole, metadata=about))


def read(
    path: str | os.PathLike[str], kind: str | None = FORMAT
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and header of a file that :func:`write` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no safetensors file, cut short, not what was written, or of another kind.
    """
    from safetensors import SafetensorError, safe_open

    name = os.fspath(path)
    if not Path(path).is_file():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), name)
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}
    except (
        SafetensorError,
        OSError,
        AttributeError,
        TypeError,
    ) as error:  # the latter two: types NumPy lacks
        raise ValueError(f"{name}: corrupt or no safetensors file: {error}") from error
    if kind is not None and metadata.get("format") != kind:
        raise ValueError(f"{name}: got format {metadata.get('format')!r}, expected {kind!r}")
    checksum = metadata.pop(_CHECKSUM, None)
    if checksum not in (None, _checksum(tensors, metadata)):
        raise ValueError(
            f"{name}: corrupt: its checksum is not that of what it holds; take another copy, or make it again"
        )
    with named(path, "corrupt header"):
        # NaN is what nobody knows, as in strict JSON; an infinite thickness is one.
        header = json.loads(
            metadata["header"], parse_constant=lambda word: None if word == "NaN" else float(word)
        )
        if not isinstance(header, dict):
            raise TypeError(f"got {type(header).__name__}, expected names and values")
    return tensors, header


@contextmanager
def named(path: str | os.PathLike[str], what: str) -> Iterator[None]:
    """Whatever does not fit in here is a ValueError that names the file at ``path`` and says ``what`` is wrong."""
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{os.fspath(path)}: {what}: it lacks {error}") from error
    except UNREADABLE as error:
        raise ValueError(f"{os.fspath(path)}: {what}: {error}") from error


def _checksum(tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> str:
    """SHA-256 [hex] of names, types, shapes and bytes, whatever their order."""
    total = hashlib.sha256()
    for key, text in sorted(metadata.items()):
        total.update(f"\0{key}\0{text}".encode())
    for name, tensor in sorted(tensors.items()):
        total.update(f"\0{name}\0{tensor.dtype.str}{tensor.shape}".encode())
        total.update(tensor.tobytes())
    return total.hexdigest()
