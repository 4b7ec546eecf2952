"""How a source illuminates what rays hit, whatever the materials. Places are float64, angles in the precision asked for."""

from typing import Any

import warp as wp

from warprrf.cache import once


@once
def build(real: type) -> Any:
    """The kernel ``illuminate`` with angles in precision ``real``."""
    vec3 = wp.types.vector(3, real)

    @wp.kernel(module="unique", enable_backward=False)
    def illuminate(
        offset: int,
        flat_normal: wp.array(dtype=wp.vec3d),
        normal: wp.array(dtype=vec3),
        ray: wp.array(dtype=wp.int32),
        source: wp.array(dtype=wp.vec3d),
        origins: wp.array(dtype=wp.vec3d),
        per_origin: int,
        directions: wp.array(dtype=wp.vec3d),
        face: wp.array(dtype=wp.int32),
        range_m: wp.array(dtype=wp.float64),
        solid_angle: wp.array(dtype=real),
        nearest: real,
        loss: real,
        strength: wp.array(dtype=real),
        angle: wp.array(dtype=vec3),
        point: wp.array(dtype=wp.vec3d),
    ):
        """How transmitters at ``source``, one for all or one for each row, illuminate what rays hit, shadows apart.

        Row k is of ray ``ray[k]``, or of ray k if that is empty. Ray r starts at origin r / per_origin; ``directions``
        holds one for each ray, or one set for every origin. ``flat_normal`` and ``normal`` are of faces; scattering uses
        the latter. Writes ``strength`` = Omega cos(theta_i) / (4 pi d1)^2 [sr/m^2] less what air of ``loss`` [neper/m]
        absorbs from the source over the hit to the ray's origin; cosines of incidence, of scattering and of the angle to
        the mirror direction; and where the ray hits [m]. ``nearest`` [m] bounds d1 from below: an element at the source
        spans directions.
        """
        k = offset + wp.tid()
        strength[k] = real(0.0)
        r = k
        if ray.shape[0] > 0:
            r = ray[k]
        f = face[r]
        if f >= 0:
            d = directions[r % directions.shape[0]]
            met = origins[r / per_origin] + range_m[r] * d
            way = source[wp.min(k, source.shape[0] - 1)] - met
            d1 = real(wp.length(way))
            toward = vec3(way) / wp.max(d1, real(1.0e-9))
            back = -vec3(d)
            n = normal[f]
            cos_s = wp.dot(n, back)
            if wp.dot(vec3(flat_normal[f]), back) < real(0.0):
                n = -n
                cos_s = -cos_s
            cos_s = wp.max(cos_s, real(0.0))  # a smoothed normal may turn away from who sees the face
            cos_i = wp.dot(n, toward)
            if cos_i > real(0.0) and d1 > real(0.0):
                point[k] = met
                reach = wp.max(d1, nearest)
                air = wp.exp(-loss * (d1 + real(range_m[r])))
                share = solid_angle[r % solid_angle.shape[0]]
                strength[k] = air * share * cos_i / (real(157.91367041742973) * reach * reach)
                cos_mirror = wp.clamp(real(2.0) * cos_i * cos_s - wp.dot(toward, back), real(-1.0), real(1.0))
                angle[k] = vec3(wp.min(cos_i, real(1.0)), wp.min(cos_s, real(1.0)), cos_mirror)

    return illuminate
