"""Blending weights on disk: a compact file a receiver, written once and read a few receivers at a time.

A fit needs a handful of receivers at once, so memory does not grow with their number. What a file holds per pair: the
Gaussian (uint32) and its share of the pixel's weight (float16); per pixel: how many pairs, which of them is dominant
(uint8 each), the sum of weights and the blended mean range (float32), and what top-K left out (float16): 6 bytes a pair
and 12 a pixel. Shares are at least :data:`warprrf.rf.fields.harmonic.transport.MIN_WEIGHT`, which float16 holds to 2^-11; read
back they are scaled to the sum, which is exact: a weight is off by at most 2^-10 of itself, 0.004 dB. Interaction
points follow from the dominant Gaussian in float64 and directions from the grid, so neither is stored.

Files are written to a temporary name and renamed; a killed run goes on with the receivers that are missing.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.rf.fields import files as field_files
from warprrf.rf.fields.harmonic.transport import TOP_K, Transport, View, index_of, joined, viewing

FORMAT = "warprrf transport 1"
HEADER = "transport.safetensors"
RECEIVERS_AT_ONCE = 10
"""Receivers that :meth:`StoredTransport.parts` reads at a time: some 20 MB at 90 x 180 pixels."""


def store_transport(
    folder: str | os.PathLike[str],
    gaussians: Gaussians,
    receivers: Any,
    shape: tuple[int, int],
    *,
    range_db: Any = (-60.0, 0.0),
    rule: str = "product",
    top_k: int = TOP_K,
    device: Any = None,
    progress: Progress | None = None,
) -> StoredTransport:
    """:func:`~warprrf.rf.fields.harmonic.transport.transport` into ``folder``; receivers that it holds are not done again.

    Args:
        folder: where the files go; made if missing.
        gaussians, receivers, shape, range_db, rule, top_k, device, progress: as there.

    Raises:
        ValueError: as there, or if the folder holds the weights of other geometry, receivers or options.
    """
    view, positions = viewing(gaussians, receivers, shape, range_db, rule, top_k, device)
    place = Path(folder)
    geometry = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities)
    identity = field_files.fingerprint(
        FORMAT, *geometry, positions, view.shape, repr(view.blending), view.top_k
    )
    header = place / HEADER
    if header.exists():
        known = field_files.read(header, FORMAT)[1].get("identity")
        if known != identity:
            raise ValueError(
                f"folder: {place} holds weights of other geometry, receivers or options; delete it or name another"
            )
    else:
        about = {"identity": identity, "shape": view.shape, "rule": rule, "gaussians": len(gaussians)}
        field_files.write(header, {"receivers": positions}, about, FORMAT)
    for i in range(len(positions)):
        file = _file(place, i)
        if not file.exists():
            field_files.write(file, _encoded(view(i), view.top_k), {"identity": identity}, FORMAT)
        if progress is not None:
            progress("transport", i + 1, len(positions))
    return StoredTransport(place)


class StoredTransport:
    """Blending weights in a folder that :func:`store_transport` filled; asked like a :class:`Transport`.

    Attributes:
        folder: where the files are.
        shape: rows and columns of a spectrum.
        receivers: positions [m], shape ``(R, 3)``.
        rule: transmittance rule.
        identity: digest of geometry, receivers and options.

    Raises:
        FileNotFoundError: if there is no store.
        ValueError: if it is unfinished or corrupt.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        tensors, about = field_files.read(self.folder / HEADER, FORMAT)
        self.receivers: np.ndarray = tensors["receivers"]
        self.shape: tuple[int, int] = (int(about["shape"][0]), int(about["shape"][1]))
        self.rule, self.identity = str(about["rule"]), str(about["identity"])
        self._gaussians = int(about["gaussians"])
        missing = [i for i in range(len(self.receivers)) if not _file(self.folder, i).exists()]
        if missing:
            raise ValueError(
                f"{self.folder}: {len(missing)} of {len(self.receivers)} receivers are missing; store_transport goes on"
            )

    def __repr__(self) -> str:  # also what a checkpoint's fingerprint reads
        return f"StoredTransport({len(self.receivers)} receivers, {self.identity})"

    def subset(self, indices: Sequence[int] | np.ndarray) -> Transport:
        """The receivers at ``indices``, in that order, in memory."""
        chosen = np.asarray(indices, dtype=np.int64)
        views = [_decoded(self._read(int(i)), self.shape) for i in chosen]
        return joined(self.receivers[chosen], self.shape, self.rule, views)

    def at(self, receiver: Any) -> Transport:
        """The part of one receiver (3,) [m].

        Raises:
            ValueError: if it is none of these receivers.
        """
        return self.subset([index_of(self.receivers, receiver)])

    def parts(self) -> Iterator[tuple[np.ndarray, Transport]]:
        """The receivers in portions that fit into memory, with their indices."""
        for first in range(0, len(self.receivers), RECEIVERS_AT_ONCE):
            chosen = np.arange(first, min(first + RECEIVERS_AT_ONCE, len(self.receivers)))
            yield chosen, self.subset(chosen)

    @cached_property
    def pairs(self) -> int:
        """Pairs of pixel and Gaussian in all."""
        return sum(part.pairs for _, part in self.parts())

    @cached_property
    def seen(self) -> np.ndarray:
        """Gaussians that any receiver sees, ascending."""
        mask = np.zeros(self._gaussians, dtype=bool)
        for i in range(len(self.receivers)):
            mask[self._read(i)["gaussian"]] = True
        return np.flatnonzero(mask).astype(np.int32)

    @property
    def dominant(self) -> np.ndarray:
        """Gaussian with the largest weight, shape ``(R, H, W)`` int32, -1 where there is none."""
        return np.concatenate([part.dominant for _, part in self.parts()])

    @property
    def expected_range(self) -> np.ndarray:
        """Blended mean of the peak ranges [m], shape ``(R, H, W)`` float32, NaN where there is none."""
        return np.stack([self._read(i)["expected_range"] for i in range(len(self.receivers))])

    @property
    def pixel_weight(self) -> np.ndarray:
        """Sum of the weights per pixel, shape ``(R, H, W)`` float64."""
        totals = [self._read(i)["total"] for i in range(len(self.receivers))]
        return np.stack(totals).astype(np.float64)

    @cached_property
    def dropped(self) -> tuple[float, float]:
        """Largest and mean weight per pixel that top-K left out."""
        found = [self._read(i)["dropped"] for i in range(len(self.receivers))]
        return float(max(d.max() for d in found)), float(np.mean([d.mean(dtype=np.float64) for d in found]))

    @property
    def bytes(self) -> int:
        """Size of the receivers' files."""
        return sum(_file(self.folder, i).stat().st_size for i in range(len(self.receivers)))

    def _read(self, receiver: int) -> dict[str, np.ndarray]:
        file = _file(self.folder, receiver)
        tensors, about = field_files.read(file, FORMAT)
        if about.get("identity") != self.identity:
            raise ValueError(f"{file}: belongs to another store; delete it and store again")
        return tensors


