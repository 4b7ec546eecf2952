"""Rays for Embree on a CPU: packed in float32, and what they met placed in float64 on the planes of the faces.

Embree takes rays as six float32 and names a face. A thread owns 16 rays, and computes on all at once, a number of each
to a lane. Those that are not plain (misses, grazing or bad rays, surfaces at a ray's start, fewer than 16 at the end)
it takes one by one, by the rules of :mod:`warprrf.kernels.rays`. Products are rounded before they are added, as there:
distances agree to the bit.
"""

from typing import Any

import warp as wp

from warprrf.kernels.lanes import LANES, VECTORISED, lanes_of, lowest_bit
from warprrf.kernels.lanes import build as lane_functions
from warprrf.kernels.rays import (
    AGAIN,
    BAD,
    BLOCKED,
    FREE,
    MISS,
    ROUNDING,
    is_bad,
    narrow,
    plane_distance,
    rounding_scale,
)

BLOCKER = 12
"""Numbers that :func:`pack_segments` knows a blocker by: its plane, and two barycentric coordinates of points."""

# Beyond these a hit is neither grazing nor at the ray's start, without a closer look.
_STEEP_SQUARE = wp.constant(wp.float64(1e-12))
_CLEAR = wp.constant(wp.float64(1e-9))
# Squares between these neither overflow nor lose digits in float32.
_LEAST_SQUARE = wp.constant(wp.float32(1e-30))
_MOST_SQUARE = wp.constant(wp.float32(1e30))
# A known blocker is not asked about points nearer than this, in barycentric coordinates, to its edges.
_INSIDE = wp.constant(wp.float64(1e-6))

_OPTIONS = {
    "cpu_compiler_flags": VECTORISED["cpu_compiler_flags"].replace("-ffp-contract=fast", "-ffp-contract=off")
}

doubles = lanes_of(wp.float64)
singles = lanes_of(wp.float32)
integers = lanes_of(int)
_of = lane_functions(wp.float64)
_of_singles = lane_functions(wp.float32)
above, higher, lower, positive_bits, roots = _of.above, _of.higher, _of.lower, _of.positive_bits, _of.roots
above_of_singles, positive_bits_of_singles = _of_singles.above, _of_singles.positive_bits
roots_of_singles = _of_singles.roots

