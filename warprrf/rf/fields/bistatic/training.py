"""Fitting a bistatic field: trace once, choose terms on held-out receivers, fit groups, elements, then the errors."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from threadpoolctl import threadpool_limits

from warprrf.checks import check_array, check_count, check_seed, checked
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import GeometryLike, as_mesh
from warprrf.rf.em.absorption import Air
from warprrf.rf.fields.bistatic.fit import Fitted, GroupFit, Reading, fit_groups
from warprrf.rf.fields.bistatic.grouping import BY_SHAPE, Regrouping, regroup
from warprrf.rf.fields.bistatic.materials import Materials, Parameters
from warprrf.rf.fields.bistatic.render import render, sent_radiance
from warprrf.rf.fields.bistatic.residuals import QUICK as QUICK_RESIDUAL
from warprrf.rf.fields.bistatic.residuals import ResidualFit, fit_residual, shares_of
from warprrf.rf.fields.bistatic.response import SpectrumPixels, respond, with_further_bounces
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.terms import Terms
from warprrf.rf.fields.bistatic.transport import ReceiverView, Transport
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel, learn_errors
from warprrf.rf.positions import check_dataset
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import to_db

MORE: tuple[tuple[str, Any], ...] = (
    ("mirror_scatter", True),
    ("diffuse_order", 2),
    ("diffuse_order", 3),
    ("mirror_order", 2),
    ("mirror_order", 3),
    ("scatter_mirror", True),
)
"""Bounces that may be added to single ones, in the order in which they are tried."""
QUICK: dict[str, Any] = {
    "mirror_order": 1, "mirror_scatter": False, "scatter_mirror": False, "diffuse_order": 1, "indirect": True,
    "residual": True, "sub_pixels": 1,
}  # fmt: skip
"""What a quick fit takes for given: light of more than one bounce is even but for the residual, one ray a pixel."""
TERMS = ("mirror_order", "mirror_scatter", "scatter_mirror", "diffuse_order", "indirect", "residual")
"""Terms that a fit decides on where they are None."""
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
        least_receivers: training receivers below which nothing is held out, so no term is chosen.
        held_out: share of the receivers that are held out.
        most_held_out: receivers held out at most.
        few_receivers: up to which errors are learned from every receiver, held out in turn.
        most_to_choose: receivers that fits which only decide about a term learn from.
        short_steps: of such a fit.
        better: share to which a term must lower the held-out mean square error.
        clearly_better: and the residual: it has thousands of unknowns and blurs the strongest paths.
        not_much_worse: share to which it may rise where fewer materials fit the training receivers better.
        few_materials: up to which light that is sent on follows the parameters of its group.
        regrouped: rounds of deciding what is of one material, and fitting.
        rounds: of further bounces and groups in turn, where no choice came before.
        readings: pixels that groups are fitted to, spread over the training receivers.
        regrouping: what it takes to be of one material; None for :data:`BY_SHAPE` where only shapes tell groups apart.
    """

    least_receivers: int = 4
    held_out: float = 0.25
    most_held_out: int = 10
    few_receivers: int = 20
    most_to_choose: int = 12
    short_steps: int = 10
    better: float = 0.995
    clearly_better: float = 0.95
    not_much_worse: float = 1.5
    few_materials: int = 30
    regrouped: int = 3
    rounds: int = 2
    readings: int = 12_000
    regrouping: Regrouping | None = None


