"""Paths over given mirrors and slabs: delay, angles, interaction points and polarised gain as a function of both ends, of what
their antennas are turned by, and of materials. One kernel answers and, by its adjoint, gives the derivatives.

The image method without its search: the transmitter is mirrored in one plane after the other, and the way is unfolded from the
receiver back. The field of each transmitted polarisation goes along as a complex vector E. With k its direction before and k'
behind, s the unit vector across the plane of incidence, and TE and TM of ITU-R P.2040-4, eqs. (37), (43), (44), each interaction
makes of it

    E' = TE s (s . E) + TM (s x k') ((s x k) . E),

whatever s is where a mirror is met head on. What a loop hands on from one interaction to the next goes through arrays, each
element written once: the adjoint of a loop reads it there, and would not know a variable's. All in float64.
"""

import warp as wp

from warprrf.kernels.radio import slabs

real = wp.float64
times, spun, slab = (getattr(slabs.build(real), name) for name in ("times", "spun", "slab"))
SPEED_OF_LIGHT = wp.constant(real(299_792_458.0))
VACUUM_PERMITTIVITY = wp.constant(real(8.8541878128e-12))  # [F/m]
TURN = wp.constant(real(6.283185307179586))
PARALLEL = wp.constant(
    real(1e-6)
)  # sine of incidence below which a mirror has no plane of incidence of its own

IMAGE = wp.constant(0)  # of the transmitter
WAY = wp.constant(1)  # direction of each leg
MET = wp.constant(2)  # where the way back stands
WAVE = wp.constant(3)  # field, four of them: real and imaginary of either polarisation
REST = wp.constant(7)  # phase factor of TE (real, imaginary), and detour in slabs [m]
STATE = 8
"""Vectors of each interaction that are handed on to the next one."""


@wp.struct
class Sequences:
    """What L paths meet, up to K interactions each, from the transmitter on.

    ``receiver`` is the index of each path's end, ``count`` of its interactions. Of these: whether it mirrors (1) or is passed (0),
    its plane (``normal . x = plane_offset``), its material, -1 for a mirror that is perfect and has no sign, and the thickness
    [m] of a slab that is a solid, else NaN.
    """

    receiver: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    mirrors: wp.array2d(dtype=wp.int32)
    normal: wp.array2d(dtype=wp.vec3d)
    plane_offset: wp.array2d(dtype=real)
    material: wp.array2d(dtype=wp.int32)
    solid_m: wp.array2d(dtype=real)
    frequency_hz: real


@wp.func
def angles_of(d: wp.vec3d):
    """Zenith and azimuth of a direction [rad]; azimuth 0 along the pole."""
    across = d[0] * d[0] + d[1] * d[1]
    zenith = wp.where(d[2] < real(0.0), real(0.5) * TURN, real(0.0))
    azimuth = real(0.0)
    if across > real(0.0):
        zenith = wp.atan2(wp.sqrt(across), d[2])
        azimuth = wp.atan2(d[1], d[0])
        if azimuth == -real(0.5) * TURN:
            azimuth = real(0.5) * TURN
    return zenith, azimuth


@wp.func
def zenith_vector(zenith: real, azimuth: real):
    """Unit vector along which the zenith grows."""
    c = wp.cos(zenith)
    return wp.vec3d(c * wp.cos(azimuth), c * wp.sin(azimuth), -wp.sin(zenith))


@wp.func
def azimuth_vector(azimuth: real):
    """Unit vector along which the azimuth grows."""
    return wp.vec3d(-wp.sin(azimuth), wp.cos(azimuth), real(0.0))


@wp.func
def rotation_of(o: wp.vec3d):
    """From an antenna's axes, turned by yaw, pitch and roll [rad], to the world's; 3GPP TR 38.901, eq. (7.1-4)."""
    a = wp.cos(o[0])
    b = wp.cos(o[1])
    c = wp.cos(o[2])
    u = wp.sin(o[0])
    v = wp.sin(o[1])
    w = wp.sin(o[2])
    return wp.mat33d(
        a * b, a * v * w - u * c, a * v * c + u * w,
        u * b, u * v * w + a * c, u * v * c - a * w,
        -v, b * w, b * c,
    )  # fmt: skip


