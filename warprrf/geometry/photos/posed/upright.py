"""Which way is up and where the floor is, where nobody surveyed: from edges, planes and the floor that photos show.

Every straight edge of a photo spans a plane with the camera's centre, and the planes of all vertical edges share the
vertical. It is the direction that the most edges agree on near the photos' own "up", found by shrinking a window round
it (the idea of Coughlan and Yuille, "Manhattan world", 2003, for one direction). Walls and level surfaces among the
sparse points then correct it, and the floor is the lowest level surface beneath the cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from warprrf.geometry.mesh_files import UP
from warprrf.geometry.photos.posed.images import block_means
from warprrf.geometry.photos.posed.photo_files import spread
from warprrf.geometry.photos.posed.sparse import SparseModel, cleaned, detect_room_planes
from warprrf.geometry.planes import Plane, PlaneConfig
from warprrf.geometry.splats.camera import Camera

NEAR_DEG = 25.0  # the vertical is this near to the photos' own up


def upright(sparse: SparseModel, photo: Callable[[str], np.ndarray], *, seed: int = 0) -> SparseModel:
    """``sparse`` turned and shifted: z up, the floor at 0, x = y = 0 amid the cameras; lengths are as they were [m].

    What no photo proves is said in its ``guessed``.

    Args:
        photo: reads the photo of a posed camera, ``(H, W, 3)`` in [0, 1], by its name; some are looked at.
    """
    cameras = list(sparse.cameras.values())
    guessed = list(sparse.guessed)
    up, proven = vertical_of_edges(sparse.cameras, photo)
    clean = cleaned(sparse)
    points = clean.points
    planes = detect_room_planes(clean, PlaneConfig(), seed)[0] if len(points) >= 3 else []
    if not proven:
        level = [p.normal for p in planes if p.normal @ up > np.cos(np.radians(NEAR_DEG))]
        if level:  # the best supported one
            up = level[0]
        else:
            guessed.append(
                "up: photos show neither vertical edges nor a floor; taken from how the camera was held"
            )
    up = _vertical_of_planes(up, planes)
    height = floor_height(points, planes, up, cameras)
    if height is None:
        guessed.append("floor: no level surface beneath the cameras; the lowest points are taken for it")
        height = float(np.percentile(points @ up, 1.0)) if len(points) else 0.0
    ahead = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([ahead, np.cross(up, ahead), up])
    shift = -rotation @ np.mean([c.position for c in cameras], axis=0)
    shift[2] = -height
    moved = sparse.transformed(rotation=rotation, shift=shift)
    return replace(moved, upright=True, guessed=tuple(guessed))


def turned(sparse: SparseModel, up: str) -> SparseModel:
    """``sparse`` with the axis ``up`` of its own, ``"x"``, ``"y"`` or ``"z"``, as z; its origin stays."""
    axes, signs = UP[up]
    rotation = np.eye(3)[axes] * np.array(signs)[:, None]
    return replace(sparse.transformed(rotation=rotation), upright=True)


def held_up(cameras: Sequence[Camera]) -> np.ndarray:
    """Unit vector that points up as cameras are held: across their x axes, which are level, and near their own up."""
    axes = np.array([c.rotation for c in cameras])
    right, up = axes[:, 0], -axes[:, 1]
    return _least(right.T @ right + 0.1 * (len(up) * np.eye(3) - up.T @ up), up.sum(axis=0))


def _least(cost: np.ndarray, near: np.ndarray) -> np.ndarray:
    """The unit vector ``x`` of least ``x . cost x``, of symmetric ``cost`` (3, 3), that points the way of ``near``."""
    found = np.linalg.eigh(cost)[1][:, 0]
    return found if found @ near > 0 else -found


def vertical_of_edges(
    cameras: Mapping[str, Camera], photo: Callable[[str], np.ndarray]
) -> tuple[np.ndarray, bool]:
    """The vertical as a unit vector, shape ``(3,)``, and whether edges prove it; else it is :func:`held_up`.

    Args:
        photo: reads a photo by its name, ``(H, W, 3)`` in [0, 1].
    """
    held = held_up(list(cameras.values()))
    photos = 40  # looked at for edges, spread over all
    normals = np.concatenate([_edge_planes(photo(name), cameras[name]) for name in spread(cameras, photos)])
    normals = normals[np.abs(normals @ held) < np.sin(np.radians(NEAR_DEG))]
    if len(normals) < 100:
        return held, False
    up = held
    windows_deg = (12, 8, 5, 3, 2, 1.5, 1, 0.7, 0.5, 0.5, 0.5)  # standard deviations of the window, in turn
    for window in windows_deg:
        weight = np.exp(-0.5 * (normals @ up / np.sin(np.radians(window))) ** 2)
        up = _least((normals * weight[:, None]).T @ normals, up)
    off = np.degrees(np.arcsin(np.minimum(np.abs(normals @ up), 1.0)))
    # density of edges within 1 degree of the vertical over that from 4 to 10 degrees; of clutter: 1
    proven = 1.3
    sharp = (off < 1).sum() > proven * ((off > 4) & (off < 10)).sum() / 6
    near = up @ held > np.cos(np.radians(NEAR_DEG))
    return (up, True) if sharp and near else (held, False)


def _edge_planes(photo: np.ndarray, camera: Camera) -> np.ndarray:
    """Unit normals in the world of the planes that a photo's straight edges span with its centre, shape ``(E, 3)``."""
    edge_pixels = 480  # about the longer side of a photo while its edges are looked for
    step = max(1, round(max(photo.shape[:2]) / edge_pixels))
    grey = ndimage.gaussian_filter(block_means(photo.mean(axis=2), step), 0.8)
    gy, gx = (ndimage.sobel(grey, axis) / 8 for axis in (0, 1))
    xx, xy, yy = (ndimage.gaussian_filter(product, 2.0) for product in (gx * gx, gx * gy, gy * gy))
    spread = np.hypot(xx - yy, 2 * xy)
    slope, across = np.hypot(gx, gy), 0.5 * np.arctan2(2 * xy, xx - yy)
    straight = 0.9  # least coherence of gradients round a pixel of an edge
    contrast = 0.01  # least slope there [white/pixel]
    rows, columns = np.nonzero((slope > contrast) & (spread > straight * (xx + yy)))
    nx, ny = np.cos(across[rows, columns]), np.sin(across[rows, columns])
    beside = [
        ndimage.map_coordinates(slope, [rows + s * ny, columns + s * nx], order=1, mode="nearest")
        for s in (-1, 1)
    ]
    crest = slope[rows, columns] >= np.maximum(*beside)
    nx, ny = nx[crest], ny[crest]
    x, y = ((at[crest] + 0.5) * step for at in (columns, rows))
    lines = np.stack([nx * camera.fx, ny * camera.fy, nx * (camera.cx - x) + ny * (camera.cy - y)], axis=1)
    return lines / np.linalg.norm(lines, axis=1, keepdims=True) @ camera.rotation


