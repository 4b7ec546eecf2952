"""Posed photos in memory: in colour, with their masks; and grey ones on a device, one behind the other, as kernels compare
them with each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import DTypeLike

from warprrf.device import DeviceLike, require, resolve
from warprrf.geometry.splats.camera import Camera

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601


@dataclass(frozen=True)
class PosedPhotos:
    """Photos and where they were taken.

    Attributes:
        images: in [0, 1], each ``(H, W, 3)``.
        cameras: pinhole cameras of the same sizes.
        masks: True where a pixel takes no part, each ``(H, W)``, None for a photo without one; default: none has one.
    """

    images: Sequence[np.ndarray]
    cameras: Sequence[Camera]
    masks: Sequence[np.ndarray | None] = ()

    def mask(self, number: int) -> np.ndarray:
        """Where a photo takes no part, shape ``(H, W)`` bool."""
        given = self.masks[number] if self.masks else None
        return np.asarray(np.zeros(self.images[number].shape[:2]) if given is None else given) != 0

    def subset(self, chosen: Sequence[int]) -> PosedPhotos:
        """The photos of these numbers."""
        parts = zip(*((self.images[k], self.cameras[k], self.mask(k)) for k in chosen), strict=True)
        return PosedPhotos(*map(list, parts))


def shown_at(mask: np.ndarray, camera: Camera) -> np.ndarray:
    """The pixels that take part where a photo has ``mask`` (H, W), at the size of ``camera``, bool."""
    rows, columns = ((np.arange(n) + 0.5) / n for n in (camera.height, camera.width))
    inside = (rows * mask.shape[0]).astype(int), (columns * mask.shape[1]).astype(int)
    return ~mask[np.ix_(*inside)]


@dataclass(frozen=True)
class GreyPhotos:
    """Grey photos.

    Attributes:
        cameras: pinhole cameras of the sizes at which photos are compared.
        pixels: of each, in [0, 1], ``(H, W)`` float32.
        sizes: their :func:`layout` in ``flat``.
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
        grey = (np.asarray(photo, dtype=np.float32) @ LUMA for photo in images)
        pixels = [resized(photo, camera) for photo, camera in zip(grey, cameras, strict=True)]
        flat = np.concatenate([photo.ravel() for photo in pixels])
        return cls(cameras, pixels, layout(cameras), wp.array(flat, dtype=wp.float32, device=resolve(device)))

    @property
    def device(self) -> wp.Device:
        """Where they lie."""
        return self.flat.device


def resized(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """A photo of bytes or single precision, ``(H, W)`` or ``(H, W, 3)``, at the size of ``camera``, averaged over its pixels."""
    image = require("PIL.Image", extra="photos")
    return np.asarray(image.fromarray(pixels).resize((camera.width, camera.height), image.BOX))


def block_means(pixels: np.ndarray, side: int, dtype: DTypeLike | None = None) -> np.ndarray:
    """Means over squares of ``side`` pixels of an image ``(H, W)`` or ``(H, W, C)``, summed in ``dtype``; what fills no square
    at its right and lower border is left out."""
    rows, columns = pixels.shape[0] // side, pixels.shape[1] // side
    whole = pixels[: rows * side, : columns * side]
    blocks = whole.reshape(rows, side, columns, side, *pixels.shape[2:])
    return blocks.mean(axis=(1, 3), dtype=dtype)


def layout(cameras: Sequence[Camera]) -> np.ndarray:
    """Of images one behind the other: where each begins, its width and its height, shape ``(N, 3)`` int32."""
    sizes = np.array([(c.width, c.height) for c in cameras], dtype=np.int32)
    pixels = sizes.prod(axis=1)
    return np.column_stack([np.cumsum(pixels) - pixels, sizes]).astype(np.int32)


def lens_matrix(camera: Camera) -> np.ndarray:
    """Pixels ``(u, v, 1)`` of directions ``(x, y, 1)`` of a pinhole camera, shape ``(3, 3)``."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def projections(cameras: Sequence[Camera]) -> np.ndarray:
    """Homogeneous pixels of places ``(x, y, z, 1)`` in pinhole cameras, shape ``(N, 3, 4)`` float32."""
    return np.array([lens_matrix(c) @ c.world_to_camera[:3] for c in cameras], dtype=np.float32)
