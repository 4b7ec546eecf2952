"""Which surfaces are of one material: decided by their appearance first, then by what the spectra say.

Colours or shapes tell materials apart only so far. Once materials have parameters, each group of faces is tried as every other
material: what the objective would rise or fall by is known without a new fit, because a spectrum is linear in what its
groups scatter. Materials that are as well described by another one join it, and a group that another material describes
better goes over. Fewer parameters, and purer materials, are learned better from the same spectra.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warprrf.rf.em.fresnel import fresnel_curves
from warprrf.rf.fields.bistatic.gauss_newton import Batch, Problem
from warprrf.rf.fields.bistatic.observations import NOISE_DB, Observation, huber
from warprrf.rf.tracing.model import Effects, Parameters
from warprrf.rf.tracing.records import Materials
from warprrf.rows import sums_of


def merge(
    problem: Problem, p: Parameters, appearance: np.ndarray, area: np.ndarray, *, by_shape: bool = False
) -> tuple[np.ndarray, Parameters]:
    """Materials of the groups anew, shape ``(G,)``, numbered without gaps, and the parameters of those left.

    Args:
        problem: observations, and the material of each group now.
        p: parameters of the materials.
        appearance: of each group, shape ``(G, K)``; see :class:`warprrf.rf.tracing.surface.Surface`.
        area: of each group [m^2].
        by_shape: whether only shapes tell groups apart.
    """
    count, material = len(p.log_excess), problem.material
    # In units of the objective: a squared difference of 1 in appearance; the rise that a material of its own must be worth;
    # and the fall that a group must bring to go over. Place and extent say less of a material than colour, a thing's parts
    # more.
    appearance_cost, join, move = (1.0, 15.0, 30.0) if by_shape else (3.0, 30.0, 4.0)
    typical = _mean_appearance(appearance, material, area, count)

    # whole materials first, small ones before large ones
    cost = _costs(problem, p, material, np.arange(count))
    cost += appearance_cost * _gaps(typical, typical)
    np.fill_diagonal(cost, np.inf)
    size = np.bincount(material, area, minlength=count)
    target = np.arange(count)
    touched = np.zeros(count, bool)
    for m in np.argsort(size):
        if touched[m]:
            continue
        k = int(np.where(target == np.arange(count), cost[m], np.inf).argmin())
        if cost[m, k] < join:
            target[m] = k
            touched[k] = True  # what takes others in stays itself this time
    material = target[material]

    # then single groups
    typical = _mean_appearance(appearance, material, area, count)
    alive = np.unique(material)
    cost = _costs(problem, p, np.arange(len(material)), material)
    cost += appearance_cost * _gaps(appearance, typical)
    rows = np.arange(len(material))
    change = cost - cost[rows, material][:, None]
    change[:, np.setdiff1d(np.arange(count), alive)] = np.inf
    best = change.argmin(axis=1)
    moves = change[rows, best] < -move
    material = np.where(moves, best, material)
    left, material = np.unique(material, return_inverse=True)
    return material.reshape(-1), p.take(left)


def _mean_appearance(
    appearance: np.ndarray, material: np.ndarray, area: np.ndarray, count: int
) -> np.ndarray:
    """Mean appearance of each material, shape ``(count, K)``."""
    size = np.maximum(np.bincount(material, area, minlength=count), 1e-12)
    return sums_of(area[:, None] * appearance, material, count) / size[:, None]


def _gaps(appearance: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """Squared difference of each appearance from each typical one, shape ``(units, materials)``."""
    gap = ((appearance[:, None] - typical[None]) ** 2).sum(axis=2)
    most = 9.0  # looks that differ more tell no more
    return np.asarray(np.minimum(np.nan_to_num(gap, nan=most), most))


def _costs(problem: Problem, p: Parameters, unit_of: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Rise of the objective if one unit alone became each material, ``(units, materials)``.

    Args:
        unit_of: unit of each group: its material, or itself.
        owner: material of each unit now.
    """
    curves, count = fresnel_curves(), len(p.log_excess)
    alpha = curves.at(curves.coordinates, p.log_excess)[0]
    out = np.zeros((len(owner), count))
    for batch, materials, power in problem.evaluated(p):
        here, c = materials.parameters, batch.columns
        mix = (here.weight[:, :, None] * alpha[:, None, :]).reshape(count, -1).astype(np.float32)
        share = here.scattered_share.astype(np.float32)
        gain = batch.gain(here, power)
        power, gain = gain * power, gain * here.gain
        loss = batch.fit_loss(power)
        mirrors = _mirror_changes(batch, materials, unit_of)
        met = np.array(list(mirrors), int)
        for unit in np.unique(np.concatenate([unit_of[c.groups], unit_of[c.senders], met])):
            change = mirrors.get(int(unit), np.zeros((count, len(power)), np.float32)).copy()
            for a in np.flatnonzero(unit_of[c.groups] == unit):
                change += (mix - mix[owner[unit]]) @ c.single[a].reshape(-1, len(power))
            for a in np.flatnonzero(unit_of[c.senders] == unit):
                change += (share - share[owner[unit]])[:, None] * c.further[a]
            own = np.flatnonzero(change.any(axis=0))
            new = np.maximum(power[own] + gain[own] * change[:, own], 0.0)
            error = batch.target.take(own).error(new)
            rise = huber(error, batch.huber_db[own])[0].sum(axis=1) - loss[own].sum()
            out[unit] += rise / NOISE_DB**2
    return out


