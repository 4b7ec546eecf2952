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

# What float32 may displace a surface along a ray, over the largest coordinate: four roundings of 2^-24.
_ROUNDING = wp.constant(wp.float64(2.4e-7))
# A ray's start is on a plane if no further from it than this, over the largest coordinate: float64 rounding.
_ON_PLANE = wp.constant(wp.float64(1e-12))
# Below this |normal . direction| the plane equation is worse than the float32 distance.
_GRAZING = wp.constant(wp.float64(1e-7))
_FAR = wp.constant(wp.float64(1e30))
_STEPS = 8


@wp.struct
class Ray:
    """A ray in float64 relative to the mesh's centre."""

    origin: wp.vec3d
    """Start [m]."""
    direction: wp.vec3d
    """Unit direction."""
    scale: wp.float64
    """Largest coordinate that rounding acts on [m]; NaN or infinite where the ray is bad."""


@wp.func
def ray_of(
    i: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    center: wp.vec3d,
    radius: wp.float64,
):
    """Ray ``i``; one origin or one direction serves all."""
    o = origins[wp.min(i, origins.shape[0] - 1)] - center
    d = directions[wp.min(i, directions.shape[0] - 1)]
    length = wp.length(d)
    ray = Ray()
    ray.origin = o
    ray.direction = d / length
    ray.scale = radius + wp.length(o) + wp.float64(0.0) * wp.length(ray.direction)
    return ray


@wp.func
def begin_at(ray: Ray, distance: wp.float64):
    """The point at ``distance`` along the ray, in float32."""
    p = ray.origin + distance * ray.direction
    return wp.vec3(wp.float32(p[0]), wp.float32(p[1]), wp.float32(p[2]))


@wp.func
def toward(ray: Ray):
    """The ray's direction in float32."""
    return wp.vec3(wp.float32(ray.direction[0]), wp.float32(ray.direction[1]), wp.float32(ray.direction[2]))


@wp.func
def plane_distance(ray: Ray, plane: wp.vec4d, near: wp.float64, clearance: wp.float64):
    """Distance [m] to a plane (normal, offset) and whether it counts as met: not at the start, beyond ``clearance``.

    Along the plane the float32 distance ``near`` stands.
    """
    normal = wp.vec3d(plane[0], plane[1], plane[2])
    slope = wp.dot(normal, ray.direction)
    height = plane[3] - wp.dot(normal, ray.origin)
    t = near
    met = near > clearance
    if wp.abs(slope) > _GRAZING:
        t = height / slope
        met = t > clearance and wp.abs(height) > _ON_PLANE * ray.scale
    return t, met


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
    ray = ray_of(i, origins, directions, center, radius)
    if not wp.isfinite(ray.scale):
        distance[i] = wp.float64(wp.inf)
        face[i] = BAD
        return
    step = _ROUNDING * ray.scale
    start = clearance - step
    most = wp.min(reach[wp.min(i, reach.shape[0] - 1)], _FAR)
    found = wp.float64(wp.inf)
    name = MISS
    for _ in range(_STEPS):
        query = wp.mesh_query_ray(mesh, begin_at(ray, start), toward(ray), wp.float32(most - start + step))
        if not query.result:
            break
        near = start + wp.float64(query.t)
        t, met = plane_distance(ray, planes[query.face], near, clearance)
        if met:
            found = t
            name = query.face
            break
        start = near + step
        if start > most:
            break
    distance[i] = found
    face[i] = name


@wp.kernel(enable_backward=False)
def pack_rays(
    offset: int,
    first: int,
    center: wp.vec3d,
    radius: wp.float64,
    clearance: wp.float64,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    start: wp.array(dtype=wp.float64),
    rays: wp.array2d(dtype=wp.float32),
):
    """Rays from ``first`` on as rows of float32 (start, direction); a bad one gets NaN.

    ``start`` holds the distance [m] at which each begins; if empty, all begin at ``clearance``, less the rounding.
    """
    k = offset + wp.tid()
    i = first + k
    ray = ray_of(i, origins, directions, center, radius)
    begin = clearance - _ROUNDING * ray.scale
    if start.shape[0] > 0:
        begin = start[i]
    p = begin_at(ray, begin)
    d = toward(ray)
    for c in range(3):
        rays[k, c] = p[c]
        rays[k, 3 + c] = d[c]


@wp.kernel(enable_backward=False)
def place_hits(
    offset: int,
    first: int,
    center: wp.vec3d,
    radius: wp.float64,
    planes: wp.array(dtype=wp.vec4d),
    clearance: wp.float64,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    start: wp.array(dtype=wp.float64),
    names: wp.array(dtype=wp.int32),
    met_at: wp.array(dtype=wp.float32),
    met_face: wp.array(dtype=wp.int32),
    distance: wp.array(dtype=wp.float64),
    face: wp.array(dtype=wp.int32),
):
    """Distances in float64 of what the rays of :func:`pack_rays` met; ``names`` are the faces of a hierarchy's."""
    k = offset + wp.tid()
    i = first + k
    ray = ray_of(i, origins, directions, center, radius)
    found = wp.float64(wp.inf)
    name = MISS
    if not wp.isfinite(ray.scale):
        name = BAD
    elif met_face[k] >= 0:
        step = _ROUNDING * ray.scale
        begin = clearance - step
        if start.shape[0] > 0:
            begin = start[i]
        near = begin + wp.float64(met_at[k])
        name = names[met_face[k]]
        t, met = plane_distance(ray, planes[name], near, clearance)
        found = t
        if not met:
            found = near + step
            name = AGAIN
    distance[i] = found
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
