"""Rays: through triangle meshes and through Gaussians."""
