"""What the 32 threads of a GPU's warp do together: ballots, a shelf in shared memory, sums by halves; for CUDA alone.

A warp has 8 x 4 pixels of a tile, a thread each, and walks its tile's list 32 entries at a time. Each lane looks at one
entry, a ballot tells which of them reach the warp's two blocks of pixels, and only those are staged in shared memory,
by their lanes. Warps share nothing, so nothing waits for a whole tile.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import BLOCK, LANES, lanes_of
from warprrf.kernels.raster.project import (
    CHANNELS,
    CUT,
    FLAT,
    G0,
    G1,
    G2,
    PRODUCT,
    ROW,
    TILE,
    View,
    rays_of,
)

WARP = 32  # threads
PIXELS = TILE * TILE  # threads of a tile: one a pixel
STAGED = ROW + CHANNELS  # numbers staged per entry: its row, its features
WHOSE = ROW - 1  # of a staged entry: which Gaussian it is, in a place that rows leave free


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
def build(real: Any, rule: int, width: int) -> SimpleNamespace:
    """The functions for one scalar type, ``wp.float32`` or ``wp.float64``, one transmittance rule, and entries staged
    with 0 to 4 channels of features."""
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

    return SimpleNamespace(
        add=add,
        behind=behind,
        gaussian=gaussian,
        inverse=inverse,
        look=look,
        next_entries=next_entries,
        number=number,
        place_of=place_of,
        ray_of=ray_of,
        response=response,
        shelf=shelf,
        staged=staged,
        thinned=thinned,
        warp_sums=warp_sums,
    )
