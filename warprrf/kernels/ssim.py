"""L1 and structural similarity of images in [0, 1] with their derivative, in Warp.

SSIM: Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004, with a Gaussian
window of 11 pixels and sigma 1.5 that sees zeros beyond the border. That filter is its own adjoint, so the derivative
filters the slopes once more.

The filter is most of the loss, and along rows and columns alike it adds shifted stretches of memory. An image is
a plane here: row after row, each a margin of zeros, the numbers (pixel after pixel, channel after channel), zeros up to
a whole number of blocks, and a margin again. So a kernel's index is a block of neighbours in a row, a vector holds them,
and nothing asks where a row ends. A GPU has a thread for every number, that is blocks of one.
"""

from types import SimpleNamespace

import numpy as np
import warp as wp

from warprrf.cache import once
from warprrf.kernels.raster.blocks import VECTORISED

RADIUS = 5  # pixels: 11 taps
WINDOW = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / 1.5) ** 2)
WINDOW /= WINDOW.sum()
C1, C2 = 0.01**2, 0.03**2  # the paper's constants for a range of one
MARGIN = 16  # numbers before and behind a row: as many as the window reaches, or more
LANES = 16  # of a block on a CPU


def stride_of(numbers: int) -> int:
    """Places from one row of a plane to the next, for ``numbers`` in a row."""
    return blocks_of(numbers, LANES) * LANES + 2 * MARGIN


def blocks_of(numbers: int, lanes: int) -> int:
    """Blocks of a row."""
    return -(-numbers // lanes)


def build(real: type, lanes: int, channels: int) -> SimpleNamespace:
    """The kernels for one scalar type, size of a block and numbers per pixel; compiled when first launched."""
    kernels = vars(_filters(real, lanes, channels)) | vars(_loss(real, lanes, channels))
    return SimpleNamespace(**kernels)


@once
def _blocks(real: type, lanes: int, channels: int) -> SimpleNamespace:
    """What kernels do with a block."""
    block = wp.types.vector(lanes, real)
    window = wp.constant(wp.types.vector(len(WINDOW), real)(*WINDOW))
    name = real.__name__
    plane = wp.array(dtype=real)

    @wp.func_native(f"""
    wp::vec_t<{lanes}, wp::{name}> out;
    const wp::{name}* from = source.data + at;
    for (int i = 0; i < {lanes}; ++i) out[i] = from[i];
    return out;
    """)
    def load(source: plane, at: int) -> block:
        """The block that begins at a number of a plane."""
        ...

    @wp.func_native(f"""
    wp::{name}* to = target.data + at;
    for (int i = 0; i < {lanes}; ++i) to[i] = values[i];
    """)
    def store(target: plane, at: int, values: block):
        """Write a block."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{lanes}, wp::{name}> out;
    for (int i = 0; i < {lanes}; ++i) out[i] = wp::{name}((x[i] > wp::{name}(0)) - (x[i] < wp::{name}(0)));
    return out;
    """)
    def signs(x: block) -> block:
        """-1, 0 or 1."""
        ...

    @wp.func
    def along_row(source: plane, at: int):
        """Window average of a block along its row."""
        total = block()
        for k in range(wp.static(2 * RADIUS + 1)):
            total += window[k] * load(source, at + (k - wp.static(RADIUS)) * wp.static(channels))
        return total

    return SimpleNamespace(
        block=block, window=window, plane=plane, load=load, store=store, signs=signs, along_row=along_row
    )


