"""Fitting material parameters to readings: Gauss-Newton in dB, damped as by Levenberg and Marquardt.

Of each material the fit learns the weights of its scattering lobes, one permittivity (the Fresnel curve that lobes and
mirror share) and the strength of its mirror reflection. All are positive, so their logarithms are fitted. Priors keep
what no spectrum shows near plausible values and tie a surface's scattered and mirrored shares together, because they
split one reflection (S^2 and 1 - S^2). Also free, where the readings can tell, are the share that each lets through (where
paths pass slabs), and of all together a common gain (an uncalibrated receiver), the power of the carrier that roughness goes with
(several carriers) and the gains of measuring chains.

Parameters are fitted to a few hundred readings at each of many places: a :class:`Batch` is one table of several places'
readings, because what is computed of all at once costs a fraction of what each costs alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import ceil
from typing import Any

import numpy as np
from scipy.linalg import solve
from scipy.linalg.blas import ssyrk
from scipy.sparse import block_diag, csr_matrix

from warprrf.cache import Cache, cached_property
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.bistatic.observations import (
    NOISE_DB,
    OWN_GAIN,
    Columns,
    Observation,
    Target,
    columns_of,
    huber,
)
from warprrf.rf.tracing.model import ROUGHNESS, Effects, Layout, Parameters
from warprrf.rf.tracing.records import Materials, Records
from warprrf.rf.tracing.tracer import SPECULAR

WEIGHT_STD, EXCESS_STD, MIRROR_STD = 2.0, 0.8, 1.5
"""Standard deviations a priori of lobe weights, permittivity less one and mirrored share from where a fit starts [nepers]."""
THROUGH_STD, KNOWN_THROUGH_STD = 1.5, 0.02
"""Those of the share let through from what it is before any measurement: where that is assumed, and of a slab of known thickness
and permittivity. The latter is small because hundreds of pixels hold one path and err together."""

MOST_NUMBERS = 2**26
"""Of the columns of one batch: 256 MB."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Observations at one carrier, N readings in all, one's after another's.

    Attributes:
        observations: B of them; phases count in all or in none.
        columns, effects, material: as of :class:`Problem`.
    """

    observations: Sequence[Observation]
    columns: Columns
    effects: Effects
    material: np.ndarray

    @classmethod
    def several(
        cls,
        observations: Sequence[Observation],
        columns: Sequence[Columns],
        effects: Effects,
        material: np.ndarray,
    ) -> list[Batch]:
        """As few as may be, none of more numbers than :data:`MOST_NUMBERS` where one observation has not as many."""
        alike: dict[tuple[float, bool], list[int]] = {}
        for k, o in enumerate(observations):
            alike.setdefault((o.ratio, o.measured.together is None), []).append(k)
        found = []
        for every in alike.values():
            lobes, moments, _ = columns[every[0]].single.shape[1:]
            numbers = len(material) * lobes * moments * sum(len(observations[k].target) for k in every)
            count = max(ceil(numbers / MOST_NUMBERS), 1)
            for own in np.array_split(every, min(count, len(every))):
                parts = Columns.joined([columns[k] for k in own])
                found.append(cls([observations[k] for k in own], parts, effects, material))
        return found

    @property
    def ratio(self) -> float:
        """Carrier of the readings over that of the fit's parameters."""
        return self.observations[0].ratio

    @cached_property
    def own(self) -> list[slice]:
        """Readings of each observation."""
        return [slice(*ends) for ends in pairwise(np.cumsum([0, *self.counts]))]

    @property
    def counts(self) -> list[int]:
        """How many readings each observation has, ``(B,)``."""
        return [len(o.target) for o in self.observations]

    @cached_property
    def target(self) -> Target:
        """What was read."""
        return Target.joined([o.target for o in self.observations])

    @cached_property
    def huber_db(self) -> np.ndarray:
        """Of each reading, see :class:`Observation`, shape ``(N,)``."""
        return np.repeat([o.huber_db for o in self.observations], self.counts)

    @cached_property
    def chain(self) -> np.ndarray:
        """Of each observation, shape ``(B,)``."""
        return np.array([o.chain for o in self.observations])

    @cached_property
    def by_materials(self) -> Columns:
        """Columns of materials instead of groups."""
        return self.columns.by_materials(self.material)

    @property
    def phases_count(self) -> bool:
        """Whether paths without scattering add up by their phases."""
        return self.observations[0].measured.together is not None

    @cached_property
    def counted(self) -> list[np.ndarray]:
        """Of each observation the paths without scattering that count, L in all; all of them where phases do."""
        every = [o.view.counted_paths(self.effects) | self.phases_count for o in self.observations]
        return [np.flatnonzero(own) for own in every]

    @cached_property
    def specular(self) -> Records:
        """Those paths: one launch serves all."""
        each = zip(self.observations, self.counted, strict=True)
        return Records.joined([o.view.records[SPECULAR].take(own) for o, own in each])

    @cached_property
    def path(self) -> csr_matrix:
        """Readings of unit power on each of them, in units of the floor, shape ``(L, N)``."""
        each = zip(self.observations, self.counted, strict=True)
        return block_diag([csr_matrix(o.path[own]) for o, own in each], format="csr")

    def power(self, materials: Materials) -> np.ndarray:
        """Predictions ``(N,)`` in units of each floor, without the gains of chains."""
        p = materials.parameters
        if self.phases_count:
            direct = np.concatenate([o.coherent_power(self.effects, materials) for o in self.observations])
        else:
            direct = self.path.T @ self.specular.powers(materials).astype(np.float32)
        return np.asarray(p.gain * (self.by_materials.power(p) + direct), float)

    def slopes(self, materials: Materials, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of :meth:`power`, but of its common gain, ``(C, N)`` float32, and the places of those parameters ``(C,)``."""
        side, by_materials = self.observations[0].view.tracer.surface.side_group, self.by_materials
        met = self.material[self.specular.groups(side)]
        place, index = layout.columns(np.concatenate([met, by_materials.groups, by_materials.senders]))
        found = by_materials.slopes(materials.parameters, layout, place, len(index))
        if self.phases_count:
            own = [o.coherent_slopes(self.effects, materials, place, len(index)) for o in self.observations]
            found += np.concatenate(own, axis=1)
        else:
            rise = csr_matrix(self.specular.slopes(materials, place, len(index)), dtype=np.float32)
            direct = (rise.T @ self.path).tocoo()
            found[direct.row, direct.col] += direct.data
        found *= np.float32(materials.parameters.gain)
        return found, index

    def gain(self, p: Parameters, power: np.ndarray) -> np.ndarray:
        """Of the measuring chain of each reading, where ``power`` is predicted, shape ``(N,)``."""
        each = [o.gain(p, power[own]) for o, own in zip(self.observations, self.own, strict=True)]
        return np.repeat(each, self.counts)

    def without_gain(self, table: np.ndarray, power: np.ndarray) -> np.ndarray:
        """Slopes ``table`` (C, N) of ``power`` (N,) where what changes all readings of an observation alike changes nothing."""
        for o, own in zip(self.observations, self.own, strict=True):
            if o.chain == OWN_GAIN:
                known = (o.target.trust > 0).astype(float)
                alike = table[:, own] @ known / max(float(known @ power[own]), 1e-300)
                table[:, own] -= alike[:, None] * power[own]
        return table

    def losses(self, power: np.ndarray) -> np.ndarray:
        """Squared errors (N,) of predicted readings as they count [dB^2]."""
        each = zip(self.observations, self.own, strict=True)
        return np.concatenate([o.losses(power[own]) for o, own in each])

    def fit_loss(self, power: np.ndarray) -> np.ndarray:
        """The same as a fit counts them, large errors linearly, shape ``(N,)``."""
        return huber(self.target.error(power), self.huber_db)[0]


@dataclass(frozen=True, eq=False)
class Problem:
    """What parameters of materials are fitted to: observations, and how light comes to what scatters it last.

    Attributes:
        observations: of the training receivers.
        columns: what scatters in each, by groups.
        effects: what is modelled.
        material: of each group, shape ``(G,)``.
        chains: measuring chains whose gain is unknown.
        gain_offset: whether a gain common to all paths is free.
        energy_std: standard deviation a priori of the scattered and the mirrored share, added, from one.
        known_through: ln of the share that materials let through before any measurement, and its deviation, shape ``(2, M)``; None
            for that of the start.
    """

    observations: Sequence[Observation]
    columns: Sequence[Columns]
    effects: Effects
    material: np.ndarray
    chains: int = 0
    gain_offset: bool = False
    energy_std: float = 0.25
    known_through: np.ndarray | None = None
    _evaluated: Cache = field(init=False, repr=False, default_factory=lambda: Cache(1))

    @classmethod
    def of(
        cls,
        observations: Sequence[Observation],
        effects: Effects,
        material: np.ndarray,
        p: Parameters,
        **settings: Any,
    ) -> Problem:
        """That of observations where what lights the second and later scatterers is as under parameters ``p`` of materials."""
        groups = p.take(material)
        columns = [columns_of(o, effects, groups) for o in observations]
        return cls(observations, columns, effects, material, **settings)

    @cached_property
    def batches(self) -> list[Batch]:
        """All observations, as few tables as may be."""
        return Batch.several(self.observations, self.columns, self.effects, self.material)

    def evaluated(self, p: Parameters) -> list[tuple[Batch, Materials, np.ndarray]]:
        """Batches, parameters ``p`` at their carriers as kernels take them, and predictions without the gains of chains, in units
        of each floor; the last are kept."""

        def evaluate(batch: Batch) -> tuple[Batch, Materials, np.ndarray]:
            tracer = batch.observations[0].view.tracer
            here = p.at_ratio(batch.ratio)
            materials = Materials(here, tracer.slabs, self.material, device=tracer.grid.device)
            return batch, materials, batch.power(materials)

        return self._evaluated.get(p.values, lambda: [evaluate(batch) for batch in self.batches])

    def linearised(
        self, p: Parameters, layout: Layout
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Of each batch predictions less what was read, as it counts [dB] ``(N,)``, derivatives ``(C, N)`` float32, and the
        places of those parameters ``(C,)``."""
        for batch, materials, power in self.evaluated(p):
            table, index = batch.slopes(materials, layout)
            if layout.gain:
                table = np.concatenate([table, power[None].astype(np.float32)])
                index = np.append(index, layout.common_gain)
            if batch.ratio != 1.0:
                slopes = layout.slopes_at_ratio(p, batch.ratio)[index]
                index = np.unique(slopes.indices)
                table = np.asarray(slopes[:, index].T @ table)
            gain = batch.gain(p, power)
            table = batch.without_gain(table, power)
            power = gain * power
            known = np.unique(batch.chain[batch.chain >= 0])
            if (batch.chain != -1).any():
                table = table * gain.astype(np.float32)
            if len(known):
                of_chains = np.where(np.repeat(batch.chain, batch.counts) == known[:, None], power, 0.0)
                table = np.concatenate([table, of_chains.astype(np.float32)])
                index = np.append(index, layout.first_chain + known)
            table *= batch.target.slope(power).astype(np.float32)
            yield batch.target.error(power), table.astype(np.float32, copy=False), index


@dataclass(frozen=True)
class Solution:
    """What was decided on, and what :func:`gauss_newton` found under it.

    Attributes:
        effects: what is modelled.
        material: of each group, shape ``(G,)``.
        parameters: of the materials.
        covariance: of the free ones (Laplace), shape ``(F, F)``; see :class:`Layout`.
        losses: objective after each step, per reading [dB^2].
    """

    effects: Effects
    material: np.ndarray
    parameters: Parameters
    covariance: np.ndarray
    losses: list[float]


def layout_of(problem: Problem, start: Parameters) -> Layout:
    """What is free."""
    carriers = {o.ratio for o in problem.observations}
    return Layout(
        *start.log_weight.shape, through=problem.effects.transmissions > 0, gain=problem.gain_offset,
        roughness=bool(carriers - {1.0}), chains=len(start.log_gains),
    )  # fmt: skip


def priors(
    p: Parameters,
    start: Parameters,
    layout: Layout,
    energy_std: float,
    known_through: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of the priors ``(K,)`` and their Jacobian ``(K, F)``: distance to the start, energy kept."""
    own = np.arange(layout.groups)
    gain_std, chain_std = 1.0, 10.0  # of the common gain and a chain's unknown one from one [nepers]
    carrier_std = 1.0  # of the power of the carrier that roughness goes with, from Ament's 2
    residuals, rows = [], []

    def add(values: np.ndarray, places: np.ndarray, slope: np.ndarray | float) -> None:
        block = np.zeros((len(values), layout.size))
        np.put_along_axis(block, places.reshape(len(values), -1), slope, axis=1)
        residuals.append(values)
        rows.append(block)

    for j, places in enumerate(layout.weight(own).T):
        add((p.log_weight[:, j] - start.log_weight[:, j]) / WEIGHT_STD, places, 1.0 / WEIGHT_STD)
    add((p.log_excess - start.log_excess) / EXCESS_STD, layout.excess(own), 1.0 / EXCESS_STD)
    add((p.log_mirror - start.log_mirror) / MIRROR_STD, layout.mirror(own), 1.0 / MIRROR_STD)
    if layout.through:
        of_start = start.log_through, np.full(layout.groups, THROUGH_STD)
        centre, std = of_start if known_through is None else known_through
        add((p.log_through - centre) / std, layout.let_through(own), 1.0 / std[:, None])
    if layout.gain:
        add(np.array([p.log_gain / gain_std]), np.array([layout.common_gain]), 1.0 / gain_std)
    if layout.roughness:
        from_ament = np.array([(p.roughness - ROUGHNESS) / carrier_std])
        add(from_ament, np.array([layout.roughness_exponent]), 1.0 / carrier_std)
    if layout.chains:
        add(p.log_gains / chain_std, layout.first_chain + np.arange(layout.chains), 1.0 / chain_std)
    shares = np.column_stack([p.weight, np.exp(p.log_mirror)])  # S^2 by lobes, and 1 - S^2
    places = np.column_stack([layout.weight(own), layout.mirror(own)])
    add((shares.sum(axis=1) - 1.0) / energy_std, places, shares / energy_std)
    return np.concatenate(residuals), np.concatenate(rows)


def gauss_newton(problem: Problem, start: Parameters, steps: int) -> Solution:
    """Levenberg-Marquardt on the parameters of materials.

    Args:
        problem: observations, and which groups are of one material.
        start: where the fit starts and the priors centre: those of a fit that goes on from another are about what that found.
        steps: most steps.
    """
    if len(start.log_gains) != problem.chains:
        gains = [_first_gain(problem, start, c) for c in range(problem.chains)]
        start = replace(start, log_gains=np.array(gains))
    layout = layout_of(problem, start)
    vector, damping, weight = layout.pack(start), 1e-3, 1.0 / NOISE_DB**2
    count = max(sum(len(o.target) for o in problem.observations), 1)
    hessian, losses = np.eye(layout.size), []
    if steps == 0:
        hessian = _normal_equations(problem, start, layout)[0]
        slopes = priors(start, start, layout, problem.energy_std, problem.known_through)[1]
        hessian += slopes.T @ slopes

    def total(x: np.ndarray) -> float:
        p = layout.unpack(x, start)
        prior = priors(p, start, layout, problem.energy_std, problem.known_through)[0]
        own = (batch.fit_loss(batch.gain(p, power) * power) for batch, _, power in problem.evaluated(p))
        return weight * sum(float(loss.sum()) for loss in own) + float((prior**2).sum())

    longest = 1.5  # change of a logarithm in a step
    tolerance, nothing = 1e-3, 1e-4  # relative falls that end the fit
    current = total(vector)
    for _ in range(steps):
        p = layout.unpack(vector, start)
        hessian, gradient = _normal_equations(problem, p, layout)
        r, j = priors(p, start, layout, problem.energy_std, problem.known_through)
        hessian += j.T @ j
        gradient += j.T @ r
        improved = False
        for _ in range(8):
            move = solve(hessian + damping * np.diag(np.diag(hessian)), -gradient, assume_a="pos")
            move = np.clip(move, -longest, longest)
            value = total(vector + move)
            improved = value < current
            if improved:
                break
            damping *= 5.0
        if not improved:
            break
        # Steps that were cut short, or do worse than the quadratic model says, are no sign of having arrived, unless they bring
        # nothing: a parameter that hardly counts may swing about its best value for long.
        expected = -float(move @ (2.0 * gradient + hessian @ move))
        honest = current - value > 0.5 * expected
        fall = (current - value) / current
        vector, current = vector + move, value
        damping = max(damping * 0.3, 1e-6) if honest else damping * 3.0
        losses.append(current / weight / count)
        if fall < (tolerance if honest and (np.abs(move) < longest).all() else nothing):
            break
    found, covariance = layout.unpack(vector, start), np.linalg.inv(hessian)
    return Solution(problem.effects, problem.material, found, covariance, losses)


def _normal_equations(problem: Problem, p: Parameters, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and gradient of the data term."""
    hessian, gradient = np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    some = 1024  # readings that are summed in single precision
    for batch, (error, table, index) in zip(problem.batches, problem.linearised(p, layout), strict=True):
        root = np.sqrt(huber(error, batch.huber_db)[1]) / NOISE_DB
        table *= root.astype(np.float32)
        square = np.zeros((len(index), len(index)))
        for first in range(0, table.shape[1], some):  # their upper triangles
            square += ssyrk(1.0, table[:, first : first + some].T, trans=1) if len(index) else 0.0
        hessian[np.ix_(index, index)] += square
        gradient[index] += table @ (root * error).astype(np.float32)
    return np.triu(hessian) + np.triu(hessian, 1).T, gradient


def _first_gain(problem: Problem, start: Parameters, chain: int) -> float:
    """ln of the gain that makes the chain's readings agree with what ``start`` predicts, in the median of their power."""
    ratio = [np.zeros(0)]
    for batch, _, expected in problem.evaluated(start):
        read = np.expm1(batch.target.db / NEPER)
        known = (read > 0) & (expected > 0) & ~batch.target.censored
        known &= np.repeat(batch.chain, batch.counts) == chain
        ratio.append(np.log(read[known] / expected[known]))
    every = np.concatenate(ratio)
    return float(np.median(every)) if len(every) else 0.0
