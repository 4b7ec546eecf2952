"""Radio fields of spherical harmonics per Gaussian, as published: RF-3DGS+ and RF-3DGS on frozen Gaussians.

``field`` is the field, ``paths`` its propagation paths. ``transport`` is what receivers see of the Gaussians, ``store``
keeps it on disk, and ``single_bounce`` is what a pixel's value is made of. ``fitting`` learns harmonics from
``targets``, with ``opacity`` where that is trained, and leaves a ``checkpoint``.
"""
