"""What a harmonic field computes and how it is fitted."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated

from warprrf.checks import Count, Seed, checked, one_of, whole
from warprrf.kernels.raster.sh import COEFFICIENTS as DEGREE_TO_COUNT
from warprrf.rf.fields.harmonic.transport import TOP_K


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


GAIN_RATES = Rates()
CHANNEL_RATES = Rates(constant=0.1, directional=0.05, ridge=0.02, ridge_directional=0.1)


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
        train_opacity: also train the opacities with the gain, as RF-3DGS does; the field then has Gaussians of its own
            opacities. Needs the ``product`` transmittance.
        checkpoint: file to save progress to and go on from; removed when the fit is done, and no part of a field.
        seed: of the batches.

    Raises:
        ValueError: for a value that is not allowed.
    """

    model: Annotated[str, one_of("rf3dgs+", "rf3dgs")] = "rf3dgs+"
    transmittance: Annotated[str, one_of("product", "exp")] = "product"
    interaction_point: Annotated[str, one_of("centre", "peak", "expected", "mesh")] = "centre"
    gain: Annotated[str, one_of("exp", "linear")] = "exp"
    sh_degree: Annotated[int, one_of(*DEGREE_TO_COUNT)] = 3
    top_k: Count = TOP_K
    line_of_sight: Annotated[str | None, one_of(None, "explicit")] = None
    iterations: Annotated[int, whole(0)] = 300
    batch: Count = 10
    train_opacity: bool = False
    checkpoint: str | os.PathLike[str] | None = None
    seed: Seed = 0

    def __post_init__(self) -> None:
        if self.train_opacity and self.transmittance != "product":
            raise ValueError(f"train_opacity: got transmittance {self.transmittance!r}, expected 'product'")
