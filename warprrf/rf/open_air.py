"""Scenes under the sky: what is a building and what a street there, and what is not modelled outdoors.

A city's mesh is no closed room: rays leave it, buildings often have no floors, and the ground is one sheet. So places
are judged by rays upward. In a building low, slanting and steep ones all cross an odd number of surfaces, or out of the
same number of solids; in a court, under a bridge or below a canopy some of them do not.
"""

from __future__ import annotations

import inspect
import warnings
from functools import lru_cache

import numpy as np

from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh

LEAST_HZ = 100e9
"""Below it walls let much through, and waves bend round edges, indoors too."""

_DIRECTIONS = 24
_BANDS = 3  # of rays: low, slanting, steep
_AGREED = 0.75  # share of a band's rays that must say the same
_SKY = 1.0 / 3.0  # share of rays that meet nothing where there is sky
_PLACES = 5  # along each side of a scene, at which the sky is looked for
_AT_ONCE = 20_000  # places whose rays are cast in one launch


def under_a_roof(mesh: Mesh, points: np.ndarray, *, device: DeviceLike = None) -> np.ndarray:
    """Whether each of ``points`` (N, 3) [m] of a scene under the sky is in a building or in the ground, shape ``(N,)``,
    bool; in doubt it is not."""
    found = np.zeros(len(points), dtype=bool)
    for first in range(0, len(points), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        winding, _ = mesh.look_around(points[some], _upward(), device=device)
        middle = np.median(winding, axis=1, keepdims=True)
        for votes in (winding % 2 == 1, (winding == middle) & (middle != 0)):
            share = votes.reshape(len(votes), _BANDS, -1).mean(axis=2)
            found[some] |= (share >= _AGREED).all(axis=1)
    return found


def over_ground(mesh: Mesh, points: np.ndarray, *, device: DeviceLike = None) -> np.ndarray:
    """Whether each of ``points`` (N, 3) [m] of a scene under the sky is in its air: over something, and neither in a
    building nor in the ground, shape ``(N,)``, bool."""
    below = mesh.cast(points, np.tile([0.0, 0.0, -1.0], (len(points), 1)), device=device)
    return (below.face >= 0) & ~under_a_roof(mesh, points, device=device)


def ground_height(mesh: Mesh, x: np.ndarray, y: np.ndarray, *, device: DeviceLike = None) -> np.ndarray:
    """Height z of the lowest surface at ``x``, ``y`` [m], of their shape; NaN where there is none."""
    low = mesh.bounds[0, 2] - 1.0
    start = np.column_stack([np.ravel(x), np.ravel(y), np.full(np.size(x), low)])
    up = mesh.cast(start, np.tile([0.0, 0.0, 1.0], (len(start), 1)), device=device).t
    return np.where(np.isfinite(up), low + up, np.nan).reshape(np.shape(x))


def sees_sky(mesh: Mesh, *points: np.ndarray, device: DeviceLike = None) -> bool:
    """Whether there is sky over any of the first ``points``, each (3,) or (N, 3) [m]."""
    places = np.concatenate([np.reshape(p, (-1, 3)) for p in points])[:_DIRECTIONS]
    return bool(_sky_over(mesh, places, device).any())


def is_open_air(mesh: Mesh, *, device: DeviceLike = None) -> bool:
    """Whether most of a scene is ground under the sky: a street or a city, not a room or a corridor, torn as its mesh
    may be."""
    if mesh.is_closed:
        return False
    low, high = mesh.bounds
    share = (np.arange(_PLACES) + 0.5) / _PLACES
    x, y = (a.ravel() for a in np.meshgrid(*(low[:2, None] + share * (high - low)[:2, None])))
    places = np.column_stack([x, y, np.full(len(x), 0.5 * (low[2] + high[2]))])
    ground = np.isfinite(ground_height(mesh, x, y, device=device))
    return bool((ground & _sky_over(mesh, places, device)).mean() > 0.5)


def warn_of_unmodelled(
    mesh: Mesh | None,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    *,
    frequency_hz: float,
    transmission: bool = False,
    device: DeviceLike = None,
) -> None:
    """Warn, where the user's code calls, of what is left out and matters: below 100 GHz, and outdoors.

    Args:
        mesh: The scene's; None if there is none.
        transmitter, receivers: Positions [m], shapes ``(3,)``, and ``(3,)`` or ``(R, 3)``.
        frequency_hz: Carrier frequency [Hz].
        transmission: Whether transmission through walls is modelled.
        device: Where rays are cast.
    """
    reasons = [f"below {LEAST_HZ / 1e9:g} GHz"] if frequency_hz < LEAST_HZ else []
    if mesh is not None and (
        sees_sky(mesh, transmitter, receivers, device=device) or is_open_air(mesh, device=device)
    ):
        reasons.append("outdoors (under the sky)")
    if not reasons:
        return
    what = "diffraction is" if transmission else "diffraction and transmission through walls are"
    warnings.warn(
        f"{frequency_hz / 1e9:g} GHz: {what} not modelled, which matters {' and '.join(reasons)}: receivers without line "
        "of sight may get more power than is found here; warprrf.relevance estimates how much",
        UserWarning,
        stacklevel=_users_level(),
    )


def _users_level() -> int:
    """Frames from the caller to the first one outside this package: ``stacklevel`` of a warning there."""
    frame, level = inspect.currentframe(), 0
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == "warprrf":
        frame, level = frame.f_back, level + 1
    return level


def _sky_over(mesh: Mesh, points: np.ndarray, device: DeviceLike) -> np.ndarray:
    """Whether a third of the rays upward from ``points`` (N, 3) meets nothing, shape ``(N,)``, bool."""
    side = mesh.look_around(points, _upward(), device=device)[1]
    return np.asarray((side == 0).mean(axis=1) >= _SKY)


@lru_cache(maxsize=1)
def _upward() -> np.ndarray:
    """Directions spread over the upper half of the sphere, from low to steep: a Fibonacci lattice, of which none runs
    along a wall."""
    k = np.arange(_DIRECTIONS) + 0.5
    height, azimuth = k / _DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - height**2)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), height])
