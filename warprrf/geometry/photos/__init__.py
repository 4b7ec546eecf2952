"""Stage 1: from photo files to Gaussians, a mesh and its planar patches, in metres.

In the order in which :func:`warprrf.reconstruct` runs them:

- ``photo_files``, ``sfm``: image files to lenses, camera poses, sparse points and undistorted photos (``undistort``);
  ``sparse`` brings them to metres.
- ``initialise``: the points cleaned, planes found among them (``sparse``), the cells of each plane that hold a surface
  (``cells``), corrected and completed by comparing photos (``sweep``), joined by surfaces without
  features that edges show (``edges``, ``plain``), covered with Gaussians (``initial_gaussians``).
- ``refine``: Gaussians moved until they render the photos (``photo_loss``, ``densify``).
- ``fusion``: depth maps rendered and compared with photos (``stereo``), made flat where one colour shows one surface
  (``segments``), fused to a mesh, snapped to planes (``scans``), made whole (``completion``).

All settings are in ``config``.
"""
