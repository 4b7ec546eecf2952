"""Diffuse bounces seen from a receiver, in three steps: what its rays meet, how a source lights that, what it sends on.

The first step knows no transmitter, the second no materials, the third no rays: each is kept and reused. A source is
the transmitter or its image behind a mirror patch. Hierarchy and angles are float32, ranges float64.
"""

import warp as wp

from warprrf.kernels.radio.scatter import local

INV_PI = wp.constant(0.3183098861837907)
MOMENTS = 3
"""Components that a family of Fresnel curves is resolved into."""


@wp.struct
class Surface:
    """Faces of a mesh and what they belong to.

    ``normal`` may be smoother than the faces; ``patch`` is -1 off all planar patches; ``clearance`` [m] is the depth
    of the skin in which a shadow ray ignores the surface that it ends on.
    """

    mesh: wp.uint64
    center: wp.vec3d
    corner: wp.array(dtype=wp.vec3d)
    flat_normal: wp.array(dtype=wp.vec3d)
    normal: wp.array(dtype=wp.vec3)
    patch: wp.array(dtype=wp.int32)
    group: wp.array(dtype=wp.int32)
    element: wp.array(dtype=wp.int32)
    clearance: wp.float32


@wp.struct
class Source:
    """A transmitter, or its image in the plane of ``patch`` (-1: none): then ``real`` is the transmitter itself."""

    position: wp.vec3d
    real: wp.vec3d
    patch: wp.int32


@wp.func
def narrow(v: wp.vec3d):
    """A vector in single precision."""
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def widen(v: wp.vec3):
    """A vector in double precision."""
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def clear(surface: Surface, a: wp.vec3d, b: wp.vec3d, skin: float):
    """Whether nothing lies between ``a`` and ``b``, but within ``skin`` [m] of either end."""
    way = b - a
    length = wp.float32(wp.length(way))
    free = bool(True)
    if length > 2.0 * skin:
        toward = narrow(way) / length
        query = wp.mesh_query_ray(
            surface.mesh, local(a, surface.center) + skin * toward, toward, length - 2.0 * skin
        )
        free = not query.result
    return free


@wp.kernel
def meet_surface(
    offset: int,
    surface: Surface,
    origins: wp.array(dtype=wp.vec3d),
    per_origin: int,
    directions: wp.array(dtype=wp.vec3d),
    face: wp.array(dtype=wp.int32),
    range_m: wp.array(dtype=wp.float64),
):
    """Face and range that each ray meets; -1 and infinity where it escapes.

    Ray k starts at origin k / per_origin; ``directions`` holds one for each ray, or one set for every origin.
    """
    k = offset + wp.tid()
    receiver = origins[k / per_origin]
    d = directions[k % directions.shape[0]]
    face[k] = -1
    range_m[k] = wp.float64(wp.inf)
    query = wp.mesh_query_ray(surface.mesh, local(receiver, surface.center), narrow(d), 1.0e30)
    if query.result:
        face[k] = query.face
        t = wp.float64(query.t)
        n = surface.flat_normal[query.face]
        slope = wp.dot(n, d)
        if wp.abs(slope) > wp.float64(1.0e-7):
            t = wp.dot(n, surface.corner[query.face] - receiver) / slope
        range_m[k] = wp.max(t, wp.float64(1.0e-6))


@wp.kernel
def light_surface(
    offset: int,
    surface: Surface,
    source: Source,
    origins: wp.array(dtype=wp.vec3d),
    per_origin: int,
    directions: wp.array(dtype=wp.vec3d),
    face: wp.array(dtype=wp.int32),
    range_m: wp.array(dtype=wp.float64),
    solid_angle: wp.array(dtype=wp.float32),
    half_width: float,
    nearest: float,
    shadows: int,
    strength: wp.array(dtype=wp.float32),
    cos_in: wp.array(dtype=wp.float32),
    cos_mirror: wp.array(dtype=wp.float32),
    grazing: wp.array(dtype=wp.float32),
):
    """How ``source`` lights what each ray met.

    Writes ``strength`` = Omega cos(theta_i) / (4 pi d1)^2 times visibility [sr/m^2], the cosine of incidence, of the
    angle between the scattered and the mirror direction, and the mean of 1 / cos(theta_s) over +-``half_width`` (what
    lies below the horizon left out). ``nearest`` [m] bounds d1 from below: an element at the source spans directions.
    Without ``shadows`` whoever launches this finds out what the transmitter itself does not see.
    """
    k = offset + wp.tid()
    strength[k] = 0.0
    f = face[k]
    if f >= 0:
        d = directions[k % directions.shape[0]]
        point = origins[k / per_origin] + range_m[k] * d
        way = source.position - point
        d1 = wp.float32(wp.length(way))
        toward = narrow(way) / wp.max(d1, 1.0e-9)
        look = -narrow(d)
        n = surface.normal[f]
        cos_s = wp.dot(n, look)
        if wp.dot(narrow(surface.flat_normal[f]), look) < 0.0:
            n = -n
            cos_s = -cos_s
        cos_s = wp.max(cos_s, 0.0)  # a smoothed normal may turn away from who sees the face
        cos_i = wp.dot(n, toward)
        if cos_i > 0.0 and d1 > 0.0:
            lit = bool(True)
            if source.patch < 0 and shadows != 0:
                lit = clear(surface, source.position, point, surface.clearance)
            elif source.patch >= 0:
                # The ray towards the image must meet its patch first, and see the transmitter from there.
                lit = False
                start = local(point, surface.center) + surface.clearance * toward
                query = wp.mesh_query_ray(surface.mesh, start, toward, d1)
                if query.result:
                    if surface.patch[query.face] == source.patch and surface.patch[f] != source.patch:
                        turn = point + wp.float64(query.t + surface.clearance) * widen(toward)
                        lit = clear(surface, turn, source.real, surface.clearance)
            if lit:
                reach = wp.max(d1, nearest)
                strength[k] = (
                    solid_angle[k % solid_angle.shape[0]] * cos_i / (157.91367041742973 * reach * reach)
                )
                cos_in[k] = wp.min(cos_i, 1.0)
                cos_mirror[k] = wp.clamp(2.0 * cos_i * cos_s - wp.dot(toward, look), -1.0, 1.0)
                high = cos_s + half_width
                low = wp.max(cos_s - half_width, 0.01 * half_width)
                grazing[k] = wp.log(high / low) / (high - low)


