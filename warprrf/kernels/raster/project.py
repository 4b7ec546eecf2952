"""Seen from one ray origin: a Gaussian's coefficients on every ray, the pixels that it covers, the order of blending.

All rays of a view start at one point. For a Gaussian with whitening matrix ``M = diag(1/s) R^T`` and mean ``m`` seen
from the ray origin, turn the whitened space so that its first axis points at the mean: ``q0 = M m/|M m|``, ``q1, q2``
perpendicular to it. A ray ``d`` has ``g_i = q_i . M d``, three linear forms; its squared Mahalanobis distance is

    q = |M m|^2 (g1^2 + g2^2) / |g|^2,

the response ``exp(-q/2)``, the peak at range ``t = |M m| g0/|g|^2``, visible where ``g0 > 0``. This is exact for every
direction, with no projection to differentiate, and a sum of squares of linear forms loses no digits, which needles
need. ``q`` does not depend on the length of ``d`` and ``t |d|`` neither, so directions are taken where they are
cheapest: on the image plane of a photo, on the cylinder round the pole axis of a panorama. Projection serves binning
only. Coefficients are computed in float64.

Blending works on blocks of 4 x 4 pixels, one Warp vector, which a CPU executes with wide registers. Gaussians are
listed per tile of 4 x 4 blocks, near to far, and each tile's list is then shared out to the blocks that they touch.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import BLOCK as BLOCK
from warprrf.kernels.raster.lanes import LANES as LANES
from warprrf.kernels.raster.lanes import VECTORISED, lanes_of
from warprrf.kernels.raster.lanes import build as lane_functions

TILE = 16  # pixels: tiles are TILE x TILE
CHANNELS = 4  # feature channels blended by one launch
# What a row of coefficients holds, one vector per Gaussian and view. The forms are those of directions (across, along,
# down): camera x, z, y of a photo, world x, y, z of a panorama. G0, REACH, LIFT: M is scaled by the smallest scale.
G0, G1, G2 = 0, 3, 6  # linear forms; G1 and G2 times |M m|
FLAT = 9  # 1 / |M m|^2
CUT, OPACITY = 10, 11  # q at which alpha falls below alpha_min
REACH = 12  # |m| |M m|: a range is REACH g0 / |g|^2 [m]
LIFT, TILT = 13, 14  # how a range's gradient joins the others in `blend_adjoint` [m]
ROW = 16
# Numbers per Gaussian that `blend_adjoint` sums: v q, Y1 without its first component 2, Y2 without its last 5, what
# ranges take from the first component of Y1, opacity, features 4, blending weight. The first nine lack the factor
# -opacity/2 of v, and 1/|M m| for each first component of y but its sign: `chain` multiplies once.
GRADIENTS = 15
SUMS = 16
# Stays finite where scales are near the smallest number: zero offset times infinity would be NaN.
STEEPEST = 1.0e15
PINHOLE, SPHERICAL = 0, 1
PRODUCT, EXPONENTIAL = 0, 1  # transmittance rules: prod(1 - alpha), or the paper's exp(-sum alpha)


@wp.struct
class View:
    """A camera as the kernels see it (float64; world to camera rotation, ray origin in the world)."""

    kind: int
    width: int
    height: int
    tiles_x: int
    tiles_y: int
    fx: wp.float64
    fy: wp.float64
    cx: wp.float64
    cy: wp.float64
    rotation: wp.mat33d
    origin: wp.vec3d


@wp.struct
class Rules:
    """How alpha becomes an image: cutoff, clamp, early exit."""

    alpha_min: wp.float64
    alpha_max: wp.float64
    transmittance_min: wp.float64


@wp.func
def rotation_matrix(w: wp.float64, x: wp.float64, y: wp.float64, z: wp.float64):
    """Rotation of the quaternion wxyz, normalised here."""
    one = wp.float64(1.0)
    n = one / wp.sqrt(w * w + x * x + y * y + z * z)
    w = w * n
    x = x * n
    y = y * n
    z = z * n
    two = wp.float64(2.0)
    return wp.mat33d(
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip


@wp.func
def tangent_interval(c11: wp.float64, c13: wp.float64, c33: wp.float64):
    """Roots of ``c33 x^2 - 2 c13 x + c11``: where image lines x = const touch the silhouette (c33 < 0)."""
    root = wp.sqrt(wp.max(c13 * c13 - c11 * c33, wp.float64(0.0)))
    return wp.vec2d((c13 + root) / c33, (c13 - root) / c33)


@wp.func
def tile_span(lo: wp.float64, hi: wp.float64, pixels: int):
    """First and last tile with a pixel centre in [lo, hi] (pixel coordinates); (0, -1) where there is none."""
    slack = wp.float64(1.0e-3)  # pixels: covers the rounding of the bounds
    edge = wp.float64(pixels)
    first = int(wp.ceil(wp.clamp(lo - slack, wp.float64(-1.0), edge + wp.float64(1.0)) - wp.float64(0.5)))
    last = int(wp.floor(wp.clamp(hi + slack, wp.float64(-1.0), edge + wp.float64(1.0)) - wp.float64(0.5)))
    first = wp.max(first, 0)
    last = wp.min(last, pixels - 1)
    if first > last:
        return wp.vec2i(0, -1)
    return wp.vec2i(first / wp.static(TILE), last / wp.static(TILE))


@wp.func
def covered_tiles(
    view: View,
    m: wp.vec3d,
    distance: wp.float64,
    axes: wp.mat33d,
    extent: wp.float64,
    inside: bool,
):
    """Tiles that an ellipsoid can touch: its half axes the columns of ``axes``, the longest one ``extent``; those and
    its centre ``m`` in the camera's frame (the world's for a panorama).

    Returned are first column, columns, first row, rows; columns wrap on a sphere.

    A plane through the ray origin with normal l touches the ellipsoid where l^T C l = 0, C = axes axes^T - m m^T.
    """
    c = wp.mat33d()
    for i in range(3):
        for j in range(i, 3):
            c[i, j] = (
                axes[i, 0] * axes[j, 0] + axes[i, 1] * axes[j, 1] + axes[i, 2] * axes[j, 2] - m[i] * m[j]
            )
    everything = wp.vec4i(0, view.tiles_x, 0, view.tiles_y)
    nothing = wp.vec4i(0, 0, 0, 0)
    if inside:
        return everything
    cap = wp.float64(
        3.141592653589793
    )  # a long ellipsoid close by reaches more than 90 degrees from its mean
    if extent < distance:
        cap = wp.asin(extent / distance)
    if view.kind == wp.static(PINHOLE):
        if c[2, 2] < wp.float64(0.0):  # the ellipsoid lies on one side of the camera plane
            if m[2] <= wp.float64(0.0):
                return nothing
            x = tangent_interval(c[0, 0], c[0, 2], c[2, 2])
            y = tangent_interval(c[1, 1], c[1, 2], c[2, 2])
            tx = tile_span(view.fx * x[0] + view.cx, view.fx * x[1] + view.cx, view.width)
            ty = tile_span(view.fy * y[0] + view.cy, view.fy * y[1] + view.cy, view.height)
            return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], ty[1] - ty[0] + 1)
        corner = wp.vec2d(
            wp.max(view.cx, wp.float64(view.width) - view.cx) / view.fx,
            wp.max(view.cy, wp.float64(view.height) - view.cy) / view.fy,
        )
        if wp.acos(wp.clamp(m[2] / distance, wp.float64(-1.0), wp.float64(1.0))) > cap + wp.atan(
            wp.length(corner)
        ):
            return nothing
        return everything
    pi = wp.float64(3.141592653589793)
    per_radian = wp.float64(view.height) / pi
    columns = wp.float64(view.width) / (wp.float64(2.0) * pi)
    zenith = wp.acos(wp.clamp(m[2] / distance, wp.float64(-1.0), wp.float64(1.0)))
    ty = tile_span((zenith - cap) * per_radian, (zenith + cap) * per_radian, view.height)
    count_y = ty[1] - ty[0] + 1
    # Silhouette seen along the pole axis: the same dual conic in the horizontal plane.
    c11 = c[0, 0]
    c12 = c[0, 1]
    c22 = c[1, 1]
    determinant = c11 * c22 - c12 * c12
    if determinant >= wp.float64(0.0):  # the pole axis meets the ellipse: every azimuth
        return wp.vec4i(0, view.tiles_x, ty[0], count_y)
    # In the frame whose first axis points at the mean: l = (-sin p, cos p), and tan p solves a quadratic.
    rho = wp.sqrt(m[0] * m[0] + m[1] * m[1])
    cp = m[0] / rho
    sp = m[1] / rho
    d11 = cp * cp * c11 + wp.float64(2.0) * cp * sp * c12 + sp * sp * c22
    d12 = -cp * sp * c11 + (cp * cp - sp * sp) * c12 + cp * sp * c22
    d22 = sp * sp * c11 - wp.float64(2.0) * cp * sp * c12 + cp * cp * c22
    half_lo = -pi
    half_hi = pi
    if d11 < wp.float64(0.0):
        t = tangent_interval(d22, d12, d11)
        half_lo = wp.atan(t[0])
        half_hi = wp.atan(t[1])
    else:  # the ellipse reaches behind the pole axis sideways
        return wp.vec4i(0, view.tiles_x, ty[0], count_y)
    azimuth = wp.atan2(m[1], m[0])
    lo = (azimuth + half_lo + pi) * columns
    hi = (azimuth + half_hi + pi) * columns
    w = wp.float64(view.width)
    if lo < wp.float64(0.0):
        lo += w
        hi += w
    tx = tile_span(lo, wp.min(hi, w), view.width)
    if hi <= w:
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], count_y)
    rest = tile_span(wp.float64(0.0), hi - w, view.width)
    if tx[1] < tx[0]:
        return wp.vec4i(rest[0], rest[1] - rest[0] + 1, ty[0], count_y)
    if rest[1] < rest[0]:
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], count_y)
    return wp.vec4i(tx[0], wp.min(view.tiles_x - tx[0] + rest[1] + 1, view.tiles_x), ty[0], count_y)


@wp.func
def whitened_frame(a: wp.vec3d):
    """Rotation whose first column points along ``a``.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
    """
    one = wp.float64(1.0)
    q = a * (one / wp.length(a))
    sign = one
    if q[2] < wp.float64(0.0):
        sign = -one
    f = -one / (sign + q[2])
    g = q[0] * q[1] * f
    return wp.mat33d(
        q[0], one + sign * q[0] * q[0] * f, g,
        q[1], sign * g, sign + q[1] * q[1] * f,
        q[2], -sign * q[0], -q[1],
    )  # fmt: skip


@cache
def rays_of(real: Any) -> Any:
    """The struct of a view's rays. Those of a pixel point along (across, along, down), in the order of the forms."""
    lanes = lanes_of(real)

    @wp.struct
    class Rays:
        across: wp.array(dtype=lanes)  # per column of blocks: camera x of a photo, cos(azimuth) of a panorama
        along: wp.array(dtype=lanes)  # per column of blocks: one (camera z), sin(azimuth)
        down: wp.array(dtype=lanes)  # per row of blocks: camera y, cot(zenith)
        # What each of a tile's blocks spans, as middle and half width.
        columns: wp.array(dtype=lanes, ndim=2)  # per column of tiles: across, its half, along, its half
        rows: wp.array(dtype=lanes, ndim=2)  # per row of tiles: down, its half

    return Rays