_HALF = LANES // 2  # numbers of float64 that a register of 512 bits holds
_AHEAD = 16  # blocks of 16 rows, 3 KiB
_CELLS = 4  # that a key tells apart along each axis
_EVERY = (1 << LANES) - 1
_TYPES = f"""
    typedef wp::float64 half_lanes __attribute__((vector_size({_HALF} * sizeof(wp::float64)), aligned(8)));
    typedef wp::float64 quarter __attribute__((vector_size(4 * sizeof(wp::float64)), aligned(8)));
    typedef wp::float32 narrow_lanes __attribute__((vector_size({LANES} * sizeof(wp::float32)), aligned(4)));
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

    @wp.func_native(f"""{_TYPES}
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

    @wp.func_native(f"""{_TYPES}
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

    @wp.func_native(f"""{_TYPES}
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


column_x, column_y, column_z = (_column(c) for c in range(3))
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
            stores.append(f"to[{3 * side + part}] = {whole};")
    return f"""{_TYPES}
    const narrow_lanes x = *(const narrow_lanes*)&sx, y = *(const narrow_lanes*)&sy, z = *(const narrow_lanes*)&sz;
    const narrow_lanes u = *(const narrow_lanes*)&dx, v = *(const narrow_lanes*)&dy, w = *(const narrow_lanes*)&dz;
    half_lanes* to = (half_lanes*)(rays.data + 2 * k);
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
    """Write rays ``k`` to ``k + 16``, start and direction each."""
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


@wp.func_native(f"""{_TYPES}
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


@wp.func_native(f"""{_TYPES}
    // Which faces are asked does not change an answer, so neither do the roundings of a fused product and sum.
    wp::vec_t<{LANES}, wp::float64> out;
    half_lanes* to = (half_lanes*)&out;
    const half_lanes *a = (const half_lanes*)&x, *b = (const half_lanes*)&y, *c = (const half_lanes*)&z;
    for (int h = 0; h < 2; ++h)
        to[h] = __builtin_elementwise_fma(
            a[h], (half_lanes)(half_lanes{{}} + n.data[f]), __builtin_elementwise_fma(
            b[h], (half_lanes)(half_lanes{{}} + n.data[f + 1]), c[h] * n.data[f + 2]));
    return out;
""")
def along(
    n: wp.array(dtype=wp.float64),
    f: int,
    x: doubles,  # type: ignore[valid-type]
    y: doubles,  # type: ignore[valid-type]
    z: doubles,  # type: ignore[valid-type]
) -> doubles:  # type: ignore[valid-type, empty-body]
    """Product of vectors with numbers ``f`` to ``f + 3``."""
    ...


@wp.func_native(f"""
    for (int j = 0; j < {LANES}; ++j)
        sight.data[i + j] = (bad >> j) & 1 ? {BAD} : (blocked >> j) & 1 ? {BLOCKED} : {FREE};
""")
def tell(sight: wp.array(dtype=wp.int8), i: int, blocked: int, bad: int) -> None:
    """Write FREE, BLOCKED and BAD for segments ``i`` to ``i + 16``."""
    ...


@wp.func_native(f"""
    for (int j = 0; j < {LANES}; ++j) sight.data[first + which.data[k + j]] = {BLOCKED};
""")
def block(sight: wp.array(dtype=wp.int8), first: int, which: wp.array(dtype=wp.int32), k: int) -> None:
    """Write BLOCKED for segments ``first`` plus elements ``k`` to ``k + 16`` of ``which``."""
    ...


@wp.func
def row(source: wp.array(dtype=wp.vec3d), i: int):
    """Row ``i``, or the only one."""
    return source[wp.min(i, source.shape[0] - 1)]


@wp.func
def unit_narrow(direction: wp.vec3d):
    """A direction in float32, of length one to rounding; NaN if it has none. Normalised in float32, which is faster."""
    d = narrow(direction)
    square = wp.dot(d, d)
    if square > _LEAST_SQUARE and square < _MOST_SQUARE:
        return d * (wp.float32(1.0) / wp.sqrt(square))
    return narrow(direction * (wp.float64(1.0) / wp.length(direction)))


@wp.func
def pack_ray(
    i: int,
    k: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    start: wp.array(dtype=wp.float64),
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    rays: wp.array(dtype=wp.vec3),
):
    """Pack ray ``i`` at place ``k``."""
    near = narrow(row(origins, i) - center)
    begin = wp.float32(clearance) - wp.float32(ROUNDING) * (
        wp.float32(radius) + wp.abs(near[0]) + wp.abs(near[1]) + wp.abs(near[2])
    )
    if start.shape[0] > 0:
        begin = wp.float32(start[i])
    unit = unit_narrow(row(directions, i))
    rays[2 * k] = near + begin * unit
    rays[2 * k + 1] = unit


@wp.kernel(module="unique", module_options=_OPTIONS, enable_backward=False)
def pack_rays(
    offset: int,
    first: int,
    size: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    start: wp.array(dtype=wp.float64),
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    rays: wp.array(dtype=wp.vec3),
    keys: wp.array(dtype=wp.uint16),
):
    """``size`` rays from number ``first`` on as pairs (start, unit direction) in float32; a bad one meets nothing.

    ``start`` holds the distance [m] at which each begins; if empty, all begin at ``clearance``, less the rounding.
    ``keys``, if not empty, become numbers that rays near each other share.
    """
    k = wp.static(LANES) * (offset + wp.tid())
    i = first + k
    count = wp.min(size - k, wp.static(LANES))
    rare = (1 << count) - 1
    if count == wp.static(LANES):
        fetch_rows(origins, i)
        fetch_rows(directions, i)
        x = rounded(column_x(origins, i) - doubles(center[0]))
        y = rounded(column_y(origins, i) - doubles(center[1]))
        z = rounded(column_z(origins, i) - doubles(center[2]))
        dx = rounded(column_x(directions, i))
        dy = rounded(column_y(directions, i))
        dz = rounded(column_z(directions, i))
        scale = singles(wp.float32(radius)) + magnitude_of_singles(x)
        scale = scale + magnitude_of_singles(y) + magnitude_of_singles(z)
        begin = singles(wp.float32(clearance)) - wp.float32(ROUNDING) * scale
        if start.shape[0] > 0:
            begin = rounded(numbers(start, i))
        square = wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz)
        if keys.shape[0] > 0:
            put_keys(keys, k, wp.float32(radius), x, y, z, dx, dy, dz)
        inverse = wp.cw_div(singles(wp.float32(1.0)), roots_of_singles(square))
        dx = wp.cw_mul(dx, inverse)
        dy = wp.cw_mul(dy, inverse)
        dz = wp.cw_mul(dz, inverse)
        put_rays(
            rays, k, x + wp.cw_mul(begin, dx), y + wp.cw_mul(begin, dy), z + wp.cw_mul(begin, dz), dx, dy, dz
        )
        low = positive_bits_of_singles(square - singles(_LEAST_SQUARE))
        high = positive_bits_of_singles(singles(_MOST_SQUARE) - square)
        rare = wp.static(_EVERY) - (low & high)
    elif keys.shape[0] > 0:
        for j in range(count):
            keys[k + j] = wp.uint16(0)
    while rare != 0:
        j = lowest_bit(rare)
        rare = rare & (rare - 1)
        pack_ray(i + j, k + j, center, radius, clearance, start, origins, directions, rays)


