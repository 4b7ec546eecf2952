"""The loss of photos, (1 - s) L1 + s (1 - SSIM), and its derivative with respect to the rendered image, in Warp."""

from __future__ import annotations

import warp as wp

from warprrf.device import DeviceLike, launch
from warprrf.kernels import ssim as ssim_kernels


class PhotoLoss:
    """Loss of a rendered ``(H, W, 3)`` image.

    Args:
        device: Warp device.
        ssim_share: weight ``s`` of 1 - SSIM.
        real: scalar type of the images.
    """

    def __init__(self, device: DeviceLike, ssim_share: float, real: type = wp.float32) -> None:
        self.device, self.ssim_share, self.real = device, ssim_share, real
        self.kernels = ssim_kernels.build(real)

    def moments(self, image: wp.array, target: wp.array, shape: tuple[int, int, int]) -> wp.array:
        """Window averages of (u, u^2, u t)."""
        products = wp.empty(image.size, dtype=self.kernels.vec3, device=self.device)
        launch(self.kernels.moments, image.size, [image, target, products], device=self.device)
        return self._filtered(products, shape)

    def _filtered(self, source: wp.array, shape: tuple[int, int, int]) -> wp.array:
        """Window averages of an image of vectors."""
        height, width, channels = shape
        between, out = wp.empty_like(source), wp.empty_like(source)
        rows = [width, channels, 0, source, between]
        launch(self.kernels.filter_rows, source.size, rows, device=self.device)
        columns = [height, width * channels, between, out]
        launch(self.kernels.filter_columns, source.size, columns, device=self.device)
        return out

    def __call__(
        self, image: wp.array, target: wp.array, target_moments: wp.array, gradient: wp.array
    ) -> wp.array:
        """Write dL/d(image) to ``gradient``; returns the SSIM of every element, flat."""
        shape, count = image.shape, image.size
        flat, out = image.flatten(), gradient.flatten()
        score = wp.empty(count, dtype=self.real, device=self.device)
        slopes = wp.empty(count, dtype=self.kernels.vec3, device=self.device)
        averages = self.moments(flat, target, shape)
        launch(self.kernels.slopes, count, [target_moments, averages, score, slopes], device=self.device)
        filtered = self._filtered(slopes, shape)
        shares = [(1 - self.ssim_share) / count, self.ssim_share / count]
        launch(self.kernels.adjoint, count, [flat, target, filtered, *shares, out], device=self.device)
        return score
