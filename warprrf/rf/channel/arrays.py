"""Antenna arrays: element positions, patterns and polarisation, plane-wave and spherical-wave responses.

An array lies in its local y-z plane and looks along local +x, as in Sionna RT and 3GPP TR 38.901: rows run down (-z),
columns along +y, elements are numbered down each column, the first column first. ``orientation`` turns it: yaw about z,
then pitch about the new y, then roll about the new x (TR 38.901, eq. (7.1-4)).

Element patterns: "isotropic"; "dipole", the short dipole along local z, gain 1.5 sin^2 (Balanis, Antenna Theory, eq.
(4-26a)); "half_wave_dipole", 1.643 (cos(pi/2 cos theta) / sin theta)^2 (eq. (4-84)); "tr38901", 3GPP TR 38.901 table
7.3-1 (8 dBi, 65 degrees, 30 dB); or a rotationally symmetric one as :meth:`SpectrumDataset.deembed` takes it.

Polarisation: an array without one (None) is driven by powers: its amplitude is the root of the element's power gain,
for paths that carry the power of all polarisations. With one, elements are polarised along the slant angle zeta,
(F_theta, F_phi) = sqrt(gain) (cos zeta, sin zeta) in the local frame (TR 38.901, eqs. (7.3-4), (7.3-5), model 2), and
channels need the Jones matrices of the paths. A dual-polarised element has two ports; ports are numbered
polarisation by polarisation, then element by element.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from warprrf.cache import cached_property
from warprrf.checks import check_array, check_choice, check_count, check_positive, checked
from warprrf.rf.spectra.antenna import Pattern, sample_pattern
from warprrf.rf.spectra.spectrum import angles_from_directions, transverse_basis, unit_vectors

PATTERNS = ("isotropic", "dipole", "half_wave_dipole", "tr38901")
SLANTS_RAD = {
    "V": (0.0,),
    "H": (0.5 * np.pi,),
    "VH": (0.0, 0.5 * np.pi),
    "cross": (-0.25 * np.pi, 0.25 * np.pi),
}
"""Slant angle of each port of an element, by the name of its polarisation."""


@checked
@dataclass(frozen=True)
class PlanarArray:
    """A planar array of equal elements.

    Args:
        rows: Elements down the array.
        cols: Elements across the array.
        spacing: Distance between elements in carrier wavelengths: one number, or that of rows and that of columns.
        orientation: Yaw, pitch and roll [rad], or a rotation matrix from local to world axes, shape ``(3, 3)``.
        pattern: One of :data:`PATTERNS`, or a power gain [linear] over the angle off boresight: a function of angles
            [rad] or samples at equally spaced angles from 0 to pi.
        polarisation: None, "V", "H", "VH" or "cross".

    Raises:
        TypeError, ValueError: naming the argument.
    """

    rows: int
    cols: int
    spacing: ArrayLike = 0.5
    orientation: ArrayLike = (0.0, 0.0, 0.0)
    pattern: str | Pattern = "isotropic"
    polarisation: str | None = None

    def __post_init__(self) -> None:
        for name in ("rows", "cols"):
            check_count(name, getattr(self, name))
        spacing = check_array("spacing", self.spacing)
        if spacing.shape not in ((), (2,)) or (spacing <= 0).any():
            raise ValueError(f"spacing: got {self.spacing!r}, expected one or two positive numbers")
        if isinstance(self.pattern, str):
            check_choice("pattern", self.pattern, PATTERNS)
        check_choice("polarisation", self.polarisation, (None, *SLANTS_RAD))
        _ = self.rotation

    @property
    def elements(self) -> int:
        """Number of elements."""
        return int(self.rows) * int(self.cols)

    @property
    def ports(self) -> int:
        """Number of ports: elements times polarisations."""
        return self.elements * (1 if self.polarisation is None else len(SLANTS_RAD[self.polarisation]))

    @cached_property
    def rotation(self) -> np.ndarray:
        """Rotation from local to world axes, shape ``(3, 3)``."""
        value = check_array("orientation", self.orientation)
        if value.shape == (3,):
            return rotation_matrix(value)
        turned = value.shape == (3, 3) and np.allclose(value @ value.T, np.eye(3), atol=1e-9)
        if not turned or np.linalg.det(value) < 0:
            raise ValueError(
                f"orientation: got shape {value.shape}, expected three angles (3,), or a rotation (3, 3) of determinant 1: "
                "one of -1 mirrors the array"
            )
        return value

    def positions(self, wavelength_m: float) -> np.ndarray:
        """Elements about the array's centre in world axes [m], shape ``(N, 3)``; ``wavelength_m`` is the carrier's."""
        wavelength = check_positive("wavelength_m", wavelength_m, "number of metres")
        down, across = np.broadcast_to(np.asarray(self.spacing, dtype=np.float64), (2,)) * wavelength
        column, row = np.divmod(np.arange(self.elements), self.rows)
        local = np.zeros((self.elements, 3))
        local[:, 1] = (column - 0.5 * (self.cols - 1)) * across
        local[:, 2] = (0.5 * (self.rows - 1) - row) * down
        return local @ self.rotation.T

    def gain(self, directions: ArrayLike) -> np.ndarray:
        """Power gain of an element [linear] towards world ``directions`` (..., 3), shape ``(...)``."""
        local = check_array("directions", directions, (..., 3), finite=False) @ self.rotation
        return _pattern_gain(self.pattern, local)

    def field(self, directions: ArrayLike) -> np.ndarray:
        """Polarised amplitude of each port of an element along world zenith and azimuth unit vectors.

        Returns:
            Shape ``(K, ..., 2)`` for K ports an element, real.

        Raises:
            ValueError: if the array has no polarisation.
        """
        if self.polarisation is None:
            raise ValueError("polarisation: got None, expected 'V', 'H', 'VH' or 'cross'")
        world = check_array("directions", directions, (..., 3), finite=False)
        local = world @ self.rotation
        size = np.sqrt(_pattern_gain(self.pattern, local))
        turn = np.einsum(
            "...ai,ij,...bj->...ab", transverse_basis(world), self.rotation, transverse_basis(local)
        )
        slants = SLANTS_RAD[self.polarisation]
        return np.stack(
            [size[..., None] * (turn @ np.array([np.cos(zeta), np.sin(zeta)])) for zeta in slants]
        )

    def response(self, directions: ArrayLike, wavelength_m: float) -> np.ndarray:
        """Plane-wave response exp(j 2 pi / lambda d . u) of elements at d to world ``directions`` u (..., 3).

        Args:
            wavelength_m: lambda, of the wave, that the spacing is counted in.

        Returns:
            Shape ``(..., N)``, complex, of unit modulus, phase zero at the array's centre.
        """
        reach = check_array("directions", directions, (..., 3), finite=False) @ self.positions(wavelength_m).T
        return np.exp(2j * np.pi / wavelength_m * reach)

    def spherical_response(self, points: ArrayLike, wavelength_m: float) -> np.ndarray:
        """Response to a source at ``points`` (..., 3) [m] from the array's centre, relative to that at the centre.

        Every element's own distance counts, in phase and (as its inverse) in amplitude: r / r_n exp(-j 2 pi (r_n -
        r) / lambda). Shape ``(..., N)``, complex; other arguments as in :meth:`response`.
        """
        source = check_array("points", points, (..., 3), finite=False)[..., None, :]
        place = self.positions(wavelength_m)
        far = np.linalg.norm(source, axis=-1)
        each = np.linalg.norm(source - place, axis=-1)
        # r_n - r without cancellation: (|d|^2 - 2 d . p) / (r_n + r).
        longer = ((place**2).sum(axis=-1) - 2.0 * (source * place).sum(axis=-1)) / (each + far)
        return far / each * np.exp(-2j * np.pi / wavelength_m * longer)


def rotation_matrix(orientation: ArrayLike) -> np.ndarray:
    """Rotation from local to world axes of yaw, pitch and roll [rad]; 3GPP TR 38.901, eq. (7.1-4)."""
    return Rotation.from_euler("ZYX", orientation).as_matrix()


@checked
def orientation_towards(direction: ArrayLike) -> tuple[float, float, float]:
    """Yaw, pitch and roll [rad] that point an array's boresight along ``direction`` (3,), columns level.

    Raises:
        ValueError: for a vector without length.
    """
    zenith, azimuth = angles_from_directions(unit_vectors("direction", direction, (3,)))
    return float(azimuth), float(zenith - 0.5 * np.pi), 0.0


@checked
@dataclass(frozen=True)
class PlaneWaveError:
    """What taking a spherical wave for a plane one costs an array.

    Attributes:
        phase_rad: Largest phase error of an element against the array's centre [rad].
        beam_loss_db: Power that a beam loses which is steered by the plane wave, against one matched to the spherical
            wave [dB].
        entry_error: Largest error of an element's response, relative to that at the centre.
    """

    phase_rad: float
    beam_loss_db: float
    entry_error: float


@checked
def plane_wave_error(
    array: PlanarArray, distance_m: float, wavelength_m: float, direction: ArrayLike = (1.0, 0.0, 0.0)
) -> PlaneWaveError:
    """Error of the plane wave from a source ``distance_m`` away in world ``direction``.

    On boresight the largest phase error tends to pi D^2 / (4 lambda r) for an aperture D (its diagonal): pi / 8 at the
    Fraunhofer distance 2 D^2 / lambda.

    Raises:
        ValueError: for a distance or wavelength that is not positive.
    """
    for name, value in (("distance_m", distance_m), ("wavelength_m", wavelength_m)):
        check_positive(name, value, "number of metres")
    unit = unit_vectors("direction", direction, (3,))
    plane = array.response(unit, wavelength_m)
    true = array.spherical_response(distance_m * unit, wavelength_m)
    shares = np.abs(np.vdot(plane, true)) ** 2 / (len(true) * np.sum(np.abs(true) ** 2))
    # Not wrapped: r_n - (r - u . d) for elements at d, by r_n^2 = (r - u . d)^2 + across.
    place = array.positions(wavelength_m)
    along = place @ unit
    across = (place**2).sum(axis=1) - along**2
    extra = across / (np.linalg.norm(distance_m * unit - place, axis=1) + np.abs(distance_m - along))
    return PlaneWaveError(
        phase_rad=float(2.0 * np.pi / wavelength_m * extra.max()),
        beam_loss_db=float(-10.0 * np.log10(shares)),
        entry_error=float(np.abs(plane - true).max()),
    )


def _pattern_gain(pattern: str | Pattern, local: np.ndarray) -> np.ndarray:
    """Power gain [linear] of ``pattern`` towards ``local`` unit directions (..., 3)."""
    if not isinstance(pattern, str):
        angle = np.arctan2(np.hypot(local[..., 1], local[..., 2]), local[..., 0])
        gain = sample_pattern(pattern, angle)
        if not np.isfinite(gain).all() or (gain < 0).any():
            raise ValueError("pattern: got negative, NaN or infinite gains, expected linear power gains")
        return gain
    zenith, azimuth = angles_from_directions(local)
    if pattern == "isotropic":
        return np.ones(zenith.shape)
    if pattern == "dipole":
        return 1.5 * np.sin(zenith) ** 2
    if pattern == "half_wave_dipole":
        sine = np.maximum(np.sin(zenith), 1e-9)  # the limit along the axis is zero
        return 1.643 * (np.cos(0.5 * np.pi * np.cos(zenith)) / sine) ** 2
    width = np.deg2rad(65.0)  # TR 38.901, table 7.3-1
    vertical = -np.minimum(12.0 * ((zenith - 0.5 * np.pi) / width) ** 2, 30.0)
    horizontal = -np.minimum(12.0 * (azimuth / width) ** 2, 30.0)
    return 10.0 ** (0.1 * (8.0 - np.minimum(-(vertical + horizontal), 30.0)))


def check_unpolarised(name: str, array: PlanarArray, why: str) -> None:
    """Raise ValueError, naming the argument, for an array with a polarisation; ``why`` there may be none."""
    if array.polarisation is not None:
        raise ValueError(f"{name}: got polarisation {array.polarisation!r}, expected None: {why}")


ISOTROPIC = PlanarArray(1, 1)
"""One isotropic element without polarisation."""
