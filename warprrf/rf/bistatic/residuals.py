"""What differs within a material group: a gain for each surface element, held close to one.

Photos tell materials apart only so far, and a mesh misses what it misses. The residual is fitted by Gauss-Newton with
conjugate gradients: the Jacobian is the receiver beam after a sparse matrix, neither of which is ever formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warprrf.rf.beam import BeamOperator
from warprrf.rf.bistatic.fit import NEPER

ROUNDS = 4
CONJUGATE_STEPS = 12
DEVIATION = 0.5  # of an element's gain from its group's [nepers]
HUBER_DB = 3.0


@dataclass(frozen=True)
class Shares:
    """What each element gives the pixels of one receiver before the beam, in units of N0, as (pixel, element, power)
    triples, the rest of its spectrum after the beam, and the target.

    Attributes:
        pixel, element, power: shapes ``(E,)``.
        rest: shape ``(N,)``.
        target_db: 10 log10(P / N0 + 1), shape ``(N,)``.
    """

    pixel: np.ndarray
    element: np.ndarray
    power: np.ndarray
    rest: np.ndarray
    target_db: np.ndarray


def gather_shares(
    face_element: np.ndarray, power: np.ndarray, per_pixel: int, elements: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays (K,) gathered by pixel and element: pixel, element, power."""
    k = np.flatnonzero(power > 0)
    key = (k // per_pixel) * elements + face_element[k]
    unique, index = np.unique(key, return_inverse=True)
    return unique // elements, unique % elements, np.bincount(index.reshape(-1), power[k])


def fit_residual(
    shares: Sequence[Shares],
    beam: BeamOperator,
    elements: int,
    *,
    deviation: float = DEVIATION,
    noise_db: float = 3.0,
) -> np.ndarray:
    """ln of each element's gain over its group's, shape ``(elements,)``; zero where nothing is seen of it.

    Args:
        shares: one for each training receiver.
        beam: the receiver beam.
        elements: number of elements.
        deviation: standard deviation of the prior [nepers].
        noise_db: standard deviation of a pixel's error that it is weighed against; see :func:`fit_groups`.
    """
    pixels, count = len(shares[0].target_db), len(shares)
    pixel = np.concatenate([s.pixel + r * pixels for r, s in enumerate(shares)])
    element = np.concatenate([s.element for s in shares])
    power = np.concatenate([s.power for s in shares])
    rest = np.stack([s.rest for s in shares], axis=1)
    target = np.stack([s.target_db for s in shares], axis=1)
    rows, columns = beam.shape

    def spread(values: np.ndarray) -> np.ndarray:
        image = (
            np.bincount(pixel, values, minlength=count * pixels).astype(np.float32).reshape(count, pixels).T
        )
        return beam(image.reshape(rows, columns, count)).reshape(pixels, count)

    def gather(image: np.ndarray) -> np.ndarray:
        back = (
            beam.adjoint(image.astype(np.float32).reshape(rows, columns, count))
            .reshape(pixels, count)
            .T.ravel()
        )
        return back[pixel]

    r = np.zeros(elements)
    weight, ridge = 1.0 / noise_db**2, 1.0 / deviation**2
    for _ in range(ROUNDS):
        now = power * np.exp(r[element])
        total = np.maximum(spread(now), 0.0) + rest
        residual = NEPER * np.log1p(total) - target
        robust = weight * np.where(
            np.abs(residual) <= HUBER_DB, 1.0, HUBER_DB / np.maximum(np.abs(residual), 1e-9)
        )
        slope = NEPER / (1.0 + total)

        def curvature(
            v: np.ndarray, now: np.ndarray = now, slope: np.ndarray = slope, robust: np.ndarray = robust
        ) -> np.ndarray:
            image = slope * spread(now * v[element])
            return np.bincount(element, now * gather(slope * robust * image), minlength=elements) + ridge * v

        gradient = (
            np.bincount(element, now * gather(slope * robust * residual), minlength=elements) + ridge * r
        )
        step = _conjugate_gradients(curvature, -gradient)
        r = np.clip(r + np.clip(step, -1.5, 1.5), -4.0, 4.0)
    return r


def _conjugate_gradients(matrix: object, right: np.ndarray) -> np.ndarray:
    x = np.zeros_like(right)
    residual = right.copy()
    direction, size = residual.copy(), float(residual @ residual)
    for _ in range(CONJUGATE_STEPS):
        if size < 1e-12:
            break
        image = matrix(direction)  # type: ignore[operator]
        step = size / float(direction @ image)
        x += step * direction
        residual -= step * image
        new = float(residual @ residual)
        direction, size = residual + (new / size) * direction, new
    return x
