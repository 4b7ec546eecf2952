"""Blending weights from cached responses, and the adjoint of opacities, on the pairs of :mod:`warprrf.kernels.radio.harmonics`.

A pixel's pairs lie front to back in ``pair_of_pixel``. With response ``r_e`` of its Gaussian on the pixel's ray

    alpha_e = min(o_g r_e, alpha_max)     T_e = prod_{before} (1 - alpha)     w_e = alpha_e T_e

and, with contributions ``c_e = w_e u_g A_e`` to the pixel's sum C and v = dL/dC,

    dL/do_g = sum_e v r_e (c_e / alpha_e - (C - C_<=e) / (1 - alpha_e)),      zero where alpha is clamped.

Opacities are moved by their logits, between two limits: dL/dlogit_g = dL/do_g o_g (1 - o_g).
"""

from types import SimpleNamespace

import warp as wp

from warprrf.cache import once


@once
def build(real: type) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        offset: int,
        alpha_max: real,
        pixel_start: wp.array(dtype=int),
        pair_of_pixel: wp.array(dtype=int),
        pair_gaussian: wp.array(dtype=int),
        pair_response: wp.array(dtype=real),
        opacity: wp.array(dtype=real),
        weight: wp.array(dtype=real),
    ):
        """``w_e`` of a pixel's pairs."""
        p = offset + wp.tid()
        left = real(1.0)
        for j in range(pixel_start[p], pixel_start[p + 1]):
            e = pair_of_pixel[j]
            alpha = wp.min(opacity[pair_gaussian[e]] * pair_response[e], alpha_max)
            weight[e] = alpha * left
            left = left * (real(1.0) - alpha)

    @wp.kernel(module="unique", enable_backward=False)
    def blend_adjoint(
        offset: int,
        alpha_max: real,
        pixel_start: wp.array(dtype=int),
        pair_of_pixel: wp.array(dtype=int),
        pair_gaussian: wp.array(dtype=int),
        pair_response: wp.array(dtype=real),
        opacity: wp.array(dtype=real),
        contribution: wp.array(dtype=real),
        total: wp.array(dtype=real),
        pixel_adjoint: wp.array(dtype=real),
        pair_adjoint: wp.array(dtype=real),
    ):
        """A pixel's part of ``dL/do_g``, one number a pair."""
        p = offset + wp.tid()
        behind = total[p]
        for j in range(pixel_start[p], pixel_start[p + 1]):
            e = pair_of_pixel[j]
            response = pair_response[e]
            alpha = opacity[pair_gaussian[e]] * response
            behind = behind - contribution[e]
            slope = real(0.0)
            if alpha > real(0.0) and alpha < alpha_max:
                slope = response * (contribution[e] / alpha - behind / (real(1.0) - alpha))
            pair_adjoint[e] = pixel_adjoint[p] * slope

    @wp.kernel(module="unique", enable_backward=False)
    def add_rows(
        offset: int,
        row_start: wp.array(dtype=int),
        pair_adjoint: wp.array(dtype=real),
        opacity: wp.array(dtype=real),
        gradient: wp.array(dtype=real),
    ):
        """``dL/dlogit_g``, by the sum over the Gaussian's pairs."""
        row = offset + wp.tid()
        total = real(0.0)
        for e in range(row_start[row], row_start[row + 1]):
            total += pair_adjoint[e]
        gradient[row] = total * opacity[row] * (real(1.0) - opacity[row])

    @wp.kernel(module="unique", enable_backward=False)
    def activate(
        offset: int, low: real, high: real, logits: wp.array(dtype=real), opacity: wp.array(dtype=real)
    ):
        """Opacities from logits, which are held between ``low`` and ``high``."""
        row = offset + wp.tid()
        logit = wp.clamp(logits[row], low, high)
        logits[row] = logit
        opacity[row] = real(1.0) / (real(1.0) + wp.exp(-logit))

    return SimpleNamespace(blend=blend, blend_adjoint=blend_adjoint, add_rows=add_rows, activate=activate)


@wp.kernel(enable_backward=False)
def owners(offset: int, row_start: wp.array(dtype=int), pair_gaussian: wp.array(dtype=int)):
    """The row that each pair is of."""
    row = offset + wp.tid()
    for e in range(row_start[row], row_start[row + 1]):
        pair_gaussian[e] = row
