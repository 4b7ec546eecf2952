"""Antenna arrays: element positions, patterns and polarisation, plane-wave and spherical-wave responses.

An array lies in its local y-z plane and looks along local +x, as in Sionna RT and 3GPP TR 38.901: rows run down (-z),
columns along +y, elements are numbered down each column, the first column first. ``orientation`` turns it: yaw about z,
then pitch about the new y, then roll about the new x (TR 38.901, eq. (7.1-4)).

Elements are equal antennas (:mod:`warprrf.rf.spectra.antenna`), turned with the array. An array whose elements have no
polarisation is driven by powers: its amplitude is the root of the element's power gain, for paths that carry the power of all
polarisations. With one, channels need the Jones matrices of the paths. Ports are numbered port by port of an element,
then element by element.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from warprrf.cache import cached_property
from warprrf.checks import Count, check_array, checked, positive
from warprrf.geometry.mesh import headings
from warprrf.rf.spectra.antenna import Antenna, Pattern, as_antenna, check_rotation
from warprrf.rf.spectra.spectrum import angles_from_directions, unit_vectors

Metres: TypeAlias = Annotated[float, positive("number of metres")]


@checked
@dataclass(frozen=True)
class PlanarArray:
    """A planar array of equal elements.

    Args:
        rows: Elements down the array.
        cols: Elements across the array.
        spacing: Distance between elements in carrier wavelengths: one number, or that of rows and that of columns.
        orientation: Yaw, pitch and roll [rad], or a rotation matrix from local to world axes, shape ``(3, 3)``.
        pattern: An element: an :class:`Antenna`, or one of its names, or a power gain [linear] over the angle off boresight: a
            function of angles [rad] or samples at equally spaced angles from 0 to pi.
        polarisation: None, "V", "H", "VH" or "cross"; None of an element that has its own.

    Raises:
        TypeError, ValueError: naming the argument.
    """

    rows: Count
    cols: Count
    spacing: ArrayLike = 0.5
    orientation: ArrayLike = (0.0, 0.0, 0.0)
    pattern: Pattern = "isotropic"
    polarisation: str | None = None

    def __post_init__(self) -> None:
        spacing = check_array("spacing", self.spacing)
        if spacing.shape not in ((), (2,)) or (spacing <= 0).any():
            raise ValueError(f"spacing: got {self.spacing!r}, expected one or two positive numbers")
        _ = self.rotation, self.element

    @property
    def elements(self) -> int:
        """Number of elements."""
        return int(self.rows) * int(self.cols)

    @property
    def ports(self) -> int:
        """Number of ports: elements times theirs."""
        return self.elements * self.element.ports

    @property
    def directed(self) -> bool:
        """Whether directions of paths count: all but one isotropic element without polarisation."""
        return self.ports > 1 or self.element.polarised or self.element.pattern != "isotropic"

    @cached_property
    def element(self) -> Antenna:
        """An element, turned as it stands in the world."""
        return as_antenna(self.pattern, self.polarisation).turned(self.rotation)

    @cached_property
    def rotation(self) -> np.ndarray:
        """Rotation from local to world axes, shape ``(3, 3)``."""
        return check_rotation(self.orientation)

    def positions(self, wavelength_m: Metres) -> np.ndarray:
        """Elements about the array's centre in world axes [m], shape ``(N, 3)``; ``wavelength_m`` is the carrier's."""
        down, across = np.broadcast_to(np.asarray(self.spacing, dtype=np.float64), (2,)) * wavelength_m
        column, row = np.divmod(np.arange(self.elements), self.rows)
        local = np.zeros((self.elements, 3))
        local[:, 1] = (column - 0.5 * (self.cols - 1)) * across
        local[:, 2] = (0.5 * (self.rows - 1) - row) * down
        return local @ self.rotation.T

    def gain(self, directions: ArrayLike) -> np.ndarray:
        """Power gain of an element [linear] towards world ``directions`` (..., 3), shape ``(...)``; the mean over its ports."""
        return self.element.gain(directions)

    def field(self, directions: ArrayLike) -> np.ndarray:
        """Polarised amplitude of each port of an element along world zenith and azimuth unit vectors; see :meth:`Antenna.field`."""
        return self.element.field(directions)

    def response(self, directions: ArrayLike, wavelength_m: float) -> np.ndarray:
        """Plane-wave response exp(j 2 pi / lambda d . u) of elements at d to world ``directions`` u (..., 3), made of length one.

        Args:
            wavelength_m: lambda, of the wave, that the spacing is counted in.

        Returns:
            Shape ``(..., N)``, complex, of unit modulus, phase zero at the array's centre.
        """
        toward, _ = headings(check_array("directions", directions, (..., 3), finite=False))
        return np.exp(2j * np.pi / wavelength_m * (toward @ self.positions(wavelength_m).T))

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
    array: PlanarArray, distance_m: Metres, wavelength_m: Metres, direction: ArrayLike = (1.0, 0.0, 0.0)
) -> PlaneWaveError:
    """Error of the plane wave from a source ``distance_m`` away in world ``direction``.

    On boresight the largest phase error tends to pi D^2 / (4 lambda r) for an aperture D (its diagonal): pi / 8 at the
    Fraunhofer distance 2 D^2 / lambda.

    Raises:
        ValueError: for a distance or wavelength that is not positive.
    """
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


ISOTROPIC = PlanarArray(1, 1)
"""One isotropic element without polarisation."""

End: TypeAlias = PlanarArray | Antenna | None
"""What stands at an end of a link: an array, a single antenna, or one that is isotropic and has no polarisation."""


def array_of(name: str, end: End) -> PlanarArray:
    """The array at an end; TypeError names the argument."""
    if end is None:
        return ISOTROPIC
    if isinstance(end, Antenna):
        return PlanarArray(1, 1, pattern=end)
    if not isinstance(end, PlanarArray):
        raise TypeError(f"{name}: got {type(end).__name__}, expected a PlanarArray or an Antenna")
    return end


def check_unpolarised(name: str, array: PlanarArray) -> None:
    """Raise ValueError, naming the argument, for elements with a polarisation."""
    if array.element.polarised:
        raise ValueError(
            f"{name}: got polarisation {array.polarisation or 'of its own'!r}, expected None: powers are reckoned with here, "
            "which Antenna.unpolarised() goes with"
        )
