"""Blending weights of the training receivers as batches on the device: what every layer of a fit works on.

A :class:`Problem` sorts the weights once into fixed batches, Gaussian by Gaussian, so that each sum has one owner. They
do not leave the device that they were made on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import DTypeLike

from warprrf.device import DeviceLike, launch, resolve
from warprrf.kernels.radio import harmonics as _kernels
from warprrf.kernels.radio import transport as _pairs
from warprrf.kernels.raster.binning import tile_starts
from warprrf.rf.fields.harmonic.transport import Transport
from warprrf.rf.spectra.spectrum import pixel_directions


@dataclass(frozen=True)
class Pairs:
    """One batch's pairs on the device, Gaussian by Gaussian; see :mod:`warprrf.kernels.radio.harmonics`."""

    receivers: np.ndarray
    row_start: wp.array
    pair_pixel: wp.array
    pair_direction: wp.array
    pair_weight: wp.array
    pixel_start: wp.array
    pair_of_pixel: wp.array


class Problem:
    """Blending weights of the training receivers, in batches on the device.

    Args:
        transport: weights of the training receivers, which are copied if they lie on another device.
        batch: receivers per optimiser step.
        seed: deals receivers into batches and orders them.
        precision: ``np.float32``, or ``np.float64`` for gradient checks.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        batch: int = 10,
        seed: int = 0,
        device: DeviceLike = None,
        precision: DTypeLike = np.float32,
    ) -> None:
        self.seed = int(seed)
        self.device = resolve(device)
        self.transport = transport.on(self.device)
        self.precision = np.dtype(precision)
        self.real = wp.float64 if self.precision == np.float64 else wp.float32
        self.kernels = _kernels.build(self.real)
        self._row, self.seen = self._rows()
        self.pixels = transport.shape[0] * transport.shape[1]
        count = len(transport.receivers)
        order = np.random.default_rng([self.seed, 0]).permutation(count)
        parts = np.array_split(order, max(1, round(count / batch)))
        self.batches = [self._sorted(np.sort(part)) for part in parts]
        self.basis = harmonics(transport.shape, self.real, self.device)

    def upload(self, values: np.ndarray, dtype: type | None = None) -> wp.array:
        """``values`` on the device, in the problem's precision unless ``dtype`` says otherwise."""
        numbers = np.ascontiguousarray(values, dtype=self.precision)
        return wp.array(numbers, dtype=dtype or self.real, device=self.device)

    def launch(self, kernel: wp.Kernel, dim: int, *inputs: Any) -> None:
        """Launch one of the problem's kernels on its device."""
        launch(kernel, dim, inputs, device=self.device)

    def batch_at(self, step: int) -> int:
        """Which batch a step uses: all of them once an epoch, in an order that seed and epoch fix."""
        epoch, place = divmod(step, len(self.batches))
        return int(np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.batches))[place])

    def _rows(self) -> tuple[wp.array, np.ndarray]:
        """The row of each Gaussian that any receiver sees, and these Gaussians, ascending."""
        count = self.transport.gaussians
        row = wp.zeros(count + 1, dtype=int, device=self.device)
        for view in self.transport.views:
            self.launch(_pairs.mark_seen, len(view.gaussian), view.gaussian, row)
        seen = np.flatnonzero(row.numpy())
        wp.utils.array_scan(row, row, inclusive=False)
        return row, seen

    def _sorted(self, receivers: np.ndarray) -> Pairs:
        """The pairs of some receivers, sorted by Gaussian."""
        views = [self.transport.views[r] for r in receivers]
        count, pixels = sum(len(view.gaussian) for view in views), self.pixels * len(views)
        empty = partial(wp.empty, dtype=int, device=self.device)
        keys, order = empty(2 * count), empty(2 * count)  # room to sort
        pixel, place, pair_pixel, pair_direction = (empty(count) for _ in range(4))
        pixel_start = empty(pixels + 1)
        first = 0
        for k, view in enumerate(views):
            inputs = view.start, view.gaussian, self._row, pixel_start, pixel, keys, order
            self.launch(_pairs.gather_pairs, self.pixels + 1, self.pixels * k, first, *inputs)
            first += len(view.gaussian)
        wp.utils.radix_sort_pairs(keys, order, count, 0, len(self.seen).bit_length())
        row_start = empty(len(self.seen) + 1)
        self.launch(tile_starts, len(row_start), keys, count, row_start)
        self.launch(_pairs.sorted_pairs, count, self.pixels, order, pixel, place, pair_pixel, pair_direction)
        weight = self.in_order(place, [view.weight for view in views])
        return Pairs(receivers, row_start, pair_pixel, pair_direction, weight, pixel_start, place)

    def in_order(self, pair_of_pixel: wp.array, values: list[wp.array]) -> wp.array:
        """Values (E,) of the pairs of a batch's receivers, in the batch's order and the problem's precision."""
        out = wp.empty(len(pair_of_pixel), dtype=self.real, device=self.device)
        first = 0
        for own in values:
            self.launch(self.kernels.put_in_order, len(own), first, pair_of_pixel, own, out)
            first += len(own)
        return out

    def weighted_means(self, values: np.ndarray) -> np.ndarray:
        """Mean of the ``values`` (R, H, W) of the pixels that see a Gaussian, weighted by blending weight, shape ``(G,)``;
        pixels of NaN do not count, and without any it is NaN."""
        total, summed = (wp.zeros(len(self.seen), dtype=wp.float64, device=self.device) for _ in range(2))
        for batch in self.batches:
            own = values[batch.receivers].ravel()
            inputs = batch.row_start, batch.pair_pixel, batch.pair_weight, own, total, summed
            self.launch(self.kernels.add_to_means, len(self.seen), *inputs)
        weight = total.numpy()
        return np.divide(summed.numpy(), weight, out=np.full(len(weight), np.nan), where=weight > 0)


def harmonics(shape: tuple[int, int], real: type, device: DeviceLike) -> wp.array:
    """The 16 real harmonics at every pixel's direction, shape ``(H * W,)`` of 16-vectors, on the device."""
    kernels, toward = _kernels.build(real), pixel_directions(shape).reshape(-1, 3)
    out = wp.zeros(len(toward), dtype=kernels.vec16, device=device)
    launch(kernels.evaluate_basis, len(toward), [toward, out], device=device)
    return out
