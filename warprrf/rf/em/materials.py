r"""Radio materials: permittivity by band, slab thickness, and scattering from surface roughness.

The relative permittivity is a f^b and the conductivity c f^d [S/m] with f in GHz, as in ITU-R P.2040-4, section 2.1.4;
the complex relative permittivity is then eps_r - j sigma / (2 pi f eps_0). A row holds in its own band only: outside
all bands of a material every question about it is an error, unless it was extrapolated on request
(:meth:`Material.extrapolated`), which its rows then say. The scattering coefficient comes
from the roughness: S^2 = 1 - rho^2, rho = exp(-8 (pi sigma_h / lambda)^2), the Rayleigh roughness factor at normal
incidence (Ament 1953; Degli-Esposti et al. 2007, eq. (2), for the power that leaves the mirror direction).

The table is that of ITU-R P.2040, table 3: of edition 3 (2023), then what edition 4 (2025) adds. The first row whose band
holds a frequency counts.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Annotated, Any, TypeAlias

import numpy as np

from warprrf.checks import (
    NotNegative,
    Number,
    check_choice,
    check_count,
    check_items,
    check_number,
    check_positive,
    checked,
    within,
)
from warprrf.files import file_at, read_json
from warprrf.rf.em.waves import SPEED_OF_LIGHT, Hertz

VACUUM_PERMITTIVITY = 8.8541878128e-12  # F/m, CODATA 2018

NARROWEST_LOBE = 1000
"""Largest exponent of a scattering lobe: half its power lies within 3 degrees of the mirror direction. From 1023 on
the sums of binomials that normalise it leave double precision; what is narrower is a mirror reflection."""

WIDEST_HZ = (1e6, 1e13)
"""Where a material whose permittivity does not depend on frequency is known [Hz]."""

ROUGHEST_M = 1.0  # rms height; from a few wavelengths on nothing is reflected as by a mirror


Permittivity: TypeAlias = Annotated[float, within(1.0)]
Roughness: TypeAlias = Annotated[float, within(0.0, ROUGHEST_M)]


@checked
@dataclass(frozen=True)
class Band:
    """One row of permittivity coefficients and where it holds.

    Attributes:
        low_hz, high_hz: the band, both ends included [Hz].
        a, b: relative permittivity a f^b, f in GHz.
        c, d: conductivity c f^d [S/m], f in GHz.
        source: where the row comes from; starts with "assumed" where nothing was measured.

    Raises:
        ValueError: for numbers that are not finite, a band without width, or one at an end of which the relative
            permittivity is less than 1 or the conductivity negative: such a surface would give power.
    """

    low_hz: Hertz
    high_hz: Hertz
    a: Number
    b: Number
    c: Number
    d: Number
    source: str = "assumed"

    def __post_init__(self) -> None:
        if not self.low_hz < self.high_hz:
            raise ValueError(f"low_hz, high_hz: got {self.low_hz}, {self.high_hz}, expected 0 < low < high")
        for frequency_hz in (self.low_hz, self.high_hz):  # both laws are monotonic in between
            what, permittivity = f" at {frequency_hz / 1e9:g} GHz", self.relative_permittivity(frequency_hz)
            check_number("relative_permittivity (a f^b)" + what, permittivity, 1.0)
            check_number("conductivity (c f^d) [S/m]" + what, self.conductivity(frequency_hz), 0.0)

    def __str__(self) -> str:
        return f"{self.low_hz / 1e9:g} to {self.high_hz / 1e9:g} GHz"

    def widened(self, low_hz: float, high_hz: float) -> Band | None:
        """This law from ``low_hz`` to ``high_hz`` beside its own band, as far as its relative permittivity is 1 or
        more; None where nothing is left."""
        if self.b != 0:  # a f^b = 1
            with np.errstate(over="ignore"):
                end = 1e9 * float(np.float64(self.a) ** (-1.0 / self.b)) * (1 + np.sign(self.b) * 1e-12)
            low_hz, high_hz = (max(low_hz, end), high_hz) if self.b > 0 else (low_hz, min(high_hz, end))
        if not low_hz < high_hz:
            return None
        source = f"extrapolated from {self}: {self.source}"
        return replace(self, low_hz=low_hz, high_hz=high_hz, source=source)

    def relative_permittivity(self, frequency_hz: Hertz) -> float:
        """a f^b, f in GHz."""
        with np.errstate(over="ignore"):
            return float(self.a * np.float64(frequency_hz / 1e9) ** self.b)

    def conductivity(self, frequency_hz: Hertz) -> float:
        """c f^d [S/m], f in GHz."""
        with np.errstate(over="ignore"):
            return float(self.c * np.float64(frequency_hz / 1e9) ** self.d)


@checked
@dataclass(frozen=True)
class Material:
    """What a surface does to a radio wave.

    Attributes:
        name: the material's name.
        bands: permittivity rows; the first whose band holds the frequency counts. Without any it is a name alone, as a
            mesh file gives: it tells a radio field which surfaces are alike, and every question about it is an error.
        thickness_m: slab thickness [m], by default Sionna RT's; ``inf`` for a half-space.
        roughness_m: rms height of the surface sigma_h [m]; gives the scattering coefficient.
        scattering: scattering coefficient S in [0, 1] at every frequency, instead of one from ``roughness_m``.
        pattern: ``"lambertian"`` or ``"directive"``.
        alpha_r: width of the directive lobe ((1 + cos psi) / 2)^alpha_r, a whole number from 1 to 1000.
        itu: the P.2040 name, or None for a custom material.
        sources: where thickness, roughness and pattern come from.
        reciprocal: whether it scatters alike when transmitter and receiver change places. Degli-Esposti's lobes, the
            default and Sionna RT's, do not; see :func:`warprrf.rf.em.fresnel.lobe`. ``engine="exact"`` takes either.
        xpd: share K_x of scattered power in the other polarisation, in [0, 1]. Path gains sum over both received
            polarisations, so ours do not depend on it; Sionna RT is given it.

    Raises:
        TypeError, ValueError: naming what is no such number, and the material.
    """

    name: str
    bands: tuple[Band, ...]
    thickness_m: float = 0.1
    roughness_m: float = 0.0
    scattering: float | None = None
    pattern: str = "lambertian"
    alpha_r: int = 4
    itu: str | None = None
    sources: Mapping[str, str] | None = None
    reciprocal: bool = False
    xpd: float = 0.0

    def __post_init__(self) -> None:
        check_items("bands", self.bands, Band)
        of = f" of {self.name!r}"
        if self.thickness_m != np.inf:
            check_positive("thickness_m" + of, self.thickness_m, "number of metres, or inf for a half-space")
        check_number("roughness_m" + of, self.roughness_m, 0.0, ROUGHEST_M)
        if self.scattering is not None:
            check_number("scattering" + of, self.scattering, 0.0, 1.0)
        check_choice("pattern" + of, self.pattern, ("lambertian", "directive"))
        check_count("alpha_r" + of, self.alpha_r, 1, NARROWEST_LOBE)
        check_number("xpd" + of, self.xpd, 0.0, 1.0)

    @classmethod
    def custom(
        cls,
        name: str,
        *,
        relative_permittivity: Permittivity,
        conductivity: NotNegative = 0.0,
        thickness_m: float = 0.1,
        scattering: float = 0.0,
        pattern: str = "lambertian",
        alpha_r: int = 4,
        reciprocal: bool = False,
    ) -> Material:
        """A material with the same permittivity and conductivity [S/m] at every frequency up to 10 THz.

        Raises:
            ValueError: for a relative permittivity below 1, a negative conductivity, and as :class:`Material`.
        """
        band = Band(*WIDEST_HZ, relative_permittivity, 0.0, conductivity, 0.0, "given by the caller")
        return cls(name, (band,), thickness_m, 0.0, scattering, pattern, alpha_r, reciprocal=reciprocal)

    @classmethod
    def conductor(cls, **options: Any) -> Material:
        """A good conductor (1e7 S/m): reflects all but 0.7 % at 1 THz. ``options``: ``scattering``, ``pattern``
        and what else :meth:`custom` takes."""
        return cls.custom("conductor", relative_permittivity=1.0, conductivity=1e7, **options)

    def band(self, frequency_hz: Hertz) -> Band:
        """The row that holds at ``frequency_hz``.

        Raises:
            ValueError: naming material, frequency and bands, if none does.
        """
        check_known((self,))
        for band in self.bands:
            if band.low_hz <= frequency_hz <= band.high_hz:
                return band
        known = ", ".join(str(b) for b in self.bands)
        nearest = min(self.bands, key=lambda b: max(b.low_hz / frequency_hz, frequency_hz / b.high_hz))
        raise ValueError(
            f"frequency_hz: got {frequency_hz / 1e9:g} GHz, but material {self.name!r} is known for {known} only, "
            f"nearest {nearest}; choose a frequency inside, add a row for this band to its table, or load the scene "
            "with extrapolate=True (Material.extrapolated)"
        )

    def extrapolated(self) -> Material:
        """The same material with the law of the nearest band at every frequency from 1 MHz to 10 THz.

        The rows that are added say so in their ``source``; nobody measured there. Between two bands each holds up to
        the geometric mean of their ends. Where a law's relative permittivity would fall below 1 it ends.
        """
        if not self.bands:
            return self
        ends = sorted(self.bands, key=lambda band: (band.low_hz, band.high_hz))
        added, below, reach = [], ends[0], ends[0].high_hz
        added.append(ends[0].widened(WIDEST_HZ[0], ends[0].low_hz))
        for band in ends[1:]:
            if band.low_hz > reach:
                middle = float(np.sqrt(reach * band.low_hz))
                added += [below.widened(reach, middle), band.widened(middle, band.low_hz)]
            if band.high_hz > reach:
                below, reach = band, band.high_hz
        added.append(below.widened(reach, WIDEST_HZ[1]))
        return replace(self, bands=self.bands + tuple(band for band in added if band is not None))

    def permittivity(self, frequency_hz: float) -> complex:
        """Complex relative permittivity eps_r - j sigma / (2 pi f eps_0); ValueError outside the bands."""
        # ITU-R P.2040-4, section 2.1.4
        sigma = self.conductivity(frequency_hz)
        loss = -sigma / (2 * np.pi * frequency_hz * VACUUM_PERMITTIVITY)
        return complex(self.relative_permittivity(frequency_hz), loss)

    def relative_permittivity(self, frequency_hz: float) -> float:
        """Real part of the relative permittivity; ValueError outside the bands."""
        return self.band(frequency_hz).relative_permittivity(frequency_hz)

    def conductivity(self, frequency_hz: float) -> float:
        """Conductivity [S/m]; ValueError outside the bands."""
        return self.band(frequency_hz).conductivity(frequency_hz)

    def scattering_coefficient(self, frequency_hz: float) -> float:
        """Scattering coefficient S in [0, 1]; ValueError outside the bands."""
        self.band(frequency_hz)
        if self.scattering is not None:
            return float(self.scattering)
        return roughness_scattering(self.roughness_m, frequency_hz)


def radio_values(material: Material, frequency_hz: float) -> dict[str, float]:
    """A material at a carrier, by the names that Sionna RT's radio materials have for its properties."""
    return {
        "relative_permittivity": material.relative_permittivity(frequency_hz),
        "conductivity": material.conductivity(frequency_hz),
        "thickness": material.thickness_m,
        "scattering_coefficient": material.scattering_coefficient(frequency_hz),
        "xpd_coefficient": material.xpd,
    }


