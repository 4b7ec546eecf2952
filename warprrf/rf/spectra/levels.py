"""Whether measured powers can be path gains: none reaches what was transmitted, and few are far above line of sight.

Free space gives (lambda / (4 pi d))^2 between isotropic antennas (Friis 1946). What surfaces add is bounded in practice by
:data:`MARGIN_DB`. Numbers beyond it are mostly in another unit, which is guessed by what would bring the strongest of
them nearest to line of sight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import some_of, warn
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.spectra.spectrum import to_db

MARGIN_DB = 18.0
"""By how much all paths together may exceed line of sight: three mirror reflections in a corridor of perfect conductors
give 16.4 dB, two in a furnished room of them 10.3 dB, a lobby of building materials 3.9 dB."""


def free_space_gain(transmitters: np.ndarray, receivers: np.ndarray, frequency_hz: float) -> np.ndarray:
    """Path gain of line of sight [linear] between positions (N, 3) or (3,) [m], shape ``(N,)``; at most 1."""
    length = np.linalg.norm(np.subtract(transmitters, receivers), axis=-1)
    near = SPEED_OF_LIGHT / frequency_hz / (4.0 * np.pi)
    return np.asarray((near / np.maximum(length, near)) ** 2)


def question_levels(
    name: str, power: np.ndarray, free_space: np.ndarray, *, margin_db: ArrayLike = MARGIN_DB, hint: str = ""
) -> None:
    """Question received over transmitted powers (N,) [linear], NaN where not measured.

    Args:
        free_space: what line of sight gives at most, antennas' gains included, shape ``(N,)``.
        margin_db: by how much all paths may exceed it.
        hint: what else may have raised them.

    Raises:
        ValueError: naming rows that received as much as was transmitted, and the likely unit.

    Warns:
        UserWarning: naming rows that are further above line of sight, and the likely unit.
    """
    level_db, line_of_sight_db = to_db(np.nan_to_num(power, posinf=1e300)), to_db(free_space)
    above = level_db - line_of_sight_db
    wrong = np.flatnonzero(above > margin_db)
    impossible = np.flatnonzero(level_db >= 0.0)
    if len(impossible):
        wrong = impossible
    elif not len(wrong):
        return
    unit = _likely_unit(level_db[wrong], line_of_sight_db[wrong])
    rows = f"{name}: {len(wrong)} of {len(power)} (rows {some_of(wrong)})"
    end = f"{unit}{hint}; expected received over transmitted power"
    if len(impossible):
        raise ValueError(f"{rows} are up to {level_db[wrong].max():.4g} dB, not less than transmitted{end}")
    warn(
        f"{rows} are up to {above[wrong].max():.3g} dB above line of sight in free space, where reflections add "
        f"{float(np.max(margin_db)):g} dB at most{end}"
    )


def _likely_unit(level_db: np.ndarray, line_of_sight_db: np.ndarray) -> str:
    """In which unit numbers would be as strong as line of sight; none if they are too strong in each."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        readings = {
            "decibels whose minus signs were lost": -level_db,
            "amplitudes, not powers: square them": 2.0 * level_db,
            "dBm, not dB: subtract the transmitted power [dBm]": level_db - 30.0,
            "linear powers given as decibels": 10.0 * np.log10(level_db),
            "decibels, their minus signs lost, given as linear": -(10.0 ** (level_db / 10.0)),
        }
    away = {unit: float(np.nanmax(db - line_of_sight_db, initial=-np.inf)) for unit, db in readings.items()}
    faint_db = 150.0  # below line of sight nothing is measured
    fits = {unit: abs(excess) for unit, excess in away.items() if -faint_db < excess <= MARGIN_DB}
    return f"; they look like {min(fits, key=lambda unit: fits[unit])}" if fits else ""
