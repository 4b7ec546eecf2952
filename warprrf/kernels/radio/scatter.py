"""Single-bounce diffuse scattering seen from a receiver: one ray, one shadow ray and the surface's lobe per sub-pixel.

The hierarchy is float32; every length, angle and coefficient is float64. Reflection: ITU-R P.2040-4 slab, eqs. (37),
(43a), (44). Lobes: Degli-Esposti et al. (2007), or reciprocal ones of the same shape. Complex numbers are vec2d (real,
imaginary).
"""

import warp as wp

PI = wp.constant(wp.float64(3.141592653589793))


@wp.func
def complex_mul(a: wp.vec2d, b: wp.vec2d):
    """Product of complex numbers."""
    return wp.vec2d(a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0])


@wp.func
def complex_div(a: wp.vec2d, b: wp.vec2d):
    """Quotient of complex numbers."""
    return complex_mul(a, wp.vec2d(b[0], -b[1])) / wp.length_sq(b)


@wp.func
def complex_sqrt(a: wp.vec2d):
    """Principal square root: real part not negative."""
    size = wp.length(a)
    real = wp.sqrt(wp.float64(0.5) * wp.max(size + a[0], wp.float64(0.0)))
    imag = wp.sqrt(wp.float64(0.5) * wp.max(size - a[0], wp.float64(0.0)))
    if a[1] < wp.float64(0.0):
        imag = -imag
    return wp.vec2d(real, imag)


@wp.func
def slab_from_interface(r: wp.vec2d, echo: wp.vec2d):
    """Reflection of a slab from that of its face and exp(-2jq). ITU-R P.2040-4, eq. (43a)."""
    one = wp.vec2d(wp.float64(1.0), wp.float64(0.0))
    return complex_div(complex_mul(r, one - echo), one - complex_mul(complex_mul(r, r), echo))


@wp.func
def slab_power_reflection(cos_i: wp.float64, eta: wp.vec2d, thickness: wp.float64, wavelength: wp.float64):
    """(|r_TE|^2 + |r_TM|^2) / 2 of a slab: the mean over transmit polarisations."""
    cos = wp.vec2d(cos_i, wp.float64(0.0))
    root = complex_sqrt(eta - wp.vec2d(wp.float64(1.0) - cos_i * cos_i, wp.float64(0.0)))
    te = complex_div(cos - root, cos + root)
    tm = complex_div(eta * cos_i - root, eta * cos_i + root)
    echo = wp.vec2d()  # a half-space sends none back
    if not wp.isinf(thickness):
        q = wp.float64(2.0) * PI * thickness / wavelength * root
        decay = wp.exp(wp.float64(2.0) * q[1])
        echo = wp.vec2d(decay * wp.cos(wp.float64(2.0) * q[0]), -decay * wp.sin(wp.float64(2.0) * q[0]))
    return wp.float64(0.5) * (
        wp.length_sq(slab_from_interface(te, echo)) + wp.length_sq(slab_from_interface(tm, echo))
    )


@wp.func
def lobe_norm(alpha: int, cos_i: wp.float64):
    """Integral of ((1 + cos psi) / 2)^alpha over the hemisphere. Degli-Esposti et al. (2007), eqs. (11) to (14)."""
    one = wp.float64(1.0)
    sin_sq = one - cos_i * cos_i
    binomial = wp.float64(1.0)
    term = wp.float64(1.0)
    series = wp.float64(0.0)
    total = wp.float64(0.0)
    for j in range(alpha + 1):
        share = binomial * wp.float64(2.0) * PI / wp.float64(j + 1)
        if j % 2 == 1:
            series = series + term
            term = term * sin_sq * wp.float64(j) / wp.float64(j + 1)
            share = share * cos_i * series
        total = total + share
        binomial = binomial * wp.float64(alpha - j) / wp.float64(j + 1)
    return total * wp.pow(wp.float64(0.5), wp.float64(alpha))


@wp.func
def lobe_over_cosine(
    alpha: int, cos_i: wp.float64, cos_s: wp.float64, cos_psi: wp.float64, half_width: wp.float64
):
    """f_s / cos(theta_s) [1/sr], averaged over the stretch of +-``half_width`` in cosine that a direction stands for.

    A Lambertian lobe's cosine cancels. Else 1 / cos is replaced by its mean, ln(b / a) / (b - a), which stays finite
    at grazing; what lies below the horizon shows another surface, so the mean is over what is above.
    """
    if alpha == 0:
        return wp.float64(1.0) / PI
    high = cos_s + half_width
    low = wp.max(cos_s - half_width, wp.float64(0.01) * half_width)
    f = wp.pow(wp.float64(0.5) * (wp.float64(1.0) + cos_psi), wp.float64(alpha)) / lobe_norm(alpha, cos_i)
    return f * wp.log(high / low) / (high - low)


@wp.func
def factor_at(factor: wp.array2d(dtype=wp.float64), row: int, cosine: wp.float64):
    """Row of a table over cosine in [0, 1], interpolated linearly."""
    last = factor.shape[1] - 1
    x = wp.min(cosine, wp.float64(1.0)) * wp.float64(last)
    i = wp.min(int(x), last - 1)
    s = x - wp.float64(i)
    return (wp.float64(1.0) - s) * factor[row, i] + s * factor[row, i + 1]


@wp.struct
class Materials:
    """What each material does to a wave, arrays by material.

    ``reciprocal`` is 1 where its lobe is the reciprocal one, whose factors b over the cosine are the rows of ``factor``.
    """

    permittivity: wp.array(dtype=wp.vec2d)
    thickness: wp.array(dtype=wp.float64)
    scattering: wp.array(dtype=wp.float64)
    alpha_r: wp.array(dtype=wp.int32)
    reciprocal: wp.array(dtype=wp.int32)
    factor: wp.array2d(dtype=wp.float64)


