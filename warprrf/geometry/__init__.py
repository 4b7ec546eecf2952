"""Stage 1: cameras, Gaussians, rendering, meshes, and their reconstruction from photos."""
