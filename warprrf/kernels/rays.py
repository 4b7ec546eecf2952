"""Ray and closest-point queries on a triangle mesh's bounding volume hierarchy.

Hierarchies keep geometry in float32, so a query answers *which* face; its distance is then taken in float64 from that
face's plane. Rays come in float64 and positions are made relative to the mesh's centre before they are rounded. A
search starts a little before its ray, by what float32 may err, and steps over surfaces that float64 places at the
ray's start or before it: so a ray from a point on a surface meets the next surface, whatever the rounding.
"""

import warp as wp

MISS = wp.constant(-1)
"""Face of a ray that met nothing."""
BAD = wp.constant(-2)
"""Face of a ray that is not finite or has no direction."""
AGAIN = wp.constant(-3)
"""Face of a ray that met a surface at its start and goes on from the distance stored in its place."""
FREE = wp.constant(0)
"""Segment that nothing blocks."""
BLOCKED = wp.constant(1)
"""Segment that a surface blocks."""

# What float32 may displace a surface along a ray, over the largest coordinate: six roundings of 2^-24.
_ROUNDING = wp.constant(wp.float64(3.6e-7))
# A ray's start is on a plane if no further from it than this, over the largest coordinate: float64 rounding.
_ON_PLANE = wp.constant(wp.float64(1e-12))
GRAZING = 1e-7
"""Below this |normal . direction| the plane equation is worse than the float32 distance."""

_GRAZING = wp.constant(wp.float64(GRAZING))
_FAR = wp.constant(wp.float64(1e30))
# Beyond these a hit is neither grazing nor at the ray's start, without a closer look.
_STEEP_SQUARE = wp.constant(wp.float64(1e-12))
_CLEAR = wp.constant(wp.float64(1e-9))
# Squares between these neither overflow nor lose digits in float32.
_LEAST_SQUARE = wp.constant(wp.float32(1e-30))
_MOST_SQUARE = wp.constant(wp.float32(1e30))
_STEPS = 8


# Warp's own indexing allows for negative indices and strides, some six instructions an access.
@wp.func_native("return source.data[i < source.shape[0] ? i : source.shape[0] - 1];")
def ray_row(source: wp.array(dtype=wp.vec3d), i: int) -> wp.vec3d:  # type: ignore[empty-body]
    """Row ``i >= 0`` of a contiguous array, or its last row."""
    ...


@wp.func_native("return source.data[i];")
def plane_row(source: wp.array(dtype=wp.vec4d), i: int) -> wp.vec4d:  # type: ignore[empty-body]
    """Row ``i >= 0`` of a contiguous array."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    const int ahead = k + 16 < met.shape[0] ? met.data[k + 16] : -1;
    if (ahead >= 0) __builtin_prefetch(planes.data + ahead);
#endif
""")
def fetch_ahead(planes: wp.array(dtype=wp.vec4d), met: wp.array(dtype=wp.int32), k: int) -> None:
    """Ask for the plane that will be wanted 16 rays later: incoherent rays find it in no cache."""
    ...


@wp.func_native("return source.data[i];")
def name_at(source: wp.array(dtype=wp.int32), i: int) -> wp.int32:  # type: ignore[empty-body]
    """Element ``i >= 0`` of a contiguous array."""
    ...


@wp.func_native("distance.data[i] = t; face.data[i] = name;")
def keep(
    distance: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.int32),
    i: int,
    t: wp.float64,
    name: wp.int32,
) -> None:
    """Write a hit to contiguous arrays, ``i >= 0``."""
    ...


@wp.func_native("rays.data[2 * k] = start; rays.data[2 * k + 1] = way;")
def put(rays: wp.array(dtype=wp.vec3), k: int, start: wp.vec3, way: wp.vec3) -> None:
    """Write ray ``k >= 0`` to a contiguous array."""
    ...


@wp.func
def narrow(p: wp.vec3d):
    """A position or direction in float32."""
    return wp.vec3(wp.float32(p[0]), wp.float32(p[1]), wp.float32(p[2]))


@wp.func
def unit_narrow(direction: wp.vec3d):
    """A direction in float32, of length one to rounding; NaN if it has none. Normalised in float32, which is faster."""
    d = narrow(direction)
    square = wp.dot(d, d)
    if square > _LEAST_SQUARE and square < _MOST_SQUARE:
        return d * (wp.float32(1.0) / wp.sqrt(square))
    return narrow(direction * (wp.float64(1.0) / wp.length(direction)))


@wp.func
def rounding_scale(origin: wp.vec3d, radius: wp.float64):
    """Largest coordinate that rounding acts on [m]."""
    return radius + wp.abs(origin[0]) + wp.abs(origin[1]) + wp.abs(origin[2])


