"""Gaussians as one ray origin sees them: a splat's coefficients on every ray, and its gradients' way back.

For a Gaussian with whitening matrix ``M = diag(1/s) R^T`` and mean ``m`` seen from the ray origin, turn the whitened
space so that its first axis points at the mean: ``q0 = M m/|M m|``, ``q1, q2`` perpendicular to it. A ray ``d`` has
``g_i = q_i . M d``, three linear forms; its squared Mahalanobis distance is

    q = |M m|^2 (g1^2 + g2^2) / |g|^2,

the response ``exp(-q/2)``, the peak at range ``t = |M m| g0/|g|^2``, visible where ``g0 > 0``. This is exact for every
direction, with no projection to differentiate, and a sum of squares of linear forms loses no digits, which needles
need. Projection serves binning only. Coefficients are computed in float64.

Adjoint: with ``y = M (t d - m)`` (so that ``q = |y|^2``) the envelope theorem gives ``dq = 2 y.(dM r - M dmean)``,
``r = M^-1 y``, and ``dt = -(g.do + (y + t g).dg)/|g|^2``. Both are symmetric in whitened coordinates: every pair of
pixel and Gaussian adds to a 3-vector ``Y1`` and a symmetric 3x3 ``Y2`` per Gaussian, which `chain` turns into
gradients of mean, quaternion and scale. In the turned coordinates of the linear forms
``y = (-|M m| (g1^2 + g2^2), |M m| g0 g1, |M m| g0 g2)/|g|^2``.

Bounds of the tiles that an ellipsoid can touch never leave one out: a plane through the ray origin with normal l touches
it where l^T C l = 0, with its half axes the columns of A, its centre m, and C = A A^T - m m^T. In float32 they reach
further by what rounding may err.
"""

from typing import Any

import warp as wp

from warprrf.cache import once
from warprrf.kernels.raster.view import PINHOLE, Rules, View, rotation_matrix

PI = wp.constant(3.141592653589793)
ON_ONE_SIDE = 0.02
"""A plane passes an ellipsoid if its distance from the centre, squared, exceeds the half width's by this share: less, and
float32 would err by more than the slack."""
SLACK, SLACK_A_PIXEL = (
    0.01,
    2.0e-5,
)  # pixels, and of each of an image's: seven roundings of 2^-24, over ON_ONE_SIDE
SLACK_ANGLE = 1.0e-5  # radians


@wp.func
def tile_span(lo: float, hi: float, pixels: int, tile: int):
    """First and last tile with a pixel centre in [lo, hi] (pixel coordinates); (0, -1) where there is none."""
    slack = wp.static(SLACK) + wp.static(SLACK_A_PIXEL) * float(pixels)
    beyond = float(pixels + 1)
    first = int(wp.ceil(wp.clamp(lo - slack, -1.0, beyond) - 0.5))
    last = int(wp.floor(wp.clamp(hi + slack, -1.0, beyond) - 0.5))
    first = wp.max(first, 0)
    last = wp.min(last, pixels - 1)
    if first > last:
        return wp.vec2i(0, -1)
    return wp.vec2i(first / tile, last / tile)


@wp.func
def covered_in_photo(view: View, m: wp.vec3, axes: wp.mat33, cap: float):
    """:func:`covered_tiles` of a pinhole camera; ``cap`` is the angle round the mean that holds the ellipsoid.

    Where it lies on one side of the camera plane, lines x = const touch the silhouette at the roots of
    c11 x^2 - 2 c01 x + c00, C = axes axes^T - m m^T. Their distance is that of the same without the determinant of
    axes axes^T, which makes it larger and needs no difference of large numbers.
    """
    depth = m[1] * m[1]
    c11 = wp.dot(axes[1], axes[1]) - depth
    if c11 < -wp.static(ON_ONE_SIDE) * depth:
        if m[1] <= 0.0:
            return wp.vec4i(0, 0, 0, 0)
        fx, fy, cx, cy = float(view.fx), float(view.fy), float(view.cx), float(view.cy)
        x = fx * (wp.dot(axes[0], axes[1]) - m[0] * m[1]) / c11 + cx
        y = fy * (wp.dot(axes[2], axes[1]) - m[2] * m[1]) / c11 + cy
        wide = -fx * wp.length(m[1] * axes[0] - m[0] * axes[1]) / c11
        high = -fy * wp.length(m[1] * axes[2] - m[2] * axes[1]) / c11
        tx = tile_span(x - wide, x + wide, view.width, view.tile)
        ty = tile_span(y - high, y + high, view.height, view.tile)
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], ty[1] - ty[0] + 1)
    corner = wp.vec2(
        float(wp.max(view.cx, wp.float64(view.width) - view.cx) / view.fx),
        float(wp.max(view.cy, wp.float64(view.height) - view.cy) / view.fy),
    )
    off_axis = wp.atan2(wp.length(wp.vec2(m[0], m[2])), m[1])
    if off_axis > cap + wp.atan(wp.length(corner)) + wp.static(SLACK_ANGLE):
        return wp.vec4i(0, 0, 0, 0)
    return wp.vec4i(0, view.tiles_x, 0, view.tiles_y)


