"""Fitting a bistatic field: trace once, choose terms on held-out receivers, fit groups, elements, then the errors."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_matrix
from threadpoolctl import threadpool_limits

from warprrf.device import Progress, check_array
from warprrf.rf.em.absorption import Air
from warprrf.rf.fields.bistatic import fit as _fit
from warprrf.rf.fields.bistatic.field import BistaticField
from warprrf.rf.fields.bistatic.fit import NEPER, Fit, Parameters, View
from warprrf.rf.fields.bistatic.grouping import regroup
from warprrf.rf.fields.bistatic.residuals import Shares, fit_residual, gather_shares
from warprrf.rf.fields.bistatic.sight import Sight
from warprrf.rf.fields.bistatic.specular import MOST_MIRRORS, specular_paths
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.terms import Terms
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel, learn_errors
from warprrf.rf.fields.receivers import check_receiver
from warprrf.rf.spectra.spectrum import to_db

if TYPE_CHECKING:
    from warprrf.rf.relevance.search import Relevance
    from warprrf.rf.spectra.dataset import SpectrumDataset

ROWS = 12_000  # pixels that groups are fitted to, spread over the training receivers
LEAST_TO_HOLD_OUT = 4  # training receivers below which nothing is held out, so no term is chosen
MOST_HELD_OUT = 10
FEW_RECEIVERS = 20  # up to which errors are learned from every receiver, held out in turn
MOST_TO_CHOOSE = 12  # receivers that fits which only decide about a term learn from
SHORT_STEPS = 10  # of a fit that only decides about a term
BETTER = 0.995  # a term must lower the held-out mean square error at least to this share
CLEARLY_BETTER = (
    0.95  # and the residual to this share: it has thousands of unknowns and blurs the strongest paths
)
NOT_MUCH_WORSE = 1.5  # share to which it may rise where fewer materials fit the training receivers better
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
FEW_MATERIALS = 30
REGROUPED = 3  # rounds of deciding what is of one material, and fitting
OUTER = 2  # rounds of further bounces and groups in turn


@dataclass(frozen=True)
class BistaticTransport:
    """What the training receivers see of the geometry, whatever the materials: traced once, reused by every fit.

    Attributes:
        surface: patches, groups, elements.
        sights: one for each receiver.
        transmitter, frequency_hz, shape, beam_sigma_rad, air: what it was traced for.
        lobes: exponents of the lobes.
        sub_pixels: square root of the rays per pixel.
        seconds: what it took.
    """

    surface: Surface
    sights: list[Sight]
    transmitter: np.ndarray
    frequency_hz: float
    shape: tuple[int, int]
    beam_sigma_rad: float
    lobes: tuple[int, ...]
    sub_pixels: int
    seconds: float
    air: Air | None = None

    def subset(self, indices: Sequence[int] | np.ndarray) -> BistaticTransport:
        """Some of its receivers."""
        return replace(self, sights=[self.sights[int(i)] for i in indices])


def trace(
    geometry: Any,
    ds: SpectrumDataset,
    *,
    lobes: tuple[int, ...] | None = None,
    mirror_order: int | None = None,
    sub_pixels: int | None = None,
    device: Any = None,
    progress: Progress | None = None,
) -> BistaticTransport:
    """Trace the receivers of ``ds`` on ``geometry`` (a Reconstruction, Scene, Mesh or Surface), mirrors up to
    ``mirror_order`` (None: 3)."""
    started = time.perf_counter()
    surface = geometry if isinstance(geometry, Surface) else Surface.of(geometry)
    receivers = check_receiver("ds.receivers", np.asarray(ds.receivers, np.float64), surface.mesh)
    order = MOST_MIRRORS if mirror_order is None else mirror_order
    terms = Terms(mirror_order=order, **_chosen(lobes=lobes, sub_pixels=sub_pixels))
    blank = _blank(surface, ds, terms, device)
    source = blank.transmitter
    found = specular_paths(
        surface,
        source,
        receivers,
        blank.wavelength_m,
        order=order,
        tree=blank.mirror_tree(source),
        device=device,
    )
    sights = []
    for r, receiver in enumerate(receivers):
        sights.append(blank.see(receiver, paths=found.subset(np.flatnonzero(found.receiver == r))))
        if progress is not None:
            progress("transport", r + 1, len(receivers))
    return BistaticTransport(
        surface, sights, blank.transmitter, blank.frequency_hz, blank.shape, blank.beam_sigma_rad, blank.terms.lobes,
        blank.terms.sub_pixels, time.perf_counter() - started, blank.air,
    )  # fmt: skip


def train(
    geometry: Any,
    ds: SpectrumDataset,
    *,
    line_of_sight: bool = True,
    diffuse: bool = True,
    mirror_order: int | None = None,
    lobes: tuple[int, ...] | None = None,
    mirror_scatter: bool | None = None,
    scatter_mirror: bool | None = None,
    diffuse_order: int | None = None,
    indirect: bool | None = None,
    residual: bool | None = None,
    sub_pixels: int | None = None,
    quick: bool = False,
    gain_offset: bool = False,
    iterations: int = _fit.MAX_STEPS,
    transport: BistaticTransport | None = None,
    relevance: Relevance | None = None,
    seed: int = 0,
    device: Any = None,
    progress: Progress | None = None,
) -> BistaticField:
    """Fit a bistatic field.

    A term given as None is kept only if it lowers the error on receivers held out of ``ds`` (a quarter, ten at most);
    with fewer than four receivers nothing is held out and only single bounces are modelled.

    Args:
        geometry: Reconstruction, Scene (its materials name the groups, nothing else is taken from them) or Mesh.
        ds: training set.
        line_of_sight, diffuse: switches of those terms.
        mirror_order: mirror reflections on a path: 0 to 3.
        lobes: exponents of the scattering lobes ((1 + cos psi) / 2)^n, 0 for Lambertian.
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
        transport: what :func:`trace` found for exactly these receivers.
        relevance: what :func:`warprrf.relevance` found: terms that it rules out are off, others stay free. Terms given
            here count for more.
        seed: of the choice of pixels and held-out receivers.
        device: where rays are cast.
        progress: called with the stages ``"transport"`` and ``"fit"``.

    Raises:
        ValueError: for bad options, receivers on a surface or outside the scene, spectra that are all empty.
        TypeError: for a geometry without a mesh.
    """
    if not isinstance(iterations, int | np.integer) or iterations < 0:
        raise ValueError(f"iterations: got {iterations!r}, expected a whole number of steps, 0 or more")
    wanted: dict[str, Any] = {
        "mirror_order": mirror_order, "mirror_scatter": mirror_scatter, "scatter_mirror": scatter_mirror,
        "diffuse_order": diffuse_order, "indirect": indirect, "residual": residual,
    }  # fmt: skip
    fixed: dict[str, Any] = {"line_of_sight": bool(line_of_sight), "diffuse": bool(diffuse)}
    if relevance is not None:
        ruled = relevance.options(float(ds.frequency_hz))
        fixed = {name: value and ruled[name] for name, value in fixed.items()}
        wanted = {name: ruled[name] if value is None else value for name, value in wanted.items()}
        lobes = ruled["lobes"] if lobes is None else lobes
    if quick:
        wanted = {name: QUICK[name] if value is None else value for name, value in wanted.items()}
        if sub_pixels is None and transport is None:
            sub_pixels = QUICK["sub_pixels"]
    given = _chosen(**wanted)
    Terms(**fixed, **_chosen(lobes=lobes, sub_pixels=sub_pixels), **given)
    check_array("ds.path_gain", ds.path_gain, (len(ds.receivers), None, None), np.float32)
    if len(ds.receivers) == 0 or not (ds.path_gain > ds.floor).any():
        raise ValueError("ds: got no pixel above the floor, expected spectra with power to fit to")
    order = wanted["mirror_order"]
    seen = transport or trace(
        geometry, ds, lobes=lobes, mirror_order=order, sub_pixels=sub_pixels, device=device, progress=progress
    )
    _check_transport(seen, ds, lobes, sub_pixels)
    # The fit's matrices are small: threads of BLAS would spend more time waiting for each other than they save.
    with threadpool_limits(1, user_api="blas"):
        return _Training(seen, ds, gain_offset, int(iterations), quick, seed, device, progress).run(
            fixed, wanted
        )


class _Training:
    """One fit: the state that its steps share."""

    def __init__(
        self,
        seen: BistaticTransport,
        ds: SpectrumDataset,
        gain: bool,
        steps: int,
        quick: bool,
        seed: int,
        device: Any,
        progress: Any,
    ) -> None:
        self.seen, self.ds, self.gain, self.steps, self.device = seen, ds, gain, steps, device
        self.quick = quick
        self.started = time.perf_counter()
        self.surface, self.count = seen.surface, len(ds.receivers)
        self.area = np.bincount(self.surface.group, self.surface.mesh.areas, minlength=self.surface.groups)
        self.material = self.surface.material
        self.target = to_db(ds.path_gain, ds.floor) - 10.0 * np.log10(ds.floor)
        rng = np.random.default_rng(seed)
        self.held = np.zeros(0, int)
        if self.count >= LEAST_TO_HOLD_OUT:
            self.held = np.sort(rng.permutation(self.count)[: min(self.count // 4, MOST_HELD_OUT)])
        self.kept = np.setdiff1d(np.arange(self.count), self.held)
        self.progress = progress or (lambda stage, done, total: None)
        pixels = self.target[0].size
        self.pixels = [
            np.sort(rng.choice(pixels, min(pixels, max(200, ROWS // self.count)), replace=False))
            for _ in range(self.count)
        ]
        blank = _blank(self.surface, ds, Terms(lobes=seen.lobes, sub_pixels=seen.sub_pixels), device)
        self.blank = blank
        self.views = []
        for r in range(self.count):
            self.views.append(blank.view(seen.sights[r], self.pixels[r], self.target[r]))
            self.progress("fit", r, 2 * self.count)
        self.log: list[dict[str, Any]] = []

    def run(self, fixed: dict[str, Any], wanted: dict[str, Any]) -> BistaticField:
        terms = replace(self.blank.terms, **fixed, **_chosen(**wanted))
        free = {name for name, value in wanted.items() if value is None} if len(self.held) else set()
        start = Parameters.prior(int(self.material.max()) + 1, len(self.seen.lobes))
        errors: ErrorModel | None = None
        if len(self.held):
            fit = self._groups(terms, start, self.kept[:MOST_TO_CHOOSE], SHORT_STEPS * 2)
            terms, fit, residual = self._choose(terms, free, fit)
            errors = self._errors(terms, fit, residual)
            start = fit.parameters
        # Chosen terms come with a fit to most receivers, under which light that goes on is settled: one round is left.
        rounds = 1 if len(self.held) else OUTER
        fit = self._groups(terms, start, np.arange(self.count), self.steps, rounds=rounds)
        residual = (
            self._residual(self._field(terms, fit, None), np.arange(self.count)) if terms.residual else None
        )
        field = self._field(terms, fit, residual)
        if errors is not None:
            errors = replace(errors, covariance=fit.covariance)
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
        if self.gain:
            deviation = float(np.sqrt(fit.covariance[-1, -1]))
            report["gain_offset_db"] = NEPER * fit.parameters.log_gain
            report["gain_offset_std_db"] = NEPER * deviation
        self.progress("fit", 2 * self.count, 2 * self.count)
        return replace(field, errors=errors, report=report)

    # ------------------------------------------------------------------------------------------ choosing

    def _choose(self, terms: Terms, free: set[str], fit: Fit) -> tuple[Terms, Fit, np.ndarray | None]:
        """Terms that lower the held-out error, one after another, each with a short fit of its own."""
        best = self._held_error(terms, fit)
        self.log.append({"term": "single bounces", "kept": True, "held_out_rmse_db": float(np.sqrt(best))})
        bounces = [
            (name, value)
            for name, value in MORE
            if name in free and (terms.diffuse or name == "mirror_order")
        ]
        for name, value in bounces:
            if "order" in name and getattr(terms, name) < value - 1:
                continue  # the order below it did not help
            if name == "scatter_mirror" and not (terms.further or terms.mirror_scatter):
                continue  # the same bounces the other way round
            terms, fit, best = self._tried(name, value, terms, fit, best)
        if np.isfinite(self.surface.look).all() and self.material.max() > 0:
            fit, best = self._regroup(terms, fit, best)
        # Last, because it would stand in for whatever a wrong material leaves dark.
        if "indirect" in free and terms.diffuse:
            terms, fit, best = self._tried("indirect", True, terms, fit, best)
        residual = None
        if terms.residual or "residual" in free:
            base = self._field(terms, fit, None)
            found_residual = self._residual(base, self.kept)
            best = self._image_error(base)
            error = self._image_error(self._field(replace(terms, residual=True), fit, found_residual))
            keep = terms.residual or error < CLEARLY_BETTER * best
            self.log.append(
                {"term": "residual", "kept": bool(keep), "held_out_rmse_db": float(np.sqrt(error))}
            )
            if keep:
                terms, residual = replace(terms, residual=True), found_residual
        return terms, fit, residual

    def _tried(self, name: str, value: Any, terms: Terms, fit: Fit, best: float) -> tuple[Terms, Fit, float]:
        """``terms`` with one more, its fit and error, if that error is lower; else as they were."""
        trial = replace(terms, **{name: value})
        found = self._groups(trial, fit.parameters, self.kept[:MOST_TO_CHOOSE], SHORT_STEPS, rounds=1)
        error = self._held_error(trial, found)
        keep = error < BETTER * best
        label = name if value is True else f"{name} {value}"
        self.log.append({"term": label, "kept": bool(keep), "held_out_rmse_db": float(np.sqrt(error))})
        return (trial, found, error) if keep else (terms, fit, best)

    def _regroup(self, terms: Terms, fit: Fit, best: float) -> tuple[Fit, float]:
        """Materials by what the spectra say, if that lowers the held-out error."""
        before, trial = self.material, fit
        chosen = self.kept[: 2 * MOST_TO_CHOOSE]
        for _ in range(REGROUPED):
            views = self._views(terms, trial, chosen, True)
            self.material, start = regroup(
                views, trial.parameters, self.material, self.surface.look, self.area
            )
            # What surfaces get of each other changes little with who is of which material: the same views serve.
            trial = self._fitted(views, terms, start, SHORT_STEPS)
        error = self._held_error(terms, trial)
        # Few receivers held out say little, fewer materials that describe the others better say much.
        same = len(self.kept) <= MOST_TO_CHOOSE  # receivers of both fits
        simpler = same and trial.losses[-1:] < fit.losses[-1:] and error < NOT_MUCH_WORSE * best
        keep = error < best or simpler
        name = f"{before.max() + 1} materials as {self.material.max() + 1}"
        self.log.append({"term": name, "kept": bool(keep), "held_out_rmse_db": float(np.sqrt(error))})
        if not keep:
            self.material = before
            return fit, best
        return trial, error

    def _held_error(self, terms: Terms, fit: Fit) -> float:
        """Mean square error of the held-out receivers without residual [dB^2]: of whole images where they are few,
        else at the chosen pixels."""
        if len(self.held) <= LEAST_TO_HOLD_OUT:
            return self._image_error(self._field(terms, fit, None))
        views = self._views(terms, fit, self.held, False)
        gaps = [
            NEPER * np.log1p(_fit.predict(v.tied(self.material), fit.parameters)) - v.target_db for v in views
        ]
        return float(np.mean(np.concatenate(gaps) ** 2))

    def _image_error(self, field: BistaticField) -> float:
        """Mean square error of the dB images of the held-out receivers [dB^2]."""
        return float(np.mean([np.mean((self._image(field, r) - self.target[r]) ** 2) for r in self.held]))

    def _image(self, field: BistaticField, receiver: int) -> np.ndarray:
        return NEPER * np.log1p(field.compose(self.seen.sights[receiver]).image / self.ds.floor)

    def _errors(self, terms: Terms, fit: Fit, residual: np.ndarray | None) -> ErrorModel:
        """Learned from the receivers held out; where they are few, from all, held out in turn."""
        receivers = np.asarray(self.ds.receivers, float)
        images, errors, gaps = [], [], []
        folds = [self.held]
        if self.count <= FEW_RECEIVERS:
            rest = np.array_split(self.kept, max(len(self.kept) // max(len(self.held), 2), 2))
            folds += rest
        for held in folds:
            kept = np.setdiff1d(np.arange(self.count), held)
            if held is self.held:
                field = self._field(terms, fit, residual)
            else:
                own = self._groups(terms, fit.parameters, kept, SHORT_STEPS, rounds=1)
                bare = self._field(terms, own, None)
                field = self._field(terms, own, self._residual(bare, kept)) if terms.residual else bare
            for r in held:
                images.append(self._image(field, r))
                errors.append(images[-1] - self.target[r])
                gaps.append(np.linalg.norm(receivers[kept] - receivers[r], axis=1).min())
        return learn_errors(images, errors, np.array(gaps), receivers, fit.covariance)

    # ------------------------------------------------------------------------------------------ fitting

    def _groups(
        self, terms: Terms, start: Parameters, chosen: np.ndarray, steps: int, rounds: int = OUTER
    ) -> Fit:
        """Materials' parameters on the receivers ``chosen``, further bounces recomputed in each of ``rounds``."""
        further = terms.further or terms.mirror_scatter or terms.scatter_mirror
        fit = Fit(
            start, np.zeros((0, 0)), _fit.Layout(*start.log_weight.shape, indirect=False, gain=False), [], 0
        )
        for k in range(rounds if further else 1):
            views = self._views(terms, fit, chosen, self.material.max() < FEW_MATERIALS)
            fit = self._fitted(
                views, terms, fit.parameters if k else start, max(steps // rounds, 1) if further else steps
            )
        return fit

    def _fitted(self, views: list[View], terms: Terms, start: Parameters, steps: int) -> Fit:
        """Materials' parameters on views by groups."""
        return _fit.fit_groups(
            [v.tied(self.material) for v in views], start, np.bincount(self.material, self.area),
            indirect=terms.indirect, gain=self.gain, steps=steps,
        )  # fmt: skip

    def _views(self, terms: Terms, fit: Fit, chosen: np.ndarray, follow: bool) -> list[View]:
        """Views of the receivers ``chosen`` by groups, under ``terms``; light that reaches surfaces from others held
        fixed. ``follow``: what they send on of it follows their parameters (which costs columns)."""
        views = [self._limited(self.views[r], terms) for r in chosen]
        if terms.further or terms.mirror_scatter or terms.scatter_mirror:
            # Radiance of the groups themselves is fitted, so it is left out of what is fixed.
            known = self._field(replace(terms, indirect=False), fit, None)
            share = _fit.scattered_share(known.parameters)
            for i, r in enumerate(chosen):
                # No common gain here: the fit applies it to everything.
                groups, sent, shown = known.further_by_group(self.seen.sights[r], self.pixels[r])
                sent, shown = np.maximum(sent, 0.0) / self.ds.floor, np.maximum(shown, 0.0) / self.ds.floor
                if follow:
                    unit = (sent / np.maximum(share[groups], 1e-12)).astype(np.float32)
                    views[i] = replace(
                        views[i], again_group=groups, again=unit, extra=shown.astype(np.float32)
                    )
                else:
                    views[i] = replace(views[i], extra=(sent.sum(axis=1) + shown).astype(np.float32))
        return views

    def _limited(self, view: View, terms: Terms) -> View:
        """``view`` without the terms that are switched off."""
        order = (view.path_group >= 0).sum(axis=1)
        keep = (order <= terms.mirror_order) & ((order > 0) | terms.line_of_sight)
        view = replace(
            view, gain=view.gain[keep], path_group=view.path_group[keep], cosine=view.cosine[keep],
            turn=view.turn[keep], beam=view.beam[keep],
        )  # fmt: skip
        if not terms.diffuse:
            view = replace(view, groups=view.groups[:0], basis=view.basis[:, :0])
        return view

    def _residual(self, field: BistaticField, chosen: np.ndarray) -> np.ndarray:
        shares, surface, floor = [], self.surface, self.ds.floor
        pixels, per_pixel = self.target[0].size, field.tracer.sub_pixels**2
        for r in chosen:
            sight = self.seen.sights[r]
            parts = field.compose(sight)
            rays = np.arange(len(parts.rays))
            single = gather_shares(
                rays // per_pixel, sight.met.face.numpy(), parts.rays / floor, pixels, surface
            )
            gain = np.exp(field.parameters.log_gain) / floor
            further = csr_matrix((pixels, surface.texels), dtype=np.float32)
            for pixel, face, power in field.sent_on(sight):
                further += gather_shares(pixel, face, gain * power, pixels, surface)
            known = np.asarray((single + further).sum(axis=1)).reshape(field.shape)
            rest = np.maximum(parts.image / floor - field.beam(known), 0.0)
            shares.append(Shares(single, further, rest.ravel(), self.target[r].ravel()))
        return fit_residual(shares, field.beam, surface, quick=self.quick)

    def _field(self, terms: Terms, fit: Fit, residual: np.ndarray | None) -> BistaticField:
        zero = np.zeros((2, self.surface.texels))
        field = replace(
            self.blank,
            terms=terms if residual is not None else replace(terms, residual=False),
            parameters=fit.parameters.take(self.material),
            material=self.material,
            residual=zero if residual is None else residual,
        )
        # Geometry that no parameter changes is traced once for all of them.
        for name in ("tracer", "beam", "_mirror_tracer", "_element_light"):
            field.__dict__[name] = getattr(self.blank, name)
        return field


def _blank(surface: Surface, ds: SpectrumDataset, terms: Terms, device: Any) -> BistaticField:
    return BistaticField.prior(surface, ds, terms=terms, device=device)


def _chosen(**options: Any) -> dict[str, Any]:
    """Those that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def _check_transport(
    seen: BistaticTransport, ds: SpectrumDataset, lobes: tuple[int, ...] | None, sub_pixels: int | None
) -> None:
    same = (
        len(seen.sights) == len(ds.receivers)
        and seen.shape == tuple(ds.path_gain.shape[1:])
        and all(np.array_equal(s.receiver, r) for s, r in zip(seen.sights, ds.receivers, strict=True))
        and np.array_equal(seen.transmitter, ds.transmitter)
        and seen.frequency_hz == ds.frequency_hz
        and seen.air == getattr(ds, "air", None)
        and (lobes is None or tuple(lobes) == seen.lobes)
        and sub_pixels in (None, seen.sub_pixels)
    )
    if not same:
        raise ValueError(
            f"transport: got what {len(seen.sights)} receivers see with lobes {seen.lobes} and "
            f"{seen.sub_pixels**2} rays a pixel; expected exactly the {len(ds.receivers)} receivers, transmitter, "
            "carrier, grid, air, lobes and rays of this fit"
        )
