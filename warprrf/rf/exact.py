"""Spectra of a scene with known materials, by the tracer of radio fields: a truth to compare with, without noise up to single
scatterings.

Line of sight and mirrors come from the image method (:mod:`warprrf.rf.paths.trace`). Scattering is evaluated along 64
directions per pixel, each with one receiver ray and one shadow ray on the mesh, without sampling noise: path gain
(lambda / 4 pi)^2 S^2 |Gamma|^2 f_s cos(theta_i) / (cos(theta_s) d1^2) times its share of the pixel's solid angle, with
|Gamma|^2 the mean over transmit polarisations. All paths are spread by one receiver beam. Absorption by the air, where asked
for, is that of each path's own length.

All rays are turned at mirrors; fewer are connected to images of the transmitter, and scattered on, one direction a ray, drawn by
the cosine from a stated seed: unbiased, with sampling noise. Slabs are passed straight on, on the way to a surface that scatters
and behind it.

Materials with ``reciprocal`` scatter alike both ways (:mod:`warprrf.rf.em.fresnel`), with |Gamma|^2 the mean of both angles.

The directions form a rank-1 lattice of equal solid angles, shifted from row to row and column to column: a regular grid
errs 3 to 5 times more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_count, check_seed
from warprrf.device import DeviceLike, resolve
from warprrf.geometry.mesh import ENDPOINT_CLEARANCE
from warprrf.kernels.radio.records import MIRROR, SCATTER
from warprrf.rf.channel.path_arrays import length_along, points_along
from warprrf.rf.em.absorption import Gas, air_of
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.mirror_paths import described
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.paths.trace import MirrorTracer
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import Received
from warprrf.rf.spectra.spectrum import (
    BEAM_SIGMA_RAD,
    angles_from_directions,
    beam_sums,
    check_shape,
    spread_paths,
    sub_pixel_directions,
)
from warprrf.rf.tracing.model import SETS, Effects
from warprrf.rf.tracing.rays import Hits, RayGrid, by_cosine
from warprrf.rf.tracing.records import Interactions, Records, SlabMaterials
from warprrf.rf.tracing.surface import Surface
from warprrf.rf.tracing.tracer import Rays, Tracer
from warprrf.rows import Rows

SUB_PIXELS = 8
"""Default square root of the directions per pixel.

Error of the total diffuse power at 60 x 120 over 17 places in a furnished room, rms (largest): 4: 0.3 % (0.8 %),
8: 0.05 % (0.13 %), 16: 0.02 % (0.04 %).
"""
SINGLE = replace(SETS["single"], residual=False)
"""Line of sight, one mirror, scattering once: what has no noise."""
REVISION = 10
"""Raised whenever the engine's numbers change: finished receivers of another revision are not used."""


@dataclass(frozen=True)
class DiffusePaths(Rows):
    """Paths of one receiver that scatter, in rows.

    Attributes:
        direction: Direction of arrival, shape ``(L, 3)``.
        power: Path gain [linear], shape ``(L,)``.
        length_m: Whole length [m], shape ``(L,)``.
        departure: Where they left the transmitter towards, not of unit length, shape ``(L, 3)``.
        beams: What :func:`beam_sums` gives for each direction, shape ``(L, 2)``.
        sequence: ``"S"`` scattered, ``"M"`` mirrored, ``"T"`` through slabs, from the transmitter on.
    """

    direction: np.ndarray
    power: np.ndarray
    length_m: np.ndarray
    departure: np.ndarray
    beams: np.ndarray
    sequence: str


@dataclass(frozen=True)
class _Bundle:
    """Rays that went ``length_m`` (N,) from the receiver to where they start, along the directions ``ray`` (N,) of its
    grid, over ``sequence``; solid angles of ``hits`` hold what they lost on the way. Each stands for ``times`` rays of the grid."""

    hits: Hits
    ray: np.ndarray
    length_m: np.ndarray
    sequence: str
    times: int = 1

    @property
    def reach_m(self) -> np.ndarray:
        """Length from the receiver to what they hit [m], shape ``(N,)``."""
        return self.length_m + self.hits.range_m

    @property
    def seen(self) -> Rays:
        return Rays(self.hits, np.arange(len(self.ray)))


