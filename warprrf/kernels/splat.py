"""Gaussian splatting with the exact response on the ray: project, bin to tiles, blend, and the hand-written adjoint.

All rays of a view start at one point. For a Gaussian with whitening matrix ``M = diag(1/s) R^T`` and mean ``m`` seen
from the ray origin, let ``mh = m/|m|``, ``e1, e2`` perpendicular to it, ``a = M mh``, ``b1 = M e1``, ``b2 = M e2``. A ray
``d = w mh + u1 e1 + u2 e2`` has ``g = M d = w a + u1 b1 + u2 b2``; its squared Mahalanobis distance is

    q = |m|^2 u^T A u / |g|^2,   A the Gram matrix of (b1 x a, b2 x a),

the response ``exp(-q/2)``, the peak at range ``t = |m| (a.g)/|g|^2``, visible where ``a.g > 0``. This is exact for every
direction, with no projection to differentiate; projection serves binning only.

Adjoint: with ``y = M (t d - m)`` (so that ``q = |y|^2``) the envelope theorem gives ``dq = 2 y.(dM r - M dmean)``,
``r = M^-1 y``, and ``dt = -(g.do + (y + t g).dg)/|g|^2``. Both are symmetric in whitened coordinates: every pair adds
to a 3-vector ``Y1`` and a symmetric 3x3 ``Y2`` per Gaussian, which :func:`chain` turns into gradients of mean,
quaternion and scale.

A thread blends a strip of 16 pixels of one row; the strip is one Warp vector, which a CPU executes with wide registers.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

TILE = 16  # pixels: tiles are TILE x TILE, strips 1 x TILE
STRIP = 16
CHANNELS = 4  # feature channels blended by one launch
ROW = 34  # numbers per Gaussian and view: see `project`
GRADIENTS = 16  # numbers per Gaussian that `blend_adjoint` sums: Y1 3, Y2 6, opacity 1, features 4, image-plane 1, spare 1
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
    extent = radius * wp.sqrt(wp.max(wp.max(cov[0, 0] + cov[1, 1] + cov[2, 2], wp.float64(0.0)), wp.float64(1.0e-300)))
    distance = wp.length(m)
    everything = wp.vec4i(0, view.tiles_x, 0, view.tiles_y)
    nothing = wp.vec4i(0, 0, 0, 0)
    rows = wp.vec2d(wp.float64(-1.0), wp.float64(view.height + 1))
    if inside:
        return everything, rows
    cap = wp.float64(3.141592653589793)  # a long ellipsoid close by reaches more than 90 degrees from its mean
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
        if wp.acos(wp.clamp(local[2] / distance, wp.float64(-1.0), wp.float64(1.0))) > cap + wp.atan(wp.length(corner)):
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
    """Functions and kernels for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    strip = wp.types.vector(STRIP, real)
    total = wp.types.vector(GRADIENTS, wp.float64)
    big = 1.0e30 if real is wp.float32 else 1.0e250
    tiny = 1.0e-30 if real is wp.float32 else 1.0e-250

    @wp.func
    def step(x: strip):
        """1 where x > 0, else 0 (NaN-free arithmetic select)."""
        return wp.min(wp.max(x * real(wp.static(big)), strip()), strip(real(1.0)))

    if real is wp.float32:

        @wp.func
        def negative_exponential(h: strip):
            """exp(-h) for h >= 0: (Taylor of exp(-h/16), degree 6)^16; absolute error below 5e-7."""
            one = strip(real(1.0))
            x = wp.min(h, strip(real(80.0))) * real(-0.0625)
            p = one + x * real(0.16666666666666666)
            p = one + wp.cw_mul(x, p) * real(0.2)
            p = one + wp.cw_mul(x, p) * real(0.25)
            p = one + wp.cw_mul(x, p) * real(0.3333333333333333)
            p = one + wp.cw_mul(x, p) * real(0.5)
            p = wp.max(one + wp.cw_mul(x, p), strip())
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            return wp.cw_mul(p, p)

    else:

        @wp.func
        def negative_exponential(h: strip):
            out = strip()
            for k in range(wp.static(STRIP)):
                out[k] = wp.exp(-h[k])
            return out

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
        """Per Gaussian and view: the row of coefficients, the covered tiles, the range that orders blending.

        Row: e1 3, e2 3, mh 3, A 3 (times |m|^2), a.a, a.b1, a.b2, b1.b1, b1.b2, b2.b2, |m|, opacity, q at the cutoff,
        a 3, b1 3, b2 3 (scaled by the smallest scale), 1/s_min, s_min, first and last row of pixels.
        """
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
            rows[i, k] = real(e1[k])
            rows[i, 3 + k] = real(e2[k])
            rows[i, 6 + k] = real(mh[k])
            rows[i, 21 + k] = real(a[k])
            rows[i, 24 + k] = real(b1[k])
            rows[i, 27 + k] = real(b2[k])
        rows[i, 9] = real(wp.dot(c1, c1) * gain)
        rows[i, 10] = real(wp.dot(c1, c2) * gain)
        rows[i, 11] = real(wp.dot(c2, c2) * gain)
        rows[i, 12] = real(wp.dot(a, a))
        rows[i, 13] = real(wp.dot(a, b1))
        rows[i, 14] = real(wp.dot(a, b2))
        rows[i, 15] = real(wp.dot(b1, b1))
        rows[i, 16] = real(wp.dot(b1, b2))
        rows[i, 17] = real(wp.dot(b2, b2))
        rows[i, 18] = real(range_)
        rows[i, 19] = real(opacity)
        rows[i, 20] = real(cut)
        rows[i, 30] = real(wp.float64(1.0) / smin)
        rows[i, 31] = real(smin)
        rows[i, 32] = real(pixel_rows[0] - wp.float64(0.51))
        rows[i, 33] = real(pixel_rows[1] - wp.float64(0.49))

    @wp.func
    def local_ray(rows: wp.array(dtype=real, ndim=2), k: int, dx: strip, dy: strip, dz: strip):
        """Components (w, u1, u2) of the strip's rays in the Gaussian's frame."""
        u1 = rows[k, 0] * dx + rows[k, 1] * dy + rows[k, 2] * dz
        u2 = rows[k, 3] * dx + rows[k, 4] * dy + rows[k, 5] * dz
        w = rows[k, 6] * dx + rows[k, 7] * dy + rows[k, 8] * dz
        return w, u1, u2

    @wp.func
    def quadratics(rows: wp.array(dtype=real, ndim=2), k: int, w: strip, u1: strip, u2: strip):
        """Numerator of q, a.g and |g|^2."""
        n = wp.cw_mul(u1, rows[k, 9] * u1 + (real(2.0) * rows[k, 10]) * u2) + rows[k, 11] * wp.cw_mul(u2, u2)
        p = rows[k, 13] * u1 + rows[k, 14] * u2
        ag = rows[k, 12] * w + p
        h1 = rows[k, 13] * w + rows[k, 15] * u1 + rows[k, 16] * u2
        h2 = rows[k, 14] * w + rows[k, 16] * u1 + rows[k, 17] * u2
        side = wp.cw_mul(u1, h1) + wp.cw_mul(u2, h2)
        gg = wp.max(wp.cw_mul(w, ag) + side, strip(real(wp.static(tiny))))
        return n, ag, gg, side

    @wp.func
    def strip_directions(view: View, x0: int, y: int):
        dx = strip()
        dy = strip()
        dz = strip()
        for k in range(wp.static(STRIP)):
            d = pixel_direction(view, x0 + k, y)
            dx[k] = real(d[0])
            dy[k] = real(d[1])
            dz[k] = real(d[2])
        return dx, dy, dz

    @wp.func
    def thinned(transmittance: strip, alpha: strip, rule: int):
        if rule == wp.static(PRODUCT):
            return wp.cw_mul(transmittance, strip(real(1.0)) - alpha)
        return wp.cw_mul(transmittance, negative_exponential(alpha))

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        offset: int,
        rows: wp.array(dtype=real, ndim=2),
        features: wp.array(dtype=real, ndim=2),
        first: int,
        background: wp.array(dtype=real),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        image: wp.array(dtype=real, ndim=3),
        alpha_out: wp.array(dtype=real, ndim=2),
        depth_out: wp.array(dtype=real, ndim=2),
        transmittance_out: wp.array(dtype=real, ndim=2),
        dominant_out: wp.array(dtype=int, ndim=2),
        peak_out: wp.array(dtype=real, ndim=2),
    ):
        """Blend channels ``first .. first + 3`` front to back. ``depth_out`` holds the sum of weight times t."""
        i = offset + wp.tid()
        tile = i / wp.static(TILE)
        x0 = (tile % view.tiles_x) * wp.static(TILE)
        y = (tile / view.tiles_x) * wp.static(TILE) + i % wp.static(TILE)
        if y >= view.height:
            return
        row = real(y)
        dx, dy, dz = strip_directions(view, x0, y)
        channels = wp.min(features.shape[1] - first, wp.static(CHANNELS))
        one = strip(real(1.0))
        amax = strip(real(rules.alpha_max))
        tmin = strip(real(rules.transmittance_min))
        transmittance = strip(real(1.0))
        c0 = strip()
        c1 = strip()
        c2 = strip()
        c3 = strip()
        depth = strip()
        total = strip()
        best = strip()
        owner = strip(real(-1.0))
        peak = strip()
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            if row >= rows[k, 32] and row <= rows[k, 33]:
                w, u1, u2 = local_ray(rows, k, dx, dy, dz)
                n, ag, gg, side = quadratics(rows, k, w, u1, u2)
                q = wp.cw_div(n, gg)
                room = strip(rows[k, 20]) - q
                if wp.max(room) > real(0.0):
                    keep = wp.cw_mul(wp.cw_mul(step(room), step(ag)), step(transmittance - tmin))
                    alpha = wp.min(rows[k, 19] * negative_exponential(real(0.5) * q), amax)
                    alpha = wp.cw_mul(alpha, keep)
                    weight = wp.cw_mul(alpha, transmittance)
                    transmittance = thinned(transmittance, alpha, rules.rule)
                    t = rows[k, 18] * wp.cw_div(ag, gg)
                    depth += wp.cw_mul(weight, t)
                    total += weight
                    better = step(weight - best)
                    best = wp.max(best, weight)
                    owner += wp.cw_mul(better, strip(real(k)) - owner)
                    peak += wp.cw_mul(better, t - peak)
                    c0 += features[k, first] * weight
                    if channels > 1:
                        c1 += features[k, first + 1] * weight
                    if channels > 2:
                        c2 += features[k, first + 2] * weight
                    if channels > 3:
                        c3 += features[k, first + 3] * weight
                    if wp.max(transmittance) <= real(rules.transmittance_min):
                        break
        c0 += background[first] * transmittance
        if channels > 1:
            c1 += background[first + 1] * transmittance
        if channels > 2:
            c2 += background[first + 2] * transmittance
        if channels > 3:
            c3 += background[first + 3] * transmittance
        for lane in range(wp.static(STRIP)):
            x = x0 + lane
            if x < view.width:
                image[y, x, first] = c0[lane]
                if channels > 1:
                    image[y, x, first + 1] = c1[lane]
                if channels > 2:
                    image[y, x, first + 2] = c2[lane]
                if channels > 3:
                    image[y, x, first + 3] = c3[lane]
                if first == 0:
                    alpha_out[y, x] = total[lane]
                    depth_out[y, x] = depth[lane]
                    transmittance_out[y, x] = transmittance[lane]
                    dominant_out[y, x] = int(owner[lane])
                    peak_out[y, x] = peak[lane]

    @wp.kernel(module="unique", enable_backward=False)
    def blend_adjoint(
        offset: int,
        strips: int,
        pieces: int,
        rows: wp.array(dtype=real, ndim=2),
        features: wp.array(dtype=real, ndim=2),
        first: int,
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        image: wp.array(dtype=real, ndim=3),
        total: wp.array(dtype=real, ndim=2),
        depth_sum: wp.array(dtype=real, ndim=2),
        image_grad: wp.array(dtype=real, ndim=3),
        alpha_grad: wp.array(dtype=real, ndim=2),
        depth_grad: wp.array(dtype=real, ndim=2),
        sums: wp.array(dtype=real, ndim=3),
    ):
        """Same walk as `blend`; adds each pair's gradient to ``sums[piece, Gaussian]``.

        dL/da_i = T_i x_i - (R - sum_{j<=i} w_j x_j) / (1 - a_i), x the gradient dotted with the pair's features, R the
        same dotted with the finished pixel; without the division for the exponential rule.
        """
        i = offset + wp.tid()
        piece = ((i + 1) * pieces - 1) / strips
        tile = i / wp.static(TILE)
        x0 = (tile % view.tiles_x) * wp.static(TILE)
        y = (tile / view.tiles_x) * wp.static(TILE) + i % wp.static(TILE)
        if y >= view.height or starts[tile] == starts[tile + 1]:
            return
        channels = wp.min(features.shape[1] - first, wp.static(CHANNELS))
        v0 = strip()
        v1 = strip()
        v2 = strip()
        v3 = strip()
        vt = strip()
        va = strip()
        goal = strip()
        for lane in range(wp.static(STRIP)):
            x = x0 + lane
            if x < view.width:
                v0[lane] = image_grad[y, x, first]
                r = v0[lane] * image[y, x, first]
                if channels > 1:
                    v1[lane] = image_grad[y, x, first + 1]
                    r += v1[lane] * image[y, x, first + 1]
                if channels > 2:
                    v2[lane] = image_grad[y, x, first + 2]
                    r += v2[lane] * image[y, x, first + 2]
                if channels > 3:
                    v3[lane] = image_grad[y, x, first + 3]
                    r += v3[lane] * image[y, x, first + 3]
                if first == 0:
                    a = total[y, x]
                    if a > real(0.0):
                        vt[lane] = depth_grad[y, x] / a
                        va[lane] = alpha_grad[y, x] - depth_grad[y, x] * depth_sum[y, x] / (a * a)
                        r += vt[lane] * depth_sum[y, x] + va[lane] * a
                goal[lane] = r
        with_depth = wp.dot(vt, vt) > real(0.0)
        row = real(y)
        dx, dy, dz = strip_directions(view, x0, y)
        one = strip(real(1.0))
        amax = strip(real(rules.alpha_max))
        tmin = strip(real(rules.transmittance_min))
        transmittance = strip(real(1.0))
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            if row >= rows[k, 32] and row <= rows[k, 33]:
                w, u1, u2 = local_ray(rows, k, dx, dy, dz)
                n, ag, gg, side = quadratics(rows, k, w, u1, u2)
                q = wp.cw_div(n, gg)
                room = strip(rows[k, 20]) - q
                if wp.max(room) > real(0.0):
                    keep = wp.cw_mul(wp.cw_mul(step(room), step(ag)), step(transmittance - tmin))
                    response = wp.cw_mul(negative_exponential(real(0.5) * q), keep)
                    raw = rows[k, 19] * response
                    alpha = wp.min(raw, amax)
                    free = one - step(raw - amax)
                    weight = wp.cw_mul(alpha, transmittance)
                    t = rows[k, 18] * wp.cw_div(ag, gg)
                    value = features[k, first] * v0
                    if channels > 1:
                        value += features[k, first + 1] * v1
                    if channels > 2:
                        value += features[k, first + 2] * v2
                    if channels > 3:
                        value += features[k, first + 3] * v3
                    if first == 0:
                        value += wp.cw_mul(vt, t) + va
                    goal -= wp.cw_mul(weight, value)
                    behind = goal
                    if rules.rule == wp.static(PRODUCT):
                        behind = wp.cw_div(goal, wp.max(one - alpha, strip(real(wp.static(tiny)))))
                    slope = wp.cw_mul(wp.cw_mul(wp.cw_mul(transmittance, value) - behind, keep), free)
                    transmittance = thinned(transmittance, alpha, rules.rule)
                    v = real(-0.5) * wp.cw_mul(slope, raw)  # dL/dq
                    # y = M (t d - m) without cancellation: t w - |m| = -|m| side / gg
                    off = rows[k, 30] * wp.cw_div(strip(-rows[k, 18]), gg)
                    lift = wp.cw_mul(off, side)
                    s1 = rows[k, 30] * wp.cw_mul(t, u1)
                    s2 = rows[k, 30] * wp.cw_mul(t, u2)
                    y0 = rows[k, 21] * lift + rows[k, 24] * s1 + rows[k, 27] * s2
                    y1 = rows[k, 22] * lift + rows[k, 25] * s1 + rows[k, 28] * s2
                    y2 = rows[k, 23] * lift + rows[k, 26] * s1 + rows[k, 29] * s2
                    p0 = wp.cw_mul(v, y0)
                    p1 = wp.cw_mul(v, y1)
                    p2 = wp.cw_mul(v, y2)
                    s00 = wp.dot(p0, y0)
                    s01 = wp.dot(p0, y1)
                    s02 = wp.dot(p0, y2)
                    s11 = wp.dot(p1, y1)
                    s12 = wp.dot(p1, y2)
                    s22 = wp.dot(p2, y2)
                    if with_depth:
                        half = (real(0.5) * rows[k, 31]) * wp.cw_div(wp.cw_mul(weight, vt), gg)
                        h0 = wp.cw_mul(half, rows[k, 21] * w + rows[k, 24] * u1 + rows[k, 27] * u2)
                        h1 = wp.cw_mul(half, rows[k, 22] * w + rows[k, 25] * u1 + rows[k, 28] * u2)
                        h2 = wp.cw_mul(half, rows[k, 23] * w + rows[k, 26] * u1 + rows[k, 29] * u2)
                        p0 -= h0
                        p1 -= h1
                        p2 -= h2
                        s00 -= real(2.0) * wp.dot(h0, y0)
                        s01 -= wp.dot(h0, y1) + wp.dot(h1, y0)
                        s02 -= wp.dot(h0, y2) + wp.dot(h2, y0)
                        s11 -= real(2.0) * wp.dot(h1, y1)
                        s12 -= wp.dot(h1, y2) + wp.dot(h2, y1)
                        s22 -= real(2.0) * wp.dot(h2, y2)
                    wp.atomic_add(sums, piece, k, 0, wp.dot(p0, one))
                    wp.atomic_add(sums, piece, k, 1, wp.dot(p1, one))
                    wp.atomic_add(sums, piece, k, 2, wp.dot(p2, one))
                    wp.atomic_add(sums, piece, k, 3, s00)
                    wp.atomic_add(sums, piece, k, 4, s01)
                    wp.atomic_add(sums, piece, k, 5, s02)
                    wp.atomic_add(sums, piece, k, 6, s11)
                    wp.atomic_add(sums, piece, k, 7, s12)
                    wp.atomic_add(sums, piece, k, 8, s22)
                    wp.atomic_add(sums, piece, k, 9, wp.dot(slope, response))
                    wp.atomic_add(sums, piece, k, 10, wp.dot(weight, v0))
                    if channels > 1:
                        wp.atomic_add(sums, piece, k, 11, wp.dot(weight, v1))
                    if channels > 2:
                        wp.atomic_add(sums, piece, k, 12, wp.dot(weight, v2))
                    if channels > 3:
                        wp.atomic_add(sums, piece, k, 13, wp.dot(weight, v3))
                    if first == 0:
                        wp.atomic_add(sums, piece, k, 14, wp.dot(weight, one))
                    if wp.max(transmittance) <= real(rules.transmittance_min):
                        break

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

    @wp.kernel(module="unique", enable_backward=False)
    def strongest(
        offset: int,
        rows: wp.array(dtype=real, ndim=2),
        ids: wp.array(dtype=int),
        starts: wp.array(dtype=int),
        view: View,
        rules: Rules,
        index: wp.array(dtype=int, ndim=3),
        weight_out: wp.array(dtype=real, ndim=3),
        range_out: wp.array(dtype=real, ndim=3),
        total: wp.array(dtype=real, ndim=2),
    ):
        """The ``K`` largest blending weights of each pixel in front-to-back order, their Gaussians and peak ranges."""
        pixel = offset + wp.tid()
        x = pixel % view.width
        y = pixel / view.width
        tile = (y / wp.static(TILE)) * view.tiles_x + x / wp.static(TILE)
        d = pixel_direction(view, x, y)
        dx = real(d[0])
        dy = real(d[1])
        dz = real(d[2])
        transmittance = real(1.0)
        kept = int(0)
        smallest = real(0.0)
        at = int(0)
        capacity = index.shape[2]
        for j in range(starts[tile], starts[tile + 1]):
            k = ids[j]
            u1 = rows[k, 0] * dx + rows[k, 1] * dy + rows[k, 2] * dz
            u2 = rows[k, 3] * dx + rows[k, 4] * dy + rows[k, 5] * dz
            w = rows[k, 6] * dx + rows[k, 7] * dy + rows[k, 8] * dz
            n = u1 * (rows[k, 9] * u1 + real(2.0) * rows[k, 10] * u2) + rows[k, 11] * u2 * u2
            ag = rows[k, 12] * w + rows[k, 13] * u1 + rows[k, 14] * u2
            gg = w * ag + u1 * (rows[k, 13] * w + rows[k, 15] * u1 + rows[k, 16] * u2)
            gg = wp.max(gg + u2 * (rows[k, 14] * w + rows[k, 16] * u1 + rows[k, 17] * u2), real(wp.static(tiny)))
            if n < rows[k, 20] * gg and ag > real(0.0):
                alpha = wp.min(rows[k, 19] * wp.exp(real(-0.5) * n / gg), real(rules.alpha_max))
                weight = alpha * transmittance
                if rules.rule == wp.static(PRODUCT):
                    transmittance = transmittance * (real(1.0) - alpha)
                else:
                    transmittance = transmittance * wp.exp(-alpha)
                total[y, x] = total[y, x] + weight
                place = kept
                if kept == capacity:
                    place = -1
                    if weight > smallest:
                        for c in range(at, capacity - 1):  # close the gap: the order along the ray stays
                            index[y, x, c] = index[y, x, c + 1]
                            weight_out[y, x, c] = weight_out[y, x, c + 1]
                            range_out[y, x, c] = range_out[y, x, c + 1]
                        place = capacity - 1
                if place >= 0:
                    index[y, x, place] = k
                    weight_out[y, x, place] = weight
                    range_out[y, x, place] = rows[k, 18] * ag / gg
                    kept = wp.min(kept + 1, capacity)
                    if kept == capacity:
                        smallest = weight_out[y, x, 0]
                        at = int(0)
                        for c in range(1, capacity):
                            if weight_out[y, x, c] < smallest:
                                smallest = weight_out[y, x, c]
                                at = c
                if transmittance <= real(rules.transmittance_min):
                    break

    @wp.kernel(module="unique", enable_backward=False)
    def mean_depth(
        offset: int,
        depth_sum: wp.array(dtype=real, ndim=2),
        alpha: wp.array(dtype=real, ndim=2),
        depth: wp.array(dtype=real, ndim=2),
    ):
        """Blended mean range; 0 where nothing is seen, so that a loss on it stays finite."""
        pixel = offset + wp.tid()
        x = pixel % alpha.shape[1]
        y = pixel / alpha.shape[1]
        if alpha[y, x] > real(0.0):
            depth[y, x] = depth_sum[y, x] / alpha[y, x]

    @wp.kernel(module="unique", enable_backward=False)
    def background_adjoint(
        offset: int,
        transmittance: wp.array(dtype=real, ndim=2),
        image_grad: wp.array(dtype=real, ndim=3),
        background_grad: wp.array(dtype=real),
    ):
        """Gradient of one background channel: the transmittance left, summed over the image."""
        c = offset + wp.tid()
        total = wp.float64(0.0)
        for y in range(transmittance.shape[0]):
            for x in range(transmittance.shape[1]):
                total += wp.float64(transmittance[y, x]) * wp.float64(image_grad[y, x, c])
        background_grad[c] = background_grad[c] + real(total)

    return SimpleNamespace(
        mean_depth=mean_depth, background_adjoint=background_adjoint, project=project, blend=blend, blend_adjoint=blend_adjoint, chain=chain, strongest=strongest, real=real
    )
