"""Specific attenuation of air by oxygen and water vapour, 1 to 1000 GHz.

Source: ITU-R P.676-13 (08/2022), Annex 1, the sum over spectroscopic lines of its tables 1 and 2 with Zeeman and
Doppler broadening, and the dry continuum. Both tables stand beside this file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import NotNegative, check_array, checked, within

_PREFIX = "air_"


@checked
@dataclass(frozen=True)
class Air:
    """A state of the air; the defaults are the standard atmosphere at sea level (ITU-R P.835).

    Attributes:
        temperature_k: temperature [K].
        pressure_hpa: pressure of the dry air [hPa].
        water_vapour_g_m3: density of water vapour [g/m^3].

    Raises:
        ValueError: for less than 100 K, or a negative pressure or density.
    """

    temperature_k: Annotated[float, within(100.0)] = 288.15
    pressure_hpa: NotNegative = 1013.25
    water_vapour_g_m3: NotNegative = 7.5

    def attenuation_db_per_m(self, frequency_hz: ArrayLike) -> Any:
        """Specific attenuation [dB/m], shape as ``frequency_hz``; see :func:`gas_attenuation_db_per_m`."""
        return gas_attenuation_db_per_m(frequency_hz, **vars(self))

    def transmittance(self, frequency_hz: float, length_m: ArrayLike) -> np.ndarray:
        """Share of power that ``length_m`` [m] of it lets through, 10^(-gamma d / 10), shape as ``length_m``."""
        return np.asarray(10.0 ** (-0.1 * self.attenuation_db_per_m(frequency_hz) * np.asarray(length_m)))

    def loss_per_m(self, frequency_hz: float) -> float:
        """Loss of power [neper/m]: transmittance is exp of minus this a metre."""
        return float(0.1 * np.log(10.0) * self.attenuation_db_per_m(frequency_hz))

    @property
    def attributes(self) -> dict[str, float]:
        """As attributes of a file: ``air_temperature_k`` and so on."""
        return {f"{_PREFIX}{name}": value for name, value in vars(self).items()}

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, Any]) -> Air | None:
        """The air among a file's attributes; None if there is none."""
        found = {k.removeprefix(_PREFIX): float(v) for k, v in attributes.items() if k.startswith(_PREFIX)}
        return cls(**found) if found else None


Gas: TypeAlias = Any
"""Whether the air absorbs: False or None for no, True for the standard atmosphere, one's own :class:`Air`, or a
:class:`~warprrf.rf.relevance.search.Relevance`, which says whether it matters."""


def air_of(gas: Gas, frequency_hz: float | None = None) -> Air | None:
    """The air to reckon with: None for False, the standard atmosphere for True, :class:`Air` as it is.

    A :class:`~warprrf.rf.relevance.search.Relevance` decides by whether it kept the effect "gas".

    Raises:
        TypeError: for anything else.
        ValueError: if air is to be reckoned with at a ``frequency_hz`` outside ITU-R P.676.
    """
    kept = getattr(gas, "kept", None)
    if gas is None or isinstance(gas, Air):
        air = gas
    elif isinstance(gas, bool | np.bool_):
        air = Air() if gas else None
    elif isinstance(kept, tuple):
        air = Air() if "gas" in kept else None
    else:
        raise TypeError(f"gas: got {type(gas).__name__}, expected True, False, an Air or a Relevance")
    if air is not None and frequency_hz is not None:
        air.attenuation_db_per_m(frequency_hz)
    return air


@checked
def gas_attenuation_db_per_m(
    frequency_hz: ArrayLike,
    *,
    temperature_k: float = Air.temperature_k,
    pressure_hpa: float = Air.pressure_hpa,
    water_vapour_g_m3: float = Air.water_vapour_g_m3,
) -> Any:
    """Specific attenuation of air [dB/m]: a float for one frequency, else an array of the shape of ``frequency_hz``.

    Args:
        frequency_hz: carrier, 1 to 1000 GHz.
        temperature_k: temperature of the air.
        pressure_hpa: pressure of the dry air; 0 for none.
        water_vapour_g_m3: density of water vapour; 0 for dry air.

    Raises:
        ValueError: for a frequency outside the band, or a state of the air that cannot be.
    """
    f_hz = check_array("frequency_hz", frequency_hz, finite=False)
    if not np.all((f_hz >= 1e9) & (f_hz <= 1000e9)):
        raise ValueError(f"frequency_hz: got {frequency_hz!r}, expected 1e+09 to 1e+12, where P.676 holds")
    Air(temperature_k, pressure_hpa, water_vapour_g_m3)  # which checks them
    f = f_hz[..., None] * 1e-9
    theta = 300.0 / temperature_k
    vapour_hpa = water_vapour_g_m3 * temperature_k / 216.7  # eq. (4)
    state = f, theta, pressure_hpa, vapour_hpa
    per_km = 0.1820 * f[..., 0] * (_oxygen(*state) + _water_vapour(*state))  # eq. (1)
    return float(per_km) * 1e-3 if f_hz.ndim == 0 else per_km * 1e-3


def _oxygen(f: np.ndarray, theta: float, p: float, e: float) -> np.ndarray:
    """Imaginary part of the refractivity by oxygen's lines and the dry continuum; eqs. (2a), (3), (5) to (9)."""
    f0, a1, a2, a3, a4, a5, a6 = _lines("oxygen")
    strength = a1 * 1e-7 * p * theta**3 * np.exp(a2 * (1.0 - theta))
    width = a3 * 1e-4 * (p * theta ** (0.8 - a4) + 1.1 * e * theta)
    width = np.sqrt(width**2 + 2.25e-6)  # Zeeman splitting
    interference = (a5 + a6 * theta) * 1e-4 * (p + e) * theta**0.8
    debye = 5.6e-4 * (p + e) * theta**0.8
    x = f[..., 0]
    dry = np.zeros_like(x)
    if p > 0:
        dry = x * p * theta**2 * (
            6.14e-5 / (debye * (1.0 + (x / debye) ** 2)) + 1.4e-12 * p * theta**1.5 / (1.0 + 1.9e-5 * x**1.5)
        )  # fmt: skip
    return (strength * _shape(f, f0, width, interference)).sum(axis=-1) + dry


def _water_vapour(f: np.ndarray, theta: float, p: float, e: float) -> np.ndarray:
    """Imaginary part of the refractivity by water vapour's lines; eqs. (2b), (3), (5) to (7)."""
    f0, b1, b2, b3, b4, b5, b6 = _lines("water_vapour")
    strength = b1 * 1e-1 * e * theta**3.5 * np.exp(b2 * (1.0 - theta))
    width = b3 * 1e-4 * (p * theta**b4 + b5 * e * theta**b6)
    width = 0.535 * width + np.sqrt(0.217 * width**2 + 2.1316e-12 * f0**2 / theta)  # Doppler broadening
    return (strength * _shape(f, f0, width, np.zeros_like(f0))).sum(axis=-1)


def _shape(f: np.ndarray, f0: np.ndarray, width: np.ndarray, interference: np.ndarray) -> np.ndarray:
    """Line shape, eq. (5)."""
    total = np.zeros(1)
    for offset in (f0 - f, f0 + f):
        total = total + (width - interference * offset) / (offset**2 + width**2)
    return f / f0 * total


@cache
def _lines(gas: str) -> np.ndarray:
    """Columns of the table of spectroscopic lines, one row of the result each."""
    return np.loadtxt(Path(__file__).with_name(f"p676_{gas}.txt"), unpack=True)
