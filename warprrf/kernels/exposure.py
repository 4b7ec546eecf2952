"""What a photo shows of a rendered image: its own gain for every colour, masked pixels left out, highlights clipped.

Photos are planes (:mod:`.ssim`), images are flat.
"""

import warp as wp

from warprrf.kernels.ssim import MARGIN

CLIPPED = 1.0 - 0.5 / 255.0  # a photo's value from here on may stand for any brighter one


@wp.kernel(enable_backward=False)
def show(
    offset: int,
    width: int,
    stride: int,
    image: wp.array(dtype=float),
    photo: wp.array(dtype=float),
    kept: wp.array(dtype=float),
    gain: wp.vec3,
    out: wp.array(dtype=float),
):
    """The image as the photo's camera would have taken it; ``kept`` is 0 at masked pixels, else 1."""
    p = offset + wp.tid()
    first = (p / width) * stride + wp.static(MARGIN) + 3 * (p % width)
    for k in range(3):
        e = first + k
        value = gain[k] * image[3 * p + k]
        if photo[e] >= wp.static(CLIPPED):
            value = wp.min(value, photo[e])
        out[e] = value * kept[p]


@wp.kernel(enable_backward=False)
def show_adjoint(
    offset: int,
    width: int,
    stride: int,
    image: wp.array(dtype=float),
    photo: wp.array(dtype=float),
    kept: wp.array(dtype=float),
    gain: wp.vec3,
    slope: wp.array(dtype=float),
    out: wp.array(dtype=float),
):
    """Chain rule through :func:`show`, from the gradient ``slope`` of what it wrote."""
    p = offset + wp.tid()
    first = (p / width) * stride + wp.static(MARGIN) + 3 * (p % width)
    for k in range(3):
        e = first + k
        value = gain[k] * slope[e]
        if photo[e] >= wp.static(CLIPPED) and gain[k] * image[3 * p + k] > photo[e]:
            value = 0.0
        out[3 * p + k] = value * kept[p]


@wp.kernel(enable_backward=False)
def gain_sums(
    offset: int,
    width: int,
    stride: int,
    image: wp.array(dtype=float),
    photo: wp.array(dtype=float),
    kept: wp.array(dtype=float),
    gain: wp.vec3,
    knee: float,
    of_photo: wp.array(dtype=wp.vec3),
    of_image: wp.array(dtype=wp.vec3),
):
    """Per row the sums of w x t and w x x over image x and photo t, with the weights w of a Huber loss: 1 where x times
    the gain is within ``knee`` of t, then falling. Their quotient is the gain of the next step of least squares."""
    row = offset + wp.tid()
    products = wp.vec3(0.0)
    squares = wp.vec3(0.0)
    for column in range(width):
        p = row * width + column
        for k in range(3):
            x = image[3 * p + k]
            t = photo[row * stride + wp.static(MARGIN) + 3 * column + k]
            if kept[p] > 0.0 and t < wp.static(CLIPPED):
                w = knee / wp.max(wp.abs(gain[k] * x - t), knee)
                products[k] += w * x * t
                squares[k] += w * x * x
    of_photo[row] = products
    of_image[row] = squares