@cache
def build(real: Any) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    lanes = lanes_of(real)
    coefficients = wp.types.vector(ROW, real)
    Rays = rays_of(real)
    of = lane_functions(real)
    above, lower, higher, positive_bits = of.above, of.lower, of.higher, of.positive_bits
    total = wp.types.vector(GRADIENTS, wp.float64)
    unbounded = 1.0e30 if real is wp.float32 else 1.0e250
    faintest = 80.0 if real is wp.float32 else 1.0e250  # what `response` is made for: exp(-40)

    @wp.func
    def double3(v: vec3):
        return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))

    @wp.func
    def double_rotation(q: vec4):
        return rotation_matrix(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3]))

    @wp.kernel(module="unique", enable_backward=False)
    def project(
        offset: int,
        means: wp.array(dtype=vec3),
        quaternions: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real),
        view: View,
        rules: Rules,
        span: wp.array(dtype=wp.vec4i),
        count: wp.array(dtype=int),
        distance: wp.array(dtype=float),
        rows: wp.array(dtype=coefficients),
        centres: wp.array(dtype=vec3),
    ):
        """Per Gaussian and view: the covered tiles, the range that orders blending, and, where it is seen, the row of
        coefficients and where the ray to the mean points (0 if nowhere)."""
        i = offset + wp.tid()
        m = double3(means[i]) - view.origin
        range_ = wp.length(m)
        opacity = wp.float64(opacities[i])
        count[i] = 0
        distance[i] = float(range_)
        if opacity < rules.alpha_min or opacity <= wp.float64(0.0) or range_ < wp.float64(1.0e-12):
            return
        s = double3(scales[i])
        cut = wp.float64(2.0) * wp.log(opacity / rules.alpha_min)
        r = double_rotation(quaternions[i])
        if view.kind == wp.static(PINHOLE):
            r = view.rotation * r
            m = view.rotation * m
        smin = wp.min(s[0], wp.min(s[1], s[2]))
        scaling = wp.vec3d(smin / s[0], smin / s[1], smin / s[2])
        a = wp.cw_mul(scaling, wp.transpose(r) * m)  # |M m| times the smallest scale
        length = wp.length(a)
        steepness = length / smin
        radius = wp.sqrt(cut)
        tiles = covered_tiles(
            view,
            m,
            range_,
            r * wp.diag(radius * s),
            radius * wp.max(s[0], wp.max(s[1], s[2])),
            steepness * steepness <= cut,
        )
        if tiles[1] * tiles[3] == 0:
            return
        span[i] = tiles
        count[i] = tiles[1] * tiles[3]
        steep = wp.min(steepness, wp.float64(wp.static(STEEPEST)))
        forms = r * (wp.diag(scaling) * whitened_frame(a))
        centre = vec3()
        if view.kind == wp.static(PINHOLE):
            if m[2] > wp.float64(1.0e-6) * range_:
                centre = vec3(real(m[0] / m[2]), real(1.0), real(m[1] / m[2]))
        else:
            axis_distance = wp.sqrt(m[0] * m[0] + m[1] * m[1])
            if axis_distance > wp.float64(1.0e-6) * range_:
                m = m / axis_distance
                centre = vec3(real(m[0]), real(m[1]), real(m[2]))
        centres[i] = centre
        row = coefficients()
        for k in range(3):
            axis = k
            if view.kind == wp.static(PINHOLE) and k > 0:
                axis = 3 - k
            row[wp.static(G0) + k] = real(forms[axis, 0])
            row[wp.static(G1) + k] = real(forms[axis, 1] * steep)
            row[wp.static(G2) + k] = real(forms[axis, 2] * steep)
        flat = wp.float64(1.0) / steep
        row[wp.static(FLAT)] = real(flat * flat)
        row[wp.static(CUT)] = real(wp.min(cut, wp.float64(wp.static(faintest))))
        row[wp.static(OPACITY)] = real(opacity)
        row[wp.static(REACH)] = real(length)
        row[wp.static(LIFT)] = real(smin * steep / opacity)
        row[wp.static(TILT)] = real(-smin * flat / opacity)
        rows[i] = row

    @wp.func
    def magnitude(x: lanes):
        return wp.max(x, -x)

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def block_masks(
        offset: int,
        rows: wp.array(dtype=coefficients),
        centres: wp.array(dtype=vec3),
        whose: wp.array(dtype=int),
        slots: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        rays: Rays,
        tiles_x: int,
        ids: wp.array(dtype=int),
        masks: wp.array(dtype=int),
        counts: wp.array(dtype=lanes),
    ):
        """Whose each entry is, which blocks of its tile it can reach, a bit each, and how many entries each block gets.

        A ray counts where ``f(d) = cut |g|^2 - g1^2 - g2^2`` and ``g0`` are positive. ``f`` is quadratic in ``d`` and
        exceeds its tangent plane by no more than ``cut g0(change of d)^2``: hence a bound on the box round the block.
        """
        tile = offset + wp.tid()
        x = tile % tiles_x
        y = tile / tiles_x
        u = rays.columns[x, 0]
        hu = rays.columns[x, 1]
        w = rays.columns[x, 2]
        hw = rays.columns[x, 3]
        v = rays.rows[y, 0]
        hv = rays.rows[y, 1]
        count = lanes()
        for j in range(starts[tile], starts[tile + 1]):
            k = whose[slots[j]]
            ids[j] = k
            row = rows[k]
            # The point of the block's box that is nearest to the mean, and where the box ends beside it.
            centre = centres[k]
            pu = lower(higher(lanes(centre[0]), u - hu), u + hu)
            pw = lower(higher(lanes(centre[1]), w - hw), w + hw)
            pv = lower(higher(lanes(centre[2]), v - hv), v + hv)
            du = u - pu
            dw = w - pw
            dv = v - pv
            g0 = row[G0] * pu + row[G0 + 1] * pw + row[G0 + 2] * pv
            g1 = row[G1] * pu + row[G1 + 1] * pw + row[G1 + 2] * pv
            g2 = row[G2] * pu + row[G2 + 1] * pw + row[G2 + 2] * pv
            outside = real(1.0) - row[CUT] * row[FLAT]
            s0 = row[CUT] * g0
            s1 = outside * g1
            s2 = outside * g2
            f = wp.cw_mul(s0, g0) - wp.cw_mul(s1, g1) - wp.cw_mul(s2, g2)
            su = row[G0] * s0 - row[G1] * s1 - row[G2] * s2
            sw = row[G0 + 1] * s0 - row[G1 + 1] * s1 - row[G2 + 1] * s2
            sv = row[G0 + 2] * s0 - row[G1 + 2] * s1 - row[G2 + 2] * s2
            slope = wp.cw_mul(su, du) + wp.cw_mul(sw, dw) + wp.cw_mul(sv, dv)
            slope += (
                wp.cw_mul(magnitude(su), hu) + wp.cw_mul(magnitude(sw), hw) + wp.cw_mul(magnitude(sv), hv)
            )
            change = real(2.0) * (wp.abs(row[G0]) * hu + wp.abs(row[G0 + 1]) * hw + wp.abs(row[G0 + 2]) * hv)
            bound = f + real(2.0) * slope + row[CUT] * wp.cw_mul(change, change)
            # From inside the ellipsoid every ray ahead counts.
            bound += lanes(wp.where(outside > real(0.0), real(0.0), real(wp.static(unbounded))))
            reached = lower(bound, g0 + change)
            count += above(reached, lanes(), lanes(real(1.0)), lanes())
            masks[j] = positive_bits(reached)
        counts[tile] = count

    @wp.kernel(module="unique", enable_backward=False)
    def chain(
        offset: int,
        means: wp.array(dtype=vec3),
        quaternions: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real),
        view: View,
        first: int,
        begins: wp.array(dtype=int),
        count: wp.array(dtype=int),
        sums: wp.array(dtype=coefficients),
        means_grad: wp.array(dtype=vec3),
        quaternions_grad: wp.array(dtype=vec4),
        scales_grad: wp.array(dtype=vec3),
        opacities_grad: wp.array(dtype=real),
        features_grad: wp.array(dtype=real, ndim=2),
        seen: wp.array(dtype=real),
    ):
        """Sum over tiles and add the gradients of mean, quaternion, scale, opacity and features.

        A Gaussian's sums follow one another from ``begins``; without ``begins`` it has one.
        With Y1 and Y2 turned back to the Gaussian's axes: dL/dmean = -2 M^T Y1, dL/ds_i = -2 Y2_ii / s_i,
        dL/dw_3 = 2 Y2_12 (s_2/s_1 - s_1/s_2) and cyclic for a local rotation w, and a quaternion turns by q (0, w/2).
        """
        i = offset + wp.tid()
        if count[i] == 0:
            return
        y = total()
        begin = i
        end = i + 1
        if begins.shape[0] > 0:
            begin = begins[i]
            end = begin + count[i]
        for entry in range(begin, end):
            row = sums[entry]
            for k in range(wp.static(GRADIENTS)):
                y[k] += wp.float64(row[k])
        if first == 0:
            seen[i] = real(y[14])
        if y[14] == wp.float64(0.0):  # hidden behind others: no gradient
            return
        two = wp.float64(2.0)
        q = quaternions[i]
        qw = wp.float64(q[0])
        qx = wp.float64(q[1])
        qy = wp.float64(q[2])
        qz = wp.float64(q[3])
        r = rotation_matrix(qw, qx, qy, qz)
        s = double3(scales[i])
        t = wp.cw_div(wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(1.0)), s)
        smin = wp.min(s[0], wp.min(s[1], s[2]))
        m = double3(means[i]) - view.origin
        a = wp.cw_mul(smin * t, wp.transpose(r) * m)
        steep = wp.min(wp.length(a) / smin, wp.float64(wp.static(STEEPEST)))
        frame = whitened_frame(a)
        flat = wp.float64(-1.0) / steep
        factor = wp.float64(-0.5) * wp.float64(opacities[i])
        for k in range(9):
            y[k] = factor * y[k]
        for k in range(3, 6):
            y[k] = flat * y[k]
        y[3] = flat * y[3]
        y1 = frame * wp.vec3d(flat * (y[0] - y[8]), y[1], y[2])
        y22 = y[0] - y[3] - y[6]  # the trace is the sum of dL/dq times q
        y2 = frame * wp.mat33d(y[3], y[4], y[5], y[4], y[6], y[7], y[5], y[7], y22) * wp.transpose(frame)
        dm = r * wp.cw_mul(y1, t)
        means_grad[i] = means_grad[i] - vec3(real(two * dm[0]), real(two * dm[1]), real(two * dm[2]))
        scales_grad[i] = scales_grad[i] - vec3(
            real(two * y2[0, 0] * t[0]), real(two * y2[1, 1] * t[1]), real(two * y2[2, 2] * t[2])
        )
        wx = two * y2[1, 2] * (s[2] * t[1] - s[1] * t[2])
        wy = -two * y2[0, 2] * (s[2] * t[0] - s[0] * t[2])
        wz = two * y2[0, 1] * (s[1] * t[0] - s[0] * t[1])
        f = two / (qw * qw + qx * qx + qy * qy + qz * qz)
        quaternions_grad[i] = quaternions_grad[i] + vec4(
            real(f * (-qx * wx - qy * wy - qz * wz)),
            real(f * (qw * wx + qy * wz - qz * wy)),
            real(f * (qw * wy + qz * wx - qx * wz)),
            real(f * (qw * wz + qx * wy - qy * wx)),
        )
        opacities_grad[i] = opacities_grad[i] + real(y[9])
        for k in range(wp.static(CHANNELS)):
            if first + k < features_grad.shape[1]:
                features_grad[i, first + k] = features_grad[i, first + k] + real(y[10 + k])

    return SimpleNamespace(
        block_masks=block_masks,
        chain=chain,
        project=project,
    )
