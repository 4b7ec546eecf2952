"""What receivers see of the geometry under one transmitter, whatever the materials: traced once, used by every render.

A :class:`Transport` belongs to a surface, a transmitter and a grid of rays. It gives a :class:`ReceiverView` of any
receiver: what its rays hit, how the transmitter illuminates that, line of sight and mirror paths without their
reflection, and the geometry of light that comes over mirrors. How surfaces illuminate each other
(:mod:`warprrf.rf.fields.bistatic.elements`) belongs to the transmitter and is traced when first asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from warprrf.cache import Cache
from warprrf.device import DeviceLike, Progress, resolve
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.bistatic.elements import LIFT_M, ElementLinks
from warprrf.rf.fields.bistatic.materials import Terms
from warprrf.rf.fields.bistatic.mirror_light import MIRROR_SLACK_M, MirrorIllumination, MirrorLight
from warprrf.rf.fields.bistatic.rays import Hits, Illumination, RayGrid
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.paths.images import MirrorImages
from warprrf.rf.paths.mirror_paths import MirrorPaths, zone_paths
from warprrf.rf.spectra.spectrum import unit_beams

MIRROR_SUB_PIXELS = 2
"""Square root of the rays per pixel that look into mirrors: what they show is seen a second time already."""

_TRACED = Cache(
    6
)  # a lobby's take up to 90 MB each; kept here, not by surfaces, so that the bound is the process's


@dataclass(frozen=True)
class MirrorShown:
    """What mirrors show a receiver of the illuminated scene: rays turned at a planar patch.

    Attributes:
        ray: the first ray of the same pixel in the view's grid, shape ``(M,)``.
        group: of the mirror, shape ``(M,)``.
        cosine: of incidence on it, shape ``(M,)``.
        air: share of power that the air lets through from the mirror to the receiver, shape ``(M,)``.
        hits: what the turned rays hit.
        light: how the transmitter illuminates that.
    """

    ray: np.ndarray
    group: np.ndarray
    cosine: np.ndarray
    air: np.ndarray
    hits: Hits
    light: Illumination


@dataclass(frozen=True)
class ReceiverView:
    """What R receivers see of the geometry under one transmitter; their rays, K each, stand one after another.

    Attributes:
        transport: surface, transmitter and grid.
        receivers: positions [m], shape ``(R, 3)``.
        hits: what the rays hit.
        light: how the transmitter illuminates that.
        paths: line of sight and mirror paths, L in all, without their reflection.
        beams: unit beam of each path over the pixels, shape ``(L, H, W)`` float32; None where none was asked for.
        mirror_illumination: light that mirrors throw on what the rays hit; None where no term wants it.
        mirror_shown: what mirrors show; None where no term wants it.
    """

    transport: Transport
    receivers: np.ndarray
    hits: Hits
    light: Illumination
    paths: MirrorPaths
    beams: np.ndarray | None = field(default=None, repr=False)
    mirror_illumination: MirrorIllumination | None = None
    mirror_shown: MirrorShown | None = None

    @property
    def friis(self) -> np.ndarray:
        """Power of each path without its reflections, shape ``(L,)``."""
        paths, t = self.paths, self.transport
        friis = (t.wavelength_m / (4.0 * np.pi * paths.length_m)) ** 2
        return np.asarray(friis * paths.share**2 * t.grid.transmittance(paths.length_m))

    @property
    def path_groups(self) -> np.ndarray:
        """Groups that each path meets, shape ``(L, 3)``, -1 where fewer."""
        known, owner = self.paths.patch >= 0, self.transport.surface.patch_group
        return np.where(known, owner[np.where(known, self.paths.patch, 0)] if len(owner) else -1, -1)


class Transport:
    """Geometry under one transmitter.

    Args:
        surface: what is hit.
        transmitter: position (3,) [m].
        frequency_hz: carrier.
        grid: rays of a receiver.
        beam_sigma_rad: width of the receiver's beam; None where no beams are asked for.
        mirror_sub_pixels: square root of the rays per pixel that look into mirrors.

    Attributes:
        wavelength_m: wavelength.
    """

    def __init__(
        self,
        surface: Surface,
        transmitter: np.ndarray,
        frequency_hz: float,
        grid: RayGrid,
        beam_sigma_rad: float | None = None,
        mirror_sub_pixels: int = MIRROR_SUB_PIXELS,
    ) -> None:
        self.surface, self.grid, self.beam_sigma_rad = surface, grid, beam_sigma_rad
        self.mirror_sub_pixels = mirror_sub_pixels
        self.transmitter = np.array(transmitter, np.float64)
        self.frequency_hz = frequency_hz
        self.wavelength_m = SPEED_OF_LIGHT / frequency_hz
        self._tracing = grid
        self._made = Cache(8)

    @classmethod
    def of(
        cls,
        surface: Surface,
        transmitter: np.ndarray,
        frequency_hz: float,
        shape: tuple[int, int],
        sub_pixels: int,
        *,
        beam_sigma_rad: float | None = None,
        loss_per_m: float = 0.0,
        device: DeviceLike = None,
    ) -> Transport:
        """That of a grid of ``shape`` with ``sub_pixels`` squared rays a pixel; the last few are kept."""
        place = np.asarray(transmitter, np.float64).tobytes()
        where = str(resolve(device))
        key = surface, place, frequency_hz, shape, sub_pixels, beam_sigma_rad, loss_per_m, where

        def make() -> Transport:
            grid = RayGrid(surface, shape, sub_pixels, loss_per_m=loss_per_m, device=device)
            return cls(surface, transmitter, frequency_hz, grid, beam_sigma_rad)

        return _TRACED.get(key, make)

    @property
    def recipe(self) -> Callable[[], Transport]:
        """Makes the same again, in another process: it holds the surface, not what was traced."""
        g = self._tracing
        return partial(
            Transport.of, self.surface, self.transmitter, self.frequency_hz, g.shape, g.sub_pixels,
            beam_sigma_rad=self.beam_sigma_rad, loss_per_m=g.loss_per_m, device=str(g.device),
        )  # fmt: skip

    def on_grid(self, shape: tuple[int, int], sub_pixels: int, mirror_sub_pixels: int) -> Transport:
        """The same for receivers with other rays and no beams; what belongs to the transmitter is shared."""
        other = copy(self)
        other.grid = self._grid(shape, sub_pixels)
        other.beam_sigma_rad, other.mirror_sub_pixels = None, mirror_sub_pixels
        return other

    @property
    def elements(self) -> ElementLinks:
        """How the transmitter illuminates the elements by way of others."""
        return self._made.get("elements", lambda: ElementLinks(self._tracing, self.transmitter))

    @property
    def mirror_light(self) -> MirrorLight:
        """What the transmitter sends to the surface by way of one mirror."""
        return self._made.get("mirror light", lambda: MirrorLight(self._tracing, self.transmitter))

    @property
    def images(self) -> MirrorImages:
        """Images of the transmitter in the surface's mirrors."""

        where: dict[str, Any] = {"slack_m": MIRROR_SLACK_M, "device": self.grid.device}
        return self._made.get("images", lambda: MirrorImages(self.surface.patches, self.transmitter, **where))

    def paths(self, receivers: np.ndarray, order: int, progress: Progress | None = None) -> MirrorPaths:
        """Line of sight and mirror paths of ``receivers`` (R, 3) with at most ``order`` reflections."""
        return zone_paths(self.images, receivers, order, self.wavelength_m, self.surface.skin_m, progress)

    def view(self, receivers: np.ndarray, terms: Terms, *, paths: MirrorPaths | None = None) -> ReceiverView:
        """What ``receivers``, (3,) or (R, 3) [m], see, as far as ``terms`` want it.

        Args:
            receivers: positions, off the surface.
            terms: what is modelled.
            paths: line of sight and mirror paths, if they are known.
        """
        places = np.asarray(receivers, np.float64).reshape(-1, 3)
        hits = self.grid.hit(places)
        found = self.paths(places, terms.mirror_order) if paths is None else paths
        beams = None
        if self.beam_sigma_rad is not None:
            beams = unit_beams(found.arrival, self.grid.shape, self.beam_sigma_rad)
        light = self.grid.light(hits, self.transmitter)
        return self.complete(ReceiverView(self, places, hits, light, found, beams), terms)

    def adopt(self, view: ReceiverView) -> ReceiverView:
        """What :func:`traced` found, as a view of this transport."""
        own: dict[str, Any] = {
            "directions": self.grid.device_directions,
            "solid_angle": self.grid.device_solid_angle,
        }
        return replace(view, transport=self, hits=replace(view.hits, **own))

    def complete(self, view: ReceiverView, terms: Terms) -> ReceiverView:
        """``view`` with what ``terms`` want and it lacks."""
        if not terms.diffuse:
            return view
        if terms.mirror_scatter and view.mirror_illumination is None:
            found = self.mirror_light.view(self.grid, view.hits)
            view = replace(view, mirror_illumination=found)
        if terms.scatter_mirror and view.mirror_shown is None:
            view = replace(view, mirror_shown=self._mirror_shown(view.receivers))
        return view

    def _grid(self, shape: tuple[int, int], sub_pixels: int) -> RayGrid:
        g = self.grid
        return RayGrid(self.surface, shape, sub_pixels, loss_per_m=g.loss_per_m, device=g.device)

    def _mirror_shown(self, receivers: np.ndarray) -> MirrorShown:
        """Turn rays of ``receivers`` (R, 3) at the patches that they hit, and see how the transmitter lights the rest."""
        s, per_pixel = self.surface, self.grid.sub_pixels**2
        kind = self.grid.shape, self.mirror_sub_pixels
        grid = self._made.get(kind, lambda: self._grid(*kind))
        first_hits = grid.hit(receivers)
        face = first_hits.face.numpy()
        ray = np.flatnonzero(face >= 0)
        ray = ray[s.patch[face[ray]] >= 0]
        face, direction = face[ray], grid.directions[ray % len(grid.directions)]
        normal = s.plane_normal[s.patch[face]]
        normal = np.where((direction * normal).sum(axis=1, keepdims=True) > 0, -normal, normal)
        cosine = -(direction * normal).sum(axis=1)
        turned = direction + 2.0 * cosine[:, None] * normal
        hits = grid.hit_along(
            first_hits.points(ray) + LIFT_M * normal, turned, grid.solid_angle[ray % len(grid.directions)]
        )
        air = np.broadcast_to(grid.transmittance(first_hits.range_m.numpy()[ray]), len(ray))
        light = grid.light(hits, self.transmitter)
        return MirrorShown(ray // grid.sub_pixels**2 * per_pixel, s.group[face], cosine, air, hits, light)


def traced(
    recipe: Callable[[], Transport], terms: Terms, part: tuple[np.ndarray, MirrorPaths]
) -> ReceiverView:
    """What a receiver (3,) of known line of sight and mirror paths sees, without what all receivers share."""
    view = recipe().view(part[0], terms, paths=part[1])
    none: dict[str, Any] = {"directions": None, "solid_angle": None}
    return replace(view, transport=None, hits=replace(view.hits, **none))  # type: ignore[arg-type]
