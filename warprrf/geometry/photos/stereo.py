"""Depth maps mended by the photos: where they show no common texture at a depth but do at another, the other is right.

Depth maps of Gaussians are exact where planes were known, and vague elsewhere. Every pixel's depth is compared in the
photos that show its place from aside; pixels that disagree look for a better one
(:mod:`warprrf.kernels.patch_match`), which counts where the maps of other photos confirm it. What others see through
is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import ndimage

from warprrf.device import DeviceLike, Progress, launch, require, resolve
from warprrf.geometry.photos.cells import in_frame
from warprrf.geometry.photos.targets import PosedPhotos
from warprrf.geometry.splats.camera import Camera
from warprrf.kernels.patch_match import UNKNOWN, match

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601
GOOD_ANGLE_DEG = 9.0  # between two lines of sight: less tells depths badly, more changes what a window shows

DOWNSCALE = 2  # photos are compared at the depth maps' size divided by this
SOURCES = 3  # photos that one is compared with
TURNS = 2  # how often planes are handed on between pixels
SETTLED = 0.2  # a depth of less cost (one minus a correlation) stays as it is
PROVED = 0.6  # depths of more cost prove nothing
GAIN = 0.05  # by which a new depth has to cost less than the old one
CHECKED, AGREED = 8, 2  # maps of other photos that a depth is checked against, and how many must agree on it
TOLERANCE = 0.02  # up to this part of the range two depths agree


@dataclass(frozen=True)
class _Map:
    """A depth map of small planes.

    Attributes:
        camera: its camera.
        planes: inverse depth along the optical axis [1/m] and its change per pixel in a row and a column,
            ``(H, W, 3)``.
        proved: photos agree there.
        better: and do so clearly more than on the plane that was there before.
    """

    camera: Camera
    planes: np.ndarray
    proved: np.ndarray
    better: np.ndarray

    def ranges(self) -> np.ndarray:
        """Euclidean ranges [m], 0 where nothing is proved."""
        return np.where(self.proved, 1 / (self.planes[..., 0] * ahead(self.camera)), 0.0)

    def at(self, view: Camera) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
        """Which pixels of the map the pixels of ``view``, the same photo in another size, fall into, and their ranges."""
        x = (np.arange(view.width) + 0.5) * self.camera.width / view.width
        y = (np.arange(view.height) + 0.5) * self.camera.height / view.height
        place = np.ix_(y.astype(int), x.astype(int))
        plane = self.planes[place]
        w = plane[..., 0] + plane[..., 1] * (x % 1 - 0.5) + plane[..., 2] * (y % 1 - 0.5)[:, None]
        return place, 1 / (np.maximum(w, 1e-6) * ahead(view))


def mended(
    depths: Sequence[np.ndarray],
    views: Sequence[Camera],
    photos: PosedPhotos,
    *,
    progress: Progress,
    device: DeviceLike = None,
) -> list[np.ndarray]:
    """Depth maps with what photos prove wrong replaced by what they prove, or left out.

    Args:
        depths: ranges [m], ``(height, width)`` of each of ``views``, 0 where unknown.
        views: cameras of the photos, of any size.
        photos: one a view, in this order.
    """
    cameras = [v.resized(max(2, v.width // DOWNSCALE), max(2, v.height // DOWNSCALE)) for v in views]
    coarse = [_sampled(depth, camera) for depth, camera in zip(depths, cameras, strict=True)]
    known = [depth[depth > 0] for depth in coarse]
    if sum(map(len, known)) == 0:
        return list(depths)
    near, far = np.percentile(np.concatenate(known), [0.5, 99.5])
    bounds = 1 / (1.6 * float(far)), 1 / (0.6 * float(near))
    comparison = _Comparison.of(cameras, photos, bounds, device)
    maps = []
    for k, depth in enumerate(coarse):
        progress("stereo", k, len(coarse))
        others = _companions(k, cameras, coarse, comparison.sharpness, SOURCES)
        maps.append(comparison.map_of(k, depth, others))
    progress("stereo", len(coarse), len(coarse))
    ranges = [found.ranges() for found in maps]
    result = []
    for k, (view, depth) in enumerate(zip(views, depths, strict=True)):
        others = _companions(k, cameras, coarse, np.ones(len(cameras)), CHECKED)
        pairs = [(cameras[s], ranges[s]) for s in others]
        agreed, _ = _votes(ranges[k], cameras[k], pairs, TOLERANCE)
        place, fine = maps[k].at(view)
        right = (maps[k].better & (agreed >= AGREED))[place]
        _, crossed = _votes(coarse[k], cameras[k], pairs, 2 * TOLERANCE)
        wrong = (crossed >= AGREED)[place]
        result.append(np.where(right, fine, np.where(wrong, 0.0, depth)))
    return result


def ahead(camera: Camera) -> np.ndarray:
    """Depth along the optical axis over range, shape ``(height, width)``."""
    cosine: np.ndarray = camera.directions() @ camera.rotation[2]
    return cosine


def _sampled(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """A depth map at the size of ``camera``."""
    rows, columns = ((np.arange(n) + 0.5) / n for n in (camera.height, camera.width))
    return depth[np.ix_((rows * depth.shape[0]).astype(int), (columns * depth.shape[1]).astype(int))]


@dataclass(frozen=True)
class _Comparison:
    """Grey photos on a device, and how they are compared.

    Attributes:
        cameras: of the photos, at the size at which they are compared.
        sizes: where each photo begins in ``grey``, its width and its height, shape ``(N, 3)``.
        grey: all photos, flat.
        kept: pixels that are not masked, ``(H, W)`` each.
        sharpness: of each photo, over the median.
        bounds: least and largest inverse depth [1/m].
    """

    cameras: Sequence[Camera]
    sizes: np.ndarray
    grey: wp.array
    kept: Sequence[np.ndarray]
    sharpness: np.ndarray
    bounds: tuple[float, float]
    device: wp.Device

    @classmethod
    def of(
        cls,
        cameras: Sequence[Camera],
        photos: PosedPhotos,
        bounds: tuple[float, float],
        device: DeviceLike,
    ) -> _Comparison:
        """The photos at the sizes of ``cameras``."""
        image, where = require("PIL.Image", extra="photos"), resolve(device)
        grey, kept = [], []
        for k, (photo, camera) in enumerate(zip(photos.images, cameras, strict=True)):
            whole = image.fromarray(np.asarray(photo, dtype=np.float32) @ LUMA)
            small = np.asarray(whole.resize((camera.width, camera.height), image.BOX))
            mask = photos.masks[k] if photos.masks else None
            grey.append(small)
            kept.append(
                np.full(small.shape, True) if mask is None else _sampled(np.asarray(mask), camera) == 0
            )
        ends = np.cumsum([0, *(g.size for g in grey)])[:-1]
        sizes = np.array(
            [(end, g.shape[1], g.shape[0]) for end, g in zip(ends, grey, strict=True)], dtype=np.int32
        )
        blur = np.array([ndimage.laplace(g).var() for g in grey])  # small where a photo is blurred
        flat = wp.array(np.concatenate([g.ravel() for g in grey]), dtype=wp.float32, device=where)
        sharpness = np.clip(blur / max(float(np.median(blur)), 1e-12), 0.3, 1.5)
        return cls(cameras, sizes, flat, kept, sharpness, bounds, where)

    def map_of(self, view: int, depth: np.ndarray, others: np.ndarray) -> _Map:
        """The map of one photo, from ``depth`` and comparison with ``others``."""
        camera, device = self.cameras[view], self.device
        first = self._start(depth, camera, view)
        nothing = np.zeros(depth.shape, dtype=bool)
        if len(others) < 2:
            return _Map(camera, first, nothing, nothing)
        planes = wp.array(first.reshape(-1, 3), dtype=wp.vec3, device=device)
        costs = wp.full(depth.size, float(UNKNOWN), dtype=wp.float32, device=device)
        inverse = np.linalg.inv(_lens(camera))
        turn = [self.cameras[s].rotation @ camera.rotation.T for s in others]
        shift = [
            self.cameras[s].world_to_camera[:3, 3] - r @ camera.world_to_camera[:3, 3]
            for s, r in zip(others, turn, strict=True)
        ]
        lenses = [_lens(self.cameras[s]) for s in others]
        turns = np.array([k @ r @ inverse for k, r in zip(lenses, turn, strict=True)], dtype=np.float32)
        shifts = np.array([k @ t for k, t in zip(lenses, shift, strict=True)], dtype=np.float32)
        sources = [
            wp.array(turns, dtype=wp.mat33, device=device), wp.array(shifts, dtype=wp.vec3, device=device),
            wp.array(self.sizes[others], dtype=wp.vec3i, device=device), self.grey, planes, costs,
        ]  # fmt: skip
        before = np.zeros(0)
        for number in range(-1, TURNS):
            for colour in (0, 1):
                settings = [
                    colour, number, view, 1 / camera.fx, wp.vec2(*self.bounds), SETTLED,
                    wp.vec3i(*map(int, self.sizes[view])),
                ]  # fmt: skip
                count = camera.height * ((camera.width + 1) // 2)
                launch(match, count, [*settings, *sources], device=device, grain=32)
            if number < 0:
                before = costs.numpy().reshape(depth.shape).copy()
        cost = costs.numpy().reshape(depth.shape)
        proved = (cost < PROVED) & self.kept[view]
        better = proved & ((cost < before - GAIN) | (depth <= 0))
        return _Map(camera, planes.numpy().reshape(first.shape).astype(np.float64), proved, better)

    def _start(self, depth: np.ndarray, camera: Camera, view: int) -> np.ndarray:
        """Planes along a depth map; at any depth where it is unknown."""
        known = depth > 0
        w = np.where(known, 1 / np.where(known, depth * ahead(camera), 1.0), 0.0)
        planes = np.stack([w, *np.gradient(w)[::-1]], axis=-1)
        bent = ~known | (np.abs(planes[..., 1:]).max(axis=-1) > 0.05 * w)  # across an edge
        planes[bent, 1:] = 0.0
        planes[~known, 0] = np.random.default_rng(view).uniform(*self.bounds, (~known).sum())
        return planes.astype(np.float32)


def _lens(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


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
    good = np.exp(-0.5 * (np.log(np.maximum(angle, 0.1) / GOOD_ANGLE_DEG) / 0.7) ** 2)
    good *= np.minimum(distance / distance[view], distance[view] / np.maximum(distance, 1e-9))
    inside = np.array([in_frame(c, points)[0] for c in cameras])
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
    depth: np.ndarray, camera: Camera, others: Sequence[tuple[Camera, np.ndarray]], tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """How many of the ``others`` (cameras and their ranges) confirm the depth at each pixel, and how many see through."""
    agreed, crossed = (np.zeros(depth.shape, dtype=np.int64) for _ in range(2))
    known = depth > 0
    points = camera.position + depth[known][:, None] * camera.directions()[known]
    for other, ranges in others:
        inside, place = in_frame(other, points)
        seen = np.where(inside, ranges[place[:, 0], place[:, 1]], 0.0)
        distance = np.linalg.norm(points - other.position, axis=1)
        agreed[known] += (seen > 0) & (np.abs(seen - distance) < tolerance * distance)
        crossed[known] += seen > (1 + tolerance) * distance
    return agreed, crossed