@wp.func
def azimuth_interval(m: wp.vec3, axes: wp.mat33):
    """Azimuths relative to that of the mean between which the silhouette lies, seen along the pole axis: in the frame
    whose first axis points at the mean, tan p solves d11 t^2 - 2 d12 t + d22 = 0, with D = axes axes^T - m m^T in the
    horizontal plane. (-pi, pi) where the ellipse meets the pole axis or reaches behind it sideways."""
    rho = wp.sqrt(m[0] * m[0] + m[1] * m[1])
    cp = m[0] / rho
    sp = m[1] / rho
    along = cp * axes[0] + sp * axes[1]
    across = cp * axes[1] - sp * axes[0]
    d11 = wp.dot(along, along) - rho * rho
    d12 = wp.dot(along, across)
    if d11 < -wp.static(ON_ONE_SIDE) * rho * rho:
        root = wp.sqrt(d12 * d12 - d11 * wp.dot(across, across))
        return wp.vec2(wp.atan((d12 + root) / d11), wp.atan((d12 - root) / d11))
    return wp.vec2(-PI, PI)


@wp.func
def covered_in_panorama(view: View, m: wp.vec3, axes: wp.mat33, cap: float):
    """:func:`covered_tiles` of a spherical camera; columns wrap."""
    per_radian = float(view.height) / PI
    zenith = wp.atan2(wp.length(wp.vec2(m[0], m[1])), m[2])
    ty = tile_span((zenith - cap) * per_radian, (zenith + cap) * per_radian, view.height, view.tile)
    rows = ty[1] - ty[0] + 1
    half = azimuth_interval(m, axes)
    if half[1] == PI:
        return wp.vec4i(0, view.tiles_x, ty[0], rows)
    azimuth = wp.atan2(m[1], m[0])
    w = float(view.width)
    lo = (azimuth + half[0] + PI) * w / (2.0 * PI)
    hi = (azimuth + half[1] + PI) * w / (2.0 * PI)
    if lo < 0.0:
        lo += w
        hi += w
    tx = tile_span(lo, wp.min(hi, w), view.width, view.tile)
    if hi <= w:
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], rows)
    rest = tile_span(0.0, hi - w, view.width, view.tile)
    if tx[1] < tx[0]:
        return wp.vec4i(rest[0], rest[1] - rest[0] + 1, ty[0], rows)
    if rest[1] < rest[0]:
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], rows)
    return wp.vec4i(tx[0], wp.min(view.tiles_x - tx[0] + rest[1] + 1, view.tiles_x), ty[0], rows)


@wp.func
def covered_tiles(view: View, m: wp.vec3, axes: wp.mat33, extent: float, inside: bool):
    """Tiles that an ellipsoid can touch: first column, columns, first row, rows; columns wrap on a sphere.

    Its half axes are the columns of ``axes``, the longest one ``extent``, its centre ``m``, in the view's axes.
    ``inside``: whether it holds the ray origin.
    """
    if inside:
        return wp.vec4i(0, view.tiles_x, 0, view.tiles_y)
    cap = PI  # a long ellipsoid close by reaches more than 90 degrees from its mean
    share = extent * wp.static(1.0 + SLACK_ANGLE) / wp.length(m)
    if share < 1.0:
        cap = wp.asin(share)
    if view.kind == wp.static(PINHOLE):
        return covered_in_photo(view, m, axes, cap)
    return covered_in_panorama(view, m, axes, cap)


