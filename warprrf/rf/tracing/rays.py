"""Rays of receivers on a surface: what they hit, and how a source illuminates that. No material is known here.

A pixel is seen through a lattice of rays. What they hit depends on the receiver alone, how it is illuminated on the
transmitter besides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.cache import Cache, cached_property
from warprrf.device import DeviceLike, launch, resolve
from warprrf.geometry import rays as mesh_rays
from warprrf.geometry.mesh import vectors_across
from warprrf.kernels.radio import illumination
from warprrf.rf.spectra.spectrum import sub_pixel_directions
from warprrf.rf.tracing.surface import Surface

REALS = {np.dtype(np.float32): wp.float32, np.dtype(np.float64): wp.float64}
"""Warp's types of precisions."""
NEAREST_M = 0.05  # an element at the transmitter spans directions: its distance counts as no less


@dataclass(frozen=True)
class Hits:
    """What rays from ``O`` origins hit, the same number from each.

    Attributes:
        origins: where they start [m], shape ``(O, 3)``.
        directions: unit vectors, one for each ray, or one set for every origin, shape ``(K, 3)``.
        solid_angle: that each ray stands for [sr], less what air took before, shape ``(K,)``.
        face: face that each hits, one origin's rays after another's, -1 for none, shape ``(O K,)`` int32.
        range_m: distance to it, shape ``(O K,)``; infinite for none.
    """

    origins: np.ndarray
    directions: np.ndarray
    solid_angle: np.ndarray
    face: np.ndarray
    range_m: np.ndarray
    cache: Cache = field(init=False, repr=False, default_factory=lambda: Cache(1))

    def rays(self, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the rays of index ``ray`` (N,) where they start [m] and their unit vectors, shape ``(N, 3)``, and solid angles
        [sr], shape ``(N,)``."""
        each = max(len(self.face) // max(len(self.origins), 1), 1)
        start, toward = mesh_rays.rays_of(self.origins, self.directions, each, ray)
        return start, toward, self.solid_angle[ray % len(self.solid_angle)]

    def points(self, ray: np.ndarray) -> np.ndarray:
        """Where the rays of index ``ray`` (N,) hit [m], shape ``(N, 3)``; NaN or infinite where they hit nothing."""
        start, toward, _ = self.rays(ray)
        with np.errstate(invalid="ignore"):
            return np.asarray(start + self.range_m[ray, None] * toward)


@dataclass(frozen=True)
class Light:
    """How a source illuminates what rays hit.

    Attributes:
        strength: Omega cos(theta_i) / (4 pi d1)^2 [sr/m^2] less what the air absorbs, shadows not counted, shape ``(K,)``.
        angle: cosines of incidence, of scattering, and of the angle to the mirror direction, shape ``(K, 3)``.
        point: where the rays hit [m], known where there is light, shape ``(K, 3)``.
    """

    strength: np.ndarray
    angle: np.ndarray
    point: np.ndarray


def quasi_random(count: int, each: int) -> np.ndarray:
    """Numbers that fill the unit cube, ``each`` for each of ``count``, shape ``(3, count, each)``."""
    steps = np.multiply.outer([0.8191725133961645, 0.6710436067037893, 0.5497004779019703], np.arange(each))
    shift = np.random.default_rng(0).random((3, count, 1))
    return np.mod(steps[:, None] + shift, 1.0)  # the R3 sequence (Roberts 2018), shifted


def by_cosine(normal: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Directions (N, 3) about ``normal`` (N, 3), of a density proportional to the cosine where ``u`` and ``v`` (N,) fill the unit
    square; that cosine is sqrt(1 - u)."""
    radius, turn = np.sqrt(u), 2.0 * np.pi * v
    across, over = vectors_across(normal)
    directions = (radius * np.cos(turn))[:, None] * across + (radius * np.sin(turn))[:, None] * over
    return np.asarray(directions + np.sqrt(1.0 - u)[:, None] * normal)


class RayGrid:
    """Rays that fill the sphere around a receiver, and other rays, on one surface.

    Args:
        sub_pixels: square root of the rays per pixel.
        loss_per_m: absorption of power by the air [neper/m].
        nearest_m: least distance of a source from what it lights [m]: a smaller one counts as this. With 0 it counts as it is, and
            no ray sees more than half of what the source sends.
        dtype: precision of angles and of light.
    """

    def __init__(
        self,
        surface: Surface,
        shape: tuple[int, int],
        sub_pixels: int,
        *,
        loss_per_m: float = 0.0,
        nearest_m: float = NEAREST_M,
        dtype: Any = np.float32,
        device: DeviceLike = None,
    ) -> None:
        self.surface, self.shape, self.sub_pixels, self.dtype = surface, shape, sub_pixels, np.dtype(dtype)
        self.loss_per_m, self.nearest_m = float(loss_per_m), nearest_m
        self.device = resolve(device)
        self.directions, solid_angle = sub_pixel_directions(shape, sub_pixels)
        self.solid_angle = solid_angle.astype(self.dtype)
        self.half_width = 0.5 * np.pi / (shape[0] * sub_pixels**2)

    @cached_property
    def device_directions(self) -> wp.array:
        """The directions, on the device."""
        return wp.array(self.directions, dtype=wp.vec3d, device=self.device)

    @property
    def per_pixel(self) -> int:
        """Rays of a pixel."""
        return self.sub_pixels**2

    def transmittance(self, length_m: ArrayLike) -> np.ndarray | float:
        """Share of power that ``length_m`` [m] of air lets through; 1.0 without absorption."""
        return np.exp(-self.loss_per_m * np.asarray(length_m)) if self.loss_per_m else 1.0

    def hit(self, receivers: np.ndarray) -> Hits:
        """What the grid's rays from ``receivers``, (3,) or (O, 3), hit."""
        origins = np.asarray(receivers, float).reshape(-1, 3)
        return self.hit_along(origins, self.directions, self.solid_angle, True)

    def hit_along(
        self, origins: np.ndarray, directions: np.ndarray, solid_angle: np.ndarray, shared: bool = False
    ) -> Hits:
        """What rays hit: ``origins`` (O, 3), a whole number of ``directions`` (K, 3) each, or all of them each if they are
        ``shared``."""
        least_m = 1e-6  # range of what is hit at the ray's very start
        each = len(directions) if shared else len(directions) // max(len(origins), 1)
        hit = self.surface.mesh.cast(
            origins, directions, per_origin=max(each, 1), device=self.device, backend=self._backend(each * len(origins))
        )  # fmt: skip
        return Hits(
            origins, directions, np.asarray(solid_angle, self.dtype), np.asarray(hit.face, np.int32),
            np.maximum(hit.t, least_m, out=hit.t),
        )  # fmt: skip

    def hit_from(self, tile: np.ndarray, point: np.ndarray, u: np.ndarray, v: np.ndarray) -> Hits:
        """What rays hit that start at places (N, 3) on sides of tiles (N,), each with a direction :func:`by_cosine` of its own."""
        s = self.surface
        behind, tile = np.divmod(tile, len(s.tiles.face))
        normal = s.side_normal[s.tiles.face[tile]] * (1.0 - 2.0 * behind)[:, None]
        start, directions = point + s.position_error_m * normal, by_cosine(normal, u, v)
        return self.hit_along(start, directions, np.ones(len(tile)))

    def tile(self, hits: Hits) -> np.ndarray:
        """Tile that each ray hits, shape ``(O K,)`` int32, -1 for none; ``hits`` keeps it."""

        def make() -> np.ndarray:
            hit, found = np.flatnonzero(hits.face >= 0), np.full(len(hits.face), -1, np.int32)
            found[hit] = self.surface.tile_at(hits.face[hit], hits.points(hit), hits.rays(hit)[1])
            return found

        return hits.cache.get("tile", make)

    def tiles_met(self, hits: Hits) -> tuple[np.ndarray, np.ndarray]:
        """Which rays hit something, and the sides of tiles that they do."""
        s, ray = self.surface, np.flatnonzero(hits.face >= 0)
        behind = s.is_behind(hits.face[ray], hits.rays(ray)[1])
        return ray, self.tile(hits)[ray] + behind * len(s.tiles.face)

    def _backend(self, count: int) -> str:
        """Embree is worth being loaded for a grid of rays, whether it is in use yet or not."""
        usable = not self.device.is_cuda and mesh_rays.open3d_installed()
        return "embree" if usable and count >= mesh_rays.EMBREE_RAYS else "warp"

    def light(self, hits: Hits, source: np.ndarray) -> tuple[Light, np.ndarray]:
        """How a transmitter at ``source`` (3,) [m] illuminates what was hit, and rows that no shadow falls on."""
        found = self.unshadowed(hits, source)
        ray = np.flatnonzero(found.strength > 0)
        free = self.surface.mesh.visible(
            np.asarray(source, float), found.point.take(ray, axis=0), clearance=self.surface.position_error_m, device=self.device,
            backend=self._backend(len(ray)),
        )  # fmt: skip
        return found, ray[free]

    def unshadowed(self, hits: Hits, sources: np.ndarray, ray: np.ndarray | None = None) -> Light:
        """How transmitters at ``sources`` (3,) or (K, 3) [m] would illuminate what rays of index ``ray`` (K,), by default
        all, hit if nothing threw a shadow."""
        count, where = len(hits.face) if ray is None else len(ray), self.device
        real = REALS[self.dtype]
        kinds = real, wp.types.vector(3, real), wp.vec3d
        found = [wp.zeros(count, dtype=kind, device=where) for kind in kinds]
        each = max(len(hits.face) // max(len(hits.origins), 1), 1)
        inputs = [
            *self.surface.on_device(where, real), np.zeros(0, np.int32) if ray is None else ray,
            np.reshape(sources, (-1, 3)), hits.origins, each, hits.directions, hits.face, hits.range_m, hits.solid_angle,
            self.nearest_m, self.loss_per_m, *found,
        ]  # fmt: skip
        launch(illumination.build(real), count, inputs, device=where)
        light = Light(*(a.numpy() for a in found))
        if self.nearest_m == 0.0:
            met_m = hits.range_m if ray is None else hits.range_m[ray]
            np.minimum(light.strength, light.angle[:, 1] / (8.0 * np.pi * met_m**2), out=light.strength)
        return light
