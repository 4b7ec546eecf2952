"""Blending the exact responses of :mod:`warprrf.kernels.project` front to back, and the hand-written adjoint.

Adjoint: with ``y = M (t d - m)`` (so that ``q = |y|^2``) the envelope theorem gives ``dq = 2 y.(dM r - M dmean)``,
``r = M^-1 y``, and ``dt = -(g.do + (y + t g).dg)/|g|^2``. Both are symmetric in whitened coordinates: every pair adds
to a 3-vector ``Y1`` and a symmetric 3x3 ``Y2`` per Gaussian, which `chain` turns into gradients of mean, quaternion
and scale.

A thread blends a strip of 16 pixels of one row; the strip is one Warp vector, which a CPU executes with wide registers.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.project import (
    AA,
    AB1,
    AB2,
    B1,
    B2,
    BB11,
    BB12,
    BB22,
    CHANNELS,
    CUT,
    E1,
    E2,
    FIRST_ROW,
    GRAM,
    INVERSE,
    LAST_ROW,
    MH,
    OPACITY,
    PRODUCT,
    RANGE,
    SMALLEST,
    STRIP,
    TILE,
    A,
    Rules,
    View,
    pixel_direction,
)  # fmt: skip


@cache
def build(real: Any) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    strip = wp.types.vector(STRIP, real)
    big = 1.0e30 if real is wp.float32 else 1.0e250
    tiny = 1.0e-30 if real is wp.float32 else 1.0e-250

    @wp.func
    def step(x: strip):
        """1 where x > 0, else 0 (NaN-free arithmetic select)."""
        return wp.min(wp.max(x * real(wp.static(big)), strip()), strip(real(1.0)))

    # Reductions as trees: a chain of 16 dependent additions is what wp.dot and wp.max compile to on a CPU.
    @wp.func
    def lane_sum(x: strip):
        return (((x[0] + x[8]) + (x[4] + x[12])) + ((x[2] + x[10]) + (x[6] + x[14]))) + (
            ((x[1] + x[9]) + (x[5] + x[13])) + ((x[3] + x[11]) + (x[7] + x[15]))
        )

    @wp.func
    def lane_max(x: strip):
        return wp.max(
            wp.max(
                wp.max(wp.max(x[0], x[8]), wp.max(x[4], x[12])),
                wp.max(wp.max(x[2], x[10]), wp.max(x[6], x[14])),
            ),
            wp.max(
                wp.max(wp.max(x[1], x[9]), wp.max(x[5], x[13])),
                wp.max(wp.max(x[3], x[11]), wp.max(x[7], x[15])),
            ),
        )

    if real is wp.float32:

        @wp.func
        def negative_exponential(h: strip):
            """exp(-h) for h >= 0: (Taylor of exp(-h/16), degree 6)^16; absolute error below 5e-7."""
            one = strip(real(1.0))
            x = wp.min(h, strip(real(80.0))) * real(-0.0625)
            p = one + x * real(0.16666666666666666)
            p = one + wp.cw_mul(x, p) * real(0.2)
            p = one + wp.cw_mul(x, p) * real(0.25)
            p = one + wp.cw_mul(x, p) * real(0.3333333333333333)
            p = one + wp.cw_mul(x, p) * real(0.5)
            p = wp.max(one + wp.cw_mul(x, p), strip())
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            return wp.cw_mul(p, p)

    else:

        @wp.func
        def negative_exponential(h: strip):
            out = strip()
            for k in range(wp.static(STRIP)):
                out[k] = wp.exp(-h[k])
            return out

    @wp.func
    def local_ray(rows: wp.array(dtype=real, ndim=2), k: int, dx: strip, dy: strip, dz: strip):
        """Components (w, u1, u2) of the strip's rays in the Gaussian's frame."""
        u1 = rows[k, E1] * dx + rows[k, E1 + 1] * dy + rows[k, E1 + 2] * dz
        u2 = rows[k, E2] * dx + rows[k, E2 + 1] * dy + rows[k, E2 + 2] * dz
        w = rows[k, MH] * dx + rows[k, MH + 1] * dy + rows[k, MH + 2] * dz
        return w, u1, u2

    @wp.func
    def quadratics(rows: wp.array(dtype=real, ndim=2), k: int, w: strip, u1: strip, u2: strip):
        """Numerator of q, a.g and |g|^2."""
        n = rows[k, GRAM] * wp.cw_mul(u1, u1) + rows[k, GRAM + 1] * wp.cw_mul(u2, u2)
        p = rows[k, AB1] * u1 + rows[k, AB2] * u2
        ag = rows[k, AA] * w + p
        h1 = rows[k, AB1] * w + rows[k, BB11] * u1 + rows[k, BB12] * u2
        h2 = rows[k, AB2] * w + rows[k, BB12] * u1 + rows[k, BB22] * u2
        side = wp.cw_mul(u1, h1) + wp.cw_mul(u2, h2)
        gg = wp.max(wp.cw_mul(w, ag) + side, strip(real(wp.static(tiny))))
        return n, ag, gg, side

    @wp.func
    def strip_directions(view: View, x0: int, y: int):
        dx = strip()
        dy = strip()
        dz = strip()
        for k in range(wp.static(STRIP)):
            d = pixel_direction(view, x0 + k, y)
            dx[k] = real(d[0])
            dy[k] = real(d[1])
            dz[k] = real(d[2])
        return dx, dy, dz

    @wp.func
    def thinned(transmittance: strip, alpha: strip, rule: int):
        if rule == wp.static(PRODUCT):
            return wp.cw_mul(transmittance, strip(real(1.0)) - alpha)
        return wp.cw_mul(transmittance, negative_exponential(alpha))

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        offset: int,
        rows: wp.array(dtype=real, ndim=2),
        features: wp.array(dtype=real, ndim=2),
        first: int,
        background: wp.array(dtype=real),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        image: wp.array(dtype=real, ndim=3),
        alpha_out: wp.array(dtype=real, ndim=2),
        depth_out: wp.array(dtype=real, ndim=2),
        transmittance_out: wp.array(dtype=real, ndim=2),
        dominant_out: wp.array(dtype=int, ndim=2),
        peak_out: wp.array(dtype=real, ndim=2),
    ):
        """Blend channels ``first .. first + 3`` front to back. ``depth_out`` holds the sum of weight times t."""
        i = offset + wp.tid()
        tile = i / wp.static(TILE)
        x0 = (tile % view.tiles_x) * wp.static(TILE)
        y = (tile / view.tiles_x) * wp.static(TILE) + i % wp.static(TILE)
        if y >= view.height:
            return
        row = real(y)
        dx, dy, dz = strip_directions(view, x0, y)
        channels = wp.min(features.shape[1] - first, wp.static(CHANNELS))
        amax = strip(real(rules.alpha_max))
        tmin = strip(real(rules.transmittance_min))
        transmittance = strip(real(1.0))
        c0 = strip()
        c1 = strip()
        c2 = strip()
        c3 = strip()
        depth = strip()
        total = strip()
        best = strip()
        owner = strip(real(-1.0))
        peak = strip()
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            if row >= rows[k, FIRST_ROW] and row <= rows[k, LAST_ROW]:
                w, u1, u2 = local_ray(rows, k, dx, dy, dz)
                n, ag, gg, side = quadratics(rows, k, w, u1, u2)
                q = wp.cw_div(n, gg)
                room = strip(rows[k, CUT]) - q
                if lane_max(room) > real(0.0):
                    keep = wp.cw_mul(wp.cw_mul(step(room), step(ag)), step(transmittance - tmin))
                    alpha = wp.min(rows[k, OPACITY] * negative_exponential(real(0.5) * q), amax)
                    alpha = wp.cw_mul(alpha, keep)
                    weight = wp.cw_mul(alpha, transmittance)
                    transmittance = thinned(transmittance, alpha, rules.rule)
                    t = rows[k, RANGE] * wp.cw_div(ag, gg)
                    depth += wp.cw_mul(weight, t)
                    total += weight
                    better = step(weight - best)
                    best = wp.max(best, weight)
                    owner += wp.cw_mul(better, strip(real(k)) - owner)
                    peak += wp.cw_mul(better, t - peak)
                    c0 += features[k, first] * weight
                    if channels > 1:
                        c1 += features[k, first + 1] * weight
                    if channels > 2:
                        c2 += features[k, first + 2] * weight
                    if channels > 3:
                        c3 += features[k, first + 3] * weight
                    if lane_max(transmittance) <= real(rules.transmittance_min):
                        break
        c0 += background[first] * transmittance
        if channels > 1:
            c1 += background[first + 1] * transmittance
        if channels > 2:
            c2 += background[first + 2] * transmittance
        if channels > 3:
            c3 += background[first + 3] * transmittance
        for lane in range(wp.static(STRIP)):
            x = x0 + lane
            if x < view.width:
                image[y, x, first] = c0[lane]
                if channels > 1:
                    image[y, x, first + 1] = c1[lane]
                if channels > 2:
                    image[y, x, first + 2] = c2[lane]
                if channels > 3:
                    image[y, x, first + 3] = c3[lane]
                if first == 0:
                    alpha_out[y, x] = total[lane]
                    depth_out[y, x] = depth[lane]
                    transmittance_out[y, x] = transmittance[lane]
                    dominant_out[y, x] = int(owner[lane])
                    peak_out[y, x] = peak[lane]

    @wp.kernel(module="unique", enable_backward=False)
    def blend_adjoint(
        offset: int,
        strips: int,
        pieces: int,
        rows: wp.array(dtype=real, ndim=2),
        features: wp.array(dtype=real, ndim=2),
        first: int,
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        image: wp.array(dtype=real, ndim=3),
        alpha_sum: wp.array(dtype=real, ndim=2),
        depth_sum: wp.array(dtype=real, ndim=2),
        image_grad: wp.array(dtype=real, ndim=3),
        alpha_grad: wp.array(dtype=real, ndim=2),
        depth_grad: wp.array(dtype=real, ndim=2),
        sums: wp.array(dtype=real, ndim=3),
    ):
        """Same walk as `blend`; adds each pair's gradient to ``sums[piece, Gaussian]``.

        dL/da_i = T_i x_i - (R - sum_{j<=i} w_j x_j) / (1 - a_i), x the gradient dotted with the pair's features, R the
        same dotted with the finished pixel; without the division for the exponential rule.
        """
        i = offset + wp.tid()
        piece = ((i + 1) * pieces - 1) / strips
        tile = i / wp.static(TILE)
        x0 = (tile % view.tiles_x) * wp.static(TILE)
        y = (tile / view.tiles_x) * wp.static(TILE) + i % wp.static(TILE)
        if y >= view.height or starts[tile] == starts[tile + 1]:
            return
        channels = wp.min(features.shape[1] - first, wp.static(CHANNELS))
        v0 = strip()
        v1 = strip()
        v2 = strip()
        v3 = strip()
        vt = strip()
        va = strip()
        goal = strip()
        for lane in range(wp.static(STRIP)):
            x = x0 + lane
            if x < view.width:
                v0[lane] = image_grad[y, x, first]
                r = v0[lane] * image[y, x, first]
                if channels > 1:
                    v1[lane] = image_grad[y, x, first + 1]
                    r += v1[lane] * image[y, x, first + 1]
                if channels > 2:
                    v2[lane] = image_grad[y, x, first + 2]
                    r += v2[lane] * image[y, x, first + 2]
                if channels > 3:
                    v3[lane] = image_grad[y, x, first + 3]
                    r += v3[lane] * image[y, x, first + 3]
                if first == 0:
                    a = alpha_sum[y, x]
                    if a > real(0.0):
                        vt[lane] = depth_grad[y, x] / a
                        va[lane] = alpha_grad[y, x] - depth_grad[y, x] * depth_sum[y, x] / (a * a)
                        r += vt[lane] * depth_sum[y, x] + va[lane] * a
                goal[lane] = r
        with_depth = lane_sum(wp.cw_mul(vt, vt)) > real(0.0)
        row = real(y)
        dx, dy, dz = strip_directions(view, x0, y)
        one = strip(real(1.0))
        amax = strip(real(rules.alpha_max))
        tmin = strip(real(rules.transmittance_min))
        transmittance = strip(real(1.0))
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            if row >= rows[k, FIRST_ROW] and row <= rows[k, LAST_ROW]:
                w, u1, u2 = local_ray(rows, k, dx, dy, dz)
                n, ag, gg, side = quadratics(rows, k, w, u1, u2)
                q = wp.cw_div(n, gg)
                room = strip(rows[k, CUT]) - q
                if lane_max(room) > real(0.0):
                    keep = wp.cw_mul(wp.cw_mul(step(room), step(ag)), step(transmittance - tmin))
                    response = wp.cw_mul(negative_exponential(real(0.5) * q), keep)
                    raw = rows[k, OPACITY] * response
                    alpha = wp.min(raw, amax)
                    free = one - step(raw - amax)
                    weight = wp.cw_mul(alpha, transmittance)
                    t = rows[k, RANGE] * wp.cw_div(ag, gg)
                    value = features[k, first] * v0
                    if channels > 1:
                        value += features[k, first + 1] * v1
                    if channels > 2:
                        value += features[k, first + 2] * v2
                    if channels > 3:
                        value += features[k, first + 3] * v3
                    if first == 0:
                        value += wp.cw_mul(vt, t) + va
                    goal -= wp.cw_mul(weight, value)
                    behind = goal
                    if rules.rule == wp.static(PRODUCT):
                        behind = wp.cw_div(goal, wp.max(one - alpha, strip(real(wp.static(tiny)))))
                    slope = wp.cw_mul(wp.cw_mul(wp.cw_mul(transmittance, value) - behind, keep), free)
                    transmittance = thinned(transmittance, alpha, rules.rule)
                    v = real(-0.5) * wp.cw_mul(slope, raw)  # dL/dq
                    # y = M (t d - m) without cancellation: t w - |m| = -|m| side / gg
                    off = rows[k, INVERSE] * wp.cw_div(strip(-rows[k, RANGE]), gg)
                    lift = wp.cw_mul(off, side)
                    s1 = rows[k, INVERSE] * wp.cw_mul(t, u1)
                    s2 = rows[k, INVERSE] * wp.cw_mul(t, u2)
                    y0 = rows[k, A] * lift + rows[k, B1] * s1 + rows[k, B2] * s2
                    y1 = rows[k, A + 1] * lift + rows[k, B1 + 1] * s1 + rows[k, B2 + 1] * s2
                    y2 = rows[k, A + 2] * lift + rows[k, B1 + 2] * s1 + rows[k, B2 + 2] * s2
                    p0 = wp.cw_mul(v, y0)
                    p1 = wp.cw_mul(v, y1)
                    p2 = wp.cw_mul(v, y2)
                    s00 = lane_sum(wp.cw_mul(p0, y0))
                    s01 = lane_sum(wp.cw_mul(p0, y1))
                    s02 = lane_sum(wp.cw_mul(p0, y2))
                    s11 = lane_sum(wp.cw_mul(p1, y1))
                    s12 = lane_sum(wp.cw_mul(p1, y2))
                    s22 = lane_sum(wp.cw_mul(p2, y2))
                    if with_depth:
                        half = (real(0.5) * rows[k, SMALLEST]) * wp.cw_div(wp.cw_mul(weight, vt), gg)
                        h0 = wp.cw_mul(half, rows[k, A] * w + rows[k, B1] * u1 + rows[k, B2] * u2)
                        h1 = wp.cw_mul(half, rows[k, A + 1] * w + rows[k, B1 + 1] * u1 + rows[k, B2 + 1] * u2)
                        h2 = wp.cw_mul(half, rows[k, A + 2] * w + rows[k, B1 + 2] * u1 + rows[k, B2 + 2] * u2)
                        p0 -= h0
                        p1 -= h1
                        p2 -= h2
                        s00 -= real(2.0) * lane_sum(wp.cw_mul(h0, y0))
                        s01 -= lane_sum(wp.cw_mul(h0, y1)) + lane_sum(wp.cw_mul(h1, y0))
                        s02 -= lane_sum(wp.cw_mul(h0, y2)) + lane_sum(wp.cw_mul(h2, y0))
                        s11 -= real(2.0) * lane_sum(wp.cw_mul(h1, y1))
                        s12 -= lane_sum(wp.cw_mul(h1, y2)) + lane_sum(wp.cw_mul(h2, y1))
                        s22 -= real(2.0) * lane_sum(wp.cw_mul(h2, y2))
                    wp.atomic_add(sums, piece, k, 0, lane_sum(p0))
                    wp.atomic_add(sums, piece, k, 1, lane_sum(p1))
                    wp.atomic_add(sums, piece, k, 2, lane_sum(p2))
                    wp.atomic_add(sums, piece, k, 3, s00)
                    wp.atomic_add(sums, piece, k, 4, s01)
                    wp.atomic_add(sums, piece, k, 5, s02)
                    wp.atomic_add(sums, piece, k, 6, s11)
                    wp.atomic_add(sums, piece, k, 7, s12)
                    wp.atomic_add(sums, piece, k, 8, s22)
                    wp.atomic_add(sums, piece, k, 9, lane_sum(wp.cw_mul(slope, response)))
                    wp.atomic_add(sums, piece, k, 10, lane_sum(wp.cw_mul(weight, v0)))
                    if channels > 1:
                        wp.atomic_add(sums, piece, k, 11, lane_sum(wp.cw_mul(weight, v1)))
                    if channels > 2:
                        wp.atomic_add(sums, piece, k, 12, lane_sum(wp.cw_mul(weight, v2)))
                    if channels > 3:
                        wp.atomic_add(sums, piece, k, 13, lane_sum(wp.cw_mul(weight, v3)))
                    if first == 0:
                        wp.atomic_add(sums, piece, k, 14, lane_sum(weight))
                    if lane_max(transmittance) <= real(rules.transmittance_min):
                        break

    @wp.kernel(module="unique", enable_backward=False)
    def strongest(
        offset: int,
        rows: wp.array(dtype=real, ndim=2),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        index: wp.array(dtype=int, ndim=3),
        weight_out: wp.array(dtype=real, ndim=3),
        range_out: wp.array(dtype=real, ndim=3),
        total: wp.array(dtype=real, ndim=2),
    ):
        """The ``K`` largest blending weights of each pixel in front-to-back order, their Gaussians and peak ranges."""
        pixel = offset + wp.tid()
        x = pixel % view.width
        y = pixel / view.width
        tile = (y / wp.static(TILE)) * view.tiles_x + x / wp.static(TILE)
        d = pixel_direction(view, x, y)
        dx = real(d[0])
        dy = real(d[1])
        dz = real(d[2])
        transmittance = real(1.0)
        kept = int(0)
        smallest = real(0.0)
        at = int(0)
        capacity = index.shape[2]
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            u1 = rows[k, E1] * dx + rows[k, E1 + 1] * dy + rows[k, E1 + 2] * dz
            u2 = rows[k, E2] * dx + rows[k, E2 + 1] * dy + rows[k, E2 + 2] * dz
            w = rows[k, MH] * dx + rows[k, MH + 1] * dy + rows[k, MH + 2] * dz
            n = rows[k, GRAM] * u1 * u1 + rows[k, GRAM + 1] * u2 * u2
            ag = rows[k, AA] * w + rows[k, AB1] * u1 + rows[k, AB2] * u2
            gg = w * ag + u1 * (rows[k, AB1] * w + rows[k, BB11] * u1 + rows[k, BB12] * u2)
            gg = wp.max(
                gg + u2 * (rows[k, AB2] * w + rows[k, BB12] * u1 + rows[k, BB22] * u2), real(wp.static(tiny))
            )
            if n < rows[k, CUT] * gg and ag > real(0.0):
                alpha = wp.min(rows[k, OPACITY] * wp.exp(real(-0.5) * n / gg), real(rules.alpha_max))
                weight = alpha * transmittance
                if rules.rule == wp.static(PRODUCT):
                    transmittance = transmittance * (real(1.0) - alpha)
                else:
                    transmittance = transmittance * wp.exp(-alpha)
                total[y, x] = total[y, x] + weight
                place = kept
                if kept == capacity:
                    place = -1
                    if weight > smallest:
                        for c in range(at, capacity - 1):  # close the gap: the order along the ray stays
                            index[y, x, c] = index[y, x, c + 1]
                            weight_out[y, x, c] = weight_out[y, x, c + 1]
                            range_out[y, x, c] = range_out[y, x, c + 1]
                        place = capacity - 1
                if place >= 0:
                    index[y, x, place] = k
                    weight_out[y, x, place] = weight
                    range_out[y, x, place] = rows[k, RANGE] * ag / gg
                    kept = wp.min(kept + 1, capacity)
                    if kept == capacity:
                        smallest = weight_out[y, x, 0]
                        at = int(0)
                        for c in range(1, capacity):
                            if weight_out[y, x, c] < smallest:
                                smallest = weight_out[y, x, c]
                                at = c
                if transmittance <= real(rules.transmittance_min):
                    break

    @wp.kernel(module="unique", enable_backward=False)
    def mean_depth(
        offset: int,
        depth_sum: wp.array(dtype=real, ndim=2),
        alpha: wp.array(dtype=real, ndim=2),
        depth: wp.array(dtype=real, ndim=2),
    ):
        """Blended mean range; 0 where nothing is seen, so that a loss on it stays finite."""
        pixel = offset + wp.tid()
        x = pixel % alpha.shape[1]
        y = pixel / alpha.shape[1]
        if alpha[y, x] > real(0.0):
            depth[y, x] = depth_sum[y, x] / alpha[y, x]

    @wp.kernel(module="unique", enable_backward=False)
    def background_adjoint(
        offset: int,
        transmittance: wp.array(dtype=real, ndim=2),
        image_grad: wp.array(dtype=real, ndim=3),
        background_grad: wp.array(dtype=real),
    ):
        """Gradient of one background channel: the transmittance left, summed over the image."""
        c = offset + wp.tid()
        total = wp.float64(0.0)
        for y in range(transmittance.shape[0]):
            for x in range(transmittance.shape[1]):
                total += wp.float64(transmittance[y, x]) * wp.float64(image_grad[y, x, c])
        background_grad[c] = background_grad[c] + real(total)

    return SimpleNamespace(
        background_adjoint=background_adjoint,
        blend=blend,
        blend_adjoint=blend_adjoint,
        mean_depth=mean_depth,
        strongest=strongest,
    )