@wp.func
def across_of(way: wp.vec3d, normal: wp.vec3d):
    """Unit vector across the plane of incidence; any across ``way`` where it meets a plane head on."""
    found = wp.cross(way, normal)
    if wp.dot(found, found) < PARALLEL * PARALLEL:
        found = wp.vec3d(real(0.0), -way[2], way[1])
        if wp.abs(way[0]) > real(0.5):
            found = wp.vec3d(way[2], real(0.0), -way[0])
    return found / wp.sqrt(wp.dot(found, found))


@wp.kernel
def follow_paths(
    offset: int,
    paths: Sequences,
    transmitter: wp.array(dtype=wp.vec3d),
    receiver: wp.array(dtype=wp.vec3d),
    transmitter_orientation: wp.array(dtype=wp.vec3d),
    receiver_orientation: wp.array(dtype=wp.vec3d),
    relative_permittivity: wp.array(dtype=real),
    conductivity: wp.array(dtype=real),
    thickness_m: wp.array(dtype=real),
    roughness_m: wp.array(dtype=real),
    scattering: wp.array(dtype=real),
    state: wp.array3d(dtype=wp.vec3d),
    gain: wp.array(dtype=wp.vec2d),
    jones: wp.array3d(dtype=wp.vec2d),
    tau: wp.array(dtype=real),
    theta_r: wp.array(dtype=real),
    phi_r: wp.array(dtype=real),
    theta_t: wp.array(dtype=real),
    phi_t: wp.array(dtype=real),
    vertices: wp.array2d(dtype=wp.vec3d),
):
    """Answers of each path, from ``gain`` on.

    There is one transmitter; one orientation of receivers stands for all. Angles and Jones matrices are those of the antennas'
    own axes. ``vertices`` are NaN past the last interaction. ``state`` (L, K + 1, :data:`STATE`) is what loops hand on.
    """
    i = offset + wp.tid()
    n = paths.count[i]
    r = paths.receiver[i]
    wavelength_m = SPEED_OF_LIGHT / paths.frequency_hz
    state[i, 0, IMAGE] = transmitter[0]
    for j in range(n):
        height = wp.dot(paths.normal[i, j], state[i, j, IMAGE]) - paths.plane_offset[i, j]
        state[i, j + 1, IMAGE] = (
            state[i, j, IMAGE] - real(2 * paths.mirrors[i, j]) * height * paths.normal[i, j]
        )
    whole = receiver[r] - state[i, n, IMAGE]
    length_m = wp.length(whole)
    state[i, n, WAY] = whole / length_m
    state[i, n, MET] = receiver[r]
    for back in range(n):
        j = n - 1 - back
        normal = paths.normal[i, j]
        after = state[i, j + 1, WAY]
        state[i, j, WAY] = after - real(2 * paths.mirrors[i, j]) * wp.dot(after, normal) * normal
        here = state[i, j + 1, MET]
        side = wp.dot(normal, here) - paths.plane_offset[i, j]
        depth = wp.dot(normal, state[i, j + 1, IMAGE]) - paths.plane_offset[i, j]
        state[i, j, MET] = here + side / (side - depth) * (state[i, j + 1, IMAGE] - here)
        vertices[i, j] = state[i, j, MET]
    for j in range(n, vertices.shape[1]):
        vertices[i, j] = wp.vec3d(real(wp.nan), real(wp.nan), real(wp.nan))

    turn_t = rotation_of(transmitter_orientation[0])
    turn_r = rotation_of(receiver_orientation[wp.min(r, receiver_orientation.shape[0] - 1)])
    zenith_t, azimuth_t = angles_of(wp.transpose(turn_t) * state[i, 0, WAY])
    zenith_r, azimuth_r = angles_of(-(wp.transpose(turn_r) * state[i, n, WAY]))
    theta_t[i] = zenith_t
    phi_t[i] = azimuth_t
    theta_r[i] = zenith_r
    phi_r[i] = azimuth_r

    none = wp.vec3d(real(0.0), real(0.0), real(0.0))
    state[i, 0, WAVE + 0] = turn_t * zenith_vector(zenith_t, azimuth_t)
    state[i, 0, WAVE + 1] = none
    state[i, 0, WAVE + 2] = turn_t * azimuth_vector(azimuth_t)
    state[i, 0, WAVE + 3] = none
    state[i, 0, REST] = wp.vec3d(real(1.0), real(0.0), real(0.0))
    for j in range(n):
        before = state[i, j, WAY]
        after = state[i, j + 1, WAY]
        mirrors = paths.mirrors[i, j] == 1
        m = paths.material[i, j]
        te = wp.vec2d(real(1.0), real(0.0))
        tm = wp.vec2d(real(1.0), real(0.0))
        longer = real(0.0)
        if m >= 0:
            lossy = -conductivity[m] / (TURN * paths.frequency_hz * VACUUM_PERMITTIVITY)
            eta = wp.vec2d(relative_permittivity[m], lossy)
            cosine = wp.abs(wp.dot(before, paths.normal[i, j]))
            thick = thickness_m[m]
            if not mirrors and not wp.isnan(paths.solid_m[i, j]):
                thick = paths.solid_m[i, j]
            te, tm, longer = slab(eta, thick / wavelength_m, cosine, mirrors)
            longer = wavelength_m * longer
            if mirrors:
                longer = real(0.0)
                rough = TURN * roughness_m[m] / wavelength_m  # 8 (pi sigma_h / lambda)^2 is twice its square
                smooth = real(0.0)
                if scattering[m] < real(1.0):
                    smooth = wp.exp(real(-2.0) * rough * rough) * wp.sqrt(
                        real(1.0) - scattering[m] * scattering[m]
                    )
                te = smooth * te
                tm = smooth * tm
        s = across_of(before, paths.normal[i, j])
        p = wp.cross(s, before)
        q = wp.cross(s, after)
        for k in range(2):
            e = state[i, j, WAVE + 2 * k]
            f = state[i, j, WAVE + 2 * k + 1]
            along = times(te, wp.vec2d(wp.dot(s, e), wp.dot(s, f)))
            within = times(tm, wp.vec2d(wp.dot(p, e), wp.dot(p, f)))
            state[i, j + 1, WAVE + 2 * k] = along[0] * s + within[0] * q
            state[i, j + 1, WAVE + 2 * k + 1] = along[1] * s + within[1] * q
        size = wp.dot(te, te)
        phase = wp.vec2d(real(1.0), real(0.0))
        if size > real(0.0):
            phase = te / wp.sqrt(size)
        rest = state[i, j, REST]
        turned = times(wp.vec2d(rest[0], rest[1]), phase)
        state[i, j + 1, REST] = wp.vec3d(turned[0], turned[1], rest[2] + longer)

    rest = state[i, n, REST]
    delay = (length_m + rest[2]) / SPEED_OF_LIGHT
    tau[i] = delay
    cycles = paths.frequency_hz * delay  # whole turns are dropped: there are 1e4 and more
    friis = wavelength_m / (real(2.0) * TURN * length_m)
    factor = friis * spun(TURN * (cycles - wp.floor(cycles)))
    up = turn_r * zenith_vector(zenith_r, azimuth_r)
    around = turn_r * azimuth_vector(azimuth_r)
    power = real(0.0)
    for k in range(2):
        e = state[i, n, WAVE + 2 * k]
        f = state[i, n, WAVE + 2 * k + 1]
        a = wp.vec2d(wp.dot(up, e), wp.dot(up, f))
        b = wp.vec2d(wp.dot(around, e), wp.dot(around, f))
        power += wp.dot(a, a) + wp.dot(b, b)
        jones[i, 0, k] = times(factor, a)
        jones[i, 1, k] = times(factor, b)
    amplitude = real(0.0)
    if power > real(0.0):
        amplitude = wp.sqrt(real(0.5) * power)
    gain[i] = amplitude * times(factor, wp.vec2d(rest[0], rest[1]))
