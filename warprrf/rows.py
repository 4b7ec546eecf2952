"""Tables: dataclasses whose arrays have a row for each thing, taken from and put together alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np


@dataclass(frozen=True)
class Rows:
    """A table. What is no array is of all rows."""

    def take(self, rows: Any) -> Self:
        """The rows ``rows``: indices, a mask or a slice."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self._columns})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of all ``parts``, one or more, one after another."""
        first = parts[0]
        return replace(first, **{n: np.concatenate([getattr(p, n) for p in parts]) for n in first._columns})

    @property
    def _columns(self) -> list[str]:
        return [f.name for f in fields(self) if isinstance(getattr(self, f.name), np.ndarray)]
