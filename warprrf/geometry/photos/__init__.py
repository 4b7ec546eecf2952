"""Stage 1: from photo files to Gaussians, a mesh and its planar patches, in metres. :func:`warprrf.reconstruct` runs

- ``posed``: image files to lenses, camera poses, undistorted photos and sparse points, brought to metres;
- ``gaussians``: planes found among the points, covered with Gaussians, which are moved until they render the photos;
- ``surface``: depth maps of these compared with photos, made flat by colours, fused to a mesh and made whole.

All settings are in ``config``.
"""
