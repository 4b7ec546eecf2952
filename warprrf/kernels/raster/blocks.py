"""Blending on a CPU, 4 x 4 pixels at a time: :mod:`.reference` with one Warp vector per number of its pixels.

A CPU's wide registers hold a block's numbers, so the loops over a vector's elements become one or two instructions
each. A block is a tile, and has one thread. Loops over its pixels run to ``view.tile``: to a constant they would be
unrolled, and its vectors taken apart into single numbers.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.cache import once
from warprrf.kernels.raster.project import OF_FEATURES, OF_OPACITY, OF_WEIGHT, SUMS, splat_of
from warprrf.kernels.raster.reference import keep_weight
from warprrf.kernels.raster.view import PRODUCT, TILE, Rules, View, pixel_ray

PIXELS = TILE * TILE
VECTORISED = {
    # Warp's loops over a vector's 16 numbers become one instruction each if they are not unrolled first, and if the
    # rest is not put together again from single numbers.
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-unroll-full-max-count=8 -fno-slp-vectorize -ffp-contract=fast"
}


@once
def exponential(real: type) -> Any:
    """exp(-q/2) of a block's numbers, for one scalar type."""
    per_pixel = wp.types.vector(PIXELS, real)

    if real is wp.float32:

        @wp.func
        def response(q: per_pixel):
            """exp(-q/2) for 0 <= q <= 80: (Taylor of exp(-q/32), degree 5)^16; absolute error below 1e-6."""
            x = q * real(-0.03125)
            p = per_pixel(real(1.0 / 24.0)) + x * real(1.0 / 120.0)
            p = per_pixel(real(1.0 / 6.0)) + wp.cw_mul(x, p)
            p = per_pixel(real(0.5)) + wp.cw_mul(x, p)
            p = per_pixel(real(1.0)) + wp.cw_mul(x, p)
            p = per_pixel(real(1.0)) + wp.cw_mul(x, p)
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            return wp.cw_mul(p, p)

    else:

        @wp.func
        def response(q: per_pixel):
            """exp(-q/2)."""
            out = per_pixel()
            for i in range(wp.static(PIXELS)):
                out[i] = wp.exp(real(-0.5) * q[i])
            return out

    return response


@once
def vector_functions(real: type) -> SimpleNamespace:
    """What Warp's vectors lack, for ``wp.float32`` or ``wp.float64``: comparisons, choices, sums, a quick exponential."""
    per_pixel = wp.types.vector(PIXELS, real)
    integers = wp.types.vector(PIXELS, int)
    name = real.__name__

    @wp.func_native(f"""
    bool found = false;
    for (int i = 0; i < {PIXELS}; ++i) found |= x[i] > wp::{name}(0);
    return found;
    """)
    def any_positive(x: per_pixel) -> bool:
        """Whether a number is above zero."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{PIXELS}, wp::{name}> out;
    for (int i = 0; i < {PIXELS}; ++i) {{
        const wp::{name} yes = a[i], no = b[i];
        out[i] = x[i] > wp::{name}(0) ? yes : no;
    }}
    return out;
    """)
    def where_positive(x: per_pixel, a: per_pixel, b: per_pixel) -> per_pixel:
        """``a`` where x > 0, else ``b``."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{PIXELS}, wp::int32> out;
    for (int i = 0; i < {PIXELS}; ++i) {{
        const wp::int32 no = b[i];
        out[i] = x[i] > wp::{name}(0) ? a : no;
    }}
    return out;
    """)
    def number_where_positive(x: per_pixel, a: int, b: integers) -> integers:
        """``a`` where x > 0, else ``b``."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{PIXELS}, wp::{name}> out;
    for (int i = 0; i < {PIXELS}; ++i) {{
        const wp::{name} x = a[i], y = b[i];
        out[i] = x < y ? x : y;
    }}
    return out;
    """)
    def lower(a: per_pixel, b: per_pixel) -> per_pixel:
        """The smaller of each two, ``b`` beside a NaN."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{PIXELS}, wp::{name}> out;
    for (int i = 0; i < {PIXELS}; ++i) {{
        const wp::{name} x = a[i], y = b[i];
        out[i] = x > y ? x : y;
    }}
    return out;
    """)
    def higher(a: per_pixel, b: per_pixel) -> per_pixel:
        """The larger of each two, ``b`` beside a NaN."""
        ...

    @wp.func_native(f"""
    #pragma clang fp reassociate(on)
    wp::{name} sum(0);
    for (int i = 0; i < {PIXELS}; ++i) sum += x[i];
    return sum;
    """)
    def total(x: per_pixel) -> real:
        """Sum of the numbers, in whatever order is quickest."""
        ...

    return SimpleNamespace(
        any_positive=any_positive,
        where_positive=where_positive,
        number_where_positive=number_where_positive,
        total=total,
        lower=lower,
        higher=higher,
        response=exponential(real),
    )


