"""Colours and shapes of what a viewer draws."""

from __future__ import annotations

import numpy as np

from warprrf import device as _device
from warprrf.geometry.splats.gaussians import Gaussians

GREY = (200, 200, 205)


def coloured(values: np.ndarray, low: float, high: float, name: str = "viridis") -> np.ndarray:
    """Values (...) as colours (..., 3) uint8, ``low`` to ``high`` along a colour map of matplotlib; NaN in grey."""
    colours = _device.require("matplotlib", extra="view").colormaps[name]
    unit = (np.asarray(values, dtype=np.float64) - low) / max(high - low, 1e-12)
    found = np.round(colours(np.clip(np.nan_to_num(unit), 0.0, 1.0))[..., :3] * 255).astype(np.uint8)
    found[np.isnan(unit)] = GREY
    return found


def panorama(image_db: np.ndarray, low: float, high: float, width: int = 720) -> np.ndarray:
    """A dB image (H, W) as a picture, each pixel a square."""
    times = max(1, width // image_db.shape[1])
    return np.repeat(np.repeat(coloured(image_db, low, high), times, axis=0), times, axis=1)


def named_colours(index: np.ndarray) -> np.ndarray:
    """A colour (..., 3) uint8 for each index (...), neighbours in index far apart in hue."""
    import colorsys

    hues = [colorsys.hsv_to_rgb((0.61803399 * k) % 1.0, 0.5, 0.9) for k in range(int(index.max()) + 1)]
    return np.round(np.array(hues) * 255).astype(np.uint8)[index]


def splats(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Arrays that viser draws: ``centers`` (N, 3), ``covariances`` (N, 3, 3), ``rgbs`` (N, 3), ``opacities`` (N, 1)."""
    turned = gaussians.rotations * gaussians.scales[:, None, :]
    base = gaussians.sh[:, 0, :3] * 0.28209479177387814 + 0.5
    return {
        "centers": gaussians.means,
        "covariances": turned @ np.swapaxes(turned, 1, 2),
        "rgbs": np.clip(base, 0.0, 1.0),
        "opacities": gaussians.opacities[:, None],
    }


def lobe_mesh(
    centre: np.ndarray,
    directions: np.ndarray,
    lobe: np.ndarray,
    radius_m: float = 1.5,
    range_db: float = 20.0,
) -> tuple[np.ndarray, np.ndarray]:
    """A beam's power gain (K, M) along ``directions`` (K, M, 3) as triangles: the radius falls to 0 over ``range_db``."""
    gain_db = 10.0 * np.log10(np.maximum(lobe / lobe.max(), 1e-9))
    radius = radius_m * np.clip(1.0 + gain_db / range_db, 0.0, 1.0)
    rows, columns = lobe.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return (centre + radius[..., None] * directions).reshape(-1, 3), faces
