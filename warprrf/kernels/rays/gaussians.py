"""Gaussians along arbitrary rays: which of them a ray meets, how opaque they are there, and the adjoints.

For a ray ``o + t d`` (unit ``d``) and a Gaussian with mean ``c`` and whitening matrix ``M = diag(1/s) R^T``, the offset
``p = (m.d) d - m`` of the ray's nearest point from ``m = c - o`` gives

    g = M d,   h = M p,   t = m.d - (h.g)/|g|^2,   y = h - (h.g)/|g|^2 g,   q = |y|^2,

the peak of the response at range ``t`` and ``alpha = min(opacity exp(-q/2), alpha_max)`` there: the definition of
:mod:`warprrf.kernels.raster.project` for one ray origin, here for any. All of it in float64; the hierarchy of boxes
around the ellipsoids ``q < cut`` is in float32 and only proposes candidates.

Adjoint: with ``A = dM M^-1``, ``dq = 2 (y.A y - y.M dc)`` and ``dt = -(g.A y + y.A g - g.M dc)/|g|^2``, so that
every pair adds to a 3-vector and a symmetric 3x3 per Gaussian, which :func:`chain` turns into gradients of mean, scale
and quaternion.
"""

from types import SimpleNamespace

import warp as wp

from warprrf.cache import once
from warprrf.kernels.raster.project import quaternion_gradient
from warprrf.kernels.raster.view import PRODUCT, Rules, rotation_matrix

SUMS = 10  # numbers per Gaussian that the adjoints sum: Y1 3, Y2 6, opacity
BY_PEAK, BY_RANGE = 0, 1  # order of hits: peak along the ray, or distance of the mean from the ray's origin

# What float32 may err in placing a ray or a box, over the largest length in the scene: about 20 roundings of 2^-24.
ROUNDING = 1.5e-6


@wp.struct
class Scene:
    """Gaussians and the hierarchy of their boxes; box ``j`` is around Gaussian ``ids[j]``, relative to ``center``."""

    bvh: wp.uint64
    center: wp.vec3d
    radius: wp.float64
    ids: wp.array(dtype=int)
    means: wp.array(dtype=wp.vec3d)
    whitening: wp.array(dtype=wp.mat33d)
    opacities: wp.array(dtype=wp.float64)
    cuts: wp.array(dtype=wp.float64)


@wp.struct
class Meeting:
    """A ray and a Gaussian: whitened direction and offset at the peak, range of the peak [m], squared distance."""

    g: wp.vec3d
    gg: wp.float64
    y: wp.vec3d
    t: wp.float64
    q: wp.float64


@wp.func
def meeting(scene: Scene, k: int, origin: wp.vec3d, unit: wp.vec3d):
    """How the ray passes Gaussian ``k``."""
    out = Meeting()
    m = scene.means[k] - origin
    along = wp.dot(m, unit)
    whiten = scene.whitening[k]
    out.g = whiten * unit
    out.gg = wp.dot(out.g, out.g)
    h = whiten * (along * unit - m)
    shift = wp.dot(h, out.g) / out.gg
    out.t = along - shift
    out.y = h - shift * out.g
    out.q = wp.dot(out.y, out.y)
    return out


@wp.func
def lead(scene: Scene, origin: wp.vec3d, unit: wp.vec3d):
    """How far a ray can go before it comes near any box [m]: from there float32 places it well."""
    return wp.max(-wp.dot(origin - scene.center, unit) - scene.radius, wp.float64(0.0))


@wp.func
def reach(scene: Scene, length: wp.float64, ahead: wp.float64):
    """Where a search that starts ``ahead`` may end for peaks up to ``length`` [m]."""
    slack = wp.float64(wp.static(ROUNDING)) * (wp.float64(4.0) * scene.radius + wp.abs(length - ahead))
    return wp.float32(wp.min(length - ahead + slack, wp.float64(1.0e30)))


@wp.func
def counts(scene: Scene, k: int, met: Meeting, length: wp.float64):
    """Whether the pair contributes: alpha above alpha_min, peak within the segment."""
    return met.q < scene.cuts[k] and met.t > wp.float64(0.0) and met.t < length


