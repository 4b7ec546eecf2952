"""Blending, its adjoint and the strongest weights, a thread per pixel: what blending means, in plain loops.

A GPU runs these. On a CPU :mod:`.blocks` computes the same 16 pixels at a time, and tests compare the two. Threads go
tile by tile; a tile's entries ``ids[starts[tile]:starts[tile + 1]]`` are the Gaussians that it may see, near to far.
What a GPU waits for is memory: its 16 threads of a tile each fetch one of the 16 rows that all of them walk next
(:func:`touch`), and what they add to a Gaussian is summed before it leaves the warp (:func:`build_add`). Few threads
would walk a long list alone: stretches of it are blended side by side (:func:`build_stretches`).
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.cache import once
from warprrf.kernels.raster.project import OF_FEATURES, OF_OPACITY, OF_WEIGHT, SUMS, splat_of
from warprrf.kernels.raster.view import PRODUCT, TILE, Rules, View, pixel_of, pixel_ray

LANES = TILE**2  # threads of a tile, which walk its list together
STRETCH = 64  # entries; on an H200 32 takes the same time, 256 twice as long


@wp.func
def touch(splats: wp.array(dtype=Any), ids: wp.array(dtype=int), at: int, end: int):
    """Zero, read from both halves of a row. Each lane of a tile reads another one of the 16 that they all walk next:
    memory is waited for once, and the rows then lie in the nearest cache."""
    splat = splats[ids[wp.min(at, end - 1)]]
    none = type(splat.cut)(0.0)
    return wp.min(splat.cut, none) + wp.max(splat.tilt, none)


@wp.func
def meet(splat: Any, ray: Any, least: Any):
    """How a ray passes a Gaussian: its forms g0, g1, g2, n = g1^2 + g2^2, and |g|^2 (``least`` at least, so that its
    reciprocal stays finite): it is n / |g|^2 squared standard deviations away."""
    g0 = wp.dot(splat.g0, ray)
    g1 = wp.dot(splat.g1, ray)
    g2 = wp.dot(splat.g2, ray)
    n = g1 * g1 + g2 * g2
    return g0, g1, g2, n, wp.max(g0 * g0 + splat.flat * n, least)


@wp.func
def behind(transmittance: Any, alpha: Any, rule: int):
    """The transmittance behind a layer."""
    if rule == wp.static(PRODUCT):
        return transmittance * (type(alpha)(1.0) - alpha)
    return transmittance * wp.exp(-alpha)


@wp.func
def pair_sums(s: Any, slope: Any, q: Any, y1: Any, y2: Any, h0: Any, h1: Any, h2: Any, weight: Any):
    """``s`` with what a pair adds to its Gaussian's sums, beside those of features; see :mod:`.project`."""
    two = type(q)(2.0)
    s[0] = slope * q
    s[1] = slope * y1 - h1
    s[2] = slope * y2 - h2
    s[3] = slope * q * q - two * h0 * q
    s[4] = slope * q * y1 - h0 * y1 - h1 * q
    s[5] = slope * q * y2 - h0 * y2 - h2 * q
    s[6] = slope * y1 * y1 - two * h1 * y1
    s[7] = slope * y1 * y2 - h1 * y2 - h2 * y1
    s[8] = h0
    s[wp.static(OF_OPACITY)] = slope
    s[wp.static(OF_WEIGHT)] = weight
    return s


