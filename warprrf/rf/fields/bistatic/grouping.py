"""Which surfaces are of one material: decided by their look first, then by what the spectra say.

Colours or shapes tell materials apart only so far. Once materials have parameters, each group of faces is tried as every other
material: what the objective would rise or fall by is known without a new fit, because a spectrum is linear in what its
groups scatter. Materials that are as well described by another one join it, and a group that another material describes
better goes over. Fewer parameters, and purer materials, are learned better from the same spectra.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warprrf.rf.em.fresnel import fresnel_curves
from warprrf.rf.fields.bistatic.fit import GroupFit, Reading, huber
from warprrf.rf.fields.bistatic.materials import Parameters, mirror_power
from warprrf.rf.fields.bistatic.response import Response, predict


@dataclass(frozen=True)
class Regrouping:
    """What it takes to be of one material, in units of the fit's objective.

    Attributes:
        look_cost: of one unit of difference in look, squared.
        most_look: largest squared difference that counts: looks that differ more tell no more.
        join: rise that a material of its own must be worth.
        move: fall that a group must bring to go over.
    """

    look_cost: float = 3.0
    most_look: float = 9.0
    join: float = 30.0
    move: float = 4.0


BY_SHAPE = Regrouping(look_cost=1.0, join=15.0, move=30.0)
"""For groups that only shapes tell apart: place and extent say less of a material than colour, a thing's parts more."""


def regroup(
    readings: Sequence[Reading],
    p: Parameters,
    material: np.ndarray,
    look: np.ndarray,
    area: np.ndarray,
    options: Regrouping | None = None,
) -> tuple[np.ndarray, Parameters]:
    """Materials of the groups anew, shape ``(G,)``, numbered without gaps, and the parameters of those left.

    Args:
        readings: of the training receivers, by groups.
        p: parameters of the materials.
        material: of each group now.
        look: of each group, shape ``(G, K)``; see :class:`warprrf.rf.fields.bistatic.surface.Surface`.
        area: of each group [m^2].
        options: what it takes.
    """
    o, count = options or Regrouping(), len(p.log_excess)
    typical = _mean_look(look, material, area, count)

    # whole materials first, small ones before large ones
    cost = _costs([r.tied(material) for r in readings], p, np.arange(count))
    cost += _look_cost(typical, typical, o)
    np.fill_diagonal(cost, np.inf)
    size = np.bincount(material, area, minlength=count)
    target = np.arange(count)
    touched = np.zeros(count, bool)
    for m in np.argsort(size):
        if touched[m]:
            continue
        k = int(np.where(target == np.arange(count), cost[m], np.inf).argmin())
        if cost[m, k] < o.join:
            target[m] = k
            touched[k] = True  # what takes others in stays itself this time
    material = target[material]

    # then single groups
    typical = _mean_look(look, material, area, count)
    alive = np.unique(material)
    cost = _costs(readings, p, material) + _look_cost(look, typical, o)
    rows = np.arange(len(material))
    change = cost - cost[rows, material][:, None]
    change[:, np.setdiff1d(np.arange(count), alive)] = np.inf
    best = change.argmin(axis=1)
    moves = change[rows, best] < -o.move
    material = np.where(moves, best, material)
    left, material = np.unique(material, return_inverse=True)
    return material.reshape(-1), p.take(left)


def _mean_look(look: np.ndarray, material: np.ndarray, area: np.ndarray, count: int) -> np.ndarray:
    """Mean look of each material, shape ``(count, K)``."""
    size = np.maximum(np.bincount(material, area, minlength=count), 1e-12)
    sums = [np.bincount(material, area * channel, minlength=count) for channel in look.T]
    return np.stack(sums, axis=1) / size[:, None]


def _look_cost(look: np.ndarray, typical: np.ndarray, o: Regrouping) -> np.ndarray:
    gap = ((look[:, None] - typical[None]) ** 2).sum(axis=2)
    return o.look_cost * np.minimum(np.nan_to_num(gap, nan=o.most_look), o.most_look)


def _costs(readings: Sequence[Reading], p: Parameters, owner: np.ndarray) -> np.ndarray:
    """Rise of the objective if one unit (a reading's group) alone became each material, ``(units, materials)``.

    ``owner`` is the material of each unit now.
    """
    curves, fit = fresnel_curves(), GroupFit()
    common, count = p, len(p.log_excess)
    alpha = curves.at(curves.coordinates, p.log_excess)[0]
    out = np.zeros((len(owner), count))
    for reading in readings:
        r, p = reading.response, common.at_ratio(reading.ratio)
        mix = (p.weight[:, :, None] * alpha[:, None, :]).reshape(count, -1).astype(np.float32)
        share = p.scattered_share.astype(np.float32)
        power = predict(r.tied(owner), p)
        gain = reading.gain(p, power)
        power, gain = gain * power, gain * p.gain
        loss = huber(reading.target.error(power), fit.huber_db)[0].sum()
        reflects = r.path_group >= 0
        now = np.where(reflects, owner[np.where(reflects, r.path_group, 0)], -1)
        for unit in np.unique(np.concatenate([r.group, r.sender, r.path_group[reflects]])):
            change = _mirror_change(r, now, unit, p)
            for a in np.flatnonzero(r.group == unit):
                change += (mix - mix[owner[unit]]) @ r.bounce[a].reshape(-1, len(power))
            for c in np.flatnonzero(r.sender == unit):
                change += (share - share[owner[unit]])[:, None] * r.sent[c]
            error = reading.target.error(np.maximum(power + gain * change, 0.0))
            rise = huber(error, fit.huber_db)[0].sum(axis=1) - loss
            out[unit] += rise / fit.noise_db**2
    return out


def _mirror_change(r: Response, now: np.ndarray, unit: int, p: Parameters) -> np.ndarray:
    """Change of readings, shape ``(materials, N)``, by paths that meet ``unit`` if it became each material; ``now`` are
    the materials that the paths meet."""
    count, paths = len(p.log_excess), np.flatnonzero((r.path_group == unit).any(axis=1))
    if len(paths) == 0:
        return np.zeros((count, len(r.offset)), np.float32)
    if r.together is not None:
        each = [np.where(r.path_group == unit, material, now) for material in range(count)]
        heard = [
            r.together.received(r.together.amplitudes(r.path_power, groups, r.cosine, r.turn, p)[0])
            for groups in (now, *each)
        ]
        return np.asarray(heard[1:], np.float32) - np.float32(heard[0])
    own = np.broadcast_to(r.path_group[paths] == unit, (count, len(paths), now.shape[1]))
    trial = np.where(own, np.arange(count)[:, None, None], now[paths]).reshape(-1, now.shape[1])
    cosine, turn = (np.tile(a[paths], (count, 1)) for a in (r.cosine, r.turn))
    new = mirror_power(np.tile(r.path_power[paths], count), trial, cosine, turn, p)[0].reshape(count, -1)
    old = mirror_power(r.path_power[paths], now[paths], r.cosine[paths], r.turn[paths], p)[0]
    return np.asarray((new - old).astype(np.float32) @ r.path[paths])
