"""Propagation paths, and what is computed from them: channels, dispersion, files.

The arrays are those of :class:`~warprrf.rf.channel.path_arrays.PathArrays`, which also explains angles and polarisation.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from warprrf.brief import one_line
from warprrf.checks import checked
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.channel.dispersion import Dispersion, dispersion
from warprrf.rf.channel.path_arrays import PathArrays
from warprrf.rf.channel.response import (
    LinkOptions,
    channel_taps,
    diffuse_power,
    frequency_response,
    impulse_response,
)
from warprrf.rf.paths import files, sionna


@checked
@dataclass(frozen=True)
class Paths(PathArrays):
    """Paths of one receiver, arrays ``(L,)``, or of several, arrays ``(R, L)`` padded where ``valid`` is False.

    ``gain`` (complex, exp(-j 2 pi f tau) included), ``tau`` [s], ``theta_r``, ``phi_r``, ``theta_t``, ``phi_t`` [rad],
    ``vertices`` [m], ``kind``, ``valid`` and, where known, ``jones``, ``frequency_hz``, ``transmitter``, ``receiver`` and
    ``air``: see :class:`~warprrf.rf.channel.path_arrays.PathArrays`.
    """

    __repr__ = one_line

    def cir(self, **link: Unpack[LinkOptions]) -> tuple[np.ndarray, np.ndarray]:
        """Impulse response, one coefficient a path; see :func:`warprrf.rf.channel.response.impulse_response`."""
        return impulse_response(self, **link)

    def cfr(
        self,
        frequencies_hz: ArrayLike,
        *,
        amplitude: str = "carrier",
        method: str = "auto",
        **link: Unpack[LinkOptions],
    ) -> np.ndarray:
        """Frequency response; see :func:`warprrf.rf.channel.response.frequency_response`."""
        return frequency_response(self, frequencies_hz, amplitude=amplitude, method=method, **link)

    def taps(
        self,
        bandwidth_hz: float,
        l_min: int,
        l_max: int,
        *,
        center_hz: float | None = None,
        **link: Unpack[LinkOptions],
    ) -> np.ndarray:
        """Taps of the discrete baseband channel; see :func:`warprrf.rf.channel.response.channel_taps`."""
        return channel_taps(self, bandwidth_hz, l_min, l_max, center_hz=center_hz, **link)

    def diffuse_power(
        self, *, tx_array: PlanarArray | None = None, rx_array: PlanarArray | None = None
    ) -> np.ndarray:
        """Mean power that diffuse paths add to any pair of elements; see
        :func:`warprrf.rf.channel.response.diffuse_power`."""
        return diffuse_power(self, tx_array=tx_array, rx_array=rx_array)

    def dispersion(self) -> Dispersion:
        """Delay and angular spreads, K-factor and coherence bandwidth; see
        :func:`warprrf.rf.channel.dispersion.dispersion`."""
        return dispersion(self)

    def to_sionna(
        self,
        tx_array: PlanarArray | None = None,
        rx_array: PlanarArray | None = None,
        *,
        diffuse: str | None = None,
        seed: int = 0,
    ) -> sionna.SionnaPaths:
        """Arrays in the shapes and conventions of Sionna RT; see :func:`warprrf.rf.paths.sionna.to_sionna`."""
        return sionna.to_sionna(self, tx_array, rx_array, diffuse=diffuse, seed=seed)

    @classmethod
    def from_sionna(
        cls, paths: Any, *, frequency_hz: float, transmitter: int = 0, drop_repeated: bool = False
    ) -> Paths:
        """Paths that Sionna RT solved, with their Jones matrices, arrays ``(R, L)``, strongest path first.

        Sionna's arrays must be one isotropic element of polarisation "VH" at either end, unrotated: their four
        coefficients are the Jones matrix. The phase of ``gain`` is that of the delay alone.

        Args:
            paths: What a ``PathSolver`` returned, with ``synthetic_array=True``.
            frequency_hz: The scene's carrier [Hz].
            transmitter: Index of the transmitter.
            drop_repeated: Leave out specular paths that repeat another one: Sionna counts a mirror of many small
                triangles several times.

        Raises:
            ValueError: for other arrays, or paths through or round obstacles (refraction, diffraction).
        """
        found = sionna.from_sionna(paths, frequency_hz, transmitter, drop_repeated)
        return cls.stack([cls(**arrays) for arrays in found])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write to a NetCDF-4 file, whole or not at all; :mod:`warprrf.rf.paths.files` describes it."""
        files.write(path, self)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Paths:
        """Read what :meth:`save` wrote.

        Raises:
            OSError: naming the file, if it cannot be read.
            ValueError: naming it, if it is damaged, or holds something else.
        """
        arrays, one_receiver = files.read(path)
        several = cls(**arrays)
        return several[0] if one_receiver else several
