"""Diffuse single bounces of one receiver: what its rays meet, how a source lights it, and the images that follow.

A pixel is seen through a lattice of rays. What they meet depends on the receiver alone, how it is lit on the source
besides, what it sends on on the materials too: the three steps are kept apart, so that a fit, another transmitter or
another set of materials repeats only what changes. Path gain per ray, after Degli-Esposti et al. (2007), eq. (5), over
the footprint of its solid angle Omega:

    (lambda / 4 pi)^2 Omega f_s |Gamma|^2 cos(theta_i) / (cos(theta_s) d1^2)

with f_s a mix of normalised lobes and |Gamma|^2 a Fresnel curve of one permittivity per material group. Absorption by
the air is that of each leg: lit rays hold those from the source to the ray's origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.geometry import o3d
from warprrf.geometry import rays as raysearch
from warprrf.kernels.radio import bounce
from warprrf.rf.em.fresnel import lobe_norm
from warprrf.rf.em.half_spaces import COSINES, fresnel_curves
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.spectra.spectrum import strongest_rays, sub_pixel_directions

LOBES = (0, 2, 5, 12, 30)
"""Exponents of the lobe mix; 0 is Lambertian."""
SUB_PIXELS = 3
"""Square root of the rays per pixel."""
LEAST_M = 1e-6  # range of what is met at the ray's very start
NEAREST_M = 0.05  # an element at the transmitter spans directions: d1 counts as no less


@lru_cache(maxsize=8)
def _lobe_tables(exponents: tuple[int, ...], device: str) -> tuple[wp.array, wp.array]:
    cosine = np.linspace(0.0, 1.0, COSINES)
    inverse = np.array([np.ones(COSINES) if n == 0 else 1.0 / lobe_norm(n, cosine) for n in exponents])
    return (
        wp.array(np.array(exponents, np.float32), dtype=wp.float32, device=device),
        wp.array(inverse.astype(np.float32), dtype=wp.float32, device=device),
    )


@dataclass(frozen=True)
class Met:
    """What rays meet: their origins (O, 3) and directions, and face (-1: nothing) and range of each, on the device."""

    origins: wp.array
    directions: wp.array
    solid_angle: wp.array
    face: wp.array
    range_m: wp.array

    @property
    def inputs(self) -> list[Any]:
        """In the order that kernels take them."""
        per_origin = len(self.face) // len(self.origins)
        return [self.origins, per_origin, self.directions, self.face, self.range_m]


@dataclass(frozen=True)
class Lit:
    """How one source lights what rays meet; see :func:`warprrf.kernels.radio.bounce.light_surface`."""

    strength: wp.array
    cos_in: wp.array
    cos_mirror: wp.array
    grazing: wp.array

    @property
    def inputs(self) -> list[wp.array]:
        """In the order that kernels take them."""
        return [self.strength, self.cos_in, self.cos_mirror, self.grazing]


class BounceTracer:
    """Rays on a surface.

    Args:
        surface: what is met.
        shape: rows and columns of a spectrum.
        lobes: exponents of the lobe mix.
        sub_pixels: square root of the rays per pixel.
        loss_per_m: absorption by the air [neper/m].
        device: where rays are cast.
    """

    def __init__(
        self,
        surface: Surface,
        shape: tuple[int, int],
        *,
        lobes: tuple[int, ...] = LOBES,
        sub_pixels: int = SUB_PIXELS,
        loss_per_m: float = 0.0,
        device: Any = None,
    ) -> None:
        self.surface, self.shape, self.lobes, self.sub_pixels = surface, shape, tuple(lobes), sub_pixels
        self.loss_per_m = float(loss_per_m)
        self.device = _device.resolve(device)
        # On a CPU Embree is three times as fast as the search inside the kernels, and worth being loaded for a grid.
        self._searches = not self.device.is_cuda and o3d.installed()
        self.directions, self.solid_angle = sub_pixel_directions(shape, sub_pixels)
        self._directions = wp.array(self.directions, dtype=wp.vec3d, device=self.device)
        self._solid_angle = wp.array(self.solid_angle, dtype=wp.float32, device=self.device)
        self.half_width = 0.5 * np.pi / (shape[0] * sub_pixels**2)
        self._exponent, self._norm = _lobe_tables(self.lobes, str(self.device))
        self._moments = wp.array(fresnel_curves().moments, dtype=wp.float32, device=self.device)

    def through_air(self, length_m: Any) -> np.ndarray | float:
        """Share of power that ``length_m`` [m] of air lets through; 1.0 without absorption."""
        return np.exp(-self.loss_per_m * np.asarray(length_m)) if self.loss_per_m else 1.0

    def meet(self, receivers: np.ndarray) -> Met:
        """What the grid's rays from ``receivers``, (3,) or (O, 3), meet, one receiver's after another's."""
        origins = np.asarray(receivers, float).reshape(-1, 3)
        return self._meet(origins, self._directions, self._solid_angle, len(origins) * len(self._directions))

    def meet_rays(self, origins: np.ndarray, directions: np.ndarray, solid_angle: np.ndarray) -> Met:
        """What rays meet: ``origins`` (O, 3), a whole number of ``directions`` (K, 3) each."""
        return self._meet(
            origins,
            wp.array(directions, dtype=wp.vec3d, device=self.device),
            wp.array(solid_angle, dtype=wp.float32, device=self.device),
            len(directions),
        )

    def _meet(self, origins: np.ndarray, directions: wp.array, solid_angle: wp.array, count: int) -> Met:
        starts = wp.array(origins, dtype=wp.vec3d, device=self.device)
        if self._searches:
            start = np.repeat(origins, count // len(origins), axis=0) if len(origins) > 1 else origins
            toward = directions.numpy()
            hit = self.surface.mesh.cast(
                start,
                np.tile(toward, (count // len(toward), 1)) if len(toward) < count else toward,
                device=self.device,
                backend=self._backend(count),
            )
            found = [
                wp.array(a, device=self.device, copy=False) for a in (hit.face, np.maximum(hit.t, LEAST_M))
            ]
            return Met(starts, directions, solid_angle, *found)
        met = Met(
            starts, directions, solid_angle,
            wp.empty(count, dtype=wp.int32, device=self.device), wp.empty(count, dtype=wp.float64, device=self.device),
        )  # fmt: skip
        _device.launch(
            bounce.meet_surface, count, [self.surface.on_device(self.device), *met.inputs], device=self.device
        )
        return met

    @staticmethod
    def _backend(count: int) -> str:
        return "embree" if count >= raysearch.EMBREE_RAYS else "warp"

    def _shadow(self, met: Met, lit: Lit, position: np.ndarray) -> None:
        """Take away the light of what the transmitter at ``position`` does not see."""
        strength = lit.strength.numpy()
        ray = np.flatnonzero(strength > 0)
        origins, directions = met.origins.numpy(), met.directions.numpy()
        start = origins[ray // (len(strength) // len(origins))] if len(origins) > 1 else origins
        point = start + met.range_m.numpy()[ray, None] * directions[ray % len(directions)]
        free = self.surface.mesh.visible(
            position,
            point,
            clearance=self.surface.skin_m,
            device=self.device,
            backend=self._backend(len(ray)),
        )
        strength[ray[~free]] = 0.0

    def light(
        self, met: Met, position: np.ndarray, *, real: np.ndarray | None = None, patch: int = -1
    ) -> Lit:
        """How the transmitter at ``position`` (3,), or its image in ``patch`` (``real`` is then itself), lights it."""
        source = bounce.Source()
        source.position = wp.vec3d(*position)
        source.real = wp.vec3d(*(position if real is None else real))
        source.patch = int(patch)
        count = len(met.face)
        lit = Lit(*(wp.zeros(count, dtype=wp.float32, device=self.device) for _ in range(4)))
        inputs = [
            self.surface.on_device(self.device), source, *met.inputs, met.solid_angle, float(self.half_width),
            NEAREST_M, int(not (self._searches and patch < 0)), *lit.inputs,
        ]  # fmt: skip
        _device.launch(bounce.light_surface, count, inputs, device=self.device)
        if self._searches and patch < 0:
            self._shadow(met, lit, np.asarray(position, float))
        if self.loss_per_m:
            inputs = [source.position, self.loss_per_m, *met.inputs, lit.strength]
            _device.launch(bounce.absorb, count, inputs, device=self.device)
        return lit

    def resolve(self, met: Met, lit: Lit, wavelength_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Path gain per pixel of each lit group, lobe and Fresnel component at unit weight.

        Returns:
            The groups that are lit, shape ``(A,)``, and the images, shape ``(H W, A, L, 3)`` float32.
        """
        pixels = self.shape[0] * self.shape[1]
        group = self.surface.group[met.face.numpy()[lit.strength.numpy() > 0]]
        groups = np.unique(group)
        place = np.zeros(self.surface.groups, np.int32)
        place[groups] = np.arange(len(groups))
        columns = len(groups) * len(self.lobes) * bounce.MOMENTS
        out = wp.zeros((pixels, max(columns, 1)), dtype=wp.float32, device=self.device)
        inputs = [
            self.sub_pixels**2, self.surface.on_device(self.device),
            wp.array(place, dtype=wp.int32, device=self.device), met.face, *lit.inputs, self._exponent, self._norm,
            self._moments, out,
        ]  # fmt: skip
        _device.launch(bounce.resolve_bounces, pixels, inputs, device=self.device)
        image = out.numpy()[:, :columns] * np.float32(wavelength_m**2)
        return groups, image.reshape(pixels, len(groups), len(self.lobes), bounce.MOMENTS)

    def strongest(self, power: np.ndarray, sigma: float) -> np.ndarray:
        """Which ray of the grid, of ``power`` (K,), gives each pixel the most through a beam; see
        :func:`strongest_rays`."""
        return strongest_rays(self._directions, power, self.shape, sigma, device=self.device)

    def scatter(
        self, met: Met, lit: Lit, weight: np.ndarray, log_excess: np.ndarray, wavelength_m: float
    ) -> np.ndarray:
        """Path gain of each ray, shape ``(K,)`` float32, for lobe weights ``(G, L)`` and ln(epsilon_r - 1) ``(G,)``."""
        return self.scatter_faces(met.face, lit, weight, log_excess, wavelength_m)

    def scatter_faces(
        self, face: wp.array, lit: Lit, weight: np.ndarray, log_excess: np.ndarray, wavelength_m: float
    ) -> np.ndarray:
        """:meth:`scatter` for the faces alone that rays met."""
        curves = fresnel_curves()
        fresnel = curves.at(curves.curves, log_excess)[0]
        power = wp.empty(len(face), dtype=wp.float32, device=self.device)
        inputs = [
            self.surface.on_device(self.device), face, *lit.inputs, self._exponent, self._norm,
            wp.array(fresnel, dtype=wp.float32, device=self.device),
            wp.array(weight * wavelength_m**2, dtype=wp.float32, device=self.device), power,
        ]  # fmt: skip
        _device.launch(bounce.scatter_bounces, len(face), inputs, device=self.device)
        return power.numpy()
