"""How surfaces illuminate each other: what rays from every surface element hit, and how a transmitter lights that.

Elements are half a metre wide in a room, and light that comes to one over others is taken for even over it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warprrf.geometry.mesh import vectors_across
from warprrf.rf.fields.bistatic.rays import Hits, Illumination, RayGrid
from warprrf.rf.fields.bistatic.surface import Surface

RAYS = 128  # from each element, over its hemisphere
LIFT_M = 0.02


@dataclass(frozen=True)
class SideRays:
    """What 128 rays from each of T sides of elements meet, density proportional to the cosine.

    Attributes:
        side: that the rays start from, shape ``(T,)``.
        hits: what they hit.
        light: how the transmitter illuminates that.
        met: side of an element that each meets, shape ``(T, 128)``; 0 where it meets nothing.
        air: share of power that the air between lets through, shape ``(T, 128)``; 0 where a ray meets nothing.
    """

    side: np.ndarray
    hits: Hits
    light: Illumination
    met: np.ndarray
    air: np.ndarray


class ElementLinks:
    """Geometry between the elements of a surface under one transmitter.

    Args:
        grid: casts the rays.
        transmitter: position (3,) [m].

    Attributes:
        rays: those of the first sides, and of second sides that light can reach: solids' inner ones are left dark.
    """

    def __init__(self, grid: RayGrid, transmitter: np.ndarray) -> None:
        surface = grid.surface
        point, normal = _sample_points(surface)
        known = np.arange(len(point))
        if surface.two_sided:
            point, normal = np.tile(point, (2, 1)), np.concatenate([normal, -normal])
            face = grid.hit(transmitter).face.numpy()
            ray = np.flatnonzero(face >= 0)
            known = np.union1d(known, surface.side_met(face[ray], grid.directions[ray]))
        shift = np.random.default_rng(0).random((2, len(surface.element_area)))
        self.rays: list[SideRays] = []
        new = known
        while len(new):
            directions = _hemispheres(normal[new], shift[:, new % shift.shape[1]])
            hits = grid.hit_along(point[new] + LIFT_M * normal[new], directions, np.ones(len(directions)))
            face = hits.face.numpy()
            hit = face >= 0
            met = np.where(hit, surface.side_met(np.maximum(face, 0), directions), 0)
            air = np.where(hit, grid.transmittance(np.where(hit, hits.range_m.numpy(), 0.0)), 0.0)
            light = grid.light(hits, transmitter)
            self.rays.append(SideRays(new, hits, light, met.reshape(-1, RAYS), air.reshape(-1, RAYS)))
            new = np.setdiff1d(met[hit], known)
            known = np.union1d(known, new)


def _sample_points(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """A place on each element, and its first side's normal: the centre of the face nearest to its middle."""
    centre = surface.mesh.triangles.mean(axis=1)
    gap = np.linalg.norm(centre - surface.element_centre[surface.element], axis=1)
    order = np.lexsort((gap, surface.element))
    first = order[np.searchsorted(surface.element[order], np.arange(len(surface.element_area)))]
    return centre[first], surface.side_normal[first]


def _hemispheres(normal: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """``RAYS`` directions for each normal (T, 3), density proportional to the cosine, shape ``(T * RAYS, 3)``."""
    k = np.arange(RAYS)
    u = np.mod(k * 0.7548776662466927 + shift[0, :, None], 1.0)  # R2 sequence (Roberts 2018), shifted
    v = np.mod(k * 0.5698402909980532 + shift[1, :, None], 1.0)
    radius, turn = np.sqrt(u), 2.0 * np.pi * v
    a, b = vectors_across(normal)
    x, y, z = radius * np.cos(turn), radius * np.sin(turn), np.sqrt(np.maximum(1.0 - u, 0.0))
    d = x[..., None] * a[:, None] + y[..., None] * b[:, None] + z[..., None] * normal[:, None]
    return d.reshape(-1, 3)
