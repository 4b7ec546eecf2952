"""What one receiver sees of the geometry, whatever the materials, and what a field makes of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from warprrf.rf.fields.bistatic.bounces import BounceTracer, Lit, Met
from warprrf.rf.fields.bistatic.mirror_light import MirrorLight, MirrorSight
from warprrf.rf.fields.bistatic.second_bounce import SeenSurface
from warprrf.rf.fields.bistatic.specular import SpecularPaths


@dataclass(frozen=True)
class Sight:
    """What a receiver sees of the geometry under one transmitter, whatever the materials.

    Attributes:
        receiver, transmitter: positions [m].
        met: what its rays meet.
        lit: how the transmitter lights that.
        paths: its line of sight and mirror paths.
        beams: unit beam of each, shape ``(L, H, W)`` float32.
        tracer: whose rays they are.
    """

    receiver: np.ndarray
    transmitter: np.ndarray
    met: Met
    lit: Lit
    paths: SpecularPaths
    beams: np.ndarray
    tracer: BounceTracer = field(repr=False)
    _mirrored: list[MirrorSight] = field(default_factory=list, repr=False)

    @cached_property
    def surface(self) -> SeenSurface:
        """Faces that its rays meet."""
        return SeenSurface.of(self.tracer, self.met)

    def mirrored(self, light: MirrorLight) -> MirrorSight:
        """What its rays see of the light that mirrors throw on surfaces, traced once."""
        if not self._mirrored:
            self._mirrored.append(light.sight(self.receiver, self.met))
        return self._mirrored[0]


@dataclass(frozen=True)
class Composed:
    """A spectrum by its parts, path gain.

    Attributes:
        rays: of each diffuse ray, before the beam, shape ``(K,)``.
        specular: of each line-of-sight and mirror path, shape ``(L,)``.
        further: of what was sent on, per pixel before the beam, shape ``(H, W)``.
        image: all, after the beam, shape ``(H, W)``.
    """

    rays: np.ndarray
    specular: np.ndarray
    further: np.ndarray
    image: np.ndarray
