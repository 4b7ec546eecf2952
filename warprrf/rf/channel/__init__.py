"""From propagation paths to channels: the paths of a receiver, what arrays make of them, and their files.

``path_set`` holds paths (:class:`Paths`), whoever found them. From them ``response`` computes channels between two
``arrays`` (``lengths``: what elements add to paths, ``sums``: the sums over paths), ``dispersion`` spreads in delay and
angle, ``beams`` the beams to choose. ``files``, ``sionna_paths`` and ``deepmimo`` are formats, ``band_plan`` the
channels of IEEE 802.15.3d. Nothing here knows of a field, of an engine or of how paths are found.
"""
