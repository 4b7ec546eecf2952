"""Blending weights of the training receivers as batches on the device: what every layer of a fit works on.

A :class:`Problem` sorts the weights once into fixed batches, Gaussian by Gaussian, so that each sum has one owner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import DTypeLike

from warprrf import device as _device
from warprrf.device import DeviceLike
from warprrf.kernels.radio import harmonics as _kernels
from warprrf.rf.fields.harmonic.transport import Transport
from warprrf.rf.spectra.spectrum import pixel_directions


@dataclass(frozen=True)
class Pairs:
    """One batch's pairs on the device, Gaussian by Gaussian; see :mod:`warprrf.kernels.radio.harmonics`."""

    receivers: np.ndarray
    rows: int
    row_gaussian: wp.array
    row_start: wp.array
    pair_pixel: wp.array
    pair_direction: wp.array
    pair_weight: wp.array
    pixel_start: wp.array
    pair_of_pixel: wp.array


class Problem:
    """Blending weights of the training receivers, in batches on the device.

    Args:
        transport: weights of the training receivers.
        batch: receivers per optimiser step.
        seed: deals receivers into batches and orders them.
        device: where to fit.
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
        self.transport = transport
        self.seed = int(seed)
        self.device = _device.resolve(device)
        self.precision = np.dtype(precision)
        self.real = wp.float64 if self.precision == np.float64 else wp.float32
        self.kernels = _kernels.build(self.real)
        self.seen = transport.seen
        self.pixels = transport.shape[0] * transport.shape[1]
        count = len(transport.receivers)
        order = np.random.default_rng([self.seed, 0]).permutation(count)
        parts = np.array_split(order, max(1, round(count / batch)))
        self.batches = [self._sorted(np.sort(part)) for part in parts]
        self.basis = harmonics(transport.shape, self.real, self.device)

    def upload(self, values: np.ndarray, dtype: type | None = None) -> wp.array:
        """``values`` on the device, in the problem's precision unless ``dtype`` says otherwise."""
        return wp.array(
            np.ascontiguousarray(values, dtype=self.precision), dtype=dtype or self.real, device=self.device
        )

    def launch(self, kernel: wp.Kernel, dim: int, *inputs: Any) -> None:
        """Launch one of the problem's kernels on its device."""
        _device.launch(kernel, dim, inputs, device=self.device)

    def batch_at(self, step: int) -> int:
        """Which batch a step uses: all of them once an epoch, in an order that seed and epoch fix."""
        epoch, place = divmod(step, len(self.batches))
        return int(np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.batches))[place])

    def _sorted(self, receivers: np.ndarray) -> Pairs:
        """The pairs of some receivers, sorted by Gaussian."""
        part = self.transport.subset(receivers)
        order = np.argsort(part.gaussian, kind="stable")
        gaussian, pixel = part.gaussian[order], part.pixel[order]
        first = np.flatnonzero(np.diff(gaussian, prepend=-1))
        place = np.empty(len(order), dtype=np.int32)
        place[order] = np.arange(len(order), dtype=np.int32)
        arrays = {
            "row_gaussian": np.searchsorted(self.seen, gaussian[first]),
            "row_start": np.append(first, len(gaussian)),
            "pair_pixel": pixel,
            "pair_direction": pixel % self.pixels,
            "pixel_start": part.start,
            "pair_of_pixel": place,
        }
        on_device = {
            n: wp.array(a.astype(np.int32), dtype=int, device=self.device) for n, a in arrays.items()
        }
        return Pairs(receivers, len(first), pair_weight=self.upload(part.weight[order]), **on_device)


def harmonics(shape: tuple[int, int], real: type, device: DeviceLike) -> wp.array:
    """The 16 real harmonics at every pixel's direction, shape ``(H * W,)`` of 16-vectors, on the device."""
    kernels = _kernels.build(real)
    kind = np.float64 if real is wp.float64 else np.float32
    toward: wp.array = wp.array(
        pixel_directions(shape).reshape(-1, 3).astype(kind), dtype=kernels.vec3, device=device
    )
    out = wp.zeros(len(toward), dtype=kernels.vec16, device=device)
    _device.launch(kernels.evaluate_basis, len(toward), [toward, out], device=device)
    return out