@once
def layers(real: type, width: int) -> SimpleNamespace:
    """What a pixel has met, the walk along a list, and what was met on two parts of it as one, for ``width`` channels."""
    vec3 = wp.types.vector(3, real)
    values = wp.types.vector(width, real)
    Splat = splat_of(real)
    least = 1.0e-30 if real is wp.float32 else 1.0e-250

    @wp.struct
    class Layers:
        color: values
        transmittance: real
        total: real  # of the weights
        depth: real  # of the weights times ranges; ranges are in lengths of the ray
        best: real  # the largest weight, its range and its Gaussian
        peak: real
        owner: int

    @wp.func
    def nothing():
        """What a pixel has met before it begins."""
        met = Layers()
        met.transmittance = real(1.0)
        met.owner = -1
        return met

    @wp.func
    def walk(
        met: Layers,
        begin: int,
        end: int,
        lane: int,
        ray: vec3,
        splats: wp.array(dtype=Splat),
        ids: wp.array(dtype=int),
        rules: Rules,
        features: wp.array(dtype=real, ndim=2),
        first: int,
    ):
        """``met`` and the entries from ``begin`` to ``end`` behind it, until the pixel is finished."""
        for j in range(begin, end):
            if met.transmittance <= real(rules.transmittance_min):
                break
            if (j - begin) % wp.static(LANES) == 0:
                met.transmittance += touch(splats, ids, j + lane, end)
            k = ids[j]
            splat = splats[k]
            g0, g1, g2, n, square = meet(splat, ray, real(wp.static(least)))
            if g0 > real(0.0) and n < splat.cut * square:
                inverse = real(1.0) / square
                alpha = wp.min(splat.opacity * wp.exp(real(-0.5) * n * inverse), real(rules.alpha_max))
                weight = alpha * met.transmittance
                met.transmittance = behind(met.transmittance, alpha, rules.rule)
                t = splat.reach * g0 * inverse
                for c in range(wp.static(width)):
                    met.color[c] += features[k, first + c] * weight
                met.total += weight
                met.depth += weight * t
                if weight > met.best:
                    met.best = weight
                    met.peak = t
                    met.owner = k
        return met

    @wp.func
    def over(front: Layers, back: Layers):
        """``front`` with ``back`` seen through it."""
        through = front.transmittance
        met = front
        met.color += through * back.color
        met.total += through * back.total
        met.depth += through * back.depth
        if through * back.best > front.best:
            met.best = through * back.best
            met.peak = back.peak
            met.owner = back.owner
        met.transmittance = through * back.transmittance
        return met

    return SimpleNamespace(Layers=Layers, nothing=nothing, walk=walk, over=over)


@once
def build_stretches(real: type, width: int) -> Any:
    """The kernel that blends every whole stretch of a list by itself, as :func:`build_blend` makes it."""
    vec3 = wp.types.vector(3, real)
    Splat, of = splat_of(real), layers(real, width)
    Layers, nothing, walk = of.Layers, of.nothing, of.walk

    @wp.kernel(module="unique", enable_backward=False)
    def blend_stretches(
        offset: int,
        splats: wp.array(dtype=Splat),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        features: wp.array(dtype=real, ndim=2),
        first: int,
        stretches: wp.array(dtype=Layers, ndim=2),
    ):
        """``stretches[i, lane]``: what a pixel of a tile meets on entries ``i STRETCH`` to ``(i + 1) STRETCH``, if these
        are all of one tile."""
        thread = offset + wp.tid()
        lane = thread % wp.static(LANES)
        stretch = thread / wp.static(LANES)
        begin = stretch * wp.static(STRETCH)
        end = begin + wp.static(STRETCH)
        tile = wp.lower_bound(starts, begin + 1) - 1
        if starts[tile + 1] < end:
            return
        tile, x, y = pixel_of(tile * wp.static(LANES) + lane, view)
        ray = vec3(pixel_ray(view, x, y))
        stretches[stretch, lane] = walk(nothing(), begin, end, lane, ray, splats, ids, rules, features, first)

    return blend_stretches


