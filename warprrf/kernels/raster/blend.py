"""Blending the exact responses of :mod:`warprrf.kernels.raster.project` front to back, and the hand-written adjoint.

Adjoint: with ``y = M (t d - m)`` (so that ``q = |y|^2``) the envelope theorem gives ``dq = 2 y.(dM r - M dmean)``,
``r = M^-1 y``, and ``dt = -(g.do + (y + t g).dg)/|g|^2``. Both are symmetric in whitened coordinates: every pair adds
to a 3-vector ``Y1`` and a symmetric 3x3 ``Y2`` per Gaussian, which `chain` turns into gradients of mean, quaternion
and scale. In the turned coordinates of the linear forms ``y = (-|M m| (g1^2 + g2^2), |M m| g0 g1, |M m| g0 g2)/|g|^2``.

A thread of `blend` owns a block of 4 x 4 pixels and walks the block's list. A thread of `blend_adjoint` owns a tile:
for each Gaussian it visits the blocks that the Gaussian reaches and reduces their sums over pixels once.

Who adds where: a pair of Gaussian and tile has a slot of its own, which the tile's thread writes; `chain` adds up a
Gaussian's slots, so no two threads ever meet at an address. A GPU blends by :mod:`.blend_pixels`.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import BLOCK, LANES, VECTORISED, lanes_of, lowest_bit
from warprrf.kernels.raster.lanes import build as lane_functions
from warprrf.kernels.raster.project import (
    CHANNELS,
    CUT,
    FLAT,
    LIFT,
    OPACITY,
    REACH,
    ROW,
    TILE,
    TILT,
    Rules,
    View,
    rays_of,
)
from warprrf.kernels.raster.response import build as response_functions

# What `blend_adjoint` keeps per block: gradients of the channels, of the sums of weight and of weight times range, what
# they make of all that lies behind, and the transmittance left.
OF_CHANNELS, OF_WEIGHT, OF_RANGE, BEHIND, LEFT = 0, 4, 5, 6, 7
PER_BLOCK = 8


@cache
def build(real: Any, rule: int, width: int = CHANNELS) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``, one transmittance rule, and 1 to 4 channels at
    once; each is compiled when first launched."""
    lanes = lanes_of(real)
    integers = lanes_of(int)
    coefficients = wp.types.vector(ROW, real)
    Rays = rays_of(real)
    of = lane_functions(real)
    any_positive, above, above_number, lower, higher = (
        of.any_positive,
        of.above,
        of.above_number,
        of.lower,
        of.higher,
    )
    sums_of, read, write, number = of.sums, of.read, of.write, of.number
    collect, inside, spread, spread_numbers = of.collect, of.inside, of.spread, of.spread_numbers
    shared = response_functions(real, rule)
    behind, forms, place_of, response = shared.behind, shared.forms, shared.place_of, shared.response
    ray_lengths, thinned, tiny = shared.ray_lengths, shared.thinned, shared.tiny

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def blend(
        offset: int,
        rows: wp.array(dtype=coefficients),
        features: wp.array(dtype=real),
        channels: int,
        first: int,
        background: wp.array(dtype=real),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        rays: Rays,
        view: View,
        rules: Rules,
        image: wp.array(dtype=real),
        alpha_out: wp.array(dtype=real),
        depth_out: wp.array(dtype=real),
        transmittance_out: wp.array(dtype=real),
        dominant_out: wp.array(dtype=int),
        peak_out: wp.array(dtype=real),
    ):
        """Blend ``width`` channels from ``first`` front to back.

        The mean range ``depth_out`` is 0 where nothing is seen, so that a loss on it stays finite.
        """
        block = offset + wp.tid()
        column, line = place_of(block, view)
        if column * wp.static(BLOCK) >= view.width or line * wp.static(BLOCK) >= view.height:
            return
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
            f = k * channels + first
            c0 += number(features, f) * weight
            if wp.static(width > 1):
                c1 += number(features, f + 1) * weight
            if wp.static(width > 2):
                c2 += number(features, f + 2) * weight
            if wp.static(width > 3):
                c3 += number(features, f + 3) * weight
        x = column * wp.static(BLOCK)
        y = line * wp.static(BLOCK)
        columns = wp.min(view.width - x, wp.static(BLOCK))
        lines = wp.min(view.height - y, wp.static(BLOCK))
        pixel = y * view.width + x
        at = pixel * channels + first
        step = view.width * channels
        spread(image, at, step, channels, columns, lines, c0 + background[first] * transmittance)
        if wp.static(width > 1):
            spread(image, at + 1, step, channels, columns, lines, c1 + background[first + 1] * transmittance)
        if wp.static(width > 2):
            spread(image, at + 2, step, channels, columns, lines, c2 + background[first + 2] * transmittance)
        if wp.static(width > 3):
            spread(image, at + 3, step, channels, columns, lines, c3 + background[first + 3] * transmittance)
        if first == 0:
            length = ray_lengths(across, along, down)
            mean = wp.cw_div(wp.cw_mul(depth, length), above(total, lanes(), total, one))
            spread(alpha_out, pixel, view.width, 1, columns, lines, total)
            spread(depth_out, pixel, view.width, 1, columns, lines, mean)
            spread(transmittance_out, pixel, view.width, 1, columns, lines, transmittance)
            spread(peak_out, pixel, view.width, 1, columns, lines, wp.cw_mul(peak, length))
            spread_numbers(dominant_out, pixel, view.width, 1, columns, lines, owner)

    @wp.func
    def seed_sums(
        seeds: wp.array(dtype=lanes),
        at: int,
        pixel: int,
        columns: int,
        lines: int,
        x: int,
        y: int,
        rays: Rays,
        view: View,
        alphas: wp.array(dtype=real),
        ranges: wp.array(dtype=real),
        alpha_grad: wp.array(dtype=real),
        depth_grad: wp.array(dtype=real),
    ):
        """Gradients of a block's sums of weight and of weight times range, which are alpha and alpha times the mean
        range; returned is what they make of the whole pixel."""
        total = collect(alphas, pixel, view.width, 1, columns, lines)
        mean = collect(ranges, pixel, view.width, 1, columns, lines)
        of_weight = above(total, lanes(), collect(alpha_grad, pixel, view.width, 1, columns, lines), lanes())
        of_range = wp.cw_div(
            above(total, lanes(), collect(depth_grad, pixel, view.width, 1, columns, lines), lanes()),
            above(total, lanes(), total, lanes(real(1.0))),
        )
        whole = wp.cw_mul(total, of_weight)
        of_weight -= wp.cw_mul(of_range, mean)
        length = ray_lengths(
            read(rays.across, x / wp.static(BLOCK)),
            read(rays.along, x / wp.static(BLOCK)),
            read(rays.down, y / wp.static(BLOCK)),
        )
        write(seeds, at + wp.static(OF_WEIGHT), of_weight)
        write(seeds, at + wp.static(OF_RANGE), wp.cw_mul(of_range, length))
        return whole

    def adjoint_kernel(with_range: bool) -> Any:
        @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
        def blend_adjoint(
            offset: int,
            bounds: wp.array(dtype=int),
            rows: wp.array(dtype=coefficients),
            features: wp.array(dtype=real),
            channels: int,
            first: int,
            ids: wp.array(dtype=int),
            slots: wp.array(dtype=int),
            masks: wp.array(dtype=int),
            starts: wp.array(dtype=int),
            rays: Rays,
            view: View,
            rules: Rules,
            image: wp.array(dtype=real),
            alphas: wp.array(dtype=real),
            ranges: wp.array(dtype=real),
            remaining: wp.array(dtype=real),
            image_grad: wp.array(dtype=real),
            alpha_grad: wp.array(dtype=real),
            depth_grad: wp.array(dtype=real),
            seeds: wp.array(dtype=lanes),
            sums: wp.array(dtype=coefficients),
            background_sums: wp.array(dtype=coefficients),
        ):
            """Same walk as `blend`; leaves each Gaussian's gradient in a tile in ``sums[slot of the entry]``.

            dL/da_i = T_i x_i - (R - sum_{j<=i} w_j x_j) / (1 - a_i), x the gradient dotted with the pair's features, R
            the same dotted with the finished pixel; without the division for the exponential rule. Tiles
            ``bounds[p] .. bounds[p + 1]`` run one after the other and share ``seeds``.
            """
            tile = offset + wp.tid()
            open = int(wp.static((1 << LANES) - 1))
            place = int(0)
            while tile >= bounds[place + 1]:
                place += 1
            seed0 = place * wp.static(LANES * PER_BLOCK)
            column0 = (tile % view.tiles_x) * wp.static(TILE // BLOCK)
            line0 = (tile / view.tiles_x) * wp.static(TILE // BLOCK)
            amax = lanes(real(rules.alpha_max))
            tmin = lanes(real(rules.transmittance_min))
            one = lanes(real(1.0))
            w0 = lanes()
            w1 = lanes()
            w2 = lanes()
            w3 = lanes()
            unseeded = open
            while unseeded != 0:
                b = lowest_bit(unseeded)
                unseeded = unseeded & (unseeded - 1)
                at = seed0 + b * wp.static(PER_BLOCK)
                x = (column0 + b % wp.static(TILE // BLOCK)) * wp.static(BLOCK)
                y = (line0 + b / wp.static(TILE // BLOCK)) * wp.static(BLOCK)
                columns = wp.clamp(view.width - x, 0, wp.static(BLOCK))
                lines = wp.clamp(view.height - y, 0, wp.static(BLOCK))
                pixel = y * view.width + x
                step = view.width * channels
                here = collect(remaining, pixel, view.width, 1, columns, lines)
                goal = lanes()
                if first == 0:
                    goal = seed_sums(
                        seeds,
                        at,
                        pixel,
                        columns,
                        lines,
                        x,
                        y,
                        rays,
                        view,
                        alphas,
                        ranges,
                        alpha_grad,
                        depth_grad,
                    )
                else:
                    write(seeds, at + wp.static(OF_WEIGHT), lanes())
                    write(seeds, at + wp.static(OF_RANGE), lanes())
                for c in range(wp.static(width)):
                    source = pixel * channels + first + c
                    v = collect(image_grad, source, step, channels, columns, lines)
                    goal += wp.cw_mul(v, collect(image, source, step, channels, columns, lines))
                    write(seeds, at + wp.static(OF_CHANNELS) + c, v)
                    if wp.static(c == 0):
                        w0 += wp.cw_mul(v, here)
                    if wp.static(c == 1):
                        w1 += wp.cw_mul(v, here)
                    if wp.static(c == 2):
                        w2 += wp.cw_mul(v, here)
                    if wp.static(c == 3):
                        w3 += wp.cw_mul(v, here)
                write(seeds, at + wp.static(BEHIND), goal)
                write(seeds, at + wp.static(LEFT), inside(columns, lines))
            zero = lanes()
            write(
                background_sums,
                tile,
                sums_of(
                    w0, w1, w2, w3, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
                ),
            )
            for j in range(starts[tile], starts[tile + 1]):
                mask = masks[j] & open
                if mask == 0:
                    write(sums, slots[j], lanes())
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
                    f = k * channels + first
                    column = column0 + b % wp.static(TILE // BLOCK)
                    line = line0 + b / wp.static(TILE // BLOCK)
                    at = seed0 + b * wp.static(PER_BLOCK)
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
                    value = number(features, f) * v0 + read(seeds, at + wp.static(OF_WEIGHT))
                    s10 += wp.cw_mul(weight, v0)
                    if wp.static(width > 1):
                        v1 = read(seeds, at + wp.static(OF_CHANNELS + 1))
                        value += number(features, f + 1) * v1
                        s11 += wp.cw_mul(weight, v1)
                    if wp.static(width > 2):
                        v2 = read(seeds, at + wp.static(OF_CHANNELS + 2))
                        value += number(features, f + 2) * v2
                        s12 += wp.cw_mul(weight, v2)
                    if wp.static(width > 3):
                        v3 = read(seeds, at + wp.static(OF_CHANNELS + 3))
                        value += number(features, f + 3) * v3
                        s13 += wp.cw_mul(weight, v3)
                    if wp.static(with_range):
                        vt = wp.cw_mul(weight, read(seeds, at + wp.static(OF_RANGE)))
                        value += row[REACH] * wp.cw_mul(lever, read(seeds, at + wp.static(OF_RANGE)))
                    goal = read(seeds, at + wp.static(BEHIND)) - wp.cw_mul(weight, value)
                    write(seeds, at + wp.static(BEHIND), goal)
                    # dL/da times the response: dL/d opacity
                    slope = wp.cw_mul(wp.cw_mul(transmittance, value) - behind(goal, alpha), free)
                    left = thinned(transmittance, alpha, weight)
                    write(seeds, at + wp.static(LEFT), left)
                    y1 = wp.cw_mul(lever, g1)
                    y2 = wp.cw_mul(lever, g2)
                    bent = wp.cw_mul(slope, q)
                    p1 = wp.cw_mul(slope, y1)
                    s0 += bent
                    s1 += p1
                    s2 += wp.cw_mul(slope, y2)
                    s3 += wp.cw_mul(bent, q)
                    s4 += wp.cw_mul(bent, y1)
                    s5 += wp.cw_mul(bent, y2)
                    s6 += wp.cw_mul(p1, y1)
                    s7 += wp.cw_mul(p1, y2)
                    s9 += slope
                    s14 += weight
                    if wp.static(with_range):
                        half = wp.cw_mul(vt, inverse)
                        h0 = row[LIFT] * wp.cw_mul(half, g0)
                        h1 = row[TILT] * wp.cw_mul(half, g1)
                        h2 = row[TILT] * wp.cw_mul(half, g2)
                        s1 -= h1
                        s2 -= h2
                        s3 -= real(2.0) * wp.cw_mul(h0, q)
                        s4 -= wp.cw_mul(h0, y1) + wp.cw_mul(h1, q)
                        s5 -= wp.cw_mul(h0, y2) + wp.cw_mul(h2, q)
                        s6 -= real(2.0) * wp.cw_mul(h1, y1)
                        s7 -= wp.cw_mul(h1, y2) + wp.cw_mul(h2, y1)
                        s8 += h0
                    if not any_positive(left - tmin):
                        open = open & (-1 - (1 << b))
                found = sums_of(s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12, s13, s14, lanes())
                write(sums, slots[j], found)

        return blend_adjoint

    @wp.kernel(module="unique", enable_backward=False)
    def background_adjoint(
        offset: int,
        first: int,
        background_sums: wp.array(dtype=coefficients),
        background_grad: wp.array(dtype=real),
    ):
        """Gradient of one channel of the background: the transmittance left times what each pixel wants."""
        c = offset + wp.tid()
        total = wp.float64(0.0)
        for k in range(background_sums.shape[0]):
            total += wp.float64(background_sums[k][c])
        background_grad[first + c] = background_grad[first + c] + real(total)

    return SimpleNamespace(
        background_adjoint=background_adjoint,
        blend=blend,
        blend_adjoint=(adjoint_kernel(False), adjoint_kernel(True)),  # with or without gradients of ranges
    )