@wp.func
def add_pair(
    sums: wp.array(dtype=wp.float64, ndim=3),
    piece: int,
    k: int,
    met: Meeting,
    slope_q: wp.float64,
    slope_t: wp.float64,
    slope_opacity: wp.float64,
):
    """Add what the gradients of q and t mean for Gaussian ``k``."""
    half = wp.float64(0.5) * slope_t / met.gg
    first = slope_q * met.y - half * met.g
    cross = wp.outer(met.g, met.y)
    second = slope_q * wp.outer(met.y, met.y) - half * (cross + wp.transpose(cross))
    wp.atomic_add(sums, piece, k, 0, first[0])
    wp.atomic_add(sums, piece, k, 1, first[1])
    wp.atomic_add(sums, piece, k, 2, first[2])
    wp.atomic_add(sums, piece, k, 3, second[0, 0])
    wp.atomic_add(sums, piece, k, 4, second[0, 1])
    wp.atomic_add(sums, piece, k, 5, second[0, 2])
    wp.atomic_add(sums, piece, k, 6, second[1, 1])
    wp.atomic_add(sums, piece, k, 7, second[1, 2])
    wp.atomic_add(sums, piece, k, 8, second[2, 2])
    wp.atomic_add(sums, piece, k, 9, slope_opacity)


@wp.kernel(enable_backward=False)
def transmit(
    offset: int,
    scene: Scene,
    rules: Rules,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    transmittance: wp.array(dtype=wp.float64),
    open_part: wp.array(dtype=wp.float64),
    closed: wp.array(dtype=int),
):
    """Transmittance of each segment; apart, that of the layers with alpha below one and how many layers have one."""
    i = offset + wp.tid()
    origin = starts[wp.min(i, starts.shape[0] - 1)]
    way = ends[wp.min(i, ends.shape[0] - 1)] - origin
    length = wp.length(way)
    product = wp.float64(1.0)
    total = wp.float64(0.0)
    shut = int(0)
    if length > wp.float64(0.0):
        unit = way / length
        ahead = lead(scene, origin, unit)
        if scene.ids.shape[0] > 0 and ahead < length:
            query = wp.bvh_query_ray(scene.bvh, wp.vec3(origin - scene.center + ahead * unit), wp.vec3(unit))
            box = int(0)
            while wp.bvh_query_next(query, box, reach(scene, length, ahead)):
                k = scene.ids[box]
                met = meeting(scene, k, origin, unit)
                if counts(scene, k, met, length):
                    alpha = wp.min(scene.opacities[k] * wp.exp(wp.float64(-0.5) * met.q), rules.alpha_max)
                    total += alpha
                    if alpha < wp.float64(1.0):
                        product = product * (wp.float64(1.0) - alpha)
                    else:
                        shut += 1
    if rules.rule != wp.static(PRODUCT):
        product = wp.exp(-total)
        shut = 0
    open_part[i] = product
    closed[i] = shut
    transmittance[i] = wp.where(shut > 0, wp.float64(0.0), product)


@wp.kernel(enable_backward=False)
def transmit_adjoint(
    offset: int,
    rays: int,
    pieces: int,
    scene: Scene,
    rules: Rules,
    starts: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    open_part: wp.array(dtype=wp.float64),
    closed: wp.array(dtype=int),
    transmittance_grad: wp.array(dtype=wp.float64),
    sums: wp.array(dtype=wp.float64, ndim=3),
):
    """Same walk as :func:`transmit`; dT/dalpha_i is minus the product of the other layers' (1 - alpha)."""
    i = offset + wp.tid()
    piece = ((i + 1) * pieces - 1) / rays
    incoming = transmittance_grad[i]
    origin = starts[wp.min(i, starts.shape[0] - 1)]
    way = ends[wp.min(i, ends.shape[0] - 1)] - origin
    length = wp.length(way)
    if incoming == wp.float64(0.0) or length == wp.float64(0.0) or scene.ids.shape[0] == 0 or closed[i] > 1:
        return
    unit = way / length
    ahead = lead(scene, origin, unit)
    if ahead >= length:
        return
    query = wp.bvh_query_ray(scene.bvh, wp.vec3(origin - scene.center + ahead * unit), wp.vec3(unit))
    box = int(0)
    while wp.bvh_query_next(query, box, reach(scene, length, ahead)):
        k = scene.ids[box]
        met = meeting(scene, k, origin, unit)
        if counts(scene, k, met, length):
            response = wp.exp(wp.float64(-0.5) * met.q)
            raw = scene.opacities[k] * response
            if raw <= rules.alpha_max:
                others = open_part[i]
                if rules.rule == wp.static(PRODUCT):
                    if raw < wp.float64(1.0):
                        others = wp.where(
                            closed[i] == 0, open_part[i] / (wp.float64(1.0) - raw), wp.float64(0.0)
                        )
                slope = -incoming * others
                add_pair(
                    sums, piece, k, met, wp.float64(-0.5) * slope * raw, wp.float64(0.0), slope * response
                )


