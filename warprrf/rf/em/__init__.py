"""Electromagnetics of waves and surfaces: carriers, materials, Fresnel reflection, absorption by the air."""

from warprrf.lazy import attach

__getattr__, __dir__, __doc__ = attach(__file__, __doc__)