class ExactEngine:
    """Propagation from one transmitter in a scene.

    Args:
        effects: What is modelled; by default :data:`SINGLE`.
        sub_pixels: Square root of the number of directions per pixel.
        seed: Of the directions in which light is scattered on.
        gas: Absorption of the air: see :meth:`Paths.with_gas`.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        transmitter: ArrayLike,
        frequency_hz: float,
        shape: tuple[int, int],
        beam_sigma_rad: float = BEAM_SIGMA_RAD,
        effects: Effects = SINGLE,
        sub_pixels: int = SUB_PIXELS,
        seed: int = 0,
        gas: Gas = False,
        device: DeviceLike = None,
    ) -> None:
        check_count("sub_pixels", sub_pixels)
        self.shape, self.beam_sigma_rad = check_shape(shape), beam_sigma_rad
        self.effects, self.seed, self.air = effects, check_seed(seed), air_of(gas)
        self.mirrors = MirrorTracer(
            scene, transmitter=transmitter, frequency_hz=frequency_hz, transmissions=effects.transmissions,
            diffractions=effects.diffractions, device=device,
        )  # fmt: skip
        table = self.mirrors.table
        if table is None:
            raise TypeError(
                "scene: got a bare Mesh, expected a Scene with materials, because scattering needs them"
            )
        self.device = resolve(device)
        # Of faces at one place rays may meet any: each is of the first one's material.
        material = np.asarray(scene.face_material, dtype=np.int32)[self.mirrors.patches.first]
        self.surface = Surface.of_materials(self.mirrors.patches, material, [m.name for m in scene.materials])
        self.materials = SlabMaterials(
            table, self.mirrors.wavelength_m, np.arange(len(table.scattering)), device
        )
        loss = 0.0 if self.air is None else self.air.loss_per_m(self.mirrors.frequency_hz)

        grid = RayGrid(
            self.surface, self.shape, sub_pixels, loss_per_m=loss, nearest_m=0.0, dtype=np.float64, device=device,
        )  # fmt: skip
        source, frequency = self.mirrors.transmitter, self.mirrors.frequency_hz
        self._tracer = Tracer(self.surface, source, frequency, grid, walls=self.mirrors.walls)

    def diffuse(self, receiver: np.ndarray) -> DiffusePaths:
        """Paths of one receiver (3,) that scatter, one sequence after another."""
        empty = np.zeros((0, 3))
        none = DiffusePaths(empty, empty[:, 0], empty[:, 0], empty, empty[:, :2], "")
        every = list(self.sequences(receiver))
        names = ", ".join(paths.sequence for paths in every)
        return replace(DiffusePaths.joined([none, *every]), sequence=names)

    def sequences(self, receiver: np.ndarray) -> Iterator[DiffusePaths]:
        """Paths of one receiver (3,) that scatter, by sequence."""
        e = self.effects
        if not e.scatterings:
            return
        hits = self._tracer.grid.hit(receiver)
        first = _Bundle(hits, np.arange(len(hits.face)), np.zeros(len(hits.face)), "")
        waiting = [first]
        while waiting:
            rays = waiting.pop()
            met = list(self._and_behind(rays))
            for own in met:
                yield from self._lit(own)
                if e.mirror_scatter:
                    yield from self._lit_by_mirrors(own)
            depth = rays.sequence.count("S") + 1
            for own in reversed(met if rays is first else [rays]):
                if rays is first and e.scatter_mirror:
                    waiting.append(self._on(own, self._tracer.reflected(own.seen), own.reach_m, "M"))
                if depth < e.scatterings:
                    waiting.append(self._scattered_on(own, depth))

    def receive(self, receiver: ArrayLike) -> Received:
        """The spectrum of one receiver (3,)."""
        point = check_array("receiver", receiver, (3,))
        specular = together(self.mirrors.trace(point, self.effects.mirrors).with_gas(self.air))
        specular = specular.select(np.flatnonzero((specular.kind != "los") | self.effects.line_of_sight))
        scattered, beam = self.diffuse(point), (self.shape, self.beam_sigma_rad)
        sharp = beam_sums(specular.arrival, *beam, device=self.device)
        spread = spread_paths(
            np.concatenate([specular.arrival, scattered.direction]), np.concatenate([specular.power, scattered.power]), *beam,
            beams=np.concatenate([sharp, scattered.beams]), device=self.device,
        )  # fmt: skip
        departure = np.column_stack([specular.theta_t, specular.phi_t])
        aod = np.column_stack(angles_from_directions(scattered.departure))
        return Received(
            path_gain=spread.path_gain,
            delay_s=spread.of_strongest(np.concatenate([specular.tau, scattered.length_m / SPEED_OF_LIGHT])),
            aod=spread.of_strongest(np.concatenate([departure, aod])),
            line_of_sight=bool((specular.kind == "los").any()),
        )

    def _and_behind(self, rays: _Bundle) -> Iterator[_Bundle]:
        """``rays``, and what those of them that pass slabs meet behind."""
        yield rays
        if self.mirrors.walls is None or not self.effects.scatter_mirror:
            return
        behind = self._tracer.behind(rays.seen, self.effects.transmissions)
        if len(behind.ray):
            yield self._on(rays, behind, rays.length_m, "T")

    def _lit(self, rays: _Bundle) -> Iterator[DiffusePaths]:
        """What the transmitter lights where rays hit, and what it lights through slabs."""
        tracer = self._tracer
        for name, records in tracer.lit_straight(rays.seen, self.effects.transmissions).items():
            out = rays.hits.points(records.ray) - tracer.transmitter
            yield self._paths(rays, records, np.linalg.norm(out, axis=1), out, name)

    def _lit_by_mirrors(self, rays: _Bundle) -> Iterator[DiffusePaths]:
        """What images of the transmitter light where some of the rays hit, and what they light through slabs."""
        tracer, patches = self._tracer, self.mirrors.patches
        most = 4 if rays.sequence else 16  # each is a search: fewer after they hit first
        ray, every = self._some(rays, most)
        point, _, normal = self._met(rays, ray)
        ways = self.mirrors.images.candidates(point, 1)
        own = ((ways.point[:, 0] - point[ways.row]) * normal[ways.row]).sum(axis=1) > 0
        own &= patches.contains(ways.patch[:, 0], ways.point[:, 0])
        ways = ways.take(own)
        lit, walls = {"MS": ways.take(ways.unobstructed(tracer.grid.device))}, self.mirrors.walls
        if walls is not None:
            lit["MTS"] = ways.through(walls)[1]
        for name, ways in lit.items():
            mirrors = described(ways, 1, walls)
            before, patch = tracer.specular(mirrors), ways.patch[:, 0]
            k, records = tracer.lit_by_images(rays.seen, ray[ways.row], patch, before, every)
            out = mirrors.point[k, 0] - tracer.transmitter
            yield self._paths(rays, records, mirrors.length_m[k], out, name)

    def _paths(
        self, rays: _Bundle, records: Records, legs: np.ndarray, departure: np.ndarray, name: str
    ) -> DiffusePaths:
        """Paths over where rays hit, ``legs`` (N,) from the transmitter; ``records`` name rows of ``rays``."""
        grid = self._tracer.grid
        row, ray = records.ray, rays.ray[records.ray]
        length = rays.reach_m[row] + legs
        beams = _lattice_beams(grid.sub_pixels, self.shape, self.beam_sigma_rad, str(self.device))[ray]
        power, direction = records.powers(self.materials), grid.directions[ray]
        return DiffusePaths(direction, power, length, departure, beams, name + rays.sequence)

    def _scattered_on(self, rays: _Bundle, depth: int) -> _Bundle:
        """Some of the rays scattered where they hit, one direction each, drawn by the cosine."""
        most = 9  # of a pixel
        ray, every = self._some(rays, most)
        point, direction, normal = self._met(rays, ray)
        u, v = np.random.default_rng([self.seed, depth, len(rays.sequence)]).random((2, len(ray)))
        onward, up = by_cosine(normal, u, v), np.sqrt(1.0 - u)
        cos_out = np.clip(-(direction * normal).sum(axis=1), 0.0, 1.0)
        cos_mirror = np.clip(2.0 * up * cos_out + (onward * direction).sum(axis=1), -1.0, 1.0)
        angle = np.column_stack([up, cos_out, cos_mirror])[:, None]
        surface = Interactions.of_kind(self.surface.group[rays.hits.face[ray], None], angle, SCATTER)
        grid = self._tracer.grid
        weight = every * np.pi * (rays.hits.rays(ray)[2] * grid.transmittance(rays.hits.range_m[ray]))
        hits = grid.hit_along(point + ENDPOINT_CLEARANCE * normal, onward, weight)
        found = self._on(rays, Rays(hits, ray, surface), rays.reach_m, "S")
        return replace(found, times=every * rays.times)

    def _on(self, rays: _Bundle, onward: Rays, length_m: np.ndarray, name: str) -> _Bundle:
        """Rays that go on, ``length_m`` (N,) from the receiver, with what interactions leave of their solid angles."""
        hits, met, own = onward.hits, onward.after, rays.ray[onward.ray]
        if met is not None:
            width, power = self._tracer.grid.half_width, hits.solid_angle
            records = Records(met.index, met.angle, met.kind, power, own, half_width=width)
            hits = replace(hits, solid_angle=records.powers(self.materials))
        return _Bundle(hits, own, length_m[onward.ray], name + rays.sequence, rays.times)

    def _some(self, rays: _Bundle, most: int) -> tuple[np.ndarray, int]:
        """Of the rays those that hit something, at most so many of a pixel (of more than by default, more): a lattice again. How
        many each of them stands for."""
        per_pixel = self._tracer.grid.per_pixel
        count, most = per_pixel // rays.times, most * max(per_pixel // SUB_PIXELS**2, 1)
        every = next(n for n in range(1, count + 1) if count % n == 0 and count // n <= most)
        place = rays.ray % per_pixel // rays.times
        return np.flatnonzero((rays.hits.face >= 0) & (place % every == every // 2)), every

    def _met(self, rays: _Bundle, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the rows ``ray`` hit, their directions, and normals of what they meet, on the side that they meet, (N, 3) each."""
        direction = rays.hits.rays(ray)[1]
        normal = self.surface.mesh.face_normals[rays.hits.face[ray]]
        away = (normal * direction).sum(axis=1, keepdims=True) > 0
        return rays.hits.points(ray), direction, np.where(away, -normal, normal)


