"""Hand-written adjoints on Warp's tape: which tape is active, what it keeps, where gradients go."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import warp as wp


def active_tape() -> wp.Tape | None:
    """The tape of the ``with wp.Tape()`` block that is running, or None."""
    return wp._src.context.runtime.tape


def record(
    tape: wp.Tape, adjoint: Callable[[], object], inputs: Sequence[wp.array], outputs: Sequence[wp.array]
) -> None:
    """Let ``adjoint`` run in the tape's backward pass: it reads the gradients of ``outputs`` and adds to those of
    ``inputs``. Empty arrays and those without a gradient are left out, which the tape would refuse."""

    def backward() -> None:
        adjoint()
        for array in outputs:  # as Warp's own adjoints do: a second backward adds the same again, not more
            if not array.retain_grad:
                array.grad.zero_()

    tape.record_func(backward, [a for a in (*inputs, *outputs) if a.requires_grad and a.size])


def gradient(array: wp.array) -> wp.array:
    """An array's gradient; zeros that nobody keeps if it has none."""
    return array.grad if array.requires_grad else wp.zeros_like(array)
