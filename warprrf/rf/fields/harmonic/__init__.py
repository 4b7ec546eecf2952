"""Radio fields of spherical harmonics per Gaussian, as published: RF-3DGS+ and RF-3DGS on frozen Gaussians.

``field`` is the field, ``options`` what it computes, ``paths`` its propagation paths. ``transport`` is what receivers see
of the Gaussians, ``interaction`` where their rays meet them, and ``single_bounce`` what a pixel's value is made of.
``fitting`` learns harmonics from ``targets`` on the batches of a ``problem``, with ``opacity`` where that is trained.
"""
