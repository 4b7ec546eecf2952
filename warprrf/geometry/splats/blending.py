"""How responses of Gaussians become an image: cutoff, clamp, early exit and transmittance rule."""

from __future__ import annotations

from dataclasses import dataclass

from warprrf.checks import checked
from warprrf.kernels.raster import view as kernels

RULES = {"product": kernels.PRODUCT, "exp": kernels.EXPONENTIAL}


@checked
@dataclass(frozen=True)
class Blending:
    """How responses become an image; the defaults suit 8-bit photos.

    Attributes:
        alpha_min: a Gaussian contributes where ``opacity * response`` reaches this.
        alpha_max: clamp of alpha, so that no layer is fully opaque. With 1 allowed, a layer of alpha exactly one hides
            what is behind it from its own gradient as well (``product``).
        transmittance_min: a pixel is finished when less light than this is left.
        rule: ``"product"`` of (1 - alpha), or ``"exp"`` of minus the sum of alphas (the paper's equation for T_k, which
            can blend to more than one).

    Raises:
        ValueError: naming the setting that is out of range.
    """

    alpha_min: float = 1 / 255  # below this a Gaussian cannot change an 8-bit pixel
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    rule: str = "product"

    def __post_init__(self) -> None:
        for name, low, high in (("alpha_min", 0, 1), ("alpha_max", 0, 1), ("transmittance_min", -1, 1)):
            value = getattr(self, name)
            if not low < value <= high:
                raise ValueError(f"{name}: got {value!r}, expected a number in ({low}, {high}]")
        if self.rule not in RULES:
            raise ValueError(f"rule: got {self.rule!r}, expected one of {sorted(RULES)}")

    @property
    def rules(self) -> kernels.Rules:
        """As the kernels take it."""
        rules = kernels.Rules()
        rules.alpha_min, rules.alpha_max = self.alpha_min, self.alpha_max
        rules.transmittance_min, rules.rule = self.transmittance_min, RULES[self.rule]
        return rules


# An image 60 dB deep: a layer clamped at 0.99 would leak -20 dB, so alpha may come within 1e-6 of one.
RADIO = Blending(alpha_min=1e-4, alpha_max=1 - 1e-6, transmittance_min=1e-6)
