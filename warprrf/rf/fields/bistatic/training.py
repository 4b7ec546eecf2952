"""What a fit learns from: what receivers see of the geometry (:func:`trace`), what was read there, and which places decide about
effects and materials or are held out. A :class:`Training` fits and judges models by them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from warprrf.cache import cached_property
from warprrf.cluster import each
from warprrf.device import DeviceLike, Progress, resolve
from warprrf.rf.channel.array_spectra import ArraySpectra
from warprrf.rf.fields.base import Measured
from warprrf.rf.fields.bistatic.gauss_newton import (
    KNOWN_THROUGH_STD,
    THROUGH_STD,
    Problem,
    Solution,
    gauss_newton,
)
from warprrf.rf.fields.bistatic.measured import WeighedPaths
from warprrf.rf.fields.bistatic.observations import (
    NOISE_DB,
    READING_ERROR_DB,
    Observation,
    Place,
    Seen,
    frame_of,
    observe,
)
from warprrf.rf.fields.bistatic.options import SUB_PIXELS, FitOptions, evenly, needed
from warprrf.rf.spectra.readings import Readings
from warprrf.rf.tracing.model import SETS, Effects, Model, Parameters, with_slabs_and_edges
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Tracer, View, view_of

HELD_OUT, LEAST_RECEIVERS = 0.25, 4
"""Share of receivers that are held out, and of how many at least."""
FEW_RECEIVERS = 20
"""Receivers up to which errors are learned from every one, held out in turn."""
MOST_TO_CHOOSE = 24
"""Receivers that fits which only decide about something learn from."""
MERGES = 3  # rounds of deciding what is of one material, and fitting
MOST_READINGS = 20_000
"""More do not tell the few parameters of materials better: they are those of some of the receivers."""
MOST_RAYS = 500_000_000
"""Spectra with more rays than this are refused: what rays meet is kept during a fit."""
MOST_KEPT = 15_000_000
"""Rays up to which records of them are kept, some 200 bytes for each; of more they are traced whenever they are asked for."""


def trace(
    surface: Surface,
    places: Sequence[Place],
    *,
    effects: Effects | None = None,
    slabs_and_edges: Effects | None = None,
    keeps: bool = True,
    sub_pixels: int = SUB_PIXELS,
    client: Any = None,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> tuple[list[Seen], Effects]:
    """What is seen of a surface at ``places``, whatever the materials, for all steps of a fit; and the effects whose mirrors, slabs
    and edges were sought.

    Args:
        effects: whose mirrors are sought and whose tables are traced at once (others when they are first asked for); None for
            single bounces, and for as many mirrors up to 3 as can be searched (2 in a city).
        slabs_and_edges: whose are sought; None for what the scene needs (:func:`needed`).
        keeps: whether records are kept, if they are not too many; else they are traced whenever they are asked for.
        sub_pixels: square root of the rays per pixel.
        client: a ``dask.distributed.Client`` whose workers trace, to the same bits; this process by default.
        device: where rays are cast.
        progress: called with the stages ``"mirrors"`` and ``"transport"``.

    Raises:
        ValueError: for more chains of mirrors than :data:`~warprrf.rf.paths.images.MOST_CHAINS`.
    """
    tell = progress or (lambda *_: None)
    wanted = replace(SETS["single"], mirrors=3) if effects is None else effects
    decided = needed(wanted, surface, places, device) if slabs_and_edges is None else slabs_and_edges
    wanted = with_slabs_and_edges(wanted, decided)
    keeps = keeps and rays_of(places, sub_pixels) <= MOST_KEPT
    together: dict[tuple[object, ...], list[int]] = {}  # places under one transmitter
    for k, place in enumerate(places):
        together.setdefault(place.tracer_key, []).append(k)
    views: dict[int, View] = {}
    for own in together.values():
        first = places[own[0]]
        make = partial(
            Tracer.of, surface, first.transmitter, first.frequency_hz, first.shape, sub_pixels,
            air=first.air, device=str(resolve(device)),
        )  # fmt: skip
        tracer = make()
        receivers = np.stack([places[k].receiver for k in own])
        if effects is None:
            wanted = replace(wanted, mirrors=tracer.images.affordable(receivers, wanted.mirrors))
        found = tracer.paths(receivers, wanted, progress)
        parts = [(receiver, found.of(np.array([r]))) for r, receiver in enumerate(receivers)]
        for r, view in each(partial(view_of, make, wanted, keeps), parts, client):
            views[own[r]] = tracer.adopted(view)
            tell("transport", len(views), len(places))
    return [(place, views[k]) for k, place in enumerate(places)], wanted


def rays_of(places: Sequence[Place], sub_pixels: int) -> int:
    """All rays of receivers."""
    return sum(place.shape[0] * place.shape[1] for place in places) * sub_pixels**2


def check_rays(places: Sequence[Place], sub_pixels: int) -> None:
    """Refuse places whose rays would not fit into memory.

    Raises:
        ValueError: for more than :data:`MOST_RAYS`.
    """
    rays, ray_bytes = rays_of(places, sub_pixels), 40  # that are kept of each
    if rays > MOST_RAYS:
        raise ValueError(
            f"ds: {len(places)} spectra of {places[0].shape[0]} x {places[0].shape[1]} pixels take {rays:.2g} rays, "
            f"{rays * ray_bytes / 1e9:.0f} GB and more, expected at most {MOST_RAYS:.2g}: give fewer receivers (ds.split, "
            "ds.subset) or sub_pixels=1"
        )


@dataclass(frozen=True, eq=False)
class Training:
    """One fit: what it learns from, and how.

    Attributes:
        options: of the fit.
        surface: of the geometry.
        data: the data sets.
        places: all of theirs.
        held: of these, by index, the ones that are held out to decide by.
        candidates: effects to choose from, the fewest first.
        rng: chooses readings.
        tick: to be called after each fit.
        observations: by place, of those that were traced.
        parts: those readings of each that parameters are fitted to.
        log: choices, as they are made.
    """

    options: FitOptions
    surface: Surface
    data: Sequence[Measured]
    places: Sequence[Place]
    held: np.ndarray
    candidates: list[Effects]
    rng: np.random.Generator
    tick: Callable[..., None]
    observations: dict[int, Observation] = field(default_factory=dict)
    parts: dict[int, Observation] = field(default_factory=dict)
    log: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        surface: Surface,
        data: Sequence[Measured],
        places: Sequence[Place],
        options: FitOptions,
        progress: Progress | None = None,
    ) -> Training:
        """That of a fit to what ``data`` holds of ``places``, of which nothing was traced yet. A quick one holds none out."""
        count, rng = len(places), np.random.default_rng(options.seed)
        candidates, none = options.candidates(frame_of(data).frequency_hz), np.zeros(0, int)
        steps = 4 + len(candidates) + MERGES + (2 * count if count <= FEW_RECEIVERS else 3)
        step = _counted(progress, count, steps)
        found = cls(options, surface, data, places, none, candidates, rng, step)
        if count < LEAST_RECEIVERS or options.quick:
            return found
        order, most = rng.permutation(count), 30
        held = order[~np.isin(order, found.always)][: min(int(count * HELD_OUT), most)]
        return replace(found, held=np.sort(held))

    @cached_property
    def frequency_hz(self) -> float:
        """Carrier that parameters are of."""
        return frame_of(self.data).frequency_hz

    @cached_property
    def chains(self) -> list[str]:
        """Names of measuring chains whose gain is unknown."""
        return sorted({place.chain for place in self.places} - {""})

    @property
    def always(self) -> list[int]:
        """Places that are never held out, one of each chain: without any its gain would not be known."""
        chain = [place.chain for place in self.places]
        return [chain.index(name) for name in self.chains]

    @property
    def not_held(self) -> np.ndarray:
        """Places that are not held out."""
        return np.setdiff1d(np.arange(len(self.places)), self.held)

    def few(self, times: int) -> np.ndarray:
        """Places that trial fits learn from, up to ``times`` :data:`MOST_TO_CHOOSE`, those of every chain among them; the fewer are
        some of the more, whose paths are traced."""
        chosen = np.setdiff1d(self.not_held, self.always)
        for most in (2, times):
            chosen = evenly(chosen, max(most * MOST_TO_CHOOSE - len(self.always), 0))
        return np.union1d(self.always, chosen).astype(int)

    @property
    def deciding(self) -> np.ndarray:
        """Places by which effects and materials are decided: with few receivers all of them."""
        enough = 4  # places held out, to decide by
        if len(self.held) < enough:
            return np.arange(len(self.places))
        return np.union1d(self.few(2), self.held)

    def and_at(self, places: np.ndarray, seen: Sequence[Seen]) -> Training:
        """With what was read at ``places`` (P,), where that is ``seen``, and readings of them that parameters are fitted to."""
        observed = observe(self.data, seen, self.frequency_hz, self.chains)
        found = self.observations | dict(zip(places.tolist(), observed, strict=True))
        parts = self.parts | {k: self._part(found[k]) for k in places.tolist()}
        return replace(self, observations=dict(sorted(found.items())), parts=dict(sorted(parts.items())))

    def _part(self, o: Observation) -> Observation:
        """Readings of a place that parameters are fitted to, and what they count."""
        readings, least = 12_000, 200  # of all places, and of each at least
        # Line of sight alone holds no material: it tells a chain's gain. Its noise is as large as any reading's.
        known_better = 2.0
        # Of what comes through slabs more is left out (light between surfaces that passes them on its way), and what a
        # material must make up for there it lacks in the open.
        behind_walls = 0.5
        known = np.flatnonzero(o.target.trust)
        size = min(len(known), max(least, readings // len(self.places)))
        part = o.part(known[np.sort(self.rng.choice(len(known), size, replace=False))])
        explained = 1.0 - (1.0 + known_better * part.target.sight) ** -2
        share = (READING_ERROR_DB / NOISE_DB * part.target.trust) ** 2  # of its variance that is no noise
        target = part.target.trusted(1.0 / np.sqrt(1.0 - share * explained))
        straight = o.view.paths.order == 0
        if not self.totals and (straight & (o.view.paths.slabs > 0)).any():
            target = target.trusted(behind_walls)
        return replace(part, target=target)

    def as_sought(self, effects: Effects) -> Training:
        """The same that chooses from slabs and edges as they were sought for ``effects``, and no more mirrors; of power alone
        from one candidate."""
        every = (with_slabs_and_edges(one, effects) for one in self.candidates)
        found = [replace(one, mirrors=min(one.mirrors, effects.mirrors)) for one in every]
        if len(found) > 1 and any(isinstance(one, ArraySpectra) for one in self.data):
            found = [replace(one, mirrors=effects.mirrors) for one in found]  # they hear the phases of all
        return replace(self, candidates=found[1:2] if len(found) > 1 and self.totals else found)

    def without_records(self) -> Training:
        """The same that keeps none of the records that are made again when they are asked for."""
        observations, parts = (
            {k: replace(o, view=o.view.without_records()) for k, o in own.items()}
            for own in (self.observations, self.parts)
        )
        return replace(self, observations=observations, parts=parts)

    @property
    def telling(self) -> np.ndarray:
        """Places whose readings parameters of materials are fitted to, those of every chain among them."""
        readings, places = sum(len(o.target) for o in self.parts.values()), np.array(list(self.parts))
        if readings <= MOST_READINGS:
            return places
        return np.union1d(self.always, evenly(places, len(places) * MOST_READINGS // readings)).astype(int)

    @property
    def names(self) -> list[str]:
        """Of the data sets."""
        return [getattr(one, "name", "") for one in self.data]

    @cached_property
    def totals(self) -> bool:
        """Whether power alone was read, which cannot tell bounces or materials apart."""
        return all(isinstance(one, Readings) and one.total for one in self.data)

    @property
    def area(self) -> np.ndarray:
        """Of each group [m^2]."""
        s = self.surface
        return np.bincount(s.group, s.mesh.areas, minlength=s.groups)

    @property
    def transmitter(self) -> np.ndarray:
        """Under which gains of light sent on are learned: the field's own, if all was read under that, else none."""
        own = frame_of(self.data).transmitter
        alone = all(np.array_equal(o.place.transmitter, own) for o in self.observations.values())
        return own if alone else np.full(3, np.nan)

    def start(self, material: np.ndarray) -> Parameters:
        """Parameters of materials before any measurement."""
        lobes = self.options.exponents(self.frequency_hz)
        prior = Parameters.prior(int(material.max()) + 1, lobes, reciprocal=self.options.reciprocal)
        return replace(prior, log_through=self.known_through(material)[0])

    def known_through(self, material: np.ndarray) -> np.ndarray:
        """ln of the share that materials let through before any measurement, and its standard deviation, shape ``(2, M)``."""
        eta, _, through = self.surface.slab_properties(self.frequency_hz)
        std = np.where(np.abs(eta) > 0, KNOWN_THROUGH_STD, THROUGH_STD)
        return np.stack([np.bincount(material, own) for own in (through, std)]) / np.bincount(material)

    def problem(
        self, effects: Effects, material: np.ndarray, places: Iterable[int], p: Parameters
    ) -> Problem:
        """What is fitted to readings of ``places``; what lights second and later scatterers is as under parameters ``p``."""
        return Problem.of(
            [self.parts[k] for k in places], effects, material, p, chains=len(self.chains),
            gain_offset=self.options.gain_offset, known_through=self.known_through(material),
            **({"energy_std": 1.0} if self.totals else {}),
        )  # fmt: skip

    def model(self, choice: Solution) -> Model:
        """That of groups, without a residual yet."""
        effects = replace(choice.effects, residual=False)
        none = np.zeros((2, len(self.surface.cells)))
        return Model(effects, choice.parameters.take(choice.material), none, self.transmitter)

    def refined(self, choice: Solution, places: Iterable[int], steps: int, rounds: int = 1) -> Solution:
        """``choice`` with parameters fitted to readings of ``places``; what surfaces get of each other is computed anew in
        each of ``rounds``."""
        rounds, places = rounds if choice.effects.scatterings > 1 else 1, list(places)
        for _ in range(rounds):
            problem = self.problem(choice.effects, choice.material, places, choice.parameters)
            choice = gauss_newton(problem, choice.parameters, max(steps // rounds, int(steps > 0)))
        self.tick()
        return choice

    def predicted(self, model: Model, places: Iterable[int]) -> list[np.ndarray]:
        """All readings at ``places`` under a model, in units of their floors."""
        return [self.observations[k].predicted(model) for k in places]

    def loss(self, model: Model, places: Sequence[int] | np.ndarray) -> float:
        """Mean loss of all readings at ``places`` [dB^2]."""
        each = zip(places, self.predicted(model, places), strict=True)
        return float(np.mean([self.observations[k].losses(x).mean() for k, x in each]))

    def choice_loss(self, choice: Solution, most: float = np.inf) -> float:
        """Mean square error that tells one choice from another [dB^2], without residual: of the readings chosen of places that
        trial fits learn from, and of those held out, which are too few to say alone (none may be behind a wall). Where some of
        the places show that it is ``most`` or more, that at these."""
        few, p = self.few(1), choice.parameters
        places = np.concatenate([few, np.setdiff1d(self.held, few)])  # those first whose paths are traced
        count, losses = sum(len(self.parts[k].target) for k in places), np.zeros(0)
        for some in np.array_split(places, 4):
            problem = self.problem(choice.effects, choice.material, some, p)
            own = [batch.losses(batch.gain(p, x) * x) for batch, _, x in problem.evaluated(p)]
            losses = np.concatenate([losses, *own])
            if losses.sum() >= most * count:
                break
        return float(np.mean(losses))

    def unexplained(self, model: Model) -> tuple[dict[int, np.ndarray], dict[str, float]]:
        """Readings of tables that ``model`` misses by more than 5 of their standard deviations, ``(N,)`` by place; and what it
        misses the others by, in the median, by table [dB]: their noise."""
        tables = [k for k, o in self.observations.items() if isinstance(o.measured, WeighedPaths)]
        rows, left = dict[int, np.ndarray](), dict[str, list[float]]()
        most_db = 5.0 * NOISE_DB  # standard deviations beyond which a reading is taken to be wrong
        clear_db = 10.0  # above its floor a reading's decibels err as they are
        normal = 1.4826  # standard deviation over the median size of normal errors
        for k, power in zip(tables, self.predicted(model, tables), strict=True):
            o, target = self.observations[k], self.observations[k].target
            error = target.error(power)
            wrong = np.flatnonzero(np.abs(error) > most_db)
            rows |= {k: wrong} if len(wrong) else {}
            clear = ~target.censored & (target.db > clear_db)
            left.setdefault(self.names[o.place.data], []).extend((error / target.trust)[clear])
        return rows, {
            name: normal * float(np.median(np.abs(errors))) for name, errors in left.items() if errors
        }

    def without(self, wrong: Mapping[int, np.ndarray]) -> Training:
        """The same in which readings ``wrong``, by place, count no longer."""
        observations, parts = dict(self.observations), dict(self.parts)
        for k, rows in wrong.items():
            o = observations[k]
            counts = ~np.isin(np.arange(len(o.target)), rows)
            observations[k] = replace(o, target=o.target.trusted(counts))
            parts[k] = replace(parts[k], target=parts[k].target.trusted(counts[parts[k].rows]))
        return replace(self, observations=observations, parts=parts)

    def weighed(self, noise_db: Mapping[str, float]) -> Training:
        """The same in which no reading counts for more than by the noise [dB] of its table."""

        def less(o: Observation) -> Observation:
            most = NOISE_DB / max(noise_db.get(self.names[o.place.data], 0.0), 1e-9)
            return replace(o, target=replace(o.target, trust=np.minimum(o.target.trust, most)))

        observations, parts = (
            {k: less(o) for k, o in own.items()} for own in (self.observations, self.parts)
        )
        return replace(self, observations=observations, parts=parts)

    def note(self, what: str, kept: bool, loss: float) -> None:
        """Log a choice."""
        self.log.append({"term": what, "kept": bool(kept), "rmse_db": float(np.sqrt(loss))})


def _counted(progress: Progress | None, count: int, total: int) -> Callable[..., None]:
    """What tells ``progress`` that one of ``total`` steps with ``count`` places is done; how many there are is estimated."""
    done = 0

    def step(*, last: bool = False) -> None:
        nonlocal done
        done = total if last else min(done + 1, total - 1)
        if progress is not None:
            progress("fit", done * count, total * count)

    return step
