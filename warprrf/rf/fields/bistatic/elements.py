"""How surfaces illuminate each other: what rays from every surface element hit, and how a transmitter lights that.

Elements are half a metre wide, and light that comes to one over others is taken for even over it.
"""

from __future__ import annotations

import numpy as np

from warprrf.geometry.mesh import vectors_across
from warprrf.rf.fields.bistatic.rays import RayGrid
from warprrf.rf.fields.bistatic.surface import Surface

RAYS = 128  # from each element, over its hemisphere
LIFT_M = 0.02


class ElementLinks:
    """Geometry between the elements of a surface under one transmitter.

    Args:
        grid: casts the rays.
        transmitter: position (3,) [m].

    Attributes:
        hits: what 128 rays from each element hit, density proportional to the cosine.
        light: how the transmitter illuminates that.
        element: element that each ray hits, shape ``(E, 128)``; 0 where it hits nothing.
        air: share of power that the air between lets through, shape ``(E, 128)``; 0 where a ray hits nothing.
    """

    def __init__(self, grid: RayGrid, transmitter: np.ndarray) -> None:
        surface = grid.surface
        point, normal = _sample_points(surface)
        directions = _hemispheres(normal)
        self.hits = grid.hit_along(point, directions, np.ones(len(directions)))
        self.light = grid.light(self.hits, transmitter)
        face = self.hits.face.numpy()
        hit = face >= 0
        self.element = np.where(hit, surface.element[np.maximum(face, 0)], 0).reshape(-1, RAYS)
        air = np.where(hit, grid.transmittance(np.where(hit, self.hits.range_m.numpy(), 0.0)), 0.0)
        self.air = air.reshape(-1, RAYS)


def _sample_points(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """A place on each element, just off the surface, and its normal: the centre of the face nearest to its middle."""
    centre = surface.mesh.triangles.mean(axis=1)
    gap = np.linalg.norm(centre - surface.element_centre[surface.element], axis=1)
    order = np.lexsort((gap, surface.element))
    first = order[np.searchsorted(surface.element[order], np.arange(len(surface.element_area)))]
    normal = surface.front_normal[first]
    return centre[first] + LIFT_M * normal, normal


def _hemispheres(normal: np.ndarray) -> np.ndarray:
    """``RAYS`` directions for each normal, density proportional to the cosine, shape ``(E * RAYS, 3)``."""
    rng = np.random.default_rng(0)
    count = len(normal)
    k = np.arange(RAYS)
    u = np.mod(k * 0.7548776662466927 + rng.random((count, 1)), 1.0)  # R2 sequence (Roberts 2018), shifted
    v = np.mod(k * 0.5698402909980532 + rng.random((count, 1)), 1.0)
    radius, turn = np.sqrt(u), 2.0 * np.pi * v
    a, b = vectors_across(normal)
    x, y, z = radius * np.cos(turn), radius * np.sin(turn), np.sqrt(np.maximum(1.0 - u, 0.0))
    d = x[..., None] * a[:, None] + y[..., None] * b[:, None] + z[..., None] * normal[:, None]
    return d.reshape(-1, 3)
