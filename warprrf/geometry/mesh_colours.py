"""Colours of a mesh file's faces, from its vertices, materials or textures.

Colours are those of a photo, sRGB with its transfer curve (IEC 61966-2-1) in [0, 1], averaged in linear light.
"""

from __future__ import annotations

import io

import numpy as np

from warprrf.device import require

PARTS = 4  # along a triangle's edge


def read_picture(data: bytes, what: str) -> np.ndarray:
    """A picture's pixels, ``(H, W, 3)`` uint8, first row on top.

    Raises:
        ValueError: naming it by ``what``, if it cannot be read.
    """
    pillow = require("PIL.Image", extra="mesh")
    try:
        with pillow.open(io.BytesIO(data)) as picture:
            return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError, EOFError, pillow.DecompressionBombError) as error:
        raise ValueError(f"{what}: no picture that can be read: {error}") from error


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values (IEC 61966-2-1)."""
    x = np.asarray(srgb, dtype=np.float64).clip(0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB values of linear light, NaN where that is unknown."""
    x = np.asarray(linear, dtype=np.float64).clip(0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)


def sampled(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Mean linear colour of triangles ``uv`` (F, 3, 2) of a picture that repeats, v upward, shape ``(F, 3)``.

    It is taken at the centres of sixteen equal parts of each triangle.
    """
    height, width = picture.shape[:2]
    curve = to_linear(np.arange(256) / 255.0)
    place = np.array([(i, j) for i in range(PARTS) for j in range(PARTS - i)], dtype=np.float64)
    up = (place + 1 / 3) / PARTS  # centres of the parts that point as the triangle does, and of the others
    down = (place[place.sum(axis=1) < PARTS - 1] + 2 / 3) / PARTS
    centres = np.concatenate([up, down])
    total = np.zeros((len(uv), 3))
    for weight in np.column_stack([centres, 1.0 - centres.sum(axis=1)]):
        at = np.einsum("k,fkc->fc", weight, uv) % 1.0
        column = np.minimum((at[:, 0] * width).astype(np.int64), width - 1)
        row = np.minimum(((1.0 - at[:, 1]) * height).astype(np.int64), height - 1)
        total += curve[picture[row, column]]
    return total / len(centres)
