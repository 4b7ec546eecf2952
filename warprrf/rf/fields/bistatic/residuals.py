"""What differs within a material group: a gain for each surface element and each cell of it, held close to one.

Photos tell materials apart only so far, and a mesh misses what it misses: that is the gain of single bounces. Light
that surfaces send on to each other has a gain of its own, because it is known less well: elements are half a metre
wide, and of further bounces some are left out. (Sionna RT's rays scatter at the same points whatever the receiver, so
its dark corners have a texture that can be learned.)

Both are fitted by Gauss-Newton with conjugate gradients: the Jacobian is the measurement after a sparse matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from scipy.sparse import block_diag, csr_matrix, hstack, identity, vstack
from scipy.sparse.linalg import LinearOperator, cg

from warprrf.rf.fields.bistatic.fit import Target, huber
from warprrf.rf.fields.bistatic.materials import Materials
from warprrf.rf.fields.bistatic.measured import Measurement, read
from warprrf.rf.fields.bistatic.render import path_powers
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.transport import ReceiverView


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
    """What cells give the bins that a measurement of one receiver sums rays in, and the rest of what it reads, in units
    of N0.

    Attributes:
        single: single bounces, sparse, shape ``(B, X)``.
        further: light that is sent on, likewise.
        rest: readings of everything else, shape ``(N,)``.
        measured: how readings come from bins.
        target: what was read.
    """

    single: csr_matrix
    further: csr_matrix
    rest: np.ndarray
    measured: Measurement
    target: Target


def gather_shares(
    bins: np.ndarray, count: int, face: np.ndarray, power: np.ndarray, surface: Surface
) -> csr_matrix:
    """Power of rays (K,) gathered by their bin, -1 for none, and surface cell, shape ``(count, X)`` float32."""
    k = np.flatnonzero((power > 0) & (bins >= 0))
    triples = power[k].astype(np.float32), (bins[k], surface.cell[face[k]])
    return csr_matrix(triples, shape=(count, surface.cells))


def shares_of(
    view: ReceiverView,
    materials: Materials,
    sent: np.ndarray | None,
    measured: Measurement,
    unit: float,
    target: Target,
) -> Shares:
    """What cells give the readings of one receiver under ``materials``, whose residual does not count.

    Args:
        sent: see :func:`warprrf.rf.fields.bistatic.render.sent_radiance`.
        unit: path gain that the readings are in units of.
        target: what was read.
    """
    bare, surface = replace(materials, terms=replace(materials.terms, residual=False)), view.transport.surface
    powers, (bins, count) = path_powers(view, bare, sent), measured.bins(view)
    face = view.hits.face.numpy()
    own = gather_shares(bins, count, face, powers.single / unit, surface)
    # Gains of light sent on are learned under one transmitter alone.
    learned = powers.sent / unit * np.array_equal(view.transport.transmitter, materials.transmitter)
    further = gather_shares(bins, count, face, learned, surface)
    known = np.asarray((own + further).sum(axis=1)).reshape(-1, 1)
    rest = np.maximum(read(view, measured, powers) / unit - measured.of_bins(known)[:, 0], 0.0)
    return Shares(own, further, rest, measured, target)


def fit_residual(
    shares: Sequence[Shares], surface: Surface, options: ResidualFit | None = None
) -> np.ndarray:
    """ln of each cell's gains over its group's, shape ``(2, X)``; zero where nothing is seen of it.

    A cell's gain is the product of its element's and its own, each log-normal about 1: few spectra move elements, many
    move cells.

    Args:
        shares: one for each training receiver.
        surface: whose cells they are.
        options: priors and steps.
    """
    o = options or ResidualFit()
    power = vstack([hstack([s.single, s.further]) for s in shares], format="csr")
    rest = np.concatenate([s.rest for s in shares])
    target = Target.joined([s.target for s in shares])
    # Receivers that are measured alike go through the measurement together.
    batches = [list(own) for _, own in groupby(shares, key=lambda s: s.measured.alike)]
    bins = np.cumsum([0, *(len(b) * b[0].single.shape[0] for b in batches)])
    rows = np.cumsum([0, *(len(b) * len(b[0].rest) for b in batches)])

    def spread(values: np.ndarray, quick: bool = True) -> np.ndarray:
        power_of = power @ values.astype(np.float32)
        found = np.empty(rows[-1])
        for k, batch in enumerate(batches):
            table = power_of[bins[k] : bins[k + 1]].reshape(len(batch), -1).T
            found[rows[k] : rows[k + 1]] = batch[0].measured.of_bins(table, quick=quick).T.ravel()
        return found

    def gather(readings: np.ndarray) -> np.ndarray:
        back = np.empty(bins[-1], np.float32)
        for k, batch in enumerate(batches):
            table = readings[rows[k] : rows[k + 1]].reshape(len(batch), -1).T
            back[bins[k] : bins[k + 1]] = batch[0].measured.to_bins(table).T.ravel()
        return np.asarray(power.T @ back)

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
        error, slope = target.error(total), target.slope(total)
        robust = huber(error, o.huber_db)[1] / o.noise_db**2

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
