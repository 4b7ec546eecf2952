"""What a bistatic field models, and how finely."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warprrf.checks import check_array, check_count, checked
from warprrf.rf.em.materials import NARROWEST_LOBE

LOBES = (0, 2, 5, 12, 30)
"""Exponents of the lobe mix; 0 is Lambertian."""


@checked
@dataclass(frozen=True)
class Terms:
    """What a bistatic field models; see :class:`warprrf.rf.fields.bistatic.training.FitOptions`.

    Attributes:
        line_of_sight, diffuse: whether there are such paths.
        mirror_order: most mirror reflections on a path, 0 to 3.
        lobes: exponents of the scattering lobes, 0 for Lambertian, at most 1000 and each once.
        reciprocal: whether single bounces keep their power when the ends are swapped; see
            :mod:`warprrf.rf.fields.bistatic.scattering`.
        mirror_scatter: whether mirrors light surfaces.
        scatter_mirror: whether mirrors show the lit scene.
        diffuse_order: diffuse bounces on a path, 1 to 3.
        indirect: whether groups have an indirect radiance.
        residual: whether surfaces differ within their group.
        sub_pixels: square root of the rays per pixel, 1 to 16.
    """

    line_of_sight: bool = True
    diffuse: bool = True
    mirror_order: int = 1
    lobes: tuple[int, ...] = LOBES
    reciprocal: bool = False
    mirror_scatter: bool = False
    scatter_mirror: bool = False
    diffuse_order: int = 1
    indirect: bool = False
    residual: bool = False
    sub_pixels: int = 3

    def __post_init__(self) -> None:
        whole = {"mirror_order": (0, 3), "diffuse_order": (1, 3), "sub_pixels": (1, 16)}
        for name, (least, most) in whole.items():
            check_count(name, getattr(self, name), least, most)
        lobes = check_array("lobes", self.lobes, (None,), dtype=np.int64).tolist()
        if not lobes or len(set(lobes)) < len(lobes) or not 0 <= min(lobes) <= max(lobes) <= NARROWEST_LOBE:
            raise ValueError(
                f"lobes: got {self.lobes!r}, expected different exponents, whole numbers from 0 to {NARROWEST_LOBE}"
            )
        object.__setattr__(self, "lobes", tuple(lobes))

    @property
    def further(self) -> bool:
        """Whether elements send on what other surfaces scattered to them."""
        return self.diffuse and self.diffuse_order > 1

    @property
    def after_first_bounce(self) -> bool:
        """Whether there is light that comes over more than one surface, or a mirror and a surface."""
        return self.further or self.mirror_scatter or self.scatter_mirror
