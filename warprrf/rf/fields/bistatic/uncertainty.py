"""How wrong a predicted spectrum is, per pixel, in dB.

Two parts: what the group parameters leave open (Laplace approximation of their posterior, carried to the pixel), and
what no parameter explains: edges and shadows that the geometry puts in the wrong place. The second is learned from
spectra that were held out, as a function of what can be known beforehand: how steep the predicted image is there, how
far above the floor, and how far the receiver is from the nearest one that was learned from.

Such errors are not Gaussian: most pixels are right to a fraction of a decibel, and a few, where an edge is missing, are
wrong by many. The standard deviation is that of the former.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from warprrf.checks import Expected, check_arrays, lengths

STEEPNESS_DB = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, 3.5, 6.0, 10.0, 20.0)  # lower ends of the bins
LEVEL_DB = (0.0, 0.02, 0.3, 3.0, 12.0, 30.0)
LEAST_DB = 0.01
ARRAYS = {
    "table": Expected(f"{len(LEVEL_DB)} {len(STEEPNESS_DB)}", 0.0, 1e4),
    "growth": Expected("", 0.0, 1.0),
    "middle_m": lengths("", 0.0),
    "receivers": lengths("R 3"),
    "covariance": Expected("C C", -1e12, 1e12),
}
"""What the arrays of an :class:`ErrorModel` must be: R receivers, C parameters of materials."""


@dataclass(frozen=True)
class ErrorModel:
    """Standard deviation of the dB image by what is known beforehand.

    Attributes:
        table: standard deviation [dB], shape ``(levels, steepnesses)``.
        growth: relative growth per metre to the nearest training receiver.
        middle_m: distance at which the table holds.
        receivers: training receivers [m], shape ``(R, 3)``.
        covariance: of the group parameters, shape ``(C, C)``.

    Raises:
        TypeError, ValueError: for arrays of other shapes, or out of range.
    """

    table: np.ndarray
    growth: np.ndarray
    middle_m: np.ndarray
    receivers: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        check_arrays(vars(self), ARRAYS)

    def std_db(
        self, image_db: np.ndarray, receiver: np.ndarray, slopes: np.ndarray, index: np.ndarray
    ) -> np.ndarray:
        """Standard deviation per pixel [dB], shape ``(H, W)``.

        Args:
            image_db: predicted image, dB above the floor, shape ``(H, W)``.
            receiver: position (3,) [m].
            slopes: derivatives of the image to parameters ``index`` [dB], shape ``(C, H W)``.
        """
        gap = float(np.linalg.norm(self.receivers - receiver, axis=1).min())
        rest = self.table[bins(image_db)] * np.exp(self.growth * (gap - self.middle_m))
        part = self.covariance[np.ix_(index, index)].astype(np.float32)
        laplace = np.maximum(((part @ slopes) * slopes).sum(axis=0), 0.0).reshape(image_db.shape)
        return np.sqrt(rest**2 + laplace)


def steepness(image_db: np.ndarray) -> np.ndarray:
    """Largest difference within 3 x 3 pixels [dB], azimuth wrapped, shape ``(H, W)``."""
    largest, least = (f(image_db, 3, mode=("nearest", "wrap")) for f in (maximum_filter, minimum_filter))
    return np.asarray(largest - least)


def bins(image_db: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the error table for each pixel of an image in dB above the floor."""
    level = np.searchsorted(LEVEL_DB, image_db, side="right") - 1
    return np.maximum(level, 0), np.searchsorted(STEEPNESS_DB, steepness(image_db), side="right") - 1


def learn_errors(
    images: list[np.ndarray],
    errors: list[np.ndarray],
    gaps: np.ndarray,
    receivers: np.ndarray,
    covariance: np.ndarray,
) -> ErrorModel:
    """Error model from held-out predictions.

    Args:
        images: predicted images, dB above the floor, each ``(H, W)``.
        errors: prediction less truth [dB], each ``(H, W)``, NaN where that is not known.
        gaps: distance of each to the nearest receiver that was learned from [m], shape ``(V,)``.
        receivers: all training receivers [m].
        covariance: of the group parameters.
    """
    shape = len(LEVEL_DB), len(STEEPNESS_DB)
    places = [bins(image) for image in images]
    row, column = (np.concatenate([p[k].ravel() for p in places]) for k in (0, 1))
    error = np.abs(np.concatenate([e.ravel() for e in errors]))
    row, column, error = (one[np.isfinite(error)] for one in (row, column, error))
    table, enough = np.full(shape, np.nan), 60  # errors in a bin
    for i in range(shape[0]):
        for j in range(shape[1]):
            own = error[(row == i) & (column == j)]
            if len(own) >= enough:
                table[i, j] = _scale(own)
    overall = _scale(error)
    for i in range(shape[0]):  # empty bins: as their neighbours of one level, else as all
        known = np.isfinite(table[i])
        if known.any():
            table[i] = np.interp(np.arange(shape[1]), np.flatnonzero(known), table[i][known])
        else:
            table[i] = overall
    typical = np.array([np.sqrt(np.nanmean(e**2)) for e in errors])
    growth, middle = 0.0, float(np.mean(gaps))
    if len(gaps) >= 4 and np.ptp(gaps) > 0.1:
        growth = float(np.clip(np.polyfit(gaps - middle, np.log(np.maximum(typical, 1e-3)), 1)[0], 0.0, 0.3))
    return ErrorModel(np.maximum(table, LEAST_DB), np.array(growth), np.array(middle), receivers, covariance)


def _scale(error: np.ndarray) -> float:
    """Standard deviation of the errors that are no outliers, from the shares of 68 and 95 %: tails are heavier than
    Gaussian, so the two disagree, and the larger share counts for less."""
    one, two = np.quantile(error, (0.6827, 0.9545))
    return float(np.maximum(one, LEAST_DB) ** 0.7 * np.maximum(0.5 * two, LEAST_DB) ** 0.3)
