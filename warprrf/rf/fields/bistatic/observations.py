"""What a fit learns from: data sets of any kind, taken apart into places, one receiver under one transmitter each, and what
was read there as observations that a fit can predict and linearise.

A new kind of measurement is a class like :class:`_Spectra` in :data:`KINDS`: it says where it was taken, and how its readings
come from paths (:mod:`warprrf.rf.fields.bistatic.measured`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from warprrf.cache import Cache, cached_property
from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.kernels.radio.records import EXCESS_COLUMN, MIRROR, MIRRORED_COLUMN, THROUGH_COLUMN
from warprrf.rf.channel.array_spectra import ArraySpectra
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.fresnel import fresnel_curves
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.base import Data, Measured
from warprrf.rf.fields.bistatic.measured import (
    ArrayImage,
    Measurement,
    SpectrumPixels,
    Superposition,
    WeighedPaths,
    pixel_means,
    read,
)
from warprrf.rf.positions import check_dataset
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset, question_spectra
from warprrf.rf.spectra.levels import free_space_gain
from warprrf.rf.spectra.readings import Readings, fading_db, path_weights, question_readings
from warprrf.rf.spectra.spectrum import to_db
from warprrf.rf.tracing.model import SETS, Effects, Layout, Model, Parameters
from warprrf.rf.tracing.records import Bins, Materials
from warprrf.rf.tracing.render import PathGains, materials_of, path_gains
from warprrf.rf.tracing.tracer import SPECULAR, View, sequences
from warprrf.rows import Rows, distinct_rows

OWN_GAIN = -2
"""In place of a measuring chain's index: readings of one place whose common gain is not known: it is the ratio of what
was read and what is predicted, summed."""
NOISE_DB = 3.0
"""Standard deviation of an independent reading's error that priors are weighed against. Errors of a view's pixels hang
together (one misplaced edge), which a larger value stands for."""
READINGS_SHAPE = (60, 120)
"""Rows and columns of the rays around a receiver of whom no spectrum is known, and of its field's spectra."""
READING_ERROR_DB = 1.0
"""Standard deviation of what a field cannot explain of a reading without noise [dB]."""
HUBER_DB = 3.0  # see :class:`Observation`
TAP_STEPS = 4.0  # that delays are told apart, and a clock is tried in, per tap


