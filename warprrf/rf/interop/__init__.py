"""Other people's software and files: Sionna RT, DeepMIMO, digital twins for ray tracers."""

from warprrf.lazy import attach

__getattr__, __dir__, __doc__ = attach(__file__, __doc__)
