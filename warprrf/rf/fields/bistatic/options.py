"""Options of a bistatic fit; and what few scenes need, transmission through slabs and diffraction at edges: whether a fit is to
model them, and what it lacks without. That is estimated where receivers are blocked, by the tracer itself on few rays, over line
of sight, mirrors and single scatterings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np

from warprrf.checks import Seed, checked, whole
from warprrf.device import DeviceLike
from warprrf.rf.em.materials import assumed_permittivity
from warprrf.rf.em.waves import NEPER
from warprrf.rf.fields.bistatic.observations import Place
from warprrf.rf.tracing.model import LOBES, SETS, Effects, Model, Parameters, with_slabs_and_edges
from warprrf.rf.tracing.render import path_gains
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Tracer

SUB_PIXELS = 3
"""Square root of the rays per pixel."""


@runtime_checkable
class EffectsChoice(Protocol):
    """What says beforehand which effects a scene needs, such as :class:`warprrf.Relevance`."""

    def needs(self, frequency_hz: float) -> tuple[Effects, tuple[int, ...] | None]:
        """Effects, each as far as it may be needed, and exponents of lobes; None for those of a fit."""


@checked
@dataclass(frozen=True)
class FitOptions:
    """Options of a bistatic fit; :meth:`BistaticField.fit` takes each of them as a keyword.

    Attributes:
        effects: what is modelled: :class:`Effects`, the name of one of :data:`SETS` (``"single"``, ``"room"``,
            ``"everything"``), or ``"auto"``: the set that errs least, fitted to up to 24 receivers, on these and on
            those held out (a quarter, 30 at most); a larger set is tried where the one before it was better. With fewer
            than eight receivers it is ``"room"``, or ``"single"`` if that fits much better. Slabs are passed and edges gone
            over where that is worth more than 0.25 dB to all power of blocked receivers (:func:`needed`), and predicts
            better.
        lobes: exponents of the scattering lobes ((1 + cos psi) / 2)^n, 0 for Lambertian; None for 0, 2, 5, 12, 30.
        reciprocal: lobes that scatter alike when transmitter and receiver change places. By default they are those of
            Degli-Esposti et al. (2007), Sionna RT's, which do not.
        sub_pixels: square root of the rays per pixel (None: 3); 4 gives better delays of scattering, 2 takes half the
            time.
        quick: one ray a pixel, and nothing held out to decide by.
        gain_offset: fit one gain common to all paths, for a receiver that was not calibrated; see ``report``.
        iterations: most steps of the fit of materials.
        relevance: what it rules out is off, unless ``effects`` are :class:`Effects`; lobes are those that it found.
        seed: of the choice of pixels and held-out receivers.
    """

    effects: Effects | str = "auto"
    lobes: tuple[int, ...] | None = None
    reciprocal: bool = False
    sub_pixels: Annotated[int, whole(1, 16)] | None = None
    quick: bool = False
    gain_offset: bool = False
    iterations: Annotated[int, whole(0)] = 40
    relevance: EffectsChoice | None = None
    seed: Seed = 0

    def __post_init__(self) -> None:
        if isinstance(self.effects, str) and self.effects not in ("auto", *SETS):
            raise ValueError(
                f"effects: got {self.effects!r}, expected wr.Effects, or one of 'auto', {', '.join(map(repr, SETS))}"
            )
        Parameters.prior(1, LOBES if self.lobes is None else self.lobes)

    def candidates(self, frequency_hz: float) -> list[Effects]:
        """Effects to choose from, the fewest first; one where they are given, else without what ``relevance`` rules out."""
        most = Effects() if self.relevance is None else self.relevance.needs(frequency_hz)[0]
        if isinstance(self.effects, Effects):
            return [self.effects]
        given = SETS.values() if self.effects == "auto" else [SETS[self.effects]]
        found = [
            Effects(**{f.name: min(getattr(one, f.name), getattr(most, f.name)) for f in fields(Effects)})
            for one in given
        ]
        if self.relevance is not None:
            found = [with_slabs_and_edges(one, most) for one in found]
        return list(dict.fromkeys(found))

    def exponents(self, frequency_hz: float) -> tuple[int, ...]:
        """Exponents of the lobes."""
        if self.lobes is not None:
            return self.lobes
        known = None if self.relevance is None else self.relevance.needs(frequency_hz)[1]
        return LOBES if known is None else known

    @property
    def rays_a_side(self) -> int:
        """Square root of the rays per pixel."""
        return self.sub_pixels or (1 if self.quick else SUB_PIXELS)


OPTIONAL: dict[str, dict[str, Any]] = {
    "transmission": {"transmissions": 3},
    "diffraction": {"diffractions": 1},
}
"""Effects that few scenes need, by name, and what of :class:`Effects` switches each on."""
SIMPLE = replace(SETS["single"], mirrors=2, residual=False)
MOST_BLOCKED = 12
"""Blocked places at which effects are estimated."""
RAYS = (20, 40), 2
"""Grid and square root of the rays a pixel."""


def assumed(surface: Surface, frequency_hz: float) -> Parameters:
    """What surfaces are taken for before any measurement: permittivities of ITU-R P.2040 by names."""
    known = [assumed_permittivity(name, frequency_hz) for name in surface.group_names]
    prior = Parameters.prior(surface.groups)
    return replace(
        prior, log_excess=np.log(np.array(known) - 1.0), log_through=surface.slab_properties(frequency_hz)[2]
    )


def needed(effects: Effects, surface: Surface, places: Sequence[Place], device: DeviceLike = None) -> Effects:
    """``effects`` with those of :data:`OPTIONAL` that raise the total path gain of blocked places by 0.25 dB rms, without the
    others."""
    needed_db = 0.25
    by_transmitter: dict[tuple[bytes, float], list[Place]] = {}
    for place in places:
        by_transmitter.setdefault((place.transmitter.tobytes(), place.frequency_hz), []).append(place)
    changes: dict[str, list[float]] = {name: [] for name in OPTIONAL}
    for own in by_transmitter.values():
        first = own[0]
        tracer = Tracer.of(surface, first.transmitter, first.frequency_hz, *RAYS, device=device)
        receivers = np.unique([place.receiver for place in own], axis=0)
        sight = tracer.paths(receivers, replace(SIMPLE, mirrors=0))
        blocked = evenly(np.setdiff1d(np.arange(len(receivers)), sight.receiver), MOST_BLOCKED)
        p, none = assumed(surface, first.frequency_hz), np.zeros((2, len(surface.cells)))
        model = Model(SIMPLE, p, none, tracer.transmitter)
        before = total(tracer, receivers[blocked], model, {})
        for name, on in OPTIONAL.items():
            after = total(tracer, receivers[blocked], model, on)
            changes[name] += (NEPER * np.log(np.maximum(after, 1e-300) / np.maximum(before, 1e-300))).tolist()
    off: dict[str, Any] = {key: 0 for on in OPTIONAL.values() for key in on}
    for name, found in changes.items():
        if found and np.sqrt(np.mean(np.square(found))) > needed_db:
            off |= OPTIONAL[name]
    return replace(effects, **off)


def total(tracer: Tracer, receivers: np.ndarray, model: Model, on: dict[str, Any]) -> np.ndarray:
    """Total path gain of receivers (R, 3) under the parameters of ``model``, with :data:`SIMPLE` effects and those ``on``."""
    if len(receivers) == 0:
        return np.zeros(0)
    here = replace(model, effects=replace(SIMPLE, **on))
    return path_gains(tracer.view(receivers, here.effects), here).total


def evenly(index: np.ndarray, most: int) -> np.ndarray:
    """At most so many of ``index``, evenly chosen."""
    return index[np.linspace(0, len(index) - 1, min(len(index), most)).astype(int)]
