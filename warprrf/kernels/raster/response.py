"""What kernels that walk the Gaussians of a block of pixels share: linear forms, response, transmittance, places."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warprrf.kernels.raster.lanes import BLOCK, LANES, lanes_of
from warprrf.kernels.raster.lanes import build as lane_functions
from warprrf.kernels.raster.project import G0, G1, G2, PRODUCT, ROW, TILE, View


@cache
def build(real: Any, rule: int) -> SimpleNamespace:
    """The functions for one scalar type, ``wp.float32`` or ``wp.float64``, and one transmittance rule."""
    lanes = lanes_of(real)
    coefficients = wp.types.vector(ROW, real)
    of = lane_functions(real)
    higher, roots = of.higher, of.roots
    tiny = 1.0e-30 if real is wp.float32 else 1.0e-250

    if real is wp.float32:

        @wp.func
        def response(q: lanes):
            """exp(-q/2) for 0 <= q <= 80: (Taylor of exp(-q/32), degree 5)^16; absolute error below 1e-6."""
            x = q * real(-0.03125)
            p = lanes(real(1.0 / 24.0)) + x * real(1.0 / 120.0)
            p = lanes(real(1.0 / 6.0)) + wp.cw_mul(x, p)
            p = lanes(real(0.5)) + wp.cw_mul(x, p)
            p = lanes(real(1.0)) + wp.cw_mul(x, p)
            p = lanes(real(1.0)) + wp.cw_mul(x, p)
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            p = wp.cw_mul(p, p)
            return wp.cw_mul(p, p)

    else:

        @wp.func
        def response(q: lanes):
            out = lanes()
            for k in range(wp.static(LANES)):
                out[k] = wp.exp(real(-0.5) * q[k])
            return out

    @wp.func
    def forms(row: coefficients, across: lanes, along: lanes, down: lanes):
        """g0, g1, g2 on the rays of a block; the last two times |M m|."""
        g0 = row[G0] * across + row[G0 + 1] * along + row[G0 + 2] * down
        g1 = row[G1] * across + row[G1 + 1] * along + row[G1 + 2] * down
        g2 = row[G2] * across + row[G2 + 1] * along + row[G2 + 2] * down
        return g0, g1, g2

    @wp.func
    def place_of(block: int, view: View):
        """Column and row of a block, in blocks."""
        tile = block / wp.static(LANES)
        b = block % wp.static(LANES)
        column = (tile % view.tiles_x) * wp.static(TILE // BLOCK) + b % wp.static(TILE // BLOCK)
        line = (tile / view.tiles_x) * wp.static(TILE // BLOCK) + b / wp.static(TILE // BLOCK)
        return column, line

    if rule == PRODUCT:

        @wp.func
        def thinned(transmittance: lanes, alpha: lanes, weight: lanes):
            """What is left behind a layer; ``weight`` is alpha times transmittance."""
            return transmittance - weight

        @wp.func
        def behind(goal: lanes, alpha: lanes):
            """How the light from behind a layer changes with its alpha."""
            return wp.cw_div(goal, higher(lanes(real(1.0)) - alpha, lanes(real(wp.static(tiny)))))

    else:

        @wp.func
        def thinned(transmittance: lanes, alpha: lanes, weight: lanes):
            return wp.cw_mul(transmittance, response(real(2.0) * alpha))

        @wp.func
        def behind(goal: lanes, alpha: lanes):
            return goal

    @wp.func
    def ray_lengths(across: lanes, along: lanes, down: lanes):
        return roots(wp.cw_mul(across, across) + wp.cw_mul(along, along) + wp.cw_mul(down, down))

    return SimpleNamespace(
        behind=behind,
        forms=forms,
        place_of=place_of,
        ray_lengths=ray_lengths,
        response=response,
        thinned=thinned,
        tiny=tiny,
    )
