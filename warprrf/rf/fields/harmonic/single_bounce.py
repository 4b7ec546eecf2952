"""What a single bounce costs: options of a field, path lengths, spreading loss, and the line of sight.

The law of Song et al., eq. (4): (lambda / (4 pi (l_prev + l_vd)))^2 times the pixel's solid angle for ``rf3dgs+``; the
solid angle alone for ``rf3dgs``. Line of sight comes from the mesh, with Friis gain. Absorption by the air is that of
the path's length; ``rf3dgs``, which has none, learns it with the gain.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.kernels.raster.sh import COEFFICIENTS as DEGREE_TO_COUNT
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.harmonic import interaction as _interaction
from warprrf.rf.fields.harmonic import transport as _transport
from warprrf.rf.fields.harmonic.interaction import Lengths
from warprrf.rf.fields.harmonic.transport import Transport
from warprrf.rf.spectra.spectrum import pixel_solid_angles, spread

if TYPE_CHECKING:
    from warprrf.rf.fields.harmonic.store import StoredTransport

MODELS = ("rf3dgs+", "rf3dgs")
GAINS = ("exp", "linear")


@dataclass(frozen=True)
class FieldOptions:
    """What a field computes; see :meth:`HarmonicField.fit`."""

    model: str = "rf3dgs+"
    transmittance: str = "product"
    interaction_point: str = "centre"
    gain: str = "exp"
    sh_degree: int = 3
    top_k: int = _transport.TOP_K
    line_of_sight: str | None = None

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"model: got {self.model!r}, expected one of {', '.join(MODELS)}")
        for name, known in (
            ("transmittance", _transport.TRANSMITTANCE),
            ("interaction_point", _interaction.INTERACTION_POINTS),
            ("gain", GAINS),
            ("sh_degree", tuple(DEGREE_TO_COUNT)),
            ("line_of_sight", (None, "explicit")),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected one of {known}")
        if not isinstance(self.top_k, int | np.integer) or self.top_k < 1:
            raise ValueError(f"top_k: got {self.top_k!r}, expected a whole number of at least 1")


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
    device: Any = None
    air: Air | None = None

    @property
    def wavelength_m(self) -> float:
        """Wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    def factor(self, lengths: Lengths) -> np.ndarray:
        """Solid angle [sr], times spreading loss for ``rf3dgs+``; zero where the ray meets nothing."""
        solid_angle = pixel_solid_angles(self.shape)[:, None]
        if self.options.model == "rf3dgs":
            return np.where(np.isfinite(lengths.total), solid_angle, 0.0)
        with np.errstate(divide="ignore"):
            loss = (self.wavelength_m / (4 * np.pi * lengths.total)) ** 2
        loss = self._through_air(loss, lengths.total)
        return np.where(np.isfinite(loss), solid_angle * loss, 0.0)

    def lengths(self, seen: Transport | StoredTransport, transmitter: np.ndarray) -> Lengths:
        """Path lengths of every pixel of ``seen`` by the interaction point that the options name."""
        points = _interaction.interaction_points(
            seen, self.gaussians, self.options.interaction_point, mesh=self.mesh, device=self.device
        )
        return _interaction.path_lengths(points, transmitter, seen.receivers)

    def line_of_sight(self, receiver: np.ndarray, transmitter: np.ndarray) -> tuple[bool, float]:
        """Whether the mesh lets them see each other, and their Friis gain, less absorption."""
        distance = float(np.linalg.norm(receiver - transmitter))
        if distance == 0:
            raise ValueError("rx: got the transmitter's own position; expected them apart")
        visible = self.mesh is not None and bool(
            self.mesh.visible(receiver[None], transmitter[None], device=self.device)[0]
        )
        friis = (self.wavelength_m / (4 * np.pi * distance)) ** 2
        return visible, float(self._through_air(friis, distance))

    def _through_air(self, gain: Any, length_m: Any) -> Any:
        """``gain`` less what ``length_m`` [m] of air absorb."""
        return gain if self.air is None else gain * self.air.transmittance(self.frequency_hz, length_m)

    def beam(self, receiver: np.ndarray, transmitter: np.ndarray) -> np.ndarray | None:
        """The explicit line of sight's beam on the grid, or None."""
        if self.options.line_of_sight != "explicit":
            return None
        visible, gain = self.line_of_sight(receiver, transmitter)
        if not visible:
            return None
        toward = (transmitter - receiver)[None]
        return spread(toward, np.array([gain]), self.shape, self.beam_sigma_rad, device=self.device)
