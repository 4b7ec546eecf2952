"""Blending weights of the training receivers as batches on the device: what every layer of a fit works on.

A :class:`Problem` sorts the weights once into fixed batches, Gaussian by Gaussian, so that each sum has one owner.
Weights on disk are fitted from disk: their batches are sorted into files beside them and mapped into memory one at a
time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.files import write_atomically
from warprrf.kernels import ssim as _ssim
from warprrf.kernels.radio import harmonics as _kernels
from warprrf.rf.fields.harmonic.store import StoredTransport
from warprrf.rf.fields.harmonic.transport import Transport
from warprrf.rf.spectra.spectrum import pixel_directions

_BATCH_ARRAYS = (
    "row_gaussian", "row_start", "pair_pixel", "pair_direction", "pair_weight", "pixel_start", "pair_of_pixel",
)  # fmt: skip


@dataclass(frozen=True)
class Batch:
    """One batch's pairs on the device, Gaussian by Gaussian; see ``kernels.field``."""

    receivers: np.ndarray
    rows: int
    row_gaussian: wp.array
    row_start: wp.array
    pair_pixel: wp.array
    pair_direction: wp.array
    pair_weight: wp.array
    pixel_start: wp.array
    pair_of_pixel: wp.array

    def pair_owner(self) -> np.ndarray:
        """Which of the Gaussians seen each pair belongs to, shape ``(E,)``."""
        return np.repeat(self.row_gaussian.numpy(), np.diff(self.row_start.numpy()))


class Problem:
    """Blending weights of the training receivers, in batches on the device.

    Args:
        transport: weights of the training receivers, in memory or stored.
        batch: receivers per optimiser step.
        seed: deals receivers into batches and orders them.
        device: where to fit.
        precision: ``np.float32``, or ``np.float64`` for gradient checks.
    """

    def __init__(
        self,
        transport: Transport | StoredTransport,
        *,
        batch: int = 10,
        seed: int = 0,
        device: Any = None,
        precision: Any = np.float32,
    ) -> None:
        if not isinstance(batch, int | np.integer) or batch < 1:
            raise ValueError(f"batch: got {batch!r}, expected a whole number of receivers of at least 1")
        self.transport = transport
        self.seed = int(seed)
        self.device = _device.resolve(device)
        self.precision = np.dtype(precision)
        self.real = wp.float64 if self.precision == np.float64 else wp.float32
        self.kernels = _kernels.build(self.real)
        self.ssim = _ssim.build(self.real)
        self.seen = transport.seen
        self.pixels = transport.shape[0] * transport.shape[1]
        count = len(transport.receivers)
        order = np.random.default_rng([self.seed, 0]).permutation(count)
        parts = [np.sort(part) for part in np.array_split(order, max(1, round(count / batch)))]
        self.batches: Sequence[Batch]
        if isinstance(transport, Transport):
            self.batches = [self.uploaded(part, self.sorted_pairs(part)) for part in parts]
        else:
            name = f"batches_{self.seed}_{len(parts)}_{self.precision.name}"
            self.batches = MappedBatches(self, transport.folder / name, parts)
        self.basis = harmonics(transport.shape, self.real, self.device)

    @property
    def in_memory(self) -> bool:
        """Whether all batches are: else one at a time is."""
        return not isinstance(self.batches, MappedBatches)

    def upload(self, values: np.ndarray, dtype: Any = None) -> wp.array:
        """``values`` on the device, in the problem's precision unless ``dtype`` says otherwise."""
        return wp.array(
            np.ascontiguousarray(values, dtype=self.precision), dtype=dtype or self.real, device=self.device
        )

    def launch(self, kernel: Any, dim: int, *inputs: Any) -> None:
        """Launch one of the problem's kernels on its device."""
        _device.launch(kernel, dim, inputs, device=self.device)

    def batch_at(self, step: int) -> int:
        """Which batch a step uses: all of them once an epoch, in an order that seed and epoch fix."""
        epoch, place = divmod(step, len(self.batches))
        return int(np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.batches))[place])

    def sorted_pairs(self, receivers: np.ndarray) -> dict[str, np.ndarray]:
        """The arrays of a :class:`Batch`."""
        part = self.transport.subset(receivers)
        pixel = np.repeat(np.arange(len(part.start) - 1, dtype=np.int32), np.diff(part.start))
        order = np.argsort(part.gaussian, kind="stable")
        gaussian = part.gaussian[order]
        first = (
            np.flatnonzero(np.concatenate([[True], gaussian[1:] != gaussian[:-1]])) if len(gaussian) else [0]
        )
        place = np.empty(len(order), dtype=np.int32)
        place[order] = np.arange(len(order), dtype=np.int32)
        rows = np.searchsorted(self.seen, gaussian[first]) if len(gaussian) else np.empty(0)
        return {
            "row_gaussian": rows.astype(np.int32),
            "row_start": np.array([*first, len(gaussian)], dtype=np.int32),
            "pair_pixel": pixel[order],
            "pair_direction": pixel[order] % np.int32(self.pixels),
            "pair_weight": part.weight[order].astype(self.precision),
            "pixel_start": part.start.astype(np.int32),
            "pair_of_pixel": place,
        }

    def uploaded(self, receivers: np.ndarray, arrays: dict[str, np.ndarray], *, copy: bool = True) -> Batch:
        """A batch of what :meth:`sorted_pairs` gave."""
        types = {"pair_weight": self.real}
        on_device = {
            name: wp.array(values, dtype=types.get(name, int), device=self.device, copy=copy)
            for name, values in arrays.items()
        }
        return Batch(receivers=receivers, rows=len(arrays["row_gaussian"]), **on_device)


