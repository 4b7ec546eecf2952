"""What differs within a material group: a gain for each surface element and each texel of it, held close to one.

Photos tell materials apart only so far, and a mesh misses what it misses: that is the gain of single bounces. Light
that surfaces send on to each other has a gain of its own, because it is known less well: elements are half a metre
wide, and of further bounces some are left out. (Sionna RT's rays scatter at the same points whatever the receiver, so
its dark corners have a texture that can be learned.)

Both are fitted by Gauss-Newton with conjugate gradients: the Jacobian is the receiver beam after a sparse matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, hstack, identity, vstack

from warprrf.rf.fields.bistatic.fit import HUBER_DB, NEPER
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.spectra.beam import BeamOperator

ROUNDS, QUICK_ROUNDS = 4, 2
CONJUGATE_STEPS, QUICK_STEPS = 12, 8
DEVIATIONS = ((0.5, 0.5), (1.0, 2.0))
"""Of the gains of elements and of texels from 1 [nepers]: for single bounces, and for light that is sent on."""
LARGEST = 4.0  # gain [nepers]
LONGEST_STEP = 3.0  # of a gain, in standard deviations


@dataclass(frozen=True)
class Shares:
    """What texels give the pixels of one receiver before the beam, the rest of its spectrum after the beam, and the
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
    """Power of rays (K,) gathered by pixel and texel, shape ``(pixels, X)`` float32."""
    k = np.flatnonzero(power > 0)
    triples = power[k].astype(np.float32), (pixel[k], surface.texel[face[k]])
    return csr_matrix(triples, shape=(pixels, surface.texels))


def fit_residual(
    shares: Sequence[Shares],
    beam: BeamOperator,
    surface: Surface,
    *,
    noise_db: float = 3.0,
    quick: bool = False,
) -> np.ndarray:
    """ln of each texel's gains over its group's, shape ``(2, X)``; zero where nothing is seen of it.

    A texel's gain is the product of its element's and its own, each log-normal about 1 with :data:`DEVIATIONS`: few
    spectra move elements, many move texels.

    Args:
        shares: one for each training receiver.
        beam: the receiver beam.
        surface: whose texels they are.
        noise_db: standard deviation of a pixel's error that gains are weighed against; see :func:`fit_groups`.
        quick: a third of the steps, which find three quarters of what is to be found.
    """
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

    # Unknowns have unit variance a priori: elements and texels of single bounces, then of light that is sent on.
    texel = np.arange(surface.texels)
    member = csr_matrix((np.ones(len(texel)), (texel, surface.texel_element)))
    either = [
        hstack([of_element * member, of_texel * identity(len(texel))]) for of_element, of_texel in DEVIATIONS
    ]
    gains = vstack(
        [hstack([either[0], csr_matrix(either[0].shape)]), hstack([csr_matrix(either[1].shape), either[1]])],
        format="csr",
    )
    unknown = np.zeros(gains.shape[1])
    rounds, steps = (QUICK_ROUNDS, QUICK_STEPS) if quick else (ROUNDS, CONJUGATE_STEPS)
    for _ in range(rounds):
        gain = np.exp(np.clip(gains @ unknown, -LARGEST, LARGEST))
        total = np.maximum(spread(gain, quick=False), 0.0) + rest
        residual = NEPER * np.log1p(total) - target
        robust = np.minimum(HUBER_DB / np.maximum(np.abs(residual), 1e-9), 1.0) / noise_db**2
        slope = NEPER / (1.0 + total)

        def curvature(
            v: np.ndarray, gain: np.ndarray = gain, weight: np.ndarray = slope**2 * robust
        ) -> np.ndarray:
            found: np.ndarray = gains.T @ (gain * gather(weight * spread(gain * (gains @ v)))) + v
            return found

        gradient = gains.T @ (gain * gather(slope * robust * residual)) + unknown
        unknown += np.clip(_conjugate_gradients(curvature, -gradient, steps), -LONGEST_STEP, LONGEST_STEP)
    return np.clip(gains @ unknown, -LARGEST, LARGEST).reshape(2, -1)


def _conjugate_gradients(
    matrix: Callable[[np.ndarray], np.ndarray], right: np.ndarray, steps: int
) -> np.ndarray:
    x = np.zeros_like(right)
    residual = right.copy()
    direction, size = residual.copy(), float(residual @ residual)
    for _ in range(steps):
        if size < 1e-12:
            break
        image = matrix(direction)
        step = size / float(direction @ image)
        x += step * direction
        residual -= step * image
        new = float(residual @ residual)
        direction, size = residual + (new / size) * direction, new
    return x
