"""Fitting a bistatic field: trace what receivers see, observe what was read, fit parameters of materials, find out which
groups are of one material, what differs within them, and how wrong all that is.

:func:`fit` reads as that list. Each step is a function of a :class:`Training`, which nothing changes.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
from threadpoolctl import threadpool_limits

from warprrf.checks import check_count, check_seed, checked, some_of, users_level
from warprrf.cluster import each
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import GeometryLike, as_mesh
from warprrf.rf.channel.array_spectra import ArraySpectra
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.base import Data, Measured
from warprrf.rf.fields.bistatic.gauss_newton import (
    KNOWN_THROUGH,
    THROUGH,
    Fitted,
    Problem,
    gauss_newton,
    layout_of,
)
from warprrf.rf.fields.bistatic.measured import SpectrumPixels, WeighedPaths, read
from warprrf.rf.fields.bistatic.merging import BY_SHAPE, Merging, merge
from warprrf.rf.fields.bistatic.needs import MOST_BLOCKED, RARE, RAYS, evenly, needed, total
from warprrf.rf.fields.bistatic.observations import (
    NOISE_DB,
    Observation,
    Place,
    as_list,
    frame_of,
    huber,
    observe,
    places_of,
)
from warprrf.rf.fields.bistatic.placing import moved, position_offset, with_azimuths
from warprrf.rf.fields.bistatic.residual import fit_residual, shares_of
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel, learn_errors
from warprrf.rf.positions import warn_of_unmodelled
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings
from warprrf.rf.tracing.model import LOBES, SETS, Effects, Layout, Model, Parameters
from warprrf.rf.tracing.records import Evaluation
from warprrf.rf.tracing.render import evaluation, path_gains
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Tracer, View, traced

LEAST_HELD_OUT = 2
"""Receivers held out below which they choose no effects: one alone likes what others do not."""
HELD_OUT, MOST_HELD_OUT, LEAST_RECEIVERS = 0.25, 30, 4
"""Share of receivers that are held out, how many at most, and of how many at least."""
FEW = 20
"""Receivers up to which errors are learned from every one, held out in turn."""
MOST_TO_CHOOSE = 24
"""Receivers that fits which only decide about something learn from."""
SHORT_STEPS = 10  # of such a fit
BETTER, MUCH_BETTER = 0.995, 0.8
"""Share to which further effects must lower the mean square error of receivers held out; to which single bounces must lower
it where receivers are too few to hold any out."""
CLEARLY_WORSE, NOT_MUCH_WORSE = 1.05, 1.25
"""Share to which the residual may raise it (one that is learned from all receivers gains more), and to which fewer materials
may that describe the training receivers better."""
MERGES = 3  # rounds of deciding what is of one material, and fitting
UNEXPLAINED = 5.0  # standard deviations beyond which a reading of a table is taken to be wrong
READINGS, LEAST_READINGS = 12_000, 200
"""Readings that parameters are fitted to, spread over the training receivers, and of each at least."""
KNOWN_BETTER = 2.0
"""By how much more readings count that hold line of sight alone: no material is in them. They tell a chain's gain."""
BEHIND_WALLS = 0.5
"""How much directions count that were measured behind slabs: of what comes through these more is left out (light between
surfaces that passes them on its way), and what a material must make up for there it lacks in the open."""
SIDE_LOBES_DB = 3.0
"""Standard deviation of the level of an antenna's side lobes, which few measure."""
HANGING_DB = 1.0  # that this moves a chain's gain by and is worth a warning
DARK = 0.01  # share of line of sight below which a place is blocked
LEFT_OUT_DB = 0.5  # of them is too little for a warning
CLEAR_DB = 10.0  # above its floor a reading's decibels err as they are
NORMAL_MEDIAN = 1.4826  # standard deviation over the median size of normal errors
MOST_RAYS = 500_000_000
"""Spectra with more rays than this are refused: what rays meet is kept during a fit."""
RAY_BYTES = 40  # kept of each ray
MOST_KEPT = 30_000_000
"""Rays up to which light over several surfaces is kept too, for as much again; of more it is traced when it is asked for."""
SUB_PIXELS, QUICK_SUB_PIXELS = 3, 1
"""Square roots of the rays per pixel."""


@runtime_checkable
class EffectsChoice(Protocol):
    """What says beforehand which effects a scene needs, such as :class:`warprrf.Relevance`."""

    def needs(self, frequency_hz: float) -> tuple[Effects, tuple[int, ...] | None]:
        """Effects, each as far as it may be needed, and exponents of lobes; None for those of a fit."""


