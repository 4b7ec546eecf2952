"""A mesh made whole: its planes divide space into boxes, and each box is free or solid.

Where most of a mesh is planar along three perpendicular directions, its planes cut space into boxes. Lines of sight
prove boxes free, the surfaces they end on prove the boxes behind solid, and for the rest the surface between free and
solid is made as small as it can be, along known planes rather than elsewhere (Chauve, Labatut and Pons, "Robust
piecewise-planar 3D reconstruction and completion from large-scale unstructured point data", 2010; a minimum cut, found
by SciPy). That surface has no holes and lies exactly on the planes. Faces that no plane explains stay as they are. Of a
mesh that is no such place every plane is closed by itself: gaps are those of a morphological closing of its cells
(Serra, "Image analysis and mathematical morphology", 1982), and stay open where a photo looks through. Lengths in
metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from warprrf.geometry.mesh import Mesh, connected_pieces, joined
from warprrf.geometry.photos.gaussians.cells import BEHIND_M, plane_mesh, with_cells
from warprrf.geometry.photos.posed.photo_files import spread
from warprrf.geometry.photos.surface.boxes import (
    FaceLevels,
    closed_sides,
    divide,
    known_levels,
    least_surface,
    seen_share,
    surface_of,
    votes,
)
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.planes import Plane, directions
from warprrf.geometry.splats.camera import Camera

CELL_M, LEAST_M2 = 0.05, 0.3  # side of a cell, and least area of a plane that is looked at
VIEWS = 40  # photos that are asked what they see through a gap


def complete(
    patches: PlanarPatches,
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    *,
    planes: Sequence[Plane] = (),
) -> tuple[PlanarPatches, bool]:
    """The mesh of ``patches`` with holes closed, borders straightened and islands in the air removed.

    Args:
        cameras, depths: what was seen: Euclidean range per pixel [m], 0 where unknown, each ``(height, width)``.
        planes: planes known beforehand; their occupied cells are evidence of their own.

    Returns:
        The mesh with its patches, one for each plane and side; and whether that is all. It is not where most of the mesh
        lies on no planes along three perpendicular directions, or the photos show so little of the place that most would
        be a guess: then gaps of single planes are closed.
    """
    mesh = patches.mesh
    axes = directions(patches.normal, patches.area, float(mesh.areas.sum()))
    if axes is None:
        return _without_gaps(patches, cameras), False
    levels, faces, proven = known_levels(patches, planes, axes)
    grid = divide(mesh, axes, levels)
    free, solid = votes(grid, mesh, faces, proven, cameras, depths)
    filled = least_surface(grid, free, solid, closed_sides(grid, faces))
    if filled.all():
        return _without_gaps(patches, cameras), False
    whole, known = surface_of(grid, filled, patches.tolerance_m)
    # 0.7: of the surface must be seen; else the photos cover too little for the rest to be inferred
    if seen_share(grid, whole, solid) < 0.7:
        return _without_gaps(patches, cameras), False
    return _with_rest(whole, known, patches, faces), True


def _with_rest(
    whole: PlanarPatches, known: np.ndarray, patches: PlanarPatches, faces: FaceLevels
) -> PlanarPatches:
    """The completed surface with round or oblique pieces of the old mesh in place of the steps made for them."""
    new, old = whole.mesh, patches.mesh
    centres = old.triangles.mean(axis=1)
    rest = faces.axis < 0
    keep_m = 0.12  # pieces of the old mesh this far from every known plane are kept,
    if known.any():
        rest[rest] = Mesh(new.vertices, new.faces[known]).distance(centres[rest]) > keep_m
    piece = connected_pieces(old, np.where(rest, 0, -1))
    keep_m2 = 0.3  # if they are this large
    rest &= np.bincount(piece, weights=old.areas * rest)[piece] >= keep_m2
    if not rest.any():
        return whole
    stays, steps = known.copy(), new.triangles[~known].mean(axis=1)
    stays[~known] = Mesh(old.vertices, old.faces[rest]).distance(steps) > keep_m
    own = patches.face_patch[rest]
    return PlanarPatches.from_planes(
        joined([(new.vertices, new.faces[stays]), (old.vertices, old.faces[rest])]),
        np.concatenate([whole.face_patch[stays], np.where(own >= 0, own + len(whole), -1)]),
        np.concatenate([whole.normal, patches.normal]),
        np.concatenate([whole.offset, patches.offset]),
        tolerance_m=patches.tolerance_m,
    )


def _without_gaps(patches: PlanarPatches, cameras: Sequence[Camera]) -> PlanarPatches:
    """The mesh of ``patches``, fine as it was fused, with squares in the gaps of its planes: holes, and bays of borders."""
    mesh, views = patches.mesh, spread(cameras, VIEWS)
    samples = np.concatenate([mesh.triangles, mesh.triangles.mean(axis=1)[:, None]], axis=1)
    meshes, labels = [mesh], [patches.face_patch]
    for k in np.flatnonzero(patches.area >= LEAST_M2):
        plane = _gaps(patches, int(k), samples[patches.faces(int(k))].reshape(-1, 3))
        cells = plane.cells()
        through = np.zeros(len(cells), dtype=bool)
        for camera in views:
            looked = np.flatnonzero(camera.in_frame(cells)[0] & (plane.distance(camera.position[None]) > 0))
            ahead = cells[looked] - camera.position
            away = np.linalg.norm(ahead, axis=1)
            met = mesh.cast(camera.position, ahead)
            through[looked] |= met.valid & (met.t > away + BEHIND_M)
        squares = plane_mesh([with_cells(plane, ~through)])
        if squares is not None:
            meshes.append(squares)
            labels.append(np.full(len(squares.faces), k, dtype=np.int32))
    whole, label = joined([(part.vertices, part.faces) for part in meshes]), np.concatenate(labels)
    planes = patches.normal, patches.offset
    return PlanarPatches.from_planes(whole, label, *planes, tolerance_m=patches.tolerance_m)


def _gaps(patches: PlanarPatches, k: int, points: np.ndarray) -> Plane:
    """The plane of patch ``k``, on whose faces ``points`` lie, with the cells of its gaps."""
    plane = Plane(patches.normal[k], float(patches.offset[k]), cell_m=CELL_M)
    uv = plane.to_plane(points)
    gap_m = 2.0  # gaps narrower than this are closed
    grid = plane.spanning(uv.min(axis=0) - 0.5 * gap_m - CELL_M, uv.max(axis=0) + 0.5 * gap_m + CELL_M)
    own, reach = grid.count(points) > 0, 0.5 * gap_m / CELL_M
    grown = ndimage.distance_transform_edt(~own) <= reach
    closed = (ndimage.distance_transform_edt(grown) > reach) & ~own
    return replace(grid, occupied=closed)
