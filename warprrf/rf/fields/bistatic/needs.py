"""Whether a fit needs what few scenes do: transmission through slabs. Estimated before anything is fitted, where receivers are
blocked, with materials as they are before any measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warprrf.device import DeviceLike
from warprrf.rf.em.materials import assumed_permittivity
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.bistatic.observations import Place
from warprrf.rf.tracing.model import SETS, Effects, Model, Parameters
from warprrf.rf.tracing.render import evaluation, path_gains
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Tracer

MOST_SLABS = 3  # on a path, where any count
MOST_BLOCKED = 12
"""Blocked places at which effects are estimated."""
NEEDED_DB = 0.25
"""Change of the total gain, rms over those, from which an effect is modelled."""
RAYS = (20, 40), 2
"""Grid and square root of the rays a pixel."""


def assumed(surface: Surface, frequency_hz: float) -> Parameters:
    """What surfaces are taken for before any measurement: permittivities of ITU-R P.2040 by names."""
    known = [assumed_permittivity(name, frequency_hz) for name in surface.group_names]
    prior = Parameters.prior(surface.groups)
    return replace(
        prior, log_excess=np.log(np.array(known) - 1.0), log_through=surface.slabs(frequency_hz)[2]
    )


def slabs_needed(surface: Surface, places: Sequence[Place], device: DeviceLike = None) -> int:
    """How many slabs paths are to pass: :data:`MOST_SLABS`, or 0 where they would change the total path gain of blocked
    places by less than :data:`NEEDED_DB`."""
    by_transmitter: dict[tuple[bytes, float], list[Place]] = {}
    for place in places:
        by_transmitter.setdefault((place.transmitter.tobytes(), place.frequency_hz), []).append(place)
    changes: list[np.ndarray] = []
    for own in by_transmitter.values():
        first = own[0]
        tracer = Tracer.of(surface, first.transmitter, first.frequency_hz, *RAYS, device=device)
        if not tracer.walls(MOST_SLABS).passes.any():
            continue
        receivers = np.unique([place.receiver for place in own], axis=0)
        sight = tracer.paths(receivers, Effects(mirrors=0, transmissions=0))
        blocked = receivers[np.setdiff1d(np.arange(len(receivers)), sight.receiver)]
        blocked = blocked[
            np.unique(np.linspace(0, len(blocked) - 1, min(len(blocked), MOST_BLOCKED)).astype(int))
        ]
        if len(blocked):
            changes.append(_changes(tracer, blocked))
    return MOST_SLABS if changes and np.sqrt(np.mean(np.square(np.concatenate(changes)))) > NEEDED_DB else 0


def _changes(tracer: Tracer, receivers: np.ndarray) -> np.ndarray:
    """By how much slabs raise the total path gain of each of ``receivers`` (R, 3) over mirrors and single scatterings [dB]."""
    p, none = assumed(tracer.surface, tracer.frequency_hz), np.zeros((2, tracer.surface.cells))
    effects = replace(SETS["single"], mirrors=2, transmissions=MOST_SLABS, residual=False)
    view, total = tracer.view(receivers, effects), []
    for most in (0, MOST_SLABS):
        model = Model(replace(effects, transmissions=most), p, none, tracer.transmitter)
        gains = path_gains(view, model, evaluation(tracer, model))
        direct = np.bincount(view.paths.receiver, gains.specular, len(receivers))
        total.append(direct + gains.by_ray().reshape(len(receivers), -1).sum(axis=1))
    return np.asarray(NEPER * np.log(np.maximum(total[1], 1e-300) / np.maximum(total[0], 1e-300)))
