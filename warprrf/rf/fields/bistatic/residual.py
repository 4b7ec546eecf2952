"""What differs within a material group: gains of each surface element and each cell of it, held close to one.

Photos tell materials apart only so far, and a mesh misses what it misses: that is the gain of light straight from the
transmitter. All other light has a second gain, because it is known less well: elements are half a metre wide, and of further
bounces some are left out. (Sionna RT's rays scatter at the same points whatever the receiver, so
its dark corners have a texture that can be learned.)

Both are fitted by Gauss-Newton with conjugate gradients: the Jacobian is the measurement after a sparse matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from math import ceil

import numpy as np
from scipy.sparse import block_diag, csr_matrix, hstack, identity, vstack
from scipy.sparse.linalg import LinearOperator, cg

from warprrf.device import threads
from warprrf.rf.fields.bistatic.measured import read
from warprrf.rf.fields.bistatic.observations import NOISE_DB, Observation, huber
from warprrf.rf.tracing.model import Model
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import SPECULAR

AT_ONCE = 8  # receivers that go through a measurement together


@dataclass(frozen=True)
class Shares:
    """What cells give the bins that a measurement of one receiver sums rays in, and the rest of what it reads, in units
    of the floor.

    Attributes:
        observed: what was read there.
        power: of both kinds of light, sparse, shape ``(B, 2 X)``.
        rest: readings of everything else, shape ``(N,)``.
    """

    observed: Observation
    power: csr_matrix
    rest: np.ndarray


def shares_of(o: Observation, model: Model) -> Shares:
    """What cells give the readings of one receiver under ``model``, whose residual does not count."""
    bare = replace(model, effects=replace(model.effects, residual=False))
    gains, view = o.path_gains(bare), o.view
    unit = o.floor
    if o.chain != -1:
        unit = o.floor / o.gain(model.parameters, np.maximum(read(gains, o.measured), 0.0) / o.floor)
    (bins, count), cells = o.measured.bins(view), len(view.tracer.surface.cells)
    learned = model.learned_rows(view.tracer.transmitter)
    rows, columns, powers = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0, np.float32)]
    for name, power in gains.powers.items():
        records = gains.records[name]
        if name == SPECULAR or not 0 <= records.residual_row < learned:
            continue
        k = np.flatnonzero((power > 0) & (bins[records.ray] >= 0))
        ray = records.ray[k]
        rows.append(bins[ray])
        columns.append(cells * records.residual_row + view.cell(ray))
        powers.append((power[k] / unit).astype(np.float32))
    places = np.concatenate(rows), np.concatenate(columns)
    own = csr_matrix((np.concatenate(powers), places), shape=(count, 2 * cells))
    known = np.asarray(own.sum(axis=1)).reshape(-1, 1)
    rest = np.maximum(read(gains, o.measured) / unit - o.measured.of_bins(known)[:, 0], 0.0)
    return Shares(o, own, rest)


def fit_residual(shares: Sequence[Shares], surface: Surface, *, quick: bool = False) -> np.ndarray:
    """ln of each cell's gains over its group's, shape ``(2, X)``; zero where nothing is seen of it.

    A cell's gain is the product of its element's and its own, each log-normal about 1: few spectra move elements, many
    move cells.

    Args:
        shares: one for each training receiver.
        surface: whose cells they are.
        quick: with few steps, which find three quarters of what is to be found.
    """
    rounds, conjugate = (2, 8) if quick else (4, 12)  # Gauss-Newton steps, and of conjugate gradients in each
    enough = 0.02  # relative fall of the objective below which no step follows
    own_rows = [slice(*own) for own in pairwise(np.cumsum([0, *(len(s.rest) for s in shares)]))]
    # Receivers that are measured alike go through the measurement together, batches of them side by side.
    alike = [list(own) for _, own in groupby(shares, key=lambda s: s.observed.measured.batch_key)]
    batches = []
    for group in alike:
        ends = np.linspace(0, len(group), max(ceil(len(group) / AT_ONCE), 2) + 1).astype(int)
        batches += [group[a:b] for a, b in pairwise(ends) if b > a]
    powers = [vstack([s.power for s in batch], format="csr") for batch in batches]
    counts = np.cumsum([len(batch) * len(batch[0].rest) for batch in batches])

    def spread(values: np.ndarray, quick: bool = True) -> np.ndarray:
        single = values.astype(np.float32)

        def of(batch: list[Shares], power: csr_matrix) -> np.ndarray:
            table = (power @ single).reshape(len(batch), -1).T
            return batch[0].observed.measured.of_bins(table, quick=quick).T.ravel()

        return np.concatenate(list(pool.map(of, batches, powers)), dtype=np.float64)

    def gather(readings: np.ndarray) -> np.ndarray:
        def of(batch: list[Shares], power: csr_matrix, own: np.ndarray) -> np.ndarray:
            table = own.reshape(len(batch), -1).T
            return np.asarray(power.T @ batch[0].observed.measured.to_bins(table).T.ravel())

        parts = pool.map(of, batches, powers, np.split(readings, counts[:-1]))
        return np.sum(list(parts), axis=0)

    # Unknowns have unit variance a priori: elements and cells of single bounces, then of light that is sent on.
    deviations = ((0.5, 0.5), (1.0, 2.0))  # of elements and of cells of each from a gain of 1 [nepers]
    cell = np.arange(len(surface.cells))
    member = csr_matrix((np.ones(len(cell)), (cell, surface.element)))
    kinds = [hstack([element * member, own * identity(len(cell))]) for element, own in deviations]
    gains = block_diag(kinds, format="csr")
    largest, longest = 4.0, 3.0  # gain [nepers], and step of one in standard deviations
    unknown, before = np.zeros(gains.shape[1]), np.inf
    with ThreadPoolExecutor(threads()) as pool:
        for _ in range(rounds):
            gain = np.exp(np.clip(gains @ unknown, -largest, largest))
            pull, weight, now = spread(gain, quick=False), np.empty(counts[-1]), float(unknown @ unknown)
            for s, own in zip(shares, own_rows, strict=True):
                total = np.maximum(pull[own], 0.0) + s.rest
                error, slope = s.observed.target.error(total), s.observed.target.slope(total)
                loss, robust = (x / NOISE_DB**2 for x in huber(error, s.observed.huber_db))
                pull[own], weight[own], now = slope * robust * error, slope**2 * robust, now + loss.sum()
            if before > now > (1.0 - enough) * before:
                break
            before = now

            def curvature(v: np.ndarray, gain: np.ndarray = gain, weight: np.ndarray = weight) -> np.ndarray:
                readings = spread(gain * (gains @ v))
                readings *= weight
                return np.asarray(gains.T @ (gain * gather(readings)) + v)

            gradient = gains.T @ (gain * gather(pull)) + unknown
            system = LinearOperator((len(unknown),) * 2, matvec=curvature, dtype=np.float64)
            step = cg(system, -gradient, rtol=0.0, atol=1e-6, maxiter=conjugate)[0]
            unknown += np.clip(step, -longest, longest)
    return np.clip(gains @ unknown, -largest, largest).reshape(2, -1)
