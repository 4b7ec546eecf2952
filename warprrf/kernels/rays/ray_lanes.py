"""Rays in lanes: 16 of them side by side, read from rows, rounded and written as Embree takes them. CPU only.

Rows of three or four numbers become vectors of 16, one a coordinate, by shuffles of whole registers: Warp's indexing,
and what a compiler makes of a loop, take several times as long.
"""

from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import LANES, VECTORISED, lanes_of
from warprrf.kernels.raster.lanes import build as lane_functions

RAY_OPTIONS = {
    "cpu_compiler_flags": VECTORISED["cpu_compiler_flags"].replace("-ffp-contract=fast", "-ffp-contract=off")
}
"""Module options of kernels on rays: products are rounded before they are added, as on a single ray."""

doubles = lanes_of(wp.float64)
singles = lanes_of(wp.float32)
integers = lanes_of(int)
rounded_rows = wp.types.vector(3 * LANES, wp.float32)
"""16 rows in float32, one behind the other."""
_of = lane_functions(wp.float64)
_of_singles = lane_functions(wp.float32)
above, higher, lower, positive_bits, roots = _of.above, _of.higher, _of.lower, _of.positive_bits, _of.roots
above_of_singles, positive_bits_of_singles = _of_singles.above, _of_singles.positive_bits
roots_of_singles = _of_singles.roots

_HALF = LANES // 2  # numbers of float64 that a register of 512 bits holds
_AHEAD = 16  # blocks of 16 rows, 6 KiB
_CELLS = 16  # that a key tells apart along each axis: with eight octants, all that 15 bits hold
EVERY = (1 << LANES) - 1
"""A bit for each lane."""
HALF_LANES = f"""
    typedef wp::float64 half_lanes __attribute__((vector_size({_HALF} * sizeof(wp::float64)), aligned(8)));
    typedef wp::float64 line __attribute__((vector_size({_HALF} * sizeof(wp::float64))));
    typedef wp::float64 quarter __attribute__((vector_size(4 * sizeof(wp::float64)), aligned(8)));
    typedef wp::float32 narrow_lanes __attribute__((vector_size({LANES} * sizeof(wp::float32)), aligned(4)));
    typedef wp::float32 narrow_half __attribute__((vector_size({_HALF} * sizeof(wp::float32)), aligned(4)));
"""


def _shuffle(a: str, b: str, places: list[int]) -> str:
    """C++ that picks numbers of two vectors that lie behind each other; -1 picks any."""
    return f"__builtin_shufflevector({a}, {b}, {', '.join(map(str, places))})"


def _column(c: int) -> Any:
    """Coordinate ``c`` of 16 rows that follow each other; of the only row if there is one."""
    flat = [3 * j + c for j in range(_HALF)]
    two = [f if f < 2 * _HALF else -1 for f in flat]
    third = [j if f < 2 * _HALF else f - _HALF for j, f in enumerate(flat)]
    halves = " ".join(
        f"to[{h}] = {_shuffle(_shuffle(f'p[{3 * h}]', f'p[{3 * h + 1}]', two), f'p[{3 * h + 2}]', third)};"
        for h in (0, 1)
    )

    @wp.func_native(f"""{HALF_LANES}
    if (source.shape[0] == 1) return wp::vec_t<{LANES}, wp::float64>(source.data[0][{c}]);
    wp::vec_t<{LANES}, wp::float64> out;
    const half_lanes* p = (const half_lanes*)(source.data + i);
    half_lanes* to = (half_lanes*)&out;
    {halves}
    return out;
    """)
    def column(source: wp.array(dtype=wp.vec3d), i: int) -> doubles:  # type: ignore[valid-type, empty-body]
        """A coordinate of rows ``i`` to ``i + 16``."""
        ...

    return column


def _column_at(c: int) -> Any:
    """Coordinate ``c`` of 16 rows anywhere; of the only row if there is one."""
    # Number by number: a loop would become the processor's gathering, which is slower.
    halves = " ".join(
        f"to[{h}] = half_lanes{{{', '.join(f'from[which.data[k + {_HALF * h + j}]][{c}]' for j in range(_HALF))}}};"
        for h in (0, 1)
    )

    @wp.func_native(f"""{HALF_LANES}
    const wp::vec3d* from = source.data + first;
    if (source.shape[0] == 1) return wp::vec_t<{LANES}, wp::float64>(source.data[0][{c}]);
    wp::vec_t<{LANES}, wp::float64> out;
    half_lanes* to = (half_lanes*)&out;
    {halves}
    return out;
    """)
    def column_at(
        source: wp.array(dtype=wp.vec3d), first: int, which: wp.array(dtype=int), k: int
    ) -> doubles:  # type: ignore[valid-type, empty-body]
        """A coordinate of rows ``first`` plus elements ``k`` to ``k + 16`` of ``which``."""
        ...

    return column_at


