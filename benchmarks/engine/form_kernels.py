"""Kernels that the benchmark times: a Gaussian's response in several forms, exp(-h) in several forms."""

from functools import cache
from typing import Any

import warp as wp

from warprrf.kernels.raster.project import splat_of
from warprrf.kernels.raster.reference import behind, meet
from warprrf.kernels.raster.view import Rules, View, pixel_of, pixel_ray

TEXTBOOK, OFFSET_FIRST, GRAM, TURNED, QUADRATIC = range(5)
COEFFICIENTS = 24  # room for a Gaussian's coefficients in any form
STRIP = 16  # values that the rasteriser exponentiates at once

strip = wp.types.vector(STRIP, wp.float32)


@wp.func
def squared_distance(form: int, c: wp.array(dtype=wp.float32, ndim=2), i: int, d: wp.vec3):
    """q of Gaussian ``i`` in direction ``d``; ``c`` holds what :mod:`benchmarks.engine.forms` puts there."""
    if form == wp.static(TEXTBOOK) or form == wp.static(OFFSET_FIRST):
        g = wp.vec3(
            c[i, 0] * d[0] + c[i, 1] * d[1] + c[i, 2] * d[2],
            c[i, 3] * d[0] + c[i, 4] * d[1] + c[i, 5] * d[2],
            c[i, 6] * d[0] + c[i, 7] * d[1] + c[i, 8] * d[2],
        )
        if form == wp.static(TEXTBOOK):
            o = wp.vec3(c[i, 9], c[i, 10], c[i, 11])
            along = wp.dot(o, g)
            return c[i, 12] - along * along / wp.dot(g, g)
        m = wp.vec3(c[i, 9], c[i, 10], c[i, 11])
        p = wp.dot(m, d) * d - m
        h = wp.vec3(
            c[i, 0] * p[0] + c[i, 1] * p[1] + c[i, 2] * p[2],
            c[i, 3] * p[0] + c[i, 4] * p[1] + c[i, 5] * p[2],
            c[i, 6] * p[0] + c[i, 7] * p[1] + c[i, 8] * p[2],
        )
        x = wp.cross(g, h)
        return wp.dot(x, x) / wp.dot(g, g)
    if form == wp.static(QUADRATIC):
        xx = d[0] * d[0]
        yy = d[1] * d[1]
        zz = d[2] * d[2]
        xy = d[0] * d[1]
        xz = d[0] * d[2]
        yz = d[1] * d[2]
        top = c[i, 0] * xx + c[i, 1] * yy + c[i, 2] * zz + c[i, 3] * xy + c[i, 4] * xz + c[i, 5] * yz
        return top / (
            c[i, 6] * xx + c[i, 7] * yy + c[i, 8] * zz + c[i, 9] * xy + c[i, 10] * xz + c[i, 11] * yz
        )
    u1 = c[i, 0] * d[0] + c[i, 1] * d[1] + c[i, 2] * d[2]
    u2 = c[i, 3] * d[0] + c[i, 4] * d[1] + c[i, 5] * d[2]
    w = c[i, 6] * d[0] + c[i, 7] * d[1] + c[i, 8] * d[2]
    n = c[i, 9] * u1 * u1 + c[i, 10] * u2 * u2
    if form == wp.static(GRAM):
        n = n + c[i, 17] * u1 * u2
    gg = w * (c[i, 11] * w + 2.0 * (c[i, 12] * u1 + c[i, 13] * u2))
    gg = gg + u1 * (c[i, 14] * u1 + 2.0 * c[i, 15] * u2) + c[i, 16] * u2 * u2
    return n / gg


@cache
def form_kernel(form: int) -> Any:
    """Kernel of one form; the compiler drops the others."""

    @wp.kernel(module="unique", enable_backward=False)
    def respond(
        offset: int,
        coefficients: wp.array(dtype=wp.float32, ndim=2),
        directions: wp.array(dtype=wp.vec3, ndim=2),
        q: wp.array(dtype=wp.float32, ndim=2),
    ):
        i = offset + wp.tid()
        for k in range(directions.shape[1]):
            q[i, k] = squared_distance(wp.static(form), coefficients, i, directions[i, k])

    return respond


