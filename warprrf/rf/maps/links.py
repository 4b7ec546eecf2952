"""What a link gets, without its whole spectrum: total and best path gain, delay spread, the gain of the best beam.

The beam is the receiver's: von Mises-Fisher, kappa = 1 / sigma^2, of directivity D(psi) = 2 kappa exp(kappa (cos(psi) -
1)) / (1 - exp(-2 kappa)), its mean over the sphere one. Steered somewhere, it brings the sum over paths of path gain
times D at the angle between. The best direction is sought at the line of sight and mirror paths, exactly, and at the
pixels of a grid for what is diffuse.
"""

from __future__ import annotations

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


def best_beam_gain(
    diffuse: np.ndarray,
    receiver: np.ndarray,
    arrival: np.ndarray,
    power: np.ndarray,
    sigma: float,
    device: Any = None,
) -> np.ndarray:
    """Gain of each receiver's beam in its best direction, shape ``(R,)``.

    Args:
        diffuse: path gain per pixel, before any beam, shape ``(R, H, W)``.
        receiver, arrival, power: each sharp path's receiver ``(L,)``, unit direction ``(L, 3)`` and gain ``(L,)``.
        sigma: beam width [rad].
    """
    count, shape = len(diffuse), diffuse.shape[1:]
    beam, density = beam_operator(shape, sigma, device), 4.0 * np.pi / pixel_solid_angles(shape)[:, None]
    gain = np.moveaxis(beam(np.moveaxis(diffuse, 0, -1)), -1, 0) * density
    best = gain.reshape(count, -1).max(axis=1)
    for r in np.unique(receiver):
        to, own = arrival[receiver == r], power[receiver == r]
        sharp = directivity(sigma, to @ to.T) @ own
        best[r] = max(best[r], (sharp + gain[r][pixel_of(to, shape)]).max())
    return best


def links_of(paths: Paths, shape: tuple[int, int], sigma: float, device: Any = None) -> Links:
    """Links ``(1,)`` of a receiver whose paths are known; its diffuse ones lie in pixels of a grid of ``shape``."""
    own = paths.valid
    power, toward, tau = paths.power[own], paths.arrival[own], paths.tau[own]
    rough = paths.kind[own] == "diffuse"
    image = np.zeros((1, *shape))
    np.add.at(image[0], pixel_of(toward[rough], shape), power[rough])
    sharp = np.flatnonzero(~rough)
    beam = best_beam_gain(image, np.zeros(len(sharp), int), toward[sharp], power[sharp], sigma, device)
    timed = np.isfinite(tau)
    spread = delay_spread(power[timed], tau[timed])[1]
    return Links(*(np.array([x], float) for x in (power.sum(), power.max(initial=0.0), spread, beam[0])))
