"""warprrf: radio radiance fields from photos and a few radio measurements.

Stage 1 reconstructs a room's geometry from photos (:func:`reconstruct`); stage 2 fits a radio field to sparse spatial
spectra (:meth:`RadioField.fit`), which then answers for any receiver (:meth:`RadioField.spectrum`,
:meth:`RadioField.paths`).

Conventions: metres, seconds, hertz, radians; world right-handed with z up; zenith in [0, pi], azimuth in (-pi, pi];
``world_to_camera`` 4x4 with OpenCV axes; quaternions wxyz. A spectrum is an equirectangular grid of *path gain*, row i
at zenith ``(i + 0.5) pi / H``, column j at azimuth ``-pi + (j + 0.5) 2 pi / W``.

Names are imported when first used: ``import warprrf`` alone loads no heavy package.
"""

from warprrf.lazy import attach

__version__ = "0.1.0"
__getattr__, __dir__, __doc__ = attach(__file__, __doc__)
