"""Antennas: power gain, or polarised field, over two angles in axes of their own.

Axes are those of Sionna RT and 3GPP TR 38.901: an antenna looks along its local +x, zeniths count from its +z, azimuths from
+x to +y. A *gain* G is power gain over isotropic [linear]: its mean over the sphere is the antenna's efficiency, and the
integral of G over it 4 pi of a lossless one. A *field* (F_theta, F_phi) is complex, along the zenith and azimuth unit
vectors of the direction, with |F_theta|^2 + |F_phi|^2 = G. Of a field F_t that is sent through a path of Jones matrix J an antenna
of field F_r receives F_r^T J F_t: without a conjugate, so that links are reciprocal (IEEE Std 145).

What is called a pattern in arrays and readings is an :class:`Antenna` or what one is made of: a name of :data:`PATTERNS`, or a
power gain over the angle off boresight alone.

Names: "isotropic"; "dipole", the short dipole along local z, gain 1.5 sin^2 (Balanis, Antenna Theory, eq. (4-26a));
"half_wave_dipole", 1.643 (cos(pi/2 cos theta) / sin theta)^2 (eq. (4-84)); "tr38901", 3GPP TR 38.901 table 7.3-1 (8 dBi, 65
degrees, 30 dB).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from warprrf.cache import cached_property
from warprrf.checks import Positive, check_array, checked, one_of, within
from warprrf.rf.spectra.antenna_files import read_cuts
from warprrf.rf.spectra.spectrum import (
    angles_from_directions,
    directions_from_angles,
    pixel_directions,
    transverse_basis,
)

SLANTS_RAD = {
    "V": (0.0,),
    "H": (0.5 * np.pi,),
    "VH": (0.0, 0.5 * np.pi),
    "cross": (-0.25 * np.pi, 0.25 * np.pi),
}
"""Slant angle zeta of each port, by the name of a polarisation: (F_theta, F_phi) = sqrt(G) (cos zeta, sin zeta); 3GPP TR 38.901,
eqs. (7.3-4) and (7.3-5), model 2."""

Shape: TypeAlias = Callable[[np.ndarray, np.ndarray], Any]
"""Of zeniths and azimuths [rad], arrays alike, to power gains [linear] of their shape, or to a pair of complex fields."""


@checked
@dataclass(frozen=True, eq=False)
class Antenna:
    """An antenna of one port or two: where it sends and receives how much, in which polarisation.

    Args:
        pattern: one of :data:`PATTERNS`; a function of zenith and azimuth [rad] that returns power gains [linear], or the
            pair of complex fields (F_theta, F_phi); or a sequence of such functions of fields, one for each port.
        polarisation: "V", "H", "VH" or "cross": what a power gain is polarised along. None: nothing is known of it, or the
            fields say it themselves.
        orientation: yaw, pitch and roll [rad], or a rotation matrix from its own axes, shape ``(3, 3)``.

    Raises:
        TypeError, ValueError: naming the argument; for gains that are negative or not finite.

    Example::

        sector = wr.Antenna.load("sector.msi", polarisation="cross").turned((0.0, np.radians(6), 0.0))  # 6 degrees down
        channel = paths.cfr(f, tx_array=sector, rx_array=wr.Antenna("dipole", "V"))
    """

    pattern: str | Shape | Sequence[Shape] = "isotropic"
    polarisation: Annotated[str | None, one_of(None, *SLANTS_RAD)] = None
    orientation: ArrayLike = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if isinstance(self.pattern, str) and self.pattern not in PATTERNS:
            raise ValueError(
                f"pattern: got {self.pattern!r}, expected {', '.join(PATTERNS)}, an Antenna, a function or samples"
            )
        _ = self.rotation, self._probed

    @classmethod
    def from_grid(
        cls,
        zenith: ArrayLike,
        azimuth: ArrayLike,
        gain: ArrayLike | None = None,
        *,
        field: ArrayLike | None = None,
        polarisation: str | None = None,
    ) -> Antenna:
        """An antenna of numbers on a grid of angles, interpolated linearly, gains as gains and fields as complex numbers.

        Args:
            zenith: T rising zeniths [rad] from 0 to pi; what is missing at the ends, less than a step, is continued.
            azimuth: P rising azimuths [rad] all the way round, of which the last may repeat the first.
            gain: power gain [linear], shape ``(T, P)``.
            field: complex (F_theta, F_phi) instead, shape ``(T, P, 2)``, or ``(K, T, P, 2)`` of K ports. Of magnitudes alone:
                a gain with a ``polarisation``.
            polarisation: of a gain; see :class:`Antenna`.

        Raises:
            TypeError, ValueError: naming the argument.
        """
        rows, columns = check_array("zenith", zenith, (None,)), check_array("azimuth", azimuth, (None,))
        for name, angles, least in (("zenith", rows, 2), ("azimuth", columns, 3)):
            if len(angles) < least or not (np.diff(angles) > 0).all():
                raise ValueError(f"{name}: got {len(angles)} angles, expected {least} or more, rising [rad]")
        step = np.diff(rows).max() * 1.001
        if rows[0] < -1e-6 or rows[0] > step or rows[-1] > np.pi + 1e-6 or rows[-1] < np.pi - step:
            raise ValueError(
                f"zenith: got {rows[0]:g} to {rows[-1]:g}, expected 0 to pi (elevations: from the zenith down)"
            )
        missing = 2.0 * np.pi - (columns[-1] - columns[0])
        if not -1e-6 <= missing <= np.diff(columns).max() * 1.001:
            raise ValueError(
                f"azimuth: got {columns[0]:g} to {columns[-1]:g}, expected angles all the way round, 2 pi; give a gain of 0 "
                "where nothing is sent"
            )
        if (gain is None) == (field is None):
            raise ValueError("gain: got both of gain and field or neither, expected one of them")
        shape = len(rows), len(columns)
        if field is None or gain is not None:
            return cls(_gridded(rows, columns, check_array("gain", gain, shape)), polarisation)
        ports = check_array("field", field, dtype=complex)
        ports = ports[None] if ports.ndim == 3 else ports
        if ports.ndim != 4 or ports.shape[1:] != (*shape, 2) or not 1 <= len(ports) <= 2:
            raise ValueError(
                f"field: got shape {np.shape(field)}, expected {(*shape, 2)}, or that of one or two ports {('K', *shape, 2)}"
            )
        return cls(tuple(_gridded(rows, columns, port) for port in ports), polarisation)

    @classmethod
    def load(cls, path: str | os.PathLike[str], polarisation: str | None = None) -> Antenna:
        """An antenna of an MSI Planet file (``.msi``, ``.pln``): a horizontal and a vertical cut of losses, and a gain.

        The losses of both cuts add up in decibels, G = gain - H(azimuth) - V(elevation), as 3GPP TR 38.901, table 7.3-1, has
        it of an element, the vertical cut being that of the front; between the angles of a cut they are interpolated linearly
        in decibels. A file's azimuths run clockwise from above, its elevations down; a gain without a unit is in dBd. An electrical
        tilt is in the cuts; a mechanical one is yours: ``turned((0, tilt_rad, 0))``.

        Args:
            path: the file.
            polarisation: of the antenna; see :class:`Antenna`. The file's own word for it is not read.

        Raises:
            OSError: naming the file, if it cannot be read.
            ValueError: naming file and line, if it is no such file, or damaged.
        """
        return cls(read_cuts(path), polarisation)

    @cached_property
    def rotation(self) -> np.ndarray:
        """Rotation from its own axes, shape ``(3, 3)``."""
        return check_rotation(self.orientation)

    @cached_property
    def _probed(self) -> tuple[bool, float]:
        """Whether the pattern is one of fields, and the largest gain found over the sphere."""
        angles = angles_from_directions(pixel_directions((45, 90)).reshape(-1, 3))
        ahead = angles_from_directions(directions_from_angles([0.5 * np.pi], [0.0]))
        zenith, azimuth = (np.concatenate(pair) for pair in zip(ahead, angles, strict=True))
        if isinstance(self.pattern, _OffBoresight):  # a narrow beam may lie between the directions
            zenith, azimuth = np.full(3601, 0.5 * np.pi), np.linspace(0.0, np.pi, 3601)
        found = [_evaluated(shape, zenith, azimuth) for shape in self._shapes]
        fields = [port.ndim > zenith.ndim for port in found]
        if any(fields) and self.polarisation is not None:
            raise ValueError(
                f"polarisation: got {self.polarisation!r} for a pattern of fields, which has its own; expected None"
            )
        if len(found) > 1 and not all(fields):
            raise ValueError("pattern: got gains for one of several ports, expected pairs of fields for each")
        peak = float(_mean_gain(self._shapes, zenith, azimuth).max())
        if not peak > 0:
            raise ValueError("pattern: got no gain in any direction, expected linear power gains")
        return any(fields), peak

    @property
    def _shapes(self) -> tuple[Shape, ...]:
        if isinstance(self.pattern, str):
            return (PATTERNS[self.pattern],)
        return (self.pattern,) if callable(self.pattern) else tuple(self.pattern)

    @property
    def polarised(self) -> bool:
        """Whether it has fields, so that it goes with Jones matrices; else it goes with powers."""
        return self.polarisation is not None or self._probed[0]

    @property
    def ports(self) -> int:
        """Number of ports."""
        return len(self._shapes if self.polarisation is None else SLANTS_RAD[self.polarisation])

    @property
    def peak_gain(self) -> float:
        """Its largest gain [linear], the mean over the ports, among directions a few degrees apart and along the boresight."""
        return self._probed[1]

    @cached_property
    def efficiency(self) -> float:
        """Mean of the gain over the sphere: power radiated over power accepted; 1 of a lossless antenna."""
        node, weight = np.polynomial.legendre.leggauss(720)  # a beam of a degree takes a few of them
        zenith, azimuth = np.meshgrid(np.arccos(node), (np.arange(1440) + 0.5) * np.pi / 720.0, indexing="ij")
        gain = self.gain(directions_from_angles(zenith, azimuth) @ self.rotation.T)
        return float(0.5 * weight @ gain.mean(axis=1))

    def turned(self, orientation: ArrayLike) -> Antenna:
        """The same antenna turned, with what it was turned by before: yaw, pitch and roll [rad], or a rotation ``(3, 3)``."""
        return replace(self, orientation=check_rotation(orientation) @ self.rotation)

    def unpolarised(self) -> Antenna:
        """The same gain without polarisation, mean over the ports: for what reckons with powers, as beams and readings do."""
        if not self.polarised:
            return self
        own: Any = self.pattern if self.polarisation is not None else partial(_mean_gain, self._shapes)
        return replace(self, pattern=own, polarisation=None)

    def gain(self, directions: ArrayLike) -> np.ndarray:
        """Power gain [linear] towards ``directions`` (..., 3) of any length, shape ``(...)``; the mean over the ports."""
        local = check_array("directions", directions, (..., 3), finite=False) @ self.rotation
        return _mean_gain(self._shapes, *angles_from_directions(local))

    def field(self, directions: ArrayLike) -> np.ndarray:
        """(F_theta, F_phi) along the zenith and azimuth unit vectors of unit vectors ``directions`` (..., 3).

        Returns:
            Shape ``(K, ..., 2)`` of K ports; real where no port's field is complex.

        Raises:
            ValueError: if nothing is known of its polarisation.
        """
        if not self.polarised:
            raise ValueError(
                f"polarisation: got None, expected {', '.join(SLANTS_RAD)}, or a pattern of fields"
            )
        world = check_array("directions", directions, (..., 3), finite=False)
        local = world @ self.rotation
        found = [_evaluated(shape, *angles_from_directions(local)) for shape in self._shapes]
        if self.polarisation is not None:
            slants = np.array(SLANTS_RAD[self.polarisation])
            found = [np.sqrt(found[0])[..., None] * np.array([np.cos(z), np.sin(z)]) for z in slants]
        outside, own = transverse_basis(world), transverse_basis(local)
        turn = np.einsum("...ai,ij,...bj->...ab", outside, self.rotation, own)
        return np.stack([(turn @ port[..., None])[..., 0] for port in found])

    def gain_off_boresight(self, angle: ArrayLike) -> np.ndarray:
        """Power gain [linear] at ``angle`` off boresight [rad], shape as ``angle``, of an antenna that has no other angle.

        Raises:
            ValueError: for one whose gain is a function of two angles.
        """
        if not isinstance(self.pattern, _OffBoresight):
            raise ValueError(
                "pattern: got an antenna whose gain is a function of two angles, expected one that is the same all round its "
                "boresight: a function of the angle off boresight, or samples of it from 0 to pi"
            )
        return self.pattern.at(check_array("angle", angle))


Pattern: TypeAlias = Antenna | str | Callable[[np.ndarray], ArrayLike] | Sequence[float] | np.ndarray
"""An antenna; one of :data:`PATTERNS`; or power gain [linear] over the angle off boresight: a function of it [rad], or samples
of it from 0 to pi."""


def as_antenna(pattern: Pattern, polarisation: str | None = None, name: str = "pattern") -> Antenna:
    """What is meant by a pattern; ``polarisation`` is that of a gain."""
    if isinstance(pattern, Antenna):
        if polarisation is not None and pattern.polarised:
            raise ValueError(f"polarisation: got {polarisation!r} for an antenna with its own, expected None")
        return pattern if polarisation is None else replace(pattern, polarisation=polarisation)
    try:
        if isinstance(pattern, str):
            return Antenna(pattern, polarisation)
        if not callable(pattern):
            samples = check_array("pattern", pattern, finite=False)
            if samples.ndim != 1 or len(samples) < 2:
                raise ValueError(
                    f"pattern: got shape {samples.shape}, expected an Antenna, a function of the angle off boresight, or "
                    "samples (N,) of it from 0 to pi"
                )
            pattern = partial(_interpolated, samples)
        return Antenna(_OffBoresight(pattern), polarisation)
    except (TypeError, ValueError) as error:
        raise type(error)(re.sub("^pattern: |^(?!polarisation)", f"{name}: ", str(error))) from error


def turned_gain(antenna: Antenna, angles: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Power gain [linear] of an antenna turned to each of ``angles`` (D, 2), zenith and azimuth [rad], towards unit vectors
    ``directions`` (K, 3), shape ``(D, K)``. What is turned is a level mount: yaw, then pitch, on which the antenna stands as
    :attr:`Antenna.orientation` says."""
    if isinstance(antenna.pattern, _OffBoresight) and antenna.rotation[0, 0] > 1.0 - 1e-15:  # rolled at most
        cosine = directions_from_angles(*angles.T) @ directions.T
        return antenna.pattern.at(np.arccos(np.clip(cosine, -1.0, 1.0)))
    turns = [rotation_matrix((azimuth, zenith - 0.5 * np.pi, 0.0)) for zenith, azimuth in angles]
    found = [antenna.gain(directions @ turn) for turn in turns]
    return np.reshape(found, (len(angles), len(directions)))