def _file(folder: Path, receiver: int) -> Path:
    return folder / f"receiver_{receiver:05d}.safetensors"


def _encoded(view: View, top_k: int) -> dict[str, np.ndarray]:
    """The arrays of a receiver's file."""
    small = np.uint8 if top_k <= np.iinfo(np.uint8).max else np.uint16 if top_k <= 65_535 else np.uint32
    pixel = np.repeat(np.arange(len(view.counts)), view.counts)
    total = np.bincount(pixel, weights=view.weight, minlength=len(view.counts))
    start = np.cumsum(view.counts) - view.counts
    strongest = np.zeros(len(view.counts), dtype=small)
    mine = np.flatnonzero(view.gaussian == view.dominant.ravel()[pixel])
    strongest[pixel[mine]] = mine - start[pixel[mine]]
    return {
        "counts": view.counts.astype(small),
        "gaussian": view.gaussian.astype(np.uint32),
        "share": (view.weight / total[pixel]).astype(np.float16),
        "total": total.astype(np.float32).reshape(view.dominant.shape),
        "strongest": strongest,
        "expected_range": view.expected_range,
        "dropped": view.dropped.astype(np.float16),
    }


def _decoded(stored: dict[str, np.ndarray], shape: tuple[int, int]) -> View:
    counts = stored["counts"].astype(np.int64)
    gaussian, share = stored["gaussian"].astype(np.int32), stored["share"].astype(np.float32)
    pixel = np.repeat(np.arange(len(counts)), counts)
    rounded = np.bincount(pixel, weights=share, minlength=len(counts))
    scale = np.divide(stored["total"].ravel(), rounded, out=np.zeros(len(counts)), where=counts > 0)
    strongest = np.minimum(np.cumsum(counts) - counts + stored["strongest"], max(len(gaussian) - 1, 0))
    dominant = np.full(len(counts), -1, dtype=np.int32)
    dominant[counts > 0] = gaussian[strongest[counts > 0]]
    return View(
        counts=counts,
        gaussian=gaussian,
        weight=(share * scale[pixel]).astype(np.float32),
        dominant=dominant.reshape(shape),
        expected_range=stored["expected_range"],
        dropped=stored["dropped"].astype(np.float32),
    )