@wp.func_native(f"""
    const int end = k + {LANES} < size ? k + {LANES} : size;
    for (int j = k; j < end; ++j) {{
        if (j + 2 * {LANES} < size) __builtin_prefetch(rays.data + 2 * which.data[j + 2 * {LANES}]);
        const wp::vec3* from = rays.data + 2 * which.data[j];
        picked.data[2 * j] = from[0];
        picked.data[2 * j + 1] = from[1];
    }}
""")
def pick(
    rays: wp.array(dtype=wp.vec3),
    which: wp.array(dtype=wp.int64),
    k: int,
    size: int,
    picked: wp.array(dtype=wp.vec3),
) -> None:
    """Copy rays ``which[k]`` to ``which[k + 16]``, those below ``size``."""
    ...


@wp.kernel(module="unique", module_options=_OPTIONS, enable_backward=False)
def pick_rays(
    offset: int,
    size: int,
    rays: wp.array(dtype=wp.vec3),
    which: wp.array(dtype=wp.int64),
    picked: wp.array(dtype=wp.vec3),
):
    """The rays of :func:`pack_rays` that ``which`` names, ``size`` of them, one after the other."""
    pick(rays, which, wp.static(LANES) * (offset + wp.tid()), size, picked)


@wp.func
def place_hit(
    i: int,
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    names: wp.array(dtype=wp.int32),
    clearance: wp.float64,
    start: wp.array(dtype=wp.float64),
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    met_at: wp.float32,
    met: int,
    distance: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.int32),
):
    """Place what ray ``i`` met."""
    origin = row(origins, i) - center
    direction = row(directions, i)
    length = wp.length(direction)
    scale = rounding_scale(origin, radius)
    if met < 0:
        distance[i] = wp.float64(wp.inf)
        face[i] = wp.where(is_bad(scale, length), BAD, MISS)
        return
    name = met
    if names.shape[0] > 0:
        name = names[met]
    begin = clearance - ROUNDING * scale
    if start.shape[0] > 0:
        begin = start[i]
    near = begin + wp.float64(met_at)
    t = plane_distance(origin, direction, length, scale, planes[name], near, clearance)
    if wp.isnan(t):
        t = near + ROUNDING * scale
        name = AGAIN
    distance[i] = t
    face[i] = name


