"""Which edges a point and an image of another one can reach each other over: Keller's point, and the mirrors on the way.

A wave that meets a straight edge goes on along a cone, at equal angles with the edge: unrolled about the edge, the way is
straight. All in float64, lengths in metres.
"""

import warp as wp

from warprrf.kernels.radio.mirrors import Cones, Patches, cone_meets_ball, leads_through

wp.set_module_options({"enable_backward": False})


@wp.struct
class EdgePieces:
    """Pieces of edges in leaves of 32 neighbours: ends, unit vectors, outer normals of both faces; and balls around leaves."""

    start: wp.array(dtype=wp.vec3d)
    along: wp.array(dtype=wp.vec3d)
    length: wp.array(dtype=wp.float64)
    first: wp.array(dtype=wp.vec3d)
    last: wp.array(dtype=wp.vec3d)
    leaf_middle: wp.array(dtype=wp.vec3d)
    leaf_radius: wp.array(dtype=wp.float64)


@wp.func
def in_air(pieces: EdgePieces, k: int, way: wp.vec3d):
    """Whether ``way`` from the edge leads through the air: not below both faces."""
    return wp.dot(pieces.first[k], way) >= wp.float64(0.0) or wp.dot(pieces.last[k], way) >= wp.float64(0.0)


@wp.kernel
def find_over_edges(
    offset: int,
    patches: Patches,
    patch: wp.array2d(dtype=wp.int32),
    cones: Cones,
    pieces: EdgePieces,
    target: wp.vec3d,
    slack: wp.float64,
    words: wp.array2d(dtype=wp.uint32),
):
    """Over which pieces each of the chains ``patch`` (C, k) reaches ``target``, through the boxes of its patches: bits,
    lowest first. Pieces are longer by ``slack`` [m] at both ends."""
    i = offset + wp.tid()
    chain = i / words.shape[1]
    leaf = i % words.shape[1]
    word = wp.uint32(0)
    apex = cones.apex[chain]
    if cone_meets_ball(
        apex, cones.axis[chain], cones.sine[chain], pieces.leaf_middle[leaf], pieces.leaf_radius[leaf]
    ):
        for bit in range(wp.min(32, pieces.length.shape[0] - 32 * leaf)):
            k = 32 * leaf + bit
            e = pieces.along[k]
            a = apex - pieces.start[k]
            b = target - pieces.start[k]
            inside = in_air(pieces, k, a) and in_air(pieces, k, b)
            if inside:
                za = wp.dot(a, e)
                zb = wp.dot(b, e)
                ra = wp.length(a - za * e)
                rb = wp.length(b - zb * e)
                z = (za * rb + zb * ra) / (ra + rb)
                inside = z >= -slack and z <= pieces.length[k] + slack
                inside = inside and leads_through(patches, patch, chain, pieces.start[k] + z * e, apex)
            if inside:
                word = word | (wp.uint32(1) << wp.uint32(bit))
    words[chain, leaf] = word