@wp.kernel(enable_backward=False)
def collect(
    offset: int,
    scene: Scene,
    rules: Rules,
    order: int,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=int, ndim=2),
    key: wp.array(dtype=wp.float64, ndim=2),
    t: wp.array(dtype=wp.float64, ndim=2),
    alpha: wp.array(dtype=wp.float64, ndim=2),
    weight: wp.array(dtype=wp.float64, ndim=2),
    left: wp.array(dtype=wp.float64),
):
    """The first K Gaussians along each ray, sorted as candidates come, then their blending weights."""
    i = offset + wp.tid()
    left[i] = wp.float64(1.0)
    if scene.ids.shape[0] == 0:
        return
    origin = origins[wp.min(i, origins.shape[0] - 1)]
    unit = wp.normalize(directions[wp.min(i, directions.shape[0] - 1)])
    capacity = index.shape[1]
    ahead = lead(scene, origin, unit)
    length = wp.float64(wp.inf)
    query = wp.bvh_query_ray(scene.bvh, wp.vec3(origin - scene.center + ahead * unit), wp.vec3(unit))
    box = int(0)
    found = int(0)
    while wp.bvh_query_next(query, box, reach(scene, length, ahead)):
        k = scene.ids[box]
        met = meeting(scene, k, origin, unit)
        if counts(scene, k, met, wp.float64(wp.inf)):
            rank = met.t
            if order == wp.static(BY_RANGE):
                rank = wp.float64(wp.float32(wp.length(scene.means[k] - origin)))
            place = found
            while place > 0 and (
                key[i, place - 1] > rank or (key[i, place - 1] == rank and index[i, place - 1] > k)
            ):
                if place < capacity:
                    key[i, place] = key[i, place - 1]
                    index[i, place] = index[i, place - 1]
                    t[i, place] = t[i, place - 1]
                    alpha[i, place] = alpha[i, place - 1]
                place -= 1
            if place < capacity:
                key[i, place] = rank
                index[i, place] = k
                t[i, place] = met.t
                alpha[i, place] = wp.min(
                    scene.opacities[k] * wp.exp(wp.float64(-0.5) * met.q), rules.alpha_max
                )
                found = wp.min(found + 1, capacity)
            if found == capacity and order == wp.static(BY_PEAK):
                length = key[i, capacity - 1]  # no need to look behind the last place
    transmittance = wp.float64(1.0)
    for place in range(found):
        if transmittance > rules.transmittance_min:
            a = alpha[i, place]
            weight[i, place] = a * transmittance
            if rules.rule == wp.static(PRODUCT):
                transmittance = transmittance * (wp.float64(1.0) - a)
            else:
                transmittance = transmittance * wp.exp(-a)
        else:
            index[i, place] = -1
            t[i, place] = wp.float64(wp.inf)
            alpha[i, place] = wp.float64(0.0)
    left[i] = transmittance