@once
def build_blend(real: type, width: int) -> Any:
    """The kernel that blends ``width`` channels (1 to 4) at once, for ``wp.float32`` or ``wp.float64``."""
    vec3 = wp.types.vector(3, real)
    Splat, of = splat_of(real), layers(real, width)
    Layers, nothing, walk, over = of.Layers, of.nothing, of.walk, of.over

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        offset: int,
        splats: wp.array(dtype=Splat),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        features: wp.array(dtype=real, ndim=2),
        first: int,
        stretches: wp.array(dtype=Layers, ndim=2),
        background: wp.array(dtype=real),
        image: wp.array(dtype=real, ndim=3),
        alpha_out: wp.array(dtype=real, ndim=2),
        depth_out: wp.array(dtype=real, ndim=2),
        left_out: wp.array(dtype=real, ndim=2),
        dominant_out: wp.array(dtype=int, ndim=2),
        peak_out: wp.array(dtype=real, ndim=2),
    ):
        """Blend channels from ``first`` front to back: features, sum of weights, mean range (0 where nothing is seen,
        so that a loss on it stays finite), transmittance left, Gaussian of largest weight and the range of its peak.

        A whole stretch is taken as it was blended by itself; one in which the pixel is finished is walked once more.
        """
        thread = offset + wp.tid()
        lane = thread % wp.static(LANES)
        tile, x, y = pixel_of(thread, view)
        if x >= view.width or y >= view.height:
            return
        ray = vec3(pixel_ray(view, x, y))
        finished = real(rules.transmittance_min)
        met = nothing()
        at = int(starts[tile])
        end = starts[tile + 1]
        while at < end and met.transmittance > finished:
            stretch = at / wp.static(STRETCH)
            stop = wp.min((stretch + 1) * wp.static(STRETCH), end)
            known = bool(False)
            if stop - at == wp.static(STRETCH):
                known = met.transmittance * stretches[stretch, lane].transmittance > finished
            if known:
                met = over(met, stretches[stretch, lane])
            else:
                met = walk(met, at, stop, lane, ray, splats, ids, rules, features, first)
            at = stop
        for c in range(wp.static(width)):
            image[y, x, first + c] = met.color[c] + background[first + c] * met.transmittance
        if first == 0:
            length = wp.length(ray)
            alpha_out[y, x] = met.total
            depth_out[y, x] = wp.where(met.total > real(0.0), met.depth * length / met.total, real(0.0))
            left_out[y, x] = met.transmittance
            dominant_out[y, x] = met.owner
            peak_out[y, x] = met.peak * length

    return blend


ADD_OVER_TILES = """
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffffu;
    const unsigned who = __ballot_sync(all, seen);
    if (who) {
        const int lane = threadIdx.x % 16;
#pragma unroll
        for (int step = 0; step < 4; ++step) {
            const int half = 8 >> step;
            const bool upper = lane & half;
#pragma unroll
            for (int i = 0; i < 8; ++i) {
                if (i >= half) break;
                const auto kept = upper ? s[i + half] : s[i];
                const auto given = upper ? s[i] : s[i + half];
                s[i] = kept + __shfl_xor_sync(all, given, half);
            }
        }
        if (who & (0xffffu << (threadIdx.x & 16))) atomicAdd(&(*wp::address(sums, part, k))[lane], s[0]);
    }
    return __any_sync(all, going);
#else
    if (seen) wp::atomic_add(sums, part, k, s);
    return going;
#endif
"""


@once
def build_add(real: type) -> Any:
    """The function that adds what the pixels of a tile make of one Gaussian.

    On a GPU all lanes of a warp call it together, 16 for each of two tiles. Of the numbers that a lane holds it gives one
    half to a neighbour and gets the other: after 8, 4, 2 and 1 of them each lane has one sum of all 16, which are
    added in one go. On a CPU a pixel is alone.
    """
    sums_of_one = wp.types.vector(SUMS, real)

    @wp.func_native(ADD_OVER_TILES)
    def add(
        sums: wp.array2d(dtype=sums_of_one), part: int, k: int, s: sums_of_one, seen: bool, going: bool
    ) -> bool:
        """Add ``s`` of the lanes that have ``seen`` the Gaussian to ``sums[part, k]``; whether any is ``going`` on."""
        ...

    return add