def is_name_alone(material: object) -> bool:
    """Whether nothing is known of a material but its name."""
    return isinstance(material, Material) and not material.bands


def check_known(materials: Iterable[Material]) -> None:
    """Refuse materials that are names alone."""
    unknown = sorted({material.name for material in materials if is_name_alone(material)})
    if unknown:
        raise ValueError(
            f"materials: nothing is known of {', '.join(map(repr, unknown))} but the name, expected radio materials: "
            "give Scene.load or Scene.with_materials some, such as materials={"
            f"{unknown[0]!r}: wr.em.itu_material('wood')}}"
        )


@checked
def roughness_scattering(roughness_m: Roughness, frequency_hz: Hertz) -> float:
    """Scattering coefficient of a surface of rms height ``roughness_m`` [m] at normal incidence, in [0, 1]."""
    exponent = 8 * (np.pi * roughness_m * frequency_hz / SPEED_OF_LIGHT) ** 2
    return float(np.sqrt(-np.expm1(-2 * exponent)))


_PARTS = ("thickness_m", "roughness_m", "scattering", "pattern", "xpd")
"""Parts of a table's entry with a value and a source each."""


def table_entry(material: Material) -> dict[str, Any]:
    """The entry of a table of materials that :func:`load_materials` reads as ``material``."""
    sources = material.sources or {}
    values: dict[str, Any] = {"thickness_m": material.thickness_m, "pattern": material.pattern}
    if material.scattering is None:
        values["roughness_m"] = material.roughness_m
    else:
        values["scattering"] = material.scattering
    if material.xpd:
        values["xpd"] = material.xpd
    rows = [
        {"low_ghz": b.low_hz / 1e9, "high_ghz": b.high_hz / 1e9, "a": b.a, "b": b.b, "c": b.c, "d": b.d,
         "source": b.source}
        for b in material.bands
    ]  # fmt: skip
    entry: dict[str, Any] = {"name": material.name, "itu": material.itu, "permittivity": rows}
    for key in (key for key in _PARTS if key in values):
        entry[key] = {"value": values[key], "source": sources.get(key, "assumed")}
    if material.pattern == "directive":
        entry["pattern"]["alpha_r"] = int(material.alpha_r)
    if material.reciprocal:
        entry["pattern"]["reciprocal"] = True
    return entry


