"""Chains of mirror patches unfolded from where they end back to the transmitter, all pairs of a point and a chain."""

import warp as wp

BLOCK = 512
"""Chains that one thread tries."""


@wp.struct
class Chains:
    """Chains of mirror reflections; each continues another (``parent``, -1: none) by one patch.

    ``image`` is the transmitter's image in the last patch, ``depth`` [m] the height of the image before over its plane.
    Patches have planes (``normal``, ``plane_offset``) and boxes from ``low`` to ``high`` [m].
    """

    patch: wp.array(dtype=wp.int32)
    parent: wp.array(dtype=wp.int32)
    image: wp.array(dtype=wp.vec3d)
    depth: wp.array(dtype=wp.float64)
    normal: wp.array(dtype=wp.vec3d)
    plane_offset: wp.array(dtype=wp.float64)
    low: wp.array(dtype=wp.vec3d)
    high: wp.array(dtype=wp.vec3d)


@wp.func
def unfolds(chains: Chains, chain: int, end: wp.vec3d):
    """Whether the mirror points of a chain that ends at ``end`` all lie in the boxes of their patches."""
    here = end
    link = int(chain)
    inside = bool(True)
    while inside and link >= 0:
        p = chains.patch[link]
        side = wp.dot(chains.normal[p], here) - chains.plane_offset[p]
        if side > wp.float64(0.0):
            share = side / wp.max(side + chains.depth[link], wp.float64(1.0e-12))
            here = here + share * (chains.image[link] - here)
            low = chains.low[p]
            high = chains.high[p]
            for axis in range(3):
                if here[axis] < low[axis] or here[axis] > high[axis]:
                    inside = False
            link = chains.parent[link]
        else:
            inside = False
    return inside


@wp.kernel
def find_chains(
    offset: int,
    chains: Chains,
    first: int,
    last: int,
    points: wp.array(dtype=wp.vec3d),
    start: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    found: wp.array(dtype=wp.int32),
):
    """Counts the chains ``first`` to ``last`` (one past) that reach each point, in blocks; lists them from ``start`` on
    if ``found`` has room."""
    k = offset + wp.tid()
    blocks = (last - first + BLOCK - 1) / BLOCK
    point = points[k / blocks]
    begin = first + (k % blocks) * BLOCK
    number = int(0)
    for chain in range(begin, wp.min(begin + BLOCK, last)):
        if unfolds(chains, chain, point):
            if found.shape[0] > 0:
                found[start[k] + number] = chain - first
            number += 1
    count[k] = number
