"""A photo cut into segments of like colour (Felzenszwalb and Huttenlocher, "Efficient graph-based image segmentation", 2004).

One edge after another decides, so one thread walks through a photo.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def root(parent: wp.array(dtype=wp.int32), pixel: int) -> int:
    """The pixel that stands for the segment of ``pixel``."""
    k = int(pixel)
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@wp.kernel
def cut(
    offset: int,
    first: wp.array(dtype=wp.int32),
    second: wp.array(dtype=wp.int32),
    difference: wp.array(dtype=wp.float32),
    order: wp.array(dtype=wp.int32),
    coarseness: float,
    least: int,
    parent: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    within: wp.array(dtype=wp.float32),
):
    """Join the segments of neighbours ``first`` and ``second``, in the ``order`` of their difference: where it is less than
    the largest one within either segment plus ``coarseness`` over its size; then those of fewer pixels than ``least``.

    Before, each pixel is its own ``parent`` and a segment of ``size`` one; afterwards ``parent`` is the segment's root.
    """
    for turn in range(2):
        for e in range(order.shape[0]):
            edge = order[e]
            a = root(parent, first[edge])
            b = root(parent, second[edge])
            if a != b:
                value = difference[edge]
                joins = bool(size[a] < least or size[b] < least)
                if turn == 0:
                    joins = value < wp.min(
                        within[a] + coarseness / float(size[a]), within[b] + coarseness / float(size[b])
                    )
                if joins:
                    low = wp.min(a, b)
                    parent[wp.max(a, b)] = low
                    size[low] = size[a] + size[b]
                    within[low] = value
    for pixel in range(parent.shape[0]):
        parent[pixel] = root(parent, pixel)