class MappedBatches(Sequence[Batch]):
    """Batches in files, one of them mapped into memory at a time; sorted and written when first asked for.

    Files depend on nothing but their folder's name and the store that it lies in, so another fit finds them again.
    """

    def __init__(self, problem: Problem, folder: Path, parts: list[np.ndarray]) -> None:
        self._problem, self._folder, self._parts = problem, folder, parts
        self._kept: tuple[int, Batch] | None = None

    def __len__(self) -> int:
        return len(self._parts)

    @overload
    def __getitem__(self, index: int) -> Batch: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Batch]: ...
    def __getitem__(self, index: int | slice) -> Batch | Sequence[Batch]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        if not 0 <= index < len(self):
            raise IndexError(index)
        if self._kept is None or self._kept[0] != index:
            self._kept = None
            self._kept = index, self._mapped(index)
        return self._kept[1]

    def _mapped(self, index: int) -> Batch:
        files = {name: self._folder / f"{index:05d}_{name}.npy" for name in _BATCH_ARRAYS}
        if not all(file.exists() for file in files.values()):
            for name, values in self._problem.sorted_pairs(self._parts[index]).items():
                write_atomically(files[name], lambda file, values=values: np.save(file, values))  # type: ignore[misc]
        arrays = {name: np.load(file, mmap_mode="r") for name, file in files.items()}
        on_cpu = self._problem.device.is_cpu
        return self._problem.uploaded(self._parts[index], arrays, copy=not on_cpu)


def harmonics(shape: tuple[int, int], real: Any, device: Any) -> wp.array:
    """The 16 real harmonics at every pixel's direction, shape ``(H * W,)`` of 16-vectors, on the device."""
    kernels = _kernels.build(real)
    kind = np.float64 if real is wp.float64 else np.float32
    toward: wp.array = wp.array(
        pixel_directions(shape).reshape(-1, 3).astype(kind), dtype=kernels.vec3, device=device
    )
    out = wp.zeros(len(toward), dtype=kernels.vec16, device=device)
    _device.launch(kernels.evaluate_basis, len(toward), [toward, out], device=device)
    return out
