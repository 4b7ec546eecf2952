"""Blending weights of one receiver as sparse rows, one a pixel, and the points that its rays meet.

Lists of each pixel's largest weights, front to back with room for K, become rows ``start[p]`` to ``start[p + 1]`` of
pairs (Gaussian, weight). Sums over a pixel are float64.
"""

import warp as wp

from warprrf.kernels.raster.view import rotation_matrix

CENTRE, ALONG = 0, 1  # the centre of a Gaussian, or a range along the ray


@wp.func
def is_kept(index: int, weight: wp.float32, least: wp.float64):
    """Whether a listed weight stays: it is above ``least``."""
    return index >= 0 and weight > wp.float32(0.0) and wp.float64(weight) > least


@wp.func
def listed_sum(
    index: wp.array3d(dtype=int), weight: wp.array3d(dtype=wp.float32), y: int, x: int, least: wp.float64
):
    """Sum of a pixel's listed weights above ``least``."""
    total = wp.float64(0.0)
    for k in range(index.shape[2]):
        if is_kept(index[y, x, k], weight[y, x, k], least):
            total += wp.float64(weight[y, x, k])
    return total


@wp.kernel(enable_backward=False)
def count_kept(
    offset: int,
    share: wp.float64,
    index: wp.array3d(dtype=int),
    weight: wp.array3d(dtype=wp.float32),
    distance: wp.array3d(dtype=wp.float32),
    count: wp.array(dtype=int),
    dominant: wp.array(dtype=int),
    expected: wp.array(dtype=wp.float64),
):
    """Of a pixel: how many weights are above ``share`` of their sum, the Gaussian of the largest (-1 without any), and the
    blended mean of the ranges [m] (NaN)."""
    p = offset + wp.tid()
    y = p / index.shape[1]
    x = p % index.shape[1]
    least = share * listed_sum(index, weight, y, x, wp.float64(0.0))
    found = int(0)
    owner = int(-1)
    best = wp.float32(0.0)
    kept = wp.float64(0.0)
    far = wp.float64(0.0)
    for k in range(index.shape[2]):
        w = weight[y, x, k]
        if is_kept(index[y, x, k], w, least):
            found += 1
            kept += wp.float64(w)
            far += wp.float64(w) * wp.float64(distance[y, x, k])
            if w > best:
                best = w
                owner = index[y, x, k]
    count[p] = found
    dominant[p] = owner
    expected[p] = wp.where(found > 0, far / kept, wp.float64(wp.nan))


@wp.kernel(enable_backward=False)
def write_weights(
    offset: int,
    share: wp.float64,
    index: wp.array3d(dtype=int),
    weight: wp.array3d(dtype=wp.float32),
    alpha: wp.array2d(dtype=wp.float32),
    start: wp.array(dtype=int),
    gaussian: wp.array(dtype=int),
    out: wp.array(dtype=wp.float32),
):
    """A pixel's row: the weights above ``share`` of their sum, which take over what the others and those beyond the list
    have of the sum ``alpha`` of all."""
    p = offset + wp.tid()
    y = p / index.shape[1]
    x = p % index.shape[1]
    total = listed_sum(index, weight, y, x, wp.float64(0.0))
    least = share * total
    scale = wp.max(total, wp.float64(alpha[y, x])) / listed_sum(index, weight, y, x, least)
    at = start[p]
    for k in range(index.shape[2]):
        if is_kept(index[y, x, k], weight[y, x, k], least):
            gaussian[at] = index[y, x, k]
            out[at] = wp.float32(scale * wp.float64(weight[y, x, k]))
            at += 1


@wp.kernel(enable_backward=False)
def write_responses(
    offset: int,
    index: wp.array3d(dtype=int),
    weight: wp.array3d(dtype=wp.float32),
    opacity: wp.array(dtype=wp.float32),
    start: wp.array(dtype=int),
    gaussian: wp.array(dtype=int),
    out: wp.array(dtype=wp.float32),
):
    """A pixel's row: the response of each listed Gaussian, from the weights that ``opacity`` gives by the ``product`` rule."""
    p = offset + wp.tid()
    y = p / index.shape[1]
    x = p % index.shape[1]
    at = start[p]
    left = wp.float64(1.0)
    for k in range(index.shape[2]):
        if is_kept(index[y, x, k], weight[y, x, k], wp.float64(0.0)):
            w = wp.float64(weight[y, x, k])
            alpha = w / wp.max(left, wp.float64(1.0e-12))
            gaussian[at] = index[y, x, k]
            out[at] = wp.float32(wp.min(alpha / wp.float64(opacity[index[y, x, k]]), wp.float64(1.0)))
            left -= w
            at += 1


