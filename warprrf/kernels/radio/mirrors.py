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


IN_PLANE = 1.0e-9  # [m]


@wp.func
def step_back(chains: Chains, link: int, here: wp.vec3d):
    """Where the way from ``here`` to the image of chain ``link`` meets its last patch; whether that is in the box.

    What is no further from the patch's plane than ``IN_PLANE`` is in it: rounding does not decide about a way through
    the edge between two mirrors.
    """
    p = chains.patch[link]
    side = wp.dot(chains.normal[p], here) - chains.plane_offset[p]
    inside = bool(False)
    point = here
    if side > wp.float64(wp.static(IN_PLANE)):
        share = side / wp.max(side + chains.depth[link], wp.float64(1.0e-12))
        point = here + share * (chains.image[link] - here)
        gap = point - chains.middle[p]
        half = chains.half[p]
        inside = wp.abs(gap[0]) <= half[0] and wp.abs(gap[1]) <= half[1] and wp.abs(gap[2]) <= half[2]
    return point, inside


@wp.func
def unfolds(chains: Chains, chain: int, end: wp.vec3d):
    """Whether the mirror points of a chain that ends at ``end`` all lie in the boxes of their patches."""
    here = end
    link = int(chain)
    inside = bool(True)
    while inside and link >= 0:
        here, inside = step_back(chains, link, here)
        link = chains.parent[link]
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


@wp.kernel
def unfold_chains(
    offset: int,
    chains: Chains,
    ends: wp.array(dtype=wp.vec3d),
    end: wp.array(dtype=wp.int32),
    chain: wp.array(dtype=wp.int32),
    point: wp.array2d(dtype=wp.vec3d),
    inside: wp.array(dtype=wp.bool),
):
    """Mirror points, from the transmitter on, of pairs of an end and a chain, and whether all lie in their boxes."""
    k = offset + wp.tid()
    here = ends[end[k]]
    link = int(chain[k])
    kept = bool(True)
    column = int(point.shape[1])
    while kept and link >= 0:
        here, kept = step_back(chains, link, here)
        column -= 1
        point[k, column] = here
        link = chains.parent[link]
    inside[k] = kept