@checked
@dataclass(frozen=True)
class FitOptions:
    """Options of a bistatic fit; :meth:`BistaticField.fit` takes each of them as a keyword.

    A term given as None is kept only if it lowers the error on receivers held out of the data set (a quarter, ten at
    most); with fewer than four receivers nothing is held out and only single bounces are modelled.

    Attributes:
        line_of_sight, diffuse: switches of those terms.
        mirror_order: mirror reflections on a path: 0 to 3; None also stops short of 3 where a search would be refused.
        lobes: exponents of the scattering lobes ((1 + cos psi) / 2)^n, 0 for Lambertian; None for 0, 2, 5, 12, 30.
        reciprocal: lobes that scatter alike when transmitter and receiver change places. By default they are those of
            Degli-Esposti et al. (2007), Sionna RT's, which do not.
        mirror_scatter: surfaces lit by mirrors.
        scatter_mirror: the lit scene seen in mirrors.
        diffuse_order: diffuse bounces on a path: 1, 2 or 3.
        indirect: a non-negative radiance of each group, constant in direction.
        residual: gains of what differs within a group.
        sub_pixels: square root of the rays per pixel (None: 3; in the lobby 4 has the same image error and puts the
            delay of scattering right to 0.02 instead of 0.06 ns, 2 costs 0.2 dB of PSNR and halves the time).
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
            found = replace(found, **both, relevance=None, **found._given(ruled, (*TERMS, "lobes")))
        if self.quick:
            found = replace(found, quick=False, **found._given(QUICK, QUICK))
        return found

    def _given(self, values: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
        """Of ``values`` those of ``names`` that are None here."""
        return {name: values[name] for name in names if getattr(self, name) is None}

    def terms(self) -> Terms:
        """What is modelled, terms left to the fit as in single bounces.

        Raises:
            ValueError: naming an option out of range.
        """
        names = ("line_of_sight", "diffuse", "lobes", "reciprocal", "sub_pixels", *TERMS)
        return Terms(**{name: getattr(self, name) for name in names if getattr(self, name) is not None})


@dataclass(frozen=True)
class TrainingViews:
    """What training receivers see of the geometry, whatever the materials: traced once, reused by every fit.

    Attributes:
        transport: surface, transmitter and grid.
        views: one for each receiver.
        frequency_hz, air: what it was traced for.
        seconds: what it took.
    """

    transport: Transport
    views: list[ReceiverView] = field(repr=False)
    frequency_hz: float
    air: Air | None
    seconds: float

    @property
    def surface(self) -> Surface:
        """Patches, groups, elements."""
        return self.transport.surface

    def subset(self, indices: Sequence[int] | np.ndarray) -> TrainingViews:
        """Some of its receivers."""
        return replace(self, views=[self.views[int(i)] for i in indices])

    def check(self, ds: SpectrumDataset, sub_pixels: int | None) -> None:
        """Raise ValueError if they are not those of exactly the receivers of ``ds``."""
        t = self.transport
        same = (
            len(self.views) == len(ds.receivers)
            and t.grid.shape == tuple(ds.path_gain.shape[1:])
            and all(np.array_equal(v.receivers[0], r) for v, r in zip(self.views, ds.receivers, strict=True))
            and np.array_equal(t.transmitter, ds.transmitter)
            and self.frequency_hz == ds.frequency_hz
            and t.beam_sigma_rad == ds.beam_sigma_rad
            and self.air == getattr(ds, "air", None)
            and sub_pixels in (None, t.grid.sub_pixels)
        )
        if not same:
            raise ValueError(
                f"transport: got what {len(self.views)} receivers see with {t.grid.sub_pixels**2} rays a pixel; expected "
                f"exactly the {len(ds.receivers)} receivers, transmitter, carrier, grid, beam, air and rays of this fit"
            )


def trace(
    geometry: GeometryLike,
    ds: SpectrumDataset,
    *,
    mirror_order: int | None = None,
    sub_pixels: int | None = None,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> TrainingViews:
    """What the receivers of ``ds`` see of ``geometry`` (a Reconstruction, Scene, Mesh or Surface).

    Args:
        mirror_order: most mirror reflections on a path; 3 by default, or as many as can be searched (2 in a city).
        sub_pixels: square root of the rays per pixel; 3 by default.
        device: where rays are cast.
        progress: called with the stages ``"patches"``, ``"mirrors"`` and ``"transport"``.

    Raises:
        ValueError: for receivers on a surface or outside the scene, numbers out of range, or more rays or chains of
            mirrors than :data:`MOST_RAYS` and :data:`~warprrf.rf.paths.images.MOST_CHAINS`.
        TypeError: for a geometry without a mesh.
    """
    started, tell = time.perf_counter(), progress or _silent
    receivers, transmitter = check_dataset(as_mesh(geometry, "geometry"), ds, device=device)
    terms = Terms(
        mirror_order=3 if mirror_order is None else mirror_order,
        sub_pixels=Terms().sub_pixels if sub_pixels is None else sub_pixels,
    )
    _check_rays(ds.path_gain.shape, terms.sub_pixels)
    tell("patches", 0, 1)
    surface = Surface.of(geometry)
    tell("patches", 1, 1)
    frequency_hz, air = float(ds.frequency_hz), getattr(ds, "air", None)
    transport = Transport.of(
        surface, transmitter, frequency_hz,
        (int(ds.path_gain.shape[1]), int(ds.path_gain.shape[2])), terms.sub_pixels,
        beam_sigma_rad=float(ds.beam_sigma_rad), loss_per_m=0.0 if air is None else air.loss_per_m(frequency_hz),
        device=device,
    )  # fmt: skip
    if mirror_order is None:
        terms = replace(terms, mirror_order=transport.images.affordable(receivers, terms.mirror_order))
    found = transport.paths(receivers, terms.mirror_order, progress)
    views = []
    for r, receiver in enumerate(receivers):
        own = found.subset(np.flatnonzero(found.receiver == r))
        views.append(transport.view(receiver, terms, paths=own))
        tell("transport", r + 1, len(receivers))
    return TrainingViews(transport, views, frequency_hz, air, time.perf_counter() - started)


def _check_rays(shape: tuple[int, ...], sub_pixels: int) -> None:
    """Refuse spectra of ``shape`` (R, H, W) whose rays would not fit into memory."""
    rays = int(np.prod(shape, dtype=np.int64)) * sub_pixels**2
    if rays > MOST_RAYS:
        raise ValueError(
            f"ds: {shape[0]} spectra of {shape[1]} x {shape[2]} pixels take {rays:.2g} rays, {rays * RAY_BYTES / 1e9:.0f} "
            f"GB and more, expected at most {MOST_RAYS:.2g}: give fewer receivers (ds.split, ds.subset) or sub_pixels=1"
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
    ds: SpectrumDataset,
    options: FitOptions,
    *,
    transport: TrainingViews | None = None,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> Trained:
    """Fit materials to the spectra of ``ds``; arguments and errors as for :meth:`BistaticField.fit`."""
    o = options.decided(float(ds.frequency_hz))
    if transport is not None and options.sub_pixels is None:
        o = replace(o, sub_pixels=None)  # it is what the rays were traced with, quick or not
    check_array("ds.path_gain", ds.path_gain, (len(ds.receivers), None, None), np.float32)
    if len(ds.receivers) == 0 or not (ds.path_gain > ds.floor).any():
        raise ValueError("ds: got no pixel above the floor, expected spectra with power to fit to")
    seen = transport or trace(
        geometry, ds, mirror_order=o.mirror_order, sub_pixels=o.sub_pixels, device=device, progress=progress
    )
    seen.check(ds, o.sub_pixels)
    o = replace(o, sub_pixels=seen.transport.grid.sub_pixels)
    if o.residuals is None:
        o = replace(o, residuals=QUICK_RESIDUAL if options.quick else ResidualFit())
    # The fit's matrices are small: threads of BLAS would spend more time waiting for each other than they save.
    with threadpool_limits(1, user_api="blas"):
        return _Training(seen, ds, o, progress).run()


@dataclass(frozen=True)
class _Candidate:
    """Terms with their fit, and the held-out mean square error [dB^2]."""

    terms: Terms
    fit: Fitted
    error: float


class _Training:
    """One fit: the state that its steps share."""

    def __init__(
        self, seen: TrainingViews, ds: SpectrumDataset, options: FitOptions, progress: Progress | None
    ) -> None:
        self.seen, self.ds, self.options, self.choose = seen, ds, options, options.selection
        self.started = time.perf_counter()
        self.surface, self.count, self.floor = seen.surface, len(ds.receivers), float(ds.floor)
        self.views = list(seen.views)
        self.area = np.bincount(self.surface.group, self.surface.mesh.areas, minlength=self.surface.groups)
        self.material = self.surface.material
        self.target = to_db(ds.path_gain, ds.floor) - 10.0 * np.log10(ds.floor)
        grid = seen.transport.grid
        self.beam = beam_operator(grid.shape, float(ds.beam_sigma_rad), grid.device)
        rng = np.random.default_rng(options.seed)
        self.held = np.zeros(0, int)
        if self.count >= self.choose.least_receivers:
            held = min(int(self.count * self.choose.held_out), self.choose.most_held_out)
            self.held = np.sort(rng.permutation(self.count)[:held])
        self.kept = np.setdiff1d(np.arange(self.count), self.held)
        self.progress: Progress = progress or _silent
        self.behind, self.steps = 0, self._planned() if len(self.held) else 1
        pixels = self.target[0].size
        most = min(pixels, max(200, self.choose.readings // self.count))
        self.measured, self.readings = [], []
        terms = options.terms()
        for r in range(self.count):
            chosen = np.sort(rng.choice(pixels, most, replace=False))
            self.measured.append(SpectrumPixels(self.beam, chosen))
            response = respond(self.views[r], self.measured[r], terms, self.floor)
            self.readings.append(Reading(response, self.target[r].ravel()[chosen]))
            self.progress("fit", r, (1 + self.steps) * self.count)
        self.log: list[dict[str, Any]] = []

    def run(self) -> Trained:
        """Choose terms where some are free, fit to all receivers, and report."""
        o, everyone = self.options, np.arange(self.count)
        terms, errors = o.terms(), None
        start = Parameters.prior(int(self.material.max()) + 1, len(terms.lobes))
        if len(self.held):
            first = self._fit_groups(terms, start, self._few(1), self.choose.short_steps * 2)
            best = self._choose(_Candidate(terms, first, self._held_error(terms, first)))
            residual = self._choose_residual(best)
            terms, start = best.terms, best.fit.parameters
            if residual is not None:
                terms = replace(terms, residual=True)
            errors = self._errors(terms, best.fit, residual)
        # Chosen terms come with a fit to most receivers, under which light that goes on is settled: one round is left.
        rounds = 1 if len(self.held) else self.choose.rounds
        fit = self._fit_groups(terms, start, everyone, o.iterations, rounds=rounds)
        materials = self._materials(terms, fit)
        if terms.residual:
            materials = replace(materials, residual=self._residual(materials, everyone))
        if errors is not None:
            errors = replace(errors, covariance=fit.covariance)
        total = (1 + self.steps) * self.count
        self.progress("fit", total, total)
        return Trained(self.surface, materials, self.material, errors, self._report(fit))

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

    def _report(self, fit: Fitted) -> dict[str, Any]:
        report = {
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
            to_db_ = 10.0 / np.log(10.0)
            report["gain_offset_db"] = to_db_ * fit.parameters.log_gain
            report["gain_offset_std_db"] = to_db_ * float(np.sqrt(fit.covariance[-1, -1]))
        return report

    # ------------------------------------------------------------------------------------------ choosing

    def _few(self, times: int) -> np.ndarray:
        """Receivers that fits which only decide about a term learn from."""
        return self.kept[: times * self.choose.most_to_choose]

    def _note(self, term: str, kept: bool, error: float) -> None:
        self.log.append({"term": term, "kept": bool(kept), "held_out_rmse_db": float(np.sqrt(error))})

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

    def _choose_residual(self, best: _Candidate) -> np.ndarray | None:
        """The residual (2, X) on the receivers kept, if it is wanted or lowers the held-out error clearly."""
        if not (best.terms.residual or self.options.residual is None):
            return None
        bare = self._materials(replace(best.terms, residual=False), best.fit)
        found = self._residual(bare, self.kept)
        error = self._image_error(replace(bare, terms=replace(best.terms, residual=True), residual=found))
        keep = best.terms.residual or error < self.choose.clearly_better * self._image_error(bare)
        self._note("residual", keep, error)
        return found if keep else None

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
            return self._image_error(self._materials(replace(terms, residual=False), fit))
        readings = self._readings(terms, fit, self.held, follow=False)
        errors = [r.tied(self.material).error_db(fit.parameters) for r in readings]
        return float(np.mean(np.concatenate(errors) ** 2))

    def _image_error(self, materials: Materials) -> float:
        """Mean square error of the dB images of the held-out receivers [dB^2]."""
        sent = sent_radiance(self.seen.transport, materials)
        return float(
            np.mean([np.mean((self._image(materials, sent, r) - self.target[r]) ** 2) for r in self.held])
        )

    def _image(self, materials: Materials, sent: np.ndarray | None, receiver: int) -> np.ndarray:
        """Predicted image of a training receiver, dB above the floor, shape ``(H, W)``."""
        image = render(self._view(receiver, materials.terms), materials, self.beam, sent).image
        return to_db(image, self.floor) - 10.0 * np.log10(self.floor)

    def _errors(self, terms: Terms, fit: Fitted, residual: np.ndarray | None) -> ErrorModel:
        """Learned from the receivers held out; where they are few, from all, held out in turn."""
        receivers = np.asarray(self.ds.receivers, float)
        images, errors, gaps = [], [], []
        for held in self._folds():
            kept = np.setdiff1d(np.arange(self.count), held)
            if held is self.held:
                materials = self._materials(terms, fit, residual)
            else:
                own = self._fit_groups(terms, fit.parameters, kept, self.choose.short_steps, rounds=1)
                materials = self._materials(terms, own)
                if terms.residual:
                    materials = replace(materials, residual=self._residual(materials, kept))
            sent = sent_radiance(self.seen.transport, materials)
            for r in held:
                images.append(self._image(materials, sent, r))
                errors.append(images[-1] - self.target[r])
                gaps.append(np.linalg.norm(receivers[kept] - receivers[r], axis=1).min())
        return learn_errors(images, errors, np.array(gaps), receivers, fit.covariance)

    def _folds(self) -> list[np.ndarray]:
        """Receivers that are held out in turn to learn errors."""
        folds = [self.held]
        if self.count <= self.choose.few_receivers:
            folds += np.array_split(self.kept, max(len(self.kept) // max(len(self.held), 2), 2))
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
        known = self._materials(replace(terms, indirect=False, residual=False), fit)
        sent = sent_radiance(self.seen.transport, known)
        return [
            replace(
                reading,
                response=with_further_bounces(
                    reading.response,
                    self._view(r, terms),
                    self.measured[r],
                    known,
                    sent,
                    self.floor,
                    follow=follow,
                ),
            )
            for reading, r in zip(limited, chosen, strict=True)
        ]

    def _view(self, receiver: int, terms: Terms) -> ReceiverView:
        """What a training receiver sees, as far as ``terms`` want it; kept for the next time."""
        self.views[receiver] = self.seen.transport.complete(self.views[receiver], terms)
        return self.views[receiver]

    def _residual(self, materials: Materials, chosen: np.ndarray) -> np.ndarray:
        """Gains of surface cells over ``materials``, shape ``(2, X)``."""
        sent = sent_radiance(self.seen.transport, materials)
        shares = [
            shares_of(self._view(r, materials.terms), materials, sent, self.beam, self.floor, self.target[r])
            for r in chosen
        ]
        found = fit_residual(shares, self.beam, self.surface, self.options.residuals)
        self._stepped()
        return found

    def _materials(self, terms: Terms, fit: Fitted, residual: np.ndarray | None = None) -> Materials:
        """What ``fit`` found, by groups."""
        none = np.zeros((2, self.surface.cells))
        return Materials(
            terms,
            fit.parameters.take(self.material),
            none if residual is None else residual,
            self.ds.transmitter,
        )
