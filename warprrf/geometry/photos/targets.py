"""Photos on a device: posed, masked, at several sizes, each with a gain of its own, as a refinement compares them with what is
rendered; and grey ones, one behind the other, as kernels compare them with each other.

A camera that meters each photo for itself shows one wall in many shades. In display values a change of exposure by half
a stop is a gain up to half a percent, so a gain for each colour is all that is fitted, together with the Gaussians. What
all photos share belongs to these: the gains' geometric mean is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warprrf.checks import check_array
from warprrf.device import DeviceLike, launch, require, resolve
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.photo_loss import PhotoLoss
from warprrf.kernels import exposure as kernels
from warprrf.kernels.ssim import stride_of

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601
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


KNEE = 0.03  # of the Huber loss, in display values: what differs more is no matter of exposure
PRIOR = 1e-3  # weight of a gain of one, in squared display values per pixel
LEAST_STEP = 0.1  # share of the way to the best gain that is taken at least; the first time all of it


class Exposures:
    """Gains of photos.

    Args:
        count: number of photos.
        fitted: whether gains are fitted; otherwise they stay at one.
    """

    def __init__(self, count: int, fitted: bool) -> None:
        self.fitted = fitted
        self.log_gains = np.zeros((count, 3))

    def gain(self, view: int) -> wp.vec3:
        """Of a photo, red, green and blue."""
        return wp.vec3(*np.exp(self.log_gains[view] - self.log_gains.mean(axis=0)))

    def show(self, image: wp.array, target: Target, out: wp.array) -> None:
        """Write a rendered image ``(H, W, 3)`` as the photo would show it to the plane ``out``."""
        launch(kernels.show, image.size // 3, [*self._inputs(image, target), out], device=image.device)

    def adjoint(self, image: wp.array, target: Target, slope: wp.array) -> None:
        """Write the gradient of ``image``, given that of what is shown, a plane."""
        inputs = [*self._inputs(image, target), slope, image.grad.flatten()]
        launch(kernels.show_adjoint, image.size // 3, inputs, device=image.device)

    def _inputs(self, image: wp.array, target: Target) -> list[object]:
        """What the kernels take first."""
        width = image.shape[1]
        layout = [width, stride_of(3 * width)]
        return [*layout, image.flatten(), target.pixels, target.kept, self.gain(target.view)]

    def fit(self, image: wp.array, target: Target, visits: int) -> None:
        """Move a photo's gain towards what its rendered image asks for; ``visits``: how often that was done before."""
        if not self.fitted:
            return
        height, width, _ = image.shape
        sums = [wp.empty(height, dtype=wp.vec3, device=image.device) for _ in range(2)]
        inputs = [*self._inputs(image, target), KNEE, *sums]
        launch(kernels.gain_sums, height, inputs, device=image.device, grain=16)
        of_photo, of_image = (array.numpy().sum(axis=0, dtype=np.float64) for array in sums)
        prior = PRIOR * height * width
        wanted = np.log((of_photo + prior) / (of_image + prior))
        share = max(LEAST_STEP, 1 / (1 + visits))
        self.log_gains[target.view] += share * (wanted - self.log_gains[target.view])


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
