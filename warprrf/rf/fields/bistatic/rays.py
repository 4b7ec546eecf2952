"""Rays of receivers on a surface: what they hit, and how a source illuminates that. No material is known here.

A pixel is seen through a lattice of rays. What they hit depends on the receiver alone, how it is illuminated on the
transmitter besides: the two steps are kept apart, so that another transmitter repeats only what changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf import device as _device
from warprrf.device import DeviceLike
from warprrf.geometry import rays as mesh_rays
from warprrf.kernels.radio import bounce
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.spectra.spectrum import sub_pixel_directions

LEAST_M = 1e-6  # range of what is hit at the ray's very start
NEAREST_M = 0.05  # an element at the transmitter spans directions: d1 counts as no less


@dataclass(frozen=True)
class Hits:
    """What rays from ``O`` origins hit, the same number from each; arrays are on the device.

    Attributes:
        origins: where they start [m], shape ``(O, 3)``.
        directions: unit vectors, one for each ray, or one set for every origin, shape ``(K, 3)``.
        solid_angle: that each ray stands for [sr], shape ``(K,)``.
        face: face that each hits, one origin's rays after another's, -1 for none, shape ``(O K,)``.
        range_m: distance to it, shape ``(O K,)``; infinite for none.
    """

    origins: wp.array
    directions: wp.array
    solid_angle: wp.array
    face: wp.array
    range_m: wp.array

    @property
    def inputs(self) -> list[Any]:
        """In the order that kernels take them."""
        per_origin = len(self.face) // max(len(self.origins), 1)
        return [self.origins, max(per_origin, 1), self.directions, self.face, self.range_m]

    def points(self, ray: np.ndarray) -> np.ndarray:
        """Where the rays of index ``ray`` (N,) hit [m], shape ``(N, 3)``; NaN or infinite where they hit nothing."""
        origins, directions = self.origins.numpy(), self.directions.numpy()
        start, toward = mesh_rays.rays_of(origins, directions, len(self.face) // len(origins), ray)
        with np.errstate(invalid="ignore"):
            return np.asarray(start + self.range_m.numpy()[ray, None] * toward)


@dataclass(frozen=True)
class Illumination:
    """How a source illuminates what rays hit; arrays (K,) on the device.

    Attributes:
        strength: Omega cos(theta_i) / (4 pi d1)^2 [sr/m^2], 0 in the source's shadow; less what the air absorbs.
        cos_in: cosine of incidence.
        cos_out: cosine of scattering.
        cos_mirror: cosine of the angle between the scattered and the mirror direction.
        grazing: mean of 1 / cos(theta_s) over the ray's width.
    """

    strength: wp.array
    cos_in: wp.array
    cos_out: wp.array
    cos_mirror: wp.array
    grazing: wp.array

    @property
    def inputs(self) -> list[wp.array]:
        """In the order that kernels take them."""
        return [self.strength, self.cos_in, self.cos_out, self.cos_mirror, self.grazing]


class RayGrid:
    """Rays that fill the sphere around a receiver, and other rays, on one surface.

    Args:
        surface: what is hit.
        shape: rows and columns of a spectrum.
        sub_pixels: square root of the rays per pixel.
        loss_per_m: absorption by the air [neper/m].
        device: where rays are cast.
    """

    def __init__(
        self,
        surface: Surface,
        shape: tuple[int, int],
        sub_pixels: int,
        *,
        loss_per_m: float = 0.0,
        device: DeviceLike = None,
    ) -> None:
        self.surface, self.shape, self.sub_pixels = surface, shape, sub_pixels
        self.loss_per_m = float(loss_per_m)
        self.device = _device.resolve(device)
        self.directions, self.solid_angle = sub_pixel_directions(shape, sub_pixels)
        self.device_directions = wp.array(self.directions, dtype=wp.vec3d, device=self.device)
        self.device_solid_angle = wp.array(self.solid_angle, dtype=wp.float32, device=self.device)
        self.half_width = 0.5 * np.pi / (shape[0] * sub_pixels**2)

    def transmittance(self, length_m: ArrayLike) -> np.ndarray | float:
        """Share of power that ``length_m`` [m] of air lets through; 1.0 without absorption."""
        return np.exp(-self.loss_per_m * np.asarray(length_m)) if self.loss_per_m else 1.0

    def hit(self, receivers: np.ndarray) -> Hits:
        """What the grid's rays from ``receivers``, (3,) or (O, 3), hit."""
        origins = np.asarray(receivers, float).reshape(-1, 3)
        return self._hit(origins, self.device_directions, self.device_solid_angle, len(self.directions))

    def hit_along(self, origins: np.ndarray, directions: np.ndarray, solid_angle: np.ndarray) -> Hits:
        """What rays hit: ``origins`` (O, 3), a whole number of ``directions`` (K, 3) each."""
        toward = wp.array(directions, dtype=wp.vec3d, device=self.device)
        share = wp.array(solid_angle, dtype=wp.float32, device=self.device)
        return self._hit(origins, toward, share, len(directions) // max(len(origins), 1))

    def _hit(self, origins: np.ndarray, directions: wp.array, solid_angle: wp.array, each: int) -> Hits:
        hit = self.surface.mesh.cast(
            origins, directions.numpy(), per_origin=max(each, 1), device=self.device,
            backend=self._backend(each * len(origins)),
        )  # fmt: skip
        return Hits(
            wp.array(origins, dtype=wp.vec3d, device=self.device), directions, solid_angle,
            wp.array(hit.face, dtype=wp.int32, device=self.device, copy=False),
            wp.array(np.maximum(hit.t, LEAST_M, out=hit.t), dtype=wp.float64, device=self.device, copy=False),
        )  # fmt: skip

    def _backend(self, count: int) -> str:
        """Embree is worth being loaded for a grid of rays, whether it is in use yet or not."""
        usable = not self.device.is_cuda and mesh_rays.open3d_installed()
        return "embree" if usable and count >= mesh_rays.EMBREE_RAYS else "warp"

    def light(self, hits: Hits, source: np.ndarray) -> Illumination:
        """How a transmitter at ``source`` (3,) [m] illuminates what was hit; shadows included."""
        found, point = self.light_through(hits, source)
        strength = found.strength.numpy()
        ray = np.flatnonzero(strength > 0)
        free = self.surface.mesh.visible(
            np.asarray(source, float), point.numpy().take(ray, axis=0), clearance=self.surface.skin_m, device=self.device,
            backend=self._backend(len(ray)),
        )  # fmt: skip
        strength[ray[~free]] = 0.0
        found.strength.assign(strength)
        return found

    def light_through(
        self, hits: Hits, sources: np.ndarray, ray: np.ndarray | None = None
    ) -> tuple[Illumination, wp.array]:
        """How transmitters at ``sources`` (3,) or (K, 3) [m] would illuminate what rays of index ``ray`` (K,), by default
        all, hit if nothing threw a shadow; and where those hit [m], known where there is light."""
        count = len(hits.face) if ray is None else len(ray)
        found = Illumination(*(wp.zeros(count, dtype=wp.float32, device=self.device) for _ in range(5)))
        point = wp.empty(count, dtype=wp.vec3d, device=self.device)
        inputs = [
            self.surface.on_device(self.device), wp.array([] if ray is None else ray, dtype=wp.int32, device=self.device),
            wp.array(np.reshape(sources, (-1, 3)), dtype=wp.vec3d, device=self.device), *hits.inputs,
            hits.solid_angle, float(self.half_width), NEAREST_M, self.loss_per_m, *found.inputs, point,
        ]  # fmt: skip
        _device.launch(bounce.light_surface, count, inputs, device=self.device)
        return found, point
