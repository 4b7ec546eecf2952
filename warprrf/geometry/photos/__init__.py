"""Stage 1: from photo files to Gaussians, a mesh and its planar patches, in metres."""