def together(paths: Paths) -> Paths:
    """Paths of one receiver of which those over an edge that are hardly longer than the straight path, or than one mirror's, are
    added to it, through slabs or not, field by field: near a shadow's boundary the two are one wave. What is longer adds in
    power."""
    tx, rx = paths.transmitter, paths.receiver
    if paths.jones is None or paths.frequency_hz is None or tx is None or rx is None:
        return paths
    if not (paths.kind == "edge").any():
        return paths
    jones, gain, kept = paths.jones.copy(), paths.gain.copy(), np.full(len(paths.gain), True)
    mirrors = (paths.interactions == MIRROR).sum(axis=1)
    # In space: at the boundary fields are continuous however late a slab makes one of them.
    length_m = length_along(points_along(tx, paths.vertices, rx))
    quadrature = 1.125  # wavelengths of detour at which the two are, so that nothing jumps
    for k in np.flatnonzero(paths.kind == "edge"):
        near = (paths.kind != "edge") & (mirrors == mirrors[k])
        near &= np.abs(length_m - length_m[k]) < quadrature * SPEED_OF_LIGHT / paths.frequency_hz
        if near.any():
            parent = np.flatnonzero(near)[np.argmax(paths.arrival[near] @ paths.arrival[k])]
            jones[parent] += paths.jones[k]
            kept[k] = False
    size = np.sqrt(0.5 * (np.abs(jones) ** 2).sum(axis=(1, 2)))
    gain = np.where(kept, size * np.exp(1j * np.angle(gain)), gain)
    return replace(paths, jones=jones, gain=gain).select(np.flatnonzero(kept))


@lru_cache(maxsize=2)
def _lattice_beams(sub_pixels: int, shape: tuple[int, int], sigma: float, device: str) -> np.ndarray:
    return beam_sums(sub_pixel_directions(shape, sub_pixels)[0], shape, sigma, device=device)
