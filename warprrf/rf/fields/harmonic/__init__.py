"""Radio fields of spherical harmonics per Gaussian, as published: RF-3DGS+ and RF-3DGS on frozen Gaussians.

``field`` is the field, ``options`` what it computes and what a pixel's value is made of, ``paths`` its propagation paths.
``transport`` is what receivers see of the Gaussians, and where their rays meet them. ``fitting`` learns harmonics on the
batches of a ``problem``, with ``opacity`` where that is trained.
"""
