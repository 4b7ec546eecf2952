"""What a fit reports: gains of chains and how far side lobes move them, readings that it cannot explain, effects that it leaves
out; and warnings of these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from warprrf.checks import some_of, warn
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.base import Measured
from warprrf.rf.fields.bistatic.gauss_newton import THROUGH_STD, Solution, layout_of
from warprrf.rf.fields.bistatic.observations import NOISE_DB, huber, observe
from warprrf.rf.fields.bistatic.options import MOST_BLOCKED, OPTIONAL, RAYS, evenly, total
from warprrf.rf.fields.bistatic.training import Training
from warprrf.rf.spectra.readings import Readings
from warprrf.rf.tracing.model import Layout, Model
from warprrf.rf.tracing.tracer import View

SIDE_LOBES_DB = 3.0
"""Standard deviation of the level of an antenna's side lobes, which few measure."""


def left_out(t: Training, model: Model) -> dict[str, Any]:
    """Effects of :data:`OPTIONAL` that are not modelled and were not tried, estimated at a few ``"receivers"`` that are blocked: by
    how much they would raise all power there [dB], by name; and ``"error_db"``, by how much the fit has more than was read
    there, rms. What it lacks is no measure of its error: it may be just these effects."""
    blocked = list({o.place.view_key: k for k, o in t.observations.items() if _is_dark(o.view)}.values())
    seen = [t.observations[k] for k in evenly(np.array(blocked, int), MOST_BLOCKED)]
    tried = model.effects, *t.candidates
    lacking = {
        name: on for name, on in OPTIONAL.items() if not any(getattr(e, key) for e in tried for key in on)
    }
    change, by_tracer = {name: np.zeros(len(seen)) for name in OPTIONAL}, dict[int, list[int]]()
    whole, over = np.zeros(len(seen)), np.zeros(len(seen))
    for k, o in enumerate(seen):
        gains = o.path_gains(model)
        whole[k] = gains.total[0] + o.floor
        read_sum, predicted = o.target.sums(o.of_gains(gains))
        over[k] = NEPER * max(np.log1p(predicted) - np.log1p(read_sum), 0.0)
        by_tracer.setdefault(id(o.view.tracer), []).append(k)
    for own in by_tracer.values() if lacking else ():
        tracer, here = seen[own[0]].view.tracer.on_grid(*RAYS), model.at_ratio(seen[own[0]].ratio)
        receivers = np.stack([seen[k].place.receiver for k in own])
        few = total(tracer, receivers, here, {})
        for name, on in lacking.items():
            more = np.maximum(total(tracer, receivers, here, on) - few, 0.0)
            change[name][own] = NEPER * np.log1p(more / whole[own])
    error_db = float(np.sqrt(np.mean(over**2))) if len(seen) else 0.0
    found: dict[str, Any] = {"receivers": [o.place.receiver.tolist() for o in seen], "error_db": error_db}
    return found | {name: own.tolist() for name, own in change.items()}


def _is_dark(view: View) -> bool:
    """Whether less than a hundredth of line of sight passes what is in its way."""
    p = view.paths
    return bool((p.share[p.in_sight] ** 2).sum() < 0.01)


