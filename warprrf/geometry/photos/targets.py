"""Photos as a refinement compares them: posed, masked, at several sizes, on a device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warprrf.checks import check_array
from warprrf.geometry.photos.photo_loss import PhotoLoss
from warprrf.geometry.splats.camera import Camera

MOST_KEPT = 60_000_000  # numbers of photos kept on the device: with their moments 720 MB


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
class Target:
    """A photo on the device, as large as it is compared.

    Attributes:
        view: number of the photo.
        camera: of this size.
        pixels: in [0, 1], masked ones 0, a plane.
        kept: 0 at masked pixels, 1 at others, shape ``(H * W,)``; empty without a mask.
        moments: window averages of ``pixels`` and their squares, planes.
    """

    view: int
    camera: Camera
    pixels: wp.array
    kept: wp.array
    moments: tuple[wp.array, wp.array]


class Targets:
    """Photos at one size after another, made when first asked for; ``pixels`` is how many they have in the mean."""

    def __init__(self, photos: PosedPhotos, loss: PhotoLoss) -> None:
        self.photos, self.loss = photos, loss
        self.scale = 1
        self.made: dict[int, Target] = {}
        self.pixels = sum(c.width * c.height for c in photos.cameras) / len(photos.cameras)

    def __len__(self) -> int:
        return len(self.photos.images)

    def at(self, view: int, scale: int) -> Target:
        """A photo averaged over squares of ``scale`` pixels; where one of them is masked, all are."""
        if scale != self.scale:
            self.made.clear()
            self.scale = scale
        if view in self.made:
            return self.made[view]
        made = self.make(view, scale)
        if len(self.made) * made.pixels.size < MOST_KEPT:
            self.made[view] = made
        return made

    def make(self, view: int, scale: int) -> Target:
        """As :meth:`at`, anew."""
        image, camera = np.asarray(self.photos.images[view], dtype=np.float32), self.photos.cameras[view]
        mask = self.photos.masks[view] if self.photos.masks else None
        height, width = image.shape[0] // scale, image.shape[1] // scale
        rows, columns = height * scale, width * scale
        blocks = image[:rows, :columns].reshape(height, scale, width, scale, 3)
        small = image if scale == 1 else blocks.mean(axis=(1, 3), dtype=np.float32)
        kept = np.zeros(0, np.float32)
        if mask is not None:
            masked = np.asarray(mask)[:rows, :columns].reshape(height, scale, width, scale) != 0
            kept = (~masked.any(axis=(1, 3))).astype(np.float32)
            small = small * kept[..., None]
        lens = {name: getattr(camera, name) / scale for name in ("fx", "fy", "cx", "cy")}
        smaller = Camera.pinhole(width, height, world_to_camera=camera.world_to_camera, **lens)
        pixels = self.loss.plane(small, (height, width))
        weights = wp.array(kept.reshape(-1), dtype=float, device=self.loss.device)
        return Target(view, smaller, pixels, weights, self.loss.moments(pixels, (height, width)))