@wp.func
def scattered(
    m: Materials,
    k: int,
    cos_i: wp.float64,
    cos_s: wp.float64,
    cos_psi: wp.float64,
    half_width: wp.float64,
    wavelength: wp.float64,
):
    """S^2 |Gamma|^2 f_s / cos(theta_s) of material ``k`` [1/sr].

    Reciprocal: the mean of |Gamma|^2 at both angles times b(theta_i) b(theta_s) ((1 + cos psi) / 2)^alpha, which does not
    change when the angles are swapped, and has no pole at grazing.
    """
    gamma = slab_power_reflection(cos_i, m.permittivity[k], m.thickness[k], wavelength)
    lobe = wp.float64(0.0)
    if m.reciprocal[k] == 1:
        back = slab_power_reflection(cos_s, m.permittivity[k], m.thickness[k], wavelength)
        gamma = wp.float64(0.5) * (gamma + back)
        shape = wp.pow(wp.float64(0.5) * (wp.float64(1.0) + cos_psi), wp.float64(m.alpha_r[k]))
        lobe = shape * (factor_at(m.factor, k, cos_i) * factor_at(m.factor, k, cos_s))
    else:
        lobe = lobe_over_cosine(m.alpha_r[k], cos_i, cos_s, cos_psi, half_width)
    return m.scattering[k] * m.scattering[k] * gamma * lobe


@wp.func
def local(point: wp.vec3d, center: wp.vec3d):
    """A point in the float32 frame of the mesh's hierarchy."""
    p = point - center
    return wp.vec3(wp.float32(p[0]), wp.float32(p[1]), wp.float32(p[2]))


@wp.kernel
def scatter_to_receiver(
    offset: int,
    mesh: wp.uint64,
    center: wp.vec3d,
    corners: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    face_material: wp.array(dtype=wp.int32),
    materials: Materials,
    transmitter: wp.vec3d,
    receiver: wp.vec3d,
    wavelength: wp.float64,
    half_width: wp.float64,
    clearance: wp.float64,
    recasts: int,
    directions: wp.array(dtype=wp.vec3d),
    radiance: wp.array(dtype=wp.float64),
    range_m: wp.array(dtype=wp.float64),
):
    """Scattered path gain per solid angle [1/sr] along each direction, and the range of the surface met [m].

    (lambda / 4 pi)^2 S^2 |Gamma|^2 f_s cos(theta_i) / (cos(theta_s) d1^2): free of the receiver's distance, because the
    footprint of a solid angle grows as its square. Source: Degli-Esposti et al. (2007), eq. (5), over the footprint.
    """
    k = offset + wp.tid()
    d = directions[k]
    origin = local(receiver, center)
    toward = wp.vec3(wp.float32(d[0]), wp.float32(d[1]), wp.float32(d[2]))
    radiance[k] = wp.float64(0.0)
    range_m[k] = wp.float64(wp.inf)
    face = int(-1)
    near = float(0.0)
    query = wp.mesh_query_ray(mesh, origin, toward, 1.0e30)
    if query.result:
        face = query.face
        near = query.t
    else:
        # A ray aimed at a vertex of a closed mesh can slip through: turn it a little.
        state = wp.rand_init(7, k)
        for _attempt in range(recasts):
            if face < 0:
                turned = toward + 1.0e-5 * wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
                again = wp.mesh_query_ray(mesh, origin, turned, 1.0e30)
                if again.result:
                    face = again.face
                    near = again.t
    if face >= 0:
        n = normals[face]
        t = wp.float64(near)
        slope = wp.dot(n, d)
        if wp.abs(slope) > wp.float64(1.0e-7):
            t = wp.dot(n, corners[face] - receiver) / slope
        range_m[k] = t
        material = face_material[face]
        p = receiver + t * d
        to_tx = transmitter - p
        d1 = wp.length(to_tx)
        cos_s = -slope
        cos_i = wp.dot(n, to_tx) / d1
        # A sheet scatters on the side that both ends see.
        if cos_s < wp.float64(0.0):
            cos_s = -cos_s
            cos_i = -cos_i
        rough = materials.scattering[material] > wp.float64(0.0)
        if cos_i > wp.float64(0.0) and cos_s > wp.float64(0.0) and rough:
            back = -to_tx / d1
            shadow = wp.mesh_query_ray(
                mesh,
                local(transmitter, center),
                wp.vec3(wp.float32(back[0]), wp.float32(back[1]), wp.float32(back[2])),
                wp.float32(d1 - clearance),
            )
            lit = True
            if shadow.result:
                # The float32 hit may be the lit surface itself: judge its place in float64.
                m = normals[shadow.face]
                fall = wp.dot(m, back)
                reach = wp.float64(shadow.t)
                if wp.abs(fall) > wp.float64(1.0e-7):
                    reach = wp.dot(m, corners[shadow.face] - transmitter) / fall
                lit = reach >= d1 - clearance
            if lit:
                # Mirror direction of the wave from the transmitter, against the direction to the receiver.
                cos_psi = wp.float64(2.0) * cos_i * cos_s - wp.dot(to_tx, -d) / d1
                share = scattered(materials, material, cos_i, cos_s, cos_psi, half_width, wavelength)
                spread = wavelength / (wp.float64(4.0) * PI * d1)
                radiance[k] = spread * spread * share * cos_i