CHANNELS = 4  # feature channels blended by one launch
# Numbers per Gaussian that the adjoints of blending sum, with v = dL/d(opacity): v q; Y1 without its first component,
# 2; Y2 without its last, 5; what ranges take from the first component of Y1; v; features, 4; blending weight. The
# first nine lack the factor -opacity/2, and 1/|M m| for each first component of y but its sign: `chain` multiplies
# once.
OF_OPACITY, OF_FEATURES, OF_WEIGHT = 9, 10, 14
SUMS = 16  # as many as a tile has pixels, each of which adds up one on a GPU; the last is free
sums_d = wp.types.vector(SUMS, wp.float64)
LAST = 2147483647  # key of what is not seen
# Stays finite where scales are near the smallest number: zero offset times infinity would be NaN.
STEEPEST = 1.0e15


@once
def splat_of(real: type) -> Any:
    """The struct of a Gaussian seen from the ray origin. Forms are those of :func:`.view.pixel_ray`'s axes."""
    vec3 = wp.types.vector(3, real)

    @wp.struct
    class Splat:
        g0: vec3  # linear forms of a ray, of M times the smallest scale;
        cut: real  # q at which alpha falls below alpha_min
        g1: vec3  # these two times |M m|
        flat: real  # 1 / |M m|^2
        g2: vec3
        opacity: real
        reach: real  # |m| |M m| with M scaled as above: a range is reach g0 / |g|^2 [m]
        lift: real  # how a range's gradient joins the others in the adjoint [m]
        tilt: real  # never positive
        free: real  # rows of 64 bytes in float32: two sectors of a GPU's cache

    return Splat


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


@once
def build_project(real: type) -> Any:
    """The kernel for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    Splat = splat_of(real)
    # exp(-q/2) of float32 is a polynomial made for q up to here; nothing is seen of what is fainter.
    faintest = 80.0 if real is wp.float32 else 1.0e250

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
        keys: wp.array(dtype=int),
        order: wp.array(dtype=int),
        splats: wp.array(dtype=Splat),
    ):
        """Per Gaussian and view: the covered tiles, the key that orders blending, and the splat where it is seen. A key is
        the range, whose bits sort as it does, as it is not negative; those of Gaussians that are not seen come last."""
        i = offset + wp.tid()
        m = wp.vec3d(means[i]) - view.origin
        range_ = wp.length(m)
        opacity = wp.float64(opacities[i])
        span[i] = wp.vec4i(0, 0, 0, 0)
        keys[i] = wp.static(LAST)
        order[i] = i
        if opacity < rules.alpha_min or opacity <= wp.float64(0.0) or range_ < wp.float64(1.0e-12):
            return
        s = wp.vec3d(scales[i])
        cut = wp.float64(2.0) * wp.log(opacity / rules.alpha_min)
        r = view.rotation * rotation_matrix(wp.vec4d(quaternions[i]))
        m = view.rotation * m
        smin = wp.min(s)
        scaling = wp.vec3d(smin / s[0], smin / s[1], smin / s[2])
        a = wp.cw_mul(scaling, wp.transpose(r) * m)  # M m times the smallest scale
        length = wp.length(a)
        steepness = length / smin
        radius = wp.sqrt(cut)
        axes = wp.mat33(r * wp.diag(radius * s))
        tiles = covered_tiles(view, wp.vec3(m), axes, float(radius * wp.max(s)), steepness * steepness <= cut)
        if tiles[1] * tiles[3] == 0:
            return
        span[i] = tiles
        keys[i] = wp.cast(float(range_), wp.int32)
        steep = wp.min(steepness, wp.float64(wp.static(STEEPEST)))
        flat = wp.float64(1.0) / steep
        forms = wp.transpose(r * (wp.diag(scaling) * whitened_frame(a)))
        splat = Splat()
        splat.g0 = vec3(forms[0])
        splat.g1 = vec3(forms[1] * steep)
        splat.g2 = vec3(forms[2] * steep)
        splat.flat = real(flat * flat)
        splat.cut = real(wp.min(cut, wp.float64(wp.static(faintest))))
        splat.opacity = real(opacity)
        splat.reach = real(length)
        splat.lift = real(smin * steep / opacity)
        splat.tilt = real(-smin * flat / opacity)
        splats[i] = splat

    return project


@wp.func
def whitened_sums(y: sums_d, a: wp.vec3d, steep: wp.float64, opacity: wp.float64):
    """Y1 and Y2 in the Gaussian's axes, from the summed numbers in the turned ones."""
    flat = wp.float64(-1.0) / steep
    f = wp.float64(-0.5) * opacity
    frame = whitened_frame(a)
    y1 = frame * (f * wp.vec3d(flat * (y[0] - y[8]), y[1], y[2]))
    y00 = flat * flat * y[3]
    y01 = flat * y[4]
    y02 = flat * y[5]
    y22 = y[0] - y00 - y[6]  # the trace is the sum of dL/dq times q
    y2 = frame * (f * wp.mat33d(y00, y01, y02, y01, y[6], y[7], y02, y[7], y22)) * wp.transpose(frame)
    return y1, y2


