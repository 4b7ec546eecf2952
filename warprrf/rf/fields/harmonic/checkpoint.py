"""How far a fit of harmonics has come, on disk: what it needs to go on and end with the same bits."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from warprrf.rf.fields import files as field_files
from warprrf.rf.fields.harmonic.fitting import State

FORMAT = "warprrf field checkpoint 1"
_ARRAYS = ("coefficients", "first", "second")


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
        tensors, header = field_files.read(self.path, FORMAT)
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
        field_files.write(self.path or "", tensors, {"identity": self.identity, "layers": layers}, FORMAT)

    def remove(self) -> None:
        """Delete the file."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
