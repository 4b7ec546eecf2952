"""Spatial spectra: the grid, sets of spectra and their files, beams, antennas, metrics and lookups."""