def huber(error: np.ndarray, threshold: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Loss and weight of each error: square up to ``threshold``, linear beyond (Huber 1964)."""
    size = np.abs(error)
    small = size <= threshold
    loss = np.where(small, error**2, threshold * (2 * size - threshold))
    return loss, np.where(small, 1.0, threshold / np.maximum(size, 1e-12))


@dataclass(frozen=True)
class Place:
    """A receiver under a transmitter, and which readings are of it.

    Attributes:
        data: index of the data set.
        rows: its readings there, shape ``(N,)``; of spectra the one receiver's index.
        transmitter, receiver: positions [m], shape ``(3,)``.
        frequency_hz: carrier.
        shape: rows and columns of its rays' grid.
        air: whose absorption is in the readings.
        beam_sigma_rad: width of the receiver's beam; None where no spectrum was read.
        chain: name of the measuring chain, "" where its gain is known.
    """

    data: int
    rows: np.ndarray
    transmitter: np.ndarray
    receiver: np.ndarray
    frequency_hz: float
    shape: tuple[int, int]
    air: Air | None
    beam_sigma_rad: float | None = None
    chain: str = ""

    @property
    def tracer_key(self) -> tuple[object, ...]:
        """All of :attr:`view_key` but the receiver: one tracer serves places where it is the same."""
        return self.transmitter.tobytes(), self.frequency_hz, self.shape, self.beam_sigma_rad, self.air

    @property
    def view_key(self) -> tuple[object, ...]:
        """All that the geometry seen there depends on."""
        return *self.tracer_key, self.receiver.tobytes()


Seen = tuple[Place, View]
"""A place, and what is seen there."""


def as_list(data: Data, name: str = "ds") -> list[Measured]:
    """Data sets as a list, errors call it ``name``; of several that have one name each gets a number after it.

    Raises:
        TypeError: for anything else.
        ValueError: for none.
    """
    several: list[Measured] = []
    for one in data if isinstance(data, list | tuple) else [data]:
        if not isinstance(one, Measured):
            raise TypeError(
                f"{name}: got {type(one).__name__}, expected a SpectrumDataset, Readings, ArraySpectra, or a list of them"
            )
        several.append(one)
    if not several:
        raise ValueError(
            f"{name}: got an empty list, expected a SpectrumDataset, Readings, or several of them"
        )
    names = [None if isinstance(one, SpectrumDataset) else one.name for one in several]
    for k, one in enumerate(several):
        if not isinstance(one, SpectrumDataset) and names.count(one.name) > 1:
            several[k] = replace(one, name=f"{one.name} {names[: k + 1].count(one.name)}")
    return several


@dataclass(frozen=True)
class Target(Rows):
    """What was read at one receiver, and how errors of it count.

    Attributes:
        db: readings, 10 log10(P / N0 + 1), shape ``(N,)``.
        trust: by which errors are multiplied: :data:`NOISE_DB` over the standard deviation of each, by default 1; 0 for those left
            out, shape ``(N,)``.
        censored: readings that only say that there was no more, shape ``(N,)`` bool; by default none.
        sight: share of line of sight in each before any measurement, where those of it alone, which hold no material, count for
            more, shape ``(N,)``; by default 0.
    """

    db: np.ndarray
    trust: np.ndarray = None  # type: ignore[assignment]  # these are made when they are not given
    censored: np.ndarray = None  # type: ignore[assignment]
    sight: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        for name, value in (("trust", 1.0), ("censored", False), ("sight", 0.0)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.broadcast_to(value, self.db.shape))

    def trusted(self, trust: np.ndarray | float) -> Target:
        """The same with errors multiplied by ``trust``, (N,) or one number."""
        return replace(self, trust=trust * self.trust)

    def gain(self, power: np.ndarray) -> float:
        """Under which predicted powers (N,) in units of the floor have the sum of what was read."""
        read, predicted = self.sums(power)
        return read / max(predicted, 1e-300)

    def sums(self, power: np.ndarray) -> tuple[float, float]:
        """All that was read, and what predicted powers (N,) have of it, in units of the floor."""
        known = self.trust > 0
        return float((known * np.expm1(self.db / NEPER)).sum()), float((known * power).sum())

    def error(self, power: np.ndarray) -> np.ndarray:
        """Error of predicted powers ``(..., N)`` in units of the floor, as it counts [dB]."""
        error = NEPER * np.log1p(power) - self.db
        return np.asarray(self.trust * np.where(self.censored, np.maximum(error, 0.0), error))

    def slope(self, power: np.ndarray) -> np.ndarray:
        """Derivative of :meth:`error` to the power ``(N,)``."""
        flat = self.censored & (NEPER * np.log1p(power) <= self.db)
        return np.asarray(self.trust * np.where(flat, 0.0, NEPER / (1.0 + power)))


@dataclass(frozen=True, eq=False)
class Observation:
    """What was read at a place, and how it comes from paths.

    Attributes:
        place: where.
        view: what is seen there.
        measured: how the N readings come from paths.
        target: what was read.
        floor: path gain that readings are in units of.
        chain: index of the measuring chain whose gain is unknown, -1 where it is known, or :data:`OWN_GAIN`.
        ratio: carrier of the readings over that of the fit's parameters.
        huber_db: larger errors count linearly in a fit [dB]: shadows that the geometry puts in the wrong place. More for
            readings that fade, whose decibels have a long tail of their own, and for totals, which may miss a mirror of
            metal.
        robust: whether single readings may be wrong, so that errors count so among places held out too.
        rows: which of the place's readings these are, shape ``(N,)``; None for all.
    """

    place: Place
    view: View = field(repr=False)
    measured: Measurement = field(repr=False)
    target: Target = field(repr=False)
    floor: float
    chain: int = -1
    ratio: float = 1.0
    huber_db: float = HUBER_DB
    robust: bool = True
    rows: np.ndarray | None = None
    _kept: Cache = field(init=False, repr=False, default_factory=lambda: Cache(3))

    def part(self, index: np.ndarray) -> Observation:
        """That of some of the readings."""
        return replace(self, measured=self.measured.part(index), target=self.target.take(index), rows=index)

    def losses(self, power: np.ndarray) -> np.ndarray:
        """Squared errors (N,) of predicted readings as they count [dB^2]."""
        error = self.target.error(power)
        return huber(error, self.huber_db)[0] if self.robust else error**2

    def gain(self, p: Parameters, power: np.ndarray) -> float:
        """Of the measuring chain, or of these readings, where ``power`` (N,) is predicted in units of the floor."""
        if self.chain == OWN_GAIN:
            return self.target.gain(power)
        return float(np.exp(p.log_gains[self.chain])) if self.chain >= 0 else 1.0

    def path_gains(self, model: Model) -> PathGains:
        """What the place gets under a model of groups at the fit's carrier."""
        return path_gains(self.view, model.at_ratio(self.ratio))

    def predicted(self, model: Model) -> np.ndarray:
        """Readings under such a model, residual and gains included, in units of the floor, shape ``(N,)``."""
        return self.of_gains(self.path_gains(model))

    def of_gains(self, gains: PathGains) -> np.ndarray:
        """The same of the path gains that its view gets."""
        power = np.maximum(read(gains, self.measured), 0.0) / self.floor
        return self.gain(gains.parameters, power) * power

    @cached_property
    def path(self) -> np.ndarray:
        """Readings of unit power on each path without scattering, in units of the floor, shape ``(L, N)``."""
        return self.measured.of_paths(self.view) / np.float32(self.floor)

    def single(self, materials: Materials) -> tuple[np.ndarray, np.ndarray]:
        """What groups scatter straight from the transmitter, in units of the floor: groups ``(A,)``, and readings at unit
        weight by lobe and Fresnel component, shape ``(A, L, 3, N)`` float32."""

        def components() -> tuple[np.ndarray, np.ndarray]:
            own, count = self.ray_bins
            (records,) = (t for name, t in self.view.traced(SETS["single"]).items() if name != SPECULAR)
            groups, sums = records.components(materials, Bins.of(own[records.ray], count))
            found = self.measured.of_bins(sums.reshape(count, -1), quick=True) / np.float32(self.floor)
            return groups, np.ascontiguousarray(found.T).reshape(*sums.shape[1:], found.shape[0])

        return self._kept.get((materials.parameters.lobes, materials.parameters.reciprocal), components)

    def further(self, effects: Effects, materials: Materials) -> tuple[np.ndarray, np.ndarray]:
        """What comes over more than one surface or through slabs, by the group that scatters it last or sends it on: groups
        ``(C,)``, and readings in units of the floor, shape ``(C, N)``."""
        key = tuple(sequences(effects)), effects.scatterings, materials.parameters.values
        return self._kept.get(key, lambda: self._further(effects, materials))

    def _further(self, effects: Effects, materials: Materials) -> tuple[np.ndarray, np.ndarray]:
        own, count = self.ray_bins
        surface = self.view.tracer.surface
        group, bins, power = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
        for name, records in self.view.traced(effects).items():
            if name in ("S", SPECULAR):
                continue
            group.append(records.rough_groups(surface.side_group))
            bins.append(own[records.ray])
            power.append(records.powers(materials))
        every, all_bins, all_groups = map(np.concatenate, (power, bins, group))
        k = np.flatnonzero((all_bins >= 0) & (every > 0))
        sends = np.bincount(all_groups[k], minlength=surface.groups) > 0
        found, column = np.flatnonzero(sends), np.cumsum(sends) - 1
        cell = all_bins[k] * len(found) + column[all_groups[k]]
        table = np.bincount(cell, every[k], minlength=count * len(found)).reshape(count, len(found))
        readings = self.measured.of_bins(table.astype(np.float32), quick=True).T
        return found, np.maximum(readings, 0.0) / np.float32(self.floor)

    @property
    def together(self) -> Superposition:
        """How paths without scattering add up by their phases.

        Raises:
            TypeError: where their powers add.
        """
        if self.measured.together is None:
            raise TypeError("measured: got readings of which powers add, expected some of which phases count")
        return self.measured.together

    def coherent_power(self, effects: Effects, materials: Materials) -> np.ndarray:
        """Readings of paths without scattering whose phases count, in units of the floor, shape ``(N,)``."""
        return self.together.received(self._amplitudes(effects, materials)[0]) / self.floor

    def coherent_slopes(
        self, effects: Effects, materials: Materials, place: np.ndarray, count: int
    ) -> np.ndarray:
        """Derivatives of :meth:`coherent_power` to ``count`` parameters ``(count, N)`` float32; those of material m stand from
        ``place[m]`` on."""
        specular, p = self.view.records[SPECULAR], materials.parameters
        amplitude, slope = self._amplitudes(effects, materials)
        rise = np.zeros((len(amplitude), count), np.float32)
        counts = self.view.counted_paths(effects)[:, None] & (specular.index >= 0)
        for path, mirror in zip(*np.nonzero(counts), strict=True):
            at = place[materials.material[specular.index[path, mirror]]] + len(p.lobes)
            rise[path, at + EXCESS_COLUMN] += slope[path, mirror]
            share = MIRRORED_COLUMN if specular.kind[path, mirror] == MIRROR else THROUGH_COLUMN
            rise[path, at + share] += 0.5 * amplitude[path]
        return np.asarray(rise.T @ (self.together.slopes(amplitude) / self.floor).astype(np.float32))

    def _amplitudes(self, effects: Effects, materials: Materials) -> tuple[np.ndarray, np.ndarray]:
        """Of paths without scattering, and their slopes, see :meth:`Records.fields`; 0 where one does not count."""
        specular, kept = self.view.records[SPECULAR], self.view.counted_paths(effects)
        amplitude, slope = specular.fields(materials, self.together.sent, self.together.heard)
        return amplitude * kept, slope * kept[:, None]

    @cached_property
    def ray_bins(self) -> tuple[np.ndarray, int]:
        """What the readings sum rays in: bin of each ray, -1 for none, and how many bins there are."""
        return self.measured.bins(self.view)


@dataclass(frozen=True, eq=False)
class Columns:
    """Readings of scattered light as sums over groups, or materials, in units of the floor.

    Fits and merging ask for powers so often that evaluating every record would take ten times as long. What comes over more
    than one surface or through slabs follows the share that the last one scatters of isotropic light; all else of it is frozen,
    what slabs let through included: that is learned from single paths.

    Attributes:
        groups: or materials, that scatter straight from the transmitter, shape ``(A,)``.
        single: their readings at unit weight, by lobe and Fresnel component, shape ``(A, L, 3, N)`` float32.
        senders: that scatter or send on light that came over other surfaces, shape ``(C,)``.
        further: what they bring per unit of ``Parameters.scattered_share``, shape ``(C, N)`` float32.
    """

    groups: np.ndarray
    single: np.ndarray
    senders: np.ndarray
    further: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Columns]) -> Columns:
        """Readings of several observations one after another."""
        groups = np.unique(np.concatenate([c.groups for c in parts]))
        senders = np.unique(np.concatenate([c.senders for c in parts]))
        ends = np.cumsum([0, *(c.single.shape[-1] for c in parts)])
        single = np.zeros((len(groups), *parts[0].single.shape[1:3], ends[-1]), np.float32)
        further = np.zeros((len(senders), ends[-1]), np.float32)
        for c, (first, last) in zip(parts, pairwise(ends), strict=True):
            single[np.searchsorted(groups, c.groups), ..., first:last] = c.single
            further[np.searchsorted(senders, c.senders), first:last] = c.further
        return cls(groups, single, senders, further)

    def by_materials(self, material: np.ndarray) -> Columns:
        """Those of materials; ``material`` (G,) is that of each group."""
        single = _summed(material[self.groups], self.single)
        return Columns(*single, *_summed(material[self.senders], self.further))

    def power(self, p: Parameters) -> np.ndarray:
        """Readings, shape ``(N,)``."""
        curves = fresnel_curves()
        coordinates = curves.at(curves.coordinates, p.log_excess[self.groups])[0]
        mixed = p.weight[self.groups][:, :, None] * coordinates[:, None]
        single = mixed.astype(np.float32).ravel() @ self.single.reshape(mixed.size, self.single.shape[-1])
        further = p.scattered_share[self.senders].astype(np.float32) @ self.further
        return np.asarray(np.maximum(single, 0.0) + further, float)

    def slopes(self, p: Parameters, layout: Layout, place: np.ndarray, count: int) -> np.ndarray:
        """Derivatives of the readings to ``count`` parameters ``(count, N)`` float32; those of material m stand from ``place[m]``
        on."""
        curves, excess = fresnel_curves(), layout.lobes + EXCESS_COLUMN
        found = np.zeros((count, self.single.shape[-1]), np.float32)
        alpha, rise = curves.at(curves.coordinates, p.log_excess)
        for g, columns in zip(self.groups, self.single, strict=True):
            row, weight = found[place[g] :], p.weight[g].astype(np.float32)
            value, slope = np.moveaxis(np.stack([alpha[g], rise[g]]).astype(np.float32) @ columns, 1, 0)
            row[: layout.lobes] += weight[:, None] * value
            row[excess] += weight @ slope
        even, steeper = curves.even(p.log_excess)
        for g, column in zip(self.senders, self.further, strict=True):
            row = found[place[g] :]
            row[: layout.lobes] += (p.weight[g] * even[g])[:, None] * column
            row[excess] += p.weight[g].sum() * steeper[g] * column
        return found