@wp.kernel(module="unique", module_options=_OPTIONS, enable_backward=False)
def place_hits(
    offset: int,
    first: int,
    size: int,
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    names: wp.array(dtype=wp.int32),
    clearance: wp.float64,
    start: wp.array(dtype=wp.float64),
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    met_at: wp.array(dtype=wp.float32),
    met: wp.array(dtype=wp.int32),
    distance: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.int32),
):
    """Distances in float64 of what the rays of :func:`pack_rays` met; ``names`` are the faces of a hierarchy's, empty
    if it holds all."""
    k = wp.static(LANES) * (offset + wp.tid())
    i = first + k
    count = wp.min(size - k, wp.static(LANES))
    rare = (1 << count) - 1
    if count == wp.static(LANES):
        fetch_ahead(planes, met, k)
        fetch_rows(origins, i)
        fetch_rows(directions, i)
        name = faces_met(met, k, names)
        nx = plane_x(planes, name)
        ny = plane_y(planes, name)
        nz = plane_z(planes, name)
        x = column_x(origins, i) - doubles(center[0])
        y = column_y(origins, i) - doubles(center[1])
        z = column_z(origins, i) - doubles(center[2])
        dx = column_x(directions, i)
        dy = column_y(directions, i)
        dz = column_z(directions, i)
        square = wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz)
        slope = wp.cw_mul(nx, dx) + wp.cw_mul(ny, dy) + wp.cw_mul(nz, dz)
        height = plane_w(planes, name) - (wp.cw_mul(nx, x) + wp.cw_mul(ny, y) + wp.cw_mul(nz, z))
        t = wp.cw_div(wp.cw_mul(height, roots(square)), slope)
        keep(distance, face, i, t, name)
        scale = doubles(radius) + magnitude(x) + magnitude(y) + magnitude(z)
        # Of two numbers `lower` gives the second beside a NaN, and a ray that is not finite makes t one.
        margin = lower(magnitude(height) - _CLEAR * scale, t - doubles(clearance))
        margin = lower(wp.cw_mul(slope, slope) - _STEEP_SQUARE * square, margin)
        rare = wp.static(_EVERY) - (met_bits(met, k) & positive_bits(margin))
    while rare != 0:
        j = lowest_bit(rare)
        rare = rare & (rare - 1)
        place_hit(
            i + j, center, radius, planes, names, clearance, start, origins, directions, met_at[k + j], met[k + j],
            distance, face,
        )  # fmt: skip


@wp.func
def pack_segment(
    i: int,
    k: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    rays: wp.array(dtype=wp.vec3),
    sight: wp.array(dtype=wp.int8),
):
    """Pack segment ``i`` at place ``k``."""
    origin = row(starts, i) - center
    way = (row(ends, i) - center) - origin
    length = wp.length(way)
    unit = way * (wp.float64(1.0) / length)
    scale = rounding_scale(origin, radius)
    step = ROUNDING * scale
    inner = length - wp.float64(2.0) * clearance
    reach = wp.where(inner > wp.float64(0.0), inner + wp.float64(2.0) * step, wp.float64(wp.nan))
    rays[2 * k] = narrow(origin + (clearance - step) * unit)
    rays[2 * k + 1] = narrow(reach * unit)
    sight[i] = wp.int8(wp.where(wp.isfinite(scale) and wp.isfinite(length), FREE, BAD))


