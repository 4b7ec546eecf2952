"""Diffuse bounces seen from a receiver: how a transmitter illuminates what rays hit, and what materials make of it.

Illumination knows no materials, scattering no rays: each is kept and reused. Angles are float32, ranges float64.
"""

import warp as wp

INV_PI = wp.constant(0.3183098861837907)
MOMENTS = 3
"""Components that a family of Fresnel curves is resolved into."""


@wp.struct
class Surface:
    """Faces of a mesh: their unit normals, those that scattering uses (which may be smoother), their groups, what the first
    side of their elements faces, and these; the second side of element e is ``second_side + e``."""

    flat_normal: wp.array(dtype=wp.vec3d)
    normal: wp.array(dtype=wp.vec3)
    group: wp.array(dtype=wp.int32)
    side_normal: wp.array(dtype=wp.vec3d)
    element: wp.array(dtype=wp.int32)
    second_side: int


@wp.func
def narrow(v: wp.vec3d):
    """A vector in single precision."""
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.kernel
def light_surface(
    offset: int,
    surface: Surface,
    ray: wp.array(dtype=wp.int32),
    source: wp.array(dtype=wp.vec3d),
    origins: wp.array(dtype=wp.vec3d),
    per_origin: int,
    directions: wp.array(dtype=wp.vec3d),
    face: wp.array(dtype=wp.int32),
    range_m: wp.array(dtype=wp.float64),
    solid_angle: wp.array(dtype=wp.float32),
    half_width: float,
    nearest: float,
    loss: float,
    strength: wp.array(dtype=wp.float32),
    cos_in: wp.array(dtype=wp.float32),
    cos_out: wp.array(dtype=wp.float32),
    cos_mirror: wp.array(dtype=wp.float32),
    grazing: wp.array(dtype=wp.float32),
    point: wp.array(dtype=wp.vec3d),
):
    """How transmitters at ``source``, one for all or one for each row, illuminate what rays hit, shadows apart.

    Row k is of ray ``ray[k]``, or of ray k if that is empty. Ray r starts at origin r / per_origin; ``directions`` holds
    one for each ray, or one set for every origin. Writes ``strength`` = Omega cos(theta_i) / (4 pi d1)^2 [sr/m^2] less
    what air of ``loss`` [neper/m] absorbs from the source over the hit to the ray's origin, the cosines of incidence and of
    scattering, that of the angle between the scattered and the mirror direction, the mean of 1 / cos(theta_s) over
    +-``half_width`` (what lies below the horizon left out), and where the ray hits [m]. ``nearest`` [m] bounds d1 from
    below: an element at the source spans directions.
    """
    k = offset + wp.tid()
    strength[k] = 0.0
    r = k
    if ray.shape[0] > 0:
        r = ray[k]
    f = face[r]
    if f >= 0:
        d = directions[r % directions.shape[0]]
        met = origins[r / per_origin] + range_m[r] * d
        way = source[wp.min(k, source.shape[0] - 1)] - met
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
            point[k] = met
            reach = wp.max(d1, nearest)
            air = wp.exp(-loss * (d1 + wp.float32(range_m[r])))
            strength[k] = (
                air * solid_angle[r % solid_angle.shape[0]] * cos_i / (157.91367041742973 * reach * reach)
            )
            cos_in[k] = wp.min(cos_i, 1.0)
            cos_out[k] = wp.min(cos_s, 1.0)
            cos_mirror[k] = wp.clamp(2.0 * cos_i * cos_s - wp.dot(toward, look), -1.0, 1.0)
            high = cos_s + half_width
            low = wp.max(cos_s - half_width, 0.01 * half_width)
            grazing[k] = wp.log(high / low) / (high - low)


@wp.kernel
def send_along(
    offset: int,
    surface: Surface,
    directions: wp.array(dtype=wp.vec3d),
    face: wp.array(dtype=wp.int32),
    range_m: wp.array(dtype=wp.float64),
    solid_angle: wp.array(dtype=wp.float32),
    loss: wp.float64,
    sent: wp.array(dtype=wp.float64),
    power: wp.array(dtype=wp.float64),
):
    """Solid angle of each ray times the radiance that the side met sends; arguments as of :func:`light_surface`."""
    k = offset + wp.tid()
    f = face[k]
    if f >= 0:
        side = surface.element[f]
        if wp.dot(surface.side_normal[f], directions[k % directions.shape[0]]) > wp.float64(0.0):
            side += surface.second_side
        air = wp.exp(-loss * range_m[k])
        power[k] = air * wp.float64(solid_angle[k % solid_angle.shape[0]]) * sent[side]


