"""How a receiver stood, where that is not known: the zero of a rotator's azimuths or of a clock, and positions to some
centimetres.

Paths without scattering hold no unknown but their strength, which matters little: the zero is where readings and what those
paths would give are most alike. It is found before anything else is fitted.

A position is found after a first fit: moved by an offset, a receiver sees the same images of the transmitter elsewhere,
and what is scattered hardly changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.base import Measured
from warprrf.rf.fields.bistatic.measured import direct_paths
from warprrf.rf.fields.bistatic.observations import NOISE_DB, TAP_STEPS, Observation, Place, Seen, unmeasured
from warprrf.rf.spectra.readings import Readings, path_weights
from warprrf.rf.tracing.model import SETS
from warprrf.rf.tracing.render import materials_of
from warprrf.rf.tracing.tracer import SPECULAR, View


def with_zeros(
    data: Sequence[Measured], every: Sequence[Seen]
) -> tuple[list[Measured], dict[str, dict[str, float]]]:
    """``data`` with azimuths that count from x and delays from when they were sent, and by data set's name what was added to
    those of unknown zero, by what ``every`` place sees: ``azimuth_zero_deg`` and ``clock_offset_s``.

    Raises:
        ValueError: where neither line of sight nor a mirror path reaches any place of such a data set.
    """
    found, zeros = list(data), dict[str, dict[str, float]](azimuth_zero_deg={}, clock_offset_s={})
    for k, one in enumerate(data):
        if isinstance(one, Readings) and not one.zero_known:
            seen = [(place, view) for place, view in every if place.data == k and len(view.paths.length_m)]
            if not seen:
                name, what = ("clock_known", "delays") if one.azimuth_known else ("azimuth_known", "azimuth")
                raise ValueError(
                    f"{name}: neither line of sight nor mirrors reach a receiver of {one.name!r}, so its zero of {what} "
                    "cannot be found; expected it known"
                )
            zero = _zero(one, seen)
            if one.azimuth_known:
                zeros["clock_offset_s"][one.name] = zero / SPEED_OF_LIGHT
            else:
                zeros["azimuth_zero_deg"][one.name] = float(np.degrees(zero))
            found[k] = from_zero(one, zero)
    return found, zeros


def from_zero(one: Readings, by: float) -> Readings:
    """The same, ``by`` added to what counts from an unknown zero: to azimuths [rad], or to delays, as length [m]."""
    if one.arrival is not None and not one.azimuth_known:
        return replace(one, arrival=one.arrival + [0.0, by], azimuth_known=True)
    if one.delay_s is not None and not one.clock_known:
        return replace(one, delay_s=one.delay_s + by / SPEED_OF_LIGHT, clock_known=True)
    return one


def _zero(one: Readings, seen: Sequence[Seen]) -> float:
    """What to add to azimuths [rad], in (-pi, pi], or to delays [m]; see :func:`from_zero`."""
    paths = [(place.rows, *_strongest(view)) for place, view in seen]
    tried = np.linspace(-np.pi, np.pi, 360, endpoint=False)  # a degree apart
    if one.azimuth_known:
        tried = _clocks(one, paths)

    def alike(by: float) -> float:
        turned, total = from_zero(one, by), 0.0
        for rows, power, *ends in paths:
            expected = path_weights(turned, rows, *ends) @ power
            size = float(np.linalg.norm(expected) * np.linalg.norm(one.power[rows]))
            total += float(expected @ one.power[rows]) / max(size, 1e-300)
        return total

    between = (tried[1] - tried[0]) * np.linspace(-1.0, 1.0, 41)  # where it is no parabola
    return float(max(max(tried, key=alike) + between, key=alike))


def _clocks(one: Readings, paths: Sequence[tuple[np.ndarray, ...]]) -> np.ndarray:
    """What may have to be added to delays [m]: each place's strongest tap may be any of its paths."""
    if one.delay_s is None or one.bandwidth_hz is None:
        raise ValueError("one: got readings without delays, expected some of which the zero is not known")
    strongest = [one.delay_s[rows[np.nanargmax(one.power[rows])]] for rows, *_ in paths]
    may_be = np.concatenate([delay - tap for tap, (*_, delay) in zip(strongest, paths, strict=True)])
    tap = SPEED_OF_LIGHT / one.bandwidth_hz
    low, high = SPEED_OF_LIGHT * may_be.min() - tap, SPEED_OF_LIGHT * may_be.max() + tap
    return np.arange(low, high, tap / TAP_STEPS)