@once
def block_functions(real: type) -> SimpleNamespace:
    """The steps of blending that the kernels share, for one scalar type; :mod:`.reference` has them for one pixel."""
    per_pixel = wp.types.vector(PIXELS, real)
    Splat = splat_of(real)
    of = vector_functions(real)
    sums_of_one = wp.types.vector(SUMS, real)
    response, higher, total = of.response, of.higher, of.total
    least = 1.0e-30 if real is wp.float32 else 1.0e-250

    @wp.func
    def rays(view: View, x0: int, y0: int):
        """Rays of the block whose first pixel is (x0, y0), as their three axes, and 1 for pixels in the image, 0 for
        those beyond."""
        a = per_pixel()
        b = per_pixel()
        c = per_pixel()
        inside = per_pixel()
        for i in range(view.tile):  # axes a and b are those of a column, c of a row
            ray = pixel_ray(view, x0 + i, y0 + i)
            for j in range(view.tile):
                a[wp.static(TILE) * j + i] = real(ray[0])
                b[wp.static(TILE) * j + i] = real(ray[1])
                c[wp.static(TILE) * i + j] = real(ray[2])
                if x0 + j < view.width and y0 + i < view.height:
                    inside[wp.static(TILE) * i + j] = real(1.0)
        return a, b, c, inside

    @wp.func
    def meet(splat: Splat, a: per_pixel, b: per_pixel, c: per_pixel):
        """Forms g0, g1, g2 on the rays, the reciprocal of |g|^2, and by how much q is below the cutoff, times |g|^2."""
        g0 = splat.g0[0] * a + splat.g0[1] * b + splat.g0[2] * c
        g1 = splat.g1[0] * a + splat.g1[1] * b + splat.g1[2] * c
        g2 = splat.g2[0] * a + splat.g2[1] * b + splat.g2[2] * c
        n = wp.cw_mul(g1, g1) + wp.cw_mul(g2, g2)
        square = higher(wp.cw_mul(g0, g0) + splat.flat * n, per_pixel(real(wp.static(least))))
        return g0, g1, g2, n, square

    @wp.func
    def behind(transmittance: per_pixel, alpha: per_pixel, rule: int):
        """The transmittance behind a layer."""
        if rule == wp.static(PRODUCT):
            return transmittance - wp.cw_mul(transmittance, alpha)
        return wp.cw_mul(transmittance, response(real(2.0) * alpha))

    @wp.func
    def pair_sums(
        slope: per_pixel,
        q: per_pixel,
        y1: per_pixel,
        y2: per_pixel,
        h0: per_pixel,
        h1: per_pixel,
        h2: per_pixel,
        weight: per_pixel,
    ):
        """What a Gaussian's pairs add to its sums, those of features excepted."""
        bent = wp.cw_mul(slope, q)
        p1 = wp.cw_mul(slope, y1) - h1
        p2 = wp.cw_mul(slope, y2) - h2
        s = sums_of_one()
        s[0] = total(bent)
        s[1] = total(p1)
        s[2] = total(p2)
        s[3] = total(wp.cw_mul(bent - real(2.0) * h0, q))
        s[4] = total(wp.cw_mul(bent - h0, y1) - wp.cw_mul(h1, q))
        s[5] = total(wp.cw_mul(bent - h0, y2) - wp.cw_mul(h2, q))
        s[6] = total(wp.cw_mul(p1 - h1, y1))
        s[7] = total(wp.cw_mul(p1, y2) - wp.cw_mul(h2, y1))
        s[8] = total(h0)
        s[wp.static(OF_OPACITY)] = total(slope)
        s[wp.static(OF_WEIGHT)] = total(weight)
        return s

    return SimpleNamespace(rays=rays, meet=meet, behind=behind, pair_sums=pair_sums)


