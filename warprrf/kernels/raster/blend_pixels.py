"""Blending on a GPU: a thread per pixel, a warp of 32 threads per 8 x 4 pixels; the same sums as :mod:`.blend`.

Warps walk their tiles' lists as :mod:`.warps` says; what none of a warp's pixels sees costs it a look. `blend_adjoint`
adds up a warp's 15 sums by halves, 16 shuffles in all (at each step a lane gives away half of the numbers that it
holds), and adds them to the Gaussian's row in one coalesced atomic operation.

Rows, masks and tile lists are those of :mod:`.project`, :mod:`.entry_masks` and :mod:`.binning`.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import BLOCK, lanes_of, lowest_bit
from warprrf.kernels.raster.project import (
    CHANNELS,
    LIFT,
    OPACITY,
    REACH,
    ROW,
    TILT,
    Rules,
    View,
    rays_of,
)
from warprrf.kernels.raster.warps import WARP, WHOSE, ballot
from warprrf.kernels.raster.warps import build as warp_functions


@cache
def build(real: Any, rule: int, width: int = CHANNELS) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``, one transmittance rule, and 1 to 4 channels at
    once; each is compiled when first launched. Launch ``warps.PIXELS`` threads a tile, in blocks of 256."""
    lanes = lanes_of(real)
    coefficients = wp.types.vector(ROW, real)
    Rays = rays_of(real)
    of = warp_functions(real, rule, width)
    add = of.add
    behind = of.behind
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
    warp_sums = of.warp_sums

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        offset: int,
        rows: wp.array(dtype=coefficients),
        features: wp.array(dtype=real),
        channels: int,
        first: int,
        background: wp.array(dtype=real),
        ids: wp.array(dtype=int),
        masks: wp.array(dtype=int),
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
        """Blend ``width`` channels from ``first`` front to back, as ``blend.blend`` does."""
        thread = offset + wp.tid()
        lane = thread % wp.static(WARP)
        tile, mine, column, line, p = place_of(thread, view)
        x = column * wp.static(BLOCK) + p % wp.static(BLOCK)
        y = line * wp.static(BLOCK) + p / wp.static(BLOCK)
        inside = x < view.width and y < view.height
        across, along, down = ray_of(rays, column, line, p)
        amax = real(rules.alpha_max)
        tmin = real(rules.transmittance_min)
        transmittance = real(1.0)
        if not inside:
            transmittance = tmin
        c0 = real(0.0)
        c1 = real(0.0)
        c2 = real(0.0)
        c3 = real(0.0)
        depth = real(0.0)
        total = real(0.0)
        best = real(0.0)
        peak = real(0.0)
        owner = int(-1)
        place = shelf()
        last = starts[tile + 1]
        begin = starts[tile]
        while begin < last and ballot(transmittance > tmin) != 0:
            waiting = next_entries(
                place, lane, begin, last, mine, ids, masks, rows, features, channels, first
            )
            while waiting != 0:
                at = lowest_bit(waiting)
                waiting = waiting & (waiting - 1)
                row = staged(place, at)
                g0, g1, g2, n, square, near = look(row, across, along, down)
                seen = near and transmittance > tmin
                if ballot(seen) == 0:
                    continue
                # From here on lanes that see nothing go along with a weight of zero.
                inverted = inverse(square)
                alpha = real(0.0)
                if seen:
                    alpha = wp.min(row[OPACITY] * response(n * inverted), amax)
                weight = alpha * transmittance
                transmittance = thinned(transmittance, alpha, weight)
                t = row[REACH] * g0 * inverted
                depth += weight * t
                total += weight
                if weight > best:
                    owner = gaussian(row[wp.static(WHOSE)])
                    peak = t
                    best = weight
                c0 += row[wp.static(ROW)] * weight
                if wp.static(width > 1):
                    c1 += row[wp.static(ROW + 1)] * weight
                if wp.static(width > 2):
                    c2 += row[wp.static(ROW + 2)] * weight
                if wp.static(width > 3):
                    c3 += row[wp.static(ROW + 3)] * weight
            begin += wp.static(WARP)
        if not inside:
            return
        pixel = y * view.width + x
        at = pixel * channels + first
        image[at] = c0 + background[first] * transmittance
        if wp.static(width > 1):
            image[at + 1] = c1 + background[first + 1] * transmittance
        if wp.static(width > 2):
            image[at + 2] = c2 + background[first + 2] * transmittance
        if wp.static(width > 3):
            image[at + 3] = c3 + background[first + 3] * transmittance
        if first == 0:
            length = wp.sqrt(across * across + along * along + down * down)
            alpha_out[pixel] = total
            depth_out[pixel] = wp.where(total > real(0.0), depth * length / total, real(0.0))
            transmittance_out[pixel] = transmittance
            peak_out[pixel] = peak * length
            dominant_out[pixel] = owner

    def adjoint_kernel(with_range: bool) -> Any:
        @wp.kernel(module="unique", enable_backward=False)
        def blend_adjoint(
            offset: int,
            rows: wp.array(dtype=coefficients),
            features: wp.array(dtype=real),
            channels: int,
            first: int,
            ids: wp.array(dtype=int),
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
            sums: wp.array(dtype=coefficients),
            background_grad: wp.array(dtype=real),
        ):
            """Same walk as `blend`; adds each Gaussian's gradients to ``sums`` (N) and, where it has an element a
            channel, the background's to ``background_grad``. The sums are those of ``blend.blend_adjoint``."""
            thread = offset + wp.tid()
            lane = thread % wp.static(WARP)
            tile, mine, column, line, p = place_of(thread, view)
            x = column * wp.static(BLOCK) + p % wp.static(BLOCK)
            y = line * wp.static(BLOCK) + p / wp.static(BLOCK)
            across, along, down = ray_of(rays, column, line, p)
            amax = real(rules.alpha_max)
            tmin = real(rules.transmittance_min)
            transmittance = tmin  # outside the image: nothing to blend
            of_weight = real(0.0)
            of_range = real(0.0)
            v = lanes()  # gradients of the channels
            goal = real(0.0)  # what gradients make of all that lies behind
            left = real(0.0)
            if x < view.width and y < view.height:
                transmittance = real(1.0)
                pixel = y * view.width + x
                left = remaining[pixel]
                if first == 0:
                    total = alphas[pixel]
                    if total > real(0.0):
                        of_weight = alpha_grad[pixel]
                        of_range = depth_grad[pixel] / total
                    goal = total * of_weight
                    of_weight -= of_range * ranges[pixel]
                    of_range *= wp.sqrt(across * across + along * along + down * down)
                for c in range(wp.static(width)):
                    source = pixel * channels + first + c
                    v[c] = image_grad[source]
                    goal += v[c] * image[source]
            if background_grad.shape[0] > 0:
                found = warp_sums(v * left, lane)
                if lane % 2 == 0 and lane / 2 < width:
                    wp.atomic_add(background_grad, first + lane / 2, found)
            place = shelf()
            last = starts[tile + 1]
            begin = starts[tile]
            while begin < last and ballot(transmittance > tmin) != 0:
                waiting = next_entries(
                    place, lane, begin, last, mine, ids, masks, rows, features, channels, first
                )
                while waiting != 0:
                    at = lowest_bit(waiting)
                    waiting = waiting & (waiting - 1)
                    row = staged(place, at)
                    g0, g1, g2, n, square, near = look(row, across, along, down)
                    seen = near and transmittance > tmin
                    if ballot(seen) == 0:
                        continue
                    # From here on lanes that see nothing go along with q, lever and alpha of zero, and add nothing.
                    inverted = inverse(square)
                    q = real(0.0)
                    lever = real(0.0)
                    kept = real(0.0)
                    if seen:
                        q = n * inverted
                        lever = g0 * inverted
                        kept = response(q)
                    raw = row[OPACITY] * kept
                    alpha = wp.min(raw, amax)
                    weight = alpha * transmittance
                    value = row[wp.static(ROW)] * v[0] + of_weight
                    s = lanes()
                    s[10] = weight * v[0]
                    if wp.static(width > 1):
                        value += row[wp.static(ROW + 1)] * v[1]
                        s[11] = weight * v[1]
                    if wp.static(width > 2):
                        value += row[wp.static(ROW + 2)] * v[2]
                        s[12] = weight * v[2]
                    if wp.static(width > 3):
                        value += row[wp.static(ROW + 3)] * v[3]
                        s[13] = weight * v[3]
                    if wp.static(with_range):
                        value += row[REACH] * lever * of_range
                    goal -= weight * value
                    slope = real(0.0)  # dL/da times the response: dL/d opacity, where alpha is not clamped
                    if raw <= amax:
                        slope = (transmittance * value - behind(goal, alpha)) * kept
                    y1 = lever * g1
                    y2 = lever * g2
                    bent = slope * q
                    p1 = slope * y1
                    s[0] = bent
                    s[1] = p1
                    s[2] = slope * y2
                    s[3] = bent * q
                    s[4] = bent * y1
                    s[5] = bent * y2
                    s[6] = p1 * y1
                    s[7] = p1 * y2
                    s[9] = slope
                    s[14] = weight
                    if wp.static(with_range):
                        half = weight * of_range * inverted
                        h0 = row[LIFT] * half * g0
                        h1 = row[TILT] * half * g1
                        h2 = row[TILT] * half * g2
                        s[1] = s[1] - h1
                        s[2] = s[2] - h2
                        s[3] = s[3] - real(2.0) * h0 * q
                        s[4] = s[4] - (h0 * y1 + h1 * q)
                        s[5] = s[5] - (h0 * y2 + h2 * q)
                        s[6] = s[6] - real(2.0) * h1 * y1
                        s[7] = s[7] - (h1 * y2 + h2 * y1)
                        s[8] = h0
                    transmittance = thinned(transmittance, alpha, weight)
                    found = warp_sums(s, lane)
                    if lane % 2 == 0:
                        add(sums, gaussian(row[wp.static(WHOSE)]), lane / 2, found)
                begin += wp.static(WARP)

        return blend_adjoint

    @wp.kernel(module="unique", enable_backward=False)
    def any_gradient(offset: int, values: wp.array(dtype=real), found: wp.array(dtype=int)):
        """Set ``found`` where a value is not zero."""
        if values[offset + wp.tid()] != real(0.0):
            found[0] = 1

    return SimpleNamespace(
        any_gradient=any_gradient,
        blend=blend,
        blend_adjoint=(adjoint_kernel(False), adjoint_kernel(True)),  # with or without gradients of ranges
    )
