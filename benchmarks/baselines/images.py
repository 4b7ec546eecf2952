"""Spectra as networks see them: pictures in [0, 1] with the positions and directions that they belong to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf.checks import check_array
from warprrf.rf.channel.array_spectra import ArraySpectra
from warprrf.rf.spectra.metrics import unit_image
from warprrf.rf.spectra.spectrum import pixel_directions

if TYPE_CHECKING:
    from warprrf.rf.spectra.dataset import SpectrumDataset

UNIT_CEILING = 1.5
"""A prediction may exceed the brightest training pixel by half the range; more is cut, so that float32 holds it."""


@dataclass(frozen=True)
class SpectrumImages:
    """V pictures of spectra.

    Attributes:
        images: brightness in [0, 1], shape ``(V, H, W)`` float32.
        receivers: where each was received [m], shape ``(V, 3)``.
        transmitters: where it was sent from [m], shape ``(V, 3)``.
        directions: unit direction of each pixel, from the receiver outwards, shape ``(H, W, 3)``.
        floor, range_db: N0 [linear] and range [dB] by which [0, 1] is a dB image; None for pictures of other origin.
    """

    images: np.ndarray = field(repr=False)
    receivers: np.ndarray = field(repr=False)
    transmitters: np.ndarray = field(repr=False)
    directions: np.ndarray = field(repr=False)
    floor: float | None = None
    range_db: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Check shapes and values; ValueError or TypeError names the field."""
        images = check_array("images", self.images, (None, None, None), np.float32)
        if images.size == 0:
            raise ValueError(f"images: got shape {images.shape}, expected at least one picture")
        if images.min() < 0 or images.max() > 1:
            raise ValueError(f"images: got {images.min():g} to {images.max():g}, expected values in [0, 1]")
        count, *shape = images.shape
        for name, expected in (
            ("receivers", (count, 3)),
            ("transmitters", (count, 3)),
            ("directions", (*shape, 3)),
        ):
            object.__setattr__(self, name, check_array(name, getattr(self, name), expected, np.float64))
        object.__setattr__(self, "images", images)

    @classmethod
    def of(cls, data: SpectrumDataset | ArraySpectra | SpectrumImages) -> SpectrumImages:
        """A data set's dB images mapped to [0, 1] by its floor and range; pictures, an array's too, as they are."""
        if isinstance(data, SpectrumImages):
            return data
        if isinstance(data, ArraySpectra):
            return cls(data.power, data.receivers, data.transmitters, data.directions)
        gain = np.asarray(data.path_gain)
        return cls(
            images=unit_image(gain, float(data.floor), data.range_db).astype(np.float32),
            receivers=data.receivers,
            transmitters=np.broadcast_to(data.transmitter, (len(gain), 3)),
            directions=pixel_directions(gain.shape[1:]),
            floor=float(data.floor),
            range_db=(float(data.range_db[0]), float(data.range_db[1])),
        )

    def __len__(self) -> int:
        return len(self.images)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a picture."""
        return self.images.shape[1], self.images.shape[2]

    def subset(self, indices: Any) -> SpectrumImages:
        """The pictures at ``indices``."""
        chosen = np.asarray(indices, dtype=np.int64)
        return SpectrumImages(
            self.images[chosen],
            self.receivers[chosen],
            self.transmitters[chosen],
            self.directions,
            self.floor,
            self.range_db,
        )


def path_gain_of(unit: np.ndarray, floor: float, range_db: tuple[float, float]) -> np.ndarray:
    """Path gain of a picture: the inverse of :func:`warprrf.rf.spectra.metrics.unit_image`, float32, never negative."""
    low, high = range_db
    level = low + np.clip(np.asarray(unit, np.float64), 0.0, UNIT_CEILING) * (high - low)
    return np.maximum(10.0 ** (level / 10.0) - floor, 0.0).astype(np.float32)