def side_lobes(t: Training, choice: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Of each chain, shape ``(C,)``: the share of its readings that side lobes of its antennas bring, as it counts in dB; and
    how far :data:`SIDE_LOBES_DB` of their level move its gain [dB], all other parameters with it."""
    covariance, p = choice.covariance, choice.parameters
    first = len(covariance) - len(t.chains)
    pull = np.zeros((len(t.chains), len(covariance)))  # of side lobes' level on the parameters
    size, parts = np.zeros(len(t.chains)), dict(t.parts)
    turned = [
        isinstance(one, Readings) and not (one.arrival is None and one.departure is None) for one in t.data
    ]
    places = [k for k, o in parts.items() if o.chain >= 0 and turned[o.place.data]]
    bare = [one.without_side_lobes() if isinstance(one, Readings) else one for one in t.data]
    seen = [parts[k] for k in places]
    lobes = observe(bare, [(o.place, o.view) for o in seen], t.frequency_hz, t.chains)
    for k, lobe in zip(places, lobes, strict=True):
        parts[k] = replace(lobe.part(np.asarray(parts[k].rows)), ratio=parts[k].ratio)
    whole, main = (
        one.problem(choice.effects, choice.material, places, p) for one in (t, replace(t, parts=parts))
    )
    linear = whole.linearised(p, layout_of(replace(whole, observations=list(t.parts.values())), p))
    for (error, table, index), (batch, _, power), (*_, main_lobe) in zip(
        linear, whole.evaluated(p), main.evaluated(p), strict=True
    ):
        gain, weight = batch.gain(p, power), huber(error, batch.huber_db)[1] / NOISE_DB**2
        side = batch.target.slope(gain * power) * gain * np.maximum(power - main_lobe, 0.0)
        for chain in np.unique(batch.chain):
            here = np.repeat(batch.chain == chain, batch.counts)
            pull[chain, index] += table[:, here] @ (weight * side)[here]
            size[chain] += weight[here] @ table[index == first + chain][0, here] ** 2
    own = np.arange(len(t.chains))
    share = pull[own, first + own] / np.maximum(size, 1e-300)
    moved = SIDE_LOBES_DB * np.abs((covariance[first:] * pull).sum(axis=1))
    return share, moved


def covariance_of(t: Training, choice: Solution) -> np.ndarray:
    """Of what a field keeps: parameters of materials, with what they let through as it is known before where that was not free;
    and the common gain, if that was."""
    through = choice.effects.transmissions > 0
    layout, whole = (
        Layout(*choice.parameters.log_weight.shape, through=free, gain=t.options.gain_offset)
        for free in (through, True)
    )
    free = np.ones(whole.size, bool)
    free[whole.let_through(np.arange(whole.groups))] = through
    covariance = np.where(free, 0.0, THROUGH_STD**2) * np.eye(whole.size)
    covariance[np.ix_(free, free)] = choice.covariance[: layout.size, : layout.size]
    return covariance


def report_of(
    t: Training, choice: Solution, wrong: Mapping[int, np.ndarray], noise_db: dict[str, float]
) -> dict[str, Any]:
    """What a fit decided and found, as numbers and text, where :meth:`Training.unexplained` found ``wrong`` and ``noise_db``."""
    report: dict[str, Any] = {
        "receivers": len(t.observations),
        "held_out": len(t.held),
        "groups": t.surface.groups,
        "materials": int(choice.material.max()) + 1,
        "elements": len(t.surface.element_area),
        "steps": len(choice.losses),
        "losses": {"gain": choice.losses},
        "choices": t.log,
        "noise_db": noise_db,
    }
    deviation = np.sqrt(np.diag(choice.covariance))
    if t.options.gain_offset:
        shape, through = choice.parameters.log_weight.shape, choice.effects.transmissions > 0
        place = Layout(*shape, through=through).size
        report["gain_offset_db"] = NEPER * choice.parameters.log_gain
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
            t.chains, choice.parameters.log_gains, known, *side_lobes(t, choice), strict=True
        )
    }
    report["unexplained"] = {}
    for k, rows in wrong.items():
        where = t.observations[k].place
        report["unexplained"].setdefault(t.names[where.data], []).extend(where.rows[rows].tolist())
    return report


def warn_of(data: Sequence[Measured], report: dict[str, Any]) -> None:
    """Warn of what a report says that nobody should miss."""
    if wrong := report["unexplained"]:
        count = sum(len(one) for one in data if isinstance(one, Readings))
        listed = "; ".join(f"{len(rows)} of {name!r}, rows {some_of(rows)}" for name, rows in wrong.items())
        warn(
            f"ds: {sum(map(len, wrong.values()))} of {count} readings are taken for wrong and left out ({listed}): "
            'report["unexplained"] lists them'
        )
    much_db = 1.0
    hanging = {name: one for name, one in report["chains"].items() if one["side_lobe_std_db"] > much_db}
    if hanging:
        listed = ", ".join(
            f"{name!r} ({100 * one['side_lobe_share']:.0f} % of its readings, {one['side_lobe_std_db']:.1f} dB)"
            for name, one in hanging.items()
        )
        warn(
            f"ds: gains of chains hang on the level of side lobes, taken to be known to {SIDE_LOBES_DB:g} dB: {listed}; "
            "measure the pattern beyond its main lobe, or turn the antenna to what it is to see"
        )
    missed = report["left_out"]
    little_db = max(missed["error_db"], 0.5)
    for name in ("diffraction", "transmission"):
        large = [db for db in missed[name] if db > little_db]
        if large:
            warn(
                f"{name} is not modelled, but would add {np.median(large):.1f} dB to all power of {len(large)} of "
                f"{len(missed[name])} blocked receivers, as estimated; where it is in what was read, something else was fitted to "
                "it: warprrf.relevance tells more"
            )
