"""Electromagnetics of waves and surfaces: carriers, materials, Fresnel reflection, absorption by the air."""
