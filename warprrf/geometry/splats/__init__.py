"""Gaussians and cameras: what they are, how they are rendered, and rays through them."""
