"""Doppler shifts of paths whose ends, and what they touch, move.

A wave leaves each point of its path along k_i. With velocities v_i of the transmitter (0), of what is touched (1 to n) and
of the receiver (n + 1), all far below the speed of light, its frequency is shifted by

    f_D = (v_0 . k_0 - v_(n+1) . k_n + sum over i of v_i . (k_i - k_(i-1))) / lambda,

as the path's phase -2 pi f tau says if its length changes at that rate (Wiffen et al., IEEE WCNC Workshops 2018; Sionna RT's
technical report). What lets a wave straight through does not shift it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_number
from warprrf.geometry.mesh import GeometryLike, as_mesh, headings
from warprrf.rf.channel.path_arrays import PathArrays
from warprrf.rf.em.waves import SPEED_OF_LIGHT


def doppler_hz(
    paths: PathArrays,
    *,
    transmitter_velocity: ArrayLike = (0.0, 0.0, 0.0),
    receiver_velocity: ArrayLike = (0.0, 0.0, 0.0),
    moving: Mapping[str, ArrayLike] | None = None,
    scene: GeometryLike | None = None,
) -> np.ndarray:
    """Doppler shift of each path [Hz], positive where it gets shorter.

    Args:
        transmitter_velocity, receiver_velocity: [m/s], shape ``(3,)``, or ``(R, 3)`` of each receiver's link.
        moving: velocities [m/s], each ``(3,)``, by the name of an object of ``scene``, or of a material: that of all that is made
            of it. The rest stands still.
        scene: whose surfaces the paths touch; needed with ``moving``. What a path touches is the face next to its interaction
            point, so that the paths of a field may be asked of the scene with names that the room has.

    Returns:
        Shape as ``tau``; NaN where padded, and where directions are not known.

    Raises:
        TypeError, ValueError: naming the argument; for a name that nothing in the scene has, and for paths of another scene.

    Example::

        shift = paths.doppler_hz(receiver_velocity=(1.5, 0, 0), moving={"door": (0, 0.8, 0)}, scene=scene)
        later = paths.after(1e-3, shift)  # a millisecond on
    """
    lead = len(paths.gain) if paths.batched else None
    sent = _velocities("transmitter_velocity", transmitter_velocity, lead)
    heard = _velocities("receiver_velocity", receiver_velocity, lead)
    departure, onward = paths.departure, -paths.arrival
    speed = (sent * departure).sum(axis=-1) - (heard * onward).sum(axis=-1)
    if moving:
        speed = speed + _pushed(paths, moving, scene, departure, onward)
    return np.where(paths.valid, speed * (paths.carrier_hz / SPEED_OF_LIGHT), np.nan)


def _velocities(name: str, value: ArrayLike, receivers: int | None) -> np.ndarray:
    """Of each link, shape ``(3,)`` or ``(R, 1, 3)``."""
    found = check_array(name, value)
    if found.shape != (3,) and (receivers is None or found.shape != (receivers, 3)):
        wanted = "(3,)" if receivers is None else f"(3,) or ({receivers}, 3)"
        raise ValueError(f"{name}: got shape {found.shape}, expected {wanted}, a velocity [m/s]")
    fastest_m_s = 3e6  # a hundredth of the speed of light: the formula errs by that share
    check_number(name, float(np.abs(found).max()), 0.0, fastest_m_s)
    return found if found.ndim == 1 else found[:, None]


def _pushed(
    paths: PathArrays,
    moving: Mapping[str, ArrayLike],
    scene: GeometryLike | None,
    departure: np.ndarray,
    onward: np.ndarray,
) -> np.ndarray:
    """v . (k_i - k_(i-1)) of each path's interaction points [m/s], their sum, shape as ``tau``."""
    there, velocity = np.isfinite(paths.vertices[..., 0]), np.zeros(paths.vertices.shape)
    velocity[there] = _touched(scene, moving, paths.vertices[there])
    leg = headings(np.diff(paths.vertices, axis=-2))[0]
    before = np.concatenate([departure[..., None, :], leg], axis=-2)
    after = np.concatenate([leg, onward[..., None, :]], axis=-2)
    after = np.where(np.isfinite(after), after, onward[..., None, :])  # of the last point, and past it
    return np.where(there, (velocity * (after - before)).sum(axis=-1), 0.0).sum(axis=-1)


def _touched(scene: Any, moving: Mapping[str, ArrayLike], points: np.ndarray) -> np.ndarray:
    """Velocity of the surface at ``points`` (N, 3), shape ``(N, 3)``."""
    if not isinstance(moving, Mapping):
        raise TypeError(
            f"moving: got {type(moving).__name__}, expected velocities by the name of an object or material"
        )
    if scene is None or not hasattr(scene, "object_names"):
        raise ValueError(
            f"scene: got {type(scene).__name__} with moving, expected a Scene, whose objects have names"
        )
    mesh, velocity = as_mesh(scene, "scene"), np.zeros((len(scene.mesh.faces), 3))
    objects, materials = list(scene.object_names), [material.name for material in scene.materials]
    for name, value in moving.items():
        pushed = _velocities(f"moving[{name!r}]", value, None)
        if name in objects:
            own = np.asarray(scene.face_object) == objects.index(name)
        elif name in materials:
            own = np.isin(scene.face_material, [k for k, known in enumerate(materials) if known == name])
        else:
            known = ", ".join(dict.fromkeys([*objects, *materials]))
            raise ValueError(
                f"moving: got {name!r}, which no object or material of the scene is called; it has {known:.400}"
            )
        velocity[own] = pushed
    if len(points) == 0:
        return np.zeros((0, 3))
    nearest = mesh.closest(points)
    farthest_m = 0.3  # what photos show is right to some centimetres
    if nearest.distance.max() > farthest_m:
        raise ValueError(
            f"scene: got paths that touch something {nearest.distance.max():.3g} m from its surfaces, expected paths traced in it"
        )
    return velocity[nearest.face]
