"""Spectra of a single bounce without sampling noise: line of sight, mirror reflections and diffuse scattering.

Line of sight and mirrors come from the image method (:mod:`warprrf.rf.paths.trace`). Diffuse scattering is evaluated along 64
directions per pixel, each with one receiver ray and one shadow ray on the mesh, as a path of its own: path gain
(lambda / 4 pi)^2 S^2 |Gamma|^2 f_s cos(theta_i) / (cos(theta_s) d1^2) times its share of the pixel's solid angle, with
|Gamma|^2 the mean over transmit polarisations. All paths are spread by one receiver beam. Absorption by the air, where asked
for, is that of each path's own length.

Diffuse power changes, by some decibels a path, when transmitter and receiver change places: lobes are normalised by the
direction of incidence (Degli-Esposti et al. 2007). Materials with ``reciprocal`` scatter alike both ways, with |Gamma|^2 the
mean of both angles.

The directions form a rank-1 lattice of equal solid angles, shifted from row to row and column to column: a regular grid
would meet upright edges in whole columns, and errs 3 to 5 times more.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf import device as _device
from warprrf.checks import check_array
from warprrf.device import DeviceLike
from warprrf.geometry.mesh import ENDPOINT_CLEARANCE
from warprrf.kernels.radio import scatter
from warprrf.rf.em.absorption import Gas, air_of
from warprrf.rf.em.fresnel import SurfaceTable, reciprocal_factor
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import MirrorTracer
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.spectrum import (
    BEAM_SIGMA_RAD,
    SpreadPaths,
    angles_from_directions,
    beam_sums,
    check_shape,
    spread_paths,
    sub_pixel_directions,
)

SUB_PIXELS = 8
"""Default square root of the directions per pixel.

Error of the total diffuse power at 60 x 120 over 17 places in a furnished room, rms (largest): 4: 0.3 % (0.8 %),
8: 0.05 % (0.13 %), 16: 0.02 % (0.04 %). Coarse grids have fewer directions: at
18 x 36, out of sight in the lobby, one of them or none meets a desk top seen at one degree, and the total moves by up to
0.07 dB when the room is turned; 16: 0.04 dB, 32: 0.01 dB, 64: 0.002 dB.
"""
FACTORS = 1025
"""Entries of a reciprocal lobe's factor over the cosine: interpolation errs by 1e-5 at most up to an exponent of 100."""
REVISION = 4
"""Raised whenever the engine's numbers change: finished receivers of another revision are not used."""


@dataclass(frozen=True)
class ReceivedPaths:
    """What one receiver gets, as pixels.

    Attributes:
        path_gain: Path gain per pixel [linear], shape ``(H, W)``, float64.
        delay_s: Delay of the pixel's strongest path [s], shape ``(H, W)``; NaN where empty.
        aod: Its zenith and azimuth of departure [rad], shape ``(H, W, 2)``; NaN where empty.
        line_of_sight: Whether the transmitter is seen.
    """

    path_gain: np.ndarray
    delay_s: np.ndarray
    aod: np.ndarray
    line_of_sight: bool


@dataclass(frozen=True)
class DiffusePaths:
    """Diffuse paths of one receiver, one per direction that meets an illuminated surface.

    Attributes:
        direction: Direction of arrival, shape ``(L, 3)``.
        power: Path gain [linear], shape ``(L,)``.
        range_m: Distance to the scattering point [m], shape ``(L,)``.
        index: Which of the engine's directions, shape ``(L,)``.
    """

    direction: np.ndarray
    power: np.ndarray
    range_m: np.ndarray
    index: np.ndarray