def samples_of(antenna: Antenna) -> np.ndarray:
    """Gains, or fields, by which one antenna is told from another: every half degree, or every twentieth off boresight."""
    if isinstance(antenna.pattern, _OffBoresight) and not antenna.polarised:
        return np.concatenate([antenna.pattern.at(np.linspace(0.0, np.pi, 3601)), antenna.rotation.ravel()])
    directions = pixel_directions((360, 720)).reshape(-1, 3)
    return antenna.field(directions) if antenna.polarised else antenna.gain(directions)


def rotation_matrix(orientation: ArrayLike) -> np.ndarray:
    """Rotation from local to world axes of yaw, pitch and roll [rad]; 3GPP TR 38.901, eq. (7.1-4)."""
    return Rotation.from_euler("ZYX", orientation).as_matrix()


def check_rotation(orientation: ArrayLike) -> np.ndarray:
    """The rotation (3, 3) of three angles or a matrix; ValueError or TypeError names ``orientation``."""
    value = check_array("orientation", orientation)
    if value.shape == (3,):
        if np.abs(value).max() > 2.0 * np.pi:
            raise ValueError(
                f"orientation: got {value.tolist()}, expected yaw, pitch and roll in radians, at most 2 pi"
            )
        return rotation_matrix(value)
    if value.shape != (3, 3) or not np.allclose(value @ value.T, np.eye(3), atol=1e-9):
        raise ValueError(
            f"orientation: got shape {value.shape}, expected three angles (3,) or a rotation (3, 3)"
        )
    if np.linalg.det(value) < 0:
        raise ValueError(
            "orientation: got a matrix of determinant -1, which mirrors the antenna; expected a rotation, of "
            "determinant 1: turn one of its columns round"
        )
    return value


