"""The bistatic radio field: line of sight, mirrors, scattering lobes and what they light further, on frozen geometry.

It is three things. ``transport`` is what receivers see of a ``surface`` (its groups by ``colours``), whatever the
materials: ``rays``, mirror paths (:mod:`warprrf.rf.paths`, ``mirror_light``), and how ``elements`` illuminate each
other. ``materials`` are the parameters of the ``terms`` that are modelled, and the residual. ``render`` makes path
powers and spectra of the two, with ``scattering``; ``response`` predicts any measurement that is linear in path powers,
with its Jacobian.

``field`` holds them, with ``paths``, ``links`` and ``files``. ``training`` fits it: groups of surfaces (``fit``), which
of them are of one material (``grouping``), what differs within a group (``residuals``), its error (``uncertainty``).
"""