@wp.kernel(enable_backward=False)
def collect_adjoint(
    offset: int,
    rays: int,
    pieces: int,
    scene: Scene,
    rules: Rules,
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=int, ndim=2),
    alpha: wp.array(dtype=wp.float64, ndim=2),
    weight: wp.array(dtype=wp.float64, ndim=2),
    t_grad: wp.array(dtype=wp.float64, ndim=2),
    alpha_grad: wp.array(dtype=wp.float64, ndim=2),
    weight_grad: wp.array(dtype=wp.float64, ndim=2),
    left_grad: wp.array(dtype=wp.float64),
    sums: wp.array(dtype=wp.float64, ndim=3),
):
    """From the last hit to the first, with the gradient per unit of light left behind: no division by 1 - alpha."""
    i = offset + wp.tid()
    piece = ((i + 1) * pieces - 1) / rays
    origin = origins[wp.min(i, origins.shape[0] - 1)]
    unit = wp.normalize(directions[wp.min(i, directions.shape[0] - 1)])
    capacity = index.shape[1]
    behind = left_grad[i]
    for back in range(capacity):
        place = capacity - 1 - back
        k = index[i, place]
        if k >= 0:
            a = alpha[i, place]
            passed = wp.float64(1.0) - a
            fall = wp.float64(1.0)
            if rules.rule != wp.static(PRODUCT):
                passed = wp.exp(-a)
                fall = passed
            before = weight[i, place] / a
            slope = alpha_grad[i, place] + before * (weight_grad[i, place] - fall * behind)
            behind = weight_grad[i, place] * a + passed * behind
            met = meeting(scene, k, origin, unit)
            response = wp.exp(wp.float64(-0.5) * met.q)
            raw = scene.opacities[k] * response
            if raw > rules.alpha_max:
                slope = wp.float64(0.0)
            add_pair(sums, piece, k, met, wp.float64(-0.5) * slope * raw, t_grad[i, place], slope * response)


@once
def build(real: type) -> SimpleNamespace:
    """The kernels that read and write the parameters, for ``wp.float32`` or ``wp.float64``."""
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    total = wp.types.vector(SUMS, wp.float64)

    @wp.kernel(module="unique", enable_backward=False)
    def whiten(
        offset: int,
        means: wp.array(dtype=vec3),
        quaternions: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real),
        rules: Rules,
        centers: wp.array(dtype=wp.vec3d),
        whitening: wp.array(dtype=wp.mat33d),
        opacity: wp.array(dtype=wp.float64),
        cuts: wp.array(dtype=wp.float64),
        half: wp.array(dtype=wp.vec3d),
    ):
        """Each Gaussian in float64: whitening matrix, q at which alpha falls below alpha_min, half size of its box."""
        i = offset + wp.tid()
        centers[i] = wp.vec3d(means[i])
        s = wp.vec3d(scales[i])
        r = rotation_matrix(wp.vec4d(quaternions[i]))
        a = wp.float64(opacities[i])
        cut = wp.float64(0.0)
        if a > rules.alpha_min:
            cut = wp.float64(2.0) * wp.log(a / rules.alpha_min)
        opacity[i] = a
        cuts[i] = cut
        m = wp.mat33d()
        for row in range(3):
            for column in range(3):
                m[row, column] = r[column, row] / s[row]
        whitening[i] = m
        extent = wp.vec3d()
        for axis in range(3):
            extent[axis] = wp.sqrt(cut) * wp.length(
                wp.vec3d(r[axis, 0] * s[0], r[axis, 1] * s[1], r[axis, 2] * s[2])
            )
        half[i] = extent

    @wp.kernel(module="unique", enable_backward=False)
    def chain(
        offset: int,
        quaternions: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        whitening: wp.array(dtype=wp.mat33d),
        sums: wp.array(dtype=wp.float64, ndim=3),
        means_grad: wp.array(dtype=vec3),
        quaternions_grad: wp.array(dtype=vec4),
        scales_grad: wp.array(dtype=vec3),
        opacities_grad: wp.array(dtype=real),
    ):
        """Add up the parts of ``sums``, then the gradients of mean, quaternion, scale and opacity:
        dL/dmean = -2 M^T Y1, dL/ds_i = -2 Y2_ii / s_i."""
        i = offset + wp.tid()
        y = total()
        for p in range(sums.shape[0]):
            for k in range(wp.static(SUMS)):
                y[k] += sums[p, i, k]
        two = wp.float64(2.0)
        s = wp.vec3d(scales[i])
        y1 = wp.vec3d(y[0], y[1], y[2])
        y2 = wp.mat33d(y[3], y[4], y[5], y[4], y[6], y[7], y[5], y[7], y[8])
        means_grad[i] = means_grad[i] - vec3(two * (wp.transpose(whitening[i]) * y1))
        scales_grad[i] = scales_grad[i] - vec3(wp.cw_div(two * wp.get_diag(y2), s))
        quaternions_grad[i] = quaternions_grad[i] + vec4(quaternion_gradient(wp.vec4d(quaternions[i]), y2, s))
        opacities_grad[i] = opacities_grad[i] + real(y[9])

    return SimpleNamespace(whiten=whiten, chain=chain)
