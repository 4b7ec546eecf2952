"""Posed photos in memory: in colour, with their masks; and grey ones on a device, one behind the other, as kernels compare
them with each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warprrf.checks import check_array
from warprrf.device import DeviceLike, require, resolve
from warprrf.geometry.splats.camera import Camera

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601


@dataclass(frozen=True)
class PosedPhotos:
    """Photos and where they were taken.

    Attributes:
        images: in [0, 1], each ``(H, W, 3)``.
        cameras: pinhole cameras of the same sizes.
        masks: True where a pixel takes no part, each ``(H, W)``, None for a photo without one; empty: none has one.

    Raises:
        ValueError: if they do not match.
    """

    images: Sequence[np.ndarray]
    cameras: Sequence[Camera]
    masks: Sequence[np.ndarray | None] = ()

    def __post_init__(self) -> None:
        if len(self.images) != len(self.cameras) or not self.images:
            raise ValueError(
                f"images: got {len(self.images)} for {len(self.cameras)} cameras, expected one each and at least one"
            )
        if len(self.masks) not in (0, len(self.images)):
            raise ValueError(f"masks: got {len(self.masks)} for {len(self.images)} images, expected one each")
        for k, (image, camera) in enumerate(zip(self.images, self.cameras, strict=True)):
            if camera.kind != "pinhole":
                raise ValueError(f"cameras[{k}]: got a {camera.kind} camera, expected pinhole")
            shape = camera.height, camera.width
            check_array(f"images[{k}]", image, (*shape, 3), np.float32)
            mask = self.masks[k] if self.masks else None
            if mask is not None:
                check_array(f"masks[{k}]", mask, shape, np.uint8)

    def subset(self, chosen: Sequence[int]) -> PosedPhotos:
        """The photos of these numbers."""
        masks = [self.masks[k] for k in chosen] if self.masks else []
        return PosedPhotos([self.images[k] for k in chosen], [self.cameras[k] for k in chosen], masks)


@dataclass(frozen=True)
class GreyPhotos:
    """Grey photos.

    Attributes:
        cameras: pinhole cameras of the sizes at which photos are compared.
        pixels: of each, in [0, 1], ``(H, W)`` float32.
        sizes: where each begins in ``flat``, its width and its height, shape ``(N, 3)`` int32.
        flat: all pixels, on the device.
    """

    cameras: Sequence[Camera]
    pixels: Sequence[np.ndarray]
    sizes: np.ndarray
    flat: wp.array

    @classmethod
    def upload(
        cls, cameras: Sequence[Camera], images: Sequence[np.ndarray], device: DeviceLike = None
    ) -> GreyPhotos:
        """Photos ``(H, W, 3)`` in [0, 1] at the sizes of ``cameras``."""
        pixels = []
        for camera, photo in zip(cameras, images, strict=True):
            grey, size = np.asarray(photo, dtype=np.float32) @ LUMA, (camera.width, camera.height)
            if grey.shape != size[::-1]:
                image = require("PIL.Image", extra="photos")
                grey = np.asarray(image.fromarray(grey).resize(size, image.BOX))
            pixels.append(grey)
        first = np.cumsum([0, *(grey.size for grey in pixels)])[:-1]
        sizes = np.array(
            [(start, c.width, c.height) for start, c in zip(first, cameras, strict=True)], dtype=np.int32
        )
        flat = np.concatenate([grey.ravel() for grey in pixels])
        return cls(cameras, pixels, sizes, wp.array(flat, dtype=wp.float32, device=resolve(device)))

    @property
    def device(self) -> wp.Device:
        """Where they lie."""
        return self.flat.device


def lens_matrix(camera: Camera) -> np.ndarray:
    """Pixels ``(u, v, 1)`` of directions ``(x, y, 1)`` of a pinhole camera, shape ``(3, 3)``."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def projections(cameras: Sequence[Camera]) -> np.ndarray:
    """Homogeneous pixels of places ``(x, y, z, 1)`` in pinhole cameras, shape ``(N, 3, 4)`` float32."""
    return np.array([lens_matrix(c) @ c.world_to_camera[:3] for c in cameras], dtype=np.float32)
