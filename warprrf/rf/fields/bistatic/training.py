"""Fitting a bistatic field: trace once, choose terms on held-out receivers, fit groups, elements, then the errors."""

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
from warprrf.rf.fields.base import Data, Measured
from warprrf.rf.fields.bistatic.fit import (
    NEPER,
    OWN_GAIN,
    Fitted,
    GroupFit,
    Reading,
    fit_groups,
    gain_of,
    huber,
)
from warprrf.rf.fields.bistatic.grouping import BY_SHAPE, Regrouping, regroup
from warprrf.rf.fields.bistatic.materials import Materials, Parameters, Terms
from warprrf.rf.fields.bistatic.measured import SpectrumPixels, WeighedPaths, read
from warprrf.rf.fields.bistatic.observations import Frame, Place, as_list, observe, places_of
from warprrf.rf.fields.bistatic.placing import moved, position_offset, with_azimuths
from warprrf.rf.fields.bistatic.render import path_powers, sent_radiance
from warprrf.rf.fields.bistatic.residuals import QUICK as QUICK_RESIDUAL
from warprrf.rf.fields.bistatic.residuals import ResidualFit, fit_residual, shares_of
from warprrf.rf.fields.bistatic.response import Response, predict, respond, with_further_bounces
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.transport import ReceiverView, Transport, traced
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel, learn_errors
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings

MORE: tuple[tuple[str, Any], ...] = (
    ("mirror_scatter", True),
    ("diffuse_order", 2),
    ("diffuse_order", 3),
    ("mirror_order", 2),
    ("mirror_order", 3),
    ("scatter_mirror", True),
)
"""Bounces that may be added to single ones, in the order in which they are tried."""
SINGLE: dict[str, Any] = {
    "mirror_order": 1, "mirror_scatter": False, "scatter_mirror": False, "diffuse_order": 1, "indirect": False,
    "residual": True,
}  # fmt: skip
"""What a fit takes where :data:`FEW` fits much worse, with an indirect radiance if that is better still."""
QUICK = SINGLE | {"indirect": True, "sub_pixels": 1}
"""What a quick fit takes for given: light of more than one bounce is even but for the residual, one ray a pixel."""
FEW = SINGLE | {"mirror_order": 2, "mirror_scatter": True, "diffuse_order": 3}
"""What a fit tries first on receivers too few to choose terms by: bounces that rooms have, which bring no parameters."""
TERMS = ("mirror_order", "mirror_scatter", "scatter_mirror", "diffuse_order", "indirect", "residual")
"""Terms that a fit decides on where they are None."""
KNOWN_BETTER = 2.0
"""By how much more readings count that hold line of sight alone: no material is in them. They tell a chain's gain."""
CLEAR_DB = 10.0  # above its floor a reading's decibels err as they are
NORMAL_MEDIAN = 1.4826  # standard deviation over the median size of normal errors
MOST_RAYS = 500_000_000
"""Spectra with more rays than this are refused: what rays meet is kept during a fit."""
RAY_BYTES = 40  # kept of each ray


@runtime_checkable
class TermChoice(Protocol):
    """What says beforehand which terms a scene needs, such as :class:`warprrf.Relevance`."""

    def options(self, frequency_hz: float) -> dict[str, Any]:
        """``line_of_sight``, ``diffuse``, ``lobes`` and :data:`TERMS` by name: False or a number where a term is ruled
        out or cut down, None where it is left to the fit."""


@dataclass(frozen=True)
class Selection:
    """How a fit decides about terms, on receivers that it holds out.

    Attributes:
        least_receivers: training receivers below which nothing is held out.
        least_held_out: receivers held out below which they choose no term: one alone likes what others do not.
        held_out: share of the receivers that are held out.
        most_held_out: receivers held out at most.
        few_receivers: up to which errors are learned from every receiver, held out in turn.
        most_to_choose: receivers that fits which only decide about a term learn from.
        short_steps: of such a fit.
        better: share to which a term must lower the held-out mean square error.
        much_better: share to which single bounces alone must lower the mean square error where receivers are few.
        even_better: share to which an indirect radiance must then lower it further.
        clearly_worse: share to which the residual may raise it: one that is learned from all receivers gains more.
        not_much_worse: share to which it may rise where fewer materials fit the training receivers better.
        few_materials: up to which light that is sent on follows the parameters of its group.
        regrouped: rounds of deciding what is of one material, and fitting.
        rounds: of further bounces and groups in turn in a first fit.
        unexplained: standard deviations beyond which a reading of a table is taken to be wrong: it is named, and left out.
        readings: pixels that groups are fitted to, spread over the training receivers.
        regrouping: what it takes to be of one material; None for :data:`BY_SHAPE` where only shapes tell groups apart.
    """

    least_receivers: int = 4
    least_held_out: int = 2
    held_out: float = 0.25
    most_held_out: int = 30
    few_receivers: int = 20
    most_to_choose: int = 24
    short_steps: int = 10
    better: float = 0.995
    much_better: float = 0.5
    even_better: float = 0.9
    clearly_worse: float = 1.05
    not_much_worse: float = 1.25
    few_materials: int = 30
    regrouped: int = 3
    rounds: int = 2
    unexplained: float = 5.0
    readings: int = 12_000
    regrouping: Regrouping | None = None