def columns_of(o: Observation, effects: Effects, p: Parameters) -> Columns:
    """Those of an observation's groups, as light comes to them under parameters ``p`` of groups at the fit's carrier."""
    p, count = p.at_ratio(o.ratio), len(o.target)
    materials = materials_of(o.view.tracer, p, effects)
    groups, single = np.zeros(0, int), np.zeros((0, len(p.lobes), 3, count), np.float32)
    if effects.scatterings:
        groups, single = o.single(materials)
    senders, further = o.further(effects, materials)
    share = np.maximum(p.scattered_share[senders], 1e-12)
    return Columns(groups, single, senders, (further / share[:, None]).astype(np.float32))


def _summed(owner: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (C, ...) summed by ``owner`` (C,): the owners, and the sum of each."""
    found, place = np.unique(owner, return_inverse=True)
    out = np.zeros((len(found), *columns.shape[1:]), np.float32)
    for a, k in enumerate(place.reshape(-1)):
        out[k] += columns[a]
    return found, out


@dataclass(eq=False)
class Kind(ABC):
    """How one kind of data set is taken apart.

    Attributes:
        number: index among the data sets.
        one: the data set.
    """

    number: int
    one: Any

    @abstractmethod
    def places(self) -> list[Place]:
        """Where anything was measured; warns of powers that nobody can have read."""

    @abstractmethod
    def observe(self, place: Place, view: View) -> Observation:
        """What was read at ``place``, where ``view`` is seen."""

    def frame(self) -> SpectrumDataset:
        """What a field's spectra are made with, if it is the first; its transmitter is the first of which anything was read."""
        one = self.one
        first = np.isfinite(one.power).reshape(len(one), -1).any(axis=1).argmax()
        source, carrier = one.transmitters[first], one.frequency_hz
        none = SpectrumDataset.empty(transmitter=source, frequency_hz=carrier, shape=READINGS_SHAPE)
        return replace(none, attributes={} if one.air is None else one.air.attributes)


@dataclass(eq=False)
class _Spectra(Kind):
    """Whole spectra: pixels through a beam."""

    one: SpectrumDataset

    def places(self) -> list[Place]:
        one = self.one
        question_spectra(one)
        return [
            Place(self.number, np.array([r]), one.transmitter, receiver, one.frequency_hz, one.shape, one.air, one.beam_sigma_rad)
            for r, receiver in enumerate(one.receivers)
            if np.isfinite(one.path_gain[r]).any()
        ]  # fmt: skip

    def observe(self, place: Place, view: View) -> Observation:
        one = self.one
        measured = SpectrumPixels(beam_operator(one.shape, one.beam_sigma_rad, str(view.tracer.grid.device)))
        gain = one.path_gain[place.rows[0]].ravel()
        known = np.isfinite(gain)
        above = to_db(np.where(known, gain, 0.0), one.floor) - 10.0 * np.log10(one.floor)
        target = Target(above, known)
        return Observation(place, view, measured, target, float(one.floor), robust=False)

    def frame(self) -> SpectrumDataset:
        return self.one


@dataclass(eq=False)
class _Tables(Kind):
    """Tables of readings: horns, power alone, taps of delay."""

    one: Readings
    _pointings: Cache = field(init=False, default_factory=lambda: Cache(1))

    def places(self) -> list[Place]:
        one = self.one
        question_readings(one)
        names, chain = np.unique(np.asarray(one.chain), return_inverse=True)
        key = np.column_stack([one.transmitters, one.receivers, chain])
        first, own, count = distinct_rows(key)
        every = np.split(np.argsort(own, kind="stable"), np.cumsum(count)[:-1])
        found = []
        for number in np.argsort(first):
            rows = every[number][np.isfinite(one.power[every[number]])]
            if len(rows):
                at = int(first[number])
                ends = one.transmitters[at], one.receivers[at]
                place = Place(self.number, rows, *ends, one.frequency_hz, READINGS_SHAPE, one.air)
                found.append(replace(place, chain=str(names[chain[at]])))
        return found

    def observe(self, place: Place, view: View) -> Observation:
        one, rows = self.one, place.rows
        floors = np.asarray(one.floor)[rows]
        floor = float(floors.min())
        step = None if one.bandwidth_hz is None else 1.0 / (TAP_STEPS * one.bandwidth_hz)
        weigh = partial(path_weights, one, rows, dtype=np.float32)
        known = self._pointings.get(view.tracer.grid.sub_pixels, lambda: _pointings(one, view))
        if known is not None:
            measured = WeighedPaths.turned(view, weigh, known[0], known[1][rows])
        else:
            told_apart = {"arrival": one.arrival is not None, "departure": one.departure is not None}
            measured = WeighedPaths.of(view, weigh, **told_apart, delay_step_s=step)
        bare = Observation(place, view, measured, Target(np.zeros(len(rows))), floor)
        sight, steady = _shares(bare)
        bias, fading = fading_db(one.samples, steady)
        clipped = np.maximum(one.power[rows], floors)  # what was read below the floor is noise
        above = NEPER * np.log1p(clipped / floor * 10.0 ** (-bias / 10.0))
        # Of all power errors of single directions average out.
        unexplained = 0.5 if one.total else READING_ERROR_DB
        trust = NOISE_DB / np.hypot(np.hypot(unexplained, np.asarray(one.std_db)[rows]), fading)
        target = Target(above, trust, one.power[rows] <= floors, None if one.total else sight)  # type: ignore[arg-type]
        wide_db = 10.0  # of what fades or is all power; see :class:`Observation`
        huber_db = HUBER_DB if one.samples is None and not one.total else wide_db
        return replace(bare, target=target, huber_db=huber_db)


@dataclass(eq=False)
class _Arrays(Kind):
    """Spectra of coherent arrays."""

    one: ArraySpectra

    def places(self) -> list[Place]:
        one = self.one
        return [
            Place(self.number, np.array([r]), *ends, one.frequency_hz, READINGS_SHAPE, one.air)
            for r, ends in enumerate(zip(one.transmitters, one.receivers, strict=True))
            if np.isfinite(one.power[r]).any()
        ]

    def observe(self, place: Place, view: View) -> Observation:
        """Evenly chosen directions, some times as many as the array can tell apart, each trusted the less the more of it is
        scattered: random phases give |c + n|^2, n complex Gaussian of power s, the variance s^2 + 2 s |c|^2."""
        one = self.one
        measured = ArrayImage.of(view, one.array, one.directions.reshape(-1, 3), one.length_std_m)
        power = one.power[place.rows[0]].ravel()
        known = np.flatnonzero(np.isfinite(power))
        most = 4 * measured.steered.shape[1]  # for each pair of elements that tells something of its own
        if len(known) > most:
            known = known[np.round(np.linspace(0, len(known) - 1, most)).astype(int)]
        unit = 1.0
        if one.relative:  # of a size that prediction's is comparable to
            unit = float(free_space_gain(place.transmitter, place.receiver, one.frequency_hz))
        target, chain = Target(NEPER * np.log1p(power[known] / one.floor)), OWN_GAIN if one.relative else -1
        bare = Observation(place, view, measured.part(known), target, unit * one.floor, chain)
        start, single = unmeasured(view), SETS["single"]
        scattered = columns_of(bare, single, start).power(start)
        total = scattered + bare.coherent_power(single, materials_of(view.tracer, start, single))
        gain = bare.gain(start, total)
        spread = np.sqrt(scattered * np.maximum(2.0 * total - scattered, 0.0))
        std_db = NEPER * gain * spread / (1.0 + gain * total)
        return replace(bare, target=target.trusted(NOISE_DB / np.hypot(NOISE_DB, std_db)))


KINDS: dict[type, type[Kind]] = {SpectrumDataset: _Spectra, Readings: _Tables, ArraySpectra: _Arrays}
"""How each kind of data set is taken apart."""


def kinds_of(data: Sequence[Measured]) -> list[Kind]:
    """What takes each of ``data`` apart."""
    return [
        next(make for kind, make in KINDS.items() if isinstance(one, kind))(k, one)
        for k, one in enumerate(data)
    ]


def observe(
    data: Sequence[Measured], seen: Sequence[Seen], frequency_hz: float, chains: Sequence[str]
) -> list[Observation]:
    """What was read at places.

    Args:
        data: all data sets.
        seen: places of these.
        frequency_hz: carrier that a fit's parameters are of.
        chains: names of all measuring chains of unknown gain.
    """
    kinds, index = kinds_of(data), {name: k for k, name in enumerate(chains)}
    found = []
    for place, view in seen:
        one = kinds[place.data].observe(place, view)
        chain = index.get(place.chain, one.chain)
        found.append(replace(one, chain=chain, ratio=float(place.frequency_hz / frequency_hz)))
    return found


def unmeasured(view: View) -> Parameters:
    """What the groups that are seen are taken for before any measurement, with what slabs of them absorb there."""
    surface = view.tracer.surface
    log_through = surface.slab_properties(view.tracer.frequency_hz)[2]
    return replace(Parameters.prior(surface.groups), log_through=log_through)


def _shares(o: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Of each reading before any measurement: the share of line of sight, and the sum of the squared shares of line of sight
    and mirror paths, shape ``(N,)`` each."""
    surface = o.view.tracer.surface
    none = np.zeros((2, len(surface.cells)))
    model = Model(SETS["single"], unmeasured(o.view), none, o.place.transmitter)
    materials = materials_of(o.view.tracer, model.parameters, model.effects)
    single = o.view.records[SPECULAR].powers(materials)[:, None] * o.path
    share = single / np.maximum(o.predicted(model), np.maximum(single.sum(axis=0), 1e-300))
    return share[o.view.paths.in_sight].sum(axis=0), (share**2).sum(axis=0)


def _pointings(one: Readings, view: View) -> tuple[np.ndarray, np.ndarray] | None:
    """What each pointing of a receiving antenna reads of unit power in each pixel, shape ``(D, P)`` float32, and which one
    each reading is, shape ``(N,)``; None where arrival is not all that counts."""
    if one.arrival is None or one.departure is not None or one.delay_s is not None:
        return None
    first, row, _ = distinct_rows(one.arrival)
    toward = pixel_means(view.tracer.grid)
    return path_weights(one, first, toward, toward, np.zeros(len(toward)), dtype=np.float32), row


def frame_of(data: Sequence[Measured]) -> SpectrumDataset:
    """What a field's spectra are made with, and its transmitter: the first data set of spectra, else an empty one that is like
    the first of readings."""
    return min(kinds_of(data), key=lambda kind: not isinstance(kind, _Spectra)).frame()


def places_of(data: Sequence[Measured], mesh: Mesh | None, device: DeviceLike) -> list[Place]:
    """The places of data sets, in their order.

    Raises:
        ValueError: for a place where no field can hold; see :func:`warprrf.rf.positions.check_positions`.
    """
    found = []
    for kind in kinds_of(data):
        found += kind.places()
        check_dataset(mesh, kind.one, device=device)
    return found
