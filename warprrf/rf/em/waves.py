"""The speed of light, carriers, and the phase that a delay gives them."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_alike, check_array, checked

SPEED_OF_LIGHT = 299_792_458.0  # [m/s], exact
NEPER = 10.0 / np.log(10.0)
"""Decibels of a neper of power."""
CARRIERS_HZ = (1e5, 1e16)
"""What a carrier may be: a smaller number is one in megahertz or gigahertz."""


def check_frequency(frequency_hz: ArrayLike | None, name: str = "frequency_hz") -> float:
    """``frequency_hz`` as a float; errors call it ``name``."""
    value, (low, high) = float(check_array(name, frequency_hz, ())), CARRIERS_HZ
    if not low <= value <= high:
        raise ValueError(f"{name}: got {value!r}, expected hertz, {low:g} to {high:g} (28 GHz is 28e9)")
    return value


def check_carrier(name: str, frequency_hz: float, field_hz: float) -> None:
    """Errors call what is of another carrier than a field ``name``."""
    of, told = frequency_hz / 1e9, field_hz / 1e9
    if abs(of / told - 1.0) > 1e-3:
        raise ValueError(
            f"{name}: got {of:g} GHz, expected {told:g}; field.at_frequency(hz) is of another carrier"
        )


Hertz: TypeAlias = Annotated[float, lambda name, value: check_frequency(value, name)]
"""A carrier, checked where an argument is annotated so."""


@checked
def carrier_phase(frequency_hz: ArrayLike, tau: ArrayLike) -> np.ndarray:
    """exp(-j 2 pi f tau); whole turns are dropped before the exponential, since f tau reaches 1e4 and more."""
    frequency = check_array("frequency_hz", frequency_hz, finite=False)
    delay = check_array("tau", tau, finite=False)
    check_alike(frequency_hz=frequency, tau=delay)
    return np.exp(-2j * np.pi * np.mod(frequency * delay, 1.0))