@wp.func
def quaternion_gradient(q: wp.vec4d, y2: wp.mat33d, s: wp.vec3d):
    """dL/dq of a quaternion wxyz from dL/dw_3 = 2 Y2_12 (s_2/s_1 - s_1/s_2) and cyclic for a local rotation w: a
    quaternion turns by q (0, w/2)."""
    two = wp.float64(2.0)
    x = two * y2[1, 2] * (s[2] / s[1] - s[1] / s[2])
    y = -two * y2[0, 2] * (s[2] / s[0] - s[0] / s[2])
    z = two * y2[0, 1] * (s[1] / s[0] - s[0] / s[1])
    turned = wp.vec4d(
        -q[1] * x - q[2] * y - q[3] * z,
        q[0] * x + q[2] * z - q[3] * y,
        q[0] * y + q[3] * x - q[1] * z,
        q[0] * z + q[1] * y - q[2] * x,
    )
    return turned * (two / wp.dot(q, q))


@once
def build_chain(real: type) -> Any:
    """The kernel for one scalar type, ``wp.float32`` or ``wp.float64``; compiled when first launched."""
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    sums_of_one = wp.types.vector(SUMS, real)

    @wp.kernel(module="unique", enable_backward=False)
    def chain(
        offset: int,
        means: wp.array(dtype=vec3),
        quaternions: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec3),
        opacities: wp.array(dtype=real),
        view: View,
        first: int,
        sums: wp.array(dtype=sums_of_one, ndim=2),
        means_grad: wp.array(dtype=vec3),
        quaternions_grad: wp.array(dtype=vec4),
        scales_grad: wp.array(dtype=vec3),
        opacities_grad: wp.array(dtype=real),
        features_grad: wp.array(dtype=real, ndim=2),
        seen: wp.array(dtype=real),
    ):
        """Add up the parts of ``sums`` (parts, N), then add the gradients of mean, quaternion, scale, opacity and
        features from channel ``first``: dL/dmean = -2 M^T Y1, dL/ds_i = -2 Y2_ii / s_i."""
        i = offset + wp.tid()
        y = sums_d()
        for part in range(sums.shape[0]):
            row = sums[part, i]
            for k in range(wp.static(SUMS)):
                y[k] += wp.float64(row[k])
        if first == 0:
            seen[i] = real(y[wp.static(OF_WEIGHT)])
        if y[wp.static(OF_WEIGHT)] == wp.float64(0.0):  # out of view, or hidden behind others: no gradient
            return
        q = wp.vec4d(quaternions[i])
        s = wp.vec3d(scales[i])
        r = rotation_matrix(q)
        smin = wp.min(s)
        m = wp.vec3d(means[i]) - view.origin
        a = wp.cw_mul(wp.vec3d(smin / s[0], smin / s[1], smin / s[2]), wp.transpose(r) * m)
        steep = wp.min(wp.length(a) / smin, wp.float64(wp.static(STEEPEST)))
        y1, y2 = whitened_sums(y, a, steep, wp.float64(opacities[i]))
        means_grad[i] = means_grad[i] - vec3(r * wp.cw_div(wp.float64(2.0) * y1, s))
        scales_grad[i] = scales_grad[i] - vec3(wp.cw_div(wp.float64(2.0) * wp.get_diag(y2), s))
        quaternions_grad[i] = quaternions_grad[i] + vec4(quaternion_gradient(q, y2, s))
        opacities_grad[i] = opacities_grad[i] + real(y[wp.static(OF_OPACITY)])
        for k in range(wp.static(CHANNELS)):
            if first + k < features_grad.shape[1]:
                features_grad[i, first + k] = features_grad[i, first + k] + real(
                    y[wp.static(OF_FEATURES) + k]
                )

    return chain
