"""Which surfaces are of one material: decided by colour first, then by what the spectra say.

Photos tell materials apart only so far. Once materials have parameters, each group of faces is tried as every other
material: what the objective would rise or fall by is known without a new fit, because a spectrum is linear in what its
groups scatter. Materials that are as well described by another one join it, and a group that another material describes
better goes over. Fewer parameters, and purer materials, are learned better from the same spectra.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warprrf.rf.em.half_spaces import fresnel_curves
from warprrf.rf.fields.bistatic.fit import (
    NEPER,
    Parameters,
    View,
    huber,
    predict,
    scattered_share,
    specular_power,
)

LOOK_COST = 3.0  # what one unit of difference in look, squared, counts as in the objective
MOST_LOOK = 9.0
JOIN = 30.0  # rise of the objective that a material of its own must be worth
MOVE = -4.0  # fall of the objective that a group must bring to go over


def regroup(
    views: Sequence[View],
    p: Parameters,
    material: np.ndarray,
    look: np.ndarray,
    area: np.ndarray,
    *,
    noise_db: float = 3.0,
) -> tuple[np.ndarray, Parameters]:
    """Materials of the groups anew, shape ``(G,)``, numbered without gaps, and the parameters of those left.

    Args:
        views: of the training receivers, by groups.
        p: parameters of the materials.
        material: of each group now.
        look: of each group, shape ``(G, 4)``; see :class:`warprrf.rf.fields.bistatic.surface.Surface`.
        area: of each group [m^2].
        noise_db: as in :func:`warprrf.rf.fields.bistatic.fit.fit_groups`.
    """
    material = material.copy()
    count = len(p.log_excess)
    typical = _mean_look(look, material, area, count)

    # whole materials first, small ones before large ones
    cost = _costs([v.tied(material) for v in views], p, np.arange(count), noise_db) + _look_cost(
        typical, typical
    )
    np.fill_diagonal(cost, np.inf)
    size = np.bincount(material, area, minlength=count)
    target = np.arange(count)
    touched = np.zeros(count, bool)
    for m in np.argsort(size):
        if touched[m]:
            continue
        k = int(np.where(target == np.arange(count), cost[m], np.inf).argmin())
        if cost[m, k] < JOIN:
            target[m] = k
            touched[k] = True  # what takes others in stays itself this time
    material = target[material]

    # then single groups
    typical = _mean_look(look, material, area, count)
    alive = np.unique(material)
    cost = _costs(views, p, material, noise_db) + _look_cost(look, typical)
    rows = np.arange(len(material))
    change = cost - cost[rows, material][:, None]
    change[:, np.setdiff1d(np.arange(count), alive)] = np.inf
    best = change.argmin(axis=1)
    moves = change[rows, best] < MOVE
    material = np.where(moves, best, material)
    left, material = np.unique(material, return_inverse=True)
    return material.reshape(-1), p.take(left)


def _mean_look(look: np.ndarray, material: np.ndarray, area: np.ndarray, count: int) -> np.ndarray:
    size = np.maximum(np.bincount(material, area, minlength=count), 1e-12)
    return np.stack(
        [np.bincount(material, area * look[:, k], minlength=count) / size for k in range(look.shape[1])],
        axis=1,
    )


def _look_cost(look: np.ndarray, typical: np.ndarray) -> np.ndarray:
    gap = ((look[:, None] - typical[None]) ** 2).sum(axis=2)
    return LOOK_COST * np.minimum(np.nan_to_num(gap, nan=MOST_LOOK), MOST_LOOK)


def _costs(views: Sequence[View], p: Parameters, owner: np.ndarray, noise_db: float) -> np.ndarray:
    """Rise of the objective if one unit (a view's group) alone became each material, ``(units, materials)``.

    ``owner`` is the material of each unit now.
    """
    curves = fresnel_curves()
    count = len(p.log_excess)
    alpha = curves.at(curves.coordinates, p.log_excess)[0]
    mix = (p.weight[:, :, None] * alpha[:, None, :]).reshape(count, -1).astype(np.float32)
    share = scattered_share(p).astype(np.float32)
    out = np.zeros((len(owner), count))
    for view in views:
        power = predict(view.tied(owner), p)
        loss = huber(NEPER * np.log1p(power) - view.target_db)[0].sum()
        met = view.path_group >= 0
        now = np.where(met, owner[np.where(met, view.path_group, 0)], -1)
        strength = specular_power(view.gain, now, view.cosine, view.turn, p)[0]
        units = np.unique(np.concatenate([view.groups, view.again_group, view.path_group[met]]))
        for unit in units:
            change = np.zeros((len(power), count), np.float32)
            a = np.searchsorted(view.groups, unit)
            if a < len(view.groups) and view.groups[a] == unit:
                own = view.basis[:, a].reshape(len(power), -1)
                change += own @ (mix - mix[owner[unit]]).T
            c = np.searchsorted(view.again_group, unit)
            if c < len(view.again_group) and view.again_group[c] == unit:
                change += view.again[:, c, None] * (share - share[owner[unit]])
            paths = np.flatnonzero((view.path_group == unit).any(axis=1))
            if len(paths):
                trial = np.repeat(now[paths][None], count, axis=0)
                own = np.broadcast_to(view.path_group[paths] == unit, trial.shape)
                trial = np.where(own, np.arange(count)[:, None, None], trial).reshape(-1, trial.shape[2])
                gain = np.tile(view.gain[paths], count)
                cosine, turn = (np.tile(a[paths], (count, 1)) for a in (view.cosine, view.turn))
                new = specular_power(gain, trial, cosine, turn, p)[0].reshape(count, -1)
                change += ((new - strength[paths]).astype(np.float32) @ view.beam[paths]).T
            trial_db = NEPER * np.log1p(np.maximum(power[:, None] + np.exp(p.log_gain) * change, 0.0))
            out[unit] += (huber(trial_db - view.target_db[:, None])[0].sum(axis=0) - loss) / noise_db**2
    return out