@checked
def horn(width_rad: Positive, floor_db: Annotated[float, within(-200.0, 0.0)] = -60.0) -> Antenna:
    """A horn whose gain is Gaussian in the angle off boresight, lossless.

    Args:
        width_rad: full width at half maximum [rad], at most 2 pi / 3, that of the widest; a larger number is one in degrees.
        floor_db: of the side lobes below the peak [dB].

    Raises:
        ValueError: for other numbers.
    """
    if width_rad > 2.0 * np.pi / 3.0:
        raise ValueError(
            f"width_rad: got {width_rad:g}, expected radians, at most 2.09: "
            f"horn(np.radians({width_rad:g})) is {width_rad:g} degrees wide"
        )
    angle = np.linspace(0.0, np.pi, 20_001)
    mean = 0.5 * np.trapezoid(_horn_gain(width_rad, floor_db, 1.0, angle) * np.sin(angle), angle)
    return Antenna(_OffBoresight(partial(_horn_gain, width_rad, floor_db, mean)))


def main_lobe(antenna: Antenna) -> Antenna:
    """The gain of ``antenna`` without side lobes: nothing beyond where it first stops falling, from the boresight out, below half
    of its peak."""
    angle = np.linspace(0.0, np.pi, 3601)
    if isinstance(antenna.pattern, _OffBoresight):
        end = _flank_end(angle, antenna.pattern.at(angle), antenna.pattern.at(angle).max())
        pattern = _OffBoresight(partial(_up_to, antenna.pattern.gain, end))
        return replace(antenna, pattern=pattern, polarisation=None)
    own = replace(antenna.unpolarised(), orientation=(0.0, 0.0, 0.0))
    around = np.linspace(-np.pi, np.pi, 73)
    gain = own.gain(directions_from_angles(angle[:, None], around)[..., [2, 0, 1]])  # about +x, from +y to +z
    ends = np.array([_flank_end(angle, row, gain.max()) for row in gain.T])
    return replace(antenna, pattern=partial(_within_ends, own, around, ends), polarisation=None)


