"""Where a receiver was found, and how well that is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from warprrf.checks import one_line


@dataclass(frozen=True, eq=False)
class Location:
    """A receiver's place by what it read; see :meth:`RadioField.locate`.

    Attributes:
        position: the likeliest place [m], shape ``(3,)``.
        covariance: of its error, by how readings change there and how well the field explains them [m^2], shape ``(3, 3)``.
        candidates: places where readings are explained better than round about, the likeliest first [m], shape ``(K, 3)``.
        likelihoods: of each, among them, shape ``(K,)``; their sum is 1.
        known: whether readings and field tell the place: it is likelier than all other candidates together by far, its error
            is small beside the distance of the places searched, and what was read is explained. Never where delays are read
            more finely than half a metre, which those places lie apart: a valley of errors between them may be missed.
        misfit: root mean square error of what was read, over what the field and the readings state: about 1.
        gains_db: of measuring chains of unknown gain, by name [dB].
        azimuth_zeros: what was added to azimuths of an unknown zero, by table's name [rad].
        clock_offsets_s: what was added to delays of an unknown zero, by table's name [s].
    """

    __repr__ = one_line

    position: np.ndarray
    covariance: np.ndarray
    candidates: np.ndarray = field(repr=False)
    likelihoods: np.ndarray = field(repr=False)
    known: bool
    misfit: float
    gains_db: Mapping[str, float]
    azimuth_zeros: Mapping[str, float]
    clock_offsets_s: Mapping[str, float]

    @property
    def std_m(self) -> float:
        """Standard deviation of the position, root of the covariance's trace [m]."""
        return float(np.sqrt(np.trace(self.covariance)))