def _vertical_of_planes(up: np.ndarray, planes: Iterable[Plane]) -> np.ndarray:
    """``up`` corrected by planes that are nearly level or nearly upright, each by its number of points."""
    normals = np.array([p.normal for p in planes]).reshape(-1, 3)
    count = np.array([len(p.inliers) for p in planes], dtype=np.float64)
    plane_deg = (4.0, 2.0, 1.0, 0.7, 0.7)  # of the window for planes, in turn
    for window in plane_deg:
        along = normals @ up
        level = np.abs(along) > 0.5
        off = np.where(level, np.sqrt(np.maximum(1 - along**2, 0.0)), along)
        weight = count * np.exp(-0.5 * (off / np.sin(np.radians(window))) ** 2)
        sign = np.where(level, -1.0, 1.0)
        total = (normals * (weight * sign)[:, None]).T @ normals
        # What no plane says stays as it was.
        total -= 1e-3 * max(weight.sum(), 1.0) * np.outer(up, up)
        up = _least(total, up)
    return up


def floor_height(
    points: np.ndarray, planes: Sequence[Plane], up: np.ndarray, cameras: Sequence[Camera]
) -> float | None:
    """Height of the floor along ``up``: of the lowest large level plane beneath the cameras; None where there is none."""
    eyes = float(np.median([c.position @ up for c in cameras]))
    heights = points @ up
    levels: list[tuple[float, int]] = []
    floor_m = 0.05  # thickness of a level surface
    for plane in planes:
        if plane.normal @ up > np.cos(np.radians(5.0)):
            height = float(np.median(heights[plane.inliers]))
            if height < eyes:
                near = np.abs(heights[plane.inliers] - height) < floor_m
                levels.append((height, int(near.sum())))
    most = max((count for _, count in levels), default=0)
    floor_share = 0.1  # least points of a floor, over those of the largest level
    floor = min((height for height, count in levels if count >= floor_share * most), default=None)
    below_share = 0.01  # of all points may lie beneath a floor
    return None if floor is None or (heights < floor - 2 * floor_m).mean() > below_share else floor