def _mirror_changes(batch: Batch, materials: Materials, unit_of: np.ndarray) -> dict[int, np.ndarray]:
    """By unit the change of readings, shape ``(materials, N)``, by paths that meet it if it became each material."""
    p, found, specular = materials.parameters, dict[int, np.ndarray](), batch.specular
    meets, count = specular.index >= 0, len(p.log_excess)
    group = np.maximum(specular.index, 0)
    unit = np.where(meets, unit_of[group], -1)
    if batch.phases_count:
        for one in np.unique(unit[meets]):
            power = [_coherent_power(o, batch.effects, materials, unit_of == one) for o in batch.observations]
            found[int(one)] = np.concatenate(power, axis=1)
        return found
    now = np.where(meets, materials.material[group], -1).astype(np.int32)
    # Each group as if it were made of each material, as a slab of its own.
    slabs = np.repeat(materials.slabs[0], count), np.repeat(materials.slabs[1], count)
    every = Materials(p, slabs, np.tile(np.arange(count), len(unit_of)), device=materials.device)

    def index_of(rows: np.ndarray | slice, material: np.ndarray) -> np.ndarray:
        return np.where(material >= 0, group[rows] * count + material, -1).astype(np.int32)

    before = replace(specular, index=index_of(slice(None), now)).powers(every)
    for one in np.unique(unit[meets]):
        own = np.flatnonzero((unit == one).any(axis=1))
        trial = np.where(unit[own] == one, np.arange(count, dtype=np.int32)[:, None, None], now[own])
        several = specular.take(np.tile(own, count))
        several = replace(several, index=index_of(np.tile(own, count), trial.reshape(-1, now.shape[1])))
        change = several.powers(every).reshape(count, -1) - before[own]
        found[int(one)] = (batch.path[own].T @ change.T.astype(np.float32)).T
    return found


def _coherent_power(
    o: Observation, effects: Effects, materials: Materials, changes: np.ndarray
) -> np.ndarray:
    """The same of one observation where phases count: of all paths, where groups ``changes`` (G,) become each material."""
    p, now = materials.parameters, materials.material
    trials = (now, *(np.where(changes, material, now) for material in range(len(p.log_excess))))
    power = [o.coherent_power(effects, materials.by_materials(p, trial)) for trial in trials]
    return np.asarray(power[1:], np.float32) - np.float32(power[0])
