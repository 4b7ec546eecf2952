r"""Radio materials: permittivity by band, slab thickness, and scattering from surface roughness.

The relative permittivity is a f^b and the conductivity c f^d [S/m] with f in GHz, as in ITU-R P.2040-4, section 2.1.4;
the complex relative permittivity is then eps_r - j sigma / (2 pi f eps_0). A row holds in its own band only: outside
all bands of a material every question about it is an error, never an extrapolation. The scattering coefficient comes
from the roughness: S^2 = 1 - rho^2, rho = exp(-8 (pi sigma_h / lambda)^2), the Rayleigh roughness factor at normal
incidence (Ament 1953; Degli-Esposti et al. 2007, eq. (2), for the power that leaves the mirror direction).
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.rf.em.waves import SPEED_OF_LIGHT

VACUUM_PERMITTIVITY = 8.8541878128e-12  # F/m, CODATA 2018
PATTERNS = ("lambertian", "directive")


@dataclass(frozen=True)
class Band:
    """One row of permittivity coefficients and where it holds.

    Attributes:
        low_hz, high_hz: the band, both ends included [Hz].
        a, b: relative permittivity a f^b, f in GHz.
        c, d: conductivity c f^d [S/m], f in GHz.
        source: where the row comes from; starts with "assumed" where nothing was measured.
    """

    low_hz: float
    high_hz: float
    a: float
    b: float
    c: float
    d: float
    source: str = "assumed"

    def __post_init__(self) -> None:
        if not 0 < self.low_hz < self.high_hz:
            raise ValueError(f"low_hz, high_hz: got {self.low_hz}, {self.high_hz}, expected 0 < low < high")


@dataclass(frozen=True)
class Material:
    """What a surface does to a radio wave.

    Attributes:
        name: the material's name.
        bands: permittivity rows; the first whose band holds the frequency counts.
        thickness_m: slab thickness [m]; ``inf`` for a half-space.
        roughness_m: rms height of the surface sigma_h [m]; gives the scattering coefficient.
        scattering: scattering coefficient S in [0, 1] at every frequency, instead of one from ``roughness_m``.
        pattern: ``"lambertian"`` or ``"directive"``.
        alpha_r: width of the directive lobe ((1 + cos psi) / 2)^alpha_r, a whole number of at least 1.
        itu: the P.2040 name, or None for a custom material.
        sources: where thickness, roughness and pattern come from.
        reciprocal: whether it scatters alike when transmitter and receiver change places. Degli-Esposti's lobes, the
            default and Sionna RT's, do not; see :func:`warprrf.rf.em.fresnel.lobe`. ``engine="exact"`` takes either.
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

    def __post_init__(self) -> None:
        if not self.bands:
            raise ValueError(f"bands: material {self.name!r} has none, expected at least one row")
        if not self.thickness_m > 0:
            raise ValueError(f"thickness_m: got {self.thickness_m} for {self.name!r}, expected more than 0")
        if not (np.isfinite(self.roughness_m) and self.roughness_m >= 0):
            raise ValueError(f"roughness_m: got {self.roughness_m} for {self.name!r}, expected at least 0")
        if self.scattering is not None and not 0 <= self.scattering <= 1:
            raise ValueError(
                f"scattering: got {self.scattering} for {self.name!r}, expected a number in [0, 1]"
            )
        if self.pattern not in PATTERNS:
            raise ValueError(
                f"pattern: got {self.pattern!r} for {self.name!r}, expected one of {', '.join(PATTERNS)}"
            )
        if self.alpha_r != int(self.alpha_r) or self.alpha_r < 1:
            raise ValueError(
                f"alpha_r: got {self.alpha_r} for {self.name!r}, expected a whole number of at least 1"
            )

    @classmethod
    def custom(
        cls,
        name: str,
        *,
        relative_permittivity: float,
        conductivity: float = 0.0,
        thickness_m: float = 0.1,
        scattering: float = 0.0,
        pattern: str = "lambertian",
        alpha_r: int = 4,
        reciprocal: bool = False,
    ) -> Material:
        """A material with the same permittivity and conductivity [S/m] at every frequency up to 10 THz."""
        band = Band(1e6, 1e13, relative_permittivity, 0.0, conductivity, 0.0, "given by the caller")
        return cls(name, (band,), thickness_m, 0.0, scattering, pattern, alpha_r, reciprocal=reciprocal)

    @classmethod
    def conductor(cls, *, scattering: float = 0.0, pattern: str = "lambertian", alpha_r: int = 4) -> Material:
        """A good conductor (1e7 S/m): reflects all but a thousandth at terahertz."""
        return cls.custom(
            "conductor",
            relative_permittivity=1.0,
            conductivity=1e7,
            scattering=scattering,
            pattern=pattern,
            alpha_r=alpha_r,
        )

    def band(self, frequency_hz: float) -> Band:
        """The row that holds at ``frequency_hz``.

        Raises:
            ValueError: naming material, frequency and bands, if none does.
        """
        for band in self.bands:
            if band.low_hz <= frequency_hz <= band.high_hz:
                return band
        known = ", ".join(f"{b.low_hz / 1e9:g} to {b.high_hz / 1e9:g} GHz" for b in self.bands)
        raise ValueError(
            f"frequency_hz: got {frequency_hz / 1e9:g} GHz, but material {self.name!r} is known for {known} only; "
            "choose a frequency inside, or add a row for this band to its table"
        )

    def permittivity(self, frequency_hz: float) -> complex:
        """Complex relative permittivity eps_r - j sigma / (2 pi f eps_0); ValueError outside the bands."""
        # ITU-R P.2040-4, section 2.1.4
        sigma = self.conductivity(frequency_hz)
        return complex(
            self.relative_permittivity(frequency_hz),
            -sigma / (2 * np.pi * frequency_hz * VACUUM_PERMITTIVITY),
        )

    def relative_permittivity(self, frequency_hz: float) -> float:
        """Real part of the relative permittivity; ValueError outside the bands."""
        band = self.band(frequency_hz)
        return float(band.a * (frequency_hz / 1e9) ** band.b)

    def conductivity(self, frequency_hz: float) -> float:
        """Conductivity [S/m]; ValueError outside the bands."""
        band = self.band(frequency_hz)
        return float(band.c * (frequency_hz / 1e9) ** band.d)

    def scattering_coefficient(self, frequency_hz: float) -> float:
        """Scattering coefficient S in [0, 1]; ValueError outside the bands."""
        self.band(frequency_hz)
        if self.scattering is not None:
            return float(self.scattering)
        return roughness_scattering(self.roughness_m, frequency_hz)


