"""Depth of every pixel of a photo by comparison with others: small planes, tried, kept where photos agree, handed on.

A pixel's plane is its inverse depth along the optical axis and how that changes per pixel, ``(w, dw/du, dw/dv)``: inverse
depth is linear in the image on a plane. With ``A = K_s R K^-1`` and ``b = K_s t`` of another photo, pixel ``p`` lies there
at ``A (u, v, 1) + b w(p)``. Source: Bleyer, Rhemann and Rother, "PatchMatch Stereo", BMVC 2011; the two colours of a
chess board are updated in turns as in Galliani, Lasinger and Schindler, "Massively parallel multiview stereopsis by
surface normal diffusion", ICCV 2015. That a plane also costs what it contradicts in other photos is of Xu and Tao,
"Multi-scale geometric consistency guided multi-view stereo", CVPR 2019, as is taking the best of several neighbours.
"""

import warp as wp

from warprrf.kernels.raster.blocks import VECTORISED

wp.set_module_options({"enable_backward": False} | VECTORISED)

SIDE = 5  # samples along a window's side, of which every other one is taken, as on a chess board
SAMPLES = wp.constant((SIDE * SIDE + 1) // 2)
LANES = 16  # numbers of a window, as a CPU's registers hold them: those after the samples count for nothing
UNKNOWN = wp.constant(2.0)  # cost of what no two photos show: that of opposite textures
BLANK = wp.constant(3.0)  # cost of a window that shows nothing
SAME = wp.constant(1.0e-3)  # planes whose inverse depths differ by this part of them in a window are one
SIMILAR = wp.constant(0.06)  # grey values this far from the middle's count 1/e: a window ends at an edge
STEP = wp.constant(2)  # pixels between samples of a window
FLAT = wp.constant(1.0e-5)  # variance of a window that shows nothing
REACH = wp.constant(3)  # neighbours in each direction, of which the one of least cost hands on its plane
TRIALS = wp.constant(3)  # planes near its best that a pixel tries in a turn
WANDER = wp.constant(
    0.3
)  # their inverse depths differ by up to this part in the first turn, by half in each next
LOST = wp.constant(0.5)  # a pixel of more cost tries any depth, once
UNLIKE = wp.constant(0.02)  # depths of two photos that differ by this part contradict each other in full
STEEPEST = wp.constant(6.0)  # tangent of a plane's largest angle to the image
window = wp.types.vector(length=LANES, dtype=wp.float32)


@wp.struct
class Others:
    """Photos that one is compared with: ``A``, ``b`` and size of each, and what all photos have so far.

    ``images`` and ``told``, their planes, are laid out alike; a plane costs ``contradicting`` where it contradicts the one that
    is told of another photo.
    """

    turns: wp.array(dtype=wp.mat33)
    shifts: wp.array(dtype=wp.vec3)
    sizes: wp.array(dtype=wp.vec3i)
    images: wp.array(dtype=wp.float32)
    told: wp.array(dtype=wp.vec3)
    contradicting: float


_PLACES = [*range(0, SIDE * SIDE, 2), *(0,) * (LANES - SAMPLES)]
COLUMNS = wp.constant(window(*(float(STEP * (k % SIDE - SIDE // 2)) for k in _PLACES)))
ROWS = wp.constant(window(*(float(STEP * (k // SIDE - SIDE // 2)) for k in _PLACES)))
"""From a window's middle to its samples [pixels]."""
CORRELATION = f"""
#pragma clang fp reassociate(on) contract(fast)
    const float b0 = b[0], b1 = b[1], b2 = b[2];
    const float p0 = plane[0], p1 = plane[1], p2 = plane[2];
    const float s0 = a.data[0][0] * u + a.data[0][1] * v + a.data[0][2] + b0 * p0;
    const float s1 = a.data[1][0] * u + a.data[1][1] * v + a.data[1][2] + b1 * p0;
    const float s2 = a.data[2][0] * u + a.data[2][1] * v + a.data[2][2] + b2 * p0;
    const float c0 = a.data[0][0] + b0 * p1, c1 = a.data[1][0] + b1 * p1, c2 = a.data[2][0] + b2 * p1;
    const float d0 = a.data[0][1] + b0 * p2, d1 = a.data[1][1] + b1 * p2, d2 = a.data[2][1] + b2 * p2;
    const float columns[] = {{ {", ".join(map(str, COLUMNS))} }}, rows[] = {{ {", ".join(map(str, ROWS))} }};
    const float right = (float)size[1] - 0.51f, low = (float)size[2] - 0.51f;
    const float* pixels = images.data + size[0];
    const int width = size[1];
    float x[{LANES}], y[{LANES}];
    int beyond = 0;
    for (int k = 0; k < {LANES}; ++k) {{
        const float depth = s2 + c2 * columns[k] + d2 * rows[k];
        x[k] = (s0 + c0 * columns[k] + d0 * rows[k]) / depth;
        y[k] = (s1 + c1 * columns[k] + d1 * rows[k]) / depth;
        beyond |= !((depth >= 1.0e-6f) & (x[k] >= 0.5f) & (y[k] >= 0.5f) & (x[k] <= right) & (y[k] <= low));
    }}
    if (beyond) return -2.0f;
    float total = 0.0f, square = 0.0f, product = 0.0f;
    for (int k = 0; k < {LANES}; ++k) {{
        const int j = (int)(x[k] - 0.5f), i = (int)(y[k] - 0.5f);
        const float fx = x[k] - 0.5f - (float)j, fy = y[k] - 0.5f - (float)i;
        const int at = i * width + j;
        const float top = pixels[at] + fx * (pixels[at + 1] - pixels[at]);
        const float under = pixels[at + width] + fx * (pixels[at + width + 1] - pixels[at + width]);
        const float value = top + fy * (under - top), w = weight.c[k], g = grey.c[k];
        total += w * value;
        square += w * value * value;
        product += w * value * g;
    }}
    const float spread = square - total * total;
    return spread < {FLAT}f ? 0.0f : (product - total * mean) / sqrtf(spread * variance);
"""


@wp.func_native(CORRELATION)
def correlation(
    plane: wp.vec3,
    u: float,
    v: float,
    grey: window,
    weight: window,
    mean: float,
    variance: float,
    a: wp.mat33,
    b: wp.vec3,
    images: wp.array(dtype=wp.float32),
    size: wp.vec3i,
) -> float:
    """Weighted normalised cross-correlation of a window and its image in another photo; -2 where that does not show it."""
    ...


@wp.func
def contradiction(
    plane: wp.vec3, u: float, v: float, a: wp.mat33, b: wp.vec3, told: wp.array(dtype=wp.vec3), size: wp.vec3i
) -> float:
    """How far the depth that another photo has there is from a plane's, in [0, 1]; 1 where it has none."""
    h = a * wp.vec3(u, v, 1.0) + b * plane[0]
    if h[2] < 1.0e-6:
        return float(1.0)
    x = h[0] / h[2]
    y = h[1] / h[2]
    if x < 0.0 or y < 0.0 or x >= float(size[1]) or y >= float(size[2]):
        return float(1.0)
    j = int(x)
    i = int(y)
    other = told[size[0] + i * size[1] + j]
    w = other[0] + other[1] * (x - float(j) - 0.5) + other[2] * (y - float(i) - 0.5)
    if w < 1.0e-6:
        return float(1.0)
    return wp.min(wp.abs(plane[0] / h[2] / w - 1.0) / UNLIKE, 1.0)


@wp.func
def disagreement(
    plane: wp.vec3,
    u: float,
    v: float,
    grey: window,
    weight: window,
    mean: float,
    variance: float,
    others: Others,
    least: float,
) -> float:
    """One minus the mean of the two best correlations: what hides a surface in some photos does not count. The last photo is
    not looked at where even a correlation of one would leave ``least`` or more."""
    best = float(-2.0)
    second = float(-2.0)
    for s in range(others.sizes.shape[0]):
        if s + 1 == others.sizes.shape[0] and best < 1.0 - 2.0 * least:
            return UNKNOWN
        a = others.turns[s]
        b = others.shifts[s]
        size = others.sizes[s]
        c = correlation(plane, u, v, grey, weight, mean, variance, a, b, others.images, size)
        if others.contradicting > 0.0 and c > -1.5:
            c = c - others.contradicting * contradiction(plane, u, v, a, b, others.told, size)
        if c > best:
            second = best
            best = c
        elif c > second:
            second = c
    if second < -1.5:
        return UNKNOWN
    return 1.0 - 0.5 * (best + second)


@wp.kernel
def match(
    offset: int,
    colour: int,
    turn: int,
    seed: int,
    slope: float,
    bounds: wp.vec2,
    settled: float,
    size: wp.vec3i,
    others: Others,
    planes: wp.array(dtype=wp.vec3),
    costs: wp.array(dtype=wp.float32),
):
    """Better planes for the pixels of one colour: their own, their neighbours', and some close to the best.

    Args:
        turn: counted from 0; -1 finds the costs of ``planes`` as they are.
        slope: change of inverse depth per pixel, over itself, of a plane at 45 degrees to the image.
        bounds: lowest and highest inverse depth [1/m].
        settled: planes of less cost stay.
        size: of the photo: where it begins in ``others.images``, its width and its height.
    """
    n = offset + wp.tid()
    width = size[1]
    height = size[2]
    half = (width + 1) // 2
    i = n // half
    j = 2 * (n % half) + (i + colour) % 2
    if j >= width:
        return
    u = float(j) + 0.5
    v = float(i) + 0.5
    here = i * width + j
    cost = costs[here]
    if turn >= 0 and (cost < settled or cost > UNKNOWN):
        return
    middle = others.images[size[0] + here]
    grey = window()
    weight = window()
    whole = float(0.0)
    for k in range(SAMPLES):
        x = wp.clamp(j + int(COLUMNS[k]), 0, width - 1)
        y = wp.clamp(i + int(ROWS[k]), 0, height - 1)
        grey[k] = others.images[size[0] + y * width + x]
        weight[k] = wp.exp(-wp.abs(grey[k] - middle) / SIMILAR)
        whole = whole + weight[k]
    mean = float(0.0)
    square = float(0.0)
    for k in range(SAMPLES):
        weight[k] = weight[k] / whole
        mean = mean + weight[k] * grey[k]
        square = square + weight[k] * grey[k] * grey[k]
    variance = square - mean * mean
    if variance < FLAT:
        costs[here] = BLANK
        return
    best = planes[here]
    if turn < 0:
        costs[here] = disagreement(best, u, v, grey, weight, mean, variance, others, UNKNOWN)
        return
    for k in range(4):
        y = int(-1)
        x = int(-1)
        least = float(UNKNOWN)
        for m in range(REACH):
            far = 1 + 4 * m  # odd: of the other colour
            xm = j + far * (wp.where(k == 0, 1, 0) - wp.where(k == 1, 1, 0))
            ym = i + far * (wp.where(k == 2, 1, 0) - wp.where(k == 3, 1, 0))
            if xm >= 0 and ym >= 0 and xm < width and ym < height:
                c = costs[ym * width + xm]
                if c < least:
                    least = c
                    x = xm
                    y = ym
        if y >= 0:
            other = planes[y * width + x]
            w = other[0] + other[1] * float(j - x) + other[2] * float(i - y)
            bend = wp.abs(other[1] - best[1]) + wp.abs(other[2] - best[2])
            new = wp.abs(w - best[0]) + wp.static(1.0 * SIDE) * bend > SAME * best[0]
            if new and w > bounds[0] and w < bounds[1]:
                trial = wp.vec3(w, other[1], other[2])
                c = disagreement(trial, u, v, grey, weight, mean, variance, others, cost)
                if c < cost:
                    cost = c
                    best = trial
    state = wp.rand_init(seed, here * 64 + turn)
    reach = WANDER * wp.pow(0.5, float(turn))
    for k in range(TRIALS):
        w = best[0] * (1.0 + reach * wp.randf(state, -1.0, 1.0))
        if k == 0 and turn == 0 and cost > LOST:
            w = bounds[0] + (bounds[1] - bounds[0]) * wp.randf(state)
        limit = STEEPEST * slope * w
        dx = wp.clamp(best[1] + reach * 4.0 * slope * w * wp.randf(state, -1.0, 1.0), -limit, limit)
        dy = wp.clamp(best[2] + reach * 4.0 * slope * w * wp.randf(state, -1.0, 1.0), -limit, limit)
        if w > bounds[0] and w < bounds[1]:
            trial = wp.vec3(w, dx, dy)
            c = disagreement(trial, u, v, grey, weight, mean, variance, others, cost)
            if c < cost:
                cost = c
                best = trial
        reach = 0.6 * reach
    planes[here] = best
    costs[here] = cost
