"""Rays for Embree on a CPU: packed in float32, and what they met placed in float64 on the planes of the faces.

Embree takes rays as six float32 and names a face. A thread owns 16 rays, and computes on all at once, a number of each
to a lane. Those that are not plain (misses, grazing or bad rays, surfaces at a ray's start, fewer than 16 at the end)
it takes one by one, by the rules of :mod:`warprrf.kernels.rays.mesh`. Products are rounded before they are added, as there:
distances agree to the bit.
"""

import warp as wp

from warprrf.kernels.raster.lanes import LANES, lowest_bit
from warprrf.kernels.rays.mesh import (
    AGAIN,
    BAD,
    CLEAR,
    MISS,
    ROUNDING,
    STEEP_SQUARE,
    is_bad,
    narrow,
    plane_distance,
    rounding_scale,
)
from warprrf.kernels.rays.ray_lanes import (
    EVERY,
    RAY_OPTIONS,
    column_x,
    column_y,
    column_z,
    copy_rows,
    doubles,
    faces_met,
    fetch_ahead,
    fetch_rows,
    keep,
    lower,
    magnitude,
    magnitude_of_singles,
    met_bits,
    numbers,
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
    rounded,
    row,
    row_x,
    row_y,
    row_z,
    singles,
)

# Squares between these neither overflow nor lose digits in float32.
_LEAST_SQUARE = wp.constant(wp.float32(1e-30))
_MOST_SQUARE = wp.constant(wp.float32(1e30))


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


@wp.kernel(module="unique", module_options=RAY_OPTIONS, enable_backward=False)
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
    own_origins: wp.array(dtype=wp.vec3d),
    own_directions: wp.array(dtype=wp.vec3d),
):
    """``size`` rays from number ``first`` on as pairs (start, unit direction) in float32; a bad one meets nothing.

    ``start`` holds the distance [m] at which each begins; if empty, all begin at ``clearance``, less the rounding.
    ``keys``, if not empty, become numbers that rays near each other share, and ``own_origins`` and ``own_directions``,
    if longer than one row, copies.
    """
    k = wp.static(LANES) * (offset + wp.tid())
    i = first + k
    count = wp.min(size - k, wp.static(LANES))
    rare = (1 << count) - 1
    if count == wp.static(LANES):
        fetch_rows(origins, i)
        fetch_rows(directions, i)
        if own_origins.shape[0] > 1:
            copy_rows(origins, own_origins, i)
        if own_directions.shape[0] > 1:
            copy_rows(directions, own_directions, i)
        near = round_rows(origins, i, center)
        x = row_x(near)
        y = row_y(near)
        z = row_z(near)
        toward = round_rows(directions, i, wp.vec3d())
        dx = row_x(toward)
        dy = row_y(toward)
        dz = row_z(toward)
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
        rare = wp.static(EVERY) - (low & high)
    else:
        for j in range(count):
            if keys.shape[0] > 0:
                keys[k + j] = wp.uint16(0)
            if own_origins.shape[0] > 1:
                own_origins[i + j] = origins[i + j]
            if own_directions.shape[0] > 1:
                own_directions[i + j] = directions[i + j]
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


@wp.kernel(module="unique", module_options=RAY_OPTIONS, enable_backward=False)
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


@wp.kernel(module="unique", module_options=RAY_OPTIONS, enable_backward=False)
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
        margin = lower(magnitude(height) - CLEAR * scale, t - doubles(clearance))
        margin = lower(wp.cw_mul(slope, slope) - STEEP_SQUARE * square, margin)
        rare = wp.static(EVERY) - (met_bits(met, k) & positive_bits(margin))
    while rare != 0:
        j = lowest_bit(rare)
        rare = rare & (rare - 1)
        place_hit(
            i + j, center, radius, planes, names, clearance, start, origins, directions, met_at[k + j], met[k + j],
            distance, face,
        )  # fmt: skip
