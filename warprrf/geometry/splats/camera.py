"""Cameras with one ray origin: pinhole for photos, spherical (equirectangular, full sphere) for spatial spectra.

World: right-handed, z up, metres. ``world_to_camera`` is 4x4 with OpenCV axes (x right, y down, z forward). Pixel
centres lie at +0.5. A spherical image has zenith ``(i + 0.5) pi / H`` in row i and azimuth
``-pi + (j + 0.5) 2 pi / W`` in column j, in world axes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import (
    Count,
    Number,
    Shaped,
    check_array,
    check_number,
    check_positive,
    check_similarity,
    check_type,
    checked,
    one_of,
)

KINDS = ("pinhole", "spherical")


@checked
@dataclass(frozen=True)
class Camera:
    """A camera; build it with :meth:`pinhole` or :meth:`spherical`.

    Attributes:
        kind: ``"pinhole"`` or ``"spherical"``.
        width, height: image size [pixels].
        fx, fy, cx, cy: pinhole intrinsics [pixels]; zero for a spherical camera.
        world_to_camera: rigid transform, shape ``(4, 4)`` float64; of a spherical camera, a shift alone.

    Raises:
        TypeError, ValueError: for another kind, sizes or focal lengths that are not positive, or a transform that is
            not rigid.
    """

    kind: Annotated[str, one_of(*KINDS)]
    width: Count
    height: Count
    world_to_camera: Annotated[np.ndarray, Shaped("4 4")] = field(repr=False)
    fx: float = 0.0
    fy: float = 0.0
    cx: Number = 0.0
    cy: Number = 0.0

    def __post_init__(self) -> None:
        # callers may go on with theirs
        object.__setattr__(self, "world_to_camera", self.world_to_camera.copy())
        _check_pose(self.world_to_camera)
        if self.kind == "pinhole":
            for name in ("fx", "fy"):
                check_positive(name, getattr(self, name), "focal length in pixels")
            return
        for name in ("fx", "fy", "cx", "cy"):
            check_number(f"{name} of a spherical camera", getattr(self, name), 0.0, 0.0)
        if not np.allclose(self.rotation, np.eye(3), atol=1e-12):
            raise ValueError(
                "world_to_camera: got a spherical camera that is turned, expected axes along the world's"
            )

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
        """A pinhole camera without distortion."""
        return cls("pinhole", width, height, np.asarray(world_to_camera), fx, fy, cx, cy)

    @classmethod
    def spherical(cls, width: int, height: int, *, position: ArrayLike) -> Camera:
        """An equirectangular full-sphere camera at ``position`` (3,) [m], axes along the world's, z up."""
        pose = np.eye(4)
        pose[:3, 3] = -check_array("position", position, (3,))
        return cls("spherical", width, height, pose)

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
        if self.kind == "pinhole":
            x, y = slopes_of(self)
            local = np.stack([x, y, np.ones_like(x)], axis=-1)
            local /= np.linalg.norm(local, axis=-1, keepdims=True)
            return local @ self.rotation
        u, v = np.arange(self.width) + 0.5, np.arange(self.height) + 0.5
        azimuth, zenith = np.meshgrid(-np.pi + u * 2 * np.pi / self.width, v * np.pi / self.height)
        return np.stack(
            [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1
        )

    def in_frame(self, points: np.ndarray, nearest_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Which points ``(N, 3)`` have a pixel and lie deeper than ``nearest_m``, shape ``(N,)`` bool; and the row and column
        of each, shape ``(N, 2)`` int, 0 for the others."""
        uv, depth = self.project(points)
        if self.kind == "spherical":  # azimuth pi and the pole are of the last column and row
            uv = np.minimum(uv, np.nextafter([self.width, self.height], 0.0))
        with np.errstate(invalid="ignore"):
            inside = (
                (depth > nearest_m) & (uv >= 0).all(axis=1) & (uv < (self.width, self.height)).all(axis=1)
            )
        return inside, np.where(inside[:, None], uv[:, ::-1], 0).astype(int)

    def resized(self, width: Count, height: Count) -> Camera:
        """The same view at another resolution; pinhole intrinsics scale along."""
        sx, sy = width / self.width, height / self.height
        fx, fy, cx, cy = self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)

    def transformed(
        self, *, scale: float = 1.0, rotation: ArrayLike | None = None, shift: ArrayLike = (0.0, 0.0, 0.0)
    ) -> Camera:
        """The camera that sees points at ``scale rotation x + shift`` where this one sees ``x``.

        Arguments and errors: see :func:`warprrf.checks.check_similarity`. ValueError too for a spherical one that would be turned.
        """
        scale, turn, moved = check_similarity(scale, rotation, shift)
        pose = np.eye(4)
        pose[:3, :3] = self.rotation @ turn.T
        pose[:3, 3] = -pose[:3, :3] @ (scale * turn @ self.position + moved)
        return replace(self, world_to_camera=pose)

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


def slopes_of(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """x / z and y / z of the ray through each pixel of a pinhole camera, in its own axes, shape ``(H, W)`` each."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    columns, rows = np.meshgrid(x, y)
    return columns, rows


def check_camera(cam: object) -> None:
    """Raise TypeError unless ``cam`` is a :class:`Camera`."""
    check_type("cam", cam, Camera, " (Camera.pinhole or Camera.spherical)")


def _check_pose(pose: np.ndarray) -> None:
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise ValueError(
            "world_to_camera: its upper left 3x3 block is not a rotation; expected a rigid transform with OpenCV "
            "axes (x right, y down, z forward); a scaled or mirrored pose must be normalised first"
        )
    if not np.allclose(pose[3], [0, 0, 0, 1]):
        raise ValueError(f"world_to_camera: got last row {pose[3]}, expected [0, 0, 0, 1]")
