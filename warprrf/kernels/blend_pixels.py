"""Blending on a GPU: a thread per pixel, a warp of 32 threads per 8 x 4 pixels; the same sums as :mod:`.blend`.

A warp walks its tile's list 32 entries at a time. Each lane looks at one entry, a ballot tells which of them reach the
warp's two blocks of pixels, and only those are staged in shared memory, by their lanes, and blended. Warps share
nothing, so nothing waits for a whole tile. `blend_adjoint` adds up a warp's 15 sums by halves, 16 shuffles in all (at
each step a lane gives away half of the numbers that it holds), and adds them to the Gaussian's row in one coalesced
atomic operation.

Rows, masks and tile lists are those of :mod:`.project` and :mod:`.binning`. These kernels are for CUDA alone.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.lanes import BLOCK, LANES, lanes_of, lowest_bit
from warprrf.kernels.project import (
    CHANNELS,
    CUT,
    FLAT,
    G0,
    G1,
    G2,
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

WARP = 32  # threads
WHOSE = ROW - 1  # of a staged entry: which Gaussian it is, in a place that rows leave free
PIXELS = TILE * TILE  # threads of a tile: one a pixel
STAGED = ROW + CHANNELS  # numbers staged per entry: its row, its features


def _cuda(code: str, otherwise: str = "") -> str:
    return f"#if defined(__CUDA_ARCH__)\n{code}\n#else\n{otherwise}\n#endif\n"


@wp.func_native(_cuda("return (int)__ballot_sync(0xffffffffu, yes);", "return yes;"))
def ballot(yes: bool) -> int:  # type: ignore[empty-body]
    """Bit i is set where lane i of the warp says yes; all 32 lanes must ask."""
    ...


def _approximate(operation: str, argument: str) -> str:
    """One instruction of the special function unit, without the steps that denormal numbers take."""
    return f'float y; asm("{operation}.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"({argument})); return y;'


def _halving(name: str) -> str:
    """Adds up 16 numbers over 32 lanes: lane i ends with the total of number i / 2."""
    lines = [f"wp::{name} x[16];", "for (int i = 0; i < 16; ++i) x[i] = s[i];"]
    for stride in (16, 8, 4, 2):
        half = stride // 2
        lines.append(
            f'{{ const bool upper = lane & {stride}; _Pragma("unroll") for (int i = 0; i < {half}; ++i) {{'
            f" const wp::{name} keep = upper ? x[i + {half}] : x[i], give = upper ? x[i] : x[i + {half}];"
            f" x[i] = keep + __shfl_xor_sync(0xffffffffu, give, {stride}); }} }}"
        )
    lines.append("return x[0] + __shfl_xor_sync(0xffffffffu, x[0], 1);")
    return _cuda("\n".join(lines), "return s[0];")


@cache
def build_masks(real: Any) -> Any:
    """The kernel that finds which blocks of its tile an entry can reach, for one scalar type: a thread per entry."""
    vec3 = wp.types.vector(3, real)
    lanes = lanes_of(real)
    coefficients = wp.types.vector(ROW, real)
    Rays = rays_of(real)

    @wp.func_native("return source.data[i * 4 + which].c[lane];")
    def column_span(source: wp.array(dtype=lanes, ndim=2), i: int, which: int, lane: int) -> real:  # type: ignore[valid-type, empty-body]
        """One number of a contiguous (n, 4) array."""
        ...

    @wp.func_native("return source.data[i * 2 + which].c[lane];")
    def row_span(source: wp.array(dtype=lanes, ndim=2), i: int, which: int, lane: int) -> real:  # type: ignore[valid-type, empty-body]
        """One number of a contiguous (n, 2) array."""
        ...

    @wp.kernel(module="unique", enable_backward=False)
    def entry_masks(
        offset: int,
        rows: wp.array(dtype=coefficients),
        centres: wp.array(dtype=vec3),
        keys: wp.array(dtype=int),
        slots: wp.array(dtype=int),
        whose: wp.array(dtype=int),
        rays: Rays,
        tiles_x: int,
        ids: wp.array(dtype=int),
        masks: wp.array(dtype=int),
    ):
        """Whose entry it is, and a bit for each block of its tile that it can reach, by the bound of
        ``project.block_masks``."""
        j = offset + wp.tid()
        k = whose[slots[j]]
        ids[j] = k
        row = rows[k]
        centre = centres[k]
        x = keys[j] % tiles_x
        y = keys[j] / tiles_x
        outside = real(1.0) - row[CUT] * row[FLAT]
        mask = int(0)
        if outside <= real(0.0):  # from inside the ellipsoid every ray ahead counts
            mask = int(wp.static((1 << LANES) - 1))
        for b in range(wp.static(LANES)):
            u = column_span(rays.columns, x, 0, b)
            hu = column_span(rays.columns, x, 1, b)
            w = column_span(rays.columns, x, 2, b)
            hw = column_span(rays.columns, x, 3, b)
            v = row_span(rays.rows, y, 0, b)
            hv = row_span(rays.rows, y, 1, b)
            pu = wp.clamp(centre[0], u - hu, u + hu)
            pw = wp.clamp(centre[1], w - hw, w + hw)
            pv = wp.clamp(centre[2], v - hv, v + hv)
            g0 = row[G0] * pu + row[G0 + 1] * pw + row[G0 + 2] * pv
            g1 = row[G1] * pu + row[G1 + 1] * pw + row[G1 + 2] * pv
            g2 = row[G2] * pu + row[G2 + 1] * pw + row[G2 + 2] * pv
            s0 = row[CUT] * g0
            s1 = outside * g1
            s2 = outside * g2
            f = s0 * g0 - s1 * g1 - s2 * g2
            su = row[G0] * s0 - row[G1] * s1 - row[G2] * s2
            sw = row[G0 + 1] * s0 - row[G1 + 1] * s1 - row[G2 + 1] * s2
            sv = row[G0 + 2] * s0 - row[G1 + 2] * s1 - row[G2 + 2] * s2
            slope = su * (u - pu) + sw * (w - pw) + sv * (v - pv)
            slope += wp.abs(su) * hu + wp.abs(sw) * hw + wp.abs(sv) * hv
            change = real(2.0) * (wp.abs(row[G0]) * hu + wp.abs(row[G0 + 1]) * hw + wp.abs(row[G0 + 2]) * hv)
            bound = f + real(2.0) * slope + row[CUT] * change * change
            if g0 + change <= real(0.0):  # all behind
                mask = mask & ~(1 << b)
            elif bound > real(0.0):
                mask = mask | (1 << b)
        masks[j] = mask

    return entry_masks


@cache
def build(real: Any, rule: int, width: int = CHANNELS) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``, one transmittance rule, and 1 to 4 channels at
    once (0 for `strongest`); each is compiled when first launched. Launch ``PIXELS`` threads a tile, in blocks of 256.
    """
    lanes = lanes_of(real)
    coefficients = wp.types.vector(ROW, real)
    entry = wp.types.vector(STAGED, real)
    Rays = rays_of(real)
    single = real is wp.float32
    name = real.__name__
    tiny = 1.0e-30 if single else 1.0e-250
    wide = "float4" if single else "double2"  # 16 bytes
    per_wide = 4 if single else 2

    @wp.func_native(
        _cuda(
            f"""
    __shared__ {wide} kept[{PIXELS * STAGED // per_wide}];
    return (wp::uint64)(kept + (threadIdx.x & ~{WARP - 1}) * {STAGED // per_wide});
    """,
            "return 0;",
        )
    )
    def shelf() -> wp.uint64:  # type: ignore[empty-body]
        """Shared memory of this warp, for one staged entry a lane."""
        ...

    @wp.func_native(
        _cuda(f"""
    const {wide}* row = (const {wide}*)(rows.data + k);
    {wide} parts[{ROW // per_wide}];
    _Pragma("unroll") for (int i = 0; i < {ROW // per_wide}; ++i) parts[i] = row[i];
    {wide}* mine = ({wide}*)place + lane * {STAGED // per_wide};
    _Pragma("unroll") for (int i = 0; i < {ROW // per_wide}; ++i) mine[i] = parts[i];
    wp::{name}* last = (wp::{name}*)(mine + {ROW // per_wide});
    last[{WHOSE - ROW}] = {"__int_as_float(k)" if single else "(double)k"};
    const wp::{name}* f = features.data + (wp::int64)k * channels + first;
    _Pragma("unroll") for (int i = 0; i < {width}; ++i) last[i] = f[i];
    """)
    )
    def stage(
        place: wp.uint64,
        lane: int,
        rows: wp.array(dtype=coefficients),
        features: wp.array(dtype=real),
        k: int,
        channels: int,
        first: int,
    ):  # type: ignore[valid-type]
        """Put a Gaussian's row and features on this lane's place of the shelf."""
        ...

    @wp.func_native(_cuda("__syncwarp();"))
    def settle():  # type: ignore[empty-body]
        """What the warp's lanes wrote to the shelf before is there for all of them after.

        A ballot brings the lanes together too, but gives no order to what they read and write.
        """
        ...

    @wp.func_native(f"""
    wp::vec_t<{STAGED}, wp::{name}> out;
    #if defined(__CUDA_ARCH__)
    const {wide}* from = (const {wide}*)place + lane * {STAGED // per_wide};
    _Pragma("unroll") for (int i = 0; i < {STAGED // per_wide}; ++i) {{
        const {wide} part = from[i];
        const wp::{name}* numbers = (const wp::{name}*)&part;
        _Pragma("unroll") for (int j = 0; j < {per_wide}; ++j) out[i * {per_wide} + j] = numbers[j];
    }}
    #endif
    return out;
    """)
    def staged(place: wp.uint64, lane: int) -> entry:  # type: ignore[valid-type, empty-body]
        """What lane ``lane`` staged."""
        ...

    @wp.func_native(_cuda(f"return {'__float_as_int(staged)' if single else '(int)staged'};", "return 0;"))
    def gaussian(staged: real) -> int:  # type: ignore[valid-type, empty-body]
        """The number of the Gaussian in place ``WHOSE`` of a staged entry."""
        ...

    @wp.func_native(_halving(name))
    def warp_sums(s: lanes, lane: int) -> real:  # type: ignore[valid-type, empty-body]
        """The total over the warp of number ``lane / 2`` of 16; all 32 lanes must ask."""
        ...

    @wp.func_native("return source.data[i].c[j];")
    def number(source: wp.array(dtype=lanes), i: int, j: int) -> real:  # type: ignore[valid-type, empty-body]
        """Number ``j`` of element ``i`` of a contiguous array."""
        ...

    @wp.func_native("wp::atomic_add(&target.data[i].c[j], value);")
    def add(target: wp.array(dtype=coefficients), i: int, j: int, value: real):  # type: ignore[valid-type]
        """Add atomically to number ``j`` of element ``i`` of a contiguous array."""
        ...

    if single:

        @wp.func_native(_cuda(_approximate("rcp", "x"), "return 1.0f / x;"))
        def inverse(x: real) -> real:  # type: ignore[valid-type, empty-body]
            """1 / x to 1 unit in the last place, for normal x below 2^126."""
            ...

        @wp.func_native(_cuda(_approximate("ex2", "q * -0.72134752f"), "return expf(-0.5f * q);"))
        def response(q: real) -> real:  # type: ignore[valid-type, empty-body]
            """exp(-q/2) for 0 <= q <= 80, to 4e-6 of itself."""
            ...

    else:

        @wp.func
        def inverse(x: real):
            return real(1.0) / x

        @wp.func
        def response(q: real):
            return wp.exp(real(-0.5) * q)

    if rule == PRODUCT:

        @wp.func
        def thinned(transmittance: real, alpha: real, weight: real):
            """What is left behind a layer; ``weight`` is alpha times transmittance."""
            return transmittance - weight

        @wp.func
        def behind(goal: real, alpha: real):
            """How the light from behind a layer changes with its alpha."""
            return goal * inverse(wp.max(real(1.0) - alpha, real(wp.static(tiny))))

    else:

        @wp.func
        def thinned(transmittance: real, alpha: real, weight: real):
            return transmittance * response(real(2.0) * alpha)

        @wp.func
        def behind(goal: real, alpha: real):
            return goal

    @wp.func
    def place_of(thread: int, view: View):
        """Tile, bits of the warp's two blocks in a mask, column and row of the thread's block, and its pixel there.

        Half a warp has a block of 4 x 4 pixels: blocks 2w and 2w + 1 of the tile lie beside each other.
        """
        tile = thread / wp.static(PIXELS)
        b = (thread % wp.static(PIXELS)) / wp.static(LANES)
        p = thread % wp.static(LANES)
        column = (tile % view.tiles_x) * wp.static(TILE // BLOCK) + b % wp.static(TILE // BLOCK)
        line = (tile / view.tiles_x) * wp.static(TILE // BLOCK) + b / wp.static(TILE // BLOCK)
        return tile, int(3) << (b & -2), column, line, p

    @wp.func
    def ray_of(rays: Rays, column: int, line: int, p: int):
        """A pixel's ray, as across, along, down."""
        return number(rays.across, column, p), number(rays.along, column, p), number(rays.down, line, p)

    @wp.func
    def next_entries(
        place: wp.uint64,
        lane: int,
        begin: int,
        last: int,
        mine: int,
        ids: wp.array(dtype=int),
        masks: wp.array(dtype=int),
        rows: wp.array(dtype=coefficients),
        features: wp.array(dtype=real),
        channels: int,
        first: int,
    ):
        """Stage those of the next 32 entries that reach the warp's blocks ``mine``: a bit each."""
        settle()  # the last ones have been read
        reached = bool(False)
        if begin + lane < last:
            reached = (masks[begin + lane] & mine) != 0
            if reached:
                stage(place, lane, rows, features, ids[begin + lane], channels, first)
        waiting = ballot(reached)
        settle()
        return waiting

    @wp.func
    def look(row: entry, across: real, along: real, down: real):
        """g0, g1, g2, g1^2 + g2^2 and |g|^2 of an entry on a ray, and whether the ray passes within the cutoff."""
        g0 = row[G0] * across + row[G0 + 1] * along + row[G0 + 2] * down
        g1 = row[G1] * across + row[G1 + 1] * along + row[G1 + 2] * down
        g2 = row[G2] * across + row[G2 + 1] * along + row[G2 + 2] * down
        n = g1 * g1 + g2 * g2
        square = wp.max(g0 * g0 + row[FLAT] * n, real(wp.static(tiny)))
        return g0, g1, g2, n, square, row[CUT] * square > n and g0 > real(0.0)

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
        """The ``capacity`` largest blending weights of each pixel, as ``weights.strongest`` finds them; for a ``width``
        of 0, with ``nothing`` for features."""
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

    @wp.kernel(module="unique", enable_backward=False)
    def any_gradient(offset: int, values: wp.array(dtype=real), found: wp.array(dtype=int)):
        """Set ``found`` where a value is not zero."""
        if values[offset + wp.tid()] != real(0.0):
            found[0] = 1

    return SimpleNamespace(
        any_gradient=any_gradient,
        blend=blend,
        blend_adjoint=(adjoint_kernel(False), adjoint_kernel(True)),  # with or without gradients of ranges
        strongest=strongest,
    )
