"""What a refinement compares renderings with: photos on a device, at several sizes, each with a gain of its own.

A camera that meters each photo for itself shows one wall in many shades. In display values a change of exposure by half
a stop is a gain up to half a percent, so a gain for each colour is all that is fitted, together with the Gaussians. What
all photos share belongs to these: the gains' geometric mean is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warprrf.device import launch
from warprrf.geometry.photos.posed.images import PosedPhotos, block_means
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.photo_loss import PhotoLoss
from warprrf.kernels import exposure as kernels
from warprrf.kernels.ssim import stride_of


@dataclass(frozen=True)
class Target:
    """A photo on the device, as large as it is compared.

    Attributes:
        view: number of the photo.
        camera: of this size.
        pixels: in [0, 1], masked ones 0, a plane.
        kept: 0 at masked pixels, 1 at others, shape ``(H * W,)``.
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
        camera = self.photos.cameras[view]
        kept = (block_means(self.photos.mask(view), scale) == 0).astype(np.float32)
        small = block_means(np.asarray(self.photos.images[view], dtype=np.float32), scale) * kept[..., None]
        height, width = kept.shape
        lens = {name: getattr(camera, name) / scale for name in ("fx", "fy", "cx", "cy")}
        smaller = Camera.pinhole(width, height, world_to_camera=camera.world_to_camera, **lens)
        pixels = self.loss.plane(small, (height, width))
        weights = wp.array(kept.reshape(-1), dtype=float, device=self.loss.device)
        made = Target(view, smaller, pixels, weights, self.loss.moments(pixels, (height, width)))
        most_kept = 60_000_000  # numbers of photos kept on the device: with their moments 720 MB
        if len(self.made) * pixels.size < most_kept:
            self.made[view] = made
        return made


PRIOR = 1e-3  # weight of a gain of one, in squared display values per pixel


class Exposures:
    """Gains of photos, one until they are fitted."""

    def __init__(self, count: int) -> None:
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
        height, width, _ = image.shape
        sums = [wp.empty(height, dtype=wp.vec3, device=image.device) for _ in range(2)]
        knee = 0.03  # of the Huber loss, in display values: what differs more is no matter of exposure
        inputs = [*self._inputs(image, target), knee, *sums]
        launch(kernels.gain_sums, height, inputs, device=image.device, grain=16)
        of_photo, of_image = (array.numpy().sum(axis=0, dtype=np.float64) for array in sums)
        prior = PRIOR * height * width
        wanted = np.log((of_photo + prior) / (of_image + prior))
        least_step = 0.1  # share of the way to the best gain that is taken at least; the first time all of it
        share = max(least_step, 1 / (1 + visits))
        self.log_gains[target.view] += share * (wanted - self.log_gains[target.view])
