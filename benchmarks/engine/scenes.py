"""What the engine is measured on: a room of flat Gaussians, 18 x 12 x 4 m, a camera and receivers inside."""

from __future__ import annotations

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians

ROOM = (18.0, 12.0, 4.0)  # m
RECEIVER = (7.0, 5.0, 1.5)  # m


def room(n: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Flat Gaussians on the six sides of the room: means, quaternions, scales, opacities, colours, float32.

    In-plane scales are such that neighbours overlap whatever their number is; opacities are those of a refined scene.
    """
    rng = np.random.default_rng(seed)
    size = np.asarray(ROOM)
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, n, p=area / area.sum())
    means = rng.uniform(0, 1, (n, 3)) * size
    means[np.arange(n), axis] = rng.integers(0, 2, n) * size[axis]
    spacing = np.sqrt(2 * area.sum() / n)
    scales = spacing * np.exp(rng.uniform(np.log(0.3), np.log(1.0), (n, 3)))
    scales[np.arange(n), axis] = 0.05 * spacing
    quaternions = np.concatenate([np.ones((n, 1)), rng.normal(scale=0.05, size=(n, 3))], axis=1)
    values = (means, quaternions, scales, rng.uniform(0.3, 0.95, n), rng.uniform(size=(n, 3)))
    return tuple(v.astype(np.float32) for v in values)


def photo(width: int, height: int) -> Camera:
    """A camera in the room's corner, 80 degrees wide, looking along the diagonal."""
    position = np.array([1.5, 1.5, 1.7])
    forward = np.array([16.5, 10.5, 1.5]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    focal = 0.5 * width / np.tan(np.radians(40))
    return Camera.pinhole(
        width, height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, world_to_camera=pose
    )


def gaussians(n: int, seed: int = 0) -> Gaussians:
    """:func:`room` without colours."""
    means, quaternions, scales, opacities, _ = room(n, seed)
    return Gaussians(means, quaternions, scales, opacities, np.zeros((n, 1, 3)))


def panorama(height: int = 90, width: int = 180) -> Camera:
    """A spectrum's grid at a receiver in the room."""
    return Camera.spherical(width, height, position=RECEIVER)


def room_mesh() -> Mesh:
    """The room's six sides, wound inwards."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * np.asarray(ROOM)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return Mesh(corners, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def gain(points: np.ndarray) -> np.ndarray:
    """Linear gain that varies smoothly over some 60 dB on the walls, with one glint; points ``(..., 3)`` [m]."""
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    db = -35 + 15 * np.sin(1.3 * x) * np.cos(1.7 * y) + 10 * np.sin(2.1 * z + x)
    glint = np.exp(-0.5 * ((x - 9.0) ** 2 + (y - 12.0) ** 2 + (z - 2.0) ** 2) / 0.3**2)
    return 10 ** (db / 10) + glint