@wp.func
def table_value(table: wp.array2d(dtype=wp.float32), row: int, cosine: float):
    """Row of a table over cosine in [0, 1], interpolated linearly."""
    last = table.shape[1] - 1
    x = cosine * float(last)
    i = wp.min(int(x), last - 1)
    s = x - float(i)
    return (1.0 - s) * table[row, i] + s * table[row, i + 1]


@wp.struct
class Lobes:
    """A mix of lobes: their exponents, and of each a row of a table over the cosine.

    ``scale`` holds 1 / norm at the angle of incidence; if ``reciprocal`` is 1, a factor that counts at both angles.
    """

    exponent: wp.array(dtype=wp.int32)
    scale: wp.array2d(dtype=wp.float32)
    reciprocal: int


@wp.func
def lobe_value(lobes: Lobes, which: int, cos_in: float, cos_out: float, cos_mirror: float, grazing: float):
    """f_s / cos(theta_s) [1/sr] of lobe ``which``; exponent 0 is Lambertian, whose cosine cancels."""
    value = INV_PI
    n = int(lobes.exponent[which])
    if n > 0:
        power = wp.float64(1.0)
        square = wp.float64(0.5 * (1.0 + cos_mirror))
        while n > 0:
            if n & 1 == 1:
                power *= square
            square *= square
            n = n >> 1
        value = wp.float32(power)
        if lobes.reciprocal == 1:
            value *= table_value(lobes.scale, which, cos_in) * table_value(lobes.scale, which, cos_out)
        else:
            value *= grazing * table_value(lobes.scale, which, cos_in)
    return value


@wp.func
def reflected(table: wp.array2d(dtype=wp.float32), row: int, lobes: Lobes, cos_in: float, cos_out: float):
    """|Gamma|^2 by a row of a table: at incidence; if the lobes are reciprocal, the mean of that at both angles."""
    value = table_value(table, row, cos_in)
    if lobes.reciprocal == 1:
        value = 0.5 * (value + table_value(table, row, cos_out))
    return value


@wp.kernel
def resolve_bounces(
    offset: int,
    first: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    surface: Surface,
    place: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
    strength: wp.array(dtype=wp.float32),
    cos_in: wp.array(dtype=wp.float32),
    cos_out: wp.array(dtype=wp.float32),
    cos_mirror: wp.array(dtype=wp.float32),
    grazing: wp.array(dtype=wp.float32),
    lobes: Lobes,
    moments: wp.array2d(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
):
    """Per row of rays, what each group, lobe and Fresnel component scatters: column (group's place, lobe, component).

    The rays of row p are ``order[first[p]]`` to ``order[first[p + 1] - 1]``.
    """
    p = offset + wp.tid()
    count = lobes.exponent.shape[0]
    for s in range(first[p], first[p + 1]):
        k = order[s]
        if strength[k] > 0.0:
            base = place[surface.group[face[k]]] * count * MOMENTS
            for j in range(count):
                value = strength[k] * lobe_value(lobes, j, cos_in[k], cos_out[k], cos_mirror[k], grazing[k])
                for m in range(MOMENTS):
                    column = base + j * MOMENTS + m
                    part = value * reflected(moments, m, lobes, cos_in[k], cos_out[k])
                    out[p, column] = out[p, column] + part


@wp.kernel
def scatter_bounces(
    offset: int,
    surface: Surface,
    face: wp.array(dtype=wp.int32),
    strength: wp.array(dtype=wp.float32),
    cos_in: wp.array(dtype=wp.float32),
    cos_out: wp.array(dtype=wp.float32),
    cos_mirror: wp.array(dtype=wp.float32),
    grazing: wp.array(dtype=wp.float32),
    lobes: Lobes,
    fresnel: wp.array2d(dtype=wp.float32),
    weight: wp.array2d(dtype=wp.float32),
    power: wp.array(dtype=wp.float32),
):
    """What each ray brings: sum over lobes of ``weight[group, lobe]`` times the group's Fresnel curve."""
    k = offset + wp.tid()
    value = float(0.0)
    if strength[k] > 0.0:
        g = surface.group[face[k]]
        for j in range(lobes.exponent.shape[0]):
            value += weight[g, j] * lobe_value(lobes, j, cos_in[k], cos_out[k], cos_mirror[k], grazing[k])
        value *= strength[k] * reflected(fresnel, g, lobes, cos_in[k], cos_out[k])
    power[k] = value
