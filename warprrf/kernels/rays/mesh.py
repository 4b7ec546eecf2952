"""Ray and closest-point queries on a triangle mesh's bounding volume hierarchy.

Hierarchies keep geometry in float32, so a query answers *which* face; its distance is then taken in float64 from that
face's plane. Rays come in float64 and positions are made relative to the mesh's centre before they are rounded. A
search starts a little before its ray, by what float32 may err, and steps over surfaces that float64 places at the
ray's start or before it: so a ray from a point on a surface meets the next surface, whatever the rounding.

Ray i starts at origin i / ``per_origin``, the last of them if there are fewer, along direction i modulo their number.
"""

import warp as wp

MISS = wp.constant(-1)
"""Face of a ray that met nothing."""
BAD = wp.constant(-2)
"""Face of a ray that is not finite or has no direction."""
AGAIN = wp.constant(-3)
"""Face of a ray that met a surface at its start and goes on from the distance stored in its place."""
ROUNDING = 3.6e-7
"""What float32 may displace a surface along a ray, over the largest coordinate: six roundings of 2^-24."""
# A ray's start is on a plane if no further from it than this, over the largest coordinate: float64 rounding.
_ON_PLANE = wp.constant(wp.float64(1e-12))
GRAZING = 1e-7
"""Below this |normal . direction| the plane equation is worse than the float32 distance."""

_ROUNDING = wp.constant(wp.float64(ROUNDING))
_GRAZING = wp.constant(wp.float64(GRAZING))
_FAR = wp.constant(wp.float64(1e30))
_STEPS = 1 << 20
"""Most times that a ray which glides along its own surface meets it, a step of float32's rounding further each time."""


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
            mesh, wp.vec3(origin + start * unit), wp.vec3(unit), wp.float32(most - start + step)
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
    per_origin: int,
    directions: wp.array(dtype=wp.vec3d),
    reach: wp.array(dtype=wp.float64),
    distance: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.int32),
):
    """Nearest face along each ray beyond ``clearance`` and within ``reach`` [m], and its distance in float64."""
    i = offset + wp.tid()
    origin = origins[wp.min(i / per_origin, origins.shape[0] - 1)] - center
    direction = directions[i % directions.shape[0]]
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
def see(
    offset: int,
    mesh: wp.uint64,
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    clearance: wp.float64,
    a: wp.array(dtype=wp.vec3d),
    b: wp.array(dtype=wp.vec3d),
    free: wp.array(dtype=wp.int8),
):
    """1 where nothing lies between ``a`` and ``b`` but within ``clearance`` [m] of an end, else 0; BAD where a point is not
    finite."""
    i = offset + wp.tid()
    start = a[wp.min(i, a.shape[0] - 1)]
    way = b[wp.min(i, b.shape[0] - 1)] - start
    size = wp.length(way)
    if not wp.isfinite(size):
        free[i] = wp.int8(BAD)
        return
    free[i] = wp.int8(1)
    if size > wp.float64(2.0) * clearance:
        origin = start - center
        inner = size - clearance
        scale = rounding_scale(origin, radius)
        t, _ = search(mesh, planes, origin, way, size, scale, clearance, inner)
        if t < inner:
            free[i] = wp.int8(0)


@wp.kernel(enable_backward=False)
def pack_rays(
    offset: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    start: wp.array(dtype=wp.float64),
    origins: wp.array(dtype=wp.vec3d),
    per_origin: int,
    directions: wp.array(dtype=wp.vec3d),
    rays: wp.array(dtype=wp.vec3),
):
    """Each ray as a pair (point, unit direction) in float32; a bad one holds NaN and meets nothing.

    Rays begin at ``start`` [m]; if that is empty, at ``clearance``, less the rounding.
    """
    i = offset + wp.tid()
    origin = origins[wp.min(i / per_origin, origins.shape[0] - 1)] - center
    direction = directions[i % directions.shape[0]]
    unit = direction / wp.length(direction)
    begin = clearance - _ROUNDING * rounding_scale(origin, radius)
    if start.shape[0] > 0:
        begin = start[i]
    rays[2 * i] = wp.vec3(origin + begin * unit)
    rays[2 * i + 1] = wp.vec3(unit)


