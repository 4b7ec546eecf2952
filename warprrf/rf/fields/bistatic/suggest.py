"""Where to measure next: greedy Bayesian experimental design (Chaloner and Verdinelli 1995) for what a fit learns.

That is the parameters of materials, normal a priori as in a fit, with its priors and errors of readings, linearised
about what the field holds. Readings are chosen one after another, each the one that lowers the expected mean square
error of the dB images of spectra at all candidates most (I-optimality). What differs within a material is left out: a
spectrum tells of the few surface elements that it sees well, which no choice of a few places changes much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix, identity

from warprrf.device import Progress
from warprrf.rf.fields.bistatic.fit import NEPER, GroupFit, priors
from warprrf.rf.fields.bistatic.materials import Layout, Materials
from warprrf.rf.fields.bistatic.measured import WeighedPaths
from warprrf.rf.fields.bistatic.observations import READING_ERROR_DB
from warprrf.rf.fields.bistatic.render import sent_radiance
from warprrf.rf.fields.bistatic.response import jacobian, respond, with_further_bounces
from warprrf.rf.fields.bistatic.transport import Transport
from warprrf.rf.spectra.antenna import Pattern, sample_pattern
from warprrf.rf.spectra.spectrum import pixel_directions, pixel_of

SHAPE = (40, 80)
"""Pixels that are told apart around a receiver: as wide as a usual beam."""


@dataclass(frozen=True)
class Pointings:
    """Antennas turned to directions ``toward`` (K, 3), unit vectors, with a gain over the angle off boresight."""

    toward: np.ndarray
    pattern: Pattern


@dataclass(frozen=True)
class Told:
    """What readings tell of the parameters ``index`` (C,): their precision is ``root @ root.T`` [1/neper^2], root of
    shape ``(C, N)``."""

    index: np.ndarray
    root: np.ndarray


class Sensitivity:
    """How readings at places depend on the parameters of materials.

    Args:
        transport: the geometry under the transmitter, on a grid of :data:`SHAPE`.
        materials: of its groups; what differs within a group is left out.
        material: of each group, shape ``(G,)``.
        floor: path gain of a pixel, and of a reading, below which nothing is told.
    """

    def __init__(
        self, transport: Transport, materials: Materials, material: np.ndarray, floor: float
    ) -> None:
        self.transport, self.material, self.floor = transport, material, floor
        self.materials = replace(materials, terms=replace(materials.terms, residual=False))
        self.parameters = materials.parameters.take(np.unique(material, return_index=True)[1])
        lobes, terms = self.parameters.log_weight.shape[1], materials.terms
        self.layout = Layout(int(material.max()) + 1, lobes, indirect=terms.indirect, gain=False)
        self._sent = sent_radiance(transport, self.materials)

    @property
    def prior(self) -> np.ndarray:
        """Precision of the parameters without any reading [1/neper^2], shape ``(F, F)``."""
        surface = self.transport.surface
        area = np.bincount(self.material[surface.element_group], surface.element_area, self.layout.groups)
        rows = priors(self.parameters, self.parameters, self.layout, GroupFit().deviations, area)[1]
        return np.asarray(rows.T @ rows)

    def pixels(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Powers of the spectrum's pixels at ``place`` (3,) in units of the floor, shape ``(P,)``, their derivatives to
        the parameters ``(C, P)``, and which those are ``(C,)``."""
        terms, count = self.materials.terms, SHAPE[0] * SHAPE[1]
        view = self.transport.view(place, terms)
        pixel = np.ravel_multi_index(pixel_of(view.paths.arrival, SHAPE), SHAPE)
        one = np.ones(len(pixel), np.float32)
        own = csr_matrix((one, (np.arange(len(pixel)), pixel)), shape=(len(pixel), count)).toarray()
        apart = WeighedPaths(np.arange(count), identity(count, np.float32, "csr"), own)
        response = respond(view, apart, terms, self.floor).limited(terms)
        if terms.after_first_bounce:
            further = view, apart, self.materials, self._sent, self.floor
            response = with_further_bounces(response, *further, follow=True)
        return jacobian(response.tied(self.material), self.parameters, self.layout)

    def of(self, place: np.ndarray, pointings: Pointings | None) -> tuple[Told, list[Told]]:
        """Of ``place``: derivatives of its dB image, scaled so that their squares sum to the mean square error
        [dB/neper], and what each of ``pointings`` tells; one for a whole spectrum."""
        power, slope, index = self.pixels(place)
        image = _compressed(slope * (NEPER / (1.0 + power)))
        told = [image / GroupFit().noise_db]
        if pointings is not None:
            cosine = pointings.toward @ pixel_directions(SHAPE).reshape(-1, 3).T
            gain = sample_pattern(pointings.pattern, np.arccos(np.clip(cosine, -1.0, 1.0)))
            read = (slope @ gain.T) * (NEPER / (1.0 + gain @ power)) / READING_ERROR_DB
            told = list(read.T[:, :, None])
        return Told(index, image / np.sqrt(len(power))), [Told(index, root) for root in told]


def _compressed(slopes: np.ndarray) -> np.ndarray:
    """A root ``(C, N)`` of the same square as ``slopes`` (C, P), with no more columns than rows."""
    return np.asarray(np.linalg.qr(slopes.T, mode="r").T)


def suggest(
    sensitivity: Sensitivity,
    candidates: np.ndarray,
    n: int,
    *,
    measured: np.ndarray,
    pointings: Pointings | None = None,
    progress: Progress | None = None,
) -> np.ndarray:
    """Indices of the ``n`` of ``candidates`` (C, 3) that tell most about spectra at all of them, best first.

    Args:
        measured: receivers that have been measured before, in every direction in which candidates would be [m], shape
            ``(R, 3)``.
        pointings: that each candidate would take, C of them; None for whole spectra.
        progress: called with the stage ``"suggest"``.
    """
    places, own = np.unique(candidates, axis=0, return_inverse=True)
    precision, square = sensitivity.prior, np.zeros_like(sensitivity.prior)
    told: dict[int, Told] = {}

    def add(total: np.ndarray, one: Told, times: int = 1) -> None:
        total[np.ix_(one.index, one.index)] += times * one.root @ one.root.T

    everywhere = pointings and replace(pointings, toward=np.unique(pointings.toward, axis=0))
    for k, place in enumerate(np.concatenate([places, measured])):
        if k < len(places):
            mine = np.flatnonzero(own.reshape(-1) == k)
            turned = pointings and replace(pointings, toward=pointings.toward[mine])
            image, found = sensitivity.of(place, turned)
            add(square, image, len(mine))
            told |= {int(c): found[j % len(found)] for j, c in enumerate(mine)}
        else:
            for one in sensitivity.of(place, everywhere)[1]:
                add(precision, one)
        if progress is not None:
            progress("suggest", k + 1, len(places) + len(measured))
    chosen: list[int] = []
    for _ in range(n):
        covariance = np.linalg.inv(precision)
        moved = covariance @ square @ covariance

        def fall(k: int, covariance: np.ndarray = covariance, moved: np.ndarray = moved) -> float:
            """Of the sum of square errors, if candidate ``k`` is read too (matrix inversion lemma)."""
            root, part = told[k].root, np.ix_(told[k].index, told[k].index)
            within = np.eye(root.shape[1]) + root.T @ covariance[part] @ root
            return float(np.trace(np.linalg.solve(within, root.T @ moved[part] @ root)))

        left = sorted(told.keys() - set(chosen))
        chosen.append(left[int(np.argmax([fall(k) for k in left]))])
        add(precision, told[chosen[-1]])
    return np.array(chosen, int)
