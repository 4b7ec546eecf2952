"""Depth of every pixel by comparison of photos: a small plane for each, which several photos and their own planes confirm.

Depth maps of Gaussians are exact where planes were known, and vague elsewhere. They are where the search starts
(:mod:`warprrf.kernels.patch_match`): each photo is compared with those that show its places from aside, at every pixel;
then once more, where a plane also costs what it contradicts the planes that the others found. A depth that two photos
found takes the place of the old one; what one sees through is left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from scipy import ndimage

from warprrf.device import DeviceLike, Progress, filled, launch
from warprrf.geometry.photos.posed.images import (
    GreyPhotos,
    PosedPhotos,
    layout,
    lens_matrix,
    projections,
    shown_at,
)
from warprrf.geometry.splats.camera import Camera
from warprrf.kernels.patch_match import UNKNOWN, Others, match
from warprrf.kernels.photo_consistency import count_votes

ROUNDS = ((range(3), 0.0), (range(3, 4), 0.3))
"""Turns in which planes are handed on between pixels, finer and finer ones, and what it costs to contradict another photo's
plane in full: first photos alone, then each knows what the others found."""
PROVED = 0.6  # planes of more cost prove nothing
CHECKED = 8  # maps of other photos that a depth is checked against


def mended(
    depths: Sequence[np.ndarray],
    views: Sequence[Camera],
    photos: PosedPhotos,
    *,
    progress: Progress,
    device: DeviceLike = None,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Depth maps of what photos prove, and elsewhere of what was there, where no photo sees through it; and the pixels that
    photos prove.

    Args:
        depths: ranges [m], ``(height, width)`` of each of ``views``, 0 where unknown.
    """
    known = [depth[depth > 0] for depth in depths]
    if sum(map(len, known)) == 0:
        return list(depths), [np.zeros(depth.shape, dtype=bool) for depth in depths]
    near, far = np.percentile(np.concatenate(known), [0.5, 99.5])
    bounds = 1 / (1.6 * float(far)), 1 / (0.6 * float(near))
    grey = GreyPhotos.upload(views, photos.images, device)
    sharpness, compared = _sharpness(grey.pixels), 3  # photos that one is compared with
    others = [_companions(k, views, depths, sharpness, compared) for k in range(len(views))]
    started = [_start(k, *seen, bounds) for k, seen in enumerate(zip(views, depths, strict=True))]
    planes, costs = list(started), [np.full(depth.shape, float(UNKNOWN)) for depth in depths]
    work = len(ROUNDS) * len(views)
    for number, (turns, contradicting) in enumerate(ROUNDS):
        flat = np.concatenate([p.reshape(-1, 3) for p in planes])
        told = wp.array(flat, dtype=wp.vec3, device=grey.device)
        for k in range(len(views)):
            progress("stereo", number * len(views) + k, work)
            if len(others[k]) >= 2:
                sources = _others(grey, k, others[k], told, contradicting)
                planes[k], costs[k] = _matched(grey, k, planes[k], sources, turns, bounds)
    progress("stereo", work, work)
    found = []
    for k, (view, depth, plane) in enumerate(zip(views, depths, planes, strict=True)):
        moved = (plane[..., 0] != started[k][..., 0]) | (depth == 0)
        there = np.where(moved, 1 / (np.maximum(plane[..., 0], 1e-6) * ahead(view)), depth)
        found.append(np.where((costs[k] < PROVED) & shown_at(photos.mask(k), view), there, 0.0))
    result, proved = [], []
    tolerance = 0.015  # up to this part of the range two depths that photos found agree; one of Gaussians, up to twice as much
    for k, (view, depth) in enumerate(zip(views, depths, strict=True)):
        checked = _companions(k, views, depths, np.ones(len(views)), CHECKED)
        maps = [(views[s], found[s]) for s in checked]
        agreed, _ = _votes(found[k], view, maps, tolerance, device)
        _, crossed = _votes(depth, view, maps, 2 * tolerance, device)
        proved.append(agreed > 0)
        result.append(np.where(agreed > 0, found[k], np.where(crossed > 0, 0.0, depth)))
    return result, proved


def ahead(camera: Camera) -> np.ndarray:
    """Depth along the optical axis over range, shape ``(height, width)``."""
    return camera.directions() @ camera.rotation[2]


def _sharpness(pixels: Sequence[np.ndarray]) -> np.ndarray:
    """Of each grey photo, over the median."""
    blur = np.array([ndimage.laplace(grey).var() for grey in pixels])
    return np.clip(blur / max(float(np.median(blur)), 1e-12), 0.3, 1.5)


def _start(number: int, camera: Camera, depth: np.ndarray, bounds: tuple[float, float]) -> np.ndarray:
    """Planes along a depth map, ``(H, W, 3)``; at any inverse depth [1/m] within ``bounds`` where it is unknown."""
    known = depth > 0
    w = np.where(known, 1 / np.where(known, depth * ahead(camera), 1.0), 0.0)
    planes = np.stack([w, *np.gradient(w)[::-1]], axis=-1)
    bent = ~known | (np.abs(planes[..., 1:]).max(axis=-1) > 0.05 * w)  # across an edge
    planes[bent, 1:] = 0.0
    planes[~known, 0] = np.random.default_rng(number).uniform(*bounds, (~known).sum())
    return planes.astype(np.float32)


