"""What a link gets, without its whole spectrum: total and best path gain, delay spread, the gain of the best beam.

The beam is the receiver's: von Mises-Fisher, kappa = 1 / sigma^2, of directivity D(psi) = 2 kappa exp(kappa (cos(psi) -
1)) / (1 - exp(-2 kappa)), its mean over the sphere one. Steered somewhere, it brings the sum over paths of path gain
times D at the angle between. The best direction is sought at the line of sight and mirror paths, exactly, and at the
pixels of a grid for what is diffuse.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf import device as _device
from warprrf.device import Progress
from warprrf.rf.bounces import BeamOperator
from warprrf.rf.dispersion import delay_spread
from warprrf.rf.spectrum import check_shape, directions_from_angles, pixel_of, pixel_solid_angles
from warprrf.rf.transport import check_receiver

if TYPE_CHECKING:
    from warprrf.rf.field import RadioField
    from warprrf.rf.path_set import Paths


@dataclass(frozen=True)
class Links:
    """Links of several receivers to one transmitter, arrays ``(R,)``.

    Attributes:
        total_path_gain: sum over all paths [linear]; the sum of the spectrum.
        best_path_gain: that of the strongest path [linear]. A diffuse path is what one pixel of the field's spectrum
            holds, as in :meth:`RadioField.paths`.
        delay_spread_s: root mean square over all paths, weighted by power [s]; NaN without power.
        best_beam_gain: of the receiver's beam in its best direction: path gain times array gain [linear].
    """

    total_path_gain: np.ndarray
    best_path_gain: np.ndarray
    delay_spread_s: np.ndarray
    best_beam_gain: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Links]) -> Links:
        """One after another."""
        return cls(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in cls.__dataclass_fields__})


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
        self._beam = BeamOperator(shape, sigma, device=device)
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


def find_links(
    field: RadioField,
    rx: Any,
    transmitter: Any,
    beam_sigma_rad: float,
    shape: tuple[int, int] | None,
    mirror_order: int | None,
    progress: Progress | None,
) -> Links:
    """See :meth:`RadioField.links`."""
    from warprrf.rf.bistatic import BistaticField
    from warprrf.rf.bistatic_links import SHAPE, LinkTracer

    receivers = check_receiver("rx", _device.check_array("rx", rx, (None, 3)), field.mesh)
    source = (
        field.transmitter if transmitter is None else _device.check_array("transmitter", transmitter, (3,))
    )
    if (np.linalg.norm(receivers - source, axis=1) == 0).any():
        raise ValueError("rx: got the transmitter's own position; expected them apart")
    if not (np.isfinite(beam_sigma_rad) and beam_sigma_rad > 0):
        raise ValueError(f"beam_sigma_rad: got {beam_sigma_rad!r}, expected a positive beam width in radians")
    if mirror_order is not None and mirror_order not in (0, 1, 2, 3):
        raise ValueError(f"mirror_order: got {mirror_order!r}, expected 0 to 3, or None for the field's own")
    trace: Callable[[np.ndarray], Links]
    if isinstance(field, BistaticField):
        tracer = LinkTracer(field, source, beam_sigma_rad, check_shape(shape or SHAPE), mirror_order)
        trace, batch = tracer, tracer.batch
    elif mirror_order is not None:
        raise ValueError(
            f"mirror_order: got {mirror_order!r}, but a field of model {field.model!r} has no mirrors"
        )
    else:
        search = BeamSearch(check_shape(shape or field.shape), beam_sigma_rad, device=field.device)
        trace, batch = lambda some: links_of([field.paths(r, transmitter) for r in some], search), 1
    parts = []
    for first in range(0, len(receivers), batch):
        if progress is not None:
            progress("links", first, len(receivers))
        parts.append(trace(receivers[first : first + batch]))
    if progress is not None:
        progress("links", len(receivers), len(receivers))
    return Links.joined(parts)


def links_of(paths: Sequence[Paths], search: BeamSearch) -> Links:
    """Links of receivers whose paths are known, one set each."""
    found = []
    for p in paths:
        own = p.valid
        power, toward = np.abs(p.gain[own]) ** 2, directions_from_angles(p.theta_r[own], p.phi_r[own])
        rough = p.kind[own] == "diffuse"
        image = np.zeros(search.shape)
        np.add.at(image, pixel_of(toward[rough], search.shape), power[rough])
        sharp = np.flatnonzero(~rough)
        beam = search(image[None], np.zeros(len(sharp), int), toward[sharp], power[sharp])
        timed = np.isfinite(p.tau[own])
        spread = delay_spread(power[timed], p.tau[own][timed])[1] if timed.any() else np.nan
        found.append((power.sum(), power.max(initial=0.0), float(spread), beam[0]))
    return Links(*np.array(found, float).reshape(-1, 4).T)