@wp.kernel(enable_backward=False)
def pack_segments(
    offset: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    longest: wp.float64,
    a: wp.array(dtype=wp.vec3d),
    b: wp.array(dtype=wp.vec3d),
    rays: wp.array(dtype=wp.vec3),
    length: wp.array(dtype=wp.float64),
):
    """Each segment between ``a`` and ``b``, less ``clearance`` at both ends and longer by what float32 may err, as a pair
    (point, way) in float32; what is no longer than both clearances holds NaN. And the whole ``length`` [m]."""
    i = offset + wp.tid()
    start = a[wp.min(i, a.shape[0] - 1)]
    way = b[wp.min(i, b.shape[0] - 1)] - start
    size = wp.length(way)
    margin = _ROUNDING * rounding_scale(start - center, radius)
    inner = size - wp.float64(2.0) * clearance
    scale = wp.float64(wp.nan)
    if inner > wp.float64(0.0):
        scale = wp.min(inner + wp.float64(2.0) * margin, longest) / size
    rays[2 * i] = wp.vec3(start - center + (clearance - margin) / size * way)
    rays[2 * i + 1] = wp.vec3(scale * way)
    length[i] = size


@wp.kernel(enable_backward=False)
def place_hits(
    offset: int,
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    clearance: wp.float64,
    start: wp.array(dtype=wp.float64),
    origins: wp.array(dtype=wp.vec3d),
    per_origin: int,
    directions: wp.array(dtype=wp.vec3d),
    met_at: wp.array(dtype=wp.float32),
    met: wp.array(dtype=wp.int32),
    distance: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.int32),
):
    """Distances [m] in float64 to the faces ``met`` by rays of :func:`pack_rays`, ``met_at`` in float32 from there.

    Where a surface at the ray's start was met, ``face`` becomes AGAIN and ``distance`` that at which to go on.
    """
    i = offset + wp.tid()
    origin = origins[wp.min(i / per_origin, origins.shape[0] - 1)] - center
    direction = directions[i % directions.shape[0]]
    length = wp.length(direction)
    scale = rounding_scale(origin, radius)
    name = met[i]
    t = wp.float64(wp.inf)
    if is_bad(scale, length):
        name = BAD
    elif name >= 0:
        step = _ROUNDING * scale
        begin = clearance - step
        if start.shape[0] > 0:
            begin = start[i]
        near = begin + wp.float64(met_at[i])
        t = plane_distance(origin, direction, length, scale, planes[name], near, clearance)
        if wp.isnan(t):
            t = near + step
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


