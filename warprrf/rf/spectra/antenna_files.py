"""Antennas in MSI Planet files (``.msi``, ``.pln``): two cuts of losses and a gain, as text.

A line is a keyword and its value. ``GAIN`` is in dBd (over a half-wave dipole, 2.15 dBi), or in dBi where that stands behind it.
``HORIZONTAL n`` and ``VERTICAL n`` are followed by n lines of an angle [degrees] and a loss below the maximum [dB, positive].
Azimuths are taken to count from boresight clockwise as a compass does, elevations from the horizon down: 90 is the ground, 270
the sky. No source says so outright; most antennas are symmetric in azimuth.
Sources: "Description of Planet antenna database" (MSI); Radio Mobile's and CPAN's RF::Antenna::Planet::MSI::Format descriptions of
the format.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from warprrf.files import file_at


@dataclass(frozen=True, eq=False)
class Cuts:
    """A gain whose losses in two cuts add up in decibels.

    Attributes:
        peak_dbi: gain where neither cut has a loss.
        azimuth: of the horizontal cut [rad], rising, within one turn.
        horizontal_db: its losses.
        elevation: of the vertical cut [rad] from the horizon up, rising from -pi/2 to pi/2.
        vertical_db: its losses.
    """

    peak_dbi: float
    azimuth: np.ndarray
    horizontal_db: np.ndarray
    elevation: np.ndarray
    vertical_db: np.ndarray

    def __call__(self, zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        """Power gain [linear] at zeniths and azimuths [rad]."""
        across = np.interp(azimuth, self.azimuth, self.horizontal_db, period=2.0 * np.pi)
        down = np.interp(0.5 * np.pi - zenith, self.elevation, self.vertical_db)
        return np.asarray(10.0 ** (0.1 * (self.peak_dbi - across - down)))


def read_cuts(path: str | os.PathLike[str]) -> Cuts:
    """The cuts of a file; see the module."""
    file = file_at(path)
    if file.suffix.lower() not in (".msi", ".pln"):
        raise ValueError(f"path: {file}: got a file {file.suffix or 'without suffix'}, expected .msi or .pln")
    most_bytes = 4_000_000  # a file of 720 angles a cut has 20 thousand
    if file.stat().st_size > most_bytes:
        raise ValueError(f"path: {file}: got {file.stat().st_size} bytes, expected at most {most_bytes}")
    try:
        return _parsed(file.read_text(encoding="utf-8-sig", errors="replace").splitlines())
    except ValueError as error:
        raise ValueError(f"path: {file}: {error}") from error


def _parsed(lines: list[str]) -> Cuts:
    peak, cuts, at = None, dict[str, np.ndarray](), 0
    while at < len(lines):
        word, *rest = lines[at].split() or [""]
        key = word.upper()
        if key == "GAIN":
            peak = _gain_dbi(rest, at + 1)
        elif key in ("HORIZONTAL", "VERTICAL"):
            if key in cuts:
                raise ValueError(f"line {at + 1}: got {key} a second time, expected one such cut")
            cuts[key] = _cut(key, rest, lines, at + 1)
            at += len(cuts[key])
        at += 1
    missing = [key for key in ("HORIZONTAL", "VERTICAL") if key not in cuts] + ["GAIN"] * (peak is None)
    if missing or peak is None:
        raise ValueError(
            f"got no {', '.join(missing)}, expected an MSI Planet file with GAIN, HORIZONTAL and VERTICAL"
        )
    # Clockwise becomes counter-clockwise, down becomes up; of the vertical cut the front half counts.
    azimuth, across = _rising(-cuts["HORIZONTAL"][:, 0] % 360.0, cuts["HORIZONTAL"][:, 1])
    elevation, down = _rising((180.0 - cuts["VERTICAL"][:, 0]) % 360.0 - 180.0, cuts["VERTICAL"][:, 1])
    front = (elevation >= -90.0) & (elevation <= 90.0)
    ends = np.array([-90.0, 90.0])
    at_ends = np.interp(ends, elevation, down, period=360.0)
    elevation, down = _rising(np.append(elevation[front], ends), np.append(down[front], at_ends))
    return Cuts(peak, np.radians(azimuth), across, np.radians(elevation), down)


def _gain_dbi(rest: list[str], line: int) -> float:
    text = " ".join(rest).lower()
    unit = "dbi" if text.endswith("dbi") else "dbd"
    try:
        value = float(text.removesuffix(unit))
    except ValueError:
        value = np.nan
    if not -100.0 <= value <= 100.0:
        raise ValueError(f"line {line}: GAIN: got {' '.join(rest)!r:.40}, expected a number, then dBd or dBi")
    dipole_dbi = 2.15  # gain of the half-wave dipole that dBd counts from
    return value if unit == "dbi" else value + dipole_dbi


def _cut(key: str, rest: list[str], lines: list[str], line: int) -> np.ndarray:
    """Angles [degrees] and losses [dB], shape ``(n, 2)``, of the cut whose keyword is in ``line``."""
    if len(rest) != 1 or not rest[0].isdecimal() or not 0 < int(rest[0]) <= len(lines) - line:
        raise ValueError(
            f"line {line}: {key}: got {' '.join(rest)!r:.40} and {len(lines) - line} more lines, expected the number "
            "of its angles, a line each"
        )
    found = np.full((int(rest[0]), 2), np.nan)
    for k, text in enumerate(lines[line : line + len(found)]):
        try:
            angle, loss = map(float, text.split())
        except ValueError:
            angle = loss = np.nan
        if not (0.0 <= angle <= 360.0 and 0.0 <= loss <= 1000.0):
            raise ValueError(
                f"line {line + 1 + k}: {key}: got {text.strip()!r:.40}, expected an angle of 0 to 360 degrees and a "
                "loss of at least 0 dB below the maximum"
            )
        found[k] = angle, loss
    around = np.unique(found[:, 0] % 360.0)
    gap = np.diff(np.append(around, around[0] + 360.0)).max()
    widest_gap_deg = 30.0  # what lies between two angles is guessed
    if gap > widest_gap_deg:
        raise ValueError(
            f"line {line}: {key}: got {gap:g} degrees without a value, expected angles all the way round, at most "
            f"{widest_gap_deg:g} apart"
        )
    return found


def _rising(angle: np.ndarray, loss: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    once, first = np.unique(angle, return_index=True)
    return once, loss[first]
