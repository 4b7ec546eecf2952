"""Propagation paths without scattering: line of sight, mirrors (image method), slabs, edges; and what is made of path lists."""

from warprrf.lazy import attach

__getattr__, __dir__, __doc__ = attach(__file__, __doc__)
