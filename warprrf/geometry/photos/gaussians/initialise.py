"""Before the refinement: sparse points cleaned, their planes found, completed and covered with Gaussians.

Gaussians start as flat discs on the sparse points, and on the planes where photos see them.

The photos' colours decide how finely a plane is covered: blocks whose colour varies are cut into smaller ones, the
worst first, until the wanted number is reached. So bare walls take few Gaussians and posters many.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from warprrf.device import DeviceLike, Progress, silent
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.gaussians.cells import meeting, occupancy, plane_mesh, quarters, seen_cells
from warprrf.geometry.photos.gaussians.plain import plain_surfaces, with_plain
from warprrf.geometry.photos.gaussians.sweep import choose_views, joined, level_planes, proven_cells, united
from warprrf.geometry.photos.posed.images import GreyPhotos, PosedPhotos
from warprrf.geometry.photos.posed.sparse import SparseModel, cleaned, detect_room_planes
from warprrf.geometry.planes import Plane, aligned, directions, plane_axes
from warprrf.geometry.splats.gaussians import Y00, Gaussians, quaternions_of
from warprrf.rows import distinct_rows, sums_of

SPREAD = 0.65  # standard deviation of a disc in units of the spacing: little light leaks between neighbours


def initial_gaussians(
    points: np.ndarray,
    colors: np.ndarray,
    normals: np.ndarray,
    planes: Sequence[Plane],
    photos: PosedPhotos,
    count: int,
) -> Gaussians:
    """Flat Gaussians to start the photometric optimisation from, degree 0 colours.

    Args:
        points: sparse points [m], shape ``(P, 3)``.
        colors: in [0, 1], shape ``(P, 3)``.
        normals: unit normals, shape ``(P, 3)``.
        planes: planes with occupied cells (see :func:`~warprrf.geometry.photos.gaussians.cells.occupancy`); cells that no camera
            sees are left out.
        count: Gaussians wanted in all (about).
    """
    free = np.ones(len(points), dtype=bool)
    for plane in planes:
        # 0.02: a sparse point this close to an occupied cell gives way to the plane's own discs
        free &= ~plane.holds(points, 0.02)
    min_scale, max_scale = 0.004, 0.12  # of a disc on a sparse point [m]
    gap = cKDTree(points).query(points[free], k=4)[0][:, 1:]  # infinite where there are fewer
    radius = np.clip(gap.mean(axis=1), min_scale, max_scale)
    parts = [(points[free], normals[free], radius, colors[free])]
    if planes:
        parts += _blocks(planes, photos, max(count - int(free.sum()), 1))
    centres, facing, sizes, shades = (np.concatenate(p) for p in zip(*parts, strict=True))
    if not len(centres):
        raise ValueError("points: got none, and no plane that a photo sees; nothing to start from")
    return discs(centres, facing, sizes, shades)


def discs(centres: np.ndarray, normals: np.ndarray, radius: np.ndarray, colors: np.ndarray) -> Gaussians:
    """Flat discs of degree 0: centres and unit normals ``(N, 3)``, radii ``(N,)`` [m], colours ``(N, 3)`` in [0, 1]."""
    axes = plane_axes(normals)
    rotation = np.stack([axes[:, 0], axes[:, 1], normals], axis=2)
    # 0.05: thickness over radius
    scales = np.stack([radius, radius, np.maximum(0.05 * radius, 1e-4)], axis=1)
    sh = ((colors - 0.5) / Y00)[:, None, :]
    opacity = 0.95
    return Gaussians(centres, quaternions_of(rotation), scales, np.full(len(centres), opacity), sh)


def _blocks(
    planes: Sequence[Plane], photos: PosedPhotos, count: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Centres, normals, radii and colours of discs for blocks of two, one or half a cell, about ``count`` in all."""
    surface = plane_mesh(planes)
    cells = []
    for k, plane in enumerate(planes):
        views = choose_views(surface, plane.cells(), plane.normal, photos.cameras)
        some = views[:, 0] >= 0
        fine = quarters(plane)[some]
        color = _median_colors(fine.reshape(-1, 3), np.repeat(views[some], 4, axis=0), photos)
        key = np.insert(np.argwhere(plane.occupied)[some] // 2, 0, k, axis=1)
        cells.append((key, fine, color.reshape(-1, 4, 3)))
    key, fine, color = (np.concatenate(c) for c in zip(*cells, strict=True))
    _, parent, members = distinct_rows(key)
    whole, centre, middle = len(members), fine.mean(axis=1), color.mean(axis=1)
    coarse_centre, coarse = (sums_of(of, parent) / members[:, None] for of in (centre, middle))
    # To cut a block costs 3 Gaussians and removes about the variance between its parts, with a share of what lies
    # within them; the largest gains first, half of the room for either size.
    within = ((color - middle[:, None]) ** 2).sum(axis=2).mean(axis=1)
    between = np.bincount(parent, within + ((middle - coarse[parent]) ** 2).sum(axis=1), whole)
    room = count - whole
    cut = _largest(between, int(0.5 * room / 3))
    room -= 3 * int(cut.sum())
    cut_again = _largest(np.where(cut[parent], within, 0.0), room // 3)
    kept = cut[parent] & ~cut_again
    normal, side = np.array([p.normal for p in planes]), np.array([p.cell_m for p in planes])
    plane_of, parent_plane = key[:, 0], np.zeros(whole, dtype=int)
    parent_plane[parent] = plane_of
    quartered = np.repeat(plane_of[cut_again], 4)
    return [
        (coarse_centre[~cut], normal[parent_plane[~cut]], 2 * SPREAD * side[parent_plane[~cut]], coarse[~cut]),
        (centre[kept], normal[plane_of[kept]], SPREAD * side[plane_of[kept]], middle[kept]),
        (fine[cut_again].reshape(-1, 3), normal[quartered], 0.5 * SPREAD * side[quartered],
         color[cut_again].reshape(-1, 3)),
    ]  # fmt: skip


def _largest(values: np.ndarray, count: int) -> np.ndarray:
    """Mask of the ``count`` largest positive ``values``."""
    chosen = np.zeros(len(values), dtype=bool)
    chosen[np.argsort(-values, kind="stable")[: max(0, count)]] = True
    return chosen & (values > 0)


def _median_colors(points: np.ndarray, views: np.ndarray, photos: PosedPhotos) -> np.ndarray:
    """Median colour of each point over its ``views`` (indices of photos, shape ``(N, V)``, -1 padded), shape ``(N, 3)``."""
    taken = np.full((*views.shape, 3), np.nan)
    for c, (camera, image) in enumerate(zip(photos.cameras, photos.images, strict=True)):
        rows, slots = np.nonzero(views == c)
        if len(rows):
            at = camera.project(points[rows])[0].T[::-1] - 0.5
            colours = [ndimage.map_coordinates(image[..., c], at, order=1, mode="nearest") for c in range(3)]
            taken[rows, slots] = np.transpose(colours)
    return np.nan_to_num(np.nanmedian(taken, axis=1), nan=0.5)


def initialise(
    sparse: SparseModel,
    photos: PosedPhotos,
    *,
    config: ReconstructionConfig,
    seed: int = 0,
    progress: Progress | None = None,
    device: DeviceLike = None,
) -> tuple[list[Plane], Gaussians]:
    """Planes of the sparse points, and the Gaussians that refinement starts from.

    Args:
        sparse: posed cameras and points [m], those of held-out photos among them.
    """
    report = progress or silent
    report("planes", 0, 6)
    if len(sparse.points) < 3:
        raise ValueError(
            f"photos: only {len(sparse.points)} points were reconstructed; more overlap is needed"
        )
    sparse = cleaned(sparse, worst_px=1.0)
    points, lines = sparse.points, sparse.lines_of_sight()
    planes, normals = detect_room_planes(sparse, config.planes, seed)
    level = sparse.metric and sparse.upright
    planes = aligned(planes, points) if level else planes
    planes = occupancy(planes, points, *lines, config=config.planes)
    report("planes", 1, 6)
    if config.sweep and len(photos.cameras) > 2 and planes:
        grey = GreyPhotos.upload(photos.cameras, photos.images, device)
        planes = proven_cells(planes, points, grey)
        report("planes", 2, 6)
        if level:
            levels = []
            for k, up in enumerate((True, False)):
                levels += level_planes(planes, points, grey, lines, cell_m=config.planes.cell_m, up=up)
                report("planes", 3 + k, 6)
            planes = joined(planes, levels)
    real = np.ones(len(points), dtype=bool)
    axes = _axes(planes) if config.plain else None
    if axes is not None:
        plain, reflected = plain_surfaces(photos, axes, lines)
        sight = lines[0][~reflected], lines[1][~reflected]
        planes = with_plain(planes, plain, points, sight)
        real = np.add.reduceat(reflected, sparse.track_start[:-1]) < 0.5 * sparse.track_length
    report("planes", 5, 6)
    planes = seen_cells(meeting(united((), planes)), list(sparse.cameras.values()))
    own = points[real], sparse.colors[real], normals[real]
    gaussians = initial_gaussians(*own, planes, photos, config.gaussians)
    report("planes", 6, 6)
    return planes, gaussians


def _axes(planes: Sequence[Plane]) -> np.ndarray | None:
    """The three directions that most of the planes face along, shape ``(3, 3)``; None when there are none."""
    known = [plane for plane in planes if plane.occupied.any()]
    areas = np.array([plane.area() for plane in known])
    normals = np.array([plane.normal for plane in known])
    return directions(normals, areas, float(areas.sum()))
