"""Where a receiver of a radio field may be: inside the scene and off its surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array
from warprrf.geometry.mesh import Mesh

ON_A_WALL_M = 1e-4  # a receiver nearer to the mesh than this sits in the wall


def check_receiver(name: str, position: ArrayLike, mesh: Mesh | None) -> np.ndarray:
    """``position`` (3,) or (R, 3) [m] if spectra can be asked for there.

    Raises:
        ValueError: if it is not finite, outside the mesh's bounds, or on its surface.
    """
    array = check_array(name, position)
    if array.ndim not in (1, 2) or array.shape[-1] != 3 or array.size == 0:
        raise ValueError(f"{name}: got shape {array.shape}, expected (3,) or (R, 3) with R at least 1")
    if mesh is None:
        return array
    points = np.atleast_2d(array)
    low, high = mesh.bounds
    outside = np.flatnonzero(((points < low) | (points > high)).any(axis=-1))
    if len(outside):
        raise ValueError(
            f"{name}: got {points[outside[0]].tolist()}, which lies outside the scene's bounds {low.tolist()} to "
            f"{high.tolist()} [m]; expected a position inside"
        )
    distance = mesh.distance(points)
    touching = np.flatnonzero(distance < ON_A_WALL_M)
    if len(touching):
        raise ValueError(
            f"{name}: got {points[touching[0]].tolist()}, which lies on a surface ({distance[touching[0]]:.1e} m); "
            f"move it off by more than {ON_A_WALL_M} m"
        )
    return array
