"""Options of a bistatic fit."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Protocol, runtime_checkable

from warprrf.checks import Seed, checked, whole
from warprrf.rf.tracing.model import LOBES, SETS, Effects, Parameters

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
            ``"everything"``), or ``"auto"``: the set that errs least on receivers held out (a quarter, 30 at most), and the
            residual if it does not err more; a larger set is tried where the one before it was better. With fewer than
            eight receivers it is ``"room"``, or ``"single"`` if that fits much better. Slabs are passed and edges gone over
            where that is worth more than 0.25 dB to all power of blocked receivers (:mod:`.needs`).
        lobes: exponents of the scattering lobes ((1 + cos psi) / 2)^n, 0 for Lambertian; None for 0, 2, 5, 12, 30.
        reciprocal: lobes that scatter alike when transmitter and receiver change places. By default they are those of
            Degli-Esposti et al. (2007), Sionna RT's, which do not.
        sub_pixels: square root of the rays per pixel (None: 3); 4 gives better delays of scattering, 2 takes half the
            time.
        quick: one ray a pixel, and nothing held out to decide by.
        gain_offset: fit one gain common to all paths, for a receiver that was not calibrated; see ``report``.
        iterations: most steps of the fit of materials.
        relevance: what it rules out is off.
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
        """Effects to choose from, the fewest first; one where they are given. What ``relevance`` rules out is off."""
        most = Effects() if self.relevance is None else self.relevance.needs(frequency_hz)[0]
        if isinstance(self.effects, Effects):
            return [self.effects]
        given = SETS.values() if self.effects == "auto" else [SETS[self.effects]]
        found = [
            Effects(**{f.name: min(getattr(one, f.name), getattr(most, f.name)) for f in fields(Effects)})
            for one in given
        ]
        rare: dict[str, Any] = {"transmissions": most.transmissions, "diffractions": most.diffractions}
        if self.relevance is not None:
            found = [replace(one, **rare) for one in found]
        return list(dict.fromkeys(found))

    def exponents(self, frequency_hz: float) -> tuple[int, ...]:
        """Of the lobes."""
        if self.lobes is not None:
            return self.lobes
        known = None if self.relevance is None else self.relevance.needs(frequency_hz)[1]
        return LOBES if known is None else known

    @property
    def rays(self) -> int:
        """Square root of the rays per pixel."""
        return self.sub_pixels or (1 if self.quick else SUB_PIXELS)