@once
def build_blend(real: type, width: int) -> Any:
    """As :func:`.reference.build_blend`."""
    per_pixel = wp.types.vector(PIXELS, real)
    integers = wp.types.vector(PIXELS, int)
    values = wp.types.vector(width, real)
    many = wp.types.matrix((width, PIXELS), real)
    Splat = splat_of(real)
    of, block = vector_functions(real), block_functions(real)
    any_positive, where_positive, number_where_positive = (
        of.any_positive,
        of.where_positive,
        of.number_where_positive,
    )
    response = of.response
    rays, meet, behind = block.rays, block.meet, block.behind
    lower, higher = of.lower, of.higher

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def blend(
        offset: int,
        splats: wp.array(dtype=Splat),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        features: wp.array(dtype=real, ndim=2),
        first: int,
        background: wp.array(dtype=real),
        image: wp.array(dtype=real, ndim=3),
        alpha_out: wp.array(dtype=real, ndim=2),
        depth_out: wp.array(dtype=real, ndim=2),
        left_out: wp.array(dtype=real, ndim=2),
        dominant_out: wp.array(dtype=int, ndim=2),
        peak_out: wp.array(dtype=real, ndim=2),
    ):
        tile = offset + wp.tid()
        x0 = (tile % view.tiles_x) * wp.static(TILE)
        y0 = (tile / view.tiles_x) * wp.static(TILE)
        a, b, c, transmittance = rays(view, x0, y0)
        amax = per_pixel(real(rules.alpha_max))
        tmin = per_pixel(real(rules.transmittance_min))
        color = many()
        feature = values()
        total = per_pixel()
        depth = per_pixel()
        best = per_pixel()
        peak = per_pixel()
        owner = integers(-1)
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            splat = splats[k]
            g0, g1, g2, n, square = meet(splat, a, b, c)
            counts = lower(lower(splat.cut * square - n, g0), transmittance - tmin)
            if not any_positive(counts):
                if not any_positive(transmittance - tmin):
                    break
                continue
            inverse = wp.cw_div(per_pixel(real(1.0)), square)
            faded = splat.opacity * response(wp.cw_mul(n, inverse))
            alpha = where_positive(counts, lower(faded, amax), per_pixel())
            weight = wp.cw_mul(alpha, transmittance)
            transmittance = behind(transmittance, alpha, rules.rule)
            t = splat.reach * wp.cw_mul(g0, inverse)
            for i in range(wp.static(width)):
                feature[i] = features[k, first + i]
            color += wp.outer(feature, weight)
            total += weight
            depth += wp.cw_mul(weight, t)
            owner = number_where_positive(weight - best, k, owner)
            peak = where_positive(weight - best, t, peak)
            best = higher(best, weight)
        for i in range(view.tile * view.tile):
            x = x0 + i % wp.static(TILE)
            y = y0 + i / wp.static(TILE)
            if x < view.width and y < view.height:
                for channel in range(wp.static(width)):
                    image[y, x, first + channel] = (
                        color[channel, i] + background[first + channel] * transmittance[i]
                    )
                if first == 0:
                    length = wp.sqrt(a[i] * a[i] + b[i] * b[i] + c[i] * c[i])
                    alpha_out[y, x] = total[i]
                    depth_out[y, x] = wp.where(total[i] > real(0.0), depth[i] * length / total[i], real(0.0))
                    left_out[y, x] = transmittance[i]
                    dominant_out[y, x] = owner[i]
                    peak_out[y, x] = peak[i] * length

    return blend


