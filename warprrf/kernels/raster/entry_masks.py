"""Which blocks of its tile an entry can reach, on a GPU: what :mod:`.project` finds a tile at a time on a CPU."""

from functools import cache
from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import LANES, lanes_of
from warprrf.kernels.raster.project import CUT, FLAT, G0, G1, G2, ROW, rays_of


@cache
def build(real: Any) -> Any:
    """The kernel that finds which blocks of its tile an entry can reach, for one scalar type: a thread per entry."""
    vec3 = wp.types.vector(3, real)
    lanes = lanes_of(real)
    coefficients = wp.types.vector(ROW, real)
    Rays = rays_of(real)

    @wp.func_native("return source.data[i * 4 + which].c[lane];")
    def column_span(source: wp.array(dtype=lanes, ndim=2), i: int, which: int, lane: int) -> real:  # type: ignore[valid-type, empty-body]
        """One number of a contiguous (n, 4) array."""
        ...

    @wp.func_native("return source.data[i * 2 + which].c[lane];")
    def row_span(source: wp.array(dtype=lanes, ndim=2), i: int, which: int, lane: int) -> real:  # type: ignore[valid-type, empty-body]
        """One number of a contiguous (n, 2) array."""
        ...

    @wp.kernel(module="unique", enable_backward=False)
    def entry_masks(
        offset: int,
        rows: wp.array(dtype=coefficients),
        centres: wp.array(dtype=vec3),
        keys: wp.array(dtype=int),
        slots: wp.array(dtype=int),
        whose: wp.array(dtype=int),
        rays: Rays,
        tiles_x: int,
        ids: wp.array(dtype=int),
        masks: wp.array(dtype=int),
    ):
        """Whose entry it is, and a bit for each block of its tile that it can reach, by the bound of
        ``project.block_masks``."""
        j = offset + wp.tid()
        k = whose[slots[j]]
        ids[j] = k
        row = rows[k]
        centre = centres[k]
        x = keys[j] % tiles_x
        y = keys[j] / tiles_x
        outside = real(1.0) - row[CUT] * row[FLAT]
        mask = int(0)
        if outside <= real(0.0):  # from inside the ellipsoid every ray ahead counts
            mask = int(wp.static((1 << LANES) - 1))
        for b in range(wp.static(LANES)):
            u = column_span(rays.columns, x, 0, b)
            hu = column_span(rays.columns, x, 1, b)
            w = column_span(rays.columns, x, 2, b)
            hw = column_span(rays.columns, x, 3, b)
            v = row_span(rays.rows, y, 0, b)
            hv = row_span(rays.rows, y, 1, b)
            pu = wp.clamp(centre[0], u - hu, u + hu)
            pw = wp.clamp(centre[1], w - hw, w + hw)
            pv = wp.clamp(centre[2], v - hv, v + hv)
            g0 = row[G0] * pu + row[G0 + 1] * pw + row[G0 + 2] * pv
            g1 = row[G1] * pu + row[G1 + 1] * pw + row[G1 + 2] * pv
            g2 = row[G2] * pu + row[G2 + 1] * pw + row[G2 + 2] * pv
            s0 = row[CUT] * g0
            s1 = outside * g1
            s2 = outside * g2
            f = s0 * g0 - s1 * g1 - s2 * g2
            su = row[G0] * s0 - row[G1] * s1 - row[G2] * s2
            sw = row[G0 + 1] * s0 - row[G1 + 1] * s1 - row[G2 + 1] * s2
            sv = row[G0 + 2] * s0 - row[G1 + 2] * s1 - row[G2 + 2] * s2
            slope = su * (u - pu) + sw * (w - pw) + sv * (v - pv)
            slope += wp.abs(su) * hu + wp.abs(sw) * hw + wp.abs(sv) * hv
            change = real(2.0) * (wp.abs(row[G0]) * hu + wp.abs(row[G0 + 1]) * hw + wp.abs(row[G0 + 2]) * hv)
            bound = f + real(2.0) * slope + row[CUT] * change * change
            if g0 + change <= real(0.0):  # all behind
                mask = mask & ~(1 << b)
            elif bound > real(0.0):
                mask = mask | (1 << b)
        masks[j] = mask

    return entry_masks
