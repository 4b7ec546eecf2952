"""What single bounces leave dark: mirror-then-scatter, scatter-then-mirror and further diffuse bounces.

Nothing new is learned: the fitted groups light surface elements by way of mirrors and of each other, elements send that
on evenly (after two bounces little is left of a lobe's shape), and mirrors show the lit scene a second time.
Irradiance is in units in which the transmitter gives cos(theta_i) / d1^2 [1/m^2].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warprrf.rf.em.half_spaces import fresnel_curves
from warprrf.rf.fields.bistatic.bounces import BounceTracer, Met
from warprrf.rf.fields.bistatic.fit import Parameters, scattered_share
from warprrf.rf.fields.bistatic.mirror_light import MirrorLight
from warprrf.rf.fields.bistatic.surface import Surface

RAYS = 128  # from each element, over its hemisphere
LEAST_MIRROR = 1e-4  # reflected share of power below which a patch is no mirror
LIFT_M = 0.02


class ElementLight:
    """What one transmitter sends to the elements of a surface by way of other surfaces; geometry is traced once.

    Args:
        tracer: rays and lobes of the field.
        transmitter: position (3,) [m].
        wavelength_m: wavelength.
        seed: of the rays' directions.
    """

    def __init__(
        self, tracer: BounceTracer, transmitter: np.ndarray, wavelength_m: float, *, seed: int = 0
    ) -> None:
        self.tracer, self.surface, self.wavelength_m = tracer, tracer.surface, wavelength_m
        self.mirrors = MirrorLight(tracer, transmitter)
        point, normal = _sample_points(self.surface)
        directions = _hemispheres(normal, seed)
        self._met = tracer.meet_rays(point, directions, np.ones(len(directions)))
        self._lit = tracer.light(self._met, transmitter)
        face = self._met.face.numpy()
        # Rays that meet nothing see the dark: they point at element 0 with weight 0.
        self._sees = np.where(face >= 0, self.surface.element[np.maximum(face, 0)], 0).reshape(
            len(point), RAYS
        )
        self._meets = (face >= 0).reshape(len(point), RAYS)
        self._between = np.broadcast_to(
            tracer.through_air(self._met.range_m.numpy()), self._meets.size
        ).reshape(self._meets.shape)

    def radiance(self, p: Parameters, *, mirrors: bool, diffuse: int) -> np.ndarray:
        """Radiance that each element sends on under parameters ``p``, shape ``(E,)`` [1/(m^2 sr)].

        Args:
            p: parameters of the groups.
            mirrors: whether light that mirrors throw on surfaces counts as well as the transmitter's own.
            diffuse: scattering at other surfaces before, at most: 1 or 2.
        """
        elements = len(self.surface.element_area)
        power = self.tracer.scatter(self._met, self._lit, p.weight, p.log_excess, self.wavelength_m)
        seen = power.reshape(elements, RAYS) * (4.0 * np.pi / self.wavelength_m) ** 2
        total = np.pi * seen.mean(axis=1)
        share = self.reflectance(p) / np.pi
        if diffuse >= 2:
            before = total + self.mirrors.irradiance(p) if mirrors else total
            sent = share * before
            seen = np.where(self._meets, sent[self._sees] * self._between, 0.0)
            total = total + np.pi * seen.mean(axis=1)
        return share * total

    def reflectance(self, p: Parameters) -> np.ndarray:
        """Share of power that each element scatters under even light (E,)."""
        return scattered_share(p)[self.surface.element_group]


def mirrored_scene(
    tracer: BounceTracer, receivers: np.ndarray, transmitter: np.ndarray, p: Parameters, wavelength_m: float,
    sent: np.ndarray | None,
) -> np.ndarray:  # fmt: skip
    """Path gain per pixel that mirrors show ``receivers`` of the lit scene: first bounces, and ``sent`` radiance of the
    elements (E,) besides. Shape (H, W) for one receiver (3,), (O, H, W) for several (O, 3). ``tracer`` needs few rays a
    pixel."""
    surface = tracer.surface
    places = np.asarray(receivers, float)
    shape = (*places.shape[:-1], *tracer.shape, -1)
    places = places.reshape(-1, 3)
    met = tracer.meet(places)
    face, t = met.face.numpy(), met.range_m.numpy()
    out = np.zeros(len(face))
    known = (face >= 0) & (surface.patch[np.maximum(face, 0)] >= 0)
    group = surface.group[np.maximum(face, 0)]
    normal = surface.plane_normal[np.maximum(surface.patch[np.maximum(face, 0)], 0)]
    d = np.tile(tracer.directions, (len(places), 1))
    cosine = -(d * normal).sum(axis=1)
    share = np.where(
        known & (cosine > 0),
        np.exp(p.log_mirror[group]) * fresnel_curves().value(p.log_excess[group], np.abs(cosine))[0],
        0.0,
    )
    k = np.flatnonzero(share > LEAST_MIRROR)
    if len(k) == 0:
        return out.reshape(shape).sum(axis=-1)
    turned = d[k] + 2.0 * cosine[k, None] * normal[k]
    start = places[k // len(tracer.directions)] + t[k, None] * d[k] + LIFT_M * normal[k]
    solid_angle = tracer.solid_angle[k % len(tracer.directions)]
    again = tracer.meet_rays(start, turned, solid_angle)
    lit = tracer.light(again, transmitter)
    power = tracer.scatter(again, lit, p.weight, p.log_excess, wavelength_m).astype(float)
    if sent is not None:
        second = again.face.numpy()
        radiance = np.where(second >= 0, sent[surface.element[np.maximum(second, 0)]], 0.0)
        far = tracer.through_air(np.where(second >= 0, again.range_m.numpy(), 0.0))
        power += (wavelength_m / (4.0 * np.pi)) ** 2 * solid_angle * radiance * far
    out[k] = share[k] * power * tracer.through_air(t[k])
    return out.reshape(shape).sum(axis=-1)


@dataclass(frozen=True)
class SeenSurface:
    """Faces that a grid's rays meet: of each ray that meets one its pixel, the face, and the solid angle [sr], less
    what the air between absorbs, all shapes ``(K,)``."""

    pixel: np.ndarray
    face: np.ndarray
    solid_angle: np.ndarray

    @classmethod
    def of(cls, tracer: BounceTracer, met: Met) -> SeenSurface:
        """Those of the rays that met ``met``."""
        face = met.face.numpy()
        ray = np.flatnonzero(face >= 0)
        seen = tracer.solid_angle[ray] * tracer.through_air(met.range_m.numpy()[ray])
        return cls(ray // tracer.sub_pixels**2, face[ray], seen)

    def power(self, sent: np.ndarray, wavelength_m: float) -> np.ndarray:
        """Path gain of each (K,) of the radiance that each ray's surface sends on evenly, shape ``(K,)``."""
        return (wavelength_m / (4.0 * np.pi)) ** 2 * self.solid_angle * sent


