"""The bistatic radio field: parameters of materials fitted to the path table of :mod:`warprrf.rf.tracing`.

``field`` holds a surface, effects, parameters and a residual, and answers with ``paths``, ``suggest`` and
``files``. ``fit`` reads as the list of steps that make it: ``observations`` of data sets of any kind (``measured`` says how
readings come from paths), ``gauss_newton`` on parameters, ``merging`` of materials, ``residual``, ``uncertainty``; ``placing``
finds where a receiver stood.

Of each ``Place`` (a link) the tracer gives a ``View``, which with what was read is an ``Observation``; its ``Columns`` are what
each group scatters into the readings. Those of several places are a ``Batch``, batches a ``Problem``, its fit a ``Solution``.
"""
