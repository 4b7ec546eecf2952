"""Stage 2: spectra, propagation, materials, radio fields, paths and the lookups they are measured against."""