@wp.func
def taylor6(h: strip):
    """The rasteriser's: (Taylor of exp(-h/16), degree 6)^16."""
    one = strip(1.0)
    x = wp.min(h, strip(80.0)) * -0.0625
    p = one + x * 0.16666667
    p = one + wp.cw_mul(x, p) * 0.2
    p = one + wp.cw_mul(x, p) * 0.25
    p = one + wp.cw_mul(x, p) * 0.33333333
    p = one + wp.cw_mul(x, p) * 0.5
    p = wp.max(one + wp.cw_mul(x, p), strip())
    p = wp.cw_mul(p, p)
    p = wp.cw_mul(p, p)
    p = wp.cw_mul(p, p)
    return wp.cw_mul(p, p)


@wp.func
def taylor3(h: strip):
    """(Taylor of exp(-h/64), degree 3)^64."""
    one = strip(1.0)
    x = wp.min(h, strip(80.0)) * -0.015625
    p = one + x * 0.33333333
    p = one + wp.cw_mul(x, p) * 0.5
    p = wp.max(one + wp.cw_mul(x, p), strip())
    for _ in range(6):
        p = wp.cw_mul(p, p)
    return p


@wp.func
def limit(h: strip):
    """(1 - h/256)^256."""
    p = wp.max(strip(1.0) - h * 0.00390625, strip())
    for _ in range(8):
        p = wp.cw_mul(p, p)
    return p


@wp.func
def library(h: strip):
    """exp(-h) of the mathematical library."""
    out = strip()
    for k in range(wp.static(STRIP)):
        out[k] = wp.exp(-h[k])
    return out


@wp.func
def double_precision(h: strip):
    """exp(-h) of the mathematical library in float64."""
    out = strip()
    for k in range(wp.static(STRIP)):
        out[k] = wp.float32(wp.exp(-wp.float64(h[k])))
    return out


@cache
def exponential_kernel(function: Any) -> Any:
    """Kernel that sums ``function`` of each value, one more at a time: work without memory traffic."""

    @wp.kernel(module="unique", enable_backward=False)
    def exponentiate(
        offset: int,
        rounds: int,
        h: wp.array(dtype=wp.float32, ndim=2),
        out: wp.array(dtype=wp.float32, ndim=2),
    ):
        i = offset + wp.tid()
        x = strip()
        for k in range(wp.static(STRIP)):
            x[k] = h[i, k]
        total = strip()
        for j in range(rounds):
            total += function(x + strip(wp.float32(j)))
        for k in range(wp.static(STRIP)):
            out[i, k] = total[k]

    return exponentiate


@wp.kernel(enable_backward=False)
def count_passing(
    offset: int,
    splats: wp.array(dtype=splat_of(wp.float32)),
    ids: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    view: View,
    rules: Rules,
    count: wp.array(dtype=int, ndim=2),
):
    """How many Gaussians contribute to each pixel."""
    tile, x, y = pixel_of(offset + wp.tid(), view)
    if x >= view.width or y >= view.height:
        return
    ray = wp.vec3(pixel_ray(view, x, y))
    transmittance = float(1.0)  # noqa: UP018  (Warp's way to declare a variable)
    for j in range(starts[tile], starts[tile + 1]):
        if transmittance <= float(rules.transmittance_min):
            break
        splat = splats[ids[j]]
        g0, _g1, _g2, _inverse, q = meet(splat, ray, 1.0e-30)
        if g0 > 0.0 and q < splat.cut:
            count[y, x] = count[y, x] + 1
            alpha = wp.min(splat.opacity * wp.exp(-0.5 * q), float(rules.alpha_max))
            transmittance = behind(transmittance, alpha, rules.rule)
