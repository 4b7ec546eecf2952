"""What is read of a receiver's paths: anything linear in their powers, and images of arrays that hear their phases.

Rays are summed in bins that a reading cannot tell apart, and readings are linear in those. A spectrum's bins are its
pixels, seen through a beam; a horn or a window of delays weighs bins of direction and delay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.polarisation import vertical_ends
from warprrf.rf.paths.ways import stops_of
from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.tracing.model import Effects, Layout
from warprrf.rf.tracing.rays import RayGrid
from warprrf.rf.tracing.records import Bins, Materials
from warprrf.rf.tracing.render import PathGains
from warprrf.rf.tracing.tracer import SPECULAR, View
from warprrf.rows import Rows, distinct_rows, sums_of


class Measurement(Protocol):
    """What is read of a receiver's path powers: rays are summed in B bins, and N readings are linear in those."""

    @property
    def batch_key(self) -> object:
        """Equal for measurements whose readings of powers in bins are the same."""

    @property
    def together(self) -> Superposition | None:
        """How paths without scattering add up where their phases count; None where their powers add."""

    def bins(self, view: View) -> tuple[np.ndarray, int]:
        """Bin of each ray, shape ``(K,)``, -1 for none, and how many bins there are."""

    def of_bins(self, power: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Readings of powers in the bins ``(B, C)``, shape ``(N, C)``; ``quick``: in single precision."""

    def to_bins(self, readings: np.ndarray) -> np.ndarray:
        """The transposed map of ``readings`` (N, C), shape ``(B, C)``, in single precision."""

    def of_paths(self, view: View) -> np.ndarray:
        """Readings of unit power on each line-of-sight and mirror path, shape ``(L, N)`` float32."""

    def part(self, index: np.ndarray) -> Measurement:
        """Some of its readings."""


def read(gains: PathGains, measurement: Measurement) -> np.ndarray:
    """Readings of the paths of one receiver, shape ``(N,)``."""
    view, together = gains.view, measurement.together
    bins, count = measurement.bins(view)
    own = bins >= 0
    table = np.bincount(bins[own], gains.by_ray()[own], minlength=count)[:, None]
    if together is None:
        direct = gains.specular.astype(np.float32) @ measurement.of_paths(view)
    else:
        p, tracer = gains.parameters, view.tracer
        materials = Materials(p, tracer.slabs, device=tracer.grid.device)
        amplitude = view.records[SPECULAR].fields(materials, together.sent, together.heard)[0]
        direct = p.gain * together.received(np.where(gains.specular > 0, amplitude, 0.0))
    return np.asarray(measurement.of_bins(table)[:, 0] + direct)


def slopes(
    view: View, measurement: Measurement, effects: Effects, materials: Materials, layout: Layout
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of readings of one receiver, whose powers add, to the parameters of materials ``(C, N)`` float32, and the places
    of these ``(C,)``."""
    tables, (own, count) = view.traced(effects), measurement.bins(view)
    side, specular = view.tracer.surface.side_group, tables.pop(SPECULAR)
    groups = [records.groups(side) for records in (specular, *tables.values())]
    place, index = layout.columns(materials.material[np.concatenate(groups)])
    rise = specular.slopes(materials, place, len(index)) * view.counted_paths(effects)[:, None]
    sums = np.zeros((count, len(index)), np.float32)
    for records in tables.values():
        records.add_slopes(materials, Bins.of(own[records.ray], count), place, sums)
    scattered = np.asarray(measurement.of_bins(sums, quick=True)).T
    return rise.T.astype(np.float32) @ measurement.of_paths(view) + scattered, index


class ByPixels:
    """What does not tell the rays of a pixel of their grid apart."""

    def bins(self, view: View) -> tuple[np.ndarray, int]:
        """A bin for each pixel."""
        grid = view.tracer.grid
        return _pixel_of(len(view.hits.face), grid.per_pixel), grid.shape[0] * grid.shape[1]


@lru_cache(maxsize=4)
def _pixel_of(rays: int, per_pixel: int) -> np.ndarray:
    """Pixel of each ray: one array for all receivers."""
    return np.arange(rays) // per_pixel


@dataclass(frozen=True, eq=False)
class SpectrumPixels(ByPixels):
    """Pixels of a receiver's spectrum.

    Attributes:
        beam: of the receiver.
        pixels: which ones, shape ``(N,)``; None for all.
    """

    beam: BeamOperator
    pixels: np.ndarray | None = None
    together: None = None

    @property
    def batch_key(self) -> object:
        """Whole spectra through one beam are; of a part, itself."""
        return id(self.beam if self.pixels is None else self)

    def of_bins(self, power: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Seen through the beam."""
        if self.pixels is not None:
            return np.asarray(self.beam.at(self.pixels) @ power.astype(np.float32, copy=False))
        return self.beam(power.reshape(*self.beam.shape, -1), quick=quick).reshape(power.shape)

    def to_bins(self, readings: np.ndarray) -> np.ndarray:
        """Spread by the beam the other way."""
        image = readings.astype(np.float32)
        if self.pixels is not None:
            image = np.zeros((int(np.prod(self.beam.shape)), readings.shape[1]), np.float32)
            image[self.pixels] = readings
        return self.beam.adjoint(image.reshape(*self.beam.shape, -1)).reshape(image.shape)

    def of_paths(self, view: View) -> np.ndarray:
        """Each path's beam."""
        beams = view.beams(self.beam.sigma_rad).reshape(len(view.paths), int(np.prod(self.beam.shape)))
        return beams if self.pixels is None else beams[:, self.pixels]

    def part(self, index: np.ndarray) -> SpectrumPixels:
        """Some of the pixels."""
        return SpectrumPixels(self.beam, index if self.pixels is None else self.pixels[index])


Weigh = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""From directions of arrival ``(K, 3)`` and departure ``(K, 3)`` and delays ``(K,)`` [s] of unit power to N readings of
each, shape ``(N, K)``."""


def direct_paths(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions of arrival and departure (L, 3) and delays (L,) [s] of one receiver's paths without scattering."""
    paths, toward = view.paths, view.outward
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    return paths.arrival, toward, paths.delay_m / SPEED_OF_LIGHT


@dataclass(frozen=True, eq=False)
class WeighedPaths:
    """Readings that weigh paths by where they arrive, where they left and how late they are: horns, profiles of delay.

    Attributes:
        ray_bin: bin of each ray of the view that it was made for, shape ``(K,)``.
        of_bin: readings of unit power in each bin, shape ``(D, B)`` float32; receivers at which an antenna is turned alike
            share it.
        row: which of these each reading is, shape ``(N,)``.
        path: readings of unit power on each line-of-sight and mirror path, shape ``(L, N)`` float32.
    """

    ray_bin: np.ndarray
    of_bin: np.ndarray
    row: np.ndarray
    path: np.ndarray
    together: None = None

    @property
    def batch_key(self) -> object:
        """The same rows of one table."""
        return id(self.of_bin), self.row.tobytes()

    @classmethod
    def turned(cls, view: View, weigh: Weigh, of_bin: np.ndarray, row: np.ndarray) -> WeighedPaths:
        """Those of one receiver that depend on arrival alone: bins are pixels, ``of_bin`` (D, B) that of their
        directions (:func:`pixel_means`), of which each reading is a ``row`` (N,)."""
        pixel = _pixel_of(len(view.hits.face), view.tracer.grid.per_pixel)
        return cls(pixel, of_bin, row, _of_direct(view, weigh))

    @classmethod
    def of(
        cls, view: View, weigh: Weigh, *, arrival: bool, departure: bool, delay_step_s: float | None
    ) -> WeighedPaths:
        """Those of one receiver.

        Light that comes over several surfaces is taken to leave and to be late as light scattered once is, which the
        ray that brings it sees: its departure is not known, and its true delay is longer. So is light that is seen through
        slabs: to be late as if the first one scattered it.

        Args:
            view: what the receiver sees.
            weigh: what is read of a path.
            arrival: whether that depends on where a path arrives.
            departure: whether it depends on where a path left.
            delay_step_s: delays that differ by less are not told apart; None where they do not count.
        """
        grid, transmitter, hit = view.tracer.grid, view.tracer.transmitter, view.hits.face >= 0
        ray = np.flatnonzero(hit)
        toward = grid.directions[ray % len(grid.directions)]
        out = view.hits.points(ray) - transmitter
        length = np.linalg.norm(out, axis=1)
        delay = (length + view.hits.range_m[ray]) / SPEED_OF_LIGHT
        out /= np.maximum(length, 1e-9)[:, None]
        key = [ray // grid.per_pixel if arrival else np.zeros(len(ray), int)]
        if departure:
            rows, columns = 60, 120  # of the grid of departures that rays are told apart in
            row = np.arccos(np.clip(out[:, 2], -1.0, 1.0)) / np.pi * rows
            column = (np.arctan2(out[:, 1], out[:, 0]) / (2.0 * np.pi) + 0.5) * columns
            key += [np.floor(row).astype(int), np.floor(column).astype(int)]
        if delay_step_s is not None:
            key.append(np.floor(delay / delay_step_s).astype(int))
        _, own, count = distinct_rows(np.column_stack(key))
        mean = [sums_of(values, own) for values in (toward, out, delay[:, None])]
        ray_bin = np.full(len(hit), -1)
        ray_bin[ray] = own
        unit = [v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9) for v in mean[:2]]
        of_bin = weigh(unit[0], unit[1], mean[2][:, 0] / np.maximum(count, 1)).astype(np.float32, copy=False)
        return cls(ray_bin, of_bin, np.arange(len(of_bin)), _of_direct(view, weigh))

    def bins(self, view: View) -> tuple[np.ndarray, int]:
        """Bins of direction and delay."""
        return self.ray_bin, self.of_bin.shape[1]

    def of_bins(self, power: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Weighed, in single precision always: powers and weights are positive, and a table in double takes seconds."""
        power = power.astype(np.float32)
        if self._is_few:
            return np.asarray(self.of_bin[self.row] @ power)
        return np.asarray(self.of_bin @ power)[self.row]

    def to_bins(self, readings: np.ndarray) -> np.ndarray:
        """Weighed the other way."""
        readings = readings.astype(np.float32)
        if self._is_few:
            return np.asarray(self.of_bin[self.row].T @ readings)
        table = np.zeros((len(self.of_bin), readings.shape[1]), np.float32)
        np.add.at(table, self.row, readings)
        return np.asarray(self.of_bin.T @ table)

    def of_paths(self, view: View) -> np.ndarray:
        """Each path's weights."""
        return self.path

    def part(self, index: np.ndarray) -> WeighedPaths:
        """Some of the readings."""
        return WeighedPaths(self.ray_bin, self.of_bin, self.row[index], self.path[:, index])

    @property
    def _is_few(self) -> bool:
        """Whether taking rows out of the table costs less than reading all of it."""
        return 2 * len(self.row) < len(self.of_bin)


def _of_direct(view: View, weigh: Weigh) -> np.ndarray:
    """Readings of unit power on each line-of-sight and mirror path, shape ``(L, N)`` float32."""
    return np.ascontiguousarray(weigh(*direct_paths(view)).T, np.float32)


def pixel_means(grid: RayGrid) -> np.ndarray:
    """Unit vectors amid the rays of each pixel, shape ``(P, 3)``."""
    mean = grid.directions.reshape(-1, grid.per_pixel, 3).mean(axis=1)
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Superposition(Rows):
    """How L line-of-sight and mirror paths add up in N readings of an array, between vertical antennas.

    Attributes:
        field: amplitude of each reading for a path of amplitude 1, phase of its length included, shape ``(L, N)``.
        power: what adds in power beside, because lengths are not known so well, or nothing of the phase, shape ``(L, N)`` float32.
        sent, heard: fields of the antennas at both ends of each path, shape ``(L, 2)``; see :func:`vertical_ends`.
    """

    field: np.ndarray
    power: np.ndarray
    sent: np.ndarray
    heard: np.ndarray

    def received(self, amplitude: np.ndarray) -> np.ndarray:
        """Readings of paths of ``amplitude`` (L,), shape ``(N,)``."""
        return np.asarray(0.5 * amplitude @ self.slopes(amplitude))

    def slopes(self, amplitude: np.ndarray) -> np.ndarray:
        """Derivatives of :meth:`received` to the amplitudes, shape ``(L, N)``."""
        whole = np.conj(amplitude.astype(np.float32) @ self.field)
        return np.asarray(2.0 * ((whole * self.field).real + amplitude[:, None] * self.power))


@dataclass(frozen=True, eq=False)
class ArrayImage(ByPixels):
    """Angular spectrum |a^H h|^2 / M^2 of an array, in expectation over the phases of what is scattered.

    Scattered light adds a^H R a, R its covariance between elements: sums over the lags between them.

    Attributes:
        steered: of each reading by lag, shape ``(N, K)`` float32.
        arriving: of unit power in each bin by lag, shape ``(K, B)`` float32; bins are pixels of the rays' grid.
        together: paths without scattering.
    """

    steered: np.ndarray
    arriving: np.ndarray
    together: Superposition

    @property
    def batch_key(self) -> object:
        """Itself."""
        return id(self)

    @classmethod
    def of(cls, view: View, array: PlanarArray, directions: np.ndarray, length_std_m: float) -> ArrayImage:
        """That of the one receiver of ``view``, steered to ``directions`` (N, 3); lengths of paths are known to
        ``length_std_m`` [m]."""
        grid, paths = view.tracer.grid, view.paths
        place = array.positions(1.0)
        lag = np.round((place[:, None] - place[None]).reshape(-1, 3), 9)
        first = np.take_along_axis(lag, (lag != 0).argmax(axis=1)[:, None], axis=1)
        lag, count = np.unique(lag * np.where(first < 0, -1.0, 1.0) + 0.0, axis=0, return_counts=True)
        pixels = pixel_means(grid)
        wave, met = 2.0 * np.pi * directions @ lag.T, 2.0 * np.pi * pixels @ lag.T
        share = count / array.elements**2
        steered = np.concatenate([share * np.cos(wave), share * np.sin(wave)], axis=1)
        arriving = np.concatenate([np.cos(met), np.sin(met)], axis=1) * array.gain(pixels)[:, None]
        heard = array.response(paths.arrival, 1.0) @ array.response(directions, 1.0).conj().T / array.elements
        heard *= np.sqrt(array.gain(paths.arrival))[:, None]
        wavelength = view.tracer.wavelength_m
        kept = np.exp(-0.5 * (2.0 * np.pi * length_std_m / wavelength) ** 2)
        # By which phase an edge turns a field is not known.
        kept = np.where(paths.over_edge, 0.0, kept)[:, None]
        phase = np.exp(-2j * np.pi * np.mod(paths.delay_m / wavelength, 1.0))
        together = Superposition(
            (kept * phase[:, None] * heard).astype(np.complex64),
            ((1.0 - kept**2) * np.abs(heard) ** 2).astype(np.float32),
            *_vertical(view),
        )
        return cls(steered.astype(np.float32), np.ascontiguousarray(arriving.T, np.float32), together)

    def of_bins(self, power: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """By their lags."""
        power = power.astype(np.float32 if quick else power.dtype, copy=False)
        return np.asarray(self.steered @ (self.arriving @ power))

    def to_bins(self, readings: np.ndarray) -> np.ndarray:
        """By their lags, the other way."""
        return np.asarray(self.arriving.T @ (self.steered.T @ readings.astype(np.float32)))

    def of_paths(self, view: View) -> np.ndarray:
        """Of each path alone."""
        return np.asarray(np.abs(self.together.field) ** 2 + self.together.power)

    def part(self, index: np.ndarray) -> ArrayImage:
        """Some of the directions."""
        t = self.together
        fewer = replace(t, field=t.field[:, index], power=t.power[:, index])
        return replace(self, steered=self.steered[index], together=fewer)


def _vertical(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Fields of vertical antennas at both ends of each path of one receiver, shape ``(L, 2)`` each."""
    paths = view.paths
    sent, received = np.zeros((len(paths), 2)), np.zeros((len(paths), 2))
    each = paths.order + paths.slabs
    for count in np.unique(each):
        own = np.flatnonzero(each == count)
        ends = np.broadcast_to(view.receivers[0], (len(own), 3))
        stops = stops_of(view.tracer.transmitter, paths.point[own, :count], ends)
        sent[own], received[own] = vertical_ends(stops, paths.normal[own, :count])
    return sent, received
