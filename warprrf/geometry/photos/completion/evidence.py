"""What photos prove of boxes: votes for free and for solid by lines of sight, and how much of a surface was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warprrf.geometry.mesh import Mesh, connected_pieces
from warprrf.geometry.photos.completion.boxes import Grid
from warprrf.geometry.photos.completion.room_planes import FaceLevels, Level
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.planes import Plane
from warprrf.geometry.splats.camera import Camera

STRIDE = 5  # every so many-th row and column of the depth maps is used
SNAP_M = 0.12  # a depth agrees with the mesh when both are this close
STEP_M = 0.06  # spacing of samples along lines of sight
BESIDE_M = 0.006  # a hit votes for the boxes this far before and behind its plane: within the thinnest board
RIM_M, RIM_SHARE = 0.6, 0.25  # a side is closed when planes this near to it cover so much of it
RAYS_AT_ONCE = 20_000


def votes(
    grid: Grid,
    mesh: Mesh,
    faces: FaceLevels,
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Votes for free and for solid, shape ``grid.shape`` each.

    A line of sight counts where its depth agrees with the mesh. It votes free at samples along it, and where it ends on
    a plane also right before the plane, and solid right behind.
    """
    o, d, ranges = _lines_of_sight(cameras, depths, STRIDE)
    hit = mesh.cast(o, d)
    agree = hit.valid & (np.abs(np.where(hit.valid, hit.t, 0.0) - ranges) < SNAP_M)
    o, d, ranges, t, face = o[agree], d[agree], ranges[agree], hit.t[agree], hit.face[agree]
    axis, sign, height = faces.axis[face], faces.sign[face], faces.height[face]
    normal = sign[:, None] * grid.axes[axis]
    cosine = -np.einsum("ni,ni->n", d, normal)
    on = (axis >= 0) & (cosine > 0.05)
    slope = np.where(on, cosine, 1.0)
    t_plane = (np.einsum("ni,ni->n", o, normal) - sign * height) / slope
    on &= np.abs(t_plane - ranges) < SNAP_M / np.maximum(slope, 0.3)
    # 0.1: a line of sight proves nothing this close to an end that lies on no plane
    end = np.where(on, t_plane - BESIDE_M / slope, np.minimum(ranges, t) - 0.1)
    point = (o + t_plane[:, None] * d)[on]
    free = grid.count(point + BESIDE_M * normal[on]).astype(float)
    solid = grid.count(point - BESIDE_M * normal[on]).astype(float)
    # A sample in the middle of each step along the line. Nothing is drawn: one line more or less changes one vote.
    counts = np.ceil(np.maximum(end, 0) / STEP_M - 0.5).astype(np.int64)
    for first in range(0, len(o), RAYS_AT_ONCE):
        count = counts[first : first + RAYS_AT_ONCE]
        ray = np.repeat(np.arange(first, first + len(count)), count)
        step = np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)
        free += grid.count(o[ray] + ((step + 0.5) * STEP_M)[:, None] * d[ray])
    return free, solid


def _lines_of_sight(
    cameras: Sequence[Camera], depths: Sequence[np.ndarray], stride: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and directions, shape ``(N, 3)``, and ranges [m] of every ``stride``-th known pixel in rows and columns."""
    parts = []
    for camera, depth in zip(cameras, depths, strict=True):
        some = (slice(stride // 2, None, stride),) * 2
        ranges = np.asarray(depth, dtype=np.float64)[some].ravel()
        seen = np.isfinite(ranges) & (ranges > 0)
        towards = camera.directions()[some].reshape(-1, 3)[seen]
        parts.append((np.broadcast_to(camera.position, towards.shape), towards, ranges[seen]))
    o, d, ranges = (np.concatenate(p) for p in zip(*parts, strict=True))
    return o, d, ranges


def vote_proven(grid: Grid, plane: Plane, level: Level) -> tuple[np.ndarray, np.ndarray]:
    """Four votes of each occupied cell for free space before it, and for a solid behind, shape ``grid.shape`` each."""
    quarter = np.array([[i, j] for i in (-0.25, 0.25) for j in (-0.25, 0.25)]) * plane.cell_m
    points = (plane.cells()[:, None] + quarter @ plane.axes).reshape(-1, 3)
    axis = grid.axes[level.axis]
    points += (level.height - points @ axis)[:, None] * axis
    before = level.sign * BESIDE_M * axis
    return grid.count(points + before), grid.count(points - before)


def closed_sides(grid: Grid, mesh: Mesh, faces: FaceLevels) -> np.ndarray:
    """Whether planes cover the lower and upper end of each direction, seen from within, shape ``(3, 2)`` bool."""
    closed = np.zeros((3, 2), dtype=bool)
    extent = [h[-1] - h[0] for h in grid.heights]
    for a in range(3):
        across = extent[(a + 1) % 3] * extent[(a + 2) % 3]
        for k, (end, sign) in enumerate(((grid.heights[a][0], 1), (grid.heights[a][-1], -1))):
            own = (faces.axis == a) & (faces.sign == sign) & (np.abs(faces.height - end) < RIM_M)
            closed[a, k] = mesh.areas[own].sum() > RIM_SHARE * across
    return closed


def seen_share(grid: Grid, patches: PlanarPatches, solid: np.ndarray) -> float:
    """Share of the surface's area in flat pieces that hits lie on, by the votes ``solid`` of the boxes behind."""
    mesh = patches.mesh
    behind = grid.locate(mesh.triangles.mean(axis=1) - 0.5 * BESIDE_M * mesh.face_normals)
    hit = (behind >= 0) & (solid.ravel()[behind] > 0)
    piece = connected_pieces(mesh, patches.face_patch)
    area = np.bincount(piece, weights=mesh.areas)
    # 0.1: a flat piece of surface is seen when hits lie on so much of it
    seen = np.bincount(piece, weights=mesh.areas * hit) > 0.1 * area
    return float(area[seen].sum() / area.sum())