@wp.func
def block_margin(
    blockers: wp.array(dtype=wp.float64),
    f: int,
    x: doubles,  # type: ignore[valid-type]
    y: doubles,  # type: ignore[valid-type]
    z: doubles,  # type: ignore[valid-type]
    dx: doubles,  # type: ignore[valid-type]
    dy: doubles,  # type: ignore[valid-type]
    dz: doubles,  # type: ignore[valid-type]
    square: doubles,  # type: ignore[valid-type]
    length: doubles,  # type: ignore[valid-type]
    scale: doubles,  # type: ignore[valid-type]
    clearance: wp.float64,
):
    """Above 0 where a face, numbers ``f`` on of ``blockers``, surely lies between the ends of a finite segment.

    All is multiplied by the slope, so that nothing is divided.
    """
    slope = along(blockers, f, dx, dy, dz)
    height = doubles(blockers[f + 3]) - along(blockers, f, x, y, z)
    steep = magnitude(slope)
    ahead = above(slope, doubles(), height, -height)  # t times the steepness, over the length
    u = wp.cw_mul(along(blockers, f + 4, x, y, z) + doubles(blockers[f + 7]), steep) + wp.cw_mul(
        along(blockers, f + 4, dx, dy, dz), ahead
    )
    v = wp.cw_mul(along(blockers, f + 8, x, y, z) + doubles(blockers[f + 11]), steep) + wp.cw_mul(
        along(blockers, f + 8, dx, dy, dz), ahead
    )
    t = wp.cw_mul(ahead, length)
    near = clearance * steep
    edge = _INSIDE * steep
    margin = lower(u - edge, v - edge)
    margin = lower(steep - edge - u - v, margin)
    margin = lower(wp.cw_mul(length, steep) - near - t, margin)
    margin = lower(t - near, margin)
    margin = lower(ahead - _CLEAR * scale, margin)
    return lower(wp.cw_mul(slope, slope) - _STEEP_SQUARE * square, margin)


@wp.kernel(module="unique", module_options=_OPTIONS, enable_backward=False)
def pack_segments(
    offset: int,
    first: int,
    size: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    blockers: wp.array(dtype=wp.float64),
    rays: wp.array(dtype=wp.vec3),
    keys: wp.array(dtype=wp.uint16),
    sight: wp.array(dtype=wp.int8),
):
    """Segments from number ``first`` on as pairs (start, way) in float32, from ``clearance`` to ``clearance`` before
    the end, longer by the rounding; a bad one or one that short meets nothing.

    ``sight`` becomes BAD where a segment is not finite, BLOCKED where one of ``blockers``, rows of plane and
    barycentric coordinates, surely lies between, else FREE until something is met. ``keys`` as in :func:`pack_rays`.
    """
    k = wp.static(LANES) * (offset + wp.tid())
    i = first + k
    count = wp.min(size - k, wp.static(LANES))
    if count < wp.static(LANES):
        for j in range(count):
            pack_segment(i + j, k + j, center, radius, clearance, starts, ends, rays, sight)
            if keys.shape[0] > 0:
                keys[k + j] = wp.uint16(0)
        return
    fetch_rows(starts, i)
    fetch_rows(ends, i)
    x = column_x(starts, i) - doubles(center[0])
    y = column_y(starts, i) - doubles(center[1])
    z = column_z(starts, i) - doubles(center[2])
    dx = (column_x(ends, i) - doubles(center[0])) - x
    dy = (column_y(ends, i) - doubles(center[1])) - y
    dz = (column_z(ends, i) - doubles(center[2])) - z
    square = wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz)
    scale = doubles(radius) + magnitude(x) + magnitude(y) + magnitude(z)
    sx = rounded(x)
    sy = rounded(y)
    sz = rounded(z)
    wx = rounded(dx)
    wy = rounded(dy)
    wz = rounded(dz)
    if keys.shape[0] > 0:
        put_keys(keys, k, wp.float32(radius), sx, sy, sz, wx, wy, wz)
    one = singles(wp.float32(1.0))
    length = roots_of_singles(wp.cw_mul(wx, wx) + wp.cw_mul(wy, wy) + wp.cw_mul(wz, wz))
    # Over the length: where the segment begins, and how much of it is left.
    begin = wp.cw_div(rounded(doubles(clearance) - ROUNDING * scale), length)
    left = above_of_singles(
        length, singles(wp.float32(2.0) * wp.float32(clearance)), one, singles(wp.float32(wp.nan))
    )
    left = left - wp.float32(2.0) * begin
    put_rays(
        rays, k, sx + wp.cw_mul(begin, wx), sy + wp.cw_mul(begin, wy), sz + wp.cw_mul(begin, wz),
        wp.cw_mul(left, wx), wp.cw_mul(left, wy), wp.cw_mul(left, wz),
    )  # fmt: skip
    blocked = int(0)
    if blockers.shape[0] > 0:
        long = roots(square)
        most = doubles()
        for f in range(0, blockers.shape[0], wp.static(BLOCKER)):
            most = higher(
                block_margin(blockers, f, x, y, z, dx, dy, dz, square, long, scale, clearance), most
            )
        blocked = positive_bits(most)
    finite = positive_bits(doubles(wp.float64(wp.inf)) - (scale + square))
    tell(sight, i, blocked, wp.static(_EVERY) - finite)


