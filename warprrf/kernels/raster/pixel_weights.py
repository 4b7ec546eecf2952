"""Each pixel's largest blending weights on a GPU, a thread per pixel: what :mod:`.weights` finds on a CPU."""

from functools import cache
from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import BLOCK, lowest_bit
from warprrf.kernels.raster.project import OPACITY, REACH, ROW, Rules, View, rays_of
from warprrf.kernels.raster.warps import WARP, WHOSE, ballot
from warprrf.kernels.raster.warps import build as warp_functions


@cache
def build(real: Any, rule: int) -> Any:
    """The kernel for one scalar type, ``wp.float32`` or ``wp.float64``, and one transmittance rule, compiled when first
    launched. Launch ``warps.PIXELS`` threads a tile, in blocks of 256."""
    coefficients = wp.types.vector(ROW, real)
    Rays = rays_of(real)
    of = warp_functions(real, rule, 0)
    gaussian = of.gaussian
    inverse = of.inverse
    look = of.look
    next_entries = of.next_entries
    place_of = of.place_of
    ray_of = of.ray_of
    response = of.response
    shelf = of.shelf
    staged = of.staged
    thinned = of.thinned

    @wp.kernel(module="unique", enable_backward=False)
    def strongest(
        offset: int,
        rows: wp.array(dtype=coefficients),
        nothing: wp.array(dtype=real),
        ids: wp.array(dtype=int),
        masks: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        rays: Rays,
        view: View,
        rules: Rules,
        capacity: int,
        index: wp.array(dtype=int),
        weight_out: wp.array(dtype=real),
        range_out: wp.array(dtype=real),
        total_out: wp.array(dtype=real),
    ):
        """The ``capacity`` largest blending weights of each pixel, as ``weights.strongest`` finds them; ``nothing``
        stands for features."""
        thread = offset + wp.tid()
        lane = thread % wp.static(WARP)
        tile, mine, column, line, p = place_of(thread, view)
        x = column * wp.static(BLOCK) + p % wp.static(BLOCK)
        y = line * wp.static(BLOCK) + p / wp.static(BLOCK)
        inside = x < view.width and y < view.height
        across, along, down = ray_of(rays, column, line, p)
        length = wp.sqrt(across * across + along * along + down * down)
        amax = real(rules.alpha_max)
        tmin = real(rules.transmittance_min)
        transmittance = real(1.0)
        if not inside:
            transmittance = tmin
        total = real(0.0)
        pixel = y * view.width + x
        home = pixel * capacity
        kept = int(0)
        least = real(0.0)  # of the weights kept once there is no room left, and its place
        at = int(0)
        place = shelf()
        last = starts[tile + 1]
        begin = starts[tile]
        while begin < last and ballot(transmittance > tmin) != 0:
            waiting = next_entries(place, lane, begin, last, mine, ids, masks, rows, nothing, 0, 0)
            while waiting != 0:
                row = staged(place, lowest_bit(waiting))
                waiting = waiting & (waiting - 1)
                g0, g1, g2, n, square, near = look(row, across, along, down)
                if near and transmittance > tmin:
                    inverted = inverse(square)
                    alpha = wp.min(row[OPACITY] * response(n * inverted), amax)
                    weight = alpha * transmittance
                    transmittance = thinned(transmittance, alpha, weight)
                    total += weight
                    if weight > least:
                        if kept == capacity:
                            for c in range(at, capacity - 1):  # close the gap: the order along the ray stays
                                index[home + c] = index[home + c + 1]
                                weight_out[home + c] = weight_out[home + c + 1]
                                range_out[home + c] = range_out[home + c + 1]
                            kept = capacity - 1
                        index[home + kept] = gaussian(row[wp.static(WHOSE)])
                        weight_out[home + kept] = weight
                        range_out[home + kept] = row[REACH] * g0 * inverted * length
                        kept += 1
                        if kept == capacity:
                            least = weight_out[home]
                            at = int(0)
                            for c in range(1, capacity):
                                if weight_out[home + c] < least:
                                    least = weight_out[home + c]
                                    at = c
            begin += wp.static(WARP)
        if inside:
            total_out[pixel] = total

    return strongest