@wp.func
def is_bad(scale: wp.float64, length: wp.float64):
    """Whether a ray is not finite or its direction is of length zero."""
    return not (wp.isfinite(scale) and wp.isfinite(length) and length > wp.float64(0.0))


@wp.func
def plane_distance(
    origin: wp.vec3d,
    direction: wp.vec3d,
    length: wp.float64,
    scale: wp.float64,
    plane: wp.vec4d,
    near: wp.float64,
    clearance: wp.float64,
):
    """Distance [m] to a plane (normal, offset) along ``direction`` of ``length``, or NaN if it does not count as met.

    It counts beyond ``clearance``, unless the ray starts on it. Along the plane the float32 distance ``near`` stands.
    """
    normal = wp.vec3d(plane[0], plane[1], plane[2])
    slope = wp.dot(normal, direction)
    height = plane[3] - wp.dot(normal, origin)
    t = near
    if wp.abs(slope) > _GRAZING * length:
        t = height * length / slope
        if wp.abs(height) <= _ON_PLANE * scale:
            t = wp.float64(wp.nan)
    if t <= clearance:
        t = wp.float64(wp.nan)
    return t


@wp.func
def search(
    mesh: wp.uint64,
    planes: wp.array(dtype=wp.vec4d),
    origin: wp.vec3d,
    direction: wp.vec3d,
    length: wp.float64,
    scale: wp.float64,
    clearance: wp.float64,
    reach: wp.float64,
):
    """Distance [m] and face of what a ray meets beyond ``clearance`` and within ``reach``; inf and MISS if nothing."""
    unit = direction / length
    step = _ROUNDING * scale
    start = clearance - step
    most = wp.min(reach, _FAR)
    found = wp.float64(wp.inf)
    name = MISS
    for _ in range(_STEPS):
        query = wp.mesh_query_ray(
            mesh, narrow(origin + start * unit), narrow(unit), wp.float32(most - start + step)
        )
        if not query.result:
            break
        near = start + wp.float64(query.t)
        t = plane_distance(origin, direction, length, scale, planes[query.face], near, clearance)
        if not wp.isnan(t):
            found = t
            name = query.face
            break
        start = near + step
        if start > most:
            break
    return found, name


@wp.kernel(enable_backward=False)
def cast_rays(
    offset: int,
    mesh: wp.uint64,
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    clearance: wp.float64,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    reach: wp.array(dtype=wp.float64),
    distance: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.int32),
):
    """Nearest face along each ray beyond ``clearance`` and within ``reach`` [m], and its distance in float64."""
    i = offset + wp.tid()
    origin = origins[wp.min(i, origins.shape[0] - 1)] - center
    direction = directions[wp.min(i, directions.shape[0] - 1)]
    length = wp.length(direction)
    scale = rounding_scale(origin, radius)
    if is_bad(scale, length):
        distance[i] = wp.float64(wp.inf)
        face[i] = BAD
        return
    most = reach[wp.min(i, reach.shape[0] - 1)]
    found, name = search(mesh, planes, origin, direction, length, scale, clearance, most)
    distance[i] = found
    face[i] = name


@wp.kernel(enable_backward=False)
def look(
    offset: int,
    mesh: wp.uint64,
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    clearance: wp.float64,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    sight: wp.array(dtype=wp.int32),
):
    """Whether each segment is FREE but for ``clearance`` at its ends, or BLOCKED."""
    i = offset + wp.tid()
    origin = starts[wp.min(i, starts.shape[0] - 1)] - center
    way = (ends[wp.min(i, ends.shape[0] - 1)] - center) - origin
    length = wp.length(way)
    scale = rounding_scale(origin, radius)
    if not (wp.isfinite(scale) and wp.isfinite(length)):
        sight[i] = BAD
        return
    if length <= wp.float64(2.0) * clearance:
        sight[i] = FREE
        return
    t, name = search(mesh, planes, origin, way, length, scale, clearance, length - clearance)
    sight[i] = wp.where(name >= 0 and t < length - clearance, BLOCKED, FREE)


@wp.kernel(enable_backward=False)
def pack_segments(
    offset: int,
    first: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    rays: wp.array(dtype=wp.vec3),
):
    """Segments from number ``first`` on as pairs (start, way) in float32, from ``clearance`` to ``clearance`` before
    the end, longer by the rounding; a bad one or one that short meets nothing."""
    k = offset + wp.tid()
    i = first + k
    origin = ray_row(starts, i) - center
    way = (ray_row(ends, i) - center) - origin
    length = wp.length(way)
    unit = way * (wp.float64(1.0) / length)
    step = _ROUNDING * rounding_scale(origin, radius)
    inner = length - wp.float64(2.0) * clearance
    reach = wp.where(inner > wp.float64(0.0), inner + wp.float64(2.0) * step, wp.float64(wp.nan))
    put(rays, k, narrow(origin + (clearance - step) * unit), narrow(reach * unit))


