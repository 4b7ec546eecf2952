"""What an object of arrays says of itself in a line."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


def one_line(self: Any) -> str:
    """The ``__repr__`` of a dataclass of arrays: their shapes, other values as they are, None left out."""
    parts = []
    for field in fields(self):
        value = getattr(self, field.name)
        if hasattr(value, "shape") and np.prod(value.shape) > 3:
            parts.append(f"{field.name} {tuple(value.shape)}")
        elif value is not None and len(text := repr(value)) <= 60:
            parts.append(f"{field.name}={text}")
    return f"{type(self).__name__}({', '.join(parts)})"