@wp.kernel
def absorb(
    offset: int,
    source: wp.vec3d,
    loss: float,
    origins: wp.array(dtype=wp.vec3d),
    per_origin: int,
    directions: wp.array(dtype=wp.vec3d),
    face: wp.array(dtype=wp.int32),
    range_m: wp.array(dtype=wp.float64),
    strength: wp.array(dtype=wp.float32),
):
    """Take from ``strength`` what air of ``loss`` [neper/m] keeps between source, what the ray met and its origin."""
    k = offset + wp.tid()
    if strength[k] > 0.0:
        point = origins[k / per_origin] + range_m[k] * directions[k % directions.shape[0]]
        length = wp.float32(wp.length(source - point) + range_m[k])
        strength[k] = strength[k] * wp.exp(-loss * length)


@wp.func
def table_value(table: wp.array2d(dtype=wp.float32), row: int, cosine: float):
    """Row of a table over cosine in [0, 1], interpolated linearly."""
    last = table.shape[1] - 1
    x = cosine * float(last)
    i = wp.min(int(x), last - 1)
    s = x - float(i)
    return (1.0 - s) * table[row, i] + s * table[row, i + 1]


@wp.func
def lobe_value(
    exponent: wp.array(dtype=wp.float32),
    norm: wp.array2d(dtype=wp.float32),
    which: int,
    cos_in: float,
    cos_mirror: float,
    grazing: float,
):
    """f_s / cos(theta_s) [1/sr] of lobe ``which``; exponent 0 is Lambertian, whose cosine cancels."""
    value = INV_PI
    if exponent[which] > 0.0:
        value = wp.pow(0.5 * (1.0 + cos_mirror), exponent[which]) * grazing * table_value(norm, which, cos_in)
    return value


@wp.kernel
def resolve_bounces(
    offset: int,
    per_pixel: int,
    surface: Surface,
    place: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
    strength: wp.array(dtype=wp.float32),
    cos_in: wp.array(dtype=wp.float32),
    cos_mirror: wp.array(dtype=wp.float32),
    grazing: wp.array(dtype=wp.float32),
    exponent: wp.array(dtype=wp.float32),
    norm: wp.array2d(dtype=wp.float32),
    moments: wp.array2d(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
):
    """Per pixel, what each group, lobe and Fresnel component would send on: column (group's place, lobe, component)."""
    p = offset + wp.tid()
    lobes = exponent.shape[0]
    for s in range(per_pixel):
        k = p * per_pixel + s
        if strength[k] > 0.0:
            base = place[surface.group[face[k]]] * lobes * MOMENTS
            for j in range(lobes):
                value = strength[k] * lobe_value(exponent, norm, j, cos_in[k], cos_mirror[k], grazing[k])
                for m in range(MOMENTS):
                    column = base + j * MOMENTS + m
                    out[p, column] = out[p, column] + value * table_value(moments, m, cos_in[k])


@wp.kernel
def scatter_bounces(
    offset: int,
    surface: Surface,
    face: wp.array(dtype=wp.int32),
    strength: wp.array(dtype=wp.float32),
    cos_in: wp.array(dtype=wp.float32),
    cos_mirror: wp.array(dtype=wp.float32),
    grazing: wp.array(dtype=wp.float32),
    exponent: wp.array(dtype=wp.float32),
    norm: wp.array2d(dtype=wp.float32),
    fresnel: wp.array2d(dtype=wp.float32),
    weight: wp.array2d(dtype=wp.float32),
    power: wp.array(dtype=wp.float32),
):
    """What each ray brings: sum over lobes of ``weight[group, lobe]`` times the group's Fresnel curve."""
    k = offset + wp.tid()
    value = float(0.0)
    if strength[k] > 0.0:
        g = surface.group[face[k]]
        for j in range(exponent.shape[0]):
            value += weight[g, j] * lobe_value(exponent, norm, j, cos_in[k], cos_mirror[k], grazing[k])
        value *= strength[k] * table_value(fresnel, g, cos_in[k])
    power[k] = value
