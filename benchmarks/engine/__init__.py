"""The engine's benchmark: spectra of many Gaussians, and mesh rays."""
