"""Seen from one ray origin: a Gaussian's coefficients on every ray, the tiles that it covers, the order of blending.

All rays of a view start at one point. For a Gaussian with whitening matrix ``M = diag(1/s) R^T`` and mean ``m`` seen
from the ray origin, let ``mh = m/|m|``, ``e1, e2`` perpendicular to it, ``a = M mh``, ``b1 = M e1``,
``b2 = M e2``. A ray ``d = w mh + u1 e1 + u2 e2`` has ``g = M d = w a + u1 b1 + u2 b2``; its squared Mahalanobis
distance is

    q = |m|^2 (A1 u1^2 + A2 u2^2) / |g|^2,   A1 = |b1 x a|^2, A2 = |b2 x a|^2,

with ``e1, e2`` turned about ``mh`` until ``(b1 x a).(b2 x a) = 0``: a sum of squares loses no digits,
which needles need. The response is ``exp(-q/2)``,
the peak at range ``t = |m| (a.g)/|g|^2``, visible where ``a.g > 0``. This is exact for
every direction, with no projection to differentiate; projection serves binning only. Coefficients are computed in
float64.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

TILE = 16  # pixels: tiles are TILE x TILE, strips 1 x TILE
STRIP = 16
CHANNELS = 4  # feature channels blended by one launch
# What a row of coefficients holds, one row per Gaussian and view; M is scaled by the smallest scale throughout.
E1, E2, MH = 0, 3, 6  # the Gaussian's frame as seen from the ray origin
GRAM = 9  # |m|^2 A1, |m|^2 A2
AA, AB1, AB2, BB11, BB12, BB22 = 11, 12, 13, 14, 15, 16  # dot products of a, b1, b2
RANGE, OPACITY, CUT = 17, 18, 19  # |m| [m], opacity, q at which alpha falls below alpha_min
A, B1, B2 = 20, 23, 26
INVERSE, SMALLEST = 29, 30  # 1 / s_min, s_min [m]
FIRST_ROW, LAST_ROW = 31, 32  # of pixels
ROW = 33
GRADIENTS = (
    15  # numbers per Gaussian that `blend_adjoint` sums: Y1 3, Y2 6, opacity, features 4, blending weight
)
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
    """How alpha becomes an image: cutoff, clamp, early exit, transmittance rule."""

    alpha_min: wp.float64
    alpha_max: wp.float64
    transmittance_min: wp.float64
    rule: int


@wp.func
def pixel_direction(view: View, x: int, y: int):
    """Unit world direction of a pixel's centre."""
    u = wp.float64(x) + wp.float64(0.5)
    v = wp.float64(y) + wp.float64(0.5)
    if view.kind == wp.static(PINHOLE):
        local = wp.vec3d((u - view.cx) / view.fx, (v - view.cy) / view.fy, wp.float64(1.0))
        return wp.normalize(wp.transpose(view.rotation) * local)
    azimuth = wp.float64(6.283185307179586) * u / wp.float64(view.width) - wp.float64(3.141592653589793)
    zenith = wp.float64(3.141592653589793) * v / wp.float64(view.height)
    return wp.vec3d(wp.sin(zenith) * wp.cos(azimuth), wp.sin(zenith) * wp.sin(azimuth), wp.cos(zenith))


