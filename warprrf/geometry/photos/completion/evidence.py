"""What photos prove of boxes: votes for free and for solid by lines of sight, and how much of a surface was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.patches import PlanarPatch, connected_pieces
from warprrf.geometry.photos.completion.boxes import Grid
from warprrf.geometry.photos.completion.dividers import Divider, Labels
from warprrf.geometry.photos.planes import Plane
from warprrf.geometry.splats.camera import Camera

SNAP_M = 0.12  # a depth agrees with the mesh when both are this close
SHY_M = 0.1  # a line of sight proves nothing this close to an end that lies on no plane
STEP_M = 0.06  # mean spacing of samples along lines of sight
BESIDE_M = 0.006  # a hit votes for the boxes this far before and behind its plane: within the thinnest board
RIM_M, RIM_SHARE = 0.6, 0.25  # a side is closed when planes this near to it cover so much of it
SEEN_PIECE = 0.1  # a flat piece of surface is seen when hits lie on so much of it


def votes(
    grid: Grid,
    mesh: Mesh,
    labels: Labels,
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    stride: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Votes for free and for solid, shape ``grid.shape`` each.

    A line of sight counts where its depth agrees with the mesh. It votes free at samples along it, and where it ends on
    a plane also right before the plane, and solid right behind.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for camera, depth in zip(cameras, depths, strict=True):
        i, j = rng.integers(0, stride, 2)
        ranges = np.asarray(depth, dtype=np.float64)[i::stride, j::stride].ravel()
        seen = np.isfinite(ranges) & (ranges > 0)
        towards = camera.directions()[i::stride, j::stride].reshape(-1, 3)[seen]
        parts.append((np.broadcast_to(camera.position, towards.shape), towards, ranges[seen]))
    o, d, ranges = (np.concatenate(p) for p in zip(*parts, strict=True))
    free, solid = np.zeros(grid.size), np.zeros(grid.size)
    if not len(o):
        return free.reshape(grid.shape), solid.reshape(grid.shape)
    hit = mesh.cast(o, d)
    agree = hit.valid & (np.abs(np.where(hit.valid, hit.t, 0.0) - ranges) < SNAP_M)
    o, d, ranges, t, face = o[agree], d[agree], ranges[agree], hit.t[agree], hit.face[agree]
    axis, sign, height = labels.axis[face], labels.sign[face], labels.height[face]
    normal = sign[:, None] * grid.axes[axis]
    cosine = -np.einsum("ni,ni->n", d, normal)
    on = (axis >= 0) & (cosine > 0.05)
    slope = np.where(on, cosine, 1.0)
    t_plane = (np.einsum("ni,ni->n", o, normal) - sign * height) / slope
    on &= np.abs(t_plane - ranges) < SNAP_M / np.maximum(slope, 0.3)
    end = np.where(on, t_plane - BESIDE_M / slope, np.minimum(ranges, t) - SHY_M)
    point = (o + t_plane[:, None] * d)[on]
    free += grid.count(point + BESIDE_M * normal[on])
    solid += grid.count(point - BESIDE_M * normal[on])
    _sample(grid, o, d, end, rng, free)
    return free.reshape(grid.shape), solid.reshape(grid.shape)


def _sample(
    grid: Grid, o: np.ndarray, d: np.ndarray, end: np.ndarray, rng: np.random.Generator, votes: np.ndarray
) -> None:
    """Add to ``votes`` the samples along rays up to ``end`` [m], one in each stretch of ``STEP_M``.

    Heights become boxes by a table of 2 mm: much faster than a search, and fine enough for evidence.
    """
    fine = 0.002
    tables = []
    for heights, count in zip(grid.heights, grid.shape, strict=True):
        middles = np.arange(heights[0] + fine / 2, heights[-1], fine)
        box = np.clip(np.searchsorted(heights, middles, side="right") - 1, 0, count - 1)
        tables.append(np.concatenate([[-(2**40)], box, [-(2**40)]]))  # outside stays negative
    low = np.array([h[0] for h in grid.heights])
    start = (((o @ grid.axes.T - low) / fine) + 1).T.astype(np.float32)
    along = (d @ grid.axes.T / fine).T.astype(np.float32)
    reach = np.maximum(end, 0).astype(np.float32)
    counts = np.ceil(reach / STEP_M).astype(np.int64)
    for first in range(0, len(o), 20_000):
        count = counts[first : first + 20_000]
        ray = np.repeat(np.arange(first, first + len(count)), count)
        step = np.arange(len(ray)) - np.repeat(np.cumsum(count) - count, count)
        t = (step.astype(np.float32) + rng.random(len(ray), dtype=np.float32)) * np.float32(STEP_M)
        index = np.zeros(len(ray), dtype=np.int64)
        for a, boxes in enumerate(grid.shape):
            slot = start[a][ray] + t * along[a][ray]
            index *= boxes
            index += tables[a][np.clip(slot, 0, len(tables[a]) - 1).astype(np.int32)]
        votes += np.bincount(index[(index >= 0) & (t < reach[ray])], minlength=len(votes))


def vote_proven(grid: Grid, plane: Plane, divider: Divider, free: np.ndarray, solid: np.ndarray) -> None:
    """Four votes of each occupied cell for free space before it, and for a solid behind."""
    quarter = np.array([[i, j] for i in (-0.25, 0.25) for j in (-0.25, 0.25)]) * plane.cell_m
    points = (plane.cells()[:, None] + quarter @ plane.axes).reshape(-1, 3)
    axis = grid.axes[divider.axis]
    points += (divider.height - points @ axis)[:, None] * axis
    before = divider.sign * BESIDE_M * axis
    free += grid.count(points + before).reshape(grid.shape)
    solid += grid.count(points - before).reshape(grid.shape)


def closed_sides(grid: Grid, mesh: Mesh, labels: Labels) -> np.ndarray:
    """Whether planes cover the lower and upper end of each direction, seen from within, shape ``(3, 2)`` bool."""
    closed = np.zeros((3, 2), dtype=bool)
    extent = [h[-1] - h[0] for h in grid.heights]
    for a in range(3):
        across = extent[(a + 1) % 3] * extent[(a + 2) % 3]
        for k, (end, sign) in enumerate(((grid.heights[a][0], 1), (grid.heights[a][-1], -1))):
            own = (labels.axis == a) & (labels.sign == sign) & (np.abs(labels.height - end) < RIM_M)
            closed[a, k] = mesh.areas[own].sum() > RIM_SHARE * across
    return closed


def seen_share(grid: Grid, mesh: Mesh, patches: Sequence[PlanarPatch], solid: np.ndarray) -> float:
    """Share of the surface's area in flat pieces that hits lie on, by the votes ``solid`` of the boxes behind."""
    behind = grid.locate(mesh.triangles.mean(axis=1) - 0.5 * BESIDE_M * mesh.face_normals)
    hit = (behind >= 0) & (solid.ravel()[behind] > 0)
    label = np.full(len(mesh.faces), -1)
    for k, patch in enumerate(patches):
        label[patch.faces] = k
    piece = connected_pieces(mesh, label)
    area = np.bincount(piece, weights=mesh.areas)
    seen = np.bincount(piece, weights=mesh.areas * hit) > SEEN_PIECE * area
    return float(area[seen].sum() / area.sum())
