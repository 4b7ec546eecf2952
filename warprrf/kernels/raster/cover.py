"""Which tiles of an image an ellipsoid can touch: bounds that never leave one out.

A plane through the ray origin with normal l touches an ellipsoid where l^T C l = 0: its half axes the columns of A, its
centre m, C = A A^T - m m^T.
"""

import warp as wp

from warprrf.kernels.raster.view import PINHOLE, View

PI = wp.constant(wp.float64(3.141592653589793))


@wp.func
def tangent_interval(c11: wp.float64, c13: wp.float64, c33: wp.float64):
    """Roots of ``c33 x^2 - 2 c13 x + c11``: where image lines x = const touch the silhouette (c33 < 0)."""
    root = wp.sqrt(wp.max(c13 * c13 - c11 * c33, wp.float64(0.0)))
    return wp.vec2d((c13 + root) / c33, (c13 - root) / c33)


@wp.func
def tile_span(lo: wp.float64, hi: wp.float64, pixels: int, tile: int):
    """First and last tile with a pixel centre in [lo, hi] (pixel coordinates); (0, -1) where there is none."""
    slack = wp.float64(1.0e-3)  # pixels: covers the rounding of the bounds
    beyond = wp.float64(pixels + 1)
    first = int(wp.ceil(wp.clamp(lo - slack, wp.float64(-1.0), beyond) - wp.float64(0.5)))
    last = int(wp.floor(wp.clamp(hi + slack, wp.float64(-1.0), beyond) - wp.float64(0.5)))
    first = wp.max(first, 0)
    last = wp.min(last, pixels - 1)
    if first > last:
        return wp.vec2i(0, -1)
    return wp.vec2i(first / tile, last / tile)


@wp.func
def covered_in_photo(view: View, m: wp.vec3d, distance: wp.float64, c: wp.mat33d, cap: wp.float64):
    """:func:`covered_tiles` of a pinhole camera; ``cap`` is the angle round the mean that holds the ellipsoid."""
    if c[1, 1] < wp.float64(0.0):  # the ellipsoid lies on one side of the camera plane
        if m[1] <= wp.float64(0.0):
            return wp.vec4i(0, 0, 0, 0)
        x = tangent_interval(c[0, 0], c[0, 1], c[1, 1])
        y = tangent_interval(c[2, 2], c[1, 2], c[1, 1])
        tx = tile_span(view.fx * x[0] + view.cx, view.fx * x[1] + view.cx, view.width, view.tile)
        ty = tile_span(view.fy * y[0] + view.cy, view.fy * y[1] + view.cy, view.height, view.tile)
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], ty[1] - ty[0] + 1)
    corner = wp.vec2d(
        wp.max(view.cx, wp.float64(view.width) - view.cx) / view.fx,
        wp.max(view.cy, wp.float64(view.height) - view.cy) / view.fy,
    )
    off_axis = wp.acos(wp.clamp(m[1] / distance, wp.float64(-1.0), wp.float64(1.0)))
    if off_axis > cap + wp.atan(wp.length(corner)):
        return wp.vec4i(0, 0, 0, 0)
    return wp.vec4i(0, view.tiles_x, 0, view.tiles_y)


@wp.func
def azimuth_interval(m: wp.vec3d, c: wp.mat33d):
    """Azimuths relative to that of the mean between which the silhouette lies, seen along the pole axis: the same
    conic in the horizontal plane. (-pi, pi) where the pole axis meets the ellipse or it reaches behind it sideways."""
    c11 = c[0, 0]
    c12 = c[0, 1]
    c22 = c[1, 1]
    # In the frame whose first axis points at the mean: l = (-sin p, cos p), and tan p solves a quadratic.
    rho = wp.sqrt(m[0] * m[0] + m[1] * m[1])
    cp = m[0] / rho
    sp = m[1] / rho
    d11 = cp * cp * c11 + wp.float64(2.0) * cp * sp * c12 + sp * sp * c22
    d12 = -cp * sp * c11 + (cp * cp - sp * sp) * c12 + cp * sp * c22
    d22 = sp * sp * c11 - wp.float64(2.0) * cp * sp * c12 + cp * cp * c22
    if c11 * c22 - c12 * c12 < wp.float64(0.0) and d11 < wp.float64(0.0):
        t = tangent_interval(d22, d12, d11)
        return wp.vec2d(wp.atan(t[0]), wp.atan(t[1]))
    return wp.vec2d(-PI, PI)


@wp.func
def covered_in_panorama(view: View, m: wp.vec3d, distance: wp.float64, c: wp.mat33d, cap: wp.float64):
    """:func:`covered_tiles` of a spherical camera; columns wrap."""
    per_radian = wp.float64(view.height) / PI
    zenith = wp.acos(wp.clamp(m[2] / distance, wp.float64(-1.0), wp.float64(1.0)))
    ty = tile_span((zenith - cap) * per_radian, (zenith + cap) * per_radian, view.height, view.tile)
    rows = ty[1] - ty[0] + 1
    half = azimuth_interval(m, c)
    if half[1] == PI:
        return wp.vec4i(0, view.tiles_x, ty[0], rows)
    azimuth = wp.atan2(m[1], m[0])
    w = wp.float64(view.width)
    lo = (azimuth + half[0] + PI) * w / (wp.float64(2.0) * PI)
    hi = (azimuth + half[1] + PI) * w / (wp.float64(2.0) * PI)
    if lo < wp.float64(0.0):
        lo += w
        hi += w
    tx = tile_span(lo, wp.min(hi, w), view.width, view.tile)
    if hi <= w:
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], rows)
    rest = tile_span(wp.float64(0.0), hi - w, view.width, view.tile)
    if tx[1] < tx[0]:
        return wp.vec4i(rest[0], rest[1] - rest[0] + 1, ty[0], rows)
    if rest[1] < rest[0]:
        return wp.vec4i(tx[0], tx[1] - tx[0] + 1, ty[0], rows)
    return wp.vec4i(tx[0], wp.min(view.tiles_x - tx[0] + rest[1] + 1, view.tiles_x), ty[0], rows)


@wp.func
def covered_tiles(view: View, m: wp.vec3d, axes: wp.mat33d, extent: wp.float64, inside: bool):
    """Tiles that an ellipsoid can touch: first column, columns, first row, rows; columns wrap on a sphere.

    Its half axes are the columns of ``axes``, the longest one ``extent``, its centre ``m``, in the view's axes.
    ``inside``: whether it holds the ray origin.
    """
    if inside:
        return wp.vec4i(0, view.tiles_x, 0, view.tiles_y)
    c = axes * wp.transpose(axes) - wp.outer(m, m)
    distance = wp.length(m)
    cap = PI  # a long ellipsoid close by reaches more than 90 degrees from its mean
    if extent < distance:
        cap = wp.asin(extent / distance)
    if view.kind == wp.static(PINHOLE):
        return covered_in_photo(view, m, distance, c, cap)
    return covered_in_panorama(view, m, distance, c, cap)
