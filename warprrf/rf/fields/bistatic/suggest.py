"""Where to measure next: greedy Bayesian experimental design (Chaloner and Verdinelli 1995) on what a field predicts.

What is not known of surfaces is taken for gains in nepers, normal a priori: of the single bounces of each element, of
the light that it sends on, and of each group's mirrors. Each is the sum of one that all surfaces of its material share
and one of its own. A reading tells of a gain by how much of it is due to that gain, and predictions err likewise.
Readings are chosen one after another, each the one that lowers the expected square error most (I-optimality). Gains
that share a reading are told apart as if the others were known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from warprrf.device import Progress, with_progress
from warprrf.kernels.radio.records import MIRROR
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.bistatic.observations import NOISE_DB, READING_ERROR_DB
from warprrf.rf.spectra.antenna import Antenna, turned_gain
from warprrf.rf.spectra.spectrum import pixel_directions, pixel_of
from warprrf.rf.tracing.model import Model
from warprrf.rf.tracing.render import path_gains
from warprrf.rf.tracing.tracer import SPECULAR, Tracer

SHAPE = (40, 80)
"""Pixels that are told apart around a receiver: as wide as a usual beam."""
SHARED = (1.0, 0.3, 1.0)
OWN = (0.5, 0.3, 0.3)
"""Standard deviations of a material's gain, and of a surface's own over it [nepers]: for single bounces, for light that
is sent on (a mean over many surfaces, so it is known better), for mirrors."""


@dataclass(frozen=True)
class Unknowns:
    """Gains that are not known before any measurement.

    Attributes:
        material: whose gain each shares, shape ``(U,)``.
        shared: standard deviation of each material's gain [nepers], shape ``(M,)``.
        own: of each gain over its material's [nepers], shape ``(U,)``.
    """

    material: np.ndarray
    shared: np.ndarray
    own: np.ndarray

    @classmethod
    def of(cls, tracer: Tracer, material: np.ndarray) -> Unknowns:
        """Those of a surface; ``material`` (G,) is that of each group."""
        element, count = material[tracer.surface.element_group], int(material.max()) + 1
        return cls(
            np.concatenate([element, count + element, 2 * count + material]),
            np.repeat(SHARED, count),
            np.repeat(OWN, [len(element), len(element), len(material)]),
        )

    def variance(self, precision: np.ndarray) -> np.ndarray:
        """Of gains that readings tell with ``precision`` (U,) [1/neper^2], shape ``(U,)``: the posterior of
        x_u = m_material(u) + r_u."""
        left = 1.0 / (1.0 + self.own**2 * precision)  # of the variance of r
        told = np.bincount(self.material, precision * left, minlength=len(self.shared))
        shared = 1.0 / (1.0 / self.shared**2 + told)
        return np.asarray(self.own**2 * left + left**2 * shared[self.material])


class Sensitivity:
    """How readings and predictions at places depend on the gains.

    Args:
        tracer: the geometry under the transmitter, on a grid of :data:`SHAPE`.
        model: of its surfaces.
        floor: path gain of a pixel, and of a reading, below which nothing is told.
        antenna: what is turned to directions; None for whole spectra.
    """

    def __init__(self, tracer: Tracer, model: Model, floor: float, antenna: Antenna | None = None) -> None:
        self.tracer, self.model, self.floor, self.antenna = tracer, model, floor, antenna

    def powers(self, place: np.ndarray) -> tuple[csr_matrix, np.ndarray]:
        """Power that is due to each gain in each pixel at ``place`` (3,), shape ``(P, U)``, and all power ``(P,)``."""
        view = self.tracer.view(place, self.model.effects)
        found = path_gains(view, self.model)
        s, count = self.tracer.surface, SHAPE[0] * SHAPE[1]
        elements = len(s.element_area)
        pixel = np.ravel_multi_index(pixel_of(view.paths.arrival, SHAPE), SHAPE)
        table = view.records[SPECULAR]
        is_mirror = (table.kind == MIRROR) & (table.index >= 0)
        own, first = is_mirror.any(axis=1), is_mirror.argmax(axis=1)
        mirror = table.index[np.flatnonzero(own), first[own]]  # whatever slabs a path passes before
        parts = [(pixel[own], 2 * elements + mirror, found.specular[own])]
        rest = [(pixel[~own], found.specular[~own])]
        learned = self.model.learned_rows(self.tracer.transmitter)
        for name, power in found.powers.items():
            ray, gain = found.records[name].ray, found.records[name].residual_row
            if 0 <= gain < learned:
                parts.append((ray, elements * gain + s.element[view.cell(ray)], power))
            elif name != SPECULAR:
                # What mirrors show is taken for known, as line of sight is; so is what surfaces send on of another
                # transmitter's light, whose gains are others.
                rest.append((ray, power))
        row, unknown, power = (np.concatenate(column) for column in zip(*parts, strict=True))
        due = csr_matrix((power, (row, unknown)), shape=(count, 2 * elements + s.groups))
        ray, power = (np.concatenate(column) for column in zip(*rest, strict=True))
        known = np.bincount(ray, power, minlength=count)
        return due, np.asarray(due.sum(axis=1)).ravel() + known

    def of(self, place: np.ndarray, turned: np.ndarray | None) -> tuple[np.ndarray, csr_matrix]:
        """Of a spectrum at ``place``: squared derivatives, summed over its pixels [dB^2/neper^2], shape ``(U,)``. And the
        precisions at which readings there tell the gains [1/neper^2], shape ``(K, U)``: a row for each zenith and azimuth [rad] of
        ``turned`` (K, 2), or one for a whole spectrum."""
        table, total = self.powers(place)
        square = table.copy()
        square.data = (table.data * np.repeat(NEPER / (total + self.floor), np.diff(table.indptr))) ** 2
        summed = np.asarray(square.sum(axis=0)).ravel()
        if self.antenna is None or turned is None:
            return summed, csr_matrix(summed / NOISE_DB**2)
        gain = turned_gain(self.antenna, turned, pixel_directions(SHAPE).reshape(-1, 3))
        slope = NEPER * (gain @ table) / (gain @ total + self.floor)[:, None]
        least_db = 1e-3  # per neper: readings that change less tell nothing
        return summed, csr_matrix(np.where(slope > least_db, (slope / READING_ERROR_DB) ** 2, 0.0))


MeasuredPlaces = Sequence[tuple[Sensitivity, np.ndarray]]
"""Receivers (3,), each with how readings there depend on the gains, under its transmitter."""


def precision(
    measured: MeasuredPlaces,
    unknowns: Unknowns,
    turned: np.ndarray | None = None,
    progress: Progress | None = None,
) -> np.ndarray:
    """With which readings at all that was measured, at each ``turned`` to all of (K, 2), tell the gains [1/neper^2], shape
    ``(U,)``."""
    known = np.zeros(len(unknowns.material))
    for sensitivity, place in with_progress(measured, "suggest", progress):
        known += np.asarray(sensitivity.of(place, turned)[1].sum(axis=0)).ravel()
    return known


def suggest(
    sensitivity: Sensitivity,
    unknowns: Unknowns,
    candidates: np.ndarray,
    n: int,
    *,
    measured: MeasuredPlaces,
    turned: np.ndarray | None = None,
    progress: Progress | None = None,
) -> np.ndarray:
    """Indices of the ``n`` of ``candidates`` (C, 3) that tell most about spectra at all of them, best first.

    Args:
        measured: receivers that have been measured before, in every direction in which candidates would be [m].
        turned: zenith and azimuth that the antenna would be turned to at each candidate [rad], shape ``(C, 2)``; None for whole
            spectra.
        progress: called with the stage ``"suggest"``.
    """
    places, own = np.unique(candidates, axis=0, return_inverse=True)
    total, told = len(places) + len(measured), dict[int, csr_matrix]()
    square = np.zeros(len(unknowns.material))  # of predictions' derivatives
    for k, place in enumerate(places):
        mine = np.flatnonzero(own.reshape(-1) == k)
        whole, rows = sensitivity.of(place, None if turned is None else turned[mine])
        square += len(mine) * whole
        told |= {int(c): rows[j if len(rows.indptr) > 2 else 0] for j, c in enumerate(mine)}
        if progress is not None:
            progress("suggest", k + 1, total)
    every = None if turned is None else np.unique(turned, axis=0)
    after = None if progress is None else lambda stage, done, _: progress(stage, len(places) + done, total)
    known = precision(measured, unknowns, every, after)
    return _greedy(told, square, unknowns, known, n)


def _greedy(
    told: dict[int, csr_matrix], square: np.ndarray, unknowns: Unknowns, known: np.ndarray, n: int
) -> np.ndarray:
    """The ``n`` readings, each of which lowers the sum of ``square`` times variance most after those before it."""
    chosen: list[int] = []

    def with_reading(k: int) -> np.ndarray:
        more = known.copy()
        more[told[k].indices] += told[k].data
        return more

    for _ in range(n):
        left = sorted(told.keys() - set(chosen))
        errors = [square @ unknowns.variance(with_reading(k)) for k in left]
        chosen.append(left[int(np.argmin(errors))])
        known = with_reading(chosen[-1])
    return np.array(chosen, int)
