"""Whether points lie in planar patches of a mesh. Lengths in metres."""

import warp as wp


@wp.struct
class PatchFaces:
    """Planar patches and their faces, patch by patch.

    Attributes:
        ends: Where each patch's faces begin, and the last one's end.
        normal: Unit normal of each patch.
        low, high: Corners of each patch's box [m].
        corners: Corners of each face [m].
        face_low, face_high: Corners of the box of what is taken for each face [m].
    """

    ends: wp.array(dtype=wp.int32)
    normal: wp.array(dtype=wp.vec3d)
    low: wp.array(dtype=wp.vec3d)
    high: wp.array(dtype=wp.vec3d)
    corners: wp.array2d(dtype=wp.vec3d)
    face_low: wp.array(dtype=wp.vec3d)
    face_high: wp.array(dtype=wp.vec3d)


@wp.func
def in_box(p: wp.vec3d, low: wp.vec3d, high: wp.vec3d):
    """Whether ``p`` lies in a box or on it; one that is not a number does not."""
    inside = bool(True)
    for axis in range(3):
        inside = inside and low[axis] <= p[axis] and p[axis] <= high[axis]
    return inside


@wp.kernel(enable_backward=False)
def lie_in_patches(
    offset: int,
    faces: PatchFaces,
    slack: wp.float64,
    patch: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3d),
    inside: wp.array(dtype=wp.bool),
):
    """Whether each point, seen along its patch's normal, lies in one of the patch's faces, or no further than ``slack`` [m]
    from each of a face's sides."""
    i = offset + wp.tid()
    k = patch[i]
    p = points[i]
    found = bool(False)
    if in_box(p, faces.low[k], faces.high[k]):
        normal = faces.normal[k]
        f = faces.ends[k]
        while f < faces.ends[k + 1] and not found:
            if in_box(p, faces.face_low[f], faces.face_high[f]):
                least = wp.float64(wp.inf)
                most = wp.float64(-wp.inf)
                for side in range(3):
                    start = faces.corners[f, side]
                    edge = faces.corners[f, (side + 1) % 3] - start
                    length = wp.max(wp.length(edge), wp.float64(1e-300))
                    depth = wp.dot(wp.cross(normal, edge), p - start) / length
                    least = wp.min(least, depth)
                    most = wp.max(most, depth)
                found = least >= -slack or most <= slack
            f += 1
    inside[i] = found