@wp.kernel(enable_backward=False)
def sum_rows(
    offset: int,
    start: wp.array(dtype=int),
    weight: wp.array(dtype=wp.float32),
    out: wp.array(dtype=wp.float64),
):
    """Sum of a pixel's weights."""
    p = offset + wp.tid()
    total = wp.float64(0.0)
    for e in range(start[p], start[p + 1]):
        total += wp.float64(weight[e])
    out[p] = total


@wp.func
def peak_range(origin: wp.vec3d, direction: wp.vec3d, mean: wp.vec3, quaternion: wp.vec4, scale: wp.vec3):
    """Range [m] at which a Gaussian's response peaks on a ray: t* = -(o.g) / (g.g)."""
    turned = wp.transpose(rotation_matrix(wp.vec4d(quaternion)))
    g = wp.cw_div(turned * direction, wp.vec3d(scale))
    o = wp.cw_div(turned * (origin - wp.vec3d(mean)), wp.vec3d(scale))
    return -wp.dot(o, g) / wp.dot(g, g)


@wp.kernel(enable_backward=False)
def single_bounces(
    offset: int,
    kind: int,
    receiver: wp.vec3d,
    transmitter: wp.vec3d,
    directions: wp.array(dtype=wp.vec3d),
    means: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    scales: wp.array(dtype=wp.vec3),
    dominant: wp.array(dtype=int),
    ranges: wp.array(dtype=wp.float64),
    point: wp.array(dtype=wp.vec3d),
    length: wp.array(dtype=wp.float64),
):
    """Where a pixel's ray meets the geometry [m], and the length from transmitter to receiver by there; NaN where it meets
    nothing. ALONG the ray that is at ``ranges`` [m], where these are finite, else at the dominant Gaussian's peak."""
    i = offset + wp.tid()
    owner = dominant[i]
    p = wp.vec3d(wp.float64(wp.nan))
    t = wp.float64(wp.nan)
    if ranges.shape[0] > 0:
        t = ranges[i]
    if kind == wp.static(CENTRE):
        if owner >= 0:
            p = wp.vec3d(means[owner])
    else:
        if not wp.isfinite(t) and owner >= 0:
            t = peak_range(receiver, directions[i], means[owner], quaternions[owner], scales[owner])
        if wp.isfinite(t):
            p = receiver + t * directions[i]
    point[i] = p
    length[i] = wp.length(p - transmitter) + wp.length(p - receiver)


@wp.kernel(enable_backward=False)
def mark_seen(offset: int, gaussian: wp.array(dtype=int), seen: wp.array(dtype=int)):
    """1 for the Gaussian of every pair: whoever writes, writes the same."""
    seen[gaussian[offset + wp.tid()]] = 1


@wp.kernel(enable_backward=False)
def gather_pairs(
    offset: int,
    first_pixel: int,
    first_pair: int,
    start: wp.array(dtype=int),
    gaussian: wp.array(dtype=int),
    row: wp.array(dtype=int),
    pixel_start: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    keys: wp.array(dtype=int),
    order: wp.array(dtype=int),
):
    """A receiver's pixels and pairs as those of a batch from ``first_pixel`` and ``first_pair`` on: where a pixel's pairs begin,
    and of each pair its pixel, and its row, to sort them by. There is one thread more than pixels."""
    p = offset + wp.tid()
    pixel_start[first_pixel + p] = first_pair + start[p]
    if p + 1 < start.shape[0]:
        for e in range(first_pair + start[p], first_pair + start[p + 1]):
            pixel[e] = first_pixel + p
            keys[e] = row[gaussian[e - first_pair]]
            order[e] = e


@wp.kernel(enable_backward=False)
def sorted_pairs(
    offset: int,
    pixels: int,
    order: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    place: wp.array(dtype=int),
    pair_pixel: wp.array(dtype=int),
    pair_direction: wp.array(dtype=int),
):
    """Where a pair has come to in ``order``, and its pixel there, of the batch and of its receiver, which has ``pixels``."""
    e = offset + wp.tid()
    p = pixel[order[e]]
    place[order[e]] = e
    pair_pixel[e] = p
    pair_direction[e] = p % pixels