def _plane_number(c: int) -> Any:
    """Number ``c`` of 16 planes: four planes at a time are turned, and the other numbers' code is the same."""
    turned = []
    for q in range(LANES // 4):
        pairs = [f"*(const quarter*)(planes.data + rows[{4 * q + j}])" for j in range(4)]
        ab, cd = (_shuffle(pairs[m], pairs[m + 1], list(range(8))) for m in (0, 2))
        low = c // 2 * 2
        turned.append(
            f"const half_lanes q{q} = {_shuffle(ab, cd, [n + m for m in (low, low + 1) for n in (0, 4, 8, 12)])};"
        )
    side = 4 * (c % 2)
    places = [side + j for j in range(4)] + [8 + side + j for j in range(4)]

    @wp.func_native(f"""{HALF_LANES}
    wp::vec_t<{LANES}, wp::float64> out;
    half_lanes* to = (half_lanes*)&out;
    {" ".join(turned)}
    to[0] = {_shuffle("q0", "q1", places)};
    to[1] = {_shuffle("q2", "q3", places)};
    return out;
    """)
    def plane_number(planes: wp.array(dtype=wp.vec4d), rows: integers) -> doubles:  # type: ignore[valid-type, empty-body]
        """A number of the planes ``rows``."""
        ...

    return plane_number


@wp.func_native(f"""
    const char* ahead = (const char*)(source.data + i + {LANES} * {_AHEAD});
    if (i + {LANES} * {_AHEAD + 1} <= source.shape[0])
        for (int line = 0; line < {LANES} * 24; line += 64) __builtin_prefetch(ahead + line);
""")
def fetch_rows(source: wp.array(dtype=wp.vec3d), i: int) -> None:
    """Ask for the rows that will be wanted some blocks after row ``i``: a processor reads less far ahead by itself."""
    ...


@wp.func_native(f"""
    if (k + {LANES} * (3) <= which.shape[0] && source.shape[0] > 1)
        for (int j = 0; j < {LANES}; ++j)
            __builtin_prefetch(source.data + first + which.data[k + {LANES} * 2 + j]);
""")
def fetch_rows_at(source: wp.array(dtype=wp.vec3d), first: int, which: wp.array(dtype=int), k: int) -> None:
    """Ask for the rows that will be wanted two blocks later."""
    ...


def _row_part(c: int) -> Any:
    """Coordinate ``c`` of 16 rows in float32."""
    flat = [3 * j + c for j in range(LANES)]
    two = [f if f < 2 * LANES else -1 for f in flat]
    third = [j if f < 2 * LANES else f - LANES for j, f in enumerate(flat)]

    @wp.func_native(f"""{HALF_LANES}
    wp::vec_t<{LANES}, wp::float32> out;
    const narrow_lanes* p = (const narrow_lanes*)&rows;
    *(narrow_lanes*)&out = {_shuffle(_shuffle("p[0]", "p[1]", two), "p[2]", third)};
    return out;
    """)
    def row_part(rows: rounded_rows) -> singles:  # type: ignore[valid-type, empty-body]
        """A coordinate of each row."""
        ...

    return row_part


_HALVES = [f"__builtin_convertvector(r[2 * n + {h}], narrow_half)" for h in (0, 1)]
# Rows turn into columns after they are rounded: that takes a third of the shuffles.
_ROUND = f"""
    narrow_lanes* to = (narrow_lanes*)&out;
    for (int n = 0; n < 3; ++n) to[n] = {_shuffle(*_HALVES, list(range(LANES)))};
"""


def _relative(rows: str, source: str) -> str:
    """C++ that makes ``rows`` the 16 rows ``i`` to ``i + 16`` of ``source``, or its only one, less the centre."""
    patterns = ", ".join(
        "half_lanes{" + ", ".join(f"center[{(_HALF * n + j) % 3}]" for j in range(_HALF)) + "}"
        for n in range(3)
    )
    alone = ", ".join(
        "half_lanes{" + ", ".join(f"only[{(_HALF * n + j) % 3}]" for j in range(_HALF)) + "}"
        for n in range(3)
    )
    return f"""
    half_lanes {rows}[6];
    {{
        const half_lanes away[3] = {{{patterns}}};
        if ({source}.shape[0] == 1) {{
            const wp::vec3d only = {source}.data[0];
            const half_lanes same[3] = {{{alone}}};
            for (int n = 0; n < 6; ++n) {rows}[n] = same[n % 3] - away[n % 3];
        }} else {{
            const half_lanes* from = (const half_lanes*)({source}.data + i);
            for (int n = 0; n < 6; ++n) {rows}[n] = from[n] - away[n % 3];
        }}
    }}
    """


@wp.func_native(f"""{HALF_LANES}
    wp::vec_t<{3 * LANES}, wp::float32> out;
    {_relative("r", "source")}
    {_ROUND}
    return out;
""")
def round_rows(source: wp.array(dtype=wp.vec3d), i: int, center: wp.vec3d) -> rounded_rows:  # type: ignore[valid-type, empty-body]
    """Rows ``i`` to ``i + 16``, less ``center``; the only row if there is one."""
    ...


@wp.func_native(f"""{HALF_LANES}
    wp::vec_t<{3 * LANES}, wp::float32> out;
    {_relative("a", "starts")}
    {_relative("r", "ends")}
    for (int n = 0; n < 6; ++n) r[n] -= a[n];
    {_ROUND}
    return out;
""")
def round_ways(
    starts: wp.array(dtype=wp.vec3d), ends: wp.array(dtype=wp.vec3d), i: int, center: wp.vec3d
) -> rounded_rows:  # type: ignore[valid-type, empty-body]
    """Rows ``i`` to ``i + 16`` of ``ends`` less those of ``starts``, both taken less ``center``."""
    ...


column_x, column_y, column_z = (_column(c) for c in range(3))
row_x, row_y, row_z = (_row_part(c) for c in range(3))
column_x_at, column_y_at, column_z_at = (_column_at(c) for c in range(3))
plane_x, plane_y, plane_z, plane_w = (_plane_number(c) for c in range(4))


def _pack() -> str:
    """C++ that writes 16 rays of six numbers: first pairs of numbers of a ray side by side, then three pairs a ray."""
    pairs = [
        f"const half_lanes p{pair}{side} = (half_lanes)"
        + _shuffle(a, b, [n for j in range(_HALF) for n in (_HALF * side + j, LANES + _HALF * side + j)])
        + ";"
        for pair, (a, b) in enumerate((("x", "y"), ("z", "u"), ("v", "w")))
        for side in (0, 1)
    ]
    stores = []
    for side in (0, 1):
        for part in range(3):
            places = [divmod(_HALF * part + j, 3) for j in range(_HALF)]  # ray and pair of each place
            two = [ray + _HALF * pair if pair < 2 else -1 for ray, pair in places]
            third = [j if pair < 2 else _HALF + ray for j, (ray, pair) in enumerate(places)]
            whole = _shuffle(_shuffle(f"p0{side}", f"p1{side}", two), f"p2{side}", third)
            stores.append(f"__builtin_nontemporal_store((line){whole}, to + {3 * side + part});")
    return f"""{HALF_LANES}
    const narrow_lanes x = *(const narrow_lanes*)&sx, y = *(const narrow_lanes*)&sy, z = *(const narrow_lanes*)&sz;
    const narrow_lanes u = *(const narrow_lanes*)&dx, v = *(const narrow_lanes*)&dy, w = *(const narrow_lanes*)&dz;
    line* to = (line*)(rays.data + 2 * k);
    {" ".join(pairs)}
    {" ".join(stores)}
    """


@wp.func_native(_pack())
def put_rays(
    rays: wp.array(dtype=wp.vec3),
    k: int,
    sx: singles,  # type: ignore[valid-type]
    sy: singles,  # type: ignore[valid-type]
    sz: singles,  # type: ignore[valid-type]
    dx: singles,  # type: ignore[valid-type]
    dy: singles,  # type: ignore[valid-type]
    dz: singles,  # type: ignore[valid-type]
) -> None:
    """Write rays ``k`` to ``k + 16``, start and direction each, past the cache.

    The first ray lies on a boundary of 64 bytes. The lock that the interpreter takes next makes them seen by others.
    """
    ...


@wp.func_native(f"""{HALF_LANES}
    const half_lanes* from = (const half_lanes*)(source.data + i);
    line* to = (line*)(copy.data + i);
    for (int n = 0; n < 6; ++n) __builtin_nontemporal_store((line)from[n], to + n);
""")
def copy_rows(source: wp.array(dtype=wp.vec3d), copy: wp.array(dtype=wp.vec3d), i: int) -> None:
    """Copy rows ``i`` to ``i + 16``, past the cache; the copy's first lies on a boundary of 64 bytes."""
    ...


@wp.func_native(f"""
    const wp::float32 each = {_CELLS // 2} / radius, most = {_CELLS - 1};
    for (int j = 0; j < {LANES}; ++j) {{
        int key = (dx[j] > 0) | (dy[j] > 0) << 1 | (dz[j] > 0) << 2;
        const wp::float32 start[3] = {{sx[j], sy[j], sz[j]}};
        for (int c = 0; c < 3; ++c) {{
            const wp::float32 cell = start[c] * each + {_CELLS // 2};
            key = {_CELLS} * key + wp::int32(cell > 0 ? (cell < most ? cell : most) : 0);
        }}
        keys.data[k + j] = key;
    }}
""")
def put_keys(
    keys: wp.array(dtype=wp.uint16),
    k: int,
    radius: wp.float32,
    sx: singles,  # type: ignore[valid-type]
    sy: singles,  # type: ignore[valid-type]
    sz: singles,  # type: ignore[valid-type]
    dx: singles,  # type: ignore[valid-type]
    dy: singles,  # type: ignore[valid-type]
    dz: singles,  # type: ignore[valid-type]
) -> None:
    """Write keys ``k`` to ``k + 16``: rays of one key go into one octant and start in one cell of the bounds."""
    ...


@wp.func_native(f"""
    wp::vec_t<{LANES}, wp::float64> out;
    for (int j = 0; j < {LANES}; ++j) out[j] = source.data[i + j];
    return out;
""")
def numbers(source: wp.array(dtype=wp.float64), i: int) -> doubles:  # type: ignore[valid-type, empty-body]
    """Elements ``i`` to ``i + 16``."""
    ...


@wp.func_native(f"""
    wp::vec_t<{LANES}, wp::float32> out;
    for (int j = 0; j < {LANES}; ++j) out[j] = wp::float32(x[j]);
    return out;
""")
def rounded(x: doubles) -> singles:  # type: ignore[valid-type, empty-body]
    """In float32."""
    ...


@wp.func_native(f"""
    wp::vec_t<{LANES}, wp::float64> out;
    for (int j = 0; j < {LANES}; ++j) out[j] = __builtin_fabs(x[j]);
    return out;
""")
def magnitude(x: doubles) -> doubles:  # type: ignore[valid-type, empty-body]
    """Absolute values."""
    ...


@wp.func_native(f"""
    wp::vec_t<{LANES}, wp::float32> out;
    for (int j = 0; j < {LANES}; ++j) out[j] = __builtin_fabsf(x[j]);
    return out;
""")
def magnitude_of_singles(x: singles) -> singles:  # type: ignore[valid-type, empty-body]
    """Absolute values."""
    ...


@wp.func_native(f"""
    wp::vec_t<{LANES}, wp::int32> out;
    for (int j = 0; j < {LANES}; ++j) {{
        const int name = met.data[k + j];
        out[j] = name > 0 ? name : 0;
    }}
    if (names.shape[0] > 0)
        for (int j = 0; j < {LANES}; ++j) out[j] = names.data[out[j]];
    return out;
""")
def faces_met(met: wp.array(dtype=wp.int32), k: int, names: wp.array(dtype=wp.int32)) -> integers:  # type: ignore[valid-type, empty-body]
    """Faces ``k`` to ``k + 16`` of ``met``, which ``names`` lists if it is not empty; any face for a miss."""
    ...


@wp.func_native(f"""
    typedef wp::int32 lanes __attribute__((vector_size({LANES} * sizeof(wp::int32)), aligned(4)));
    typedef bool yes __attribute__((ext_vector_type({LANES})));
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(*(const lanes*)(met.data + k) >= 0, yes));
""")
def met_bits(met: wp.array(dtype=wp.int32), k: int) -> int:  # type: ignore[empty-body]
    """Bit j is set where ray ``k + j`` met something."""
    ...


@wp.func_native(f"""
    if (k + 2 * {LANES} <= met.shape[0])
        for (int j = 0; j < {LANES}; ++j) {{
            const int ahead = met.data[k + {LANES} + j];
            __builtin_prefetch(planes.data + (ahead > 0 ? ahead : 0));
        }}
""")
def fetch_ahead(planes: wp.array(dtype=wp.vec4d), met: wp.array(dtype=wp.int32), k: int) -> None:
    """Ask for the planes of the next 16 rays: incoherent ones find them in no cache."""
    ...


@wp.func_native(f"""{HALF_LANES}
    typedef wp::int32 whole __attribute__((vector_size({LANES} * sizeof(wp::int32)), aligned(4)));
    const half_lanes* from = (const half_lanes*)&t;
    half_lanes* to = (half_lanes*)(distance.data + i);
    to[0] = from[0];
    to[1] = from[1];
    *(whole*)(face.data + i) = *(const whole*)&name;
""")
def keep(
    distance: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.int32),
    i: int,
    t: doubles,  # type: ignore[valid-type]
    name: integers,  # type: ignore[valid-type]
) -> None:
    """Write hits ``i`` to ``i + 16``."""
    ...


@wp.func
def row(source: wp.array(dtype=wp.vec3d), i: int):
    """Row ``i``, or the only one."""
    return source[wp.min(i, source.shape[0] - 1)]
