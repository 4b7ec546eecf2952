"""Gaussians and cameras: what they are, how they are rendered, and rays through them."""

from warprrf.lazy import attach

__getattr__, __dir__, __doc__ = attach(__file__, __doc__)