def _isotropic(zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    return np.ones(zenith.shape)


def _dipole(zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    return np.asarray(1.5 * np.sin(zenith) ** 2)


def _half_wave_dipole(zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    sine = np.sin(zenith)
    steep = sine > 1e-9  # the limit along the axis is zero
    field = np.where(steep, np.cos(0.5 * np.pi * np.cos(zenith)) / np.where(steep, sine, 1.0), 0.0)
    return np.asarray(1.643 * field**2)


def _tr38901(zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    width = np.deg2rad(65.0)  # TR 38.901, table 7.3-1
    vertical = -np.minimum(12.0 * ((zenith - 0.5 * np.pi) / width) ** 2, 30.0)
    horizontal = -np.minimum(12.0 * (azimuth / width) ** 2, 30.0)
    return np.asarray(10.0 ** (0.1 * (8.0 - np.minimum(-(vertical + horizontal), 30.0))))


PATTERNS: dict[str, Shape] = {
    "isotropic": _isotropic, "dipole": _dipole, "half_wave_dipole": _half_wave_dipole, "tr38901": _tr38901,
}  # fmt: skip
"""Power gains by name."""


@dataclass(frozen=True, eq=False)
class _OffBoresight:
    """A gain over the angle off boresight alone."""

    gain: Callable[[np.ndarray], ArrayLike]

    def __call__(self, zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(directions_from_angles(zenith, azimuth), -1, 0)
        return self.at(np.arctan2(np.hypot(y, z), x))

    def at(self, angle: np.ndarray) -> np.ndarray:
        """The gain at ``angle`` [rad], shape as ``angle``."""
        return _checked_gain(self.gain(angle), angle)


def _gridded(zenith: np.ndarray, azimuth: np.ndarray, values: np.ndarray) -> Shape:
    """Values ``(T, P)``, or ``(T, P, 2)``, between zeniths (T,) and azimuths (P,), all the way round; copies."""
    zenith, azimuth, values = zenith.copy(), azimuth.copy(), values.copy()
    if azimuth[-1] - azimuth[0] < 2.0 * np.pi - 1e-6:
        azimuth = np.append(azimuth, azimuth[0] + 2.0 * np.pi)
        values = np.concatenate([values, values[:, :1]], axis=1)
    grid = RegularGridInterpolator((zenith, azimuth), values, bounds_error=False, fill_value=None)
    return partial(_on_grid, grid)


def _on_grid(grid: RegularGridInterpolator, zenith: np.ndarray, azimuth: np.ndarray) -> Any:
    rows, columns = grid.grid
    turned = columns[0] + np.mod(azimuth - columns[0], 2.0 * np.pi)
    found = grid((np.clip(zenith, rows[0], rows[-1]), np.minimum(turned, columns[-1])))
    return found if grid.values.ndim == 2 else (found[..., 0], found[..., 1])


def _mean_gain(ports: Sequence[Shape], zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Gain, the mean over ports of gains or fields, shape as ``zenith``."""
    found = [_evaluated(port, zenith, azimuth) for port in ports]
    gains = [(np.abs(port) ** 2).sum(axis=-1) if port.ndim > zenith.ndim else port for port in found]
    return np.asarray(np.mean(gains, axis=0))


def _within_ends(
    antenna: Antenna, around: np.ndarray, ends: np.ndarray, zenith: np.ndarray, azimuth: np.ndarray
) -> np.ndarray:
    """The gain of an antenna up to ``ends`` (A,) off boresight at the angles ``around`` it (A,)."""
    d = directions_from_angles(zenith, azimuth)
    end = np.interp(np.arctan2(d[..., 2], d[..., 1]), around, ends)
    off = np.arctan2(np.hypot(d[..., 1], d[..., 2]), d[..., 0])
    return np.where(off <= end, antenna.gain(d), 0.0)


def _flank_end(angle: np.ndarray, gain: np.ndarray, peak: float) -> float:
    flank = np.arange(len(gain) - 1) >= gain.argmax()
    past = np.flatnonzero(flank & (gain[:-1] < 0.5 * peak) & (np.diff(gain) >= 0))
    return float(angle[past[0]]) if len(past) else np.pi


def _up_to(gain: Callable[[np.ndarray], ArrayLike], end: float, angle: np.ndarray) -> np.ndarray:
    return np.where(angle <= end, gain(angle), 0.0)


def _horn_gain(width: float, floor_db: float, mean: float, angle: ArrayLike) -> np.ndarray:
    lobe = np.exp(-4.0 * np.log(2.0) * (np.asarray(angle) / width) ** 2)
    return np.maximum(lobe, 10.0 ** (floor_db / 10.0)) / mean


def _interpolated(samples: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.interp(angle, np.linspace(0.0, np.pi, len(samples)), samples)


def _checked_gain(found: ArrayLike, angle: np.ndarray) -> np.ndarray:
    """Gains ``found`` at ``angle``, of its shape. What is no gain is refused; those at unknown angles (NaN) are unknown."""
    gain = check_array("pattern", found, finite=False)
    if gain.shape not in ((), angle.shape):
        raise ValueError(f"pattern: got shape {gain.shape} for angles {angle.shape}, expected the same")
    gain = np.broadcast_to(gain, angle.shape)
    if not np.isfinite(gain[np.isfinite(angle)]).all() or (gain < 0).any():
        raise ValueError("pattern: got negative, NaN or infinite gains, expected linear power gains")
    return gain


def _evaluated(shape: Shape, zenith: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Gains, shape as ``zenith``, or fields ``(..., 2)``."""
    found = shape(zenith, azimuth)
    if isinstance(found, tuple | list):
        if len(found) != 2:
            raise ValueError(f"pattern: got {len(found)} fields, expected two, along zenith and azimuth")
        pair = [
            np.broadcast_to(check_array("pattern", f, dtype=complex, finite=False), zenith.shape)
            for f in found
        ]
        field = np.stack(pair, axis=-1)
        if not np.isfinite(field[np.isfinite(zenith)]).all():
            raise ValueError("pattern: got NaN or infinite fields, expected finite ones")
        return field if np.iscomplexobj(found[0]) or np.iscomplexobj(found[1]) else field.real
    return _checked_gain(found, zenith)
