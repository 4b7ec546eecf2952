"""Radio fields on disk: safetensors (no pickle), options as JSON in the header."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.files import write_atomically

FORMAT = "warprrf field 1"


def write(
    path: str | os.PathLike[str], tensors: dict[str, np.ndarray], header: dict[str, Any], kind: str = FORMAT
) -> None:
    """Write ``tensors`` and ``header`` (plain values) to ``path``."""
    from safetensors.numpy import save_file

    whole = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    about = {"format": kind, "header": json.dumps(header)}
    write_atomically(path, lambda file: save_file(whole, file, metadata=about))


def read(path: str | os.PathLike[str], kind: str = FORMAT) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
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
    if metadata.get("format") != kind:
        raise ValueError(f"{name}: got format {metadata.get('format')!r}, expected {kind!r}")
    try:
        return tensors, json.loads(metadata["header"])
    except (KeyError, json.JSONDecodeError) as error:
        raise ValueError(f"{name}: corrupt header: {error}") from error
