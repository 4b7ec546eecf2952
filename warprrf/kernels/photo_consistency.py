"""Photo consistency of small square patches: do several photos show the same texture there?"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SIDE = 5  # samples along a patch's side
SAMPLES = wp.constant(SIDE * SIDE)
patch = wp.types.vector(length=SIDE * SIDE, dtype=wp.float32)


@wp.func
def bilinear(images: wp.array(dtype=wp.float32), first: int, width: int, u: float, v: float) -> float:
    """Grey value at pixel coordinates (u, v), pixel centres at +0.5; the place must lie inside the photo."""
    x = u - 0.5
    y = v - 0.5
    j = int(wp.floor(x))
    i = int(wp.floor(y))
    fx = x - float(j)
    fy = y - float(i)
    k = first + i * width + j
    top = images[k] * (1.0 - fx) + images[k + 1] * fx
    low = images[k + width] * (1.0 - fx) + images[k + width + 1] * fx
    return top * (1.0 - fy) + low * fy


@wp.kernel
def patch_agreement(
    offset: int,
    centers: wp.array(dtype=wp.vec3),
    first_axis: wp.vec3,
    second_axis: wp.vec3,
    step: float,
    views: wp.array2d(dtype=wp.int32),
    projections: wp.array2d(dtype=wp.vec4),
    images: wp.array(dtype=wp.float32),
    sizes: wp.array(dtype=wp.vec3i),
    agreement: wp.array(dtype=wp.float32),
    contrast: wp.array(dtype=wp.float32),
):
    """Mean normalised cross-correlation over all pairs of views, and the mean contrast of the patch in them.

    ``sizes`` says where each photo begins in ``images``, its width and its height.

    With unit, zero-mean patches p_i of V views, the mean over pairs is (|sum p_i|^2 - V) / (V (V - 1)).
    """
    n = offset + wp.tid()
    center = centers[n]
    total = patch()
    used = int(0)
    spread = float(0.0)
    for s in range(views.shape[1]):
        c = views[n, s]
        if c >= 0:
            shape = sizes[c]
            values = patch()
            mean = float(0.0)
            inside = int(1)
            for k in range(SAMPLES):
                a = float(k % wp.static(SIDE)) - wp.static(0.5 * (SIDE - 1))
                b = float(k // wp.static(SIDE)) - wp.static(0.5 * (SIDE - 1))
                p = center + first_axis * (a * step) + second_axis * (b * step)
                h = wp.vec4(p[0], p[1], p[2], 1.0)
                z = wp.dot(projections[c, 2], h)
                u = wp.dot(projections[c, 0], h) / z
                v = wp.dot(projections[c, 1], h) / z
                right = float(shape[1]) - 0.51
                low = float(shape[2]) - 0.51
                if z > 0.05 and u > 0.5 and v > 0.5 and u < right and v < low:
                    values[k] = bilinear(images, shape[0], shape[1], u, v)
                    mean = mean + values[k]
                else:
                    inside = int(0)
            if inside == 1:
                mean = mean / float(SAMPLES)
                square = float(0.0)
                for k in range(SAMPLES):
                    d = values[k] - mean
                    values[k] = d
                    square = square + d * d
                size = wp.sqrt(square)
                if size > 1.0e-6:
                    total = total + values / size
                    used = used + 1
                    spread = spread + size
    if used > 1:
        count = float(used)
        agreement[n] = (wp.dot(total, total) - count) / (count * (count - 1.0))
        contrast[n] = spread / (count * wp.sqrt(float(SAMPLES)))
    else:
        agreement[n] = float(-1.0)
        contrast[n] = float(0.0)


@wp.kernel
def count_votes(
    offset: int,
    points: wp.array(dtype=wp.vec3),
    ranges: wp.array(dtype=wp.float32),
    projections: wp.array2d(dtype=wp.vec4),
    eyes: wp.array(dtype=wp.vec3),
    sizes: wp.array(dtype=wp.vec3i),
    tolerance: float,
    agreed: wp.array(dtype=wp.int32),
    crossed: wp.array(dtype=wp.int32),
):
    """How many depth maps have the surface that a point lies on, up to a ``tolerance`` of its distance, and how many see
    one behind it.

    ``ranges`` are those of all maps; ``sizes`` says where each begins, its width and its height.
    """
    n = offset + wp.tid()
    point = points[n]
    yes = int(0)
    no = int(0)
    for s in range(sizes.shape[0]):
        place = wp.vec4(point[0], point[1], point[2], 1.0)
        depth = wp.dot(projections[s, 2], place)
        if depth > 0.0:
            shape = sizes[s]
            u = wp.dot(projections[s, 0], place) / depth
            v = wp.dot(projections[s, 1], place) / depth
            if u >= 0.0 and v >= 0.0 and u < float(shape[1]) and v < float(shape[2]):
                seen = ranges[shape[0] + int(v) * shape[1] + int(u)]
                distance = wp.length(point - eyes[s])
                if seen > 0.0 and wp.abs(seen - distance) < tolerance * distance:
                    yes += 1
                elif seen > distance:
                    no += 1
    agreed[n] = yes
    crossed[n] = no
