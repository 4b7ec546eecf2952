"""Channels from propagation paths: arrays, frequency responses, dispersion, beams, precoders, the band plan.

``path_arrays`` holds paths, whoever found them. From them ``response`` computes channels between two ``arrays``
(``sums``: over paths, with what elements add to their lengths), ``dispersion`` spreads in delay and angle,
``beams`` and ``precoding`` what to send, ``band_plan`` the channels of IEEE 802.15.3d. Nothing here knows of a field,
of an engine or of how paths are found.
"""

from warprrf.lazy import attach

__getattr__, __dir__, __doc__ = attach(__file__, __doc__)