def _mapping(value: object, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: got {value!r:.60}, expected a mapping {{...}}")
    return value


def _number(entry: object, key: str, where: str) -> float:
    return check_number(f"{where}: {key!r}", _mapping(entry, where).get(key))


def _band(row: Any, where: str) -> Band:
    law: dict[str, Any] = {key: _number(row, key, where) for key in "abcd"}
    law |= {f"{end}_hz": 1e9 * _number(row, f"{end}_ghz", where) for end in ("low", "high")}
    return Band(**law, source=str(row.get("source", "assumed")))


def _material(entry: object, where: str) -> Material:
    entry = _mapping(entry, where)
    name = entry.get("name")
    if not isinstance(name, str):
        raise ValueError(f"{where} has no 'name'")
    where = f"{where}, material {name!r}"
    if lacking := [key for key in ("permittivity", "thickness_m", "pattern") if key not in entry]:
        raise ValueError(f"{where} has no {lacking[0]!r}")
    if "roughness_m" not in entry and "scattering" not in entry:
        raise ValueError(f"{where} has neither 'roughness_m' nor 'scattering', expected one of them")
    if not isinstance(entry["permittivity"], list) or not entry["permittivity"]:
        raise ValueError(f"{where}: 'permittivity' is no list of rows")
    parts = {key: _mapping(entry[key], f"{where}, {key!r}") for key in _PARTS if key in entry}
    alpha_r = check_count(f"{where}: 'alpha_r'", parts["pattern"].get("alpha_r", 4), 1, NARROWEST_LOBE)
    reciprocal = parts["pattern"].get("reciprocal", False)
    if not isinstance(reciprocal, bool):
        raise ValueError(f"{where}: 'reciprocal' is {reciprocal!r}, expected true or false")
    try:
        numbers: Any = {key: _number(part, "value", where) for key, part in parts.items() if key != "pattern"}
        return Material(
            name=name,
            bands=tuple(_band(row, where) for row in entry["permittivity"]),
            pattern=str(parts["pattern"].get("value")),
            alpha_r=alpha_r,
            itu=entry.get("itu"),
            sources={key: str(part.get("source", "assumed")) for key, part in parts.items()},
            reciprocal=reciprocal,
            **numbers,
        )
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


_SHORT = ("itu", "thickness", "scattering", "pattern", "alpha_r", "xpd")


def _short(name: str, entry: Any, where: str) -> Material:
    """A material of P.2040 by its name there and what is said besides."""
    given = dict(_mapping(entry, where))
    unknown = sorted(set(given) - set(_SHORT))
    if unknown:
        raise ValueError(f"{where}: got {', '.join(unknown)}, expected among {', '.join(_SHORT)}")
    itu = given.pop("itu", name)
    if "thickness" in given:
        given["thickness_m"] = given.pop("thickness")
    try:
        return itu_material(itu, name=name, **given)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


@checked
def load_materials(path: str | os.PathLike[str]) -> dict[str, Material]:
    """Read a table of materials (see ``data/lobby/materials.json``), by name.

    An entry has a ``roughness_m`` or, where that is not known, a ``scattering`` coefficient; of both the latter counts.
    Or the table names materials of ITU-R P.2040, with what the recommendation does not say, as of :func:`itu_material`:
    ``{"pane": {"itu": "glass", "thickness": 0.01}}``; ``itu`` may be left out where the name says it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming the file, the material and what is wrong with it.
    """
    path = file_at(path, "table of materials")
    whole = read_json(path)
    table = whole.get("materials")
    if table is None:
        return {
            name: _short(name, entry, f"path: {path}, material {name!r}") for name, entry in whole.items()
        }
    if not isinstance(table, list):
        raise ValueError(f"path: {path}: 'materials' is no list")
    found: dict[str, Material] = {}
    for k, entry in enumerate(table):
        material = _material(entry, f"path: {path}, entry {k}")
        if material.name in found:
            raise ValueError(f"path: {path} has two materials named {material.name!r}, expected one")
        found[material.name] = material
    return found


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
    plain = re.sub(r"^(mat-)?(itu[_-])?|\.\d{3}$", "", name)
    return plain if plain in ITU_BANDS else None


def itu_material(
    itu: str,
    *,
    name: str | None = None,
    thickness_m: float = Material.thickness_m,
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
        raise ValueError(f"itu: got {itu!r}, expected one of ITU-R P.2040: {', '.join(sorted(ITU_BANDS))}")
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


@checked
def skin_permittivity(frequency_hz: Hertz) -> complex:
    """Complex relative permittivity of dry skin: 7.98 - 10.9j at 60 GHz.

    Source: S. Gabriel, R. W. Lau and C. Gabriel, "The dielectric properties of biological tissues: III. Parametric models for
    the dielectric spectrum of tissues", Phys. Med. Biol. 41 (1996), table 1: four Cole-Cole dispersions, 10 Hz to 100 GHz.
    """
    turn = 2j * np.pi * frequency_hz
    high, ionic = 4.0, 0.0002  # permittivity at high frequencies, ionic conductivity [S/m]
    # strength, relaxation time [s] and spread of each; two more have no strength
    dispersions = (32.0, 7.234e-12, 0.0), (1100.0, 32.48e-9, 0.2)
    found = sum(size / (1.0 + (turn * tau) ** (1.0 - spread)) for size, tau, spread in dispersions)
    return complex(high + found + ionic / (turn * VACUUM_PERMITTIVITY))


@lru_cache(maxsize=1)
def skin() -> Material:
    """Dry skin, a half-space that does not scatter: what waves above some GHz see of a person, clothes apart. Rows follow
    :func:`skin_permittivity` to 0.5 % from 0.1 to 1000 GHz; those above 100 GHz, where it was not fitted, say so."""
    rows = []
    for low, high in pairwise(np.geomspace(0.1, 1000.0, 65).tolist()):
        epsilon = np.array([skin_permittivity(1e9 * ghz) for ghz in (low, high)])
        sigma = -epsilon.imag * 2e9 * np.pi * np.array([low, high]) * VACUUM_PERMITTIVITY
        b, d = (float(np.log(y[1] / y[0]) / np.log(high / low)) for y in (epsilon.real, sigma))
        source = "extrapolated from 0.1 to 100 GHz: " * (high > 100.1) + "Gabriel et al. 1996, dry skin"
        a, c = float(epsilon.real[0]) / low**b, float(sigma[0]) / low**d
        rows.append(Band(1e9 * low, 1e9 * high, a, b, c, d, source))
    return Material("skin", tuple(rows), thickness_m=np.inf)


def library_material(name: str) -> Material | None:
    """The material that a name alone says, at any frequency: ``"skin"``, or one of ITU-R P.2040; None for no such name."""
    if name == "skin":
        return skin().extrapolated()
    return itu_material(name, name=name).extrapolated() if itu_name(name) else None


@lru_cache(maxsize=64)
def assumed_permittivity(name: str, frequency_hz: float) -> float:
    """Magnitude of the relative permittivity that a surface called ``name`` is taken for before any measurement: that of
    P.2040's material of this name, else the geometric mean of those that rooms are made of, less one."""
    known = itu_name(name)
    found = [abs(itu_permittivity(one, frequency_hz)) for one in (BUILDING if known is None else (known,))]
    return 1.0 + float(np.exp(np.mean(np.log(np.maximum(np.array(found) - 1.0, 1e-3)))))


@lru_cache(maxsize=64)
def itu_permittivity(itu: str, frequency_hz: float) -> complex:
    """Complex relative permittivity of a material of ITU-R P.2040, by the law of the nearest band."""
    return itu_material(itu).extrapolated().permittivity(frequency_hz)
