"""How often each piece of a surface was seen, and what the surface looks like from outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.gaussians.cells import PARALLEL
from warprrf.geometry.planes import Plane
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Y00, Gaussians

SAMPLES = 30_000  # points of the surface, spread by area
FARTHEST_M, GRAZING = 15.0, 0.1  # a photo shows a point nearer than this, at a cosine of incidence above this
ON_PLANE_M = 0.1  # a point this close to a plane lies on it
CLASSES = ((0, "no photo", "#b2182b"), (1, "1 or 2", "#ef8a62"), (3, "3 to 5", "#f7d98b"),
           (6, "6 to 11", "#92c5de"), (12, "12 or more", "#2166ac"))  # fmt: skip
"""Least number of photos, its name and colour."""
LAYERS = 8  # backs of surfaces that are looked through
SUN = np.array([0.3, 0.2, 0.93])  # where light comes from in pictures of the mesh


@dataclass(frozen=True)
class Seen:
    """Points spread over a surface by area, and by how many photos each is seen.

    Attributes:
        points, normals: [m] and unit, shape ``(S, 3)``.
        photos: shape ``(S,)`` int64.
    """

    points: np.ndarray
    normals: np.ndarray
    photos: np.ndarray

    @property
    def classes(self) -> np.ndarray:
        """Index in :data:`CLASSES` of each point, shape ``(S,)``."""
        return np.searchsorted([least for least, _, _ in CLASSES], self.photos, side="right") - 1

    @property
    def shares(self) -> np.ndarray:
        """Part of the surface in each of :data:`CLASSES`."""
        return np.bincount(self.classes, minlength=len(CLASSES)) / len(self.photos)

    def unseen_and_plain(self, planes: Sequence[Plane]) -> tuple[float, float]:
        """Parts of the surface that no photo shows, and that some show but only edges found: those on plain ``planes``."""
        plain = np.zeros(len(self.points), dtype=bool)
        for plane in (plane for plane in planes if plane.plain):
            plain |= plane.holds(self.points, ON_PLANE_M) & (self.normals @ plane.normal > PARALLEL)
        return float((self.photos == 0).mean()), float((plain & (self.photos > 0)).mean())

    @property
    def colours(self) -> np.ndarray:
        """Colour of each point's class in [0, 1], shape ``(S, 3)``."""
        table = [[int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)] for _, _, colour in CLASSES]
        return np.array(table)[self.classes]


def how_seen(mesh: Mesh, cameras: Sequence[Camera], *, device: DeviceLike = None) -> Seen:
    """By how many of ``cameras`` the fronts of a mesh are seen: in the frame, near, not grazing, not hidden."""
    rng = np.random.default_rng(0)
    face = rng.choice(len(mesh.faces), SAMPLES, p=mesh.areas / mesh.areas.sum())
    a, b = np.sort(rng.random((2, SAMPLES)), axis=0)
    weights = np.stack([a, b - a, 1 - b], axis=1)
    points = np.einsum("sk,ski->si", weights, mesh.triangles[face])
    normals = mesh.face_normals[face]
    photos = np.zeros(SAMPLES, dtype=np.int64)
    for camera in cameras:
        towards = camera.position - points
        distance = np.linalg.norm(towards, axis=1)
        inside, _ = camera.in_frame(points)
        facing = np.einsum("si,si->s", towards, normals) > GRAZING * distance
        some = np.flatnonzero(inside & facing & (distance < FARTHEST_M))
        photos[some] += mesh.visible(camera.position, points[some], clearance=1e-3, device=device)
    return Seen(points, normals, photos)


def from_outside(
    mesh: Mesh, azimuth: float, *, width: int = 480, device: DeviceLike = None
) -> tuple[np.ndarray, np.ndarray]:
    """What is seen of a mesh from outside and above, through the backs of what stands before it.

    Args:
        azimuth: where the eye stands [rad].

    Returns:
        Points met [m], shape ``(H, W, 3)``, NaN where nothing is, and how light they are, shape ``(H, W)``.
    """
    back = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(np.radians(38.0))]) * np.cos(np.radians(38.0))
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    axes = np.stack([right, np.cross(back, right)], axis=1)
    bounds = np.percentile(mesh.triangles.reshape(-1, 3), [0.5, 99.5], axis=0)  # far debris stays out
    corners = np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(-1, 3) @ axes
    low, high = corners.min(axis=0) - 0.1, corners.max(axis=0) + 0.1
    step = (high[0] - low[0]) / width
    height = int(np.clip((high[1] - low[1]) / step, 1, 2 * width))
    u, v = np.meshgrid(low[0] + step * (np.arange(width) + 0.5), high[1] - step * (np.arange(height) + 0.5))
    reach = float(np.abs(mesh.bounds).sum())  # from where all of it lies ahead
    origins = np.stack([u, v], axis=-1).reshape(-1, 2) @ axes.T + reach * back
    points, light = np.full(origins.shape, np.nan), np.zeros(len(origins))
    left = np.arange(len(origins))
    for _ in range(LAYERS):
        hit = mesh.cast(origins[left], -back, device=device)
        front = hit.valid & (np.nan_to_num(hit.normal) @ back > 0)
        points[left[front]] = hit.point[front]
        light[left[front]] = 0.7 + 0.3 * np.clip(hit.normal[front] @ SUN, 0.0, 1.0)
        behind = hit.valid & ~front
        left = left[behind]
        if not len(left):
            break
        origins[left] = hit.point[behind] - 1e-4 * back
    return points.reshape(height, width, 3), light.reshape(height, width)


def painted(points: np.ndarray, light: np.ndarray, places: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """A picture of :func:`from_outside` in the colours ``(N, 3)`` of the nearest of ``places``, shape ``(H, W, 3)``."""
    picture = np.ones((*light.shape, 3))
    met = np.isfinite(points[..., 0])
    picture[met] = light[met][:, None] * colours[cKDTree(places).query(points[met])[1]]
    return picture


def colours_of(gaussians: Gaussians) -> np.ndarray:
    """Mean colour of each Gaussian in [0, 1], shape ``(N, 3)``."""
    return np.clip(Y00 * gaussians.sh[:, 0] + 0.5, 0.0, 1.0)