@checked
@dataclass(frozen=True)
class FitOptions:
    """Options of a bistatic fit; :meth:`BistaticField.fit` takes each of them as a keyword.

    Attributes:
        effects: what is modelled: :class:`Effects`, the name of one of :data:`SETS` (``"single"``, ``"room"``,
            ``"everything"``), or ``"auto"``: the set that errs least on receivers held out (a quarter, 30 at most), and the
            residual if it does not err more; a larger set is tried where the one before it was better. With fewer than
            eight receivers it is ``"room"``, or ``"single"`` if that fits much better. Slabs are passed and edges gone over
            where that is worth more than 0.25 dB to all power of blocked receivers (:mod:`.needs`).
        lobes: exponents of the scattering lobes ((1 + cos psi) / 2)^n, 0 for Lambertian; None for 0, 2, 5, 12, 30.
        reciprocal: lobes that scatter alike when transmitter and receiver change places. By default they are those of
            Degli-Esposti et al. (2007), Sionna RT's, which do not.
        sub_pixels: square root of the rays per pixel (None: 3); 4 gives better delays of scattering, 2 takes half the
            time.
        quick: one ray a pixel, and nothing held out to decide by.
        gain_offset: fit one gain common to all paths, for a receiver that was not calibrated; see ``report``.
        iterations: most steps of the fit of materials.
        relevance: what it rules out is off.
        seed: of the choice of pixels and held-out receivers.
    """

    effects: Effects | str = "auto"
    lobes: tuple[int, ...] | None = None
    reciprocal: bool = False
    sub_pixels: int | None = None
    quick: bool = False
    gain_offset: bool = False
    iterations: int = 40
    relevance: EffectsChoice | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("iterations", self.iterations, 0)
        check_seed(self.seed)
        if isinstance(self.effects, str) and self.effects not in ("auto", *SETS):
            raise ValueError(
                f"effects: got {self.effects!r}, expected wr.Effects, or one of 'auto', {', '.join(map(repr, SETS))}"
            )
        if self.sub_pixels is not None:
            check_count("sub_pixels", self.sub_pixels, 1, 16)
        Parameters.prior(1, LOBES if self.lobes is None else self.lobes)

    def candidates(self, frequency_hz: float) -> list[Effects]:
        """Effects to choose from, the fewest first; one where they are given. What ``relevance`` rules out is off."""
        most = Effects() if self.relevance is None else self.relevance.needs(frequency_hz)[0]
        if isinstance(self.effects, Effects):
            return [self.effects]
        given = SETS.values() if self.effects == "auto" else [SETS[self.effects]]
        found = [
            Effects(**{f.name: min(getattr(one, f.name), getattr(most, f.name)) for f in fields(Effects)})
            for one in given
        ]
        rare: dict[str, Any] = {"transmissions": most.transmissions, "diffractions": most.diffractions}
        if self.relevance is not None:
            found = [replace(one, **rare) for one in found]
        return list(dict.fromkeys(found))

    def exponents(self, frequency_hz: float) -> tuple[int, ...]:
        """Of the lobes."""
        if self.lobes is not None:
            return self.lobes
        known = None if self.relevance is None else self.relevance.needs(frequency_hz)[1]
        return LOBES if known is None else known

    @property
    def rays(self) -> int:
        """Square root of the rays per pixel."""
        return self.sub_pixels or (QUICK_SUB_PIXELS if self.quick else SUB_PIXELS)


@dataclass(frozen=True)
class TrainingViews:
    """What is seen of the geometry at the places that were measured, whatever the materials: traced once, used by every
    fit.

    Attributes:
        places: receivers under their transmitters.
        views: one for each place.
        effects: whose mirrors, slabs and edges were sought.
        seconds: what it took.
    """

    places: list[Place] = field(repr=False)
    views: list[View] = field(repr=False)
    effects: Effects
    seconds: float

    @property
    def tracer(self) -> Tracer:
        """Surface, transmitter and grid of the first place."""
        return self.views[0].tracer

    def subset(self, indices: Sequence[int] | np.ndarray) -> TrainingViews:
        """Some of its places."""
        chosen = [int(i) for i in indices]
        return replace(self, places=[self.places[i] for i in chosen], views=[self.views[i] for i in chosen])

    def check(self, places: Sequence[Place], sub_pixels: int | None) -> None:
        """Raise ValueError if they are not those of exactly ``places``."""
        same = len(self.places) == len(places) and all(
            a.seen_from == b.seen_from for a, b in zip(self.places, places, strict=True)
        )
        if not same or sub_pixels not in (None, self.tracer.grid.sub_pixels):
            raise ValueError(
                f"views: got what {len(self.views)} receivers see with {self.tracer.grid.per_pixel} rays a pixel; "
                f"expected exactly the {len(places)} receivers, transmitter, carrier, grid, beam, air and rays of this fit"
            )


