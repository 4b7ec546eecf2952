"""The receiver beam as a linear map of images, for what is spread again and again over one grid."""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft, rfft
from scipy.sparse import csr_matrix

from warprrf.cache import Cache, cached_property
from warprrf.device import DeviceLike
from warprrf.rf.spectra.spectrum import spread, sub_pixel_directions


class BeamOperator:
    """The receiver beam as a linear map of images: a pixel's power, even over the pixel, spread over the grid.

    The grid's columns are shifts of each other, so that a Fourier transform over azimuth leaves one small matrix over
    the rows for each frequency. Sums are kept.

    Args:
        sigma: width of the beam [rad].
    """

    def __init__(self, shape: tuple[int, int], sigma: float, *, device: DeviceLike = None) -> None:
        rows, columns = self.shape = shape
        self.sigma_rad = sigma
        even_sub_pixels = 4  # square root of the directions that stand for a whole pixel's even power
        directions = sub_pixel_directions(shape, even_sub_pixels)[0].reshape(rows, columns, -1, 3)[:, 0]
        even = np.full(directions.shape[1], 1.0 / directions.shape[1])
        # what row i of column 0 gives to each pixel, shape (row, column, i)
        self._kernel = np.stack([spread(d, even, shape, sigma, device=device) for d in directions], axis=-1)
        # a matrix over the rows for each frequency, shape (frequency, row, row)
        transform = np.ascontiguousarray(np.moveaxis(rfft(self._kernel, axis=1), 1, 0))
        self._exact, self._quick = transform, transform.astype(np.complex64)
        self._back = np.ascontiguousarray(np.swapaxes(self._quick, 1, 2).conj())

    @cached_property
    def _matrix(self) -> csr_matrix:
        """The map as a sparse matrix, because a beam ends a few widths from its centre, in single precision."""
        rows, columns = self.shape
        turn = np.arange(columns)
        m, j, i = np.nonzero(self._kernel)
        out, own = m[:, None] * columns + (j[:, None] + turn) % columns, i[:, None] * columns + turn
        value = np.repeat(self._kernel[m, j, i].astype(np.float32), columns)
        return csr_matrix((value, (out.ravel(), own.ravel())), shape=(rows * columns,) * 2)

    def __call__(self, images: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Spread ``images`` (H, W, ...), in their precision; what is below 1e-14 of the largest is rounding, and 0.

        Double precision is used whatever comes, because the errors of a transform are shared by pixels 100 dB apart;
        ``quick`` does without (errors of 1e-6 of the largest, half the time).
        """
        return self._apply(self._quick if quick else self._exact, images)

    def adjoint(self, images: np.ndarray) -> np.ndarray:
        """The transposed map of ``images`` (H, W, ...), by single precision."""
        return self._apply(self._back, images)

    def _apply(self, matrices: np.ndarray, images: np.ndarray) -> np.ndarray:
        rows, columns = self.shape
        flat: np.ndarray = np.asarray(images, matrices.real.dtype).reshape(rows, columns, -1)
        x = np.moveaxis(rfft(flat, axis=1), 1, 0)
        out = irfft(np.moveaxis(matrices @ x, 0, 1), n=columns, axis=1)
        size = np.abs(out)
        # half the time of both axes at once, as is a product to a mask
        largest = size.max(axis=0).max(axis=0)
        out *= size >= 50.0 * np.finfo(flat.dtype).eps * largest
        return out.reshape(images.shape).astype(images.dtype, copy=False)

    def at(self, pixels: np.ndarray) -> csr_matrix:
        """What the map gives at ``pixels`` (N,) alone, in single precision, shape ``(N, H W)``."""
        return self._matrix[pixels]


_OPERATORS = Cache(8)


def beam_operator(shape: tuple[int, int], sigma: float, device: DeviceLike = None) -> BeamOperator:
    """The beam of width ``sigma`` [rad] on a grid of ``shape``; the last few are kept."""
    key = shape, sigma, str(device)
    return _OPERATORS.get(key, lambda: BeamOperator(shape, sigma, device=device))
