"""Exposure and white balance of every photo: one gain a colour, fitted together with the Gaussians.

A camera that meters each photo for itself shows one wall in many shades. In display values a change of exposure by half
a stop is a gain up to half a percent, so a gain for each colour is all that is fitted. What all photos share belongs to
the Gaussians: the gains' geometric mean is one.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warprrf.device import launch
from warprrf.geometry.photos.targets import Target
from warprrf.kernels import exposure as kernels
from warprrf.kernels.photo_ssim import stride_of

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
        layout = [width, stride_of(width)]
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
