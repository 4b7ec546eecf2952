"""The path table: from a receiver backwards to records of paths, and from those and material parameters to path gains.

Read in this order: ``surface`` (a mesh as radio sees it; ``groups`` and ``cells`` of its faces), ``rays`` (what they hit,
how that is lit), ``tracer`` (sequences of interactions; what has no scattering is found by :mod:`warprrf.rf.paths`), ``records``
(tables of paths, evaluated by one kernel), ``model`` (effects and parameters), ``render`` (path gains and spectra; radiosity).

A mirror means specular reflection, a slab transmission through a layer. A surface is lit by the transmitter and seen by the
receiver; it sends on, or re-radiates, what it got of other surfaces.
"""
