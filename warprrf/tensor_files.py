"""Arrays by name on disk: safetensors (no pickle), plain values as JSON in the header, replaced at once."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.files import write_atomically

FORMAT = "warprrf field 1"
"""Of radio fields."""


def write(
    path: str | os.PathLike[str],
    tensors: Mapping[str, np.ndarray],
    header: Mapping[str, Any],
    kind: str | None = FORMAT,
) -> None:
    """Write ``tensors`` and ``header`` (plain values) to ``path``, as a file of a ``kind``."""
    from safetensors.numpy import save_file

    whole = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    about = {"header": json.dumps(dict(header))} | ({} if kind is None else {"format": kind})
    write_atomically(path, lambda file: save_file(whole, file, metadata=about))


def read(
    path: str | os.PathLike[str], kind: str | None = FORMAT
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and header of a file that :func:`write` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no safetensors file, cut short, or of another kind.
    """
    from safetensors import SafetensorError, safe_open

    name = os.fspath(path)
    if not Path(path).is_file():
        raise FileNotFoundError(f"{name}: no such file")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{name}: corrupt or no safetensors file: {error}") from error
    if kind is not None and metadata.get("format") != kind:
        raise ValueError(f"{name}: got format {metadata.get('format')!r}, expected {kind!r}")
    try:
        return tensors, json.loads(metadata["header"])
    except (KeyError, json.JSONDecodeError) as error:
        raise ValueError(f"{name}: corrupt header: {error}") from error
