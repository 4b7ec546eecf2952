"""Radio fields and half-done fits on disk: safetensors (no pickle), options as JSON in the header."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.geometry.gaussians import replacing
from warprrf.rf.fitting import State

FORMAT = "warprrf field 1"
CHECKPOINT_FORMAT = "warprrf field checkpoint 1"


def write(
    path: str | os.PathLike[str], tensors: dict[str, np.ndarray], header: dict[str, Any], kind: str = FORMAT
) -> None:
    """Write ``tensors`` and ``header`` (plain values) to ``path``."""
    from safetensors.numpy import save_file

    with replacing(path) as temporary:
        save_file(
            {name: np.ascontiguousarray(value) for name, value in tensors.items()},
            temporary,
            metadata={"format": kind, "header": json.dumps(header)},
        )


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


def fingerprint(*parts: Any) -> str:
    """Digest of everything that a fit's result depends on; parts are dataclasses, arrays, or plain values."""
    digest = hashlib.sha256()
    for part in parts:
        for value in vars(part).values() if hasattr(part, "__dataclass_fields__") else [part]:
            if isinstance(value, np.ndarray):
                digest.update(f"{value.dtype} {value.shape}".encode())
                digest.update(np.ascontiguousarray(value).tobytes())
            else:
                digest.update(repr(value).encode())
    return digest.hexdigest()


class Checkpoint:
    """Progress of a fit's layers in one file; without a path it does nothing.

    Raises:
        ValueError: if the file is corrupt or belongs to another fit.
    """

    def __init__(self, path: str | os.PathLike[str] | None, identity: str) -> None:
        self.path = None if path is None else Path(path)
        self.identity = identity
        self.states: dict[str, State] = {}
        if self.path is None or not self.path.exists():
            return
        tensors, header = read(self.path, CHECKPOINT_FORMAT)
        if header.get("identity") != identity:
            raise ValueError(
                f"checkpoint: {self.path} belongs to a fit with other data or options; delete it or name another file"
            )
        for name, info in header["layers"].items():
            self.states[name] = State(
                step=int(info["step"]),
                losses=list(info["losses"]),
                opacity=tensors.get(f"{name}/opacity"),
                **{k: tensors[f"{name}/{k}"] for k in _ARRAYS},  # type: ignore[arg-type]
            )

    def state(self, name: str) -> State | None:
        """Where layer ``name`` stood, or None."""
        return self.states.get(name)

    def saving(self, name: str) -> Callable[[State], None] | None:
        """A callback that saves layer ``name``'s state, or None."""
        return None if self.path is None else lambda state: self._save(name, state)

    def _save(self, name: str, state: State) -> None:
        self.states[name] = state
        tensors = {f"{layer}/{k}": getattr(s, k) for layer, s in self.states.items() for k in _ARRAYS}
        tensors |= {
            f"{layer}/opacity": s.opacity for layer, s in self.states.items() if s.opacity is not None
        }
        layers = {layer: {"step": s.step, "losses": s.losses} for layer, s in self.states.items()}
        write(self.path or "", tensors, {"identity": self.identity, "layers": layers}, CHECKPOINT_FORMAT)

    def remove(self) -> None:
        """Delete the file."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


_ARRAYS = ("coefficients", "first", "second")
