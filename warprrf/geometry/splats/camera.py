"""Cameras with one ray origin: pinhole for photos, spherical (equirectangular, full sphere) for spatial spectra.

World: right-handed, z up, metres. ``world_to_camera`` is 4x4 with OpenCV axes (x right, y down, z forward). Pixel
centres lie at +0.5. A spherical image has zenith ``(i + 0.5) pi / H`` in row i and azimuth
``-pi + (j + 0.5) 2 pi / W`` in column j, in world axes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_count, check_positive


@dataclass(frozen=True)
class Camera:
    """A camera; build it with :meth:`pinhole` or :meth:`spherical`.

    Attributes:
        kind: ``"pinhole"`` or ``"spherical"``.
        width, height: image size [pixels].
        fx, fy, cx, cy: pinhole intrinsics [pixels]; zero for a spherical camera.
        world_to_camera: rigid transform, shape ``(4, 4)`` float64.
    """

    kind: str
    width: int
    height: int
    world_to_camera: np.ndarray = field(repr=False)
    fx: float = 0.0
    fy: float = 0.0
    cx: float = 0.0
    cy: float = 0.0

    @classmethod
    def pinhole(
        cls,
        width: int,
        height: int,
        *,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        world_to_camera: ArrayLike,
    ) -> Camera:
        """A pinhole camera without distortion.

        Raises:
            ValueError: for sizes or focal lengths that are not positive, or a transform that is not rigid.
        """
        _check_size(width, height)
        for name, value in (("fx", fx), ("fy", fy)):
            check_positive(name, value, "focal length in pixels")
        for name, value in (("cx", cx), ("cy", cy)):
            if not np.isfinite(value):
                raise ValueError(f"{name}: got {value!r}, expected a finite pixel coordinate")
        pose = check_array("world_to_camera", world_to_camera, (4, 4))
        rotation = pose[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
            raise ValueError(
                "world_to_camera: its upper left 3x3 block is not a rotation; expected a rigid transform with OpenCV "
                "axes (x right, y down, z forward); a scaled or mirrored pose must be normalised first"
            )
        if not np.allclose(pose[3], [0, 0, 0, 1]):
            raise ValueError(f"world_to_camera: got last row {pose[3]}, expected [0, 0, 0, 1]")
        return cls("pinhole", int(width), int(height), pose, float(fx), float(fy), float(cx), float(cy))

    @classmethod
    def spherical(cls, width: int, height: int, *, position: ArrayLike) -> Camera:
        """An equirectangular full-sphere camera at ``position`` (3,) [m], axes along the world's, z up."""
        _check_size(width, height)
        pose = np.eye(4)
        pose[:3, 3] = -check_array("position", position, (3,))
        return cls("spherical", int(width), int(height), pose)

    @property
    def rotation(self) -> np.ndarray:
        """World to camera rotation, shape ``(3, 3)``."""
        return self.world_to_camera[:3, :3]

    @property
    def position(self) -> np.ndarray:
        """Ray origin in the world [m], shape ``(3,)``."""
        return -self.rotation.T @ self.world_to_camera[:3, 3]

    def directions(self) -> np.ndarray:
        """Unit world direction of every pixel centre, shape ``(height, width, 3)`` float64."""
        u, v = np.arange(self.width) + 0.5, np.arange(self.height) + 0.5
        if self.kind == "pinhole":
            x, y = np.meshgrid((u - self.cx) / self.fx, (v - self.cy) / self.fy)
            local = np.stack([x, y, np.ones_like(x)], axis=-1)
            local /= np.linalg.norm(local, axis=-1, keepdims=True)
            return local @ self.rotation
        azimuth, zenith = np.meshgrid(-np.pi + u * 2 * np.pi / self.width, v * np.pi / self.height)
        return np.stack(
            [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1
        )

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution; pinhole intrinsics scale along."""
        _check_size(width, height)
        sx, sy = width / self.width, height / self.height
        return Camera(
            self.kind,
            width,
            height,
            self.world_to_camera,
            self.fx * sx,
            self.fy * sy,
            self.cx * sx,
            self.cy * sy,
        )

    def project(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates ``(N, 2)`` of world points ``(N, 3)``, and their depth along the optical axis ``(N,)`` [m]
        (range for a spherical camera). Pinhole coordinates are NaN behind the camera."""
        local = check_array("points", points, (None, 3)) @ self.rotation.T + self.world_to_camera[:3, 3]
        if self.kind == "pinhole":
            depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
            uv = np.stack(
                [self.fx * local[:, 0] / depth + self.cx, self.fy * local[:, 1] / depth + self.cy], axis=-1
            )
            return uv, local[:, 2]
        distance = np.linalg.norm(local, axis=-1)
        zenith = np.arccos(np.clip(local[:, 2] / np.maximum(distance, 1e-300), -1, 1))
        azimuth = np.arctan2(local[:, 1], local[:, 0])
        uv = np.stack([(azimuth + np.pi) * self.width / (2 * np.pi), zenith * self.height / np.pi], axis=-1)
        return uv, distance


def check_camera(cam: object) -> None:
    """Raise TypeError unless ``cam`` is a :class:`Camera`."""
    if not isinstance(cam, Camera):
        raise TypeError(
            f"cam: got {type(cam).__name__}, expected warprrf.Camera (Camera.pinhole or Camera.spherical)"
        )


def _check_size(width: int, height: int) -> None:
    for name, value in (("width", width), ("height", height)):
        check_count(name, value)
