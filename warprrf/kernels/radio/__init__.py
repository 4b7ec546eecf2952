"""Radio: beams, mirrors, scattering, and fitting what Gaussians send."""
