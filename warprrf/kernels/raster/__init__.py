"""Splatting Gaussians: projection to one ray origin, lists of what each tile sees, blending and its adjoint."""
