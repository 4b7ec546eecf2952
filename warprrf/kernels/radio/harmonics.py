"""Fitting spherical harmonics to spectra on cached blending weights: forward, loss, hand-written adjoint.

A pair is one Gaussian seen in one pixel of one receiver, with its blending weight ``w``. Pairs are stored Gaussian by
Gaussian; a row is one Gaussian's stretch of them, which may be empty. Every sum has one owner, so that a launch split
over threads gives the same bits as one thread: rows own their contributions and gradients, pixels own their power and
loss.

    row:    c_e = w_e u_g A(b_p . a_g)           A = exp, max(0, .), or the identity (delay and angle channels), u: unit
    pixel:  P_p = F_p sum_e c_e + X_p            F: solid angle and spreading loss, X: explicit line of sight
            u_p = (10 log10(P_p + 1) - lo) / (hi - lo)          in units of N0
    loss:   0.8 mean |u - t| + 0.2 (1 - mean SSIM(u, t))
    adjoint, row:  dL/da_g = sum_e (dL/dP_p F_p) w_e u_g A'(b_p . a_g) b_p

``b_p`` are the 16 real harmonics of the pixel's ray direction, shared by all its Gaussians and by all receivers.
Images are planes of :mod:`warprrf.kernels.ssim`, which is zero beyond the poles; a row repeats ``wrapped`` columns of
its other end on either side, as it is periodic in azimuth.
"""

from types import SimpleNamespace

import numpy as np
import warp as wp

from warprrf.cache import once
from warprrf.kernels.raster import sh as _sh
from warprrf.kernels.ssim import MARGIN

EXPONENTIAL, CLAMPED, SIGNED = 0, 1, 2  # what a gain is of its harmonics' sum
COEFFICIENTS = 16
EXPONENT_LIMIT = 60.0  # nepers: keeps a runaway gain finite in float32; 260 dB off the median gain
PER_NEPER = 10.0 / np.log(10.0)  # dB per unit of natural logarithm of power


@once
def build(real: type) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    types = {"vec3": wp.types.vector(3, real), "vec16": wp.types.vector(COEFFICIENTS, real)}
    kernels = [*_forward(real), *_adjoints(real), *_sums(real)]
    return SimpleNamespace(**types, **{kernel.func.__name__: kernel for kernel in kernels})


def _forward(real: type) -> list[wp.Kernel]:
    """From directions and coefficients to harmonics, contributions, sums and images."""
    vec3 = wp.types.vector(3, real)
    vec16 = wp.types.vector(COEFFICIENTS, real)
    harmonics = _sh.build(real).basis
    limit = wp.constant(real(EXPONENT_LIMIT))
    per_neper = wp.constant(real(PER_NEPER))

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_basis(offset: int, directions: wp.array(dtype=vec3), out: wp.array(dtype=vec16)):
        """The 16 harmonics of each direction."""
        i = offset + wp.tid()
        out[i] = harmonics(directions[i])

    @wp.func
    def gain(x: real, kind: int):
        if kind == EXPONENTIAL:
            return wp.exp(wp.clamp(x, -limit, limit))
        if kind == CLAMPED:
            return wp.max(x, real(0.0))
        return x

    @wp.kernel(module="unique", enable_backward=False)
    def contributions(
        offset: int,
        kind: int,
        row_start: wp.array(dtype=int),
        pair_direction: wp.array(dtype=int),
        pair_weight: wp.array(dtype=real),
        unit: wp.array(dtype=real),
        basis: wp.array(dtype=vec16),
        coefficients: wp.array(dtype=vec16),
        contribution: wp.array(dtype=real),
    ):
        """``w_e u_g A(b_p . a_g)`` of every pair of a row."""
        row = offset + wp.tid()
        a = coefficients[row]
        u = unit[row]
        for e in range(row_start[row], row_start[row + 1]):
            contribution[e] = pair_weight[e] * u * gain(wp.dot(a, basis[pair_direction[e]]), kind)

    @wp.kernel(module="unique", enable_backward=False)
    def pixel_sums(
        offset: int,
        pixel_start: wp.array(dtype=int),
        pair_of_pixel: wp.array(dtype=int),
        contribution: wp.array(dtype=real),
        out: wp.array(dtype=real),
    ):
        """Sum of the contributions to a pixel."""
        p = offset + wp.tid()
        total = real(0.0)
        for j in range(pixel_start[p], pixel_start[p + 1]):
            total += contribution[pair_of_pixel[j]]
        out[p] = total

    @wp.kernel(module="unique", enable_backward=False)
    def to_image(
        offset: int,
        width: int,
        stride: int,
        wrapped: int,
        factor: wp.array(dtype=real),
        extra: wp.array(dtype=real),
        low: real,
        high: real,
        total: wp.array(dtype=real),
        image: wp.array(dtype=real),
    ):
        """The dB image in units of the range, one number of a plane's rows."""
        i = offset + wp.tid()
        row = i / (width + 2 * wrapped)
        place = i % (width + 2 * wrapped)
        p = row * width + (place + (width - 1) * wrapped) % width
        power = wp.max(factor[p] * total[p] + extra[p], real(0.0))
        u = (per_neper * wp.log(power + real(1.0)) - low) / (high - low)
        image[row * stride + wp.static(MARGIN) + place] = u

    @wp.kernel(module="unique", enable_backward=False)
    def predict(
        offset: int,
        kind: int,
        start: wp.array(dtype=int),
        gaussian: wp.array(dtype=int),
        weight: wp.array(dtype=real),
        basis: wp.array(dtype=vec16),
        coefficients: wp.array(dtype=vec16),
        out: wp.array(dtype=real),
    ):
        """Blended gain of one receiver's pixel from its pairs."""
        p = offset + wp.tid()
        total = real(0.0)
        for e in range(start[p], start[p + 1]):
            total += weight[e] * gain(wp.dot(coefficients[gaussian[e]], basis[p]), kind)
        out[p] = total

    return [evaluate_basis, contributions, pixel_sums, to_image, predict]