def _strongest(view: View) -> tuple[np.ndarray, ...]:
    """Powers of its strongest direct paths before any measurement, directions of arrival and departure, delays."""
    tracer = view.tracer
    power = view.records[SPECULAR].powers(materials_of(tracer, unmeasured(view), SETS["single"]))
    most = 20  # count
    kept = np.argsort(-power)[:most]
    return power[kept], *(values[kept] for values in direct_paths(view))


def moved(one: Readings, offsets: Sequence[tuple[Place, np.ndarray]]) -> Readings:
    """``one`` with the receivers of its places moved by offsets (3,) [m], and known there."""
    receivers = one.receivers.copy()
    for place, offset in offsets:
        receivers[place.rows] += offset
    return replace(one, receivers=receivers, position_std_m=0.0)


Evidence = tuple[Observation, np.ndarray, np.ndarray]
"""What was read of a receiver; what is predicted to come by scattering, shape ``(N,)``; and the power of all other paths,
shape ``(L,)``: both in the units of the target, gain of the chain included."""


def position_offset(one: Readings, evidence: Sequence[Evidence]) -> np.ndarray:
    """Offset of a receiver from where it is said to be [m], shape ``(3,)``: the one that readings and prior like best.

    Args:
        one: table that holds its readings.
        evidence: under each transmitter, and by each measuring chain, where it is said to be.
    """
    std, first = one.position_std_m, evidence[0][0]
    receiver, most = first.place.receiver, 2.0 * std  # along each axis
    missed = [_missed(one, *own) for own in evidence]
    found = least_squares(
        lambda offset: np.concatenate([*(own(offset) for own in missed), offset / std]), np.zeros(3), bounds=(-most, most),
        loss="huber", f_scale=first.huber_db / NOISE_DB, x_scale=std, diff_step=1e-3,
    ).x  # fmt: skip
    # A step and a half of it must be free, or the receiver would end in a wall.
    mesh = first.view.tracer.surface.mesh
    free = mesh.visible(receiver[None], (receiver + 1.5 * found)[None])[0]
    return np.asarray(found) if free and np.abs(found).max() > 0 else np.zeros(3)


def _missed(
    one: Readings, o: Observation, other: np.ndarray, power: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """From an offset (3,) of a receiver [m] to errors of what was read (N,), in standard deviations; see :data:`Evidence`."""
    place, paths = o.place, o.view.paths
    bent, (_, toward, _) = paths.over_edge[:, None], direct_paths(o.view)
    s = o.view.tracer.surface
    image = place.receiver + paths.arrival * paths.length_m[:, None]
    turn = np.tile(-np.eye(3), (len(paths), 1, 1))  # from arrival to departure
    normals = np.concatenate([s.plane_normal, np.zeros((1, 3))])  # the last, -1, turns nothing
    for patch in paths.patch.T:  # from the transmitter on
        normal = normals[patch]
        turn = turn - 2.0 * (turn @ normal[:, :, None]) * normal[:, None, :]

    def error(offset: np.ndarray) -> np.ndarray:
        out = image - place.receiver - offset
        length = np.linalg.norm(out, axis=1)
        arrival = out / length[:, None]
        departure = np.where(bent, toward, (turn @ arrival[:, :, None])[..., 0])  # an edge stays where it is
        delay_s = (length + paths.excess_m) / SPEED_OF_LIGHT
        weight = path_weights(one, place.rows, arrival, departure, delay_s)
        return np.asarray(o.target.error(other + weight @ power) / NOISE_DB)

    return error