@wp.kernel(enable_backward=False)
def find_crossings(
    offset: int,
    bvh: wp.uint64,
    corners: wp.array2d(dtype=wp.vec3d),
    points: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    winding: wp.array(dtype=wp.int32),
    side: wp.array(dtype=wp.int32),
):
    """Surfaces that each of ``directions`` from each point leaves less those that it enters, and the first one's side.

    ``side`` is 1 where the first surface's normal points towards the point, -1 where it points away, 0 where nothing is
    met. Source: Moeller and Trumbore, "Fast, minimum storage ray-triangle intersection", J. Graphics Tools 2 (1997).
    """
    i = offset + wp.tid()
    point = points[i // directions.shape[0]]
    direction = directions[i % directions.shape[0]]
    crossed = int(0)
    first = int(0)
    nearest = wp.float64(wp.inf)
    query = wp.bvh_query_ray(bvh, wp.vec3(point), wp.vec3(direction))
    face = int(0)
    while wp.bvh_query_next(query, face):
        a = corners[face, 0]
        ab = corners[face, 1] - a
        ac = corners[face, 2] - a
        across = wp.cross(direction, ac)
        volume = wp.dot(ab, across)
        if volume != wp.float64(0.0):
            away = point - a
            turned = wp.cross(away, ab)
            u = wp.dot(away, across) / volume
            v = wp.dot(direction, turned) / volume
            t = wp.dot(ac, turned) / volume
            if (
                u >= wp.float64(0.0)
                and v >= wp.float64(0.0)
                and u + v <= wp.float64(1.0)
                and t > wp.float64(0.0)
            ):
                enters = int(1)
                if volume < wp.float64(0.0):  # the ray goes along the normal
                    enters = -1
                crossed -= enters
                if t < nearest:
                    nearest = t
                    first = enters
    winding[i] = crossed
    side[i] = first


@wp.kernel(enable_backward=False)
def find_touching(
    offset: int,
    bvh: wp.uint64,
    corners: wp.array2d(dtype=wp.vec3d),
    points: wp.array(dtype=wp.vec3d),
    reach: wp.float64,
    start: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
):
    """How many faces have each point within ``reach`` [m] of their plane and of the inner side of each border; and, where
    ``face`` has room, which, from ``start`` on."""
    i = offset + wp.tid()
    p = points[i]
    around = wp.vec3d(reach, reach, reach)
    query = wp.bvh_query_aabb(bvh, wp.vec3(p - around), wp.vec3(p + around))
    found = int(0)
    j = int(0)
    while wp.bvh_query_next(query, j):
        normal = wp.normalize(wp.cross(corners[j, 1] - corners[j, 0], corners[j, 2] - corners[j, 0]))
        least = reach - wp.abs(wp.dot(normal, p - corners[j, 0]))
        for k in range(3):
            across = wp.normalize(wp.cross(normal, corners[j, (k + 1) % 3] - corners[j, k]))
            least = wp.min(least, wp.dot(across, p - corners[j, k]) + reach)
        if least >= wp.float64(0.0):
            if face.shape[0] > 0:
                face[start[i] + found] = j
            found += 1
    count[i] = found


@wp.struct
class OverlapFaces:
    """Faces: corners [m], unit normals, areas [m^2], the part and the group that each is of; and the areas of parts."""

    corners: wp.array2d(dtype=wp.vec3d)
    normal: wp.array(dtype=wp.vec3d)
    area: wp.array(dtype=wp.float64)
    part: wp.array(dtype=wp.int32)
    group: wp.array(dtype=wp.int32)
    part_area: wp.array(dtype=wp.float64)


@wp.func
def shared_width(corners: wp.array2d(dtype=wp.vec3d), i: int, j: int, normal: wp.vec3d):
    """How far two triangles reach into each other, seen along ``normal`` [m]: least over the sides of the first."""
    least = wp.float64(wp.inf)
    for k in range(3):
        across = wp.normalize(wp.cross(normal, corners[i, (k + 1) % 3] - corners[i, k]))
        low = wp.vec2d(wp.float64(wp.inf), wp.float64(wp.inf))
        high = -low
        for c in range(3):
            at = wp.vec2d(wp.dot(across, corners[i, c]), wp.dot(across, corners[j, c]))
            low = wp.min(low, at)
            high = wp.max(high, at)
        least = wp.min(least, wp.min(high[0], high[1]) - wp.max(low[0], low[1]))
    return least


@wp.kernel(enable_backward=False)
def find_overlaps(
    offset: int, bvh: wp.uint64, faces: OverlapFaces, distance: wp.float64, other: wp.array(dtype=wp.int32)
):
    """For each face, one of another part of its group that it lies on, of the largest if several; unchanged if none.

    The smaller one's corners lie within ``distance`` [m] of the larger one's plane, and what both share is as wide or
    wider. ``bvh`` holds the faces' boxes, wider by ``distance`` or more.
    """
    i = offset + wp.tid()
    a = faces.corners[i, 0]
    b = faces.corners[i, 1]
    c = faces.corners[i, 2]
    query = wp.bvh_query_aabb(bvh, wp.vec3(wp.min(wp.min(a, b), c)), wp.vec3(wp.max(wp.max(a, b), c)))
    most = wp.float64(0.0)
    j = int(0)
    while wp.bvh_query_next(query, j):
        part = faces.part[j]
        if part != faces.part[i] and faces.group[j] == faces.group[i]:
            if faces.part_area[part] > most:
                large = i
                small = j
                if faces.area[j] > faces.area[i]:
                    large = j
                    small = i
                normal = faces.normal[large]
                apart = wp.float64(0.0)
                for k in range(3):
                    height = wp.dot(normal, faces.corners[small, k] - faces.corners[large, 0])
                    apart = wp.max(apart, wp.abs(height))
                if apart <= distance:
                    width = wp.min(
                        shared_width(faces.corners, i, j, normal), shared_width(faces.corners, j, i, normal)
                    )
                    if width >= distance:
                        most = faces.part_area[part]
                        other[i] = j
