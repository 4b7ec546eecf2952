"""Chains of mirror patches: which patches a beam from an image can meet next, and chains unfolded to the transmitter.

A chain of k mirrors is its patches in the order in which the wave meets them, the transmitter's image in the last, and a
cone that holds every way from that image through the chain: the narrowest of those through the patches' balls, which
mirrors carry along. All in float64, lengths in metres.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Patches:
    """Planes (``normal . x = plane_offset``), bounding balls and boxes of patches, and a binary tree of boxes.

    Node i of level l of the tree holds the patches ``order[i 2^l]`` to ``order[(i + 1) 2^l]`` (one past); nodes of
    level l start at ``level[l]``. ``box_middle`` and ``box_half`` are those of the patches themselves.
    """

    normal: wp.array(dtype=wp.vec3d)
    plane_offset: wp.array(dtype=wp.float64)
    radius: wp.array(dtype=wp.float64)
    box_middle: wp.array(dtype=wp.vec3d)
    box_half: wp.array(dtype=wp.vec3d)
    order: wp.array(dtype=wp.int32)
    node_middle: wp.array(dtype=wp.vec3d)
    node_half: wp.array(dtype=wp.vec3d)
    level: wp.array(dtype=wp.int32)
    two_sided: wp.bool
    to_edges: wp.bool  # whether ways through an edge between two mirrors are told


@wp.struct
class Cones:
    """A cone for each chain: apex, unit axis and sine of the half-angle; a sine above 1 stands for all space."""

    apex: wp.array(dtype=wp.vec3d)
    axis: wp.array(dtype=wp.vec3d)
    sine: wp.array(dtype=wp.float64)


IN_PLANE = 1.0e-9  # [m]


@wp.func
def cone_meets_ball(
    apex: wp.vec3d, axis: wp.vec3d, sine: wp.float64, centre: wp.vec3d, radius: wp.float64
) -> bool:
    """Whether a cone may meet a ball: its centre is no further than the radius from the line of the nearest side."""
    if sine > wp.float64(1.0):
        return True
    offset = centre - apex
    along = wp.dot(offset, axis)
    across = wp.length(offset - along * axis)
    return across * wp.sqrt(wp.float64(1.0) - sine * sine) - along * sine <= radius


@wp.func
def reach_above(normal: wp.vec3d, plane: wp.float64, middle: wp.vec3d, half: wp.vec3d, side: wp.float64):
    """How far a box reaches to one side (+1 or -1) of a plane [m]; negative if it lies wholly on the other."""
    spread = wp.abs(normal[0]) * half[0] + wp.abs(normal[1]) * half[1] + wp.abs(normal[2]) * half[2]
    return side * (wp.dot(normal, middle) - plane) + spread


@wp.kernel
def extend_chains(
    offset: int,
    patches: Patches,
    last: wp.array(dtype=wp.int32),
    cones: Cones,
    target_middle: wp.vec3d,
    target_radius: wp.float64,
    start: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    patch: wp.array(dtype=wp.int32),
    children: Cones,
):
    """Patches that may follow each chain: counted, and written from ``start`` on where there is room.

    ``last`` is a chain's last patch, -1 for the transmitter itself. Ways behind the new patch must be able to reach the
    ball ``target_middle``, ``target_radius`` (negative: no matter).
    """
    i = offset + wp.tid()
    zero = wp.float64(0.0)
    apex, axis, sine = cones.apex[i], cones.axis[i], cones.sine[i]
    a = last[i]
    ahead = zero  # the side of the last patch on which the way goes on: not its image's
    if a >= 0:
        ahead = -wp.sign(wp.dot(patches.normal[a], apex) - patches.plane_offset[a])
    total = patches.order.shape[0]
    top = patches.level.shape[0] - 1
    level = int(top)
    at = int(0)  # first patch in order that is not done
    found = int(0)
    while at < total:
        node = patches.level[level] + (at >> level)
        middle, half = patches.node_middle[node], patches.node_half[node]
        met = cone_meets_ball(apex, axis, sine, middle, wp.length(half))
        if met and a >= 0:
            met = reach_above(patches.normal[a], patches.plane_offset[a], middle, half, ahead) > zero
        if met and level > 0:
            level -= 1
        else:
            if met:
                b = patches.order[at]
                n, d = patches.normal[b], patches.plane_offset[b]
                height = wp.dot(n, apex) - d
                side = wp.sign(height)
                met = b != a and wp.abs(height) > wp.float64(wp.static(IN_PLANE))
                met = met and (patches.two_sided or height > zero)
                met = met and cone_meets_ball(apex, axis, sine, middle, patches.radius[b])
                if met and a >= 0:
                    met = reach_above(n, d, patches.box_middle[a], patches.box_half[a], side) > zero
                if met:
                    image = apex - wp.float64(2.0) * height * n
                    toward = middle - image
                    far = wp.length(toward)
                    # The last cone, mirrored, or the one through this patch: both hold all ways.
                    beam = axis - wp.float64(2.0) * wp.dot(n, axis) * n
                    narrow = sine
                    if far > patches.radius[b] and patches.radius[b] / far < sine:
                        beam = toward / far
                        narrow = patches.radius[b] / far
                    if target_radius >= zero:
                        met = side * (wp.dot(n, target_middle) - d) > -target_radius
                        met = met and cone_meets_ball(image, beam, narrow, target_middle, target_radius)
                    if met:
                        if start[i] + found < patch.shape[0]:
                            k = start[i] + found
                            parent[k] = i
                            patch[k] = b
                            children.apex[k] = image
                            children.axis[k] = beam
                            children.sine[k] = narrow
                        found += 1
            at = ((at >> level) + 1) << level
            # As high as the next block begins.
            while level < top and (at >> level) % 2 == 0:
                level += 1
    count[i] = found


@wp.func
def step_back(patches: Patches, p: int, here: wp.vec3d, image: wp.vec3d, mirrored: bool):
    """Where the way from ``here``, on the mirror behind where it is ``mirrored``, to ``image`` meets patch p, the image before,
    and whether that is in the patch's box.

    What is no further from the patch's plane than ``IN_PLANE`` is in it: rounding does not decide about a way through
    the edge between two mirrors. Where edges are asked for, it meets the second where it meets the first.
    """
    n = patches.normal[p]
    side = wp.dot(n, here) - patches.plane_offset[p]
    depth = wp.dot(n, image) - patches.plane_offset[p]
    at_edge = wp.abs(side) <= wp.float64(wp.static(IN_PLANE))
    inside = side * depth < wp.float64(0.0)
    if at_edge:
        inside = patches.to_edges and mirrored and wp.abs(depth) > wp.float64(wp.static(IN_PLANE))
    point = here
    if inside:
        if not at_edge:
            point = here + side / (side - depth) * (image - here)
        gap = point - patches.box_middle[p]
        half = patches.box_half[p]
        inside = wp.abs(gap[0]) <= half[0] and wp.abs(gap[1]) <= half[1] and wp.abs(gap[2]) <= half[2]
    return point, image - wp.float64(2.0) * depth * n, inside


@wp.func
def leads_through(
    patches: Patches, patch: wp.array2d(dtype=wp.int32), chain: int, end: wp.vec3d, last_image: wp.vec3d
):
    """Whether the way from ``end`` to the image in the last patch of a chain, unfolded, meets the boxes of all its patches."""
    here = end
    image = last_image
    inside = bool(True)
    column = int(patch.shape[1])
    while inside and column > 0:
        column -= 1
        mirrored = column < patch.shape[1] - 1
        here, image, inside = step_back(patches, patch[chain, column], here, image, mirrored)
    return inside


@wp.kernel
def find_chains(
    offset: int,
    patches: Patches,
    patch: wp.array2d(dtype=wp.int32),
    cones: Cones,
    points: wp.array(dtype=wp.vec3d),
    leaf_middle: wp.array(dtype=wp.vec3d),
    leaf_radius: wp.array(dtype=wp.float64),
    words: wp.array2d(dtype=wp.uint32),
):
    """Which points each of the chains ``patch`` (C, k) reaches through the boxes of its patches: bits, lowest first.

    Points stand in leaves of 32 with a ball around each, which the chain's cone must meet.
    """
    i = offset + wp.tid()
    chain = i / words.shape[1]
    leaf = i % words.shape[1]
    word = wp.uint32(0)
    apex = cones.apex[chain]
    if cone_meets_ball(apex, cones.axis[chain], cones.sine[chain], leaf_middle[leaf], leaf_radius[leaf]):
        for bit in range(wp.min(32, points.shape[0] - 32 * leaf)):
            if leads_through(patches, patch, chain, points[32 * leaf + bit], apex):
                word = word | (wp.uint32(1) << wp.uint32(bit))
    words[chain, leaf] = word


@wp.kernel
def unfold_chains(
    offset: int,
    patches: Patches,
    patch: wp.array2d(dtype=wp.int32),
    image: wp.array(dtype=wp.vec3d),
    ends: wp.array(dtype=wp.vec3d),
    point: wp.array2d(dtype=wp.vec3d),
):
    """Mirror points, from the transmitter on, of chain k that ends at ``ends[k]``."""
    k = offset + wp.tid()
    here = ends[k]
    source = image[k]
    inside = bool(True)
    column = int(patch.shape[1])
    while column > 0:
        column -= 1
        here, source, inside = step_back(patches, patch[k, column], here, source, column < patch.shape[1] - 1)
        point[k, column] = here
