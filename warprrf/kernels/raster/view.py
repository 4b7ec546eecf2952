"""What the kernels know of a camera and of a blending rule, and the rays of its pixels.

All rays of a view start at one point. Neither a response nor a range depends on the length of a direction, so rays are
taken where they are cheapest: on the image plane of a photo, on the cylinder round the pole axis of a panorama.
"""

import warp as wp

TILE = 4
"""Pixels: side of a tile, which has one list of Gaussians. A CPU's thread blends a tile, a GPU's warp two."""
PINHOLE, SPHERICAL = 0, 1
PRODUCT, EXPONENTIAL = 0, 1  # transmittance rules: prod(1 - alpha), or the paper's exp(-sum alpha)


@wp.struct
class View:
    """A camera: image and tiles in pixels, intrinsics, ray origin in the world [m].

    ``rotation`` turns the world to the view's own axes: right, forward, down for a photo, the world's for a panorama.
    Either way the first two axes of a ray depend on its pixel's column alone and the third on its row.
    """

    kind: int
    width: int
    height: int
    tile: int  # TILE, where it must not be a constant
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
    """How alphas along a ray become an image: cutoff, clamp, early exit, transmittance rule."""

    alpha_min: wp.float64
    alpha_max: wp.float64
    transmittance_min: wp.float64
    rule: int


@wp.func
def pixel_ray(view: View, x: int, y: int):
    """Direction through the centre of a pixel in the view's axes, not of unit length: one forward for a photo, at
    distance one from the pole axis for a panorama. Beyond the image that of its border."""
    u = wp.float64(wp.min(x, view.width - 1)) + wp.float64(0.5)
    v = wp.float64(wp.min(y, view.height - 1)) + wp.float64(0.5)
    if view.kind == wp.static(PINHOLE):
        return wp.vec3d((u - view.cx) / view.fx, wp.float64(1.0), (v - view.cy) / view.fy)
    pi = wp.float64(3.141592653589793)
    azimuth = u * wp.float64(2.0) * pi / wp.float64(view.width) - pi
    zenith = v * pi / wp.float64(view.height)
    return wp.vec3d(wp.cos(azimuth), wp.sin(azimuth), wp.float64(1.0) / wp.tan(zenith))


@wp.func
def pixel_of(thread: int, view: View):
    """Tile, column and row of the pixel of a thread; threads go tile by tile, row by row in each."""
    tile = thread / wp.static(TILE * TILE)
    place = thread % wp.static(TILE * TILE)
    x = (tile % view.tiles_x) * wp.static(TILE) + place % wp.static(TILE)
    y = (tile / view.tiles_x) * wp.static(TILE) + place / wp.static(TILE)
    return tile, x, y


@wp.func
def rotation_matrix(q: wp.vec4d):
    """Rotation of the quaternion wxyz, normalised here."""
    one = wp.float64(1.0)
    unit = q * (one / wp.length(q))
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    two = wp.float64(2.0)
    return wp.mat33d(
        one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
        two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
        two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
    )  # fmt: skip
