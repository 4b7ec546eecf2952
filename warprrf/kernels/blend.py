"""Blending the exact responses of :mod:`warprrf.kernels.project` front to back, and the hand-written adjoint.

Adjoint: with ``y = M (t d - m)`` (so that ``q = |y|^2``) the envelope theorem gives ``dq = 2 y.(dM r - M dmean)``,
``r = M^-1 y``, and ``dt = -(g.do + (y + t g).dg)/|g|^2``. Both are symmetric in whitened coordinates: every pair adds
to a 3-vector ``Y1`` and a symmetric 3x3 ``Y2`` per Gaussian, which `chain` turns into gradients of mean, quaternion
and scale. In the turned coordinates of the linear forms ``y = (-|M m| (g1^2 + g2^2), |M m| g0 g1, |M m| g0 g2)/|g|^2``.

A thread of `blend` owns a block of 4 x 4 pixels and walks the block's list. A thread of `blend_adjoint` owns a tile:
for each Gaussian it visits the blocks that the Gaussian reaches and reduces their sums over pixels once.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.lanes import BLOCK, LANES, VECTORISED, lanes_of, lowest_bit
from warprrf.kernels.lanes import build as lane_functions
from warprrf.kernels.project import (
    CUT,
    FLAT,
    G0,
    G1,
    G2,
    INVERSE,
    LIFT,
    OPACITY,
    PRODUCT,
    REACH,
    ROW,
    TILE,
    TILT,
    Rules,
    View,
    rays_of,
)

# What is kept per block. Blended: four channels, sums of weight and of weight times range, range of the dominant peak,
# transmittance left. For the adjoint: gradients of channels and sums, what they make of all that lies behind, and again
# the transmittance left.
OF_CHANNELS, OF_WEIGHT, OF_RANGE, LEFT = 0, 4, 5, 7
PEAK = BEHIND = 6
PER_BLOCK = 8


@cache
def build(real: Any, rule: int) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``, and one transmittance rule; each is compiled
    when first launched."""
    lanes = lanes_of(real)
    integers = lanes_of(int)
    vec4 = wp.types.vector(4, real)
    coefficients = wp.types.vector(ROW, real)
    Rays = rays_of(real)
    of = lane_functions(real)
    any_positive, choose, choose_number = of.any_positive, of.choose, of.choose_number
    lower, higher, sums_of = of.lower, of.higher, of.sums
    tiny = 1.0e-30 if real is wp.float32 else 1.0e-250

    if real is wp.float32:

        @wp.func
        def response(q: lanes):
            """exp(-q/2) for q >= 0: (Taylor of exp(-q/32), degree 6)^16; absolute error below 5e-7 up to q = 60."""
            x = lower(q, lanes(real(160.0))) * real(-0.03125)
            p = lanes(real(1.0 / 120.0)) + x * real(1.0 / 720.0)
            p = lanes(real(1.0 / 24.0)) + wp.cw_mul(x, p)
            p = lanes(real(1.0 / 6.0)) + wp.cw_mul(x, p)
            p = lanes(real(0.5)) + wp.cw_mul(x, p)
            p = lanes(real(1.0)) + wp.cw_mul(x, p)
            p = lanes(real(1.0)) + wp.cw_mul(x, p)
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            return wp.cw_mul(p, p)

    else:

        @wp.func
        def response(q: lanes):
            out = lanes()
            for k in range(wp.static(LANES)):
                out[k] = wp.exp(real(-0.5) * q[k])
            return out

    @wp.func
    def forms(row: coefficients, across: lanes, along: lanes, down: lanes):
        """g0, g1, g2 on the rays of a block; the last two times |M m|."""
        g0 = row[G0] * across + row[G0 + 1] * along + row[G0 + 2] * down
        g1 = row[G1] * across + row[G1 + 1] * along + row[G1 + 2] * down
        g2 = row[G2] * across + row[G2 + 1] * along + row[G2 + 2] * down
        return g0, g1, g2

    @wp.func
    def place_of(block: int, view: View):
        """Column and row of a block, in blocks."""
        tile = block / wp.static(LANES)
        b = block % wp.static(LANES)
        column = (tile % view.tiles_x) * wp.static(TILE // BLOCK) + b % wp.static(TILE // BLOCK)
        line = (tile / view.tiles_x) * wp.static(TILE // BLOCK) + b / wp.static(TILE // BLOCK)
        return column, line

    if rule == PRODUCT:

        @wp.func
        def thinned(transmittance: lanes, alpha: lanes, weight: lanes):
            """What is left behind a layer; ``weight`` is alpha times transmittance."""
            return transmittance - weight

        @wp.func
        def behind(goal: lanes, alpha: lanes):
            """How the light from behind a layer changes with its alpha."""
            return wp.cw_div(goal, higher(lanes(real(1.0)) - alpha, lanes(real(wp.static(tiny)))))

    else:

        @wp.func
        def thinned(transmittance: lanes, alpha: lanes, weight: lanes):
            return wp.cw_mul(transmittance, response(real(2.0) * alpha))

        @wp.func
        def behind(goal: lanes, alpha: lanes):
            return goal

    @wp.func
    def ray_lengths(across: lanes, along: lanes, down: lanes):
        square = wp.cw_mul(across, across) + wp.cw_mul(along, along) + wp.cw_mul(down, down)
        for k in range(wp.static(LANES)):
            square[k] = wp.sqrt(square[k])
        return square

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def blend(
        offset: int,
        rows: wp.array(dtype=coefficients),
        features: wp.array(dtype=vec4),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        rays: Rays,
        view: View,
        rules: Rules,
        blended: wp.array(dtype=lanes, ndim=2),
        owners: wp.array(dtype=integers),
    ):
        """Blend four channels front to back; ranges are over the length of ``rays``."""
        block = offset + wp.tid()
        column, line = place_of(block, view)
        across = rays.across[column]
        along = rays.along[column]
        down = rays.down[line]
        amax = lanes(real(rules.alpha_max))
        tmin = lanes(real(rules.transmittance_min))
        one = lanes(real(1.0))
        transmittance = lanes(real(1.0))
        c0 = lanes()
        c1 = lanes()
        c2 = lanes()
        c3 = lanes()
        depth = lanes()
        total = lanes()
        best = lanes()
        peak = lanes()
        owner = integers(-1)
        for j in range(starts[block], starts[block + 1]):
            k = ids[j]
            row = rows[k]
            g0, g1, g2 = forms(row, across, along, down)
            n = wp.cw_mul(g1, g1) + wp.cw_mul(g2, g2)
            square = higher(wp.cw_mul(g0, g0) + row[FLAT] * n, lanes(real(wp.static(tiny))))
            room = lower(lower(row[CUT] * square - n, g0), transmittance - tmin)
            if not any_positive(room):
                continue
            inverse = wp.cw_div(one, square)
            alpha = choose(room, lower(row[OPACITY] * response(wp.cw_mul(n, inverse)), amax), lanes())
            weight = wp.cw_mul(alpha, transmittance)
            transmittance = thinned(transmittance, alpha, weight)
            t = wp.cw_mul(row[REACH] * g0, inverse)
            depth += wp.cw_mul(weight, t)
            total += weight
            better = weight - best
            best = higher(best, weight)
            owner = choose_number(better, k, owner)
            peak = choose(better, t, peak)
            f = features[k]
            c0 += f[0] * weight
            c1 += f[1] * weight
            c2 += f[2] * weight
            c3 += f[3] * weight
            if not any_positive(transmittance - tmin):
                break
        blended[block, OF_CHANNELS] = c0
        blended[block, OF_CHANNELS + 1] = c1
        blended[block, OF_CHANNELS + 2] = c2
        blended[block, OF_CHANNELS + 3] = c3
        blended[block, OF_WEIGHT] = total
        blended[block, OF_RANGE] = depth
        blended[block, PEAK] = peak
        blended[block, LEFT] = transmittance
        owners[block] = owner

    @wp.kernel(module="unique", enable_backward=False)
    def lay_out(
        offset: int,
        channels: int,
        first: int,
        background: wp.array(dtype=real),
        order: wp.array(dtype=int),
        rays: Rays,
        view: View,
        blended: wp.array(dtype=lanes, ndim=2),
        owners: wp.array(dtype=integers),
        image: wp.array(dtype=real),
        alpha_out: wp.array(dtype=real),
        depth_out: wp.array(dtype=real),
        transmittance_out: wp.array(dtype=real),
        dominant_out: wp.array(dtype=int),
        peak_out: wp.array(dtype=real),
    ):
        """Blocks to images, before the background."""
        block = offset + wp.tid()
        column, line = place_of(block, view)
        x0 = column * wp.static(BLOCK)
        y0 = line * wp.static(BLOCK)
        length = ray_lengths(rays.across[column], rays.along[column], rays.down[line])
        shown = wp.min(channels - first, 4)
        c0 = blended[block, OF_CHANNELS]
        c1 = blended[block, OF_CHANNELS + 1]
        c2 = blended[block, OF_CHANNELS + 2]
        c3 = blended[block, OF_CHANNELS + 3]
        total = blended[block, OF_WEIGHT]
        depth = blended[block, OF_RANGE]
        peak = blended[block, PEAK]
        transmittance = blended[block, LEFT]
        owner = owners[block]
        for lane in range(wp.static(LANES)):
            x = x0 + lane % wp.static(BLOCK)
            y = y0 + lane / wp.static(BLOCK)
            if x < view.width and y < view.height:
                pixel = y * view.width + x
                at = pixel * channels + first
                left = transmittance[lane]
                image[at] = c0[lane] + background[first] * left
                if shown > 1:
                    image[at + 1] = c1[lane] + background[first + 1] * left
                if shown > 2:
                    image[at + 2] = c2[lane] + background[first + 2] * left
                if shown > 3:
                    image[at + 3] = c3[lane] + background[first + 3] * left
                if first == 0:
                    alpha_out[pixel] = total[lane]
                    depth_out[pixel] = depth[lane] * length[lane]
                    transmittance_out[pixel] = left
                    peak_out[pixel] = peak[lane] * length[lane]
                    if owner[lane] >= 0:
                        dominant_out[pixel] = order[owner[lane]]

    @wp.kernel(module="unique", enable_backward=False)
    def seed_adjoint(
        offset: int,
        channels: int,
        first: int,
        rays: Rays,
        view: View,
        image: wp.array(dtype=real),
        alpha_sum: wp.array(dtype=real),
        depth_sum: wp.array(dtype=real),
        image_grad: wp.array(dtype=real),
        alpha_grad: wp.array(dtype=real),
        depth_grad: wp.array(dtype=real),
        seeds: wp.array(dtype=lanes, ndim=2),
    ):
        """What `blend_adjoint` starts from, block by block."""
        block = offset + wp.tid()
        column, line = place_of(block, view)
        x0 = column * wp.static(BLOCK)
        y0 = line * wp.static(BLOCK)
        length = ray_lengths(rays.across[column], rays.along[column], rays.down[line])
        v0 = lanes()
        v1 = lanes()
        v2 = lanes()
        v3 = lanes()
        vt = lanes()
        va = lanes()
        goal = lanes()
        shown = wp.min(channels - first, 4)
        for lane in range(wp.static(LANES)):
            x = x0 + lane % wp.static(BLOCK)
            y = y0 + lane / wp.static(BLOCK)
            if x < view.width and y < view.height:
                pixel = y * view.width + x
                at = pixel * channels + first
                v0[lane] = image_grad[at]
                r = v0[lane] * image[at]
                if shown > 1:
                    v1[lane] = image_grad[at + 1]
                    r += v1[lane] * image[at + 1]
                if shown > 2:
                    v2[lane] = image_grad[at + 2]
                    r += v2[lane] * image[at + 2]
                if shown > 3:
                    v3[lane] = image_grad[at + 3]
                    r += v3[lane] * image[at + 3]
                a = alpha_sum[pixel]
                if first == 0 and a > real(0.0):
                    vd = depth_grad[pixel] / a
                    vt[lane] = vd * length[lane]
                    va[lane] = alpha_grad[pixel] - vd * depth_sum[pixel] / a
                    r += vd * depth_sum[pixel] + va[lane] * a
                goal[lane] = r
        seeds[block, OF_CHANNELS] = v0
        seeds[block, OF_CHANNELS + 1] = v1
        seeds[block, OF_CHANNELS + 2] = v2
        seeds[block, OF_CHANNELS + 3] = v3
        seeds[block, OF_WEIGHT] = va
        seeds[block, OF_RANGE] = vt
        seeds[block, BEHIND] = goal
        seeds[block, LEFT] = lanes(real(1.0))

    def adjoint_kernel(with_range: bool) -> Any:
        @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
        def blend_adjoint(
            offset: int,
            parts: int,
            bounds: wp.array(dtype=int),
            rows: wp.array(dtype=coefficients),
            features: wp.array(dtype=vec4),
            ids: wp.array(dtype=int),
            masks: wp.array(dtype=int),
            starts: wp.array(dtype=int),
            rays: Rays,
            view: View,
            rules: Rules,
            seeds: wp.array(dtype=lanes, ndim=2),
            sums: wp.array(dtype=coefficients, ndim=2),
        ):
            """Same walk as `blend`; adds each Gaussian's gradient in a tile to ``sums[piece, Gaussian]``.

            dL/da_i = T_i x_i - (R - sum_{j<=i} w_j x_j) / (1 - a_i), x the gradient dotted with the pair's features, R the
            same dotted with the finished pixel; without the division for the exponential rule. A tile is shared among
            ``parts`` threads (1 or 16), and piece p holds the threads ``bounds[p] .. bounds[p + 1]``.
            """
            thread = offset + wp.tid()
            piece = int(0)
            while thread >= bounds[piece + 1]:
                piece += 1
            tile = thread / parts
            share = wp.static(LANES) / parts
            open = ((1 << share) - 1) << (share * (thread % parts))
            column0 = (tile % view.tiles_x) * wp.static(TILE // BLOCK)
            line0 = (tile / view.tiles_x) * wp.static(TILE // BLOCK)
            block0 = tile * wp.static(LANES)
            amax = lanes(real(rules.alpha_max))
            tmin = lanes(real(rules.transmittance_min))
            one = lanes(real(1.0))
            for j in range(starts[tile], starts[tile + 1]):
                mask = masks[j] & open
                if mask == 0:
                    continue
                k = ids[j]
                row = rows[k]
                f = features[k]
                s0 = lanes()
                s1 = lanes()
                s2 = lanes()
                s3 = lanes()
                s4 = lanes()
                s5 = lanes()
                s6 = lanes()
                s7 = lanes()
                s8 = lanes()
                s9 = lanes()
                s10 = lanes()
                s11 = lanes()
                s12 = lanes()
                s13 = lanes()
                s14 = lanes()
                while mask != 0:
                    b = lowest_bit(mask)
                    mask = mask & (mask - 1)
                    column = column0 + b % wp.static(TILE // BLOCK)
                    line = line0 + b / wp.static(TILE // BLOCK)
                    block = block0 + b
                    g0, g1, g2 = forms(row, rays.across[column], rays.along[column], rays.down[line])
                    transmittance = seeds[block, LEFT]
                    n = wp.cw_mul(g1, g1) + wp.cw_mul(g2, g2)
                    square = higher(wp.cw_mul(g0, g0) + row[FLAT] * n, lanes(real(wp.static(tiny))))
                    room = lower(lower(row[CUT] * square - n, g0), transmittance - tmin)
                    if not any_positive(room):
                        continue
                    inverse = wp.cw_div(one, square)
                    raw = choose(room, response(wp.cw_mul(n, inverse)), lanes())
                    free = choose(
                        row[OPACITY] * raw - amax, lanes(), raw
                    )  # response where alpha is not clamped
                    alpha = lower(row[OPACITY] * raw, amax)
                    weight = wp.cw_mul(alpha, transmittance)
                    t = wp.cw_mul(row[REACH] * g0, inverse)
                    v0 = seeds[block, OF_CHANNELS]
                    v1 = seeds[block, OF_CHANNELS + 1]
                    v2 = seeds[block, OF_CHANNELS + 2]
                    v3 = seeds[block, OF_CHANNELS + 3]
                    vt = seeds[block, OF_RANGE]
                    value = (
                        f[0] * v0
                        + f[1] * v1
                        + f[2] * v2
                        + f[3] * v3
                        + wp.cw_mul(vt, t)
                        + seeds[block, OF_WEIGHT]
                    )
                    goal = seeds[block, BEHIND] - wp.cw_mul(weight, value)
                    seeds[block, BEHIND] = goal
                    slope = wp.cw_mul(
                        wp.cw_mul(transmittance, value) - behind(goal, alpha), free
                    )  # times opacity: dL/d ln alpha
                    left = thinned(transmittance, alpha, weight)
                    seeds[block, LEFT] = left
                    v = (real(-0.5) * row[OPACITY]) * slope  # dL/dq
                    y0 = (-row[INVERSE]) * wp.cw_mul(n, inverse)
                    lever = wp.cw_mul(g0, inverse)
                    y1 = wp.cw_mul(lever, g1)
                    y2 = wp.cw_mul(lever, g2)
                    p0 = wp.cw_mul(v, y0)
                    p1 = wp.cw_mul(v, y1)
                    p2 = wp.cw_mul(v, y2)
                    s3 += wp.cw_mul(p0, y0)
                    s4 += wp.cw_mul(p0, y1)
                    s5 += wp.cw_mul(p0, y2)
                    s6 += wp.cw_mul(p1, y1)
                    s7 += wp.cw_mul(p1, y2)
                    s8 += wp.cw_mul(p2, y2)
                    s0 += p0
                    s1 += p1
                    s2 += p2
                    s9 += slope
                    s10 += wp.cw_mul(weight, v0)
                    s11 += wp.cw_mul(weight, v1)
                    s12 += wp.cw_mul(weight, v2)
                    s13 += wp.cw_mul(weight, v3)
                    s14 += weight
                    if wp.static(with_range):
                        half = wp.cw_mul(wp.cw_mul(weight, vt), inverse)
                        h0 = row[LIFT] * wp.cw_mul(half, g0)
                        h1 = row[TILT] * wp.cw_mul(half, g1)
                        h2 = row[TILT] * wp.cw_mul(half, g2)
                        s0 -= h0
                        s1 -= h1
                        s2 -= h2
                        s3 -= real(2.0) * wp.cw_mul(h0, y0)
                        s4 -= wp.cw_mul(h0, y1) + wp.cw_mul(h1, y0)
                        s5 -= wp.cw_mul(h0, y2) + wp.cw_mul(h2, y0)
                        s6 -= real(2.0) * wp.cw_mul(h1, y1)
                        s7 -= wp.cw_mul(h1, y2) + wp.cw_mul(h2, y1)
                        s8 -= real(2.0) * wp.cw_mul(h2, y2)
                    if not any_positive(left - tmin):
                        open = open & (-1 - (1 << b))
                found = sums_of(s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12, s13, s14, lanes())
                wp.atomic_add(sums, piece, k, found)

        return blend_adjoint

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def strongest(
        offset: int,
        rows: wp.array(dtype=coefficients),
        order: wp.array(dtype=int),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        rays: Rays,
        view: View,
        rules: Rules,
        capacity: int,
        count: int,
        index: wp.array(dtype=int),
        weight_out: wp.array(dtype=real),
        range_out: wp.array(dtype=real),
        total_out: wp.array(dtype=real),
    ):
        """The ``capacity`` largest blending weights of each pixel in front-to-back order, their Gaussians and peak
        ranges."""
        block = offset + wp.tid()
        column, line = place_of(block, view)
        across = rays.across[column]
        along = rays.along[column]
        down = rays.down[line]
        length = ray_lengths(across, along, down)
        x0 = column * wp.static(BLOCK)
        y0 = line * wp.static(BLOCK)
        amax = lanes(real(rules.alpha_max))
        tmin = lanes(real(rules.transmittance_min))
        one = lanes(real(1.0))
        transmittance = lanes(real(1.0))
        total = lanes()
        kept = integers()
        smallest = lanes()
        at = integers()
        for j in range(starts[block], starts[block + 1]):
            k = ids[j]
            row = rows[k]
            g0, g1, g2 = forms(row, across, along, down)
            n = wp.cw_mul(g1, g1) + wp.cw_mul(g2, g2)
            square = higher(wp.cw_mul(g0, g0) + row[FLAT] * n, lanes(real(wp.static(tiny))))
            room = lower(lower(row[CUT] * square - n, g0), transmittance - tmin)
            if not any_positive(room):
                continue
            inverse = wp.cw_div(one, square)
            alpha = choose(room, lower(row[OPACITY] * response(wp.cw_mul(n, inverse)), amax), lanes())
            weight = wp.cw_mul(alpha, transmittance)
            transmittance = thinned(transmittance, alpha, weight)
            total += weight
            t = wp.cw_mul(wp.cw_mul(row[REACH] * g0, inverse), length)
            for lane in range(count):
                x = x0 + lane % wp.static(BLOCK)
                y = y0 + lane / wp.static(BLOCK)
                if weight[lane] > smallest[lane] and x < view.width and y < view.height:
                    first = (y * view.width + x) * capacity
                    place = kept[lane]
                    if place == capacity:
                        for c in range(
                            at[lane], capacity - 1
                        ):  # close the gap: the order along the ray stays
                            index[first + c] = index[first + c + 1]
                            weight_out[first + c] = weight_out[first + c + 1]
                            range_out[first + c] = range_out[first + c + 1]
                        place = capacity - 1
                    index[first + place] = order[k]
                    weight_out[first + place] = weight[lane]
                    range_out[first + place] = t[lane]
                    kept[lane] = place + 1
                    if place + 1 == capacity:
                        least = weight_out[first]
                        where = int(0)
                        for c in range(1, capacity):
                            if weight_out[first + c] < least:
                                least = weight_out[first + c]
                                where = c
                        smallest[lane] = least
                        at[lane] = where
            if not any_positive(transmittance - tmin):
                break
        for lane in range(wp.static(LANES)):
            x = x0 + lane % wp.static(BLOCK)
            y = y0 + lane / wp.static(BLOCK)
            if x < view.width and y < view.height:
                total_out[y * view.width + x] = total[lane]

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
        blend_adjoint=(adjoint_kernel(False), adjoint_kernel(True)),  # with or without gradients of ranges
        mean_depth=mean_depth,
        lay_out=lay_out,
        seed_adjoint=seed_adjoint,
        strongest=strongest,
    )
