"""What few scenes need, transmission through slabs and diffraction at edges: whether a fit is to model them, and what it lacks
without. Estimated where receivers are blocked, by the tracer itself on few rays, over line of sight, mirrors and
single scatterings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from warprrf.device import DeviceLike
from warprrf.rf.em.materials import assumed_permittivity
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.bistatic.observations import Place
from warprrf.rf.tracing.model import SETS, Effects, Model, Parameters
from warprrf.rf.tracing.render import materials_of, path_gains
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Tracer

RARE: dict[str, dict[str, Any]] = {"transmission": {"transmissions": 3}, "diffraction": {"diffractions": 1}}
"""Effects by name, and what of :class:`Effects` has them whole."""
FEW = replace(SETS["single"], mirrors=2, residual=False)
MOST_BLOCKED = 12
"""Blocked places at which effects are estimated."""
RAYS = (20, 40), 2
"""Grid and square root of the rays a pixel."""


def assumed(surface: Surface, frequency_hz: float) -> Parameters:
    """What surfaces are taken for before any measurement: permittivities of ITU-R P.2040 by names."""
    known = [assumed_permittivity(name, frequency_hz) for name in surface.group_names]
    prior = Parameters.prior(surface.groups)
    return replace(
        prior, log_excess=np.log(np.array(known) - 1.0), log_through=surface.slabs(frequency_hz)[2]
    )


def needed(effects: Effects, surface: Surface, places: Sequence[Place], device: DeviceLike = None) -> Effects:
    """``effects`` with those of :data:`RARE` that raise the total path gain of blocked places by 0.25 dB rms, without the
    others."""
    needed_db = 0.25
    by_transmitter: dict[tuple[bytes, float], list[Place]] = {}
    for place in places:
        by_transmitter.setdefault((place.transmitter.tobytes(), place.frequency_hz), []).append(place)
    changes: dict[str, list[float]] = {name: [] for name in RARE}
    for own in by_transmitter.values():
        first = own[0]
        tracer = Tracer.of(surface, first.transmitter, first.frequency_hz, *RAYS, device=device)
        receivers = np.unique([place.receiver for place in own], axis=0)
        sight = tracer.paths(receivers, replace(FEW, mirrors=0))
        blocked = evenly(np.setdiff1d(np.arange(len(receivers)), sight.receiver), MOST_BLOCKED)
        p, none = assumed(surface, first.frequency_hz), np.zeros((2, surface.cells))
        model = Model(FEW, p, none, tracer.transmitter)
        before = total(tracer, receivers[blocked], model, {})
        for name, on in RARE.items():
            after = total(tracer, receivers[blocked], model, on)
            changes[name] += (NEPER * np.log(np.maximum(after, 1e-300) / np.maximum(before, 1e-300))).tolist()
    off: dict[str, Any] = {key: 0 for on in RARE.values() for key in on}
    for name, found in changes.items():
        if found and np.sqrt(np.mean(np.square(found))) > needed_db:
            off |= RARE[name]
    return replace(effects, **off)


def total(tracer: Tracer, receivers: np.ndarray, model: Model, on: dict[str, Any]) -> np.ndarray:
    """Total path gain of receivers (R, 3) under the parameters of ``model``, with :data:`FEW` effects and those that are ``on``."""
    if len(receivers) == 0:
        return np.zeros(0)
    here = replace(model, effects=replace(FEW, **on))
    gains = path_gains(tracer.view(receivers, here.effects), here, materials_of(tracer, here))
    direct = np.bincount(gains.view.paths.receiver, gains.specular, len(receivers))
    return np.asarray(direct + gains.by_ray().reshape(len(receivers), -1).sum(axis=1))


def evenly(index: np.ndarray, most: int) -> np.ndarray:
    """At most so many of ``index``, evenly chosen."""
    return index[np.linspace(0, len(index) - 1, min(len(index), most)).astype(int)]
