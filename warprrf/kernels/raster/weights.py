"""Each pixel's largest blending weights, for geometry that is frozen; and how many Gaussians a pixel sees at all."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import BLOCK, LANES, VECTORISED, lanes_of
from warprrf.kernels.raster.lanes import build as lane_functions
from warprrf.kernels.raster.project import (
    CUT,
    FLAT,
    G0,
    G1,
    G2,
    OPACITY,
    PRODUCT,
    REACH,
    ROW,
    Rules,
    View,
    rays_of,
)
from warprrf.kernels.raster.response import build as response_functions


@cache
def build(real: Any, rule: int) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``, and one transmittance rule; each is compiled
    when first launched."""
    lanes = lanes_of(real)
    integers = lanes_of(int)
    coefficients = wp.types.vector(ROW, real)
    Rays = rays_of(real)
    of = lane_functions(real)
    any_positive, above, lower, higher, read = of.any_positive, of.above, of.lower, of.higher, of.read
    shared = response_functions(real, rule)
    forms, place_of, response = shared.forms, shared.place_of, shared.response
    ray_lengths, thinned, tiny = shared.ray_lengths, shared.thinned, shared.tiny

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def strongest(
        offset: int,
        rows: wp.array(dtype=coefficients),
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
                    index[first + place] = k
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
    def count_passing(
        offset: int,
        rows: wp.array(dtype=coefficients),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        rays: Rays,
        view: View,
        rules: Rules,
        count: wp.array(dtype=int),
    ):
        """How many Gaussians contribute to each pixel: a plain loop, for benchmarks and tests."""
        block = offset + wp.tid()
        column, line = place_of(block, view)
        for lane in range(wp.static(LANES)):
            x = column * wp.static(BLOCK) + lane % wp.static(BLOCK)
            y = line * wp.static(BLOCK) + lane / wp.static(BLOCK)
            if x < view.width and y < view.height:
                transmittance = real(1.0)
                passing = int(0)
                for j in range(starts[block], starts[block + 1]):
                    row = rows[ids[j]]
                    across = rays.across[column][lane]
                    along = rays.along[column][lane]
                    down = rays.down[line][lane]
                    g0 = row[G0] * across + row[G0 + 1] * along + row[G0 + 2] * down
                    g1 = row[G1] * across + row[G1 + 1] * along + row[G1 + 2] * down
                    g2 = row[G2] * across + row[G2 + 1] * along + row[G2 + 2] * down
                    n = g1 * g1 + g2 * g2
                    square = g0 * g0 + row[FLAT] * n
                    if (
                        n < row[CUT] * square
                        and g0 > real(0.0)
                        and transmittance > real(rules.transmittance_min)
                    ):
                        passing += 1
                        alpha = wp.min(row[OPACITY] * wp.exp(real(-0.5) * n / square), real(rules.alpha_max))
                        if wp.static(rule == PRODUCT):
                            transmittance = transmittance * (real(1.0) - alpha)
                        else:
                            transmittance = transmittance * wp.exp(-alpha)
                count[y * view.width + x] = passing

    return SimpleNamespace(count_passing=count_passing, strongest=strongest)
