"""Segments for Embree on a CPU: packed in float32, and judged in float64 by the planes of the faces that they met.

As in :mod:`warprrf.kernels.rays.packed_rays` a thread owns 16 segments. Faces that are known to block many are asked before
the hierarchy, in float64 and away from their edges: which are asked changes the time and no answer.
"""

import warp as wp

from warprrf.kernels.raster.lanes import LANES, lowest_bit
from warprrf.kernels.rays.mesh import (
    AGAIN,
    BAD,
    BLOCKED,
    CLEAR,
    FREE,
    ROUNDING,
    STEEP_SQUARE,
    narrow,
    rounding_scale,
)
from warprrf.kernels.rays.ray_lanes import (
    EVERY,
    HALF_LANES,
    RAY_OPTIONS,
    above,
    above_of_singles,
    column_x,
    column_x_at,
    column_y,
    column_y_at,
    column_z,
    column_z_at,
    doubles,
    faces_met,
    fetch_ahead,
    fetch_rows,
    fetch_rows_at,
    higher,
    lower,
    magnitude,
    magnitude_of_singles,
    met_bits,
    plane_w,
    plane_x,
    plane_y,
    plane_z,
    positive_bits,
    positive_bits_of_singles,
    put_keys,
    put_rays,
    roots,
    roots_of_singles,
    round_rows,
    round_ways,
    row,
    row_x,
    row_y,
    row_z,
    singles,
)

BLOCKER = 12
"""Numbers that :func:`pack_segments` knows a blocker by: its plane, and two barycentric coordinates of points."""

# Beyond this [m, and its square] a segment's numbers may overflow in float32, and each is packed by itself.
_MOST = wp.constant(wp.float32(1e30))
# A known blocker is not asked about points nearer than this, in barycentric coordinates, to its edges.
_INSIDE = wp.constant(wp.float64(1e-6))


@wp.func_native(f"""{HALF_LANES}
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
        sight.data[i + j] = (blocked >> j) & 1 ? {BLOCKED} : {FREE};
""")
def tell(sight: wp.array(dtype=wp.int8), i: int, blocked: int) -> None:
    """Write FREE and BLOCKED for segments ``i`` to ``i + 16``."""
    ...


@wp.func_native(f"""
    for (int j = 0; j < {LANES}; ++j) sight.data[first + which.data[k + j]] = {BLOCKED};
""")
def block(sight: wp.array(dtype=wp.int8), first: int, which: wp.array(dtype=wp.int32), k: int) -> None:
    """Write BLOCKED for segments ``first`` plus elements ``k`` to ``k + 16`` of ``which``."""
    ...


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
    reach = wp.where(
        inner > wp.float64(0.0), wp.min(inner + wp.float64(2.0) * step, wp.float64(_MOST)), wp.float64(wp.nan)
    )
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
    margin = lower(ahead - CLEAR * scale, margin)
    return lower(wp.cw_mul(slope, slope) - STEEP_SQUARE * square, margin)


@wp.func
def known_to_block(
    blockers: wp.array(dtype=wp.float64),
    i: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
):
    """Bit j is set where one of ``blockers`` surely lies between the ends of segment ``i + j``."""
    x = column_x(starts, i) - doubles(center[0])
    y = column_y(starts, i) - doubles(center[1])
    z = column_z(starts, i) - doubles(center[2])
    dx = (column_x(ends, i) - doubles(center[0])) - x
    dy = (column_y(ends, i) - doubles(center[1])) - y
    dz = (column_z(ends, i) - doubles(center[2])) - z
    square = wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz)
    scale = doubles(radius) + magnitude(x) + magnitude(y) + magnitude(z)
    length = roots(square)
    most = doubles()
    for f in range(0, blockers.shape[0], wp.static(BLOCKER)):
        margin = block_margin(blockers, f, x, y, z, dx, dy, dz, square, length, scale, clearance)
        most = higher(margin, most)
    return positive_bits(most)


@wp.kernel(module="unique", module_options=RAY_OPTIONS, enable_backward=False)
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
    near = round_rows(starts, i, center)
    sx = row_x(near)
    sy = row_y(near)
    sz = row_z(near)
    ways = round_ways(starts, ends, i, center)
    wx = row_x(ways)
    wy = row_y(ways)
    wz = row_z(ways)
    if keys.shape[0] > 0:
        put_keys(keys, k, wp.float32(radius), sx, sy, sz, wx, wy, wz)
    one = singles(wp.float32(1.0))
    square = wp.cw_mul(wx, wx) + wp.cw_mul(wy, wy) + wp.cw_mul(wz, wz)
    length = roots_of_singles(square)
    scale = singles(wp.float32(radius)) + magnitude_of_singles(sx)
    scale = scale + magnitude_of_singles(sy) + magnitude_of_singles(sz)
    # Over the length: where the segment begins, and how much of it is left.
    begin = wp.cw_div(singles(wp.float32(clearance)) - wp.float32(ROUNDING) * scale, length)
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
        blocked = known_to_block(blockers, i, center, radius, clearance, starts, ends)
    tell(sight, i, blocked)
    plain = positive_bits_of_singles(singles(_MOST) - scale) & positive_bits_of_singles(
        singles(_MOST) - square
    )
    rare = wp.static(EVERY) - plain
    while rare != 0:
        j = lowest_bit(rare)
        rare = rare & (rare - 1)
        pack_segment(i + j, k + j, center, radius, clearance, starts, ends, rays, sight)


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
    if slope * slope > STEEP_SQUARE * length * length:
        t = height * length / slope
        if t > clearance and wp.abs(height) > CLEAR * scale:
            sight[i] = wp.int8(wp.where(t < length - clearance, BLOCKED, FREE))


@wp.kernel(module="unique", module_options=RAY_OPTIONS, enable_backward=False)
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
        margin = lower(magnitude(height) - CLEAR * scale, margin)
        margin = lower(wp.cw_mul(slope, slope) - STEEP_SQUARE * square, margin)
        blocked = met_bits(met, k) & positive_bits(margin)
        block(sight, first, which, k)
        rare = wp.static(EVERY) - blocked
    while rare != 0:
        j = lowest_bit(rare)
        rare = rare & (rare - 1)
        judge_segment(
            first + which[k + j], center, radius, planes, names, clearance, starts, ends, met[k + j], sight
        )
