"""Floor plans: where a mesh meets a horizontal plane."""

from __future__ import annotations

import numpy as np


def section(vertices: np.ndarray, faces: np.ndarray, height: float) -> np.ndarray:
    """Line segments (S, 2, 2) [m] where a mesh meets the plane z = ``height``."""
    corners = np.asarray(vertices, dtype=np.float64)[np.asarray(faces)]
    above = corners[:, :, 2] > height
    cut = corners[(above.sum(axis=1) % 3) > 0]
    above = cut[:, :, 2] > height
    ends = []
    for first, second in ((0, 1), (1, 2), (2, 0)):
        a, b = cut[:, first], cut[:, second]
        crosses = above[:, first] != above[:, second]
        share = np.where(crosses, (height - a[:, 2]) / np.where(crosses, b[:, 2] - a[:, 2], 1.0), np.nan)
        ends.append(a[:, :2] + share[:, None] * (b - a)[:, :2])
    points = np.stack(ends, axis=1)  # exactly two of the three edges cross
    return points[~np.isnan(points[:, :, 0])].reshape(-1, 2, 2)
