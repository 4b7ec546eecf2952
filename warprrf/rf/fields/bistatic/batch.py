"""Readings of several observations as one table: parameters of materials are fitted to a few hundred readings at each of many
places, and what is computed of all at once costs a fraction of what each costs alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil

import numpy as np
from scipy.sparse import block_diag, csr_matrix

from warprrf.cache import cached_property
from warprrf.rf.fields.bistatic.observations import OWN_GAIN, Columns, Observation, Target, huber
from warprrf.rf.tracing.model import Effects, Layout, Parameters
from warprrf.rf.tracing.records import Materials, Records
from warprrf.rf.tracing.tracer import SPECULAR

MOST_NUMBERS = 2**26
"""Of the columns of one batch: 256 MB."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Observations at one carrier, N readings in all, one's after another's.

    Attributes:
        observations: B of them; phases count in all or in none.
        columns: what scatters in each, by groups.
        effects: what is modelled.
        material: of each group, shape ``(G,)``.
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
            numbers = len(material) * lobes * moments * sum(len(observations[k].target.db) for k in every)
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
        return [len(o.target.db) for o in self.observations]

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
        """Whether line of sight and mirrors add up by their phases."""
        return self.observations[0].measured.together is not None

    @cached_property
    def kept(self) -> list[np.ndarray]:
        """Of each observation the line of sight and mirrors that count, L in all; all of them where phases do."""
        every = [o.view.kept_paths(self.effects) | self.phases_count for o in self.observations]
        return [np.flatnonzero(own) for own in every]

    @cached_property
    def specular(self) -> Records:
        """Those paths: one launch serves all."""
        each = zip(self.observations, self.kept, strict=True)
        return Records.joined([o.view.records[SPECULAR].take(own) for o, own in each])

    @cached_property
    def path(self) -> csr_matrix:
        """Readings of unit power on each of them, in units of the floor, shape ``(L, N)``."""
        each = zip(self.observations, self.kept, strict=True)
        return block_diag([csr_matrix(o.path[own]) for o, own in each], format="csr")

    def power(self, materials: Materials) -> np.ndarray:
        """Predictions ``(N,)`` in units of each floor, without the gains of chains."""
        p = materials.parameters
        if self.phases_count:
            direct = np.concatenate([o.heard(self.effects, materials) for o in self.observations])
        else:
            direct = self.path.T @ self.specular.powers(materials).astype(np.float32)
        return np.asarray(p.gain * (self.by_materials.power(p) + direct), float)

    def slopes(self, materials: Materials, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of :meth:`power`, but of its common gain, ``(C, N)`` float32, and the places of those parameters ``(C,)``."""
        side = self.observations[0].view.tracer.surface.side_group
        place, index = layout.columns(self.material[self.specular.groups(side)])
        if self.phases_count:
            own = [o.heard_slopes(self.effects, materials, place, len(index)) for o in self.observations]
            table = np.concatenate(own, axis=1)
        else:
            rise = self.specular.slopes(materials, place, len(index))
            table = (csr_matrix(rise, dtype=np.float32).T @ self.path).toarray()
        scattered, also = self.by_materials.slopes(materials.parameters, layout)
        every = np.union1d(index, also)
        found = np.zeros((len(every), table.shape[1]), np.float32)
        found[np.searchsorted(every, index)] = table
        found[np.searchsorted(every, also)] += scattered
        found *= np.float32(materials.parameters.gain)
        return found, every

    def gain(self, p: Parameters, power: np.ndarray) -> np.ndarray:
        """Of the measuring chain of each reading, where ``power`` is predicted, shape ``(N,)``."""
        each = [o.gain(p, power[own]) for o, own in zip(self.observations, self.own, strict=True)]
        return np.repeat(each, self.counts)

    def without_gain(self, table: np.ndarray, power: np.ndarray) -> np.ndarray:
        """Slopes ``table`` (C, N) of ``power`` (N,) where what changes all readings of an observation alike changes nothing."""
        for o, own in zip(self.observations, self.own, strict=True):
            if o.chain == OWN_GAIN:
                trust = np.ones(own.stop - own.start) if o.target.trust is None else o.target.trust
                known = (trust > 0).astype(float)
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
