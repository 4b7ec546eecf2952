"""What is read of a receiver's paths: anything linear in their powers.

Rays are summed in bins that a reading cannot tell apart, and readings are linear in those. A spectrum's bins are its
pixels, seen through a beam; a horn or a window of delays weighs bins of direction and delay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.render import PathPowers
from warprrf.rf.fields.bistatic.transport import ReceiverView
from warprrf.rf.spectra.beam import BeamOperator

DEPARTURES = (60, 120)
"""Rows and columns of the grid of departures that rays are told apart in, where a transmitter's pattern counts."""


class Measurement(Protocol):
    """What is read of a receiver's path powers: rays are summed in B bins, and N readings are linear in those."""

    def bins(self, view: ReceiverView) -> tuple[np.ndarray, int]:
        """Bin of each ray, shape ``(K,)``, -1 for none, and how many bins there are."""

    def of_bins(self, power: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Readings of powers in the bins ``(B, C)``, shape ``(N, C)``; ``quick``: in single precision."""

    def to_bins(self, readings: np.ndarray) -> np.ndarray:
        """The transposed map of ``readings`` (N, C), shape ``(B, C)``, in single precision."""

    def of_paths(self, view: ReceiverView) -> np.ndarray:
        """Readings of unit power on each line-of-sight and mirror path, shape ``(L, N)`` float32."""

    def part(self, index: np.ndarray) -> Measurement:
        """Some of its readings."""


def read(view: ReceiverView, measurement: Measurement, powers: PathPowers) -> np.ndarray:
    """Readings of the paths of one receiver, shape ``(N,)``."""
    bins, count = measurement.bins(view)
    own, power = bins >= 0, powers.single + powers.further.by_ray()
    table = np.bincount(bins[own], power[own], minlength=count)[:, None]
    direct = powers.mirror.astype(np.float32) @ measurement.of_paths(view)
    return np.asarray(measurement.of_bins(table)[:, 0] + direct)


@dataclass(frozen=True, eq=False)
class SpectrumPixels:
    """Pixels of a receiver's spectrum.

    Attributes:
        beam: of the receiver.
        pixels: which ones, shape ``(N,)``; None for all.
    """

    beam: BeamOperator
    pixels: np.ndarray | None = None

    def bins(self, view: ReceiverView) -> tuple[np.ndarray, int]:
        """A bin for each pixel."""
        grid = view.transport.grid
        return np.arange(len(view.hits.face)) // grid.sub_pixels**2, grid.shape[0] * grid.shape[1]

    def of_bins(self, power: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Seen through the beam."""
        if self.pixels is not None:
            return self.beam.at(self.pixels, power)
        return self.beam(power.reshape(*self.beam.shape, -1), quick=quick).reshape(power.shape)

    def to_bins(self, readings: np.ndarray) -> np.ndarray:
        """Spread by the beam the other way."""
        image = readings.astype(np.float32)
        if self.pixels is not None:
            image = np.zeros((int(np.prod(self.beam.shape)), readings.shape[1]), np.float32)
            image[self.pixels] = readings
        return self.beam.adjoint(image.reshape(*self.beam.shape, -1), quick=True).reshape(image.shape)

    def of_paths(self, view: ReceiverView) -> np.ndarray:
        """Each path's beam."""
        if view.beams is None:
            raise ValueError("view: it was traced without a receiver's beam, expected one of a spectrum")
        beams = view.beams.reshape(len(view.beams), int(np.prod(self.beam.shape)))
        return beams if self.pixels is None else beams[:, self.pixels]

    def part(self, index: np.ndarray) -> SpectrumPixels:
        """Some of the pixels."""
        return SpectrumPixels(self.beam, index if self.pixels is None else self.pixels[index])


Weigh = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""From directions of arrival ``(K, 3)`` and departure ``(K, 3)`` and delays ``(K,)`` [s] of unit power to N readings of
each, shape ``(N, K)``."""


@dataclass(frozen=True, eq=False)
class WeighedPaths:
    """Readings that weigh paths by where they arrive, where they left and how late they are: horns, profiles of delay.

    Attributes:
        ray_bin: bin of each ray of the view that it was made for, shape ``(K,)``.
        of_bin: readings of unit power in each bin, shape ``(N, B)`` float32.
        path: readings of unit power on each line-of-sight and mirror path, shape ``(L, N)`` float32.
    """

    ray_bin: np.ndarray
    of_bin: np.ndarray
    path: np.ndarray

    @classmethod
    def of(
        cls, view: ReceiverView, weigh: Weigh, *, departure: bool, delay_step_s: float | None
    ) -> WeighedPaths:
        """Those of one receiver.

        Light that comes over several surfaces is taken to leave and to be late as light scattered once is, which the
        ray that brings it sees: its departure is not known, and its true delay is longer.

        Args:
            view: what the receiver sees.
            weigh: what is read of a path.
            departure: whether that depends on where a path left.
            delay_step_s: delays that differ by less are not told apart; None where they do not count.
        """
        grid, transmitter, hit = view.transport.grid, view.transport.transmitter, view.hits.face.numpy() >= 0
        ray = np.flatnonzero(hit)
        arrival = grid.directions[ray % len(grid.directions)]
        out = view.hits.points(ray) - transmitter
        length = np.linalg.norm(out, axis=1)
        delay = (length + view.hits.range_m.numpy()[ray]) / SPEED_OF_LIGHT
        out /= np.maximum(length, 1e-9)[:, None]
        key = [ray // grid.sub_pixels**2]
        if departure:
            rows, columns = DEPARTURES
            row = np.arccos(np.clip(out[:, 2], -1.0, 1.0)) / np.pi * rows
            column = (np.arctan2(out[:, 1], out[:, 0]) / (2.0 * np.pi) + 0.5) * columns
            key += [np.floor(row).astype(int), np.floor(column).astype(int)]
        if delay_step_s is not None:
            key.append(np.floor(delay / delay_step_s).astype(int))
        first, own = np.unique(np.column_stack(key), axis=0, return_index=True, return_inverse=True)[1:]
        own, number = own.reshape(-1), len(first)
        mean = [
            np.stack([np.bincount(own, column, minlength=number) for column in values.T], axis=1)
            for values in (arrival, out, delay[:, None])
        ]
        ray_bin = np.full(len(hit), -1)
        ray_bin[ray] = own
        paths = view.paths
        toward = np.where((paths.order > 0)[:, None], paths.point[:, 0], view.receivers[0]) - transmitter
        unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (*mean[:2], toward)]
        count = np.bincount(own, minlength=number)
        return cls(
            ray_bin,
            weigh(unit[0], unit[1], mean[2][:, 0] / np.maximum(count, 1)).astype(np.float32),
            np.ascontiguousarray(
                weigh(paths.arrival, unit[2], paths.length_m / SPEED_OF_LIGHT).T, np.float32
            ),
        )

    def bins(self, view: ReceiverView) -> tuple[np.ndarray, int]:
        """Bins of direction and delay."""
        return self.ray_bin, self.of_bin.shape[1]

    def of_bins(self, power: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Weighed."""
        return np.asarray(self.of_bin @ power.astype(np.float32 if quick else power.dtype, copy=False))

    def to_bins(self, readings: np.ndarray) -> np.ndarray:
        """Weighed the other way."""
        return np.asarray(self.of_bin.T @ readings.astype(np.float32))

    def of_paths(self, view: ReceiverView) -> np.ndarray:
        """Each path's weights."""
        return self.path

    def part(self, index: np.ndarray) -> WeighedPaths:
        """Some of the readings."""
        return WeighedPaths(self.ray_bin, self.of_bin[index], self.path[:, index])
