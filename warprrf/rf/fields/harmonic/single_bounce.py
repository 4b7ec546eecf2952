"""What a single bounce costs: path lengths, spreading loss, and the line of sight.

The law of Song et al., eq. (4): (lambda / (4 pi (l_prev + l_vd)))^2 times the pixel's solid angle for ``rf3dgs+``; the
solid angle alone for ``rf3dgs``. Line of sight comes from the mesh, with Friis gain. Absorption by the air is that of
the path's length; ``rf3dgs``, which has none, learns it with the gain.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.harmonic.options import FieldOptions
from warprrf.rf.fields.harmonic.transport import Lengths, Transport, interaction_points, path_lengths
from warprrf.rf.spectra.spectrum import pixel_solid_angles, spread


@dataclass(frozen=True, eq=False)
class SingleBounce:
    """Geometry and law that turn blending weights into power.

    Attributes:
        gaussians, mesh: frozen geometry.
        options: which law.
        shape: rows and columns of a spectrum.
        frequency_hz: carrier [Hz].
        beam_sigma_rad: receiver beam of an explicit line of sight [rad].
        air: absorption by the air; None for none.
    """

    gaussians: Gaussians = field(repr=False)
    mesh: Mesh | None = field(repr=False)
    options: FieldOptions
    shape: tuple[int, int]
    frequency_hz: float
    beam_sigma_rad: float
    air: Air | None = None
    device: DeviceLike = None

    def lengths(self, seen: Transport, transmitter: np.ndarray) -> Lengths:
        """Path lengths of every pixel of ``seen`` by the interaction point that the options name."""
        points = interaction_points(
            seen, self.gaussians, self.options.interaction_point, mesh=self.mesh, device=self.device
        )
        return path_lengths(points, transmitter, seen.receivers)

    def factor(self, lengths: Lengths) -> np.ndarray:
        """Solid angle [sr], times spreading loss for ``rf3dgs+``; zero where the ray meets nothing."""
        solid_angle = pixel_solid_angles(self.shape)[:, None]
        if self.options.model == "rf3dgs":
            return np.where(np.isfinite(lengths.total), solid_angle, 0.0)
        loss = self._free_space(lengths.total)
        return np.where(np.isfinite(loss), solid_angle * loss, 0.0)

    def line_of_sight(self, receiver: np.ndarray, transmitter: np.ndarray) -> tuple[bool, float]:
        """Whether the mesh lets them see each other, and their Friis gain, less absorption."""
        distance = float(np.linalg.norm(receiver - transmitter))
        if distance == 0:
            raise ValueError("rx: got the transmitter's own position; expected them apart")
        visible = self.mesh is not None and bool(
            self.mesh.visible(receiver, transmitter, device=self.device)[0]
        )
        return visible, float(self._free_space(distance))

    def beam(self, receiver: np.ndarray, transmitter: np.ndarray) -> np.ndarray | None:
        """The explicit line of sight's beam on the grid, or None."""
        if self.options.line_of_sight != "explicit":
            return None
        visible, gain = self.line_of_sight(receiver, transmitter)
        if not visible:
            return None
        toward = (transmitter - receiver)[None]
        return spread(toward, np.array([gain]), self.shape, self.beam_sigma_rad, device=self.device)

    def _free_space(self, length_m: float | np.ndarray) -> float | np.ndarray:
        """Gain of a path of ``length_m`` [m] between isotropic antennas, less what the air absorbs."""
        with np.errstate(divide="ignore"):
            gain = (SPEED_OF_LIGHT / self.frequency_hz / (4 * np.pi * length_m)) ** 2
        return gain if self.air is None else gain * self.air.transmittance(self.frequency_hz, length_m)
