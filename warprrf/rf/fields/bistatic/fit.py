"""Fitting a bistatic field: trace what receivers see, observe what was read, decide which effects count and which groups are of
one material, fit parameters of materials, and find what differs within them and how wrong all that is.

:func:`_steps` reads as that list. Each step is a function of a :class:`~warprrf.rf.fields.bistatic.training.Training`; what it
decides is handed on, and noted in the report.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from warprrf.checks import warn
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import GeometryLike, Mesh, as_mesh
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.base import Data, Measured
from warprrf.rf.fields.bistatic.gauss_newton import Solution, gauss_newton
from warprrf.rf.fields.bistatic.measured import SpectrumPixels, read
from warprrf.rf.fields.bistatic.merging import merge
from warprrf.rf.fields.bistatic.observations import Place, Seen, as_list, frame_of, places_of
from warprrf.rf.fields.bistatic.options import OPTIONAL, FitOptions, evenly
from warprrf.rf.fields.bistatic.placing import Evidence, moved, position_offset, with_zeros
from warprrf.rf.fields.bistatic.report import covariance_of, left_out, report_of, warn_of
from warprrf.rf.fields.bistatic.residual import fit_residual, shares_of
from warprrf.rf.fields.bistatic.training import (
    FEW_RECEIVERS,
    MERGES,
    MOST_KEPT,
    Training,
    check_rays,
    rays_of,
    trace,
)
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel, learn_errors
from warprrf.rf.positions import warn_of_unmodelled
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import angle_deg, strongest_direction
from warprrf.rf.spectra.readings import Readings
from warprrf.rf.tracing.model import SETS, Effects, Model, with_slabs_and_edges
from warprrf.rf.tracing.surface import Surface
from warprrf.rows import distinct_rows

SHORT_STEPS = 10  # of a fit that only decides about something
BETTER = 0.995
"""Share to which another choice of effects must lower the mean square error of :meth:`Training.choice_loss`."""


def fit(
    geometry: GeometryLike,
    ds: Data,
    options: FitOptions,
    *,
    client: Any = None,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """The parts of a bistatic field that a fit to what ``ds`` holds finds, by the names of its attributes; arguments and errors
    as for :meth:`BistaticField.fit`."""
    data, mesh = as_list(ds), as_mesh(geometry, "geometry")
    for one in data:
        if isinstance(one, SpectrumDataset) and len(one) and not (one.path_gain > one.floor).any():
            raise ValueError("ds: got no pixel above the floor, expected spectra with power to fit to")
    places = places_of(data, mesh, device)
    tables = [one for one in data if isinstance(one, Readings)]
    answered = [np.asarray(one.chain)[one.power > one.floor] for one in tables]
    if dark := {place.chain for place in places} - {""}.union(*answered):
        raise ValueError(
            f"chain: got no reading of {sorted(dark)} above its floor, so that nothing tells the gain; leave it out"
        )
    for one in data:
        if isinstance(one, SpectrumDataset):
            _question_directions(one, mesh, device)
    ends = np.array([np.concatenate([place.transmitter, place.receiver]) for place in places])
    ends = ends[np.sort(distinct_rows(ends)[0])]
    check_rays(places, options.rays_a_side)
    if options.effects != "auto":  # else these are decided on by what they are worth
        frequency_hz, source = frame_of(data).frequency_hz, places[0].transmitter
        effects = options.candidates(frequency_hz)[0]
        receivers = np.array([p.receiver for p in places if np.array_equal(p.transmitter, source)])
        warn_of_unmodelled(
            mesh, source, receivers, frequency_hz=frequency_hz, device=device,
            transmission=effects.transmissions > 0, diffraction=effects.diffractions > 0,
        )  # fmt: skip
    tell = progress or (lambda *_: None)
    tell("patches", 0, 1)
    surface = Surface.of(geometry, frequency_hz=frame_of(data).frequency_hz)
    tell("patches", 1, 1)
    look = partial(trace, sub_pixels=options.rays_a_side, client=client, device=device, progress=progress)
    # The fit's matrices are small: threads of BLAS would spend more time waiting for each other than they save.
    with threadpool_limits(1, user_api="blas"):
        t, model, found, zeros = _steps(surface, data, places, look, options, progress)
        offsets = _offsets(t, model)
        if offsets:
            data = [moved(one, offsets[k]) if k in offsets else one for k, one in enumerate(t.data)]  # type: ignore[arg-type]
            places = places_of(data, mesh, device)
            t, model, found, _ = _steps(surface, data, places, look, options, progress)
    report = found["report"]
    warn_of(t.data, report)
    places_moved = {}
    for k, own in offsets.items():
        once = {place.receiver.tobytes(): (place.receiver.tolist(), offset.tolist()) for place, offset in own}
        places_moved[t.names[k]] = list(once.values())
    parameters = replace(model.parameters, log_gains=np.zeros(0))  # chains are of the data, not of the field
    return found | {
        "parameters": parameters, "report": report | zeros | {"position_offset_m": places_moved},
        "fitted_on": ends[:, 3:], "fitted_under": ends[:, :3],
    }  # fmt: skip


def _question_directions(ds: SpectrumDataset, mesh: Mesh, device: DeviceLike) -> None:
    """Warn if most receivers in line of sight get most power from elsewhere: their pixels are counted in another way, or
    they stood elsewhere."""
    whole = ~np.isnan(ds.path_gain).any(axis=(1, 2))
    seen = np.flatnonzero(whole & mesh.visible(ds.receivers, ds.transmitter, device=device))
    if len(seen) < 4:
        return
    toward = ds.transmitter - ds.receivers[seen]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    off = angle_deg(np.array([strongest_direction(ds.path_gain[k]) for k in seen]), toward) > 20.0
    if off.mean() > 0.5:
        warn(
            f"ds: at {off.sum()} of {len(seen)} receivers in line of sight the strongest direction is not that of the "
            "transmitter; expected rows by zenith from 0, columns by azimuth from -pi (x at 0, y at pi / 2), and receivers "
            "in the order of their spectra"
        )


def _steps(
    surface: Surface,
    data: Sequence[Measured],
    places: Sequence[Place],
    look: Callable[..., tuple[list[Seen], Effects]],
    options: FitOptions,
    progress: Progress | None,
) -> tuple[Training, Model, dict[str, Any], dict[str, dict[str, float]]]:
    """All steps of a fit: what it learned from, the model, all else of a field that it found, and what :func:`with_zeros` did.

    With many receivers some decide about effects and materials; what the others see is traced with those effects alone.
    """
    t = Training.of(surface, data, places, options, progress)
    given = t.candidates[0] if len(t.candidates) == 1 else None
    slabs_and_edges = None if options.effects == "auto" and options.relevance is None else t.candidates[0]
    started = time.perf_counter()
    seen, sought = look(
        surface, [places[k] for k in t.deciding], effects=given, slabs_and_edges=slabs_and_edges
    )
    tracing_s = time.perf_counter() - started
    data, zeros = with_zeros(data, seen)
    t = replace(t, data=data).as_sought(sought).and_at(t.deciding, seen)
    del seen  # and with them records, once the training has none
    started = time.perf_counter()
    choice = choose(t)
    others = np.setdiff1d(np.arange(len(places)), list(t.observations))
    if len(others):
        keeps = rays_of(places, options.rays_a_side) <= MOST_KEPT
        t = t if keeps else t.without_records()
        again = time.perf_counter()
        more, _ = look(
            surface,
            [places[k] for k in others],
            effects=choice.effects,
            slabs_and_edges=choice.effects,
            keeps=keeps,
        )
        tracing_s += time.perf_counter() - again
        t = t.and_at(others, more)
    errors = cross_validate(t, choice)
    choice, model = fit_to_all(t, choice)
    if t.totals:  # they count by how they err, from the beginning: what was fitted to noise would stay
        t = t.weighed(t.unexplained(model)[1])
        choice = t.refined(replace(choice, parameters=t.start(choice.material)), t.telling, SHORT_STEPS)
        choice, model = fit_to_all(t, choice)
    wrong, noise_db = t.unexplained(model)
    if wrong:
        t = t.without(wrong)
        choice, model = fit_to_all(t, choice)
    if errors is not None:
        errors = replace(errors, covariance=covariance_of(t, choice))
    missed = left_out(t, model)
    seconds = {"transport_time_s": tracing_s, "fit_time_s": time.perf_counter() - started}
    report = report_of(t, choice, wrong, noise_db) | seconds | {"left_out": missed}
    t.tick(last=True)
    found = {
        "surface": t.surface, "effects": model.effects, "residual": model.residual, "material": choice.material,
        "errors": errors, "report": report,
    }  # fmt: skip
    return t, model, found, zeros


def choose(t: Training) -> Solution:
    """Effects, and which groups are of one material; groups of known materials stay as they are."""
    material = t.surface.material
    start = t.start(material)
    trials = [Solution(effects, material, start, np.zeros((0, 0)), []) for effects in t.candidates]
    if len(t.held) < 2:  # one alone likes what others do not
        return _choose_of_few(t, trials)
    best, least = trials[0], np.inf
    for trial in trials:  # each holds the one before it: what is no better with some is not tried with more
        trial = replace(trial, effects=with_slabs_and_edges(trial.effects, best.effects))
        if least < np.inf and best.effects.scatterings > 1:
            trial = t.refined(replace(best, effects=trial.effects), t.few(1), SHORT_STEPS)
        else:  # not from what single bounces found: their surfaces are too bright where light between them counts
            trial = t.refined(trial, t.few(1), 2 * SHORT_STEPS, rounds=2)
        loss = t.choice_loss(trial, BETTER * least)
        kept = loss < BETTER * least
        t.note(_name(trial.effects), kept, loss)
        if not kept:
            break
        # What slabs and edges get wrong would hide what bounces are worth.
        best, least = _without_needless(t, trial, loss)
    if np.isfinite(t.surface.appearance).all() and material.max() > 0 and not t.totals:
        best = merged(t, best)
    return best


def _without_needless(t: Training, chosen: Solution, loss: float) -> tuple[Solution, float]:
    """``chosen``, of a :meth:`Training.choice_loss` of ``loss``, without those of :data:`OPTIONAL` that readings are predicted
    better without; and the loss of that."""
    for name, on in OPTIONAL.items() if t.options.effects == "auto" and t.options.relevance is None else ():
        off: dict[str, Any] = dict.fromkeys(on, 0)
        fewer = replace(chosen.effects, **off)
        if fewer != chosen.effects:
            trial = t.refined(replace(chosen, effects=fewer), t.few(1), SHORT_STEPS)
            without = t.choice_loss(trial, BETTER * loss)
            kept = without < BETTER * loss
            t.note(f"no {name}", kept, without)
            chosen, loss = (trial, without) if kept else (chosen, loss)
    return chosen, loss


def _choose_of_few(t: Training, trials: list[Solution]) -> Solution:
    """With too few receivers to hold any out: bounces as rooms have them, unless none fit much better."""
    every = [t.refined(one, t.not_held, t.options.iterations, rounds=2) for one in trials[:2]]
    found = [_without_needless(t, one, t.choice_loss(one))[0] for one in every]
    if len(found) == 1:
        return found[0]
    models = [t.model(trial) for trial in found]
    wrong, also = (t.unexplained(model)[0] for model in models)
    counted = t.without({k: np.intersect1d(rows, also[k]) for k, rows in wrong.items() if k in also})
    single, room = (counted.loss(model, list(t.observations)) for model in models)
    much_better = 0.8  # share to which single bounces must lower the error
    fewer = single < much_better * room
    t.note(_name(found[0].effects), fewer, single)
    t.note(_name(found[1].effects), not fewer, room)
    return found[0] if fewer else found[1]


def merged(t: Training, best: Solution) -> Solution:
    """Materials by what the readings say. Places held out are not asked: too few of them tell by chance whether that is better."""
    trial, by_shape = best, t.surface.by_shape
    problem = t.problem(best.effects, best.material, t.few(2), best.parameters)
    for _ in range(MERGES):
        material, start = merge(problem, trial.parameters, t.surface.appearance, t.area, by_shape=by_shape)
        # What surfaces get of each other changes little with who is of which material: it is frozen.
        problem = replace(problem, material=material, known_through=t.known_through(material))
        trial = gauss_newton(problem, start, SHORT_STEPS)
        t.tick()
    t.note(f"{best.material.max() + 1} materials as {trial.material.max() + 1}", True, t.choice_loss(trial))
    return trial


def _name(effects: Effects) -> str:
    """What a choice of effects is called in a report: the set that it is, whatever its mirrors and :data:`OPTIONAL` effects."""
    for name, one in SETS.items():
        if replace(with_slabs_and_edges(one, effects), mirrors=effects.mirrors) == effects:
            return name
    return str(effects)


def cross_validate(t: Training, choice: Solution) -> ErrorModel | None:
    """The errors of places held out; where they are few, of all, held out in turn. None where not all are of spectra."""
    if not len(t.held) or not all(isinstance(o.measured, SpectrumPixels) for o in t.observations.values()):
        return None
    places = np.stack([o.place.receiver for o in t.observations.values()])
    images, missed, gaps = list[np.ndarray](), list[np.ndarray](), list[float]()
    most_to_judge = 200  # receivers that a residual is learned from: more make it no worse
    for held in _folds(t):
        kept = evenly(np.setdiff1d(np.arange(len(places)), held), most_to_judge)
        own = choice if held is t.held else t.refined(choice, kept, SHORT_STEPS)
        model = with_residual(t, own, kept, quick=True)
        for k, power in zip(held, t.predicted(model, held), strict=True):
            o = t.observations[k]
            images.append((NEPER * np.log1p(power)).reshape(o.place.shape))
            known = np.where(o.target.trust > 0, o.target.error(power), np.nan)
            missed.append(known.reshape(o.place.shape))
            gaps.append(float(np.linalg.norm(places[kept] - places[k], axis=1).min()))
    return learn_errors(images, missed, np.array(gaps), places, covariance_of(t, choice))


def _folds(t: Training) -> list[np.ndarray]:
    """Places that are held out in turn to learn errors."""
    folds = [t.held]
    if len(t.observations) <= FEW_RECEIVERS:
        others = np.setdiff1d(t.not_held, t.always)
        folds += np.array_split(others, max(len(others) // max(len(t.held), 2), 2))
    return folds


def fit_to_all(t: Training, choice: Solution) -> tuple[Solution, Model]:
    """The choice fitted to readings of all places, and its model."""
    choice = t.refined(choice, t.telling, t.options.iterations)
    return choice, with_residual(t, choice, list(t.observations), quick=t.options.quick)


def with_residual(t: Training, choice: Solution, places: Sequence[int] | np.ndarray, *, quick: bool) -> Model:
    """The model of ``choice``, with gains of surface cells that readings at ``places`` tell if it has a residual.

    That is not tried on places held out: a few of them often say that a residual harms, though it helped wherever it was tried.
    """
    model = t.model(choice)
    if not choice.effects.residual:
        return model
    shares = [shares_of(t.observations[k], model) for k in places]
    t.tick()
    return replace(model, effects=choice.effects, residual=fit_residual(shares, t.surface, quick=quick))


def _offsets(t: Training, found: Model) -> dict[int, list[tuple[Place, np.ndarray]]]:
    """By data set of unknown positions its places, and how far each receiver is from where it is said to be [m]."""
    evidence: dict[tuple[int, bytes], list[Evidence]] = {}
    for o in t.observations.values():
        if getattr(t.data[o.place.data], "position_std_m", 0.0) == 0:
            continue
        gains = o.path_gains(found)
        total = np.maximum(read(gains, o.measured), 0.0) / o.floor
        direct = gains.specular / o.floor
        gain = o.gain(gains.parameters, total)
        other = np.maximum(total - direct @ o.measured.of_paths(o.view), 0.0)
        receiver = o.place.data, o.place.receiver.tobytes()
        evidence.setdefault(receiver, []).append((o, gain * other, gain * direct))
    offsets: dict[int, list[tuple[Place, np.ndarray]]] = {}
    for (data, _), own in evidence.items():
        offset = position_offset(t.data[data], own)  # type: ignore[arg-type]
        offsets.setdefault(data, []).extend((o.place, offset) for o, *_ in own)
    return offsets
