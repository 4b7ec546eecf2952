"""The path table: from a receiver backwards to records of paths, and from those and material parameters to path gains.

Read in this order: ``surface`` (a mesh as radio sees it; ``groups`` of its faces), ``rays`` (what they hit,
how that is lit), ``tracer`` (sequences of interactions), ``records`` (tables of paths, evaluated by one kernel), ``model``
(effects and parameters), ``render`` (path gains and spectra; surfaces that light each other).
"""