@once
def build_adjoint(real: type, width: int) -> Any:
    """The adjoint of ``blend``, as :func:`build_blend` makes it."""
    vec3 = wp.types.vector(3, real)
    values = wp.types.vector(width, real)
    sums_of_one = wp.types.vector(SUMS, real)
    add = build_add(real)
    Splat = splat_of(real)
    least = 1.0e-30 if real is wp.float32 else 1.0e-250

    @wp.kernel(module="unique", enable_backward=False)
    def blend_adjoint(
        offset: int,
        splats: wp.array(dtype=Splat),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        parts: wp.array(dtype=int),
        features: wp.array(dtype=real, ndim=2),
        first: int,
        image: wp.array(dtype=real, ndim=3),
        alphas: wp.array(dtype=real, ndim=2),
        ranges: wp.array(dtype=real, ndim=2),
        image_grad: wp.array(dtype=real, ndim=3),
        alpha_grad: wp.array(dtype=real, ndim=2),
        depth_grad: wp.array(dtype=real, ndim=2),
        sums: wp.array(dtype=sums_of_one, ndim=2),
    ):
        """Same walk as ``blend``; adds what every pair means for its Gaussian to ``sums``, see :mod:`.project`.

        dL/da_i = T_i x_i - (R - sum_{j<=i} w_j x_j) / (1 - a_i), x the gradient dotted with the pair's features, R the
        same dotted with the finished pixel; without the division for the exponential rule.
        """
        thread = offset + wp.tid()
        lane = thread % wp.static(LANES)
        tile, x, y = pixel_of(thread, view)
        tile = wp.min(tile, view.tiles_x * view.tiles_y - 1)  # of lanes that fill the last warp
        part = parts[tile]
        ray = vec3(pixel_ray(view, x, y))
        inside = x < view.width and y < view.height  # lanes beyond the image stay: a warp adds up as a whole
        of_features = values()  # gradients: of features, of the sums of weight and of weight times range
        of_weight = real(0.0)
        of_range = real(0.0)
        rest = real(0.0)  # what gradients make of all that lies behind
        if inside:
            if first == 0 and alphas[y, x] > real(0.0):
                of_range = depth_grad[y, x] / alphas[y, x]
                of_weight = alpha_grad[y, x] - of_range * ranges[y, x]
                of_range *= wp.length(ray)
                rest = alphas[y, x] * alpha_grad[y, x]
            for c in range(wp.static(width)):
                of_features[c] = image_grad[y, x, first + c]
                rest += of_features[c] * image[y, x, first + c]
        transmittance = real(1.0)
        begin = starts[tile]
        end = starts[tile + 1]
        j = int(begin)
        going = inside and j < end
        others = bool(True)  # whether any lane of the warp is going on: until none is, all stay
        while others:
            s = sums_of_one()
            seen = bool(False)
            k = int(0)
            if j < end:
                if (j - begin) % wp.static(LANES) == 0:
                    transmittance += touch(splats, ids, j + lane, end)
                k = ids[j]
                splat = splats[k]
                g0, g1, g2, n, square = meet(splat, ray, real(wp.static(least)))
                seen = going and g0 > real(0.0) and n < splat.cut * square
                if seen:
                    inverse = real(1.0) / square
                    q = n * inverse
                    response = wp.exp(real(-0.5) * q)
                    raw = splat.opacity * response
                    alpha = wp.min(raw, real(rules.alpha_max))
                    weight = alpha * transmittance
                    lever = g0 * inverse
                    value = of_weight + splat.reach * lever * of_range
                    for c in range(wp.static(width)):
                        value += of_features[c] * features[k, first + c]
                        s[wp.static(OF_FEATURES) + c] = of_features[c] * weight
                    rest -= weight * value
                    slope = real(0.0)  # dL/d(opacity): none where alpha is clamped
                    if raw <= real(rules.alpha_max):
                        hidden = rest
                        if rules.rule == wp.static(PRODUCT):
                            hidden = rest / wp.max(real(1.0) - alpha, real(wp.static(least)))
                        slope = (transmittance * value - hidden) * response
                    y1 = lever * g1
                    y2 = lever * g2
                    pull = weight * of_range * inverse
                    h0 = splat.lift * pull * g0
                    h1 = splat.tilt * pull * g1
                    h2 = splat.tilt * pull * g2
                    s = pair_sums(s, slope, q, y1, y2, h0, h1, h2, weight)
                    transmittance = behind(transmittance, alpha, rules.rule)
            j += 1
            going = going and j < end and transmittance > real(rules.transmittance_min)
            others = add(sums, part, k, s, seen, going)

    return blend_adjoint


