"""Which pairs of patches may carry a double mirror reflection to which receiver: balls around patches, float64.

Seen from the transmitter's image in the first patch, a ray through that patch's ball must meet the second's ball; seen
from the image of that image in the second patch, the ray to the receiver must pass the balls of both. What is left is
a superset of the true pairs, to be tested on the patches themselves.
"""

from __future__ import annotations

import warp as wp


@wp.func
def cone_touches(
    apex: wp.vec3d, axis: wp.vec3d, sine: wp.float64, centre: wp.vec3d, radius: wp.float64
) -> bool:
    """Whether the cone with half-angle asin(``sine``) meets a ball: d_across cos - d_along sin <= radius."""
    offset = centre - apex
    along = wp.dot(offset, axis)
    across = wp.length(offset - along * axis)
    return across * wp.sqrt(wp.float64(1.0) - sine * sine) - along * sine <= radius


@wp.kernel
def mirror_pairs(
    offset: int,
    first_patch: wp.array(dtype=int),
    image: wp.array(dtype=wp.vec3d),
    height: wp.array(dtype=wp.float64),
    normal: wp.array(dtype=wp.vec3d),
    plane: wp.array(dtype=wp.float64),
    centre: wp.array(dtype=wp.vec3d),
    radius: wp.array(dtype=wp.float64),
    receivers: wp.array(dtype=wp.vec3d),
    leaf_start: wp.array(dtype=int),
    leaf_centre: wp.array(dtype=wp.vec3d),
    leaf_radius: wp.array(dtype=wp.float64),
    slack: wp.float64,
    start: wp.array(dtype=int),
    count: wp.array(dtype=int),
    found: wp.array(dtype=int, ndim=2),
):
    """Triples (first, second, receiver) of one first patch: counted, and written from ``start`` where there is room."""
    i = offset + wp.tid()
    a = first_patch[i]
    zero = wp.float64(0.0)
    two = wp.float64(2.0)
    apex = image[a]
    toward = centre[a] - apex
    far = wp.length(toward)
    wide = far <= radius[a]
    axis = wp.vec3d()
    sine = zero
    if not wide:
        axis = toward / far
        sine = radius[a] / far
    n = int(0)
    for b in range(normal.shape[0]):
        if b == a:
            continue
        # The second lies, in part at least, on the transmitter's side of the first's plane.
        if wp.sign(height[a]) * (wp.dot(normal[a], centre[b]) - plane[a]) <= -radius[b]:
            continue
        if not wide:
            if not cone_touches(apex, axis, sine, centre[b], radius[b]):
                continue
        h = wp.dot(normal[b], apex) - plane[b]
        if h == zero:
            continue
        source = apex - two * h * normal[b]
        mirrored = centre[a] - two * (wp.dot(normal[b], centre[a]) - plane[b]) * normal[b]
        # The narrower of the two balls bounds the cone towards the receivers.
        target = centre[b]
        reach = radius[b]
        if radius[a] * wp.length(centre[b] - source) < radius[b] * wp.length(mirrored - source):
            target = mirrored
            reach = radius[a]
        span = wp.length(target - source)
        open = span <= reach
        beam = wp.vec3d()
        narrow = zero
        if not open:
            beam = (target - source) / span
            narrow = reach / span
        for leaf in range(leaf_centre.shape[0]):
            if not open:
                if not cone_touches(source, beam, narrow, leaf_centre[leaf], leaf_radius[leaf]):
                    continue
            for r in range(leaf_start[leaf], leaf_start[leaf + 1]):
                point = receivers[r]
                below = wp.dot(normal[b], point) - plane[b]
                if h * below <= zero:
                    continue
                # The image lies -h, the receiver ``below`` from the second's plane; they face each other across it.
                last = source + (h / (h + below)) * (point - source)
                if wp.length(last - centre[b]) > radius[b] + slack:
                    continue
                side = wp.dot(normal[a], last) - plane[a]
                if side * height[a] <= zero:
                    continue
                first = apex + (height[a] / (height[a] + side)) * (last - apex)
                if wp.length(first - centre[a]) > radius[a] + slack:
                    continue
                if start[i] + n < found.shape[0]:
                    found[start[i] + n, 0] = a
                    found[start[i] + n, 1] = b
                    found[start[i] + n, 2] = r
                n += 1
    count[i] = n