class ExactEngine:
    """Deterministic single-bounce propagation from one transmitter.

    Args:
        scene: Scene with ``mesh``, ``face_material`` and ``materials``.
        transmitter: Position [m], shape ``(3,)``.
        frequency_hz: Carrier frequency [Hz].
        shape: Rows and columns of the spectrum.
        beam_sigma_rad: Receiver beam width [rad].
        sub_pixels: Square root of the number of directions per pixel.
        gas: Absorption of the air: see :meth:`Paths.with_gas`.
        device: Where rays are cast and beams spread.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        transmitter: ArrayLike,
        frequency_hz: float,
        shape: tuple[int, int],
        beam_sigma_rad: float = BEAM_SIGMA_RAD,
        sub_pixels: int = SUB_PIXELS,
        gas: Gas = False,
        device: DeviceLike = None,
    ) -> None:
        if sub_pixels < 1:
            raise ValueError(f"sub_pixels: got {sub_pixels!r}, expected at least 1")
        self.shape = check_shape(shape)
        self.beam_sigma_rad = beam_sigma_rad
        self.sub_pixels = sub_pixels
        self.air = air_of(gas)
        self.tracer = MirrorTracer(scene, transmitter=transmitter, frequency_hz=frequency_hz, device=device)
        if self.tracer.table is None:
            raise TypeError(
                "scene: got a bare Mesh, expected a Scene with materials, because scattering needs them"
            )
        self.device = _device.resolve(device)
        # Of faces at one place rays may meet any: each is of the first one's material.
        material = np.asarray(scene.face_material, dtype=np.int32)[self.tracer.patches.first]
        self._surface = self._upload(self.tracer.table, material)

    def _upload(self, table: SurfaceTable, face_material: np.ndarray) -> list[Any]:
        where, mesh = self.device, self.tracer.mesh
        materials = scatter.Materials()
        eta = np.column_stack([table.permittivity.real, table.permittivity.imag])
        materials.permittivity = wp.array(eta, dtype=wp.vec2d, device=where)
        materials.thickness = wp.array(table.thickness_m, dtype=wp.float64, device=where)
        materials.scattering = wp.array(table.scattering, dtype=wp.float64, device=where)
        materials.alpha_r = wp.array(table.alpha_r, dtype=wp.int32, device=where)
        materials.reciprocal = wp.array(table.reciprocal, dtype=wp.int32, device=where)
        cosine, factor = np.linspace(0.0, 1.0, FACTORS), np.zeros((len(table.alpha_r), FACTORS))
        for k in np.flatnonzero(table.reciprocal):
            factor[k] = reciprocal_factor(table.alpha_r[k], cosine)
        materials.factor = wp.array(factor, dtype=wp.float64, device=where)
        return [
            wp.array(mesh.triangles[:, 0], dtype=wp.vec3d, device=where),
            wp.array(mesh.face_normals, dtype=wp.vec3d, device=where),
            wp.array(face_material, dtype=wp.int32, device=where),
            materials,
        ]

    def diffuse(self, receiver: np.ndarray) -> DiffusePaths:
        """Diffuse paths of one receiver (3,), one per direction that meets an illuminated surface."""
        grid = _sub_pixel_grid(self.shape, self.sub_pixels, str(self.device))
        mesh, count = self.tracer.mesh, len(grid.solid_angles)
        radiance = wp.zeros(count, dtype=wp.float64, device=self.device)
        range_m = wp.zeros(count, dtype=wp.float64, device=self.device)
        inputs = [
            mesh.on_device(self.device).id,
            wp.vec3d(*mesh.center),
            *self._surface,
            wp.vec3d(*self.tracer.transmitter),
            wp.vec3d(*receiver),
            wp.float64(self.tracer.wavelength_m),
            # The lattice has as many levels in a pixel as directions.
            wp.float64(0.5 * np.pi / (self.shape[0] * self.sub_pixels**2)),
            wp.float64(ENDPOINT_CLEARANCE),
            4 if mesh.is_closed else 0,
            grid.on_device,
            radiance,
            range_m,
        ]
        _device.launch(scatter.scatter_to_receiver, count, inputs, device=self.device)
        power = radiance.numpy() * grid.solid_angles
        positive = np.flatnonzero(power > 0)
        direction, power, reach = grid.directions[positive], power[positive], range_m.numpy()[positive]
        if self.air is not None:
            way = receiver + reach[:, None] * direction - self.tracer.transmitter
            power = power * self.air.transmittance(
                self.tracer.frequency_hz, np.linalg.norm(way, axis=1) + reach
            )
        return DiffusePaths(direction, power, reach, positive)

    def spread(self, specular: Paths, scattered: DiffusePaths) -> SpreadPaths:
        """Paths of both kinds on the grid, the specular ones counted first."""
        beam = self.shape, self.beam_sigma_rad
        # Every receiver has the same lattice of directions, whose beams are summed once.
        lattice = _lattice_beams(self.sub_pixels, *beam, str(self.device))[scattered.index]
        return spread_paths(
            np.concatenate([specular.arrival, scattered.direction]),
            np.concatenate([specular.power, scattered.power]),
            *beam,
            beams=np.concatenate([beam_sums(specular.arrival, *beam, device=self.device), lattice]),
            device=self.device,
        )

    def receive(self, receiver: ArrayLike) -> ReceivedPaths:
        """The spectrum of one receiver (3,)."""
        point = check_array("receiver", receiver, (3,))
        specular = self.tracer.trace(point, 1).with_gas(self.air)
        scattered = self.diffuse(point)
        spread = self.spread(specular, scattered)
        leg = point + scattered.range_m[:, None] * scattered.direction - self.tracer.transmitter
        tau = (np.linalg.norm(leg, axis=1) + scattered.range_m) / SPEED_OF_LIGHT
        aod = np.column_stack(angles_from_directions(leg))
        departure = np.column_stack([specular.theta_t, specular.phi_t])
        return ReceivedPaths(
            path_gain=spread.path_gain,
            delay_s=spread.of_strongest(np.concatenate([specular.tau, tau])),
            aod=spread.of_strongest(np.concatenate([departure, aod])),
            line_of_sight=bool((specular.kind == "los").any()),
        )


@dataclass(frozen=True)
class _SubPixels:
    directions: np.ndarray
    solid_angles: np.ndarray
    on_device: wp.array


@lru_cache(maxsize=4)
def _sub_pixel_grid(shape: tuple[int, int], sub_pixels: int, device: str) -> _SubPixels:
    directions, solid_angles = sub_pixel_directions(shape, sub_pixels)
    return _SubPixels(directions, solid_angles, wp.array(directions, dtype=wp.vec3d, device=device))


@lru_cache(maxsize=1)
def _lattice_beams(sub_pixels: int, shape: tuple[int, int], sigma: float, device: str) -> np.ndarray:
    return beam_sums(_sub_pixel_grid(shape, sub_pixels, device).directions, shape, sigma, device=device)