def _sample_points(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """A place on each element, just off the surface, and its normal: the centre of the face nearest to its middle."""
    centre = surface.mesh.triangles.mean(axis=1)
    gap = np.linalg.norm(centre - surface.element_centre[surface.element], axis=1)
    order = np.lexsort((gap, surface.element))
    first = order[np.searchsorted(surface.element[order], np.arange(len(surface.element_area)))]
    normal = np.where(
        ((surface.normal[first] * surface.mesh.face_normals[first]).sum(axis=1) < 0)[:, None],
        -surface.normal[first],
        surface.normal[first],
    )
    return centre[first] + LIFT_M * normal, normal


def _hemispheres(normal: np.ndarray, seed: int) -> np.ndarray:
    """``RAYS`` directions for each normal, density proportional to the cosine, shape ``(E * RAYS, 3)``."""
    rng = np.random.default_rng(seed)
    count = len(normal)
    k = np.arange(RAYS)
    u = np.mod(k * 0.7548776662466927 + rng.random((count, 1)), 1.0)  # R2 sequence (Roberts 2018), shifted
    v = np.mod(k * 0.5698402909980532 + rng.random((count, 1)), 1.0)
    radius, turn = np.sqrt(u), 2.0 * np.pi * v
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    a = np.cross(normal, least)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normal, a)
    x, y, z = radius * np.cos(turn), radius * np.sin(turn), np.sqrt(np.maximum(1.0 - u, 0.0))
    d = x[..., None] * a[:, None] + y[..., None] * b[:, None] + z[..., None] * normal[:, None]
    return d.reshape(-1, 3)
