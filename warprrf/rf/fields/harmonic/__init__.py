"""Radio fields of spherical harmonics per Gaussian, as published: RF-3DGS+ and RF-3DGS on frozen Gaussians.

``field`` is the field and what a pixel's value is made of, ``paths`` its propagation paths. ``transport`` is what receivers
see of the Gaussians. ``fitting`` has the options, and learns harmonics on the batches of a ``problem``, with ``opacity`` where
that is trained.
"""
