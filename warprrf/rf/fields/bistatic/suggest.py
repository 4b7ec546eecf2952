"""Where to measure next: greedy Bayesian experimental design (Chaloner and Verdinelli 1995) for what a fit learns.

That is the parameters of materials, and the gain of each surface element over its material: normal a priori and read
with errors as in fits, linearised about what the field holds. Readings are chosen one after another, each the one that
lowers the expected square error of the dB images of spectra at all candidates most (I-optimality). Materials are told
as if elements were known, and elements as if materials were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix, identity
from threadpoolctl import threadpool_limits

from warprrf.device import Progress
from warprrf.rf.fields.bistatic.fit import NEPER, GroupFit, priors
from warprrf.rf.fields.bistatic.materials import Layout, Materials
from warprrf.rf.fields.bistatic.measured import WeighedPaths
from warprrf.rf.fields.bistatic.observations import READING_ERROR_DB
from warprrf.rf.fields.bistatic.render import path_powers, sent_radiance
from warprrf.rf.fields.bistatic.residuals import ResidualFit
from warprrf.rf.fields.bistatic.response import jacobian, respond, with_further_bounces
from warprrf.rf.fields.bistatic.transport import Transport
from warprrf.rf.spectra.antenna import Pattern, sample_pattern
from warprrf.rf.spectra.spectrum import pixel_directions, pixel_of

SHAPE = (40, 80)
"""Pixels that are told apart around a receiver: as wide as a usual beam."""
NEGLIGIBLE = 0.01
"""Combinations of parameters of which a spectrum tells less [dB^2/neper^2] are left out: priors tell more."""


@dataclass(frozen=True)
class Pointings:
    """Antennas turned to directions ``toward`` (K, 3), unit vectors, with a gain over the angle off boresight."""

    toward: np.ndarray
    pattern: Pattern


@dataclass(frozen=True)
class Told:
    """What readings tell of materials and of single elements.

    Attributes:
        index: parameters of materials, shape ``(C,)``.
        root: they are told with precision ``root @ root.T`` [1/neper^2], shape ``(C, N)``.
        own: precision at which gains of elements over their material are told, of single bounces, then of light sent on
            [1/neper^2], shape ``(2 E,)``.
    """

    index: np.ndarray
    root: np.ndarray
    own: np.ndarray

    def scaled(self, by: float) -> Told:
        """The same with all precisions multiplied."""
        return Told(self.index, np.sqrt(by) * self.root, by * self.own)


@dataclass
class Known:
    """Sums of what was told: of all parameters of materials ``(F, F)`` and of elements' gains ``(2 E,)`` [1/neper^2]."""

    materials: np.ndarray
    own: np.ndarray

    def add(self, told: Told) -> None:
        """One more."""
        self.materials[np.ix_(told.index, told.index)] += told.root @ told.root.T
        self.own = self.own + told.own


