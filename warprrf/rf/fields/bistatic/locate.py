"""Where a receiver is, by what it read: a field asked backwards.

First everywhere: what was read is compared with what the field gives on a lattice (:mod:`warprrf.rf.fields.bistatic.field_map`).
From the best places on by Gauss-Newton steps (Levenberg 1944, Marquardt 1963): slopes are differences of answers traced anew some
centimetres away, because much of them are edges of shadows, which no derivative at fixed visibility knows.

Errors count in units of their standard deviation: those of readings as in a fit, those of a spectrum's pixels as the field
states them (:mod:`warprrf.rf.fields.bistatic.uncertainty`); large ones count linearly (Huber 1964).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter
from threadpoolctl import threadpool_limits

from warprrf.device import Progress
from warprrf.rf.em.absorption import Air
from warprrf.rf.em.waves import NEPER, SPEED_OF_LIGHT, check_carrier
from warprrf.rf.fields.base import Location, Measured
from warprrf.rf.fields.bistatic.field_map import SPACING_M, FieldMap, best_on_map, coarse, maps_of
from warprrf.rf.fields.bistatic.observations import NOISE_DB, Place, as_list, huber, kinds_of, places_of
from warprrf.rf.fields.bistatic.placing import from_zero
from warprrf.rf.fields.bistatic.uncertainty import bins
from warprrf.rf.positions import beside, quotients
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings
from warprrf.rf.spectra.spectrum import Spectrum, pixel_solid_angles
from warprrf.rf.tracing.render import PathGains, path_gains
from warprrf.rf.tracing.tracer import Tracer
from warprrf.rows import sums_of


def as_data(field: Any, measured: Any) -> list[Measured]:
    """``measured`` as data sets of one place that nobody knows: receivers stand a metre beside their transmitters.

    Raises:
        TypeError, ValueError: naming ``measured``.
    """
    if isinstance(measured, Spectrum):
        if measured.batched:
            raise ValueError(
                f"measured: got {len(measured.path_gain)} spectra, expected that of one receiver"
            )
        told, names = measured.attributes, ("transmitter", "frequency_hz", "beam_sigma_rad")
        own, air = {n: told.get(n, getattr(field, n)) for n in names}, Air.from_attributes(told)
        measured = SpectrumDataset.from_spectra(
            receivers=own["transmitter"][None] + 1.0, path_gain=measured.path_gain[None],
            floor=measured.floor or field.floor, attributes=None if air is None else air.attributes, **own,
        )  # fmt: skip
    found = []
    for one in as_list(measured, "measured"):
        check_carrier("measured", one.frequency_hz, field.frequency_hz)
        if isinstance(one, Readings):
            if not one.azimuth_known and (one.departure is not None or one.delay_s is not None):
                raise ValueError(
                    "measured: got azimuths of an unknown zero beside departures or delays, expected one without the other"
                )
        count = len(np.unique(one.receivers, axis=0)) if isinstance(one, Readings) else len(one)
        if count != 1:
            raise ValueError(
                f"measured: got {type(one).__name__} of {count} receivers, expected that of one: .subset([k])"
            )
        if isinstance(one, SpectrumDataset) and np.isnan(one.path_gain).all():
            raise ValueError("measured: got a spectrum of NaN alone, expected pixels that were measured")
        sources = one.transmitter[None] if isinstance(one, SpectrumDataset) else one.transmitters
        found.append(replace(one, receivers=sources + [1.0, 0.0, 0.0]))
    return found


@dataclass(frozen=True, eq=False)
class Found:
    """Unknowns (U,) and what they leave: errors in standard deviations ``(N,)`` and their slopes ``(N, U)``, which were taken at
    the unknowns ``sloped`` over ``step_m``."""

    unknown: np.ndarray
    error: np.ndarray
    rise: np.ndarray
    sloped: np.ndarray
    step_m: float

    @property
    def threshold(self) -> float:
        """Errors above it, of one standard deviation at least, count linearly. It goes with all of them: far from the place most
        are large, and all slopes count."""
        return max(1.0, float(np.sqrt(np.mean(self.error**2))))

    def loss(self, threshold: float) -> float:
        """Sum of squares, those above ``threshold`` counted linearly."""
        return float(huber(self.error, threshold)[0].sum())

    def normal(self, threshold: float) -> tuple[np.ndarray, np.ndarray]:
        """Curvature ``(U, U)`` and gradient ``(U,)`` of half the loss."""
        weighed = self.rise * huber(self.error, threshold)[1][:, None]
        return weighed.T @ self.rise, weighed.T @ self.error

    def near(self, others: Sequence[Found]) -> bool:
        """Whether it is the same place as one of ``others``, to a decimetre."""
        same_m = 0.1
        return any(np.linalg.norm(self.unknown[:3] - other.unknown[:3]) < same_m for other in others)


class Question:
    """What was read at one place, which is sought in a field.

    Unknowns are its position [m], the zero of each table that does not know it, of azimuths [rad] or of a clock [m], and ln of
    each measuring chain's gain.

    Args:
        field: a bistatic field.
        data: see :func:`as_data`.
    """

    def __init__(self, field: Any, data: Sequence[Measured]) -> None:
        self.field, self.data = field, data
        self.coarse = [coarse(one) for one in data]
        self.places = places_of(data, None, field.device)
        self.coarse_places = places_of(self.coarse, None, field.device)
        self.transmitters = list(np.unique([place.transmitter for place in self.places], axis=0))
        self.chains = sorted({place.chain for place in self.places} - {""})
        self.turned = [k for k, one in enumerate(data) if isinstance(one, Readings) and not one.zero_known]
        self.spectra = all(isinstance(one, SpectrumDataset) for one in data)
        self.weights = [self._weight(one) for one in data]
        self._tracers: dict[Any, Tracer] = {}

    @property
    def alike(self) -> bool:
        """Whether what is searched quickly is what is searched to the end."""
        return all(a is b for a, b in zip(self.coarse, self.data, strict=True))

    @property
    def narrow(self) -> bool:
        """Whether delays are read more finely than places of the lattice lie apart: the right valley of errors may hold none."""
        widths = [getattr(one, "bandwidth_hz", None) for one in self.data]
        return any(width and SPEED_OF_LIGHT / width < SPACING_M for width in widths)

    def _weight(self, one: Measured) -> np.ndarray | None:
        """By what errors of a spectrum's pixels are multiplied before they count as those of readings do: where rows crowd
        at the poles, many pixels have one error, so that squares count by solid angle."""
        if not isinstance(one, SpectrumDataset):
            return None
        db = NEPER * np.log1p(np.nan_to_num(one.path_gain[0].astype(float)) / one.floor)
        known, area = self.field.errors, pixel_solid_angles(db.shape)[:, None]
        # Where an edge stands some centimetres off, pixels that are known to tenths are wrong by ten decibels.
        least_db = 2.0
        std = np.maximum(known.table[bins(db)], least_db) if known else np.full(db.shape, NOISE_DB)
        return np.asarray(NOISE_DB / std * np.sqrt(area / area.mean())).ravel()

    def starts(self, maps: dict[bytes, FieldMap]) -> np.ndarray:
        """Unknowns at the places of a lattice that suit best and lie apart, shape ``(S, U)``."""
        most = 2  # in a lobby the best one is within the spacing of the truth
        places = next(iter(maps.values())).places
        cost, gains, turn = np.zeros(len(places)), np.zeros((len(places), len(self.chains))), []
        for k, one in enumerate(self.coarse):
            least, own, gain = best_on_map(one, maps, self.chains)
            cost, gains = cost + least, gains + gain
            turn += [own] if k in self.turned else []
        turns = np.stack(turn, axis=1) if turn else gains[:, :0]
        every, chosen = np.concatenate([places, turns, gains / NEPER], axis=1), list[int]()
        for p in np.argsort(cost, kind="stable"):
            if all(np.linalg.norm(places[p] - places[q]) > 1.2 * SPACING_M for q in chosen):
                chosen.append(int(p))
            if len(chosen) == most:
                break
        return every[chosen]

    def moved(self, unknown: np.ndarray, *, quick: bool) -> list[Measured]:
        """The data with zeros put right."""
        found: list[Any] = list(self.coarse if quick else self.data)
        for k, by in zip(self.turned, unknown[3:], strict=False):
            found[k] = from_zero(found[k], by)
        return found

    def errors(self, unknown: np.ndarray, step_m: float, *, quick: bool, near: Found | None = None) -> Found:
        """What ``unknown`` (U,) leaves; slopes by position are differences over ``step_m`` to either side, or those that were
        found ``near``. ``quick``: with few rays and single mirrors."""
        here = unknown[None, :3]
        points = np.concatenate([here, beside(here[0], step_m)]) if near is None else here
        kinds, further, seen = kinds_of(self.moved(unknown, quick=quick)), {}, dict[Any, Any]()
        turn_rad, clock_m = 0.005, 0.01  # differences of the zeros of azimuths and of clocks
        smooth = 3  # pixels that a spectrum's slopes are means over: their noise would pass for curvature
        for j, k in enumerate(self.turned):
            by = clock_m if self.data[k].azimuth_known else turn_rad  # type: ignore[union-attr]
            other = unknown + by * (np.arange(len(unknown)) == 3 + j)
            further[k] = 3 + j, by, kinds_of(self.moved(other, quick=quick))[k]
        errors, rises = [], []
        for place in self.coarse_places if quick else self.places:
            key = place.transmitter.tobytes(), place.shape, place.beam_sigma_rad
            if key not in seen:
                seen[key] = self._gains(place, points, quick)
            gains = seen[key]
            chain = 3 + len(self.turned) + self.chains.index(place.chain) if place.chain else None
            times = 1.0 if chain is None else float(np.exp(unknown[chain]))
            column, by, turned = further.get(place.data, (0, 1.0, None))
            asked = [(kinds[place.data], *one) for one in zip(points, gains, strict=True)]
            asked += [] if turned is None else [(turned, points[0], gains[0])]
            observed = [kind.observe(replace(place, receiver=point), g.view) for kind, point, g in asked]
            powers = [times * o.of_gains(g) for o, (*_, g) in zip(observed, asked, strict=True)]
            target, weight = observed[0].target, self.weights[place.data]
            target = target if weight is None else target.trusted(weight)
            error, *others = (target.error(power) / NOISE_DB for power in powers)
            rise = np.zeros((len(error), len(unknown)))
            # Of both sides: the noise of one alone would hang together with that of the errors, and pull the place aside.
            if near is None:
                rise[:, :3] = quotients(others[:6], step_m)
            if turned is not None:
                rise[:, column] = (others[-1] - error) / by
            if chain is not None:
                rise[:, chain] = target.slope(powers[0]) * powers[0] / NOISE_DB
            if weight is not None:
                image, ends = rise.reshape(*place.shape, -1), ("nearest", "wrap", "nearest")
                rise = uniform_filter(image, (smooth, smooth, 1), mode=ends).reshape(rise.shape)
            errors.append(error)
            rises.append(rise)
        rise = np.concatenate(rises)
        if near is not None:
            rise[:, :3] = near.rise[:, :3]
        at = (unknown, step_m) if near is None else (near.sloped, near.step_m)
        return Found(unknown, np.concatenate(errors), rise, *at)

    def _gains(self, place: Place, points: np.ndarray, quick: bool) -> list[PathGains]:
        """What is received at each of ``points`` under a place's transmitter, all traced at once."""
        f = self.field
        tracer, model = f.tracer(place.transmitter), f.state
        if quick:
            model = replace(model, effects=replace(model.effects, mirrors=min(model.effects.mirrors, 1)))
        sub_pixels = 1 if quick else 2  # to the end, because the noise of few rays moves the least loss
        few = self._tracers.setdefault((place.view_key, quick), tracer.on_grid(place.shape, sub_pixels))
        return path_gains(few.view(points, model.effects), model).apart

    def descend(
        self, unknown: np.ndarray, *, quick: bool, near: Found | None = None, most: float = np.inf
    ) -> Found:
        """From ``unknown`` (U,) to where errors are least; given up where after a step they leave more than ``most``. Slopes
        are at first those that were found ``near``, and hold as far about their place as they were taken over."""
        # Half of the last step. Over shorter differences the noise of few rays looks like slopes.
        least_difference_m, longest_m, shortest_m = 0.04, 0.35, 3e-3 * (3.0 if quick else 1.0)
        # A Gauss-Newton step goes about half the way where most errors count linearly; twice would be the most.
        longer, steps = 1.6, 4 if quick else 3
        damping, difference = 1e-3, 0.1 if quick else 2.0 * least_difference_m
        now = self.errors(unknown, difference, quick=quick, near=near)
        for _ in range(steps):
            threshold = now.threshold
            curvature, gradient = now.normal(threshold)
            diagonal = np.diag(curvature) + max(1e-9 * np.trace(curvature), 1e-100)  # in the dark all are 0
            step = -longer * np.linalg.solve(curvature + damping * np.diag(diagonal), gradient)
            step *= min(1.0, longest_m / max(float(np.linalg.norm(step[:3])), 1e-12))
            while not self.field.mesh.visible(now.unknown[None, :3], (now.unknown + 1.1 * step)[None, :3])[0]:
                step *= 0.5  # not through walls
            length = float(np.linalg.norm(step[:3]))
            difference = float(np.clip(0.5 * length, least_difference_m, difference))
            holds = np.linalg.norm((now.unknown + step - now.sloped)[:3]) < now.step_m
            other = self.errors(now.unknown + step, difference, quick=quick, near=now if holds else None)
            better = other.loss(threshold) < now.loss(threshold)
            now, damping = (other, 0.2 * damping) if better else (now, max(1.0, 4.0 * damping))
            if length < shortest_m or now.loss(threshold) > most:
                break
        return now

    def covariance(self, best: Found, threshold: float) -> np.ndarray:
        """Of the position's error [m^2], shape ``(3, 3)``, by what errors turn out to be; infinite where they leave a way open."""
        curvature = best.normal(threshold)[0]
        told, along = np.linalg.eigh(curvature)
        if np.abs(along[:3, told <= 1e-12 * told.max()]).max(initial=0.0) > 1e-6:
            return np.diag(np.full(3, np.inf))
        inverse, count = np.linalg.pinv(curvature), len(best.error)
        if not self.spectra:
            return inverse[:3, :3] * max(1.0, best.loss(threshold) / max(count - len(curvature), 1))
        # Blocks of pixels are independent (Liang and Zeger 1986): what one edge in the wrong place spoils hangs together.
        shape, blocks = self.places[0].shape, 12  # along each axis
        # Not all that hangs together: half of the squared errors of 20 receivers of a lobby, none of them fitted to or
        # tested, were 4 times what blocks say.
        spread = 4.0
        row, column = np.indices(shape) * blocks // np.array(shape)[:, None, None]
        block = np.resize(blocks * row + column, count)
        score = best.rise * (huber(best.error, threshold)[1] * best.error)[:, None]
        sums = sums_of(score, block)
        return np.asarray(spread * inverse @ (sums.T @ sums) @ inverse)[:3, :3]


