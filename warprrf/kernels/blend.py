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
    any_positive, above, above_number, lower, higher = of.any_positive, of.above, of.above_number, of.lower, of.higher
    sums_of, take, put, read, read4, write = of.sums, of.take, of.put, of.read, of.read4, of.write
    tiny = 1.0e-30 if real is wp.float32 else 1.0e-250

    if real is wp.float32:

        @wp.func
        def response(q: lanes):
            """exp(-q/2) for 0 <= q <= 80: (Taylor of exp(-q/32), degree 5)^16; absolute error below 1e-6."""
            x = q * real(-0.03125)
            p = lanes(real(1.0 / 24.0)) + x * real(1.0 / 120.0)
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
        blended: wp.array(dtype=lanes),
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
            row = read(rows, k)
            g0, g1, g2 = forms(row, across, along, down)
            n = wp.cw_mul(g1, g1) + wp.cw_mul(g2, g2)
            square = higher(wp.cw_mul(g0, g0) + row[FLAT] * n, lanes(real(wp.static(tiny))))
            room = lower(lower(row[CUT] * square - n, g0), transmittance - tmin)
            if not any_positive(room):
                if not any_positive(transmittance - tmin):
                    break
                continue
            inverse = wp.cw_div(one, square)
            alpha = above(room, lanes(), lower(row[OPACITY] * response(wp.cw_mul(n, inverse)), amax), lanes())
            weight = wp.cw_mul(alpha, transmittance)
            transmittance = thinned(transmittance, alpha, weight)
            t = wp.cw_mul(row[REACH] * g0, inverse)
            depth += wp.cw_mul(weight, t)
            total += weight
            owner = above_number(weight, best, k, owner)
            peak = above(weight, best, t, peak)
            best = higher(best, weight)
            f = read4(features, k)
            c0 += f[0] * weight
            c1 += f[1] * weight
            c2 += f[2] * weight
            c3 += f[3] * weight
        blended[block * wp.static(PER_BLOCK) + wp.static(OF_CHANNELS)] = c0
        blended[block * wp.static(PER_BLOCK) + wp.static(OF_CHANNELS + 1)] = c1
        blended[block * wp.static(PER_BLOCK) + wp.static(OF_CHANNELS + 2)] = c2
        blended[block * wp.static(PER_BLOCK) + wp.static(OF_CHANNELS + 3)] = c3
        blended[block * wp.static(PER_BLOCK) + wp.static(OF_WEIGHT)] = total
        blended[block * wp.static(PER_BLOCK) + wp.static(OF_RANGE)] = depth
        blended[block * wp.static(PER_BLOCK) + wp.static(PEAK)] = peak
        blended[block * wp.static(PER_BLOCK) + wp.static(LEFT)] = transmittance
        owners[block] = owner

    @wp.func
    def line_of(thread: int, view: View):
        """A tile's line of pixels: its first column, its row, the first of its four blocks, and its place in a block."""
        tile = thread / wp.static(TILE)
        down = thread % wp.static(TILE)
        block = tile * wp.static(LANES) + (down / wp.static(BLOCK)) * wp.static(TILE // BLOCK)
        x = (tile % view.tiles_x) * wp.static(TILE)
        y = (tile / view.tiles_x) * wp.static(TILE) + down
        return x, y, block, (down % wp.static(BLOCK)) * wp.static(BLOCK)

    @wp.kernel(module="unique", enable_backward=False)
    def lay_out(
        offset: int,
        channels: int,
        first: int,
        background: wp.array(dtype=real),
        order: wp.array(dtype=int),
        rays: Rays,
        view: View,
        blended: wp.array(dtype=real),
        owners: wp.array(dtype=int),
        image: wp.array(dtype=real),
        alpha_out: wp.array(dtype=real),
        depth_out: wp.array(dtype=real),
        depth_sum_out: wp.array(dtype=real),
        transmittance_out: wp.array(dtype=real),
        dominant_out: wp.array(dtype=int),
        peak_out: wp.array(dtype=real),
    ):
        """Blocks to images, before the background; a thread lays out a tile's line of pixels.

        The mean range is 0 where nothing is seen, so that a loss on it stays finite.
        """
        x0, y, block0, inset = line_of(offset + wp.tid(), view)
        if y >= view.height:
            return
        shown = wp.min(channels - first, 4)
        square_down = rays.square_down[y]
        for b in range(wp.min((view.width - x0 + 3) / 4, 4)):
            x = x0 + b * 4
            n = wp.min(view.width - x, 4)
            pixel = y * view.width + x
            at = (block0 + b) * wp.static(PER_BLOCK * LANES) + inset
            left = take(blended, at + wp.static(LEFT * LANES), 1, 4)
            for c in range(shown):
                color = take(blended, at + wp.static(OF_CHANNELS * LANES) + c * wp.static(LANES), 1, 4)
                put(image, pixel * channels + first + c, channels, n, color + background[first + c] * left)
            if first == 0:
                length = take(rays.square_across, x, 1, 4)
                alpha = take(blended, at + wp.static(OF_WEIGHT * LANES), 1, 4)
                depth = take(blended, at + wp.static(OF_RANGE * LANES), 1, 4)
                peak = take(blended, at + wp.static(PEAK * LANES), 1, 4)
                mean = vec4()
                for i in range(4):
                    length[i] = wp.sqrt(length[i] + square_down)
                    depth[i] = depth[i] * length[i]
                    peak[i] = peak[i] * length[i]
                    mean[i] = depth[i] / wp.where(alpha[i] > real(0.0), alpha[i], real(1.0))
                put(alpha_out, pixel, 1, n, alpha)
                put(depth_sum_out, pixel, 1, n, depth)
                put(depth_out, pixel, 1, n, mean)
                put(transmittance_out, pixel, 1, n, left)
                put(peak_out, pixel, 1, n, peak)
                for i in range(n):
                    owner = owners[(block0 + b) * wp.static(LANES) + inset + i]
                    if owner >= 0:
                        owner = order[owner]
                    dominant_out[pixel + i] = owner

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
        seeds: wp.array(dtype=real),
    ):
        """What `blend_adjoint` starts from: images to blocks; a thread takes a tile's line of pixels."""
        x0, y, block0, inset = line_of(offset + wp.tid(), view)
        shown = wp.min(channels - first, 4)
        for b in range(4):
            x = x0 + b * 4
            n = wp.clamp(view.width - x, 0, 4)
            if y >= view.height:
                n = int(0)
            pixel = y * view.width + x
            at = (block0 + b) * wp.static(PER_BLOCK * LANES) + inset
            goal = vec4()
            for c in range(4):
                v = vec4()
                if c < shown:
                    v = take(image_grad, pixel * channels + first + c, channels, n)
                    goal += wp.cw_mul(v, take(image, pixel * channels + first + c, channels, n))
                put(seeds, at + wp.static(OF_CHANNELS * LANES) + c * wp.static(LANES), 1, 4, v)
            vt = vec4()
            va = vec4()
            if first == 0:
                sums = take(alpha_sum, pixel, 1, n)
                depths = take(depth_sum, pixel, 1, n)
                wanted = take(depth_grad, pixel, 1, n)
                va = take(alpha_grad, pixel, 1, n)
                for i in range(4):
                    seen = sums[i] > real(0.0)
                    vd = wp.where(seen, wanted[i] / wp.where(seen, sums[i], real(1.0)), real(0.0))
                    va[i] = wp.where(seen, va[i], real(0.0)) - vd * depths[i] / wp.where(seen, sums[i], real(1.0))
                    goal[i] = goal[i] + vd * depths[i] + va[i] * sums[i]
                    vt[i] = vd
                if n > 0:
                    length = take(rays.square_across, x, 1, 4)
                    for i in range(4):
                        vt[i] = vt[i] * wp.sqrt(length[i] + rays.square_down[y])
            put(seeds, at + wp.static(OF_WEIGHT * LANES), 1, 4, va)
            put(seeds, at + wp.static(OF_RANGE * LANES), 1, 4, vt)
            put(seeds, at + wp.static(BEHIND * LANES), 1, 4, goal)
            put(seeds, at + wp.static(LEFT * LANES), 1, 4, vec4(real(1.0)))

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
            seeds: wp.array(dtype=lanes),
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
                    # Read again for each block: operands in memory cost nothing, registers are for the sums.
                    row = read(rows, k)
                    f = read4(features, k)
                    column = column0 + b % wp.static(TILE // BLOCK)
                    line = line0 + b / wp.static(TILE // BLOCK)
                    at = (block0 + b) * wp.static(PER_BLOCK)
                    g0, g1, g2 = forms(
                        row, read(rays.across, column), read(rays.along, column), read(rays.down, line)
                    )
                    transmittance = read(seeds, at + wp.static(LEFT))
                    n = wp.cw_mul(g1, g1) + wp.cw_mul(g2, g2)
                    square = higher(wp.cw_mul(g0, g0) + row[FLAT] * n, lanes(real(wp.static(tiny))))
                    room = lower(lower(row[CUT] * square - n, g0), transmittance - tmin)
                    if not any_positive(room):
                        continue
                    inverse = wp.cw_div(one, square)
                    q = wp.cw_mul(n, inverse)
                    lever = wp.cw_mul(g0, inverse)
                    kept = above(room, lanes(), response(q), lanes())
                    raw = row[OPACITY] * kept
                    free = above(raw, amax, lanes(), kept)  # the response where alpha is not clamped
                    alpha = lower(raw, amax)
                    weight = wp.cw_mul(alpha, transmittance)
                    v0 = read(seeds, at + wp.static(OF_CHANNELS))
                    v1 = read(seeds, at + wp.static(OF_CHANNELS + 1))
                    v2 = read(seeds, at + wp.static(OF_CHANNELS + 2))
                    v3 = read(seeds, at + wp.static(OF_CHANNELS + 3))
                    value = f[0] * v0 + f[1] * v1 + f[2] * v2 + f[3] * v3 + read(seeds, at + wp.static(OF_WEIGHT))
                    if wp.static(with_range):
                        vt = wp.cw_mul(weight, read(seeds, at + wp.static(OF_RANGE)))
                        value += row[REACH] * wp.cw_mul(lever, read(seeds, at + wp.static(OF_RANGE)))
                    goal = read(seeds, at + wp.static(BEHIND)) - wp.cw_mul(weight, value)
                    write(seeds, at + wp.static(BEHIND), goal)
                    # dL/da times the response: dL/d opacity
                    slope = wp.cw_mul(wp.cw_mul(transmittance, value) - behind(goal, alpha), free)
                    left = thinned(transmittance, alpha, weight)
                    write(seeds, at + wp.static(LEFT), left)
                    v = (real(-0.5) * row[OPACITY]) * slope  # dL/dq
                    y0 = (-row[INVERSE]) * q
                    y1 = wp.cw_mul(lever, g1)
                    y2 = wp.cw_mul(lever, g2)
                    p0 = wp.cw_mul(v, y0)
                    p1 = wp.cw_mul(v, y1)
                    p2 = wp.cw_mul(v, y2)
                    s0 += wp.cw_mul(v, q)
                    s1 += p1
                    s2 += p2
                    s3 += wp.cw_mul(p0, y0)
                    s4 += wp.cw_mul(p0, y1)
                    s5 += wp.cw_mul(p0, y2)
                    s6 += wp.cw_mul(p1, y1)
                    s7 += wp.cw_mul(p1, y2)
                    s9 += slope
                    s10 += wp.cw_mul(weight, v0)
                    s11 += wp.cw_mul(weight, v1)
                    s12 += wp.cw_mul(weight, v2)
                    s13 += wp.cw_mul(weight, v3)
                    s14 += weight
                    if wp.static(with_range):
                        half = wp.cw_mul(vt, inverse)
                        h0 = row[LIFT] * wp.cw_mul(half, g0)
                        h1 = row[TILT] * wp.cw_mul(half, g1)
                        h2 = row[TILT] * wp.cw_mul(half, g2)
                        s1 -= h1
                        s2 -= h2
                        s3 -= real(2.0) * wp.cw_mul(h0, y0)
                        s4 -= wp.cw_mul(h0, y1) + wp.cw_mul(h1, y0)
                        s5 -= wp.cw_mul(h0, y2) + wp.cw_mul(h2, y0)
                        s6 -= real(2.0) * wp.cw_mul(h1, y1)
                        s7 -= wp.cw_mul(h1, y2) + wp.cw_mul(h2, y1)
                        s8 += h0
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
            row = read(rows, k)
            g0, g1, g2 = forms(row, across, along, down)
            n = wp.cw_mul(g1, g1) + wp.cw_mul(g2, g2)
            square = higher(wp.cw_mul(g0, g0) + row[FLAT] * n, lanes(real(wp.static(tiny))))
            room = lower(lower(row[CUT] * square - n, g0), transmittance - tmin)
            if not any_positive(room):
                if not any_positive(transmittance - tmin):
                    break
                continue
            inverse = wp.cw_div(one, square)
            alpha = above(room, lanes(), lower(row[OPACITY] * response(wp.cw_mul(n, inverse)), amax), lanes())
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
        for lane in range(wp.static(LANES)):
            x = x0 + lane % wp.static(BLOCK)
            y = y0 + lane / wp.static(BLOCK)
            if x < view.width and y < view.height:
                total_out[y * view.width + x] = total[lane]

    @wp.kernel(module="unique", enable_backward=False)
    def background_adjoint(
        offset: int,
        transmittance: wp.array(dtype=real, ndim=2),
        image_grad: wp.array(dtype=real, ndim=3),
        of_rows: wp.array(dtype=wp.float64, ndim=2),
    ):
        """Gradient of the background, row by row of the image: the transmittance left times what each pixel wants."""
        y = offset + wp.tid()
        for c in range(image_grad.shape[2]):
            total = wp.float64(0.0)
            for x in range(transmittance.shape[1]):
                total += wp.float64(transmittance[y, x]) * wp.float64(image_grad[y, x, c])
            of_rows[y, c] = total

    @wp.kernel(module="unique", enable_backward=False)
    def add_rows(
        offset: int, of_rows: wp.array(dtype=wp.float64, ndim=2), background_grad: wp.array(dtype=real)
    ):
        c = offset + wp.tid()
        total = wp.float64(0.0)
        for y in range(of_rows.shape[0]):
            total += of_rows[y, c]
        background_grad[c] = background_grad[c] + real(total)

    return SimpleNamespace(
        add_rows=add_rows,
        background_adjoint=background_adjoint,
        blend=blend,
        blend_adjoint=(adjoint_kernel(False), adjoint_kernel(True)),  # with or without gradients of ranges
        lay_out=lay_out,
        seed_adjoint=seed_adjoint,
        strongest=strongest,
    )