class Sensitivity:
    """How readings at places depend on the parameters of materials.

    Args:
        transport: the geometry under the transmitter, on a grid of :data:`SHAPE`.
        materials: of its groups; what differs within a group is taken for unknown.
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
    def prior(self) -> Known:
        """What is known without any reading."""
        p, alike = self.parameters, np.ones(self.layout.groups)
        rows = priors(p, p, self.layout, GroupFit().deviations, alike)[1]
        deviations = [element for element, _ in ResidualFit().deviations]
        own = np.repeat(deviations, len(self.transport.surface.element_area)) ** -2.0
        return Known(rows.T @ rows, own)

    def pixels(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, csr_matrix]:
        """Powers of the spectrum's pixels at ``place`` (3,) in units of the floor, shape ``(P,)``, their derivatives to
        the parameters ``(C, P)``, which those are ``(C,)``, and what they have of each element's single bounces and
        of light that it sends on ``(P, 2 E)``."""
        t, terms, count = self.transport, self.materials.terms, SHAPE[0] * SHAPE[1]
        view = t.view(place, terms)
        pixel = np.ravel_multi_index(pixel_of(view.paths.arrival, SHAPE), SHAPE)
        sharp = np.zeros((len(pixel), count), np.float32)
        sharp[np.arange(len(pixel)), pixel] = 1.0
        apart = WeighedPaths(np.arange(count), identity(count, np.float32, "csr"), sharp)
        response = respond(view, apart, terms, self.floor).limited(terms)
        if terms.after_first_bounce:
            further = view, apart, self.materials, self._sent, self.floor
            response = with_further_bounces(response, *further, follow=True)
        powers, element = path_powers(view, self.materials, self._sent), t.surface.element
        lit, sent, elements = (
            np.flatnonzero(powers.single > 0),
            powers.further.sent,
            len(t.surface.element_area),
        )
        gain = np.append(element[view.hits.face.numpy()[lit]], elements + element[sent.face])
        power = np.append(powers.single[lit], sent.power) / self.floor
        own = csr_matrix((power, (np.append(lit, sent.ray), gain)), shape=(count, 2 * elements))
        return *jacobian(response.tied(self.material), self.parameters, self.layout), own

    def of(self, place: np.ndarray, pointings: Pointings | None) -> tuple[Told, list[Told]]:
        """What the spectrum at ``place`` (3,) tells, if each pixel is known to 1 dB, and what each of ``pointings`` does as
        fits weigh it, or the spectrum itself."""
        power, slope, index, own = self.pixels(place)
        image = slope * (NEPER / (1.0 + power)).astype(np.float32)
        strength, direction = np.linalg.eigh((image @ image.T).astype(float))
        kept = strength > NEGLIGIBLE
        single = np.asarray(own.power(2).T @ (NEPER / (1.0 + power)) ** 2)
        whole = Told(index, direction[:, kept] * np.sqrt(strength[kept]), single)
        if pointings is None:
            return whole, [whole.scaled(GroupFit().noise_db ** -2.0)]
        cosine = pointings.toward @ pixel_directions(SHAPE).reshape(-1, 3).T
        gain = sample_pattern(pointings.pattern, np.arccos(np.clip(cosine, -1.0, 1.0)))
        to_db = NEPER / (1.0 + gain @ power) / READING_ERROR_DB
        rows = zip((slope @ gain.T * to_db).T, (gain @ own * to_db[:, None]) ** 2, strict=True)
        return whole, [Told(index, of_materials[:, None], of_own) for of_materials, of_own in rows]


@threadpool_limits.wrap(limits=1, user_api="blas")  # small matrices: threads would wait for each other
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
    places, place_of = np.unique(candidates, axis=0, return_inverse=True)
    known, told = sensitivity.prior, {}
    square = Known(np.zeros_like(known.materials), np.zeros_like(known.own))
    everywhere = pointings and replace(pointings, toward=np.unique(pointings.toward, axis=0))
    for k, place in enumerate(np.concatenate([places, measured])):
        if k < len(places):
            mine = np.flatnonzero(place_of.reshape(-1) == k)
            turned = pointings and replace(pointings, toward=pointings.toward[mine])
            whole, found = sensitivity.of(place, turned)
            square.add(whole.scaled(len(mine)))
            told |= {int(c): found[j % len(found)] for j, c in enumerate(mine)}
        else:
            for one in sensitivity.of(place, everywhere)[1]:
                known.add(one)
        if progress is not None:
            progress("suggest", k + 1, len(places) + len(measured))
    return _greedy(told, square, known, n)


def _greedy(told: dict[int, Told], square: Known, known: Known, n: int) -> np.ndarray:
    """The ``n`` readings, each of which lowers the variances that ``square`` weighs most after those before it."""
    chosen: list[int] = []
    for _ in range(n):
        covariance = np.linalg.inv(known.materials)
        moved, falls = covariance @ square.materials @ covariance, {}
        for k in sorted(told.keys() - set(chosen)):
            one = told[k]
            part = np.ix_(one.index, one.index)
            within = np.eye(one.root.shape[1]) + one.root.T @ covariance[part] @ one.root
            falls[k] = float(np.trace(np.linalg.solve(within, one.root.T @ moved[part] @ one.root)))
            falls[k] += float(square.own @ (1.0 / known.own - 1.0 / (known.own + one.own)))
        chosen.append(max(falls, key=lambda k: falls[k]))
        known.add(told[chosen[-1]])
    return np.array(chosen, int)
