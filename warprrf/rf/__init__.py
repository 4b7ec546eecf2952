"""Stage 2: spectra, propagation, materials, radio fields, paths and the lookups they are measured against.

``bistatic`` and ``harmonic`` are the two families of fields, ``channel`` is what is computed from paths, ``coverage``
what many receivers get of a field, ``baselines`` the learned methods that ours is compared with.
"""
