"""What a harmonic field computes and how it is fitted; what a single bounce costs: path lengths, spreading, line of sight.

The law of Song et al., eq. (4): (lambda / (4 pi (l_prev + l_vd)))^2 times the pixel's solid angle for ``rf3dgs+``; the
solid angle alone for ``rf3dgs``. Line of sight comes from the mesh, with Friis gain. Absorption by the air is that of
the path's length; ``rf3dgs``, which has none, learns it with the gain.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field

import numpy as np

from warprrf.checks import check_count, check_seed, checked
from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.kernels.raster.sh import COEFFICIENTS as DEGREE_TO_COUNT
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.harmonic.transport import (
    INTERACTION_POINTS,
    TOP_K,
    TRANSMITTANCE,
    Lengths,
    Transport,
    interaction_points,
    path_lengths,
)
from warprrf.rf.spectra.spectrum import pixel_solid_angles, spread

MODELS = ("rf3dgs+", "rf3dgs")
GAINS = ("exp", "linear")


@dataclass(frozen=True)
class Rates:
    """How fast coefficients learn and how firmly they stay where the data says little.

    Attributes:
        constant: Adam rate of the degree-0 coefficient [nepers of gain, or units of the channel].
        directional: rate of the others. (RF-3DGS' 2.5e-3 and 1.25e-4 are for 8-bit colours over 10 000 steps; a gain
            spans 14 nepers and is fitted in a few hundred.)
        ridge: pull towards the initial value, in pixels: how many pixels' L1 pull it balances at a deviation of one.
            A Gaussian that many pixels see hardly feels it, a rarely seen one stays near its initial value.
        ridge_directional: the same for the other coefficients.
    """

    constant: float = 0.2
    directional: float = 0.1
    ridge: float = 0.02
    ridge_directional: float = 0.2


@checked
@dataclass(frozen=True)
class FieldOptions:
    """What a field computes, and how :meth:`HarmonicField.fit` learns it.

    Attributes:
        model: ``"rf3dgs+"`` or ``"rf3dgs"``.
        transmittance: ``"product"`` of (1 - alpha), or the paper's ``"exp"`` of minus the sum of alphas.
        interaction_point: ``"centre"`` of the dominant Gaussian (the paper), ``"peak"``, ``"expected"``, ``"mesh"``.
        gain: ``"exp"`` of the harmonics or ``"linear"``, clamped at zero.
        sh_degree: 0 to 3.
        top_k: Gaussians kept per pixel.
        line_of_sight: None (the paper: surfaces must carry it), or ``"explicit"``: Friis gain where the mesh lets the
            transmitter be seen, spread by the data set's beam.
        iterations: optimiser steps of the gain, ``batch`` receivers each; twice as many change the test PSNR by less
            than 0.1 dB.
        batch: receivers per step.
        rates: learning rates and ridge.
        train_opacity: also train the opacities with the gain, as RF-3DGS does; the field then has Gaussians of its own
            opacities. Needs the ``product`` transmittance.
        checkpoint: file to save progress to and go on from; removed when the fit is done, and no part of a field.
        seed: of the batches.

    Raises:
        ValueError: for a value that is not allowed.
    """

    model: str = "rf3dgs+"
    transmittance: str = "product"
    interaction_point: str = "centre"
    gain: str = "exp"
    sh_degree: int = 3
    top_k: int = TOP_K
    line_of_sight: str | None = None
    iterations: int = 300
    batch: int = 10
    rates: Rates = Rates()
    train_opacity: bool = False
    checkpoint: str | os.PathLike[str] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f"model: got {self.model!r}, expected one of {', '.join(MODELS)}")
        for name, known in (
            ("transmittance", TRANSMITTANCE),
            ("interaction_point", INTERACTION_POINTS),
            ("gain", GAINS),
            ("sh_degree", tuple(DEGREE_TO_COUNT)),
            ("line_of_sight", (None, "explicit")),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected one of {known}")
        for name, least in (("top_k", 1), ("iterations", 0), ("batch", 1)):
            check_count(name, getattr(self, name), least)
        check_seed(self.seed)
        if self.train_opacity and self.transmittance != "product":
            raise ValueError(f"train_opacity: got transmittance {self.transmittance!r}, expected 'product'")


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
            raise ValueError("receivers: got the transmitter's own position; expected them apart")
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
