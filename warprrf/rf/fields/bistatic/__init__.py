"""The bistatic radio field: line of sight, mirrors, scattering lobes and what they light further, on frozen geometry.

``field`` is the field: it asks ``sight`` what a receiver sees, composes spectra of its ``terms``, and has ``paths`` and
``files``. A ``surface`` is met by rays (``bounces``), reached by way of mirrors (:mod:`warprrf.rf.paths`,
``mirror_light``) and lit by other surfaces (``second_bounce``). ``training`` fits it: groups of surfaces (``fit``),
which of them are of one material (``grouping``), what differs within a group (``residuals``), and its error
(``uncertainty``).
"""
