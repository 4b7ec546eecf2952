"""Files that are whole or not there: written under a temporary name in their folder, then put in place in one step."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np


def write_atomically(path: str | os.PathLike[str], write: Callable[[Path], Any]) -> None:
    """Call ``write`` with a temporary name of the same suffix and folder, then put that file in the place of ``path``.

    A kill or an error leaves the old file or the new one, never half of one. The folder is made if it is missing.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.stem}.{os.getpid()}.partial{target.suffix}")
    try:
        write(partial)
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write ``text`` as UTF-8."""
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write ``arrays`` in NumPy's compressed format, whatever the file's suffix."""

    def write(file: Path) -> None:
        with file.open("wb") as out:
            np.savez_compressed(out, **arrays)  # type: ignore[arg-type]

    write_atomically(path, write)


def write_json(path: str | os.PathLike[str], value: object) -> None:
    """Write `value` as strict JSON: arrays become lists, NaN and infinities null."""
    write_text(path, json.dumps(plain(value), indent=1, allow_nan=False) + "\n")


def read_json(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a JSON file.

    Raises:
        OSError: naming ``path``, if it cannot be read.
        ValueError: if it does not read as a mapping.
    """
    name = os.fspath(path)
    try:
        held = json.loads(Path(path).read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{name}: damaged, or no JSON: {error}") from error
    if not isinstance(held, dict):
        raise ValueError(f"{name}: got JSON of type {type(held).__name__}, expected a mapping {{...}}")
    return held


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
    raise TypeError(
        f"value: got {type(value).__name__}, expected numbers, text, arrays, lists or dictionaries"
    )
