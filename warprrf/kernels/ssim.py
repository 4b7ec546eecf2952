"""Structural similarity and L1 of panoramas in [0, 1], with derivatives, in Warp; of photos: :mod:`.photo_ssim`.

SSIM: Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004, with a Gaussian
window of 11 pixels and sigma 1.5; the window wraps in azimuth and sees zeros beyond the poles. That filter is its own
adjoint, so the derivative filters the slopes once more. Images of one channel are flat: element
``row * width + column``, views one after another.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warprrf.cache import once

RADIUS = 5  # pixels: 11 taps
WINDOW = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / 1.5) ** 2)
WINDOW /= WINDOW.sum()
C1, C2 = 0.01**2, 0.03**2  # the paper's constants for a range of one


@once
def _filters(real: type) -> tuple[Any, Any]:
    """The kernels that average over the window, along rows and along columns."""
    vec3 = wp.types.vector(3, real)
    window = wp.constant(wp.types.vector(len(WINDOW), real)(*WINDOW))

    @wp.kernel(module="unique", enable_backward=False)
    def filter_rows(
        offset: int,
        width: int,
        source: wp.array(dtype=vec3),
        out: wp.array(dtype=vec3),
    ):
        """Window average along a row; beyond one end comes the other."""
        p = offset + wp.tid()
        column = p % width
        total = vec3(real(0.0))
        for k in range(wp.static(2 * RADIUS + 1)):
            c = column + k - wp.static(RADIUS)
            shift = k - wp.static(RADIUS)
            if c < 0:
                shift += width
            if c >= width:
                shift -= width
            total += window[k] * source[p + shift]
        out[p] = total

    @wp.kernel(module="unique", enable_backward=False)
    def filter_columns(
        offset: int,
        height: int,
        width: int,
        source: wp.array(dtype=vec3),
        out: wp.array(dtype=vec3),
    ):
        """Window average along a column, zero beyond its ends."""
        p = offset + wp.tid()
        row = (p // width) % height
        total = vec3(real(0.0))
        for k in range(wp.static(2 * RADIUS + 1)):
            r = row + k - wp.static(RADIUS)
            if r >= 0 and r < height:
                total += window[k] * source[p + (k - wp.static(RADIUS)) * width]
        out[p] = total

    return filter_rows, filter_columns


@once
def build(real: type) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    vec3 = wp.types.vector(3, real)
    c1 = wp.constant(real(C1))
    c2 = wp.constant(real(C2))

    @wp.kernel(module="unique", enable_backward=False)
    def slopes(
        offset: int,
        target_moments: wp.array(dtype=vec3),
        image_moments: wp.array(dtype=vec3),
        score: wp.array(dtype=real),
        out: wp.array(dtype=vec3),
    ):
        """SSIM of a pixel and its derivatives with respect to the averages of u, u^2 and u t."""
        p = offset + wp.tid()
        m = image_moments[p]
        mu = m[0]
        mt = target_moments[p][0]
        a1 = real(2.0) * mu * mt + c1
        a2 = real(2.0) * (m[2] - mu * mt) + c2
        b1 = mu * mu + mt * mt + c1
        b2 = (m[1] - mu * mu) + (target_moments[p][1] - mt * mt) + c2
        s = a1 * a2 / (b1 * b2)
        of_square = -s / b2
        of_product = real(2.0) * a1 / (b1 * b2)
        of_mean = (
            real(2.0) * mt * a2 / (b1 * b2)
            - real(2.0) * mu * s / b1
            - real(2.0) * mu * of_square
            - mt * of_product
        )
        score[p] = s
        out[p] = vec3(of_mean, of_square, of_product)

    @wp.func
    def slope(u: real, t: real, filtered: vec3, absolute_share: real, ssim_share: real):
        """Derivative of ``absolute_share |u - t| - ssim_share SSIM`` with respect to u."""
        difference = u - t
        out = -ssim_share * (filtered[0] + real(2.0) * u * filtered[1] + t * filtered[2])
        if difference > real(0.0):
            out += absolute_share
        if difference < real(0.0):
            out -= absolute_share
        return out

    filter_rows, filter_columns = _filters(real)
    return SimpleNamespace(
        filter_columns=filter_columns,
        filter_rows=filter_rows,
        slope=slope,
        slopes=slopes,
        vec3=vec3,
    )