@once
def build_background(real: type) -> Any:
    """The adjoint of ``blend`` with respect to the background, for ``wp.float32`` or ``wp.float64``."""

    @wp.kernel(module="unique", enable_backward=False)
    def background_adjoint(
        offset: int,
        left: wp.array(dtype=real, ndim=2),
        image_grad: wp.array(dtype=real, ndim=3),
        background_grad: wp.array(dtype=real),
    ):
        """Add to the gradient of a channel the transmittance left times what each pixel wants."""
        c = offset + wp.tid()
        total = wp.float64(0.0)
        for y in range(left.shape[0]):
            for x in range(left.shape[1]):
                total += wp.float64(left[y, x]) * wp.float64(image_grad[y, x, c])
        background_grad[c] = background_grad[c] + real(total)

    return background_adjoint


@once
def build_strongest(real: type) -> Any:
    """The kernel that finds each pixel's largest blending weights, for ``wp.float32`` or ``wp.float64``."""
    vec3 = wp.types.vector(3, real)
    Splat = splat_of(real)
    least = 1.0e-30 if real is wp.float32 else 1.0e-250

    @wp.kernel(module="unique", enable_backward=False)
    def strongest(
        offset: int,
        splats: wp.array(dtype=Splat),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        index: wp.array(dtype=int, ndim=3),
        weight_out: wp.array(dtype=real, ndim=3),
        range_out: wp.array(dtype=real, ndim=3),
        total_out: wp.array(dtype=real, ndim=2),
    ):
        """The largest weights of each pixel, as many as ``index`` (H, W, K) has places, in front-to-back order; their
        Gaussians, the ranges of their peaks, and the sum of all weights."""
        thread = offset + wp.tid()
        lane = thread % wp.static(LANES)
        tile, x, y = pixel_of(thread, view)
        if x >= view.width or y >= view.height:
            return
        ray = vec3(pixel_ray(view, x, y))
        length = wp.length(ray)
        transmittance = real(1.0)
        total = real(0.0)
        kept = int(0)
        begin = starts[tile]
        end = starts[tile + 1]
        for j in range(begin, end):
            if transmittance <= real(rules.transmittance_min):
                break
            if (j - begin) % wp.static(LANES) == 0:
                transmittance += touch(splats, ids, j + lane, end)
            k = ids[j]
            splat = splats[k]
            g0, g1, g2, n, square = meet(splat, ray, real(wp.static(least)))
            if g0 > real(0.0) and n < splat.cut * square:
                inverse = real(1.0) / square
                alpha = wp.min(splat.opacity * wp.exp(real(-0.5) * n * inverse), real(rules.alpha_max))
                weight = alpha * transmittance
                transmittance = behind(transmittance, alpha, rules.rule)
                total += weight
                kept = keep_weight(
                    index, weight_out, range_out, y, x, kept, k, weight, splat.reach * g0 * inverse * length
                )
        total_out[y, x] = total

    return strongest


@wp.func
def keep_weight(
    index: wp.array3d(dtype=int),
    weights: wp.array3d(dtype=Any),
    ranges: wp.array3d(dtype=Any),
    y: int,
    x: int,
    kept: int,
    k: int,
    weight: Any,
    range_: Any,
):
    """Append Gaussian ``k`` to the list of a pixel that holds ``kept``; the smallest weight of a full list makes room,
    unless the new one is no larger. Returns how many it holds now."""
    capacity = index.shape[2]
    if kept == capacity:
        least = int(0)
        for c in range(1, capacity):
            if weights[y, x, c] < weights[y, x, least]:
                least = c
        if weight <= weights[y, x, least]:
            return kept
        for c in range(least, capacity - 1):  # close the gap: the order along the ray stays
            index[y, x, c] = index[y, x, c + 1]
            weights[y, x, c] = weights[y, x, c + 1]
            ranges[y, x, c] = ranges[y, x, c + 1]
        kept = capacity - 1
    index[y, x, kept] = k
    weights[y, x, kept] = weight
    ranges[y, x, kept] = range_
    return kept + 1
