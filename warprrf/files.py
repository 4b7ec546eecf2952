"""Files that are whole or not there: written under a temporary name in their folder, then put in place in one step."""

from __future__ import annotations

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