@wp.func
def judge_segment(
    i: int,
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    names: wp.array(dtype=wp.int32),
    clearance: wp.float64,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    met: int,
    sight: wp.array(dtype=wp.int8),
):
    """Judge what segment ``i`` met."""
    origin = row(starts, i) - center
    way = (row(ends, i) - center) - origin
    length = wp.length(way)
    scale = rounding_scale(origin, radius)
    if met < 0:
        sight[i] = wp.int8(wp.where(wp.isfinite(scale) and wp.isfinite(length), FREE, BAD))
        return
    name = met
    if names.shape[0] > 0:
        name = names[met]
    plane = planes[name]
    normal = wp.vec3d(plane[0], plane[1], plane[2])
    slope = wp.dot(normal, way)
    height = plane[3] - wp.dot(normal, origin)
    sight[i] = wp.int8(AGAIN)
    if slope * slope > _STEEP_SQUARE * length * length:
        t = height * length / slope
        if t > clearance and wp.abs(height) > _CLEAR * scale:
            sight[i] = wp.int8(wp.where(t < length - clearance, BLOCKED, FREE))


@wp.kernel(module="unique", module_options=_OPTIONS, enable_backward=False)
def judge_segments(
    offset: int,
    first: int,
    size: int,
    which: wp.array(dtype=wp.int32),
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    names: wp.array(dtype=wp.int32),
    clearance: wp.float64,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    met: wp.array(dtype=wp.int32),
    sight: wp.array(dtype=wp.int8),
):
    """What the first hits of :func:`pack_segments` say in float64: FREE, BLOCKED, or AGAIN if it takes a closer look.

    ``which`` names the segments, from number ``first``; ``names`` the faces of the hierarchy's, empty if it holds all.
    """
    k = wp.static(LANES) * (offset + wp.tid())
    count = wp.min(size - k, wp.static(LANES))
    rare = (1 << count) - 1
    if count == wp.static(LANES):
        fetch_ahead(planes, met, k)
        name = faces_met(met, k, names)
        nx = plane_x(planes, name)
        ny = plane_y(planes, name)
        nz = plane_z(planes, name)
        fetch_rows_at(starts, first, which, k)
        fetch_rows_at(ends, first, which, k)
        x = column_x_at(starts, first, which, k) - doubles(center[0])
        y = column_y_at(starts, first, which, k) - doubles(center[1])
        z = column_z_at(starts, first, which, k) - doubles(center[2])
        dx = (column_x_at(ends, first, which, k) - doubles(center[0])) - x
        dy = (column_y_at(ends, first, which, k) - doubles(center[1])) - y
        dz = (column_z_at(ends, first, which, k) - doubles(center[2])) - z
        square = wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz)
        length = roots(square)
        slope = wp.cw_mul(nx, dx) + wp.cw_mul(ny, dy) + wp.cw_mul(nz, dz)
        height = plane_w(planes, name) - (wp.cw_mul(nx, x) + wp.cw_mul(ny, y) + wp.cw_mul(nz, z))
        t = wp.cw_div(wp.cw_mul(height, length), slope)
        scale = doubles(radius) + magnitude(x) + magnitude(y) + magnitude(z)
        margin = lower(t - doubles(clearance), length - doubles(clearance) - t)
        margin = lower(magnitude(height) - _CLEAR * scale, margin)
        margin = lower(wp.cw_mul(slope, slope) - _STEEP_SQUARE * square, margin)
        blocked = met_bits(met, k) & positive_bits(margin)
        block(sight, first, which, k)
        rare = wp.static(_EVERY) - blocked
    while rare != 0:
        j = lowest_bit(rare)
        rare = rare & (rare - 1)
        judge_segment(
            first + which[k + j], center, radius, planes, names, clearance, starts, ends, met[k + j], sight
        )
