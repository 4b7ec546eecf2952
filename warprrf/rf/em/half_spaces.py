"""Reflection of half-spaces as a family of curves: one permittivity is one member, and what a fit moves along.

The family is tabulated once over permittivity and the cosine of incidence; values between are interpolated, with their
derivatives. A few components resolve the whole family, so that light may be gathered before the permittivity is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from warprrf.kernels.radio.bounce import MOMENTS
from warprrf.rf.em.fresnel import slab_reflection

COSINES = 257  # entries of tables over the cosine of incidence
_PERMITTIVITY = np.geomspace(0.05, 200.0, 97)  # of epsilon_r - 1; the last reflects like metal


@dataclass(frozen=True)
class FresnelCurves:
    """Power reflection of half-spaces, mean of TE and TM, as a family of curves over the cosine of incidence.

    Attributes:
        log_excess: ln(epsilon_r - 1) of each member, shape ``(97,)``.
        curves: reflection, shape ``(97, 257)``.
        moments: components that resolve the family, shape ``(3, 257)``.
        coordinates: of each member in them, shape ``(97, 3)``.
    """

    log_excess: np.ndarray
    curves: np.ndarray
    moments: np.ndarray
    coordinates: np.ndarray

    def at(self, table: np.ndarray, log_excess: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Rows of ``table`` (97, K) at ``log_excess`` (G,), clipped to the family, and derivatives, ``(G, K)``."""
        i, s, step = self._place(log_excess)
        s = s[:, None]
        return (1 - s) * table[i] + s * table[i + 1], (table[i + 1] - table[i]) / step

    def value(self, log_excess: ArrayLike, cosine: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Reflection (N,) at ``log_excess`` (N,) and ``cosine`` (N,), and its derivative to ``log_excess``."""
        i, s, step = self._place(log_excess)
        x = np.clip(np.asarray(cosine, float), 0.0, 1.0) * (COSINES - 1)
        j = np.minimum(x.astype(int), COSINES - 2)
        r = x - j
        low = (1 - r) * self.curves[i, j] + r * self.curves[i, j + 1]
        high = (1 - r) * self.curves[i + 1, j] + r * self.curves[i + 1, j + 1]
        return (1 - s) * low + s * high, (high - low) / step

    def even(self, log_excess: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Reflection under even light, 2 int F cos dcos, at ``log_excess`` (G,), and its derivative."""
        cosine = np.linspace(0.0, 1.0, COSINES)
        return tuple(rows @ cosine / cosine.sum() for rows in self.at(self.curves, log_excess))  # type: ignore[return-value]

    def _place(self, log_excess: ArrayLike) -> tuple[np.ndarray, np.ndarray, float]:
        """Row below each ``log_excess``, the share of the next, and the distance of rows."""
        step = self.log_excess[1] - self.log_excess[0]
        x = np.clip(
            (np.asarray(log_excess, float) - self.log_excess[0]) / step, 0.0, len(self.log_excess) - 1.001
        )
        i = x.astype(int)
        return i, x - i, float(step)


@lru_cache(maxsize=1)
def fresnel_curves() -> FresnelCurves:
    """The family of half-spaces from epsilon_r 1.05 to 201."""
    cosine = np.linspace(0.0, 1.0, COSINES)
    curves = np.stack(
        [
            0.5 * sum(np.abs(r) ** 2 for r in slab_reflection(cosine, 1.0 + x, np.inf, 1.0))
            for x in _PERMITTIVITY
        ]
    )
    # relative errors count: each curve is weighted by its mean
    moments = np.linalg.svd(curves / curves.mean(axis=1, keepdims=True), full_matrices=False)[2][:MOMENTS]
    return FresnelCurves(np.log(_PERMITTIVITY), curves, moments, curves @ moments.T)
