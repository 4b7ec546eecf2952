"""The materials of ITU-R P.2040, table 3: relative permittivity a f^b and conductivity c f^d [S/m], f in GHz.

Rows stand in the order of their edition, and the first whose band holds a frequency counts. The rows of edition 3
(2023) stand in edition 4 (2025) too, which adds those above 100 GHz and some materials.
"""

from __future__ import annotations

import re

import numpy as np

from warprrf.rf.em.materials import Band, Material

DEFAULT_THICKNESS_M = 0.1  # of a surface whose scene says nothing of it, as in Sionna RT


def _rows(edition: int, *rows: tuple[float, float, float, float, float, float]) -> tuple[Band, ...]:
    source = f"ITU-R P.2040-{edition}, table 3"
    return tuple(Band(low * 1e9, high * 1e9, a, b, c, d, source) for low, high, a, b, c, d in rows)


# low and high end of the band [GHz], a, b, c, d
ITU_BANDS: dict[str, tuple[Band, ...]] = {
    "vacuum": _rows(3, (0.001, 100, 1, 0, 0, 0)),
    "concrete": _rows(3, (1, 100, 5.24, 0, 0.0462, 0.7822)) + _rows(4, (110, 330, 5.17, 0, 0.0145, 1.09)),
    "brick": _rows(3, (1, 40, 3.91, 0, 0.0238, 0.16)) + _rows(4, (110, 330, 4.15, 0, 0.0006, 1.5712)),
    "plasterboard": _rows(3, (1, 100, 2.73, 0, 0.0085, 0.9395))
    + _rows(4, (110, 330, 2.56, 0, 0.0001, 1.7799), (100, 400, 2.65, 0, 0.0002, 1.598)),
    "wood": _rows(3, (0.001, 100, 1.99, 0, 0.0047, 1.0718))
    + _rows(4, (110, 330, 1.82, 0, 0.004, 1.0761), (100, 400, 2.1183, 0, 0.0055, 1.1113)),
    "glass": _rows(3, (0.1, 100, 6.31, 0, 0.0036, 1.3394), (220, 450, 5.79, 0, 0.0004, 1.658))
    + _rows(4, (100, 400, 6.5767, 0, 0.0012, 1.4697)),
    "clear_acrylic": _rows(4, (110, 330, 2.58, 0, 0.0001, 1.6524)),
    "ceiling_board": _rows(3, (1, 100, 1.48, 0, 0.0011, 1.075), (220, 450, 1.52, 0, 0.0029, 1.029))
    + _rows(4, (100, 400, 1.2567, 0, 0.00013, 1.454)),
    "chipboard": _rows(3, (1, 100, 2.58, 0, 0.0217, 0.78)) + _rows(4, (100, 200, 2.16, 0, 0.0023, 1.359)),
    "plywood": _rows(3, (1, 40, 2.71, 0, 0.33, 0))
    + _rows(4, (110, 330, 1.94, 0, 0.0067, 0.9982), (100, 400, 2.17, 0, 0.0063, 1.045)),
    "marble": _rows(3, (1, 60, 7.074, 0, 0.0055, 0.9262))
    + _rows(4, (110, 330, 7.94, 0, 0.0001, 1.733), (100, 400, 8.62, 0, 0.0027, 1.15)),
    "floorboard": _rows(3, (50, 100, 3.66, 0, 0.0044, 1.3515))
    + _rows(
        4,
        (220, 300, 5.27, 0, 2.22e-17, 7.3413),
        (300, 400, 5.27, 0, 0.0003, 2.0298),
        (400, 450, 5.27, 0, 49.8726, 0),
        (100, 400, 3.1575, 0, 0.001675, 1.32775),
    ),
    "vinyl_tile": _rows(4, (1, 40, 3.62, 0, 0.0051, 0.8422)),
    "carpet_tile": _rows(4, (1, 40, 2.08, 0, 0.0009, 0.82)),
    "asphalt_concrete": _rows(4, (1, 40, 4.83, 0, 0.0108, 1.3969)),
    "metal": _rows(3, (1, 100, 1, 0, 1e7, 0)),
    "very_dry_ground": _rows(3, (1, 10, 3, 0, 0.00015, 2.52)),
    "medium_dry_ground": _rows(3, (1, 10, 15, -0.1, 0.035, 1.63)),
    "wet_ground": _rows(3, (1, 10, 30, -0.4, 0.15, 1.3)),
}

BUILDING = (
    "concrete", "brick", "plasterboard", "wood", "glass", "ceiling_board", "chipboard", "plywood", "marble", "floorboard",
)  # fmt: skip
"""What rooms are made of."""


def itu_name(name: str) -> str | None:
    """The P.2040 material that a scene's identifier names, or None.

    Blender writes ``mat-itu_concrete`` for ``itu_concrete``, and ``mat-itu_concrete.001`` for a second one.
    """
    plain = re.sub(r"\.\d{3}$", "", name.removeprefix("mat-"))
    plain = plain[4:] if plain.startswith(("itu_", "itu-")) else plain
    return plain if plain in ITU_BANDS else None


def itu_material(
    itu: str,
    *,
    name: str | None = None,
    thickness_m: float = DEFAULT_THICKNESS_M,
    scattering: float = 0.0,
    pattern: str = "lambertian",
    alpha_r: int = 4,
    xpd: float = 0.0,
) -> Material:
    """A material of ITU-R P.2040, such as ``itu_material("concrete", thickness_m=0.2)``.

    Args:
        itu: its name in the recommendation: ``"concrete"``, ``"medium_dry_ground"``; ``mat-itu_`` before it is allowed.
        name: the material's name; that of the recommendation by default.
        thickness_m, scattering, pattern, alpha_r, xpd: as of :class:`Material`; P.2040 says nothing of them.

    Raises:
        ValueError: for a name that the recommendation does not have, and as :class:`Material`.
    """
    known = itu_name(itu) if isinstance(itu, str) else None
    if known is None:
        raise ValueError(
            f"itu: got {itu!r}, expected a material of ITU-R P.2040: {', '.join(sorted(ITU_BANDS))}"
        )
    return Material(
        name=known if name is None else name,
        bands=ITU_BANDS[known],
        thickness_m=thickness_m,
        scattering=scattering,
        pattern=pattern,
        alpha_r=alpha_r,
        xpd=xpd,
        itu=known,
    )


def assumed_permittivity(name: str, frequency_hz: float) -> float:
    """Magnitude of the relative permittivity that a surface called ``name`` is taken for before any measurement: that of
    P.2040's material of this name, else the geometric mean of those that rooms are made of, less one."""
    known = itu_name(name)
    names = BUILDING if known is None else (known,)
    found = [abs(itu_material(one).extrapolated().permittivity(frequency_hz)) for one in names]
    return 1.0 + float(np.exp(np.mean(np.log(np.maximum(np.array(found) - 1.0, 1e-3)))))