@wp.func
def rotation_matrix(w: wp.float64, x: wp.float64, y: wp.float64, z: wp.float64):
    """Rotation of the quaternion wxyz, normalised here."""
    n = wp.sqrt(w * w + x * x + y * y + z * z)
    w = w / n
    x = x / n
    y = y / n
    z = z / n
    one = wp.float64(1.0)
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
def covered_tiles(view: View, mean: wp.vec3d, m: wp.vec3d, cov: wp.mat33d, radius: wp.float64, inside: bool):
    """Tiles that the ellipsoid ``radius`` can touch (first column, columns, first row, rows; columns wrap on a sphere),
    and the lowest and highest row of pixels, in pixel coordinates.

    A plane through the ray origin with normal l touches the ellipsoid where l^T (r^2 cov - m m^T) l = 0.
    """
    r2 = radius * radius
    extent = radius * wp.sqrt(
        wp.max(wp.max(cov[0, 0] + cov[1, 1] + cov[2, 2], wp.float64(0.0)), wp.float64(1.0e-300))
    )
    distance = wp.length(m)
    everything = wp.vec4i(0, view.tiles_x, 0, view.tiles_y)
    nothing = wp.vec4i(0, 0, 0, 0)
    rows = wp.vec2d(wp.float64(-1.0), wp.float64(view.height + 1))
    if inside:
        return everything, rows
    cap = wp.float64(
        3.141592653589793
    )  # a long ellipsoid close by reaches more than 90 degrees from its mean
    if extent < distance:
        cap = wp.asin(extent / distance)
    if view.kind == wp.static(PINHOLE):
        local = view.rotation * m
        c = r2 * (view.rotation * cov * wp.transpose(view.rotation)) - wp.outer(local, local)
        if c[2, 2] < wp.float64(0.0):  # the ellipsoid lies on one side of the camera plane
            if local[2] <= wp.float64(0.0):
                return nothing, rows
            x = tangent_interval(c[0, 0], c[0, 2], c[2, 2])
            y = tangent_interval(c[1, 1], c[1, 2], c[2, 2])
            tx = tile_span(view.fx * x[0] + view.cx, view.fx * x[1] + view.cx, view.width)
            ty = tile_span(view.fy * y[0] + view.cy, view.fy * y[1] + view.cy, view.height)
            rows = wp.vec2d(view.fy * y[0] + view.cy, view.fy * y[1] + view.cy)
            return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], ty[1] - ty[0] + 1), rows
        corner = wp.vec2d(
            wp.max(view.cx, wp.float64(view.width) - view.cx) / view.fx,
            wp.max(view.cy, wp.float64(view.height) - view.cy) / view.fy,
        )
        if wp.acos(wp.clamp(local[2] / distance, wp.float64(-1.0), wp.float64(1.0))) > cap + wp.atan(
            wp.length(corner)
        ):
            return nothing, rows
        return everything, rows
    pi = wp.float64(3.141592653589793)
    per_radian = wp.float64(view.height) / pi
    columns = wp.float64(view.width) / (wp.float64(2.0) * pi)
    zenith = wp.acos(wp.clamp(m[2] / distance, wp.float64(-1.0), wp.float64(1.0)))
    rows = wp.vec2d((zenith - cap) * per_radian, (zenith + cap) * per_radian)
    ty = tile_span(rows[0], rows[1], view.height)
    count_y = ty[1] - ty[0] + 1
    # Silhouette seen along the pole axis: the same dual conic in the horizontal plane.
    c11 = r2 * cov[0, 0] - m[0] * m[0]
    c12 = r2 * cov[0, 1] - m[0] * m[1]
    c22 = r2 * cov[1, 1] - m[1] * m[1]
    determinant = c11 * c22 - c12 * c12
    if determinant >= wp.float64(0.0):  # the pole axis meets the ellipse: every azimuth
        return wp.vec4i(0, view.tiles_x, ty[0], count_y), rows
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
        return wp.vec4i(0, view.tiles_x, ty[0], count_y), rows
    azimuth = wp.atan2(m[1], m[0])
    lo = (azimuth + half_lo + pi) * columns
    hi = (azimuth + half_hi + pi) * columns
    w = wp.float64(view.width)
    if lo < wp.float64(0.0):
        lo += w
        hi += w
    tx = tile_span(lo, wp.min(hi, w), view.width)
    if hi <= w:
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], count_y), rows
    rest = tile_span(wp.float64(0.0), hi - w, view.width)
    if tx[1] < tx[0]:
        return wp.vec4i(rest[0], rest[1] - rest[0] + 1, ty[0], count_y), rows
    if rest[1] < rest[0]:
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], count_y), rows
    return wp.vec4i(tx[0], wp.min(view.tiles_x - tx[0] + rest[1] + 1, view.tiles_x), ty[0], count_y), rows


