"""The lobby's radio materials: ITU-R P.2040-4 rows above 100 GHz where there are any, and what we assume beside them.

Measured scattering coefficients above 100 GHz are scarce, so scattering follows from a roughness, which is assumed for
each material as are its thickness and scattering pattern. Polished stone, glass and metal are smooth (mirrors at
300 GHz), concrete, brick, plaster and cloth are rough.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

RECOMMENDATION = "ITU-R P.2040-4, table 3"
ASSUMED = "assumed"

Row = tuple[float, float, float, float, float, float, str]
"""Band [GHz] from, to; a, b, c, d; source."""


@dataclass(frozen=True)
class _Entry:
    name: str
    description: str
    rows: tuple[Row, ...]
    thickness_m: float
    roughness_m: float
    pattern: str = "lambertian"
    alpha_r: int | None = None
    custom: bool = False


def _itu(low: float, high: float, a: float, c: float, d: float) -> Row:
    return (low, high, a, 0.0, c, d, RECOMMENDATION)


ENTRIES = (
    _Entry(
        "marble",
        "polished stone",
        (_itu(110, 330, 7.94, 0.0001, 1.733), _itu(100, 400, 8.62, 0.0027, 1.15)),
        0.03,
        0.015e-3,
        "directive",
        10,
    ),
    _Entry(
        "ceiling_board",
        "mineral board",
        (_itu(220, 450, 1.52, 0.0029, 1.029), _itu(100, 400, 1.2567, 0.00013, 1.454)),
        0.015,
        0.10e-3,
    ),
    _Entry(
        "concrete",
        "fair-faced concrete",
        (_itu(110, 330, 5.17, 0.0145, 1.09),),
        0.25,
        0.10e-3,
        "directive",
        4,
    ),
    _Entry("brick", "bare brick", (_itu(110, 330, 4.15, 0.0006, 1.5712),), 0.25, 0.12e-3),
    _Entry(
        "glass",
        "float glass, one pane",
        (_itu(220, 450, 5.79, 0.0004, 1.658), _itu(100, 400, 6.5767, 0.0012, 1.4697)),
        0.01,
        0.01e-3,
        "directive",
        10,
    ),
    _Entry(
        "plasterboard",
        "painted board",
        (_itu(110, 330, 2.56, 0.0001, 1.7799), _itu(100, 400, 2.65, 0.0002, 1.598)),
        0.0125,
        0.06e-3,
        "directive",
        4,
    ),
    _Entry(
        "wood",
        "oiled wood",
        (_itu(110, 330, 1.82, 0.0040, 1.0761), _itu(100, 400, 2.1183, 0.0055, 1.1113)),
        0.02,
        0.05e-3,
        "directive",
        4,
    ),
    _Entry(
        "plywood",
        "raw plywood",
        (_itu(110, 330, 1.94, 0.0067, 0.9982), _itu(100, 400, 2.17, 0.0063, 1.045)),
        0.02,
        0.06e-3,
        "directive",
        4,
    ),
    _Entry(
        "carpet_tile",
        "carpet and upholstery",
        (
            (
                *(100.0, 400.0, 2.08, 0.0, 0.0009, 0.82),
                f"assumed: the 1 to 40 GHz row of {RECOMMENDATION} (carpet tile), carried up; none above 40 GHz exists",
            ),
        ),
        0.01,
        0.12e-3,
        custom=True,
    ),
    _Entry(
        "metal",
        "brushed sheet",
        (
            (
                *(1.0, 1000.0, 1.0, 0.0, 1e7, 0.0),
                f"assumed: the 1 to 100 GHz row of {RECOMMENDATION} (metal, 1e7 S/m), carried up",
            ),
        ),
        0.002,
        0.02e-3,
        "directive",
        10,
        custom=True,
    ),
)


def material_table() -> dict[str, Any]:
    """The contents of ``materials.json``; see :func:`warprrf.rf.em.materials.load_materials`."""
    return {
        "about": [
            "Radio materials of the lobby. Relative permittivity a f^b, conductivity c f^d [S/m], f in GHz;",
            "a row holds in its band only, and the first row whose band holds the frequency counts (as in Sionna RT).",
            "Scattering coefficient S from the rms roughness sigma_h at normal incidence: S^2 = 1 - rho^2,",
            "rho = exp(-8 (pi sigma_h / lambda)^2). Nothing was measured on a lobby: thickness, roughness and",
            "pattern are assumed.",
        ],
        "materials": [
            {
                "name": entry.name,
                "itu": None if entry.custom else entry.name,
                "description": entry.description,
                "permittivity": [
                    dict(zip(("low_ghz", "high_ghz", "a", "b", "c", "d", "source"), row, strict=True))
                    for row in entry.rows
                ],
                "thickness_m": {"value": entry.thickness_m, "source": ASSUMED},
                "roughness_m": {"value": entry.roughness_m, "source": f"{ASSUMED}: {entry.description}"},
                "pattern": {"value": entry.pattern, "source": ASSUMED}
                | ({} if entry.alpha_r is None else {"alpha_r": entry.alpha_r}),
            }
            for entry in ENTRIES
        ],
    }
