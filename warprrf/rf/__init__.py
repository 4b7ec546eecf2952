"""Stage 2: spectra, propagation, materials, radio fields, paths and the lookups they are measured against.

``fields`` are the two families of radio fields, ``channel`` is what is computed from paths, ``maps`` what many receivers get
of a field, ``interop`` other programs' scenes and paths, ``relevance`` what each effect is worth.
"""