@checked
@dataclass(frozen=True)
class FitOptions:
    """Options of a bistatic fit; :meth:`BistaticField.fit` takes each of them as a keyword.

    A term given as None is kept only if it lowers the error on receivers held out of the data set (a quarter, 30 at
    most); with fewer than eight receivers, :data:`FEW` is modelled, or :data:`SINGLE` if it fits much better.

    Attributes:
        line_of_sight, diffuse: switches of those terms.
        mirror_order: mirror reflections on a path: 0 to 3; None also stops short of 3 where a search would be refused, and
            tries nothing for spectra of arrays: they hear the phases of all.
        lobes: exponents of the scattering lobes ((1 + cos psi) / 2)^n, 0 for Lambertian; None for 0, 2, 5, 12, 30.
        reciprocal: lobes that scatter alike when transmitter and receiver change places. By default they are those of
            Degli-Esposti et al. (2007), Sionna RT's, which do not.
        mirror_scatter: surfaces lit by mirrors.
        scatter_mirror: the lit scene seen in mirrors.
        diffuse_order: diffuse bounces on a path: 1, 2 or 3.
        indirect: a non-negative radiance of each group, constant in direction.
        residual: gains of what differs within a group.
        sub_pixels: square root of the rays per pixel (None: 3); 4 gives better delays of scattering, 2 takes half the
            time.
        quick: try no term: what is not given here is taken from :data:`QUICK`.
        gain_offset: fit one gain common to all paths, for a receiver that was not calibrated; see ``report``.
        iterations: most steps of the groups' fit.
        relevance: terms that it rules out are off, others stay free. Terms given here count for more.
        seed: of the choice of pixels and held-out receivers.
        selection: how terms are decided on.
        groups: how groups are fitted; ``indirect``, ``gain`` and ``steps`` are set by the fit.
        residuals: how the residual is fitted; None for the default, and fewer steps if ``quick``.
    """

    line_of_sight: bool = True
    diffuse: bool = True
    mirror_order: int | None = None
    lobes: tuple[int, ...] | None = None
    reciprocal: bool = False
    mirror_scatter: bool | None = None
    scatter_mirror: bool | None = None
    diffuse_order: int | None = None
    indirect: bool | None = None
    residual: bool | None = None
    sub_pixels: int | None = None
    quick: bool = False
    gain_offset: bool = False
    iterations: int = 40
    relevance: TermChoice | None = None
    seed: int = 0
    selection: Selection = Selection()
    groups: GroupFit = GroupFit()
    residuals: ResidualFit | None = None

    def __post_init__(self) -> None:
        check_count("iterations", self.iterations, 0)
        check_seed(self.seed)
        self.decided().terms()

    @classmethod
    def of(cls, options: FitOptions | None, settings: dict[str, Any]) -> FitOptions:
        """``options`` with ``settings`` by name.

        Raises:
            TypeError: for a name that is no option.
            ValueError: for a value out of range.
        """
        names = [f.name for f in fields(cls)]
        unknown = sorted(set(settings) - set(names))
        if unknown:
            raise TypeError(
                f"fit: got unknown option {', '.join(unknown)}, expected among {', '.join(names)}"
            )
        return replace(options or cls(), **settings)

    def decided(self, frequency_hz: float | None = None) -> FitOptions:
        """The same with what ``relevance`` and ``quick`` decide; the former at the carrier ``frequency_hz``."""
        found = self
        if self.relevance is not None and frequency_hz is not None:
            ruled = self.relevance.options(frequency_hz)
            both = {name: getattr(self, name) and ruled[name] for name in ("line_of_sight", "diffuse")}
            found = replace(found, **both, relevance=None, **found.given(ruled, (*TERMS, "lobes")))
        if self.quick:
            found = replace(found, quick=False, **found.given(QUICK, QUICK))
        return found

    def of_totals(self) -> FitOptions:
        """The same for power alone, which cannot tell bounces or materials apart: bounces as rooms have them, surfaces as
        they look, and mirrors that may be stronger than priors have it (metal) before a reading is taken for wrong."""
        groups = self.groups
        if groups == GroupFit():
            groups = replace(groups, huber_db=10.0, deviations=replace(groups.deviations, energy=1.0))
        selection = replace(self.selection, regrouped=0)
        return replace(self, groups=groups, selection=selection, **self.given(FEW, TERMS))

    def given(self, values: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
        """Of ``values`` those of ``names`` that are None here."""
        return {name: values[name] for name in names if getattr(self, name) is None}

    def unmeasured(self, frequency_hz: float) -> Terms:
        """What is modelled before any measurement: terms left free are those of :data:`FEW`."""
        found = self.decided(frequency_hz)
        return replace(found, **found.given(FEW, TERMS)).terms()

    def terms(self) -> Terms:
        """What is modelled, terms left to the fit as in single bounces.

        Raises:
            ValueError: naming an option out of range.
        """
        names = ("line_of_sight", "diffuse", "lobes", "reciprocal", "sub_pixels", *TERMS)
        return Terms(**{name: getattr(self, name) for name in names if getattr(self, name) is not None})


@dataclass(frozen=True)
class TrainingViews:
    """What is seen of the geometry at the places that were measured, whatever the materials: traced once, reused by every
    fit.

    Attributes:
        places: receivers under their transmitters.
        views: one for each place.
        seconds: what it took.
    """

    places: list[Place] = field(repr=False)
    views: list[ReceiverView] = field(repr=False)
    seconds: float

    @property
    def transport(self) -> Transport:
        """Surface, transmitter and grid of the first place."""
        return self.views[0].transport

    @property
    def surface(self) -> Surface:
        """Patches, groups, elements."""
        return self.transport.surface

    def subset(self, indices: Sequence[int] | np.ndarray) -> TrainingViews:
        """Some of its places."""
        chosen = [int(i) for i in indices]
        return replace(self, places=[self.places[i] for i in chosen], views=[self.views[i] for i in chosen])

    def check(self, places: Sequence[Place], sub_pixels: int | None) -> None:
        """Raise ValueError if they are not those of exactly ``places``."""
        same = len(self.places) == len(places) and all(
            a.seen_from == b.seen_from for a, b in zip(self.places, places, strict=True)
        )
        if not same or sub_pixels not in (None, self.transport.grid.sub_pixels):
            raise ValueError(
                f"transport: got what {len(self.views)} receivers see with {self.transport.grid.sub_pixels**2} rays a "
                f"pixel; expected exactly the {len(places)} receivers, transmitter, carrier, grid, beam, air and rays of "
                "this fit"
            )


def trace(
    geometry: GeometryLike,
    ds: Data,
    *,
    mirror_order: int | None = None,
    sub_pixels: int | None = None,
    client: Any = None,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> TrainingViews:
    """What the receivers of ``ds`` see of ``geometry`` (a Reconstruction, Scene, Mesh or Surface).

    Args:
        mirror_order: most mirror reflections on a path; 3 by default, or as many as can be searched (2 in a city).
        sub_pixels: square root of the rays per pixel; 3 by default.
        client: a ``dask.distributed.Client`` whose workers trace, to the same bits; this process by default.
        device: where rays are cast.
        progress: called with the stages ``"patches"``, ``"mirrors"`` and ``"transport"``.

    Raises:
        ValueError: for receivers on a surface or outside the scene, numbers out of range, or more rays or chains of
            mirrors than :data:`MOST_RAYS` and :data:`~warprrf.rf.paths.images.MOST_CHAINS`.
        TypeError: for a geometry without a mesh.
    """
    started, tell = time.perf_counter(), progress or _silent
    places = places_of(as_list(ds), as_mesh(geometry, "geometry"), device)
    terms = Terms(
        mirror_order=3 if mirror_order is None else mirror_order,
        sub_pixels=Terms().sub_pixels if sub_pixels is None else sub_pixels,
    )
    _check_rays(places, terms.sub_pixels)
    tell("patches", 0, 1)
    surface = Surface.of(geometry)
    tell("patches", 1, 1)
    together: dict[tuple[object, ...], list[int]] = {}  # places under one transmitter
    for k, place in enumerate(places):
        together.setdefault((place.transmitter.tobytes(), *place.seen_from[2:]), []).append(k)
    views: dict[int, ReceiverView] = {}
    for own in together.values():
        first = places[own[0]]
        loss_per_m = 0.0 if first.air is None else first.air.loss_per_m(first.frequency_hz)
        transport = Transport.of(
            surface, first.transmitter, first.frequency_hz, first.shape, terms.sub_pixels,
            beam_sigma_rad=first.beam_sigma_rad, loss_per_m=loss_per_m, device=device,
        )  # fmt: skip
        receivers = np.stack([places[k].receiver for k in own])
        if mirror_order is None:
            most = transport.images.affordable(receivers, terms.mirror_order)
            terms = replace(terms, mirror_order=most)
        found = transport.paths(receivers, terms.mirror_order, progress)
        parts = [(receivers[r], found.subset(np.flatnonzero(found.receiver == r))) for r in range(len(own))]
        for r, view in each(partial(traced, transport.recipe, terms), parts, client):
            views[own[r]] = transport.adopt(view)
            tell("transport", len(views), len(places))
    return TrainingViews(places, [views[k] for k in range(len(places))], time.perf_counter() - started)


def _check_rays(places: Sequence[Place], sub_pixels: int) -> None:
    """Refuse places whose rays would not fit into memory."""
    rays = sum(place.shape[0] * place.shape[1] for place in places) * sub_pixels**2
    if rays > MOST_RAYS:
        raise ValueError(
            f"ds: {len(places)} spectra of {places[0].shape[0]} x {places[0].shape[1]} pixels take {rays:.2g} rays, "
            f"{rays * RAY_BYTES / 1e9:.0f} GB and more, expected at most {MOST_RAYS:.2g}: give fewer receivers (ds.split, "
            "ds.subset) or sub_pixels=1"
        )


def _silent(stage: str, done: int, total: int) -> None:
    """No progress is asked for."""


@dataclass(frozen=True)
class Trained:
    """Result of :func:`train`: materials of a field, the material of each group ``(G,)``, its errors, and a report."""

    surface: Surface
    materials: Materials
    material: np.ndarray
    errors: ErrorModel | None
    report: dict[str, Any]


def train(
    geometry: GeometryLike,
    ds: Data,
    options: FitOptions,
    *,
    transport: TrainingViews | None = None,
    client: Any = None,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> Trained:
    """Fit materials to what ``ds`` holds; arguments and errors as for :meth:`BistaticField.fit`."""
    data = as_list(ds)
    o = options.decided(Frame.of(data).frequency_hz)
    if transport is not None and options.sub_pixels is None:
        o = replace(o, sub_pixels=None)  # it is what the rays were traced with, quick or not
    for one in data:
        if isinstance(one, SpectrumDataset) and len(one) and not (one.path_gain > one.floor).any():
            raise ValueError("ds: got no pixel above the floor, expected spectra with power to fit to")
    if transport is not None:
        places = places_of(data, as_mesh(geometry, "geometry"), device)
        transport.check(places, o.sub_pixels)
        # Places of a part of what was traced say where in the whole their readings are.
        transport = replace(transport, places=places)
    seen = transport or trace(
        geometry, data, mirror_order=o.mirror_order, sub_pixels=o.sub_pixels, client=client, device=device,
        progress=progress,
    )  # fmt: skip
    o = replace(o, sub_pixels=seen.transport.grid.sub_pixels)
    if all(isinstance(one, Readings) and one.total for one in data):
        o = o.of_totals()
    if o.mirror_order is None and any(isinstance(one, ArraySpectra) for one in data):
        o = replace(o, mirror_order=max(int(view.paths.order.max(initial=0)) for view in seen.views))
    if o.residuals is None:
        o = replace(o, residuals=QUICK_RESIDUAL if options.quick else ResidualFit())
    # The fit's matrices are small: threads of BLAS would spend more time waiting for each other than they save.
    with threadpool_limits(1, user_api="blas"):
        data, zeros = with_azimuths(data, seen.places, seen.views)
        training = _Training(seen, data, o, progress)
        found = training.run()
        offsets = training.offsets(found.materials)
        if offsets:
            data = [
                moved(one, offsets[k]) if isinstance(one, Readings) and k in offsets else one
                for k, one in enumerate(data)
            ]
            seen = trace(
                geometry, data, mirror_order=o.mirror_order, sub_pixels=o.sub_pixels, client=client, device=device,
                progress=progress,
            )  # fmt: skip
            found = _Training(seen, data, o, progress).run()
    _warn_of_left_out(data, found.report["unexplained"])
    names = training.names
    told = {
        names[k]: [(place.receiver.tolist(), offset.tolist()) for place, offset in own]
        for k, own in offsets.items()
    }
    return replace(found, report=found.report | {"azimuth_zero_deg": zeros, "position_offset_m": told})


def _warn_of_left_out(data: Sequence[Measured], unexplained: dict[str, list[int]]) -> None:
    if unexplained:
        count = sum(len(one) for one in data if isinstance(one, Readings))
        told = "; ".join(
            f"{len(rows)} of {name!r}, rows {some_of(rows)}" for name, rows in unexplained.items()
        )
        warnings.warn(
            f"ds: {sum(map(len, unexplained.values()))} of {count} readings are taken for wrong and left out ({told}): "
            'report["unexplained"] lists them',
            UserWarning,
            stacklevel=users_level(),
        )


def _line_of_sight_share(response: Response, p: Parameters) -> np.ndarray:
    """Share of readings (N,) that comes straight from the transmitter."""
    direct = (response.path_group < 0).all(axis=1)
    power = response.path_power[direct] @ response.path[direct]
    return np.asarray(power / np.maximum(predict(response, p), np.maximum(power, 1e-300)))


Lit = Callable[[int], tuple[Materials, np.ndarray | None]]
"""From a place to the materials at its carrier, and what elements send on under its transmitter."""


@dataclass(frozen=True)
class _Candidate:
    """Terms with their fit, and the held-out mean square error [dB^2]."""

    terms: Terms
    fit: Fitted
    error: float


class _Training:
    """One fit: the state that its steps share."""

    def __init__(
        self,
        seen: TrainingViews,
        data: Sequence[Measured],
        options: FitOptions,
        progress: Progress | None,
    ) -> None:
        self.seen, self.data, self.options, self.choose = seen, data, options, options.selection
        self.started = time.perf_counter()
        self.surface, self.count, self.views = seen.surface, len(seen.places), list(seen.views)
        self.frequency_hz = Frame.of(data).frequency_hz
        self.area = np.bincount(self.surface.group, self.surface.mesh.areas, minlength=self.surface.groups)
        self.material = self.surface.material
        self.observed, self.chains = observe(data, seen.places, self.views, options.groups.noise_db)
        sources = {place.transmitter.tobytes() for place in seen.places}
        # Light that surfaces send on falls elsewhere under each transmitter: of several, no gains of it are learned.
        self.transmitter = seen.places[0].transmitter if len(sources) == 1 else np.full(3, np.nan)
        rng = np.random.default_rng(options.seed)
        self.held = np.zeros(0, int)
        chain = np.array([o.chain for o in self.observed])
        # One place of each chain is never held out: without any its gain would not be known.
        self.kept_always = [int(np.argmax(chain == k)) for k in range(len(self.chains))]
        if self.count >= self.choose.least_receivers:
            held = min(int(self.count * self.choose.held_out), self.choose.most_held_out)
            order = rng.permutation(self.count)
            self.held = np.sort(order[~np.isin(order, self.kept_always)][:held])
        self.kept = np.setdiff1d(np.arange(self.count), self.held)
        self.progress: Progress = progress or _silent
        self.behind, self.steps = 0, self._planned() if len(self.held) else 1
        self.names = [getattr(one, "name", "") for one in data]
        self.measured, self.readings, self.chosen = [], [], []
        start = Parameters.prior(self.surface.groups, len(options.terms().lobes))
        terms, most = options.terms(), max(200, self.choose.readings // self.count)
        for r, observed in enumerate(self.observed):
            target = observed.target
            known = np.arange(len(target.db)) if target.trust is None else np.flatnonzero(target.trust)
            chosen = known[np.sort(rng.choice(len(known), min(len(known), most), replace=False))]
            self.chosen.append(chosen)
            self.measured.append(observed.measured.part(chosen))
            response = respond(self.views[r], self.measured[r], terms, observed.floor)
            part = target.part(chosen)
            one = data[observed.place.data]
            if isinstance(one, Readings) and not one.total:
                part = part.trusted(1.0 + KNOWN_BETTER * _line_of_sight_share(response, start))
            ratio = float(observed.place.frequency_hz / self.frequency_hz)
            self.readings.append(Reading(response, part, observed.chain, ratio))
            self.progress("fit", r, (1 + self.steps) * self.count)
        self.log: list[dict[str, Any]] = []

    def run(self) -> Trained:
        """Choose terms where some are free, fit to all receivers, and report."""
        terms, errors = self.options.terms(), None
        start = Parameters.prior(int(self.material.max()) + 1, len(terms.lobes))
        free = any(getattr(self.options, name) is None for name in TERMS)
        if len(self.held) >= (self.choose.least_held_out if free else 1):
            first = self._fit_groups(terms, start, self._few(1), self.choose.short_steps * 2)
            best = self._choose(_Candidate(terms, first, self._held_error(terms, first)))
        else:
            best = self._choose_of_few()
        terms, start = best.terms, best.fit.parameters
        if len(self.held):
            residual, errors = self._held_in_turn(best)
            terms = replace(terms, residual=residual)
        fit, materials = self._fit_everyone(terms, start)
        wrong = self._unexplained(materials)
        if any(len(rows) for rows in wrong):
            self._leave_out(wrong)
            fit, materials = self._fit_everyone(terms, fit.parameters)
        if errors is not None:
            errors = replace(errors, covariance=self._covariance(fit))
        total = (1 + self.steps) * self.count
        self.progress("fit", total, total)
        return Trained(self.surface, materials, self.material, errors, self._report(fit, wrong))

    def _fit_everyone(self, terms: Terms, start: Parameters) -> tuple[Fitted, Materials]:
        """The chosen terms, fitted to all receivers; light that goes on is settled: one round."""
        everyone = np.arange(self.count)
        fit = self._fit_groups(terms, start, everyone, self.options.iterations, rounds=1)
        materials = self._materials(terms, fit)
        if terms.residual:
            materials = replace(materials, residual=self._residual(materials, everyone))
        return fit, materials

    def _planned(self) -> int:
        """Most fits of groups and residuals, each of which is a step of the progress that is told."""
        o, folds = self.options, len(self._folds()) - 1
        free = [name for name, _ in MORE if getattr(o, name) is None]
        residual = int(o.residual is not False)
        return (
            3 + len(free) + self.choose.regrouped + int(o.indirect is None) + folds + (folds + 2) * residual
        )

    def _stepped(self) -> None:
        """Tell that one more fit is behind."""
        self.behind += 1
        self.progress("fit", (1 + min(self.behind, self.steps)) * self.count, (1 + self.steps) * self.count)

    def _unexplained(self, materials: Materials) -> list[np.ndarray]:
        """Of each place the readings of tables that the fit misses by more than :attr:`Selection.unexplained` of their
        standard deviations. What it misses the others by, in the median, is the noise of their table."""
        lit, sd, found = self._lit(materials), self.options.groups.noise_db, []
        left: dict[str, list[float]] = {}
        for k, observed in enumerate(self.observed):
            rows, target = np.zeros(0, int), observed.target
            trust, censored = target.trust, target.censored
            if isinstance(observed.measured, WeighedPaths) and trust is not None and censored is not None:
                error = target.error(self._predicted(lit, k))
                rows = np.flatnonzero(np.abs(error) > self.choose.unexplained * sd)
                clear = ~censored & (target.db > CLEAR_DB)
                left.setdefault(self.names[observed.place.data], []).extend((error / trust)[clear])
            found.append(rows)
        self.noise = {
            name: NORMAL_MEDIAN * float(np.median(np.abs(errors))) for name, errors in left.items() if errors
        }
        return found

    def offsets(self, materials: Materials) -> dict[int, list[tuple[Place, np.ndarray]]]:
        """By data set of unknown positions its places, and how far each receiver is from where it is said to be [m]."""
        lit = self._lit(materials)
        found: dict[int, list[tuple[Place, np.ndarray]]] = {}
        for k, observed in enumerate(self.observed):
            one, place = self.data[observed.place.data], observed.place
            if not isinstance(one, Readings) or one.position_std_m == 0:
                continue
            (here, sent), view = lit(k), self._view(k, materials.terms)
            powers = path_powers(view, here, sent)
            total = np.maximum(read(view, observed.measured, powers), 0.0) / observed.floor
            direct = powers.mirror / observed.floor
            gain = gain_of(observed.chain, here.parameters, observed.target, total)
            other = np.maximum(total - direct @ observed.measured.of_paths(view), 0.0)
            offset = position_offset(
                one, place, view, observed.target, gain * other, gain * direct, self.options.groups
            )
            found.setdefault(place.data, []).append((place, offset))
        return found

    def _leave_out(self, wrong: Sequence[np.ndarray]) -> None:
        """Readings that count no longer."""
        for k, rows in enumerate(wrong):
            if len(rows) == 0:
                continue
            observed, reading = self.observed[k], self.readings[k]
            left = ~np.isin(np.arange(len(observed.target.db)), rows)
            self.observed[k] = replace(observed, target=observed.target.trusted(left))
            chosen = self.chosen[k]
            self.readings[k] = replace(reading, target=reading.target.trusted(left[chosen]))

    def _report(self, fit: Fitted, wrong: Sequence[np.ndarray]) -> dict[str, Any]:
        report: dict[str, Any] = {
            "receivers": self.count,
            "held_out": len(self.held),
            "transport_time_s": self.seen.seconds,
            "fit_time_s": time.perf_counter() - self.started,
            "groups": self.surface.groups,
            "materials": int(self.material.max()) + 1,
            "elements": len(self.surface.element_area),
            "steps": fit.steps,
            "losses": {"gain": fit.losses},
            "choices": self.log,
        }
        if self.options.gain_offset:
            report["gain_offset_db"] = NEPER * fit.parameters.log_gain
            place = len(fit.covariance) - len(self.chains) - 1
            report["gain_offset_std_db"] = NEPER * float(np.sqrt(fit.covariance[place, place]))
        variance = np.diag(fit.covariance)[len(fit.covariance) - len(self.chains) :]
        report["chains"] = {
            name: {"gain_db": NEPER * float(gain), "std_db": NEPER * float(np.sqrt(v))}
            for name, gain, v in zip(self.chains, fit.parameters.log_gains, variance, strict=True)
        }
        report["noise_db"] = self.noise
        report["unexplained"] = {}
        for observed, rows in zip(self.observed, wrong, strict=True):
            if len(rows):
                listed = report["unexplained"].setdefault(self.names[observed.place.data], [])
                listed += observed.place.rows[rows].tolist()
        return report

    # ------------------------------------------------------------------------------------------ choosing

    def _few(self, times: int) -> np.ndarray:
        """Receivers that fits which only decide about a term learn from, those of every chain among them."""
        others = np.setdiff1d(self.kept, self.kept_always)
        more = max(times * self.choose.most_to_choose - len(self.kept_always), 0)
        return np.union1d(self.kept_always, others[:more]).astype(int)

    def _note(self, term: str, kept: bool, error: float) -> None:
        self.log.append({"term": term, "kept": bool(kept), "held_out_rmse_db": float(np.sqrt(error))})

    def _choose_of_few(self) -> _Candidate:
        """With too few receivers to choose by those held out: further bounces as rooms have them, unless none fit much
        better."""

        def tried(given: dict[str, Any]) -> _Candidate:
            terms = replace(self.options, **self.options.given(given, TERMS)).terms()
            start = Parameters.prior(int(self.material.max()) + 1, len(terms.lobes))
            fit = self._fit_groups(terms, start, self.kept, self.options.iterations)
            bare = self._materials(replace(terms, residual=False), fit)
            return _Candidate(terms, fit, self._image_error(bare, np.arange(self.count)))

        further, best = tried(FEW), tried(SINGLE)
        fewer = best.error < self.choose.much_better * further.error
        self._note("further bounces", not fewer, further.error)
        self._note("single bounces", fewer, best.error)
        if not fewer:
            return further
        if self.options.indirect is None and best.terms.diffuse:
            even = tried(SINGLE | {"indirect": True})
            kept = even.error < self.choose.even_better * best.error
            self._note("indirect", kept, even.error)
            best = even if kept else best
        return best

    def _choose(self, best: _Candidate) -> _Candidate:
        """Terms that lower the held-out error, one after another, each with a short fit of its own."""
        free = {name for name in TERMS if getattr(self.options, name) is None}
        self._note("single bounces", True, best.error)
        for name, value in MORE:
            terms = best.terms
            if name not in free or not (terms.diffuse or name == "mirror_order"):
                continue
            if "order" in name and getattr(terms, name) < value - 1:
                continue  # the order below it did not help
            if name == "scatter_mirror" and not (terms.further or terms.mirror_scatter):
                continue  # the same bounces the other way round
            best = self._tried(name, value, best)
        if np.isfinite(self.surface.look).all() and self.material.max() > 0:
            best = self._regroup(best)
        # Last, because it would stand in for whatever a wrong material leaves dark.
        if "indirect" in free and best.terms.diffuse:
            best = self._tried("indirect", True, best)
        return best

    def _tried(self, name: str, value: Any, best: _Candidate) -> _Candidate:
        """The candidate with one term more, if its error is lower; else as it was."""
        trial = replace(best.terms, **{name: value})
        found = self._fit_groups(trial, best.fit.parameters, self._few(1), self.choose.short_steps, rounds=1)
        error = self._held_error(trial, found)
        keep = error < self.choose.better * best.error
        self._note(name if value is True else f"{name} {value}", keep, error)
        return _Candidate(trial, found, error) if keep else best

    def _regroup(self, best: _Candidate) -> _Candidate:
        """Materials by what the spectra say, if that lowers the held-out error."""
        before, terms, trial = self.material, best.terms, best.fit
        options = self.choose.regrouping or (BY_SHAPE if self.surface.by_shape else Regrouping())
        for _ in range(self.choose.regrouped):
            readings = self._readings(terms, trial, self._few(2), follow=True)
            self.material, start = regroup(
                readings,
                trial.parameters,
                self.material,
                self.surface.look,
                self.area,
                options,
            )
            # What surfaces get of each other changes little with who is of which material: the same readings serve.
            trial = self._fitted(readings, terms, start, self.choose.short_steps)
        error = self._held_error(terms, trial)
        # Few receivers held out say little, fewer materials that describe the others better say much.
        same = len(self.kept) <= self.choose.most_to_choose  # receivers of both fits
        simpler = same and trial.losses[-1:] < best.fit.losses[-1:]
        keep = error < best.error or (simpler and error < self.choose.not_much_worse * best.error)
        self._note(f"{before.max() + 1} materials as {self.material.max() + 1}", keep, error)
        if not keep:
            self.material = before
            return best
        return _Candidate(terms, trial, error)

    def _held_error(self, terms: Terms, fit: Fitted) -> float:
        """Mean square error of the held-out receivers without residual [dB^2]: of whole images where they are few,
        else at the chosen pixels."""
        if len(self.held) <= self.choose.least_receivers:
            return self._image_error(self._materials(replace(terms, residual=False), fit), self.held)
        readings = self._readings(terms, fit, self.held, follow=False)
        errors = [r.tied(self.material).error_db(fit.parameters) for r in readings]
        return float(
            np.mean(np.concatenate([self._losses(r, e) for r, e in zip(self.held, errors, strict=True)]))
        )

    def _image_error(self, materials: Materials, places: np.ndarray) -> float:
        """Mean loss of all readings of ``places`` [dB^2]."""
        lit = self._lit(materials)
        errors = [self.observed[r].target.error(self._predicted(lit, r)) for r in places]
        return float(np.mean([self._losses(r, e).mean() for r, e in zip(places, errors, strict=True)]))

    def _losses(self, place: int, error: np.ndarray) -> np.ndarray:
        """Squares of errors (N,) at a place [dB^2]; of tables robust ones: some readings may be wrong."""
        if isinstance(self.observed[place].measured, SpectrumPixels):
            return error**2
        return huber(error, self.options.groups.huber_db)[0]

    def _predicted(self, lit: Lit, place: int) -> np.ndarray:
        """All that is read at a place under what :meth:`_lit` gave, in units of its floor, shape ``(N,)``."""
        observed = self.observed[place]
        materials, sent = lit(place)
        view = self._view(place, materials.terms)
        power = read(view, observed.measured, path_powers(view, materials, sent))
        power = np.maximum(power, 0.0) / observed.floor
        return np.asarray(gain_of(observed.chain, materials.parameters, observed.target, power) * power)

    def _lit(self, materials: Materials) -> Lit:
        """Materials at the carrier of a place, and what elements send on under its transmitter; computed once for each."""
        known: dict[int, tuple[Materials, np.ndarray | None]] = {}

        def of(place: int) -> tuple[Materials, np.ndarray | None]:
            transport = self.views[place].transport
            if id(transport) not in known:
                parameters = materials.parameters.at_ratio(self.readings[place].ratio)
                here = replace(materials, parameters=parameters)
                known[id(transport)] = here, sent_radiance(transport, here)
            return known[id(transport)]

        return of

    def _held_in_turn(self, best: _Candidate) -> tuple[bool, ErrorModel | None]:
        """Whether the residual is wanted, or does not clearly raise the held-out error, and the errors that then remain:
        of the receivers held out; where they are few, of all, held out in turn. No errors where no whole spectra were
        measured."""
        wanted, places = self.options.residual, np.stack([o.place.receiver for o in self.observed])
        power: dict[bool, list[np.ndarray]] = {one: [] for one in (False, True) if wanted in (None, one)}
        order: list[int] = []
        gaps = []
        for held in self._folds():
            kept = np.setdiff1d(np.arange(self.count), held)
            fit = best.fit
            if held is not self.held:
                fit = self._fit_groups(best.terms, fit.parameters, kept, self.choose.short_steps, rounds=1)
            order += held.tolist()
            gaps += [np.linalg.norm(places[kept] - places[r], axis=1).min() for r in held]
            bare = self._materials(replace(best.terms, residual=False), fit)
            for residual, found in power.items():
                materials = bare
                if residual:
                    terms = replace(best.terms, residual=True)
                    materials = replace(bare, terms=terms, residual=self._residual(bare, kept))
                lit = self._lit(materials)
                found += [self._predicted(lit, r) for r in held]
        errors = {
            one: [self.observed[r].target.error(x) for r, x in zip(order, found, strict=True)]
            for one, found in power.items()
        }
        loss = {
            one: float(np.mean([self._losses(r, e).mean() for r, e in zip(order, own, strict=True)]))
            for one, own in errors.items()
        }
        keep = wanted if wanted is not None else loss[True] < self.choose.clearly_worse * loss[False]
        for one, error in loss.items():
            self._note("residual" if one else "no residual", one == keep, error)
        if not all(isinstance(o.measured, SpectrumPixels) and o.target.trust is None for o in self.observed):
            return keep, None
        shapes = [self.observed[r].place.shape for r in order]
        images = [(NEPER * np.log1p(x)).reshape(shape) for x, shape in zip(power[keep], shapes, strict=True)]
        missed = [e.reshape(shape) for e, shape in zip(errors[keep], shapes, strict=True)]
        return keep, learn_errors(images, missed, np.array(gaps), places, self._covariance(best.fit))

    def _covariance(self, fit: Fitted) -> np.ndarray:
        """Of what a field keeps: without the gains of chains."""
        kept = len(fit.covariance) - len(fit.parameters.log_gains)
        return fit.covariance[:kept, :kept]

    def _folds(self) -> list[np.ndarray]:
        """Receivers that are held out in turn to learn errors."""
        folds = [self.held]
        if self.count <= self.choose.few_receivers:
            others = np.setdiff1d(self.kept, self.kept_always)
            folds += np.array_split(others, max(len(others) // max(len(self.held), 2), 2))
        return folds

    # ------------------------------------------------------------------------------------------ fitting

    def _fit_groups(
        self, terms: Terms, start: Parameters, chosen: np.ndarray, steps: int, rounds: int | None = None
    ) -> Fitted:
        """Materials' parameters on the receivers ``chosen``, further bounces recomputed in each of ``rounds``."""
        rounds = self.choose.rounds if rounds is None else rounds
        if not terms.after_first_bounce:
            rounds = 1
        fit = Fitted(start, np.zeros((0, 0)), [], 0)
        for _ in range(rounds):
            follow = bool(self.material.max() < self.choose.few_materials)
            readings = self._readings(terms, fit, chosen, follow=follow)
            each = max(steps // rounds, 1) if terms.after_first_bounce else steps
            fit = self._fitted(readings, terms, fit.parameters, each)
        return fit

    def _fitted(self, readings: list[Reading], terms: Terms, start: Parameters, steps: int) -> Fitted:
        """Materials' parameters on readings by groups."""
        options = replace(
            self.options.groups, indirect=terms.indirect, gain=self.options.gain_offset, steps=steps
        )
        tied = [r.tied(self.material) for r in readings]
        fit = fit_groups(tied, start, np.bincount(self.material, self.area), options)
        self._stepped()
        return fit

    def _readings(self, terms: Terms, fit: Fitted, chosen: np.ndarray, *, follow: bool) -> list[Reading]:
        """Readings of the receivers ``chosen`` by groups, under ``terms``; light that reaches surfaces from others held
        fixed. ``follow``: what they send on of it follows their parameters (which costs columns)."""
        limited = [
            replace(self.readings[r], response=self.readings[r].response.limited(terms)) for r in chosen
        ]
        if not terms.after_first_bounce:
            return limited
        # Radiance of the groups themselves is fitted, so it is left out of what is fixed.
        lit = self._lit(self._materials(replace(terms, indirect=False, residual=False), fit))
        return [
            replace(
                reading,
                response=with_further_bounces(
                    reading.response,
                    self._view(r, terms),
                    self.measured[r],
                    *lit(r),
                    self.observed[r].floor,
                    follow=follow,
                ),
            )
            for reading, r in zip(limited, chosen, strict=True)
        ]

    def _view(self, receiver: int, terms: Terms) -> ReceiverView:
        """What a training receiver sees, as far as ``terms`` want it; kept for the next time."""
        self.views[receiver] = self.views[receiver].transport.complete(self.views[receiver], terms)
        return self.views[receiver]

    def _residual(self, materials: Materials, chosen: np.ndarray) -> np.ndarray:
        """Gains of surface cells over ``materials``, shape ``(2, X)``."""
        lit = self._lit(materials)
        shares = []
        for r in chosen:
            view, observed, (here, sent) = self._view(r, materials.terms), self.observed[r], lit(r)
            power = np.zeros(0)
            if observed.chain == OWN_GAIN:
                power = read(view, observed.measured, path_powers(view, here, sent)) / observed.floor
            gain = gain_of(observed.chain, here.parameters, observed.target, power)
            shares.append(
                shares_of(view, here, sent, observed.measured, observed.floor / gain, observed.target)
            )
        found = fit_residual(shares, self.surface, self.options.residuals)
        self._stepped()
        return found

    def _materials(self, terms: Terms, fit: Fitted) -> Materials:
        """What ``fit`` found, by groups, without a residual."""
        none = np.zeros((2, self.surface.cells))
        return Materials(terms, fit.parameters.take(self.material), none, self.transmitter)