@wp.kernel(enable_backward=False)
def judge_segments(
    offset: int,
    first: int,
    which: wp.array(dtype=wp.int32),
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    names: wp.array(dtype=wp.int32),
    clearance: wp.float64,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    met: wp.array(dtype=wp.int32),
    sight: wp.array(dtype=wp.int32),
):
    """What the first hits of :func:`pack_segments` say in float64: FREE, BLOCKED, or AGAIN if it takes a closer look.

    ``which`` names the segments, empty if all; ``names`` the faces of the hierarchy's, empty if it holds all.
    """
    k = offset + wp.tid()
    i = first + k
    if which.shape[0] > 0:
        i = first + name_at(which, k)
    origin = ray_row(starts, i) - center
    way = (ray_row(ends, i) - center) - origin
    length = wp.length(way)
    scale = rounding_scale(origin, radius)
    fetch_ahead(planes, met, k)
    name = name_at(met, k)
    if name < 0:
        sight[i] = wp.where(wp.isfinite(scale) and wp.isfinite(length), FREE, BAD)
        return
    if names.shape[0] > 0:
        name = name_at(names, name)
    plane = plane_row(planes, name)
    normal = wp.vec3d(plane[0], plane[1], plane[2])
    slope = wp.dot(normal, way)
    height = plane[3] - wp.dot(normal, origin)
    sight[i] = AGAIN
    if slope * slope > _STEEP_SQUARE * length * length:
        t = height * length / slope
        if t > clearance and wp.abs(height) > _CLEAR * scale:
            sight[i] = wp.where(t < length - clearance, BLOCKED, FREE)


@wp.kernel(enable_backward=False)
def pack_rays(
    offset: int,
    first: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    start: wp.array(dtype=wp.float64),
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    rays: wp.array(dtype=wp.vec3),
):
    """Rays from number ``first`` on as pairs (start, unit direction) in float32; a bad one meets nothing.

    ``start`` holds the distance [m] at which each begins; if empty, all begin at ``clearance``, less the rounding.
    """
    k = offset + wp.tid()
    i = first + k
    origin = ray_row(origins, i) - center
    direction = ray_row(directions, i)
    near = narrow(origin)
    begin = wp.float32(clearance) - wp.float32(_ROUNDING) * (
        wp.float32(radius) + wp.abs(near[0]) + wp.abs(near[1]) + wp.abs(near[2])
    )
    if start.shape[0] > 0:
        begin = wp.float32(start[i])
    unit = unit_narrow(direction)
    put(rays, k, near + begin * unit, unit)


@wp.kernel(enable_backward=False)
def place_hits(
    offset: int,
    first: int,
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
    k = offset + wp.tid()
    i = first + k
    origin = ray_row(origins, i) - center
    direction = ray_row(directions, i)
    fetch_ahead(planes, met, k)
    name = name_at(met, k)
    if name >= 0:
        if names.shape[0] > 0:
            name = name_at(names, name)
        plane = plane_row(planes, name)
        normal = wp.vec3d(plane[0], plane[1], plane[2])
        square = wp.dot(direction, direction)
        slope = wp.dot(normal, direction)
        height = plane[3] - wp.dot(normal, origin)
        if slope * slope > _STEEP_SQUARE * square and wp.abs(height) > _CLEAR * rounding_scale(
            origin, radius
        ):
            t = height * wp.sqrt(square) / slope
            if t > clearance:  # nearly every ray: nothing is left to decide
                keep(distance, face, i, t, name)
                return
    length = wp.length(direction)
    scale = rounding_scale(origin, radius)
    if name < 0:
        distance[i] = wp.float64(wp.inf)
        face[i] = wp.where(is_bad(scale, length), BAD, MISS)
        return
    begin = clearance - _ROUNDING * scale
    if start.shape[0] > 0:
        begin = start[i]
    near = begin + wp.float64(met_at[k])
    t = plane_distance(origin, direction, length, scale, planes[name], near, clearance)
    if wp.isnan(t):
        t = near + _ROUNDING * scale
        name = AGAIN
    distance[i] = t
    face[i] = name


@wp.kernel
def closest_faces(
    offset: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: float,
    face: wp.array(dtype=wp.int32),
):
    """Face nearest to each point within ``reach`` [m], -1 where there is none."""
    i = offset + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], reach)
    if query.result:
        face[i] = query.face
    else:
        face[i] = -1