def trace(
    geometry: GeometryLike,
    ds: Data,
    *,
    effects: Effects | None = None,
    decides: bool = True,
    sub_pixels: int = SUB_PIXELS,
    client: Any = None,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> TrainingViews:
    """What the receivers of ``ds`` see of ``geometry`` (a Reconstruction, Scene, Mesh or Surface).

    Args:
        effects: which tables are traced at once (others when they are first asked for); None for single bounces, and for
            as many mirrors up to 3 as can be searched (2 in a city).
        decides: whether paths pass slabs and go over edges as the scene needs it (:func:`needed`), else as ``effects`` say.
        sub_pixels: square root of the rays per pixel.
        client: a ``dask.distributed.Client`` whose workers trace, to the same bits; this process by default.
        device: where rays are cast.
        progress: called with the stages ``"patches"``, ``"mirrors"`` and ``"transport"``.

    Raises:
        ValueError: for receivers on a surface or outside the scene, numbers out of range, or more rays or chains of
            mirrors than :data:`MOST_RAYS` and :data:`~warprrf.rf.paths.images.MOST_CHAINS`.
        TypeError: for a geometry without a mesh.
    """
    started, tell = time.perf_counter(), progress or (lambda *_: None)
    places = places_of(as_list(ds), as_mesh(geometry, "geometry"), device)
    check_count("sub_pixels", sub_pixels, 1, 16)
    _check_rays(places, sub_pixels)
    wanted = replace(SETS["single"], mirrors=3) if effects is None else effects
    tell("patches", 0, 1)
    surface = Surface.of(geometry)
    tell("patches", 1, 1)
    if decides:
        wanted = needed(wanted, surface, places, device)
    keeps = len(places) * places[0].shape[0] * places[0].shape[1] * sub_pixels**2 <= MOST_KEPT
    together: dict[tuple[object, ...], list[int]] = {}  # places under one transmitter
    for k, place in enumerate(places):
        together.setdefault((place.transmitter.tobytes(), *place.seen_from[2:]), []).append(k)
    views: dict[int, View] = {}
    for own in together.values():
        first = places[own[0]]
        loss_per_m = 0.0 if first.air is None else first.air.loss_per_m(first.frequency_hz)
        tracer = Tracer.of(
            surface, first.transmitter, first.frequency_hz, first.shape, sub_pixels,
            beam_sigma_rad=first.beam_sigma_rad, loss_per_m=loss_per_m, device=device,
        )  # fmt: skip
        receivers = np.stack([places[k].receiver for k in own])
        if effects is None:
            wanted = replace(wanted, mirrors=tracer.images.affordable(receivers, wanted.mirrors))
        found = tracer.paths(receivers, wanted, progress)
        parts = [(receivers[r], found.subset(np.flatnonzero(found.receiver == r))) for r in range(len(own))]
        for r, view in each(partial(traced, tracer.again, wanted, keeps), parts, client):
            views[own[r]] = tracer.adopted(view)
            tell("transport", len(views), len(places))
    seconds = time.perf_counter() - started
    every = [views[k] for k in range(len(places))]
    return TrainingViews(places, every, wanted, seconds)


def _check_rays(places: Sequence[Place], sub_pixels: int) -> None:
    """Refuse places whose rays would not fit into memory."""
    rays = sum(place.shape[0] * place.shape[1] for place in places) * sub_pixels**2
    if rays > MOST_RAYS:
        raise ValueError(
            f"ds: {len(places)} spectra of {places[0].shape[0]} x {places[0].shape[1]} pixels take {rays:.2g} rays, "
            f"{rays * RAY_BYTES / 1e9:.0f} GB and more, expected at most {MOST_RAYS:.2g}: give fewer receivers (ds.split, "
            "ds.subset) or sub_pixels=1"
        )


@dataclass(frozen=True)
class Fit:
    """Result of :func:`fit`: what a field is made of, and a report."""

    surface: Surface
    model: Model
    material: np.ndarray
    sub_pixels: int
    errors: ErrorModel | None
    report: dict[str, Any]


def fit(
    geometry: GeometryLike,
    ds: Data,
    options: FitOptions,
    *,
    views: TrainingViews | None = None,
    client: Any = None,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> Fit:
    """Fit a model to what ``ds`` holds; arguments and errors as for :meth:`BistaticField.fit`."""
    data = as_list(ds)
    for one in data:
        if isinstance(one, SpectrumDataset) and len(one) and not (one.path_gain > one.floor).any():
            raise ValueError("ds: got no pixel above the floor, expected spectra with power to fit to")
    frequency_hz = frame_of(data).frequency_hz
    candidates = options.candidates(frequency_hz)
    where: dict[str, Any] = {"client": client, "device": device, "progress": progress}
    where |= {"effects": candidates[0] if len(candidates) == 1 else None, "sub_pixels": options.rays}
    where |= {"decides": options.effects == "auto" and options.relevance is None}
    if views is not None:
        places = places_of(data, as_mesh(geometry, "geometry"), device)
        views.check(places, options.sub_pixels)
        views = replace(
            views, places=places
        )  # of a part of what was traced they say where in the whole readings are
    seen = views or trace(geometry, data, **where)
    if options.effects != "auto":  # else these are decided on by what they are worth
        rare: dict[str, Any] = {
            name: any(getattr(candidates[0], key) for key in on) for name, on in RARE.items()
        }
        first = seen.places[0]
        receivers = np.array(
            [p.receiver for p in seen.places if np.array_equal(p.transmitter, first.transmitter)]
        )
        link = as_mesh(geometry, "geometry"), first.transmitter, receivers
        warn_of_unmodelled(*link, frequency_hz=frequency_hz, device=device, **rare)
    # The fit's matrices are small: threads of BLAS would spend more time waiting for each other than they save.
    with threadpool_limits(1, user_api="blas"):
        data, zeros = with_azimuths(data, seen.places, seen.views)
        training = Training.of(seen, data, options, candidates, progress)
        found = _fitted(training)
        offsets = _offsets(training, found)
        if offsets:
            data = [moved(one, offsets[k]) if k in offsets else one for k, one in enumerate(data)]  # type: ignore[arg-type]
            training = Training.of(trace(geometry, data, **where), data, options, candidates, progress)
            found = _fitted(training)
    _warn_of_left_out(data, found.report["unexplained"])
    _warn_of_side_lobes(found.report["chains"])
    _warn_of_unmodelled(found.report["left_out"])
    places_moved = {
        training.names[k]: [(place.receiver.tolist(), offset.tolist()) for place, offset in own]
        for k, own in offsets.items()
    }
    return replace(
        found, report=found.report | {"azimuth_zero_deg": zeros, "position_offset_m": places_moved}
    )


@dataclass(frozen=True)
class Choice:
    """What was decided on: effects, the material of each group ``(G,)``, and parameters of materials under them."""

    effects: Effects
    material: np.ndarray
    fitted: Fitted

    @property
    def parameters(self) -> Parameters:
        """Of the materials."""
        return self.fitted.parameters


@dataclass(frozen=True, eq=False)
class Training:
    """One fit: what it learns from, and how.

    Attributes:
        options: of the fit.
        candidates: effects to choose from, the fewest first.
        surface: of the geometry.
        observations: of every place.
        parts: those readings of each that parameters are fitted to.
        chains: names of measuring chains whose gain is unknown.
        names: of the data sets.
        data: the data sets.
        held, kept: places that are held out to decide by, and the others.
        always: places that are never held out, one of each chain: without any its gain would not be known.
        lobes: exponents.
        totals: whether power alone was read, which cannot tell bounces or materials apart.
        seconds: what tracing took.
        step: to be called after each fit.
        log: choices, as they are made.
    """

    options: FitOptions
    candidates: list[Effects]
    surface: Surface
    observations: list[Observation]
    parts: list[Observation]
    chains: list[str]
    names: list[str]
    data: Sequence[Measured]
    held: np.ndarray
    kept: np.ndarray
    always: list[int]
    lobes: tuple[int, ...]
    totals: bool
    seconds: float
    step: Callable[..., None]
    log: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        seen: TrainingViews,
        data: Sequence[Measured],
        options: FitOptions,
        candidates: list[Effects],
        progress: Progress | None,
    ) -> Training:
        """Observations of ``data`` where ``seen`` is seen, some of them held out."""
        frequency_hz, count = frame_of(data).frequency_hz, len(seen.places)
        observations, chains = observe(data, seen.places, seen.views, frequency_hz)
        totals = all(isinstance(one, Readings) and one.total for one in data)
        sought = seen.effects
        rare: dict[str, Any] = {"transmissions": sought.transmissions, "diffractions": sought.diffractions}
        candidates = [replace(one, mirrors=min(one.mirrors, sought.mirrors), **rare) for one in candidates]
        if len(candidates) > 1 and any(isinstance(one, ArraySpectra) for one in data):
            candidates = [
                replace(one, mirrors=sought.mirrors) for one in candidates
            ]  # they hear the phases of all
        if len(candidates) > 1 and totals:
            candidates = candidates[1:2]
        rng, chain = np.random.default_rng(options.seed), np.array([o.chain for o in observations])
        always, held = [int(np.argmax(chain == k)) for k in range(len(chains))], np.zeros(0, int)
        if count >= LEAST_RECEIVERS and not options.quick:
            order = rng.permutation(count)
            held = np.sort(order[~np.isin(order, always)][: min(int(count * HELD_OUT), MOST_HELD_OUT)])
        lobes = options.exponents(frequency_hz)
        parts = []
        for o in observations:
            trust, db = o.target.trust, o.target.db
            known = np.arange(len(db)) if trust is None else np.flatnonzero(trust)
            size = min(len(known), max(LEAST_READINGS, READINGS // count))
            part = o.part(known[np.sort(rng.choice(len(known), size, replace=False))])
            if part.sight is not None:
                part = replace(part, target=part.target.trusted(1.0 + KNOWN_BETTER * part.sight))
            straight = o.view.paths.order == 0
            if not totals and (straight & (o.view.paths.slabs > 0)).any():
                part = replace(part, target=part.target.trusted(np.full(len(part.target.db), BEHIND_WALLS)))
            parts.append(part)
        steps = _Steps(progress, count, 4 + len(candidates) + MERGES + (2 * count if count <= FEW else 3))
        return cls(
            options, candidates, seen.tracer.surface, observations, parts, chains,
            [getattr(one, "name", "") for one in data], data, held, np.setdiff1d(np.arange(count), held), always, lobes,
            totals, seen.seconds, steps,
        )  # fmt: skip

    @property
    def area(self) -> np.ndarray:
        """Of each group [m^2]."""
        s = self.surface
        return np.bincount(s.group, s.mesh.areas, minlength=s.groups)

    @property
    def transmitter(self) -> np.ndarray:
        """Under which gains of light sent on are learned: of several transmitters none."""
        sources = {o.place.transmitter.tobytes() for o in self.observations}
        return self.observations[0].place.transmitter if len(sources) == 1 else np.full(3, np.nan)

    def start(self, material: np.ndarray) -> Parameters:
        """Parameters of materials before any measurement."""
        prior = Parameters.prior(int(material.max()) + 1, self.lobes, reciprocal=self.options.reciprocal)
        return replace(prior, log_through=self.passage(material)[0])

    def passage(self, material: np.ndarray) -> np.ndarray:
        """ln of the share that materials let through before any measurement, and its standard deviation, shape ``(2, M)``."""
        eta, _, through = self.surface.slabs(frame_of(self.data).frequency_hz)
        std = np.where(np.abs(eta) > 0, KNOWN_THROUGH, THROUGH)
        return np.stack([np.bincount(material, own) for own in (through, std)]) / np.bincount(material)

    def few(self, times: int) -> np.ndarray:
        """Places that fits which only decide about something learn from, those of every chain among them."""
        others = np.setdiff1d(self.kept, self.always)
        return np.union1d(self.always, others[: max(times * MOST_TO_CHOOSE - len(self.always), 0)]).astype(
            int
        )

    def problem(
        self, effects: Effects, material: np.ndarray, places: Iterable[int], p: Parameters
    ) -> Problem:
        """What is fitted to readings of ``places``, lit as under parameters ``p`` of materials."""
        return Problem.of(
            [self.parts[k] for k in places], effects, material, p, chains=len(self.chains),
            gain_offset=self.options.gain_offset, passage=self.passage(material),
            **({"energy": 1.0} if self.totals else {}),
        )  # fmt: skip

    def model(self, choice: Choice, *, residual: bool = False) -> Model:
        """That of groups, without a residual yet."""
        effects = replace(choice.effects, residual=residual)
        none = np.zeros((2, self.surface.cells))
        return Model(effects, choice.parameters.take(choice.material), none, self.transmitter)

    def fitted(self, choice: Choice, places: Iterable[int], steps: int, rounds: int = 1) -> Choice:
        """``choice`` with parameters fitted to readings of ``places``; what surfaces get of each other is computed anew in
        each of ``rounds``."""
        rounds, places = rounds if choice.effects.scatterings > 1 else 1, list(places)
        for _ in range(rounds):
            problem = self.problem(choice.effects, choice.material, places, choice.parameters)
            found = gauss_newton(problem, choice.parameters, max(steps // rounds, int(steps > 0)))
            choice = replace(choice, fitted=found)
        self.step()
        return choice

    def predicted(self, model: Model, places: Iterable[int]) -> list[np.ndarray]:
        """All readings at ``places`` under a model, in units of their floors."""
        return [o.predicted(here, materials) for o, here, materials in self.evaluated(model, places)]

    def evaluated(
        self, model: Model, places: Iterable[int]
    ) -> Iterable[tuple[Observation, Model, Evaluation]]:
        """Observations with the model at their carriers, as kernels take it."""
        known: dict[Any, tuple[Model, Evaluation]] = {}
        for k in places:
            o = self.observations[k]
            key = id(o.view.tracer), o.ratio
            if key not in known:
                here = replace(model, parameters=model.parameters.at_ratio(o.ratio))
                known[key] = here, evaluation(o.view.tracer, here)
            yield o, *known[key]

    def loss(self, model: Model, places: Sequence[int] | np.ndarray) -> float:
        """Mean loss of all readings at ``places`` [dB^2]."""
        predicted = self.predicted(model, places)
        own = [self.observations[k].losses(x).mean() for k, x in zip(places, predicted, strict=True)]
        return float(np.mean(own))

    def held_loss(self, choice: Choice) -> float:
        """Mean square error at the places held out, without residual [dB^2]: of all readings where they are few, else of
        those chosen."""
        if len(self.held) <= LEAST_RECEIVERS:
            return self.loss(self.model(choice), self.held)
        return self.part_loss(choice, self.held)

    def part_loss(self, choice: Choice, places: np.ndarray) -> float:
        """The same of the readings chosen of ``places``."""
        problem = self.problem(choice.effects, choice.material, places, choice.parameters)
        p = choice.parameters
        losses = [o.losses(o.gain(p, x) * x) for o, _, _, x in problem.evaluated(p)]
        return float(np.mean(np.concatenate(losses)))

    def note(self, what: str, kept: bool, loss: float) -> None:
        """Log a choice."""
        self.log.append({"term": what, "kept": bool(kept), "held_out_rmse_db": float(np.sqrt(loss))})


@dataclass
class _Steps:
    """Progress of a fit whose steps are only estimated."""

    progress: Progress | None
    count: int
    total: int
    done: int = 0

    def __call__(self, *, last: bool = False) -> None:
        self.done = self.total if last else min(self.done + 1, self.total - 1)
        if self.progress is not None:
            self.progress("fit", self.done * self.count, self.total * self.count)


def _fitted(t: Training) -> Fit:
    """All steps of a fit but tracing."""
    started = time.perf_counter()
    choice = choose(t)
    residual, errors = cross_validate(t, choice)
    choice, model = everyone(t, choice, residual)
    wrong = unexplained(t, model)
    if any(len(rows) for rows in wrong.rows):
        t = without(t, wrong.rows)
        choice, model = everyone(t, choice, residual)
    if errors is not None:
        errors = replace(
            errors,
            covariance=_covariance(choice.fitted, t.options.gain_offset, choice.effects.transmissions > 0),
        )
    missed = left_out(t, model)
    t.step(last=True)
    rays = t.observations[0].view.tracer.grid.sub_pixels
    return Fit(
        t.surface,
        model,
        choice.material,
        rays,
        errors,
        _report(t, choice, wrong, time.perf_counter() - started) | {"left_out": missed},
    )


def choose(t: Training) -> Choice:
    """Effects, and which groups are of one material."""
    material = t.surface.material
    start = Fitted(t.start(material), np.zeros((0, 0)), [])
    trials = [Choice(effects, material, start) for effects in t.candidates]
    if len(t.held) < (LEAST_HELD_OUT if len(trials) > 1 else 1):
        return _choose_of_few(t, trials)
    best, least = None, np.inf
    for trial in trials:  # each holds the one before it: what is no better with some is not tried with more
        if best is None:
            trial = t.fitted(trial, t.few(1), 2 * SHORT_STEPS, rounds=2)
        else:
            trial = t.fitted(replace(trial, fitted=best.fitted), t.few(1), SHORT_STEPS)
        loss = t.held_loss(trial)
        kept = loss < BETTER * least
        t.note(_name(trial.effects), kept, loss)
        if not kept:
            break
        best, least = trial, loss
    if best is None:
        raise ValueError("effects: got none to choose from")
    best, least = _spared(t, best, least)
    if np.isfinite(t.surface.appearance).all() and material.max() > 0 and not t.totals:
        best = merged(t, best, least)
    return best


def _spared(t: Training, best: Choice, least: float) -> tuple[Choice, float]:
    """``best`` and its loss without those of :data:`RARE` that readings are predicted better without: a scene may need what is
    not in its readings (a simulation without diffraction), or what its mesh shows wrongly. Places held out are too few to
    say so alone: none of them may be behind a wall."""
    chosen, places = best, np.union1d(t.few(1), t.held)
    for name, on in RARE.items() if t.options.effects == "auto" and t.options.relevance is None else ():
        off: dict[str, Any] = dict.fromkeys(on, 0)
        fewer = replace(chosen.effects, **off)
        if fewer != chosen.effects:
            trial = t.fitted(replace(chosen, effects=fewer), t.few(1), SHORT_STEPS)
            loss = t.part_loss(trial, places)
            kept = loss < BETTER * t.part_loss(chosen, places)
            t.note(f"no {name}", kept, loss)
            chosen = trial if kept else chosen
    return chosen, least if chosen is best else t.held_loss(chosen)


def _choose_of_few(t: Training, trials: list[Choice]) -> Choice:
    """With too few receivers to hold any out: bounces as rooms have them, unless none fit much better."""
    if len(trials) == 1:
        return t.fitted(trials[0], t.kept, t.options.iterations, rounds=2)
    single, room = (t.fitted(trial, t.kept, t.options.iterations, rounds=2) for trial in trials[:2])
    everywhere = np.arange(len(t.observations))
    models = [t.model(trial) for trial in (single, room)]
    wrong = zip(*(unexplained(t, model).rows for model in models), strict=True)
    counted = without(t, [np.intersect1d(*rows) for rows in wrong])  # without what neither explains
    losses = [counted.loss(model, everywhere) for model in models]
    fewer = losses[0] < MUCH_BETTER * losses[1]
    t.note(_name(single.effects), fewer, losses[0])
    t.note(_name(room.effects), not fewer, losses[1])
    return single if fewer else room


def merged(t: Training, best: Choice, least: float) -> Choice:
    """Materials by what the readings say, if that lowers the error of the places held out."""
    trial, options = best, BY_SHAPE if t.surface.by_shape else Merging()
    problem = t.problem(best.effects, best.material, t.few(2), best.parameters)
    for _ in range(MERGES):
        material, start = merge(problem, trial.parameters, t.surface.appearance, t.area, options)
        # What surfaces get of each other changes little with who is of which material: it is held.
        problem = replace(problem, material=material, passage=t.passage(material))
        trial = Choice(best.effects, material, gauss_newton(problem, start, SHORT_STEPS))
        t.step()
    loss = t.held_loss(trial)
    # Few receivers held out say little, fewer materials that describe the others better say much.
    same = len(t.kept) <= MOST_TO_CHOOSE  # receivers of both fits
    simpler = same and trial.fitted.losses[-1:] < best.fitted.losses[-1:]
    keep = loss < least or (simpler and loss < NOT_MUCH_WORSE * least)
    t.note(f"{best.material.max() + 1} materials as {trial.material.max() + 1}", keep, loss)
    return trial if keep else best


def _name(effects: Effects) -> str:
    """What a choice of effects is called in a report."""
    known = [name for name, one in SETS.items() if replace(one, mirrors=effects.mirrors) == effects]
    return (known or [str(effects)])[0]


def cross_validate(t: Training, choice: Choice) -> tuple[bool, ErrorModel | None]:
    """Whether the residual is wanted, or does not clearly raise the error of places held out, and the errors that then
    remain: of those held out; where they are few, of all, held out in turn. No errors where no whole spectra were measured."""
    free = isinstance(t.options.effects, str) and choice.effects.residual
    if not len(t.held):
        return choice.effects.residual, None
    places = np.stack([o.place.receiver for o in t.observations])
    tried = (False, True) if free else (choice.effects.residual,)
    power: dict[bool, list[np.ndarray]] = {residual: [] for residual in tried}
    order: list[int] = []
    gaps = []
    for held in _folds(t):
        kept = np.setdiff1d(np.arange(len(places)), held)
        own = choice if held is t.held else t.fitted(choice, kept, SHORT_STEPS)
        order += held.tolist()
        gaps += [np.linalg.norm(places[kept] - places[r], axis=1).min() for r in held]
        for residual, found in power.items():
            model = t.model(own, residual=residual)
            found += t.predicted(with_residual(t, model, kept) if residual else model, held)
    loss = {
        residual: float(
            np.mean([t.observations[k].losses(x).mean() for k, x in zip(order, own, strict=True)])
        )
        for residual, own in power.items()
    }
    keep = loss[True] < CLEARLY_WORSE * loss[False] if free else choice.effects.residual
    for residual, error in loss.items():
        t.note("residual" if residual else "no residual", residual == keep, error)
    if not all(isinstance(o.measured, SpectrumPixels) and o.target.trust is None for o in t.observations):
        return keep, None
    shapes = [t.observations[k].place.shape for k in order]
    images = [(NEPER * np.log1p(x)).reshape(shape) for x, shape in zip(power[keep], shapes, strict=True)]
    missed = [
        t.observations[k].target.error(x).reshape(shape)
        for k, x, shape in zip(order, power[keep], shapes, strict=True)
    ]
    return keep, learn_errors(
        images,
        missed,
        np.array(gaps),
        places,
        _covariance(choice.fitted, t.options.gain_offset, choice.effects.transmissions > 0),
    )


def _folds(t: Training) -> list[np.ndarray]:
    """Places that are held out in turn to learn errors."""
    folds = [t.held]
    if len(t.observations) <= FEW:
        others = np.setdiff1d(t.kept, t.always)
        folds += np.array_split(others, max(len(others) // max(len(t.held), 2), 2))
    return folds


def everyone(t: Training, choice: Choice, residual: bool) -> tuple[Choice, Model]:
    """The choice fitted to all places, and its model with the residual, if wanted."""
    everywhere = np.arange(len(t.observations))
    choice = t.fitted(choice, everywhere, t.options.iterations)
    model = t.model(choice, residual=residual)
    return choice, with_residual(t, model, everywhere) if residual else model


def with_residual(t: Training, model: Model, places: np.ndarray) -> Model:
    """``model`` with gains of surface cells that readings at ``places`` tell."""
    shares = [shares_of(o, here, materials) for o, here, materials in t.evaluated(model, places)]
    t.step()
    return replace(model, residual=fit_residual(shares, t.surface, quick=t.options.quick))


@dataclass(frozen=True)
class Unexplained:
    """Readings of tables that a fit misses by more than :data:`UNEXPLAINED` of their standard deviations, for each place
    ``(N,)``; and what it misses the others by, in the median, by table [dB]: their noise."""

    rows: list[np.ndarray]
    noise_db: dict[str, float]


def unexplained(t: Training, model: Model) -> Unexplained:
    """What ``model`` cannot explain."""
    rows, left = [np.zeros(0, int) for _ in t.observations], dict[str, list[float]]()
    tables = [k for k, o in enumerate(t.observations) if isinstance(o.measured, WeighedPaths)]
    for k, power in zip(tables, t.predicted(model, tables), strict=True):
        o, target = t.observations[k], t.observations[k].target
        if target.trust is not None and target.censored is not None:
            error = target.error(power)
            rows[k] = np.flatnonzero(np.abs(error) > UNEXPLAINED * NOISE_DB)
            clear = ~target.censored & (target.db > CLEAR_DB)
            left.setdefault(t.names[o.place.data], []).extend((error / target.trust)[clear])
    noise = {
        name: NORMAL_MEDIAN * float(np.median(np.abs(errors))) for name, errors in left.items() if errors
    }
    return Unexplained(rows, noise)


def without(t: Training, wrong: Sequence[np.ndarray]) -> Training:
    """``t`` in which readings ``wrong`` of each place count no longer."""
    observations, parts = list(t.observations), list(t.parts)
    for k, rows in enumerate(wrong):
        if len(rows):
            o = observations[k]
            counts = ~np.isin(np.arange(len(o.target.db)), rows)
            observations[k] = replace(o, target=o.target.trusted(counts))
            parts[k] = replace(parts[k], target=parts[k].target.trusted(counts[parts[k].rows]))
    return replace(t, observations=observations, parts=parts)


def _offsets(t: Training, found: Fit) -> dict[int, list[tuple[Place, np.ndarray]]]:
    """By data set of unknown positions its places, and how far each receiver is from where it is said to be [m]."""
    unsure = [
        k for k, o in enumerate(t.observations) if getattr(t.data[o.place.data], "position_std_m", 0.0) > 0
    ]
    offsets: dict[int, list[tuple[Place, np.ndarray]]] = {}
    for o, model, materials in t.evaluated(found.model, unsure):
        one = t.data[o.place.data]
        gains = path_gains(o.view, model, materials)
        total = np.maximum(read(gains, o.measured), 0.0) / o.floor
        direct = gains.specular / o.floor
        gain = o.gain(model.parameters, total)
        other = np.maximum(total - direct @ o.measured.of_paths(o.view), 0.0)
        offset = position_offset(one, o, gain * other, gain * direct)  # type: ignore[arg-type]
        offsets.setdefault(o.place.data, []).append((o.place, offset))
    return offsets


def left_out(t: Training, model: Model) -> dict[str, Any]:
    """Effects of :data:`RARE` that are not modelled and were not tried, estimated at a few ``"receivers"`` that are blocked: by
    how much they would raise all power there [dB], by name; and ``"error_db"``, by how much the fit has more than was read
    there, rms. What it lacks is no measure of its error: it may be just these effects."""
    blocked = list({o.place.seen_from: k for k, o in enumerate(t.observations) if _is_dark(o.view)}.values())
    seen = list(t.evaluated(model, evenly(np.array(blocked, int), MOST_BLOCKED)))
    tried = model.effects, *t.candidates
    lacking = {name: on for name, on in RARE.items() if not any(getattr(e, key) for e in tried for key in on)}
    change, by_tracer = {name: np.zeros(len(seen)) for name in RARE}, dict[int, list[int]]()
    whole, over = np.zeros(len(seen)), np.zeros(len(seen))
    for k, (o, here, materials) in enumerate(seen):
        gains = path_gains(o.view, here, materials)
        whole[k] = gains.specular.sum() + gains.by_ray().sum() + o.floor
        read_sum, predicted = o.target.sums(o.predicted(here, materials))
        over[k] = NEPER * max(np.log1p(predicted) - np.log1p(read_sum), 0.0)
        by_tracer.setdefault(id(o.view.tracer), []).append(k)
    for own in by_tracer.values() if lacking else ():
        tracer, here = seen[own[0]][0].view.tracer.on_grid(*RAYS), seen[own[0]][1]
        receivers = np.stack([seen[k][0].place.receiver for k in own])
        few = total(tracer, receivers, here, {})
        for name, on in lacking.items():
            more = np.maximum(total(tracer, receivers, here, on) - few, 0.0)
            change[name][own] = NEPER * np.log1p(more / whole[own])
    error_db = float(np.sqrt(np.mean(over**2))) if len(seen) else 0.0
    found: dict[str, Any] = {"receivers": [o.place.receiver.tolist() for o, *_ in seen], "error_db": error_db}
    return found | {name: own.tolist() for name, own in change.items()}


def _is_dark(view: View) -> bool:
    """Whether less than :data:`DARK` of line of sight passes what is in its way."""
    p = view.paths
    return bool((p.share[p.in_sight] ** 2).sum() < DARK)


def side_lobes(t: Training, choice: Choice) -> tuple[np.ndarray, np.ndarray]:
    """Of each chain, shape ``(C,)``: the share of its readings that side lobes of its antennas bring, as it counts in dB; and
    how far :data:`SIDE_LOBES_DB` of their level move its gain [dB], all other parameters with it."""
    first, p = len(choice.fitted.covariance) - len(t.chains), choice.parameters
    pull = np.zeros((len(t.chains), len(choice.fitted.covariance)))  # of side lobes' level on the parameters
    size, parts = np.zeros(len(t.chains)), list(t.parts)
    turned = [
        isinstance(one, Readings) and not (one.arrival is None and one.departure is None) for one in t.data
    ]
    places = [k for k, o in enumerate(parts) if o.chain >= 0 and turned[o.place.data]]
    bare = [one.without_side_lobes() if isinstance(one, Readings) else one for one in t.data]
    seen = [parts[k] for k in places]
    lobes = observe(bare, [o.place for o in seen], [o.view for o in seen], frame_of(t.data).frequency_hz)[0]
    for k, lobe in zip(places, lobes, strict=True):
        parts[k] = replace(lobe.part(np.asarray(parts[k].rows)), ratio=parts[k].ratio)
    whole, main = (
        one.problem(choice.effects, choice.material, places, p) for one in (t, replace(t, parts=parts))
    )
    linear = whole.linearised(p, layout_of(replace(whole, observations=t.parts), p))
    for (error, table, index), (o, _, _, power), (*_, own) in zip(
        linear, whole.evaluated(p), main.evaluated(p), strict=True
    ):
        gain, weight = o.gain(p, power), huber(error, o.huber_db)[1] / NOISE_DB**2
        side = o.target.slope(gain * power) * gain * np.maximum(power - own, 0.0)
        pull[o.chain, index] += table @ (weight * side)
        size[o.chain] += weight @ table[-1] ** 2  # its own gain's column stands last
    own = np.arange(len(t.chains))
    share = pull[own, first + own] / np.maximum(size, 1e-300)
    moved = SIDE_LOBES_DB * np.abs((choice.fitted.covariance[first:] * pull).sum(axis=1))
    return share, moved


def _covariance(found: Fitted, gain: bool, through: bool) -> np.ndarray:
    """Of what a field keeps: parameters of materials, with what they let through as it is known before where that was not free;
    and the common gain, if that was."""
    layout, whole = (
        Layout(*found.parameters.log_weight.shape, through=t, gain=gain) for t in (through, True)
    )
    free = np.ones(whole.size, bool)
    free[whole.passage(np.arange(whole.groups))] = through
    covariance = np.where(free, 0.0, THROUGH**2) * np.eye(whole.size)
    covariance[np.ix_(free, free)] = found.covariance[: layout.size, : layout.size]
    return covariance


def _report(t: Training, choice: Choice, wrong: Unexplained, seconds: float) -> dict[str, Any]:
    found = choice.fitted
    report: dict[str, Any] = {
        "receivers": len(t.observations),
        "held_out": len(t.held),
        "transport_time_s": t.seconds,
        "fit_time_s": seconds,
        "groups": t.surface.groups,
        "materials": int(choice.material.max()) + 1,
        "elements": len(t.surface.element_area),
        "steps": len(found.losses),
        "losses": {"gain": found.losses},
        "choices": t.log,
        "noise_db": wrong.noise_db,
    }
    deviation = np.sqrt(np.diag(found.covariance))
    if t.options.gain_offset:
        shape, through = found.parameters.log_weight.shape, choice.effects.transmissions > 0
        place = Layout(*shape, through=through).size
        report["gain_offset_db"] = NEPER * found.parameters.log_gain
        report["gain_offset_std_db"] = NEPER * float(deviation[place])
    known = NEPER * deviation[len(deviation) - len(t.chains) :]
    report["chains"] = {
        name: {
            "gain_db": NEPER * float(gain),
            "std_db": float(np.hypot(std, moved)),
            "side_lobe_share": float(share),
            "side_lobe_std_db": float(moved),
        }
        for name, gain, std, share, moved in zip(
            t.chains, found.parameters.log_gains, known, *side_lobes(t, choice), strict=True
        )
    }
    report["unexplained"] = {}
    for o, rows in zip(t.observations, wrong.rows, strict=True):
        if len(rows):
            report["unexplained"].setdefault(t.names[o.place.data], []).extend(o.place.rows[rows].tolist())
    return report


def _warn_of_side_lobes(chains: dict[str, dict[str, float]]) -> None:
    hanging = {name: one for name, one in chains.items() if one["side_lobe_std_db"] > HANGING_DB}
    if hanging:
        listed = ", ".join(
            f"{name!r} ({100 * one['side_lobe_share']:.0f} % of its readings, {one['side_lobe_std_db']:.1f} dB)"
            for name, one in hanging.items()
        )
        warnings.warn(
            f"ds: gains of chains hang on the level of side lobes, taken to be known to {SIDE_LOBES_DB:g} dB: {listed}; "
            "measure the pattern beyond its main lobe, or turn the antenna to what it is to see",
            UserWarning,
            stacklevel=users_level(),
        )


def _warn_of_unmodelled(missed: dict[str, Any]) -> None:
    for name in ("diffraction", "transmission"):
        large = [db for db in missed[name] if db > max(missed["error_db"], LEFT_OUT_DB)]
        if large:
            warnings.warn(
                f"{name} is not modelled, but would add {np.median(large):.1f} dB to all power of {len(large)} of "
                f"{len(missed[name])} blocked receivers, as estimated; where it is in what was read, something else was fitted to "
                "it: warprrf.relevance tells more",
                UserWarning,
                stacklevel=users_level(),
            )


def _warn_of_left_out(data: Sequence[Measured], wrong: dict[str, list[int]]) -> None:
    if wrong:
        count = sum(len(one) for one in data if isinstance(one, Readings))
        listed = "; ".join(f"{len(rows)} of {name!r}, rows {some_of(rows)}" for name, rows in wrong.items())
        warnings.warn(
            f"ds: {sum(map(len, wrong.values()))} of {count} readings are taken for wrong and left out ({listed}): "
            'report["unexplained"] lists them',
            UserWarning,
            stacklevel=users_level(),
        )
