"""What a receiver sees of the frozen geometry: blending weights.

Geometry does not change while the radio part is learned, so the weights of a view are computed once, as a sparse
pixels-by-Gaussians matrix, and every fit and every model reuses them. Radio needs other cutoffs than photos: an image
60 dB deep shows what an opacity clamp of 0.99 leaks through a wall (-20 dB), so :func:`cutoffs` derives them from the
data set's range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.checks import check_array
from warprrf.device import DeviceLike, Progress, launch, resolve, with_progress
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import Blending, Parameters, Rasterizer
from warprrf.kernels.radio import transport as _kernels
from warprrf.rf.spectra.spectrum import check_shape

TOP_K = 16  # Gaussians kept per pixel


@dataclass(frozen=True)
class Rows:
    """What one receiver sees, as sparse rows on a device: one row a pixel, of H W.

    Attributes:
        start: where each pixel's pairs begin, shape ``(H * W + 1,)`` int32.
        gaussian: Gaussian of each pair, front to back within a pixel, shape ``(E,)`` int32.
        weight: blending weight alpha T of each pair, shape ``(E,)`` float32; what top-K left out is shared among the
            pairs that stayed, so that a pixel's sum is that of all its Gaussians.
        dominant: Gaussian with the largest weight, shape ``(H * W,)`` int32, -1 where there is none.
        expected_range: blended mean of the peak ranges [m], shape ``(H * W,)`` float64, NaN where there is none.
    """

    start: wp.array
    gaussian: wp.array
    weight: wp.array
    dominant: wp.array
    expected_range: wp.array

    def on(self, device: wp.Device) -> Rows:
        """The same on another device."""
        return Rows(**{name: array.to(device) for name, array in vars(self).items()})


@dataclass(frozen=True)
class Transport:
    """Blending weights of the frozen geometry for some receivers, on a device.

    Attributes:
        shape: rows and columns of a spectrum.
        receivers: positions [m], shape ``(R, 3)``.
        views: what each of them sees.
        gaussians: how many there are, seen or not.
        rule: transmittance rule, ``"product"`` or ``"exp"``.
    """

    shape: tuple[int, int]
    receivers: np.ndarray
    views: tuple[Rows, ...]
    gaussians: int
    rule: str

    def subset(self, indices: Sequence[int] | np.ndarray) -> Transport:
        """The receivers at ``indices``, in that order."""
        chosen = np.asarray(indices, dtype=np.int64)
        return replace(self, receivers=self.receivers[chosen], views=tuple(self.views[r] for r in chosen))

    def on(self, device: DeviceLike) -> Transport:
        """The same on another device."""
        where = resolve(device)
        return replace(self, views=tuple(view.on(where) for view in self.views))

    @property
    def device(self) -> wp.Device:
        """Where the views lie."""
        return self.views[0].start.device

    @property
    def values(self) -> list[np.ndarray]:
        """All that the views hold, from the device."""
        return [array.numpy() for view in self.views for array in vars(view).values()]

    @property
    def dominant(self) -> np.ndarray:
        """Gaussian with the largest weight, shape ``(R, H, W)`` int32, -1 where there is none."""
        return np.stack([view.dominant.numpy().reshape(self.shape) for view in self.views])

    @property
    def pixel_weight(self) -> np.ndarray:
        """Sum of the weights per pixel, shape ``(R, H, W)`` float64; with the ``exp`` rule it can exceed one."""
        pixels = self.shape[0] * self.shape[1]
        out = wp.empty((len(self.views), pixels), dtype=wp.float64, device=self.device)
        for r, view in enumerate(self.views):
            inputs = [view.start, view.weight, out[r]]
            launch(_kernels.sum_rows, pixels, inputs, device=self.device)
        return out.numpy().reshape(-1, *self.shape)


def cutoffs(range_db: tuple[float, float], rule: str = "product") -> Blending:
    """How to blend for images that span ``range_db`` (lowest, highest) [dB].

    A wall may leak no more than the floor of the range, and blending stops when no more than that is left. An alpha
    below 1e-3 is left out: it changes what lies behind it by less than 0.005 dB.
    """
    depth = 10 ** (-(float(range_db[1]) - float(range_db[0])) / 10)
    leak = min(max(depth, 1e-6), 1e-2)
    return Blending(alpha_min=1e-3, alpha_max=1.0 - leak, transmittance_min=leak, rule=rule)


def transport(
    gaussians: Gaussians,
    receivers: ArrayLike,
    shape: tuple[int, int],
    *,
    range_db: tuple[float, float] = (-60.0, 0.0),
    rule: str = "product",
    top_k: int = TOP_K,
    device: DeviceLike = None,
    uploaded: Parameters | None = None,
    progress: Progress | None = None,
) -> Transport:
    """Blending weights of ``gaussians`` for every pixel of every receiver.

    Args:
        receivers: positions [m], shape ``(R, 3)``.
        range_db: lowest and highest value of the data set's dB images: sets :func:`cutoffs`.
        rule: transmittance: ``"product"`` of (1 - alpha), or the paper's ``"exp"`` of minus the sum of alphas.
        top_k: Gaussians kept per pixel.
        uploaded: the Gaussians, if they lie there already.
    """
    positions = check_array("receivers", receivers, (None, 3))
    if len(positions) == 0:
        raise ValueError("receivers: got none, expected at least one position")
    size = check_shape(shape)
    raster = Rasterizer(device=device, blending=cutoffs(range_db, rule))
    scene = raster.upload(gaussians) if uploaded is None else uploaded
    views = []
    for position in with_progress(positions, "transport", progress):
        views.append(_rows(raster, strongest(raster, scene, position, size, top_k)))
    return Transport(size, positions, tuple(views), len(gaussians), rule)


Strongest = tuple[wp.array, wp.array, wp.array, wp.array]
"""What :meth:`Rasterizer.strongest` gives."""


def strongest(
    raster: Rasterizer, scene: Parameters, position: np.ndarray, shape: tuple[int, int], top_k: int
) -> Strongest:
    """The ``top_k`` largest blending weights of every pixel of a receiver."""
    cam = Camera.spherical(shape[1], shape[0], position=position)
    return raster.strongest(raster.prepare(*scene, cam), top_k)


def kept(device: wp.Device, found: Strongest, share: float) -> tuple[wp.array, int, wp.array, wp.array]:
    """Where each pixel's row begins if all weights above ``share`` of the pixel's sum stay, how many these are, the dominant
    Gaussians and the mean ranges; see :class:`Rows`."""
    index, weight, distance, _ = found
    pixels = index.shape[0] * index.shape[1]
    start = wp.zeros(pixels + 1, dtype=int, device=device)
    dominant = wp.empty(pixels, dtype=int, device=device)
    expected = wp.empty(pixels, dtype=wp.float64, device=device)
    inputs = [share, index, weight, distance, start, dominant, expected]
    launch(_kernels.count_kept, pixels, inputs, device=device)
    wp.utils.array_scan(start, start, inclusive=False)
    return start, int(start[pixels:].numpy()[0]), dominant, expected


def _rows(raster: Rasterizer, found: Strongest) -> Rows:
    """The largest weights of one receiver's pixels as rows."""
    device, (index, weight, _, alpha) = raster.device, found
    share = 1e-4  # smaller shares of a pixel's weight are given to the others: 0.0004 dB
    start, pairs, dominant, expected = kept(device, found, share)
    gaussian, out = (wp.empty(pairs, dtype=kind, device=device) for kind in (int, float))
    inputs = [share, index, weight, alpha, start, gaussian, out]
    launch(_kernels.write_weights, len(dominant), inputs, device=device)
    return Rows(start, gaussian, out, dominant, expected)