@wp.kernel(enable_backward=False)
def emit_tiles(
    offset: int,
    order: wp.array(dtype=int),
    span: wp.array(dtype=wp.vec4i),
    ends: wp.array(dtype=int),
    tiles_x: int,
    keys: wp.array(dtype=int),
    values: wp.array(dtype=int),
):
    """Write (tile, Gaussian) for every covered tile, Gaussians from near to far."""
    i = offset + wp.tid()
    k = order[i]
    s = span[k]
    at = int(0)
    if i > 0:
        at = ends[i - 1]
    for row in range(s[3]):
        for column in range(s[1]):
            keys[at] = (s[2] + row) * tiles_x + (s[0] + column) % tiles_x
            values[at] = k
            at += 1


@wp.kernel(enable_backward=False)
def tile_starts(offset: int, keys: wp.array(dtype=int), count: int, starts: wp.array(dtype=int)):
    """``starts[t]``: first entry of tile t in the sorted list, by bisection; ``starts[tiles]`` is the count."""
    tile = offset + wp.tid()
    lo = int(0)
    hi = count
    while lo < hi:
        middle = (lo + hi) / 2
        if keys[middle] < tile:
            lo = middle + 1
        else:
            hi = middle
    starts[tile] = lo


@cache
def build(real: Any) -> SimpleNamespace:
    """The kernels for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    total = wp.types.vector(GRADIENTS, wp.float64)
    # Stays finite where scales are near the smallest number: zero offset times infinity would be NaN.
    largest = 1.0e30 if real is wp.float32 else 1.0e250

    @wp.kernel(module="unique", enable_backward=False)
    def project(
        offset: int,
        means: wp.array(dtype=vec3),
        quaternions: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real),
        view: View,
        rules: Rules,
        rows: wp.array(dtype=real, ndim=2),
        span: wp.array(dtype=wp.vec4i),
        count: wp.array(dtype=int),
        distance: wp.array(dtype=float),
    ):
        """Per Gaussian and view: the row of coefficients, the covered tiles, the range that orders blending."""
        i = offset + wp.tid()
        zero = wp.float64(0.0)
        mean = wp.vec3d(wp.float64(means[i][0]), wp.float64(means[i][1]), wp.float64(means[i][2]))
        s = wp.vec3d(wp.float64(scales[i][0]), wp.float64(scales[i][1]), wp.float64(scales[i][2]))
        q = quaternions[i]
        r = rotation_matrix(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3]))
        m = mean - view.origin
        range_ = wp.length(m)
        opacity = wp.float64(opacities[i])
        count[i] = 0
        span[i] = wp.vec4i(0, 0, 0, 0)
        distance[i] = float(range_)
        if opacity < rules.alpha_min or opacity <= zero or range_ < wp.float64(1.0e-12):
            return
        cut = wp.float64(2.0) * wp.log(opacity / rules.alpha_min)
        smin = wp.min(s[0], wp.min(s[1], s[2]))
        rt = wp.transpose(r)
        scaling = wp.vec3d(smin / s[0], smin / s[1], smin / s[2])
        mh = m / range_
        # Orthonormal pair: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017.
        sign = wp.float64(1.0)
        if mh[2] < zero:
            sign = wp.float64(-1.0)
        f = wp.float64(-1.0) / (sign + mh[2])
        g = mh[0] * mh[1] * f
        e1 = wp.vec3d(wp.float64(1.0) + sign * mh[0] * mh[0] * f, sign * g, -sign * mh[0])
        e2 = wp.vec3d(g, sign + mh[1] * mh[1] * f, -mh[1])
        a = wp.cw_mul(scaling, rt * mh)
        b1 = wp.cw_mul(scaling, rt * e1)
        b2 = wp.cw_mul(scaling, rt * e2)
        c1 = wp.cross(b1, a)
        c2 = wp.cross(b2, a)
        turn = wp.float64(0.5) * wp.atan2(wp.float64(2.0) * wp.dot(c1, c2), wp.dot(c1, c1) - wp.dot(c2, c2))
        cosine = wp.cos(turn)
        sine = wp.sin(turn)
        f1 = cosine * e1 + sine * e2
        e2 = cosine * e2 - sine * e1
        e1 = f1
        b1 = wp.cw_mul(scaling, rt * e1)
        b2 = wp.cw_mul(scaling, rt * e2)
        c1 = wp.cross(b1, a)
        c2 = wp.cross(b2, a)
        gain = (range_ / smin) * (range_ / smin)
        inside = wp.dot(a, a) * gain <= cut
        cov = wp.mat33d()
        for k in range(3):
            axis = wp.vec3d(r[0, k], r[1, k], r[2, k]) * s[k]
            cov += wp.outer(axis, axis)
        tiles, pixel_rows = covered_tiles(view, mean, m, cov, wp.sqrt(cut), inside)
        span[i] = tiles
        count[i] = tiles[1] * tiles[3]
        for k in range(3):
            rows[i, E1 + k] = real(e1[k])
            rows[i, E2 + k] = real(e2[k])
            rows[i, MH + k] = real(mh[k])
            rows[i, A + k] = real(a[k])
            rows[i, B1 + k] = real(b1[k])
            rows[i, B2 + k] = real(b2[k])
        rows[i, GRAM] = real(wp.min(wp.dot(c1, c1) * gain, wp.float64(wp.static(largest))))
        rows[i, GRAM + 1] = real(wp.min(wp.dot(c2, c2) * gain, wp.float64(wp.static(largest))))
        rows[i, AA] = real(wp.dot(a, a))
        rows[i, AB1] = real(wp.dot(a, b1))
        rows[i, AB2] = real(wp.dot(a, b2))
        rows[i, BB11] = real(wp.dot(b1, b1))
        rows[i, BB12] = real(wp.dot(b1, b2))
        rows[i, BB22] = real(wp.dot(b2, b2))
        rows[i, RANGE] = real(range_)
        rows[i, OPACITY] = real(opacity)
        rows[i, CUT] = real(cut)
        rows[i, INVERSE] = real(wp.float64(1.0) / smin)
        rows[i, SMALLEST] = real(smin)
        rows[i, FIRST_ROW] = real(pixel_rows[0] - wp.float64(0.51))
        rows[i, LAST_ROW] = real(pixel_rows[1] - wp.float64(0.49))

    @wp.kernel(module="unique", enable_backward=False)
    def chain(
        offset: int,
        quaternions: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        count: wp.array(dtype=int),
        first: int,
        sums: wp.array(dtype=real, ndim=3),
        means_grad: wp.array(dtype=vec3),
        quaternions_grad: wp.array(dtype=vec4),
        scales_grad: wp.array(dtype=vec3),
        opacities_grad: wp.array(dtype=real),
        features_grad: wp.array(dtype=real, ndim=2),
        seen: wp.array(dtype=real),
    ):
        """Sum the pieces and add the gradients of mean, quaternion, scale, opacity and features.

        dL/dmean = -2 M^T Y1, dL/ds_i = -2 Y2_ii / s_i, dL/dw_3 = 2 Y2_12 (s_2/s_1 - s_1/s_2) and cyclic for a local
        rotation w, and a quaternion turns by q (0, w/2).
        """
        i = offset + wp.tid()
        if count[i] == 0:
            return
        y = total()
        for p in range(sums.shape[0]):
            for k in range(wp.static(GRADIENTS)):
                y[k] += wp.float64(sums[p, i, k])
        two = wp.float64(2.0)
        q = quaternions[i]
        qw = wp.float64(q[0])
        qx = wp.float64(q[1])
        qy = wp.float64(q[2])
        qz = wp.float64(q[3])
        r = rotation_matrix(qw, qx, qy, qz)
        s0 = wp.float64(scales[i][0])
        s1 = wp.float64(scales[i][1])
        s2 = wp.float64(scales[i][2])
        dm = r * wp.vec3d(y[0] / s0, y[1] / s1, y[2] / s2)
        means_grad[i] = means_grad[i] - vec3(real(two * dm[0]), real(two * dm[1]), real(two * dm[2]))
        scales_grad[i] = scales_grad[i] - vec3(
            real(two * y[3] / s0), real(two * y[6] / s1), real(two * y[8] / s2)
        )
        wx = two * y[7] * (s2 / s1 - s1 / s2)
        wy = -two * y[5] * (s2 / s0 - s0 / s2)
        wz = two * y[4] * (s1 / s0 - s0 / s1)
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
        if first == 0:
            seen[i] = real(y[14])

    return SimpleNamespace(project=project, chain=chain)