@once
def _filters(real: type, lanes: int, channels: int) -> SimpleNamespace:
    """Window averages of planes, of images of ``height`` rows one below another."""
    f = _blocks(real, lanes, channels)
    block, window, plane, load, store, along_row = f.block, f.window, f.plane, f.load, f.store, f.along_row

    @wp.func
    def inside(row: int, shift: int, height: int):
        """Whether the row ``shift`` below is one of the same image."""
        r = row % height + shift
        return r >= 0 and r < height

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def moments(
        offset: int,
        height: int,
        stride: int,
        blocks: int,
        image: plane,
        photo: plane,
        mean: plane,
        square: plane,
        product: plane,
    ):
        """Window averages of u, u^2 and u t along columns."""
        i = offset + wp.tid()
        row = i / blocks
        at = (i % blocks) * wp.static(lanes) + wp.static(MARGIN)
        of_mean = block()
        of_square = block()
        of_product = block()
        for k in range(wp.static(2 * RADIUS + 1)):
            shift = k - wp.static(RADIUS)
            if inside(row, shift, height):
                there = (row + shift) * stride + at
                u = load(image, there)
                weighted = window[k] * u
                of_mean += weighted
                of_square += wp.cw_mul(weighted, u)
                of_product += wp.cw_mul(weighted, load(photo, there))
        store(mean, row * stride + at, of_mean)
        store(square, row * stride + at, of_square)
        store(product, row * stride + at, of_product)

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def filter_rows(offset: int, stride: int, blocks: int, source: plane, out: plane):
        """Window average along rows."""
        i = offset + wp.tid()
        at = (i / blocks) * stride + (i % blocks) * wp.static(lanes) + wp.static(MARGIN)
        store(out, at, along_row(source, at))

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def filter_columns(offset: int, height: int, stride: int, blocks: int, source: plane, out: plane):
        """Window average along columns."""
        i = offset + wp.tid()
        row = i / blocks
        at = (i % blocks) * wp.static(lanes) + wp.static(MARGIN)
        total = block()
        for k in range(wp.static(2 * RADIUS + 1)):
            shift = k - wp.static(RADIUS)
            if inside(row, shift, height):
                total += window[k] * load(source, (row + shift) * stride + at)
        store(out, row * stride + at, total)

    return SimpleNamespace(filter_columns=filter_columns, filter_rows=filter_rows, moments=moments)


@once
def _loss(real: type, lanes: int, channels: int) -> SimpleNamespace:
    """SSIM of planes, and the way back."""
    f = _blocks(real, lanes, channels)
    block, plane, load, store, signs, along_row = f.block, f.plane, f.load, f.store, f.signs, f.along_row
    c1, c2 = wp.constant(real(C1)), wp.constant(real(C2))

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def slopes(
        offset: int,
        stride: int,
        blocks: int,
        inside: plane,
        photo_mean: plane,
        photo_square: plane,
        mean: plane,
        square: plane,
        product: plane,
        score: plane,
        of_mean_out: plane,
        of_square_out: plane,
        of_product_out: plane,
    ):
        """SSIM and its derivatives with respect to the averages of u, u^2 and u t, from those along columns; 0 beyond
        a row's numbers, where ``inside`` is 0."""
        i = offset + wp.tid()
        first = (i % blocks) * wp.static(lanes) + wp.static(MARGIN)
        at = (i / blocks) * stride + first
        mu = along_row(mean, at)
        mt = load(photo_mean, at)
        both = wp.cw_mul(mu, mt)
        squares = wp.cw_mul(mu, mu)
        photo_squares = wp.cw_mul(mt, mt)
        a1 = real(2.0) * both + block(c1)
        a2 = real(2.0) * (along_row(product, at) - both) + block(c2)
        b1 = squares + photo_squares + block(c1)
        b2 = (along_row(square, at) - squares) + (load(photo_square, at) - photo_squares) + block(c2)
        taken = load(inside, first)
        inverse = wp.cw_div(taken, wp.cw_mul(b1, b2))
        s = wp.cw_mul(wp.cw_mul(a1, a2), inverse)
        of_square = -wp.cw_div(s, b2)
        of_product = real(2.0) * wp.cw_mul(a1, inverse)
        of_mean = (
            real(2.0) * wp.cw_mul(mt, wp.cw_mul(a2, inverse))
            - real(2.0) * wp.cw_mul(mu, wp.cw_div(s, b1) + of_square)
            - wp.cw_mul(mt, of_product)
        )
        store(score, at, s)
        store(of_mean_out, at, of_mean)
        store(of_square_out, at, of_square)
        store(of_product_out, at, of_product)

    @wp.kernel(module="unique", module_options=VECTORISED, enable_backward=False)
    def adjoint(
        offset: int,
        stride: int,
        blocks: int,
        image: plane,
        photo: plane,
        of_mean: plane,
        of_square: plane,
        of_product: plane,
        absolute_share: real,
        ssim_share: real,
        out: plane,
    ):
        """Derivative of the loss from the slopes averaged along columns; the shares hold the division by the count."""
        i = offset + wp.tid()
        at = (i / blocks) * stride + (i % blocks) * wp.static(lanes) + wp.static(MARGIN)
        u = load(image, at)
        t = load(photo, at)
        filtered = (
            along_row(of_mean, at)
            + real(2.0) * wp.cw_mul(u, along_row(of_square, at))
            + wp.cw_mul(t, along_row(of_product, at))
        )
        store(out, at, absolute_share * signs(u - t) - ssim_share * filtered)

    return SimpleNamespace(adjoint=adjoint, slopes=slopes)
