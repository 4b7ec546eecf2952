"""The zero of azimuths that a rotator counts from, where nobody knows it.

Line of sight and mirrors hold no unknown but their strength, which matters little: turned about the vertical, the zero is
where readings and what those paths would give are most alike. It is found before anything else is fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warprrf.rf.fields.bistatic.materials import Parameters, mirror_power
from warprrf.rf.fields.bistatic.measured import direct_paths
from warprrf.rf.fields.bistatic.observations import Place
from warprrf.rf.fields.bistatic.transport import ReceiverView
from warprrf.rf.fields.data import Measured
from warprrf.rf.spectra.readings import Readings, path_weights

STRONGEST = 20  # paths that count
STEPS = 360


def with_azimuths(
    data: Sequence[Measured], places: Sequence[Place], views: Sequence[ReceiverView]
) -> tuple[list[Measured], dict[str, float]]:
    """``data`` with azimuths that count from x, and by data set's name what was added to those of unknown zero [degrees].

    Raises:
        ValueError: where neither line of sight nor a mirror path reaches any place of such a data set.
    """
    found, zeros = list(data), {}
    for k, one in enumerate(data):
        if isinstance(one, Readings) and one.arrival is not None and not one.azimuth_known:
            seen = [
                (p, v) for p, v in zip(places, views, strict=True) if p.data == k and len(v.paths.length_m)
            ]
            if not seen:
                raise ValueError(
                    f"azimuth_known: neither line of sight nor mirrors reach a receiver of {one.name!r}, so its zero of "
                    "azimuth cannot be found; expected it known"
                )
            zero = _zero(one, seen)
            zeros[one.name] = float(np.degrees(zero))
            found[k] = replace(one, arrival=one.arrival + [0.0, zero], azimuth_known=True)
    return found, zeros


def _zero(one: Readings, seen: Sequence[tuple[Place, ReceiverView]]) -> float:
    """Angle to add to azimuths [rad], in (-pi, pi]."""
    arrival = np.asarray(one.arrival)
    angles = np.linspace(-np.pi, np.pi, STEPS, endpoint=False)
    alike = np.zeros(STEPS)
    paths = [(place.rows, *_strongest(view)) for place, view in seen]
    for k, angle in enumerate(angles):
        turned = replace(one, arrival=arrival + [0.0, angle])
        for rows, power, *ends in paths:
            expected = path_weights(turned, rows, *ends) @ power
            size = float(np.linalg.norm(expected) * np.linalg.norm(one.power[rows]))
            alike[k] += float(expected @ one.power[rows]) / max(size, 1e-300)
    best = int(alike.argmax())
    low, mid, high = alike[[best - 1, best, (best + 1) % STEPS]]
    bend = low - 2.0 * mid + high  # of the parabola through the three
    return float(angles[best] + (0.5 * (low - high) / bend if bend < 0 else 0.0) * 2.0 * np.pi / STEPS)


def _strongest(view: ReceiverView) -> tuple[np.ndarray, ...]:
    """Powers of its strongest direct paths before any measurement, directions of arrival and departure, delays."""
    prior = Parameters.prior(view.transport.surface.groups, 1)
    power = mirror_power(view.friis, view.path_groups, view.paths.cosine, view.paths.turn, prior)[0]
    kept = np.argsort(-power)[:STRONGEST]
    return power[kept], *(values[kept] for values in direct_paths(view))