def roughness_scattering(roughness_m: float, frequency_hz: float) -> float:
    """Scattering coefficient of a surface of rms height ``roughness_m`` [m] at normal incidence, in [0, 1]."""
    exponent = 8 * (np.pi * roughness_m * frequency_hz / SPEED_OF_LIGHT) ** 2
    return float(np.sqrt(-np.expm1(-2 * exponent)))


_PARTS = ("thickness_m", "roughness_m", "scattering", "pattern")
"""Parts of a table's entry with a value and a source each."""


def table_entry(material: Material) -> dict[str, Any]:
    """The entry of a table of materials that :func:`load_materials` reads as ``material``."""
    sources = material.sources or {}
    values: dict[str, Any] = {"thickness_m": material.thickness_m, "pattern": material.pattern}
    if material.scattering is None:
        values["roughness_m"] = material.roughness_m
    else:
        values["scattering"] = material.scattering
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


def _number(entry: Mapping[str, Any], key: str, where: str) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{where}: {key!r} is {value!r}, expected a number")
    return float(value)


def _flag(entry: Mapping[str, Any], key: str, where: str) -> bool:
    value = entry.get(key, False)
    if not isinstance(value, bool):
        raise ValueError(f"{where}: {key!r} is {value!r}, expected true or false")
    return value


def _material(entry: Mapping[str, Any], path: Path) -> Material:
    name = entry.get("name")
    if not isinstance(name, str):
        raise ValueError(f"path: an entry of {path} has no 'name'")
    where = f"path: material {name!r} in {path}"
    for key in ("permittivity", "thickness_m", "pattern"):
        if key not in entry:
            raise ValueError(f"{where} has no {key!r}")
    if "roughness_m" not in entry and "scattering" not in entry:
        raise ValueError(f"{where} has neither 'roughness_m' nor 'scattering', expected one of them")
    bands = tuple(
        Band(
            low_hz=_number(row, "low_ghz", where) * 1e9,
            high_hz=_number(row, "high_ghz", where) * 1e9,
            a=_number(row, "a", where),
            b=_number(row, "b", where),
            c=_number(row, "c", where),
            d=_number(row, "d", where),
            source=str(row.get("source", "assumed")),
        )
        for row in entry["permittivity"]
    )
    parts = {key: entry[key] for key in _PARTS if key in entry}
    scattering = _number(parts["scattering"], "value", where) if "scattering" in parts else None
    return Material(
        name=name,
        bands=bands,
        thickness_m=_number(parts["thickness_m"], "value", where),
        roughness_m=_number(parts["roughness_m"], "value", where) if "roughness_m" in parts else 0.0,
        scattering=scattering,
        pattern=str(parts["pattern"].get("value")),
        alpha_r=int(parts["pattern"].get("alpha_r", 4)),
        itu=entry.get("itu"),
        sources={key: str(part.get("source", "assumed")) for key, part in parts.items()},
        reciprocal=_flag(parts["pattern"], "reciprocal", where),
    )


def load_materials(path: str | os.PathLike[str]) -> dict[str, Material]:
    """Read a table of materials (see ``data/lobby/materials.json``), by name.

    An entry has a ``roughness_m`` or, where that is not known, a ``scattering`` coefficient; of both the latter counts.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: naming the file, the material and what is wrong with it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"path: there is no table of materials {path}")
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"path: {path} is not JSON: {error}") from error
    if not isinstance(table, dict) or not isinstance(table.get("materials"), list):
        raise ValueError(f"path: {path} holds no list 'materials'")
    found = [_material(entry, path) for entry in table["materials"]]
    return {material.name: material for material in found}