def _adjoints(real: type) -> list[wp.Kernel]:
    """From the loss back to coefficients."""
    vec16 = wp.types.vector(COEFFICIENTS, real)
    per_neper = wp.constant(real(PER_NEPER))

    @wp.kernel(module="unique", enable_backward=False)
    def loss_adjoint(
        offset: int,
        width: int,
        stride: int,
        wrapped: int,
        factor: wp.array(dtype=real),
        extra: wp.array(dtype=real),
        low: real,
        high: real,
        total: wp.array(dtype=real),
        image: wp.array(dtype=real),
        target: wp.array(dtype=real),
        slopes: wp.array(dtype=real),
        absolute: wp.array(dtype=real),
        pixel_adjoint: wp.array(dtype=real),
    ):
        """``|u - t|`` and ``dL/d(sum of contributions)`` from the planes of u, t and dL/du."""
        p = offset + wp.tid()
        e = (p / width) * stride + wp.static(MARGIN) + wrapped + p % width
        absolute[p] = wp.abs(image[e] - target[e])
        slope = slopes[e]
        power = factor[p] * total[p] + extra[p]
        if power < real(0.0):
            slope = real(0.0)
        pixel_adjoint[p] = (
            slope * per_neper / ((wp.max(power, real(0.0)) + real(1.0)) * (high - low)) * factor[p]
        )

    @wp.kernel(module="unique", enable_backward=False)
    def absolute_adjoint(
        offset: int,
        share: real,
        mask: wp.array(dtype=real),
        target: wp.array(dtype=real),
        total: wp.array(dtype=real),
        absolute: wp.array(dtype=real),
        pixel_adjoint: wp.array(dtype=real),
    ):
        """Masked absolute error of a plainly blended channel (delay, angle of departure) and its adjoint."""
        p = offset + wp.tid()
        difference = total[p] - target[p]
        absolute[p] = mask[p] * wp.abs(difference)
        slope = real(0.0)
        if difference != real(0.0):
            slope = share * mask[p] * wp.sign(difference)
        pixel_adjoint[p] = slope

    @wp.kernel(module="unique", enable_backward=False)
    def coefficient_adjoint(
        offset: int,
        kind: int,
        row_start: wp.array(dtype=int),
        pair_pixel: wp.array(dtype=int),
        pair_direction: wp.array(dtype=int),
        pair_weight: wp.array(dtype=real),
        unit: wp.array(dtype=real),
        basis: wp.array(dtype=vec16),
        contribution: wp.array(dtype=real),
        pixel_adjoint: wp.array(dtype=real),
        gradient: wp.array(dtype=vec16),
    ):
        """``dL/da_g`` of the row's Gaussian, zero if the batch does not see it."""
        row = offset + wp.tid()
        u = unit[row]
        total = vec16(real(0.0))
        for e in range(row_start[row], row_start[row + 1]):
            slope = pair_weight[e] * u
            if kind == EXPONENTIAL:
                slope = contribution[e]
            elif kind == CLAMPED and contribution[e] <= real(0.0):
                slope = real(0.0)
            total += (pixel_adjoint[pair_pixel[e]] * slope) * basis[pair_direction[e]]
        gradient[row] = total

    return [loss_adjoint, absolute_adjoint, coefficient_adjoint]


def _sums(real: type) -> list[wp.Kernel]:
    """What pairs and pixels carry, put in order and added up."""

    @wp.kernel(module="unique", enable_backward=False)
    def put_in_order(
        offset: int,
        first: int,
        pair_of_pixel: wp.array(dtype=int),
        values: wp.array(dtype=wp.float32),
        out: wp.array(dtype=real),
    ):
        """Values of a receiver's pairs, pixel by pixel from pair ``first`` on, where their Gaussians have them."""
        e = offset + wp.tid()
        out[pair_of_pixel[first + e]] = real(values[e])

    @wp.kernel(module="unique", enable_backward=False)
    def add_to_means(
        offset: int,
        row_start: wp.array(dtype=int),
        pair_pixel: wp.array(dtype=int),
        pair_weight: wp.array(dtype=real),
        values: wp.array(dtype=wp.float64),
        total: wp.array(dtype=wp.float64),
        summed: wp.array(dtype=wp.float64),
    ):
        """Add a row's weights, and these times the values of their pixels; a value of NaN does not count."""
        row = offset + wp.tid()
        weight = wp.float64(0.0)
        product = wp.float64(0.0)
        for e in range(row_start[row], row_start[row + 1]):
            value = values[pair_pixel[e]]
            if not wp.isnan(value):
                weight += wp.float64(pair_weight[e])
                product += wp.float64(pair_weight[e]) * value
        total[row] = total[row] + weight
        summed[row] = summed[row] + product

    @wp.kernel(module="unique", enable_backward=False)
    def row_errors(
        offset: int,
        width: int,
        stride: int,
        wrapped: int,
        absolute: wp.array(dtype=real),
        score: wp.array(dtype=real),
        out: wp.array(dtype=wp.vec2d),
    ):
        """Sums over a row of an image: of ``|u - t|``, and of the plane of similarities, if that is not empty."""
        row = offset + wp.tid()
        error = wp.float64(0.0)
        similarity = wp.float64(0.0)
        for x in range(width):
            error += wp.float64(absolute[row * width + x])
            if score.shape[0] > 0:
                similarity += wp.float64(score[row * stride + wp.static(MARGIN) + wrapped + x])
        out[row] = wp.vec2d(error, similarity)

    return [put_in_order, add_to_means, row_errors]
