"""What differs within a material group: a gain for each surface element and each cell of it, held close to one.

Photos tell materials apart only so far, and a mesh misses what it misses: that is the gain of single bounces. Light
that surfaces send on to each other has a gain of its own, because it is known less well: elements are half a metre
wide, and of further bounces some are left out. (Sionna RT's rays scatter at the same points whatever the receiver, so
its dark corners have a texture that can be learned.)

Both are fitted by Gauss-Newton with conjugate gradients: the Jacobian is the receiver beam after a sparse matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_diag, csr_matrix, hstack, identity, vstack
from scipy.sparse.linalg import LinearOperator, cg

from warprrf.rf.fields.bistatic.fit import NEPER, huber
from warprrf.rf.fields.bistatic.materials import Materials
from warprrf.rf.fields.bistatic.render import render
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.transport import ReceiverView
from warprrf.rf.spectra.beam import BeamOperator


@dataclass(frozen=True)
class ResidualFit:
    """How the gains of elements and cells are fitted.

    Attributes:
        deviations: a priori of the gains of elements and of cells from 1 [nepers]: for single bounces, and for light
            that is sent on.
        largest: gain [nepers].
        longest: step of a gain, in standard deviations.
        rounds: Gauss-Newton steps.
        conjugate_steps: of conjugate gradients in each.
        noise_db, huber_db: as of :class:`warprrf.rf.fields.bistatic.fit.GroupFit`.
    """

    deviations: tuple[tuple[float, float], tuple[float, float]] = ((0.5, 0.5), (1.0, 2.0))
    largest: float = 4.0
    longest: float = 3.0
    rounds: int = 4
    conjugate_steps: int = 12
    noise_db: float = 3.0
    huber_db: float = 3.0


QUICK = ResidualFit(rounds=2, conjugate_steps=8)
"""A third of the steps, which find three quarters of what is to be found."""


@dataclass(frozen=True)
class Shares:
    """What cells give the pixels of one receiver before the beam, the rest of its spectrum after the beam, and the
    target, in units of N0.

    Attributes:
        single: single bounces, sparse, shape ``(N, X)``.
        further: light that is sent on, likewise.
        rest: shape ``(N,)``.
        target_db: 10 log10(P / N0 + 1), shape ``(N,)``.
    """

    single: csr_matrix
    further: csr_matrix
    rest: np.ndarray
    target_db: np.ndarray


def gather_shares(
    pixel: np.ndarray, face: np.ndarray, power: np.ndarray, pixels: int, surface: Surface
) -> csr_matrix:
    """Power of rays (K,) gathered by pixel and surface cell, shape ``(pixels, X)`` float32."""
    k = np.flatnonzero(power > 0)
    triples = power[k].astype(np.float32), (pixel[k], surface.cell[face[k]])
    return csr_matrix(triples, shape=(pixels, surface.cells))


def shares_of(
    view: ReceiverView,
    materials: Materials,
    sent: np.ndarray | None,
    beam: BeamOperator,
    floor: float,
    target_db: np.ndarray,
) -> Shares:
    """What cells give the pixels of one receiver under ``materials``, whose residual does not count.

    Args:
        sent: see :func:`warprrf.rf.fields.bistatic.render.sent_radiance`.
        target_db: what was measured, 10 log10(P / N0 + 1), shape ``(H, W)``.
    """
    bare = replace(materials, terms=replace(materials.terms, residual=False))
    found, surface = render(view, bare, beam, sent), view.transport.surface
    per_pixel, pixels = view.transport.grid.sub_pixels**2, target_db.size
    single, on = found.powers.single, found.powers.further.sent
    own = gather_shares(
        np.arange(len(single)) // per_pixel, view.hits.face.numpy(), single / floor, pixels, surface
    )
    further = gather_shares(on.ray // per_pixel, on.face, on.power / floor, pixels, surface)
    known = np.asarray((own + further).sum(axis=1)).reshape(target_db.shape)
    rest = np.maximum(found.image / floor - beam(known), 0.0)
    return Shares(own, further, rest.ravel(), target_db.ravel())


def fit_residual(
    shares: Sequence[Shares], beam: BeamOperator, surface: Surface, options: ResidualFit | None = None
) -> np.ndarray:
    """ln of each cell's gains over its group's, shape ``(2, X)``; zero where nothing is seen of it.

    A cell's gain is the product of its element's and its own, each log-normal about 1: few spectra move elements, many
    move cells.

    Args:
        shares: one for each training receiver.
        beam: the receiver beam.
        surface: whose cells they are.
        options: priors and steps.
    """
    o = options or ResidualFit()
    pixels, count = len(shares[0].target_db), len(shares)
    power = vstack([hstack([s.single, s.further]) for s in shares], format="csr")
    rest = np.stack([s.rest for s in shares], axis=1)
    target = np.stack([s.target_db for s in shares], axis=1)
    rows, columns = beam.shape

    def spread(values: np.ndarray, quick: bool = True) -> np.ndarray:
        image = (power @ values.astype(np.float32)).reshape(count, pixels).T
        return beam(image.reshape(rows, columns, count), quick=quick).reshape(pixels, count)

    def gather(image: np.ndarray) -> np.ndarray:
        back = beam.adjoint(image.astype(np.float32).reshape(rows, columns, count), quick=True)
        found: np.ndarray = power.T @ back.reshape(pixels, count).T.ravel()
        return found

    # Unknowns have unit variance a priori: elements and cells of single bounces, then of light that is sent on.
    cell = np.arange(surface.cells)
    member = csr_matrix((np.ones(len(cell)), (cell, surface.cell_element)))
    gains = block_diag(
        [hstack([element * member, own * identity(len(cell))]) for element, own in o.deviations], format="csr"
    )
    unknown = np.zeros(gains.shape[1])
    for _ in range(o.rounds):
        gain = np.exp(np.clip(gains @ unknown, -o.largest, o.largest))
        total = np.maximum(spread(gain, quick=False), 0.0) + rest
        error = NEPER * np.log1p(total) - target
        robust = huber(error, o.huber_db)[1] / o.noise_db**2
        slope = NEPER / (1.0 + total)

        def curvature(
            v: np.ndarray, gain: np.ndarray = gain, weight: np.ndarray = slope**2 * robust
        ) -> np.ndarray:
            found: np.ndarray = gains.T @ (gain * gather(weight * spread(gain * (gains @ v)))) + v
            return found

        gradient = gains.T @ (gain * gather(slope * robust * error)) + unknown
        system = LinearOperator((len(unknown),) * 2, matvec=curvature, dtype=np.float64)
        step = cg(system, -gradient, rtol=0.0, atol=1e-6, maxiter=o.conjugate_steps)[0]
        unknown += np.clip(step, -o.longest, o.longest)
    return np.clip(gains @ unknown, -o.largest, o.largest).reshape(2, -1)
