"""A predicted spectrum as propagation paths: line of sight merged out of its beam, one diffuse path per pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warprrf.rf.em.waves import SPEED_OF_LIGHT, carrier_phase
from warprrf.rf.paths.trace import Paths
from warprrf.rf.spectra.spectrum import Spectrum, angles_from_directions, pixel_directions, pixel_of

BEAM_REACH = 3.0  # pixels within so many beam sigmas of a visible transmitter are its line of sight


@dataclass(frozen=True)
class View:
    """A spectrum with what it was made of.

    Attributes:
        spectrum: the spectrum at ``receiver``.
        receiver, transmitter: positions [m], shape ``(3,)``.
        points, delay_s, aod: interaction points [m], shape ``(H, W, 3)``, delays [s] and departures [rad] of what does not come
            directly, of all pixels; NaN where unknown.
        line_of_sight_gain: its Friis gain; 0 where the mesh does not let the two see each other.
        beam: power of the explicit line of sight per pixel, shape ``(H, W)``; None if the model has none.
    """

    spectrum: Spectrum
    receiver: np.ndarray
    transmitter: np.ndarray
    points: np.ndarray
    delay_s: np.ndarray
    aod: np.ndarray
    line_of_sight_gain: float
    beam: np.ndarray | None


def paths_of(view: View, beam_sigma_rad: float, frequency_hz: float, max_paths: int | None) -> Paths:
    """Paths of ``view``, strongest first; see :meth:`RadioField.paths`."""
    spectrum, shape = view.spectrum, view.spectrum.shape
    power = np.asarray(spectrum.path_gain, np.float64)
    total = float(power.sum())
    outward = view.receiver - view.transmitter
    line_of_sight = 0.0
    if view.beam is not None:
        line_of_sight, power = min(view.line_of_sight_gain, total), np.maximum(power - view.beam, 0.0)
    elif view.line_of_sight_gain > 0:
        near = near_line_of_sight(view.receiver, view.transmitter, shape, beam_sigma_rad)
        line_of_sight, power = float(power[near].sum()), np.where(near, 0.0, power)
    rest = total - line_of_sight
    kept = power > spectrum.floor
    if not kept.any() and rest > 0 and power.max() > 0:
        kept = power == power.max()
    row, column = np.nonzero(kept)
    diffuse = power[row, column]
    if len(diffuse):
        diffuse = diffuse * (max(rest, 0.0) / diffuse.sum())
    else:
        line_of_sight = total  # nothing else has power
    columns = view.delay_s, pixel_directions(shape), view.aod, view.points
    parts: list[Any] = [diffuse, *(a[row, column] for a in columns), ["diffuse"] * len(diffuse)]
    if line_of_sight > 0:
        departure = np.stack(angles_from_directions(outward[None]), axis=-1)
        flight, nowhere = np.linalg.norm(outward) / SPEED_OF_LIGHT, np.full((1, 3), np.nan)
        direct: list[Any] = [[line_of_sight], [flight], -outward[None], departure, nowhere, ["los"]]
        parts = [np.concatenate(pair) for pair in zip(parts, direct, strict=True)]
    amplitude = np.sqrt(parts[0])
    order = np.argsort(-amplitude, kind="stable")[:max_paths]
    amplitude, delay, arrival, aod, points, kind = (np.asarray(a)[order] for a in (amplitude, *parts[1:]))
    zenith, azimuth = angles_from_directions(arrival)
    return Paths(
        gain=amplitude
        * carrier_phase(frequency_hz, np.nan_to_num(delay)),  # without a delay the phase is zero
        tau=np.asarray(delay, np.float64),
        theta_r=zenith,
        phi_r=azimuth,
        theta_t=aod[:, 0],
        phi_t=aod[:, 1],
        vertices=points[:, None, :],
        kind=kind.astype("<U7"),
        valid=np.ones(len(order), dtype=bool),
        frequency_hz=float(frequency_hz),
        transmitter=view.transmitter,
        receiver=view.receiver,
    )


def near_line_of_sight(
    receiver: np.ndarray, transmitter: np.ndarray, shape: tuple[int, int], beam_sigma_rad: float
) -> np.ndarray:
    """Pixels ``(H, W)`` within :data:`BEAM_REACH` beam sigmas of the transmitter's direction, at least one."""
    direction = (transmitter - receiver) / np.linalg.norm(transmitter - receiver)
    near = pixel_directions(shape) @ direction >= np.cos(BEAM_REACH * beam_sigma_rad)
    near[pixel_of(direction, shape)] = True
    return near
