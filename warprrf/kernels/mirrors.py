"""Chains of mirror patches unfolded from where they end back to the transmitter, all pairs of a point and a chain."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Chains:
    """Chains of mirror reflections; each continues another (``parent``, -1: none) by one patch.

    ``image`` is the transmitter's image in the last patch, ``depth`` [m] the height of the image before over its plane.
    Patches have planes (``normal``, ``plane_offset``) and boxes of ``half`` sizes about ``middle`` [m].
    """

    patch: wp.array(dtype=wp.int32)
    parent: wp.array(dtype=wp.int32)
    image: wp.array(dtype=wp.vec3d)
    depth: wp.array(dtype=wp.float64)
    normal: wp.array(dtype=wp.vec3d)
    plane_offset: wp.array(dtype=wp.float64)
    middle: wp.array(dtype=wp.vec3d)
    half: wp.array(dtype=wp.vec3d)


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
            gap = here - chains.middle[p]
            half = chains.half[p]
            inside = wp.abs(gap[0]) <= half[0] and wp.abs(gap[1]) <= half[1] and wp.abs(gap[2]) <= half[2]
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
    words: wp.array2d(dtype=wp.uint32),
):
    """Which of the chains ``first`` to ``last`` (one past) reach each point: a row of bits, lowest first."""
    k = offset + wp.tid()
    row = k / words.shape[1]
    column = k % words.shape[1]
    point = points[row]
    begin = first + 32 * column
    word = wp.uint32(0)
    for bit in range(wp.min(32, last - begin)):
        if unfolds(chains, begin + bit, point):
            word = word | (wp.uint32(1) << wp.uint32(bit))
    words[row, column] = word
