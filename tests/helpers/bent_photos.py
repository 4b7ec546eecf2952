"""Photos as another camera would have taken them: through a lens with a known coefficient."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates


def bent(photo: np.ndarray, focal: float, k1: float) -> np.ndarray:
    """``photo`` (H, W, 3) uint8 of a pinhole camera, as a lens of the same focal length [pixels] with ``k1`` < 0 shows it.

    A point that the pinhole camera sees at radius r (of the normalised image) appears at r (1 + k1 r^2). The largest
    centred rectangle that the photo fills is kept.
    """
    height, width = photo.shape[:2]
    share = 1 + k1 * (width**2 + height**2) / (2 * focal) ** 2  # of the corners
    size = int(width * share), int(height * share)
    x, y = (np.arange(n) + 0.5 - n / 2 for n in size)
    x, y = np.meshgrid(x / focal, y / focal)
    seen = np.hypot(x, y)
    true = seen.copy()
    for _ in range(30):  # Newton's steps
        true -= (true * (1 + k1 * true**2) - seen) / (1 + 3 * k1 * true**2)
    at = [a * true / seen * focal + n / 2 - 0.5 for a, n in ((y, height), (x, width))]
    channels = [map_coordinates(photo[..., c].astype(float), at, order=3, mode="nearest") for c in range(3)]
    return np.stack(channels, axis=-1).clip(0, 255).round().astype(np.uint8)
