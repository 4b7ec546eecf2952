"""Photo files of stage 1, read with Pillow."""

from __future__ import annotations

import os

import numpy as np

from warprrf.device import require


def read_photo(path: str | os.PathLike[str]) -> np.ndarray:
    """A photo as RGB in [0, 1], shape ``(H, W, 3)`` float32.

    Raises:
        ValueError: if the file does not read as an image.
    """
    image = require("PIL.Image", extra="photos")
    try:
        with image.open(path) as photo:
            return np.asarray(photo.convert("RGB"), dtype=np.float32) / 255
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"photos: {path} does not read as an image: {error}") from error