@once
def build_adjoint(real: type, width: int) -> Any:
    """As :func:`.reference.build_adjoint`."""
    per_pixel = wp.types.vector(PIXELS, real)
    values = wp.types.vector(width, real)
    many = wp.types.matrix((width, PIXELS), real)
    sums_of_one = wp.types.vector(SUMS, real)
    Splat = splat_of(real)
    of, block = vector_functions(real), block_functions(real)
    any_positive, where_positive, response, total = of.any_positive, of.where_positive, of.response, of.total
    rays, meet, behind, pair_sums = block.rays, block.meet, block.behind, block.pair_sums
    lower, higher = of.lower, of.higher
    least = 1.0e-30 if real is wp.float32 else 1.0e-250

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
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
        tile = offset + wp.tid()
        part = parts[tile]
        x0 = (tile % view.tiles_x) * wp.static(TILE)
        y0 = (tile / view.tiles_x) * wp.static(TILE)
        a, b, c, transmittance = rays(view, x0, y0)
        amax = per_pixel(real(rules.alpha_max))
        tmin = per_pixel(real(rules.transmittance_min))
        one = per_pixel(real(1.0))
        of_features = many()
        feature = values()
        of_weight = per_pixel()
        of_range = per_pixel()
        rest = per_pixel()
        for i in range(view.tile * view.tile):
            x = x0 + i % wp.static(TILE)
            y = y0 + i / wp.static(TILE)
            if x < view.width and y < view.height:
                if first == 0 and alphas[y, x] > real(0.0):
                    per_weight = depth_grad[y, x] / alphas[y, x]
                    of_weight[i] = alpha_grad[y, x] - per_weight * ranges[y, x]
                    of_range[i] = per_weight * wp.sqrt(a[i] * a[i] + b[i] * b[i] + c[i] * c[i])
                    rest[i] = alphas[y, x] * alpha_grad[y, x]
                for channel in range(wp.static(width)):
                    of_features[channel, i] = image_grad[y, x, first + channel]
                    rest[i] = rest[i] + image_grad[y, x, first + channel] * image[y, x, first + channel]
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            splat = splats[k]
            g0, g1, g2, n, square = meet(splat, a, b, c)
            counts = lower(lower(splat.cut * square - n, g0), transmittance - tmin)
            if not any_positive(counts):
                if not any_positive(transmittance - tmin):
                    break
                continue
            inverse = wp.cw_div(one, square)
            q = wp.cw_mul(n, inverse)
            kept = where_positive(counts, response(q), per_pixel())
            raw = splat.opacity * kept
            alpha = lower(raw, amax)
            weight = wp.cw_mul(alpha, transmittance)
            lever = wp.cw_mul(g0, inverse)
            for i in range(wp.static(width)):
                feature[i] = features[k, first + i]
            value = feature * of_features + of_weight + splat.reach * wp.cw_mul(lever, of_range)
            rest -= wp.cw_mul(weight, value)
            hidden = rest
            if rules.rule == wp.static(PRODUCT):
                hidden = wp.cw_div(rest, higher(one - alpha, per_pixel(real(wp.static(least)))))
            unclamped = where_positive(raw - amax, per_pixel(), kept)
            slope = wp.cw_mul(wp.cw_mul(transmittance, value) - hidden, unclamped)
            transmittance = behind(transmittance, alpha, rules.rule)
            y1 = wp.cw_mul(lever, g1)
            y2 = wp.cw_mul(lever, g2)
            pull = wp.cw_mul(wp.cw_mul(weight, of_range), inverse)
            h0 = splat.lift * wp.cw_mul(pull, g0)
            h1 = splat.tilt * wp.cw_mul(pull, g1)
            h2 = splat.tilt * wp.cw_mul(pull, g2)
            s = pair_sums(slope, q, y1, y2, h0, h1, h2, weight)
            for i in range(wp.static(width)):
                s[wp.static(OF_FEATURES) + i] = total(wp.cw_mul(of_features[i], weight))
            sums[part, k] = sums[part, k] + s

    return blend_adjoint


@once
def build_strongest(real: type) -> Any:
    """As :func:`.reference.build_strongest`."""
    per_pixel = wp.types.vector(PIXELS, real)
    integers = wp.types.vector(PIXELS, int)
    Splat = splat_of(real)
    of, block = vector_functions(real), block_functions(real)
    any_positive, where_positive, response = of.any_positive, of.where_positive, of.response
    rays, meet, behind = block.rays, block.meet, block.behind
    lower = of.lower

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
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
        tile = offset + wp.tid()
        x0 = (tile % view.tiles_x) * wp.static(TILE)
        y0 = (tile / view.tiles_x) * wp.static(TILE)
        a, b, c, transmittance = rays(view, x0, y0)
        amax = per_pixel(real(rules.alpha_max))
        tmin = per_pixel(real(rules.transmittance_min))
        total = per_pixel()
        kept = integers()
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            splat = splats[k]
            g0, g1, g2, n, square = meet(splat, a, b, c)
            counts = lower(lower(splat.cut * square - n, g0), transmittance - tmin)
            if not any_positive(counts):
                if not any_positive(transmittance - tmin):
                    break
                continue
            inverse = wp.cw_div(per_pixel(real(1.0)), square)
            faded = splat.opacity * response(wp.cw_mul(n, inverse))
            alpha = where_positive(counts, lower(faded, amax), per_pixel())
            weight = wp.cw_mul(alpha, transmittance)
            transmittance = behind(transmittance, alpha, rules.rule)
            total += weight
            for i in range(view.tile * view.tile):
                if weight[i] > real(0.0):
                    x = x0 + i % wp.static(TILE)
                    y = y0 + i / wp.static(TILE)
                    t = splat.reach * g0[i] * inverse[i] * wp.sqrt(a[i] * a[i] + b[i] * b[i] + c[i] * c[i])
                    kept[i] = keep_weight(index, weight_out, range_out, y, x, kept[i], k, weight[i], t)
        for i in range(view.tile * view.tile):
            x = x0 + i % wp.static(TILE)
            y = y0 + i / wp.static(TILE)
            if x < view.width and y < view.height:
                total_out[y, x] = total[i]

    return strongest
