"""Ray and closest-point queries on a triangle mesh's bounding volume hierarchy.

Warp keeps mesh geometry in float32, so these kernels answer *which* face; lengths that must be exact are recomputed
in float64 from that face by :class:`warprrf.geometry.mesh.Mesh`.
"""

import warp as wp


@wp.kernel
def cast_rays(
    offset: int,
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    reach: wp.array(dtype=wp.float32),
    distance: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
):
    """Nearest face along each ray within ``reach`` [m]; face -1 where there is none."""
    i = offset + wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], reach[i])
    if query.result:
        distance[i] = query.t
        face[i] = query.face
    else:
        distance[i] = wp.inf
        face[i] = -1


@wp.kernel
def closest_faces(
    offset: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: float,
    face: wp.array(dtype=wp.int32),
):
    """Face nearest to each point within ``reach`` [m], -1 where there is none."""
    i = offset + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], reach)
    if query.result:
        face[i] = query.face
    else:
        face[i] = -1
