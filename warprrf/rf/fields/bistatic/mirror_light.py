"""Surfaces illuminated by mirrors: which faces a mirror throws light on, and what a receiver sees of it.

The image of the transmitter in a patch is a source that shines through the patch as through a window, so what a ray
meets scatters its light with the same lobes as direct light. Which images light which faces is found once for a
transmitter, at the middles of the faces (0.6 m wide at most), and holds for every ray that meets them: tracing each
ray's own shadow costs three times as much and leaves the lobby's error the same to 0.02 dB.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warprrf.rf.fields.bistatic.materials import Parameters, mirror_share
from warprrf.rf.fields.bistatic.rays import NEAREST_M, Hits, Illumination, RayGrid
from warprrf.rf.paths.images import MirrorImages
from warprrf.rf.paths.mirror_paths import ZoneRays

MIRROR_SLACK_M = 0.1
"""How far beside its faces a patch may still mirror [m]: outlines of a reconstructed mesh are torn."""


@dataclass(frozen=True)
class MirrorIllumination:
    """Light that mirrors throw on what rays hit, one row for each pair of a ray and an image that illuminates its hit.

    Attributes:
        ray: of the view's grid, shape ``(L,)``.
        patch: the mirror, shape ``(L,)``.
        cosine: of incidence on the mirror, shape ``(L,)``.
        face: what the ray hits, on the device.
        light: how the image illuminates that.
    """

    ray: np.ndarray
    patch: np.ndarray
    cosine: np.ndarray
    face: wp.array
    light: Illumination


class MirrorLight:
    """What one transmitter sends to a surface by way of one mirror; geometry is traced once.

    Args:
        grid: casts the rays.
        transmitter: position (3,) [m].
    """

    def __init__(self, grid: RayGrid, transmitter: np.ndarray) -> None:
        self.surface = s = grid.surface
        self._image = s.images(transmitter)[0]
        centre = s.mesh.triangles.mean(axis=1)
        images = MirrorImages(s.patches, transmitter, slack_m=MIRROR_SLACK_M, device=grid.device)
        face, patch, point = images.candidates(centre, 1)
        # Light must come from in front of the face, of either side if it has two, and not from its own patch.
        normal = s.front_normal[face]
        side = ((point[:, 0] - centre[face]) * normal).sum(axis=1)
        normal = np.where(s.two_sided & (side < 0)[:, None], -normal, normal)
        own = np.flatnonzero((s.two_sided | (side > 0)) & (s.patch[face] != patch[:, 0]))
        face, patch, point, normal = face[own], patch[own], point[own], normal[own]
        rays = ZoneRays(s.patches, images.transmitter, 0.0, s.skin_m, grid.device)
        free = rays.reached(centre[face], patch, point, s.skin_m * normal)
        face, patch, normal = face[free], patch[free, 0], normal[free]
        way = self._image[patch] - centre[face]
        length = np.linalg.norm(way, axis=1)
        toward = way / np.maximum(length, 1e-12)[:, None]
        self._face, self._patch, self._side = face, patch, s.side_met(face, -normal)
        self._cosine = np.abs((toward * s.plane_normal[patch]).sum(axis=1))
        cos_in = np.maximum((toward * normal).sum(axis=1), 0.0)
        share = s.mesh.areas[face] / s.element_area[s.element[face]]
        self._irradiance = share * cos_in / np.maximum(length, NEAREST_M) ** 2 * grid.transmittance(length)
        order = np.lexsort((patch, face))
        self._mirror = patch[order]
        self._first = np.searchsorted(face[order], np.arange(len(s.mesh.faces) + 1))

    def irradiance(self, p: Parameters) -> np.ndarray:
        """Mean irradiance of each element's sides, shape ``(S,)``, where the transmitter gives cos(theta_i) / d1^2 [1/m^2]."""
        sides = self.surface.element_sides
        if len(self._face) == 0:
            return np.zeros(sides)
        share = mirror_share(p, self.surface.patch_group[self._patch], self._cosine)
        return np.bincount(self._side, share * self._irradiance, minlength=sides)

    def view(self, grid: RayGrid, hits: Hits) -> MirrorIllumination:
        """Mirrored light that the rays of ``grid`` see at what they hit."""
        # About two rays of a pixel look for mirrored light; the stride takes all of their places in turn.
        every, size = grid.sub_pixels**2 // 2 + 1, len(grid.directions)
        rays = np.add.outer(np.arange(0, len(hits.face), size), np.arange(0, size, every)).ravel()
        face = hits.face.numpy()[rays]
        rays, face = rays[face >= 0], face[face >= 0]
        count = self._first[face + 1] - self._first[face]
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        ray, patch = np.repeat(rays, count), self._mirror[np.repeat(self._first[face], count) + within]
        light, point = grid.light_through(hits, self._image[patch], ray)
        k = np.flatnonzero(light.strength.numpy() > 0)
        ray, patch = ray[k], patch[k]
        way = self._image[patch] - point.numpy()[k]
        cosine = np.abs(np.einsum("ni,ni->n", way, self.surface.plane_normal[patch]))
        lit = [array.numpy()[k] for array in light.inputs]
        lit[0] *= every
        return MirrorIllumination(
            ray, patch, cosine / np.maximum(np.sqrt(np.einsum("ni,ni->n", way, way)), 1e-9),
            wp.array(hits.face.numpy()[ray], dtype=wp.int32, device=grid.device),
            Illumination(*(wp.array(value, dtype=wp.float32, device=grid.device) for value in lit)),
        )  # fmt: skip