def locate(
    field: Any, measured: Any, store: str | os.PathLike[str] | None, progress: Progress | None
) -> Location:
    """See :meth:`RadioField.locate`; ``field`` is a bistatic one."""
    data = as_data(field, measured)
    air = {one.air for one in data} - {None}
    if len(air) > 1:
        raise ValueError(f"measured: got the absorption of {len(air)} kinds of air, expected one")
    question = Question(field if air <= {field.air} else field.with_gas(*air), data)
    of, sources = question.field, question.transmitters
    key = of.air, np.stack(sources).tobytes()
    maps = field._maps.get(key, lambda: maps_of(of, sources, store, progress))
    with threadpool_limits(1, user_api="blas"):  # matrices are small
        return search(question, maps)


def search(question: Question, maps: dict[bytes, FieldMap]) -> Location:
    """From the lattice's best places to the candidates, and what is known of the likeliest."""
    given_up, followed = 2.0, 1.4  # times the least loss: beyond, others are left, or not followed
    first, most = list[Found](), np.inf
    for start in question.starts(maps):
        first.append(question.descend(start, quick=True, most=most))
        most = min(most, given_up * first[-1].loss(first[-1].threshold))
    threshold = min(one.threshold for one in first)
    first.sort(key=lambda one: one.loss(threshold))
    least, found, rest = first[0].loss(threshold), list[Found](), list[Found]()
    for one in first:
        if one.loss(threshold) > followed * least:
            rest.append(one)
        elif not one.near(first[: first.index(one)]):
            found.append(question.descend(one.unknown, quick=False, near=one if question.alike else None))
    best = min(found, key=lambda one: one.loss(threshold))
    ahead = {id(one): least - best.loss(threshold) for one in rest}  # what all effects would bring them too
    spread = best.loss(threshold) / max(len(best.error) - len(best.unknown), 1)
    spectra = [one for one in question.data if isinstance(one, SpectrumDataset)]
    pixels = max([1.0, *(one.beam_sigma_rad**2 * one.path_gain.size for one in spectra)])
    loss = {id(one): one.loss(threshold) - ahead.get(id(one), 0.0) for one in found + rest}
    order = sorted(found + rest, key=lambda one: loss[id(one)])
    order = [one for k, one in enumerate(order) if not one.near(order[:k])]
    unit = pixels * max(spread, 1.0)  # pixels within a beam have one error
    likelihood = np.exp([-0.5 * (loss[id(one)] - loss[id(best)]) / unit for one in order])
    likelihood /= likelihood.sum()
    covariance, misfit = question.covariance(best, threshold), float(np.sqrt(spread))
    sure, explained = bool(likelihood[0] > 0.95), misfit < 4.0
    close = float(np.sqrt(np.trace(covariance))) < SPACING_M
    heard = len(spectra) < len(question.data) or any((d.path_gain > d.floor).any() for d in spectra)
    after: list[Any] = [question.data[k] for k in question.turned]
    zeros = list(zip(after, best.unknown[3:].tolist(), strict=False))
    gains = (NEPER * best.unknown[3 + len(question.turned) :]).tolist()
    return Location(
        position=best.unknown[:3], covariance=covariance, candidates=np.stack([one.unknown[:3] for one in order]),
        likelihoods=likelihood, misfit=misfit,
        known=sure and close and explained and heard and not question.narrow,
        gains_db=dict(zip(question.chains, gains, strict=True)),
        azimuth_zeros={one.name: by for one, by in zeros if not one.azimuth_known},
        clock_offsets_s={one.name: by / SPEED_OF_LIGHT for one, by in zeros if one.azimuth_known},
    )  # fmt: skip
