"""Gaps in the planes of a mesh closed, each plane by itself, where no photo looks through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.cells import BEHIND_M, in_frame, plane_mesh
from warprrf.geometry.photos.photo_files import spread
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.planes import Plane
from warprrf.geometry.splats.camera import Camera

GAP_M = 2.0  # gaps narrower than this are closed
CELL_M, LEAST_M2 = 0.05, 0.3  # side of a cell, and least area of a plane that is looked at
VIEWS = 40  # photos that are asked what they see through a gap


def without_gaps(patches: PlanarPatches, cameras: Sequence[Camera]) -> PlanarPatches:
    """The mesh of ``patches``, fine as it was fused, with squares in the gaps of its planes: holes, and bays of borders.

    Gaps are those of a morphological closing (Serra, "Image analysis and mathematical morphology", 1982).
    """
    mesh, views = patches.mesh, spread(cameras, VIEWS)
    samples = np.concatenate([mesh.triangles, mesh.triangles.mean(axis=1)[:, None]], axis=1)
    meshes, labels = [mesh], [patches.face_patch]
    for k in np.flatnonzero(patches.area >= LEAST_M2):
        plane = _gaps(patches, int(k), samples[patches.faces(int(k))].reshape(-1, 3))
        cells = plane.cells()
        through = np.zeros(len(cells), dtype=bool)
        for camera in views:
            looked = np.flatnonzero(in_frame(camera, cells)[0] & (plane.distance(camera.position[None]) > 0))
            ahead = cells[looked] - camera.position
            away = np.linalg.norm(ahead, axis=1)
            met = mesh.cast(np.broadcast_to(camera.position, ahead.shape), ahead)
            through[looked] |= met.valid & (np.where(met.valid, met.t, 0.0) > away + BEHIND_M)
        occupied = plane.occupied.copy()
        occupied[occupied] = ~through
        squares = plane_mesh([replace(plane, occupied=occupied)])
        if squares is not None:
            meshes.append(squares)
            labels.append(np.full(len(squares.faces), k, dtype=np.int32))
    first = np.cumsum([0, *(len(part.vertices) for part in meshes)])
    whole = Mesh(
        np.concatenate([part.vertices for part in meshes]),
        np.concatenate([part.faces + start for part, start in zip(meshes, first, strict=False)]),
    )
    return PlanarPatches.from_planes(
        whole, np.concatenate(labels), patches.normal, patches.offset, tolerance_m=patches.tolerance_m
    )


def _gaps(patches: PlanarPatches, k: int, points: np.ndarray) -> Plane:
    """The plane of patch ``k``, on whose faces ``points`` lie, with the cells of its gaps."""
    plane = Plane(patches.normal[k], float(patches.offset[k]), np.zeros(0, dtype=np.int64), cell_m=CELL_M)
    uv = plane.to_plane(points)
    reach = 0.5 * GAP_M / CELL_M
    low = uv.min(axis=0) - 0.5 * GAP_M - CELL_M
    shape = np.ceil((uv.max(axis=0) - low) / CELL_M + reach + 1).astype(int)
    grid = replace(plane, corner=low, occupied=np.zeros(shape, dtype=bool))
    own = grid.count(points) > 0
    grown = ndimage.distance_transform_edt(~own) <= reach
    closed = (ndimage.distance_transform_edt(grown) > reach) & ~own
    return replace(grid, occupied=closed)
