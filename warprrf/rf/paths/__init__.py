"""Propagation paths: line of sight and mirror reflections by the image method, and what is made of path lists."""

from warprrf.lazy import attach

__getattr__, __dir__, __doc__ = attach(__file__, __doc__)
