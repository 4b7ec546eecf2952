"""Hand-written adjoints on Warp's tape: which tape is active, which arrays it keeps, where gradients go."""

from __future__ import annotations

import warp as wp


def active_tape() -> wp.Tape | None:
    """The tape of the ``with wp.Tape()`` block that is running, or None."""
    return wp._src.context.runtime.tape


def with_gradients(*arrays: wp.array) -> list[wp.array]:
    """Those whose gradients the tape keeps; it refuses arrays that want none or are empty."""
    return [array for array in arrays if array.requires_grad and array.size]


def gradient(array: wp.array) -> wp.array:
    """An array's gradient; zeros that nobody keeps if it has none."""
    return array.grad if array.requires_grad else wp.zeros_like(array)
