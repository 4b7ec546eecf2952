"""What a link gets, without its whole spectrum: total and best path gain, delay spread, the gain of the best beam.

The beam is the receiver's: von Mises-Fisher, kappa = 1 / sigma^2, of directivity D(psi) = 2 kappa exp(kappa (cos(psi) -
1)) / (1 - exp(-2 kappa)), its mean over the sphere one. Steered somewhere, it brings the sum over paths of path gain
times D at the angle between. The best direction is sought at the line of sight and mirror paths, exactly, and at the
pixels of a grid for what is diffuse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from warprrf.checks import checked, one_line, one_of
from warprrf.device import Progress
from warprrf.rf.channel.dispersion import delay_spread
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.spectra.beam import beam_operator
from warprrf.rf.spectra.spectrum import BEAM_SIGMA_RAD, Beam, GridShape, pixel_of, pixel_solid_angles
from warprrf.rows import Rows


@dataclass(frozen=True)
class Links(Rows):
    """Links of several receivers, arrays ``(R,)``; or one, numbers.

    Attributes:
        total_path_gain: sum over all paths [linear]; the sum of the spectrum.
        best_path_gain: that of the strongest path [linear]. A diffuse path is what one pixel of the field's spectrum
            holds, as in :meth:`RadioField.paths`.
        delay_spread_s: root mean square over all paths, weighted by power [s]; NaN without power.
        best_beam_gain: of the receiver's beam in its best direction: path gain times array gain [linear].
    """

    __repr__ = one_line

    total_path_gain: np.ndarray
    best_path_gain: np.ndarray
    delay_spread_s: np.ndarray
    best_beam_gain: np.ndarray

    __getitem__ = Rows.take


@checked
@dataclass(frozen=True)
class LinkOptions:
    """How links are found.

    Attributes:
        beam_sigma_rad: width of the receiver's beam, kappa = 1 / sigma^2: array gain 2 / sigma^2, that of a planar
            array of 2 / (pi sigma^2) elements half a wavelength apart (522 at 2 degrees).
        shape: rows and columns of the grid that rays fill; 20 x 40 by default, the field's own for other models than
            ``bistatic``.
        mirror_order: most reflections on a mirror path of a ``bistatic`` field, 0 to 3, if fewer than it was fitted with: chains
            of three mirrors take most of the time and carry little.
        client: a ``dask.distributed.Client`` whose workers compute; this process by default.
        progress: called as ``progress("links", done, total)``.
    """

    beam_sigma_rad: Beam = BEAM_SIGMA_RAD
    shape: GridShape | None = None
    mirror_order: Annotated[int | None, one_of(None, 0, 1, 2, 3)] = None
    client: Any = None
    progress: Progress | None = None


def directivity(sigma: float, cosine: Any = 1.0) -> np.ndarray:
    """Directivity [linear] of the beam of width ``sigma`` [rad] at the cosine of the angle from its axis."""
    kappa = 1.0 / sigma**2
    cosine = np.asarray(cosine, float)
    return np.asarray(2.0 * kappa * np.exp(kappa * (cosine - 1.0)) / -np.expm1(-2.0 * kappa))


class BeamSearch:
    """Looks for the best direction of a receiver's beam.

    Args:
        shape: rows and columns of the grid that diffuse power is given on.
        sigma: beam width [rad].

    Raises:
        ValueError: for a width that is not positive.
    """

    def __init__(self, shape: tuple[int, int], sigma: float, *, device: Any = None) -> None:
        self.shape, self.sigma = shape, sigma
        self._beam = beam_operator(shape, sigma, device)
        self._density = 4.0 * np.pi / pixel_solid_angles(shape)[:, None]

    def __call__(
        self, diffuse: np.ndarray, receiver: np.ndarray, arrival: np.ndarray, power: np.ndarray
    ) -> np.ndarray:
        """Gain of the best beam of each receiver, shape ``(R,)``.

        Args:
            diffuse: path gain per pixel, before any beam, shape ``(R, H, W)``.
            receiver, arrival, power: each sharp path's receiver ``(L,)``, unit direction ``(L, 3)`` and gain ``(L,)``.
        """
        count = len(diffuse)
        gain = np.moveaxis(self._beam(np.moveaxis(diffuse, 0, -1)), -1, 0) * self._density
        best = gain.reshape(count, -1).max(axis=1)
        order = np.argsort(receiver, kind="stable")
        first = np.searchsorted(receiver[order], np.arange(count + 1))
        for r in range(count):
            own = order[first[r] : first[r + 1]]
            if len(own):
                to = arrival[own]
                sharp = directivity(self.sigma, to @ to.T) @ power[own]
                best[r] = max(best[r], (sharp + gain[r][pixel_of(to, self.shape)]).max())
        return best


def links_of(paths: Sequence[Paths], search: BeamSearch) -> Links:
    """Links of receivers whose paths are known, one set each."""
    found = []
    for p in paths:
        own = p.valid
        power, toward = p.power[own], p.arrival[own]
        rough = p.kind[own] == "diffuse"
        image = np.zeros(search.shape)
        np.add.at(image, pixel_of(toward[rough], search.shape), power[rough])
        sharp = np.flatnonzero(~rough)
        beam = search(image[None], np.zeros(len(sharp), int), toward[sharp], power[sharp])
        timed = np.isfinite(p.tau[own])
        spread = delay_spread(power[timed], p.tau[own][timed])[1] if timed.any() else np.nan
        found.append((power.sum(), power.max(initial=0.0), float(spread), beam[0]))
    return Links(*np.array(found, float).reshape(-1, 4).T)