def _others(
    photos: GreyPhotos, number: int, others: np.ndarray, told: wp.array, contradicting: float
) -> Others:
    """The photos ``others``, as photo ``number`` is compared with them.

    Args:
        told: planes of all photos, flat.
        contradicting: cost of a plane that contradicts what is told of another photo.
    """
    cameras = photos.cameras
    camera, turns, shifts = cameras[number], [], []
    for other in others:
        lens, turn = lens_matrix(cameras[other]), cameras[other].rotation @ camera.rotation.T
        turns.append(lens @ turn @ np.linalg.inv(lens_matrix(camera)))
        shifts.append(lens @ (cameras[other].world_to_camera[:3, 3] - turn @ camera.world_to_camera[:3, 3]))
    return filled(
        Others, photos.device, turns=np.array(turns), shifts=np.array(shifts), sizes=photos.sizes[others],
        images=photos.flat, told=told, contradicting=contradicting,
    )  # fmt: skip


def _matched(
    photos: GreyPhotos,
    number: int,
    first: np.ndarray,
    others: Others,
    turns: range,
    bounds: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Better planes ``(H, W, 3)`` of a photo than ``first``, by comparison with ``others``, and their costs ``(H, W)``.

    Args:
        turns: in which planes are handed on between pixels.
        bounds: least and largest inverse depth [1/m].
    """
    camera, size, device = photos.cameras[number], wp.vec3i(*map(int, photos.sizes[number])), photos.device
    planes = wp.array(first.reshape(-1, 3), dtype=wp.vec3, device=device)
    costs = wp.full(len(planes), float(UNKNOWN), dtype=wp.float32, device=device)
    settled = 0.05  # a plane of less cost (one minus a correlation) stays as it is
    for turn in (-1, *turns):
        for colour in (0, 1):
            settings = [colour, turn, number, 1 / camera.fx, wp.vec2(*bounds), settled, size]
            count = camera.height * ((camera.width + 1) // 2)
            launch(match, count, [*settings, others, planes, costs], device=device, grain=32)
    return planes.numpy().reshape(first.shape), costs.numpy().reshape(first.shape[:2])


def _companions(
    view: int, cameras: Sequence[Camera], depths: Sequence[np.ndarray], weight: np.ndarray, count: int
) -> np.ndarray:
    """Up to ``count`` photos that show best what ``view`` does, at a good angle, at a like size, and not all from one
    place."""
    camera, part = cameras[view], (slice(8, None, 16),) * 2
    known = depths[view][part] > 0
    if not known.any():
        return np.zeros(0, dtype=np.int64)
    points = camera.position + depths[view][part][known][:, None] * camera.directions()[part][known]
    position = np.array([c.position for c in cameras])
    line = points[None] - position[:, None]
    distance = np.linalg.norm(line, axis=2)
    line /= np.maximum(distance, 1e-9)[..., None]
    angle = np.degrees(np.arccos(np.clip(np.einsum("cpi,pi->cp", line, line[view]), -1, 1)))
    # between two lines of sight: less tells depths badly, more changes what a window shows
    good_angle_deg = 9.0
    good = np.exp(-0.5 * (np.log(np.maximum(angle, 0.1) / good_angle_deg) / 0.7) ** 2)
    good *= np.minimum(distance / distance[view], distance[view] / np.maximum(distance, 1e-9))
    inside = np.array([c.in_frame(points)[0] for c in cameras])
    worth = np.where(inside.mean(axis=1) > 0.3, (good * inside).mean(axis=1), 0.0) * weight
    worth[view] = 0.0
    chosen: list[int] = []
    while len(chosen) < count and worth.max() > 0.02:
        best = int(worth.argmax())
        chosen.append(best)
        away = np.linalg.norm(position - position[best], axis=1)
        worth *= np.clip(2 * away / max(float(np.linalg.norm(position[best] - camera.position)), 1e-9), 0, 1)
        worth[best] = 0.0
    return np.array(chosen, dtype=np.int64)


def _votes(
    depth: np.ndarray,
    camera: Camera,
    others: Sequence[tuple[Camera, np.ndarray]],
    tolerance: float,
    device: DeviceLike = None,
) -> tuple[np.ndarray, np.ndarray]:
    """How many of the ``others`` (cameras and their ranges) confirm the depth at each pixel, and how many see through."""
    known = depth > 0
    agreed, crossed = (np.zeros(depth.shape, dtype=np.int64) for _ in range(2))
    cameras, ranges = [other for other, _ in others], [seen.ravel() for _, seen in others]
    if not cameras:
        return agreed, crossed
    points = camera.position + depth[known][:, None] * camera.directions()[known]
    eyes = np.array([c.position for c in cameras])
    found = [wp.zeros(len(points), dtype=wp.int32, device=device) for _ in range(2)]
    maps = [np.concatenate(ranges).astype(np.float32), projections(cameras), eyes, layout(cameras)]
    launch(count_votes, len(points), [points, *maps, tolerance, *found], device=device)
    agreed[known], crossed[known] = (votes.numpy() for votes in found)
    return agreed, crossed
