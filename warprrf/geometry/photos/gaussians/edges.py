"""Straight edges along a room's three directions: found in photos of known cameras, and placed in space.

A line along a known direction has two unknowns, its place in the cross-section. There a photo's edge is a bearing from
its camera: edge pixels that run along the direction and share a bearing are a segment, and where the bearings of several
photos meet is the line (for known directions and poses, the interpretation planes of Coughlan and Yuille, "Manhattan
world", 1999, and the triangulation of lines by Bartoli and Sturm, 2005). Cameras, lines and lengths are in the room's
frame, whose axes are the three directions. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from warprrf.geometry.splats.camera import Camera
from warprrf.rows import Rows

BLUR_PX = 1.5  # photos are smoothed by so much before they are differentiated
EDGE = 0.009  # an edge changes some colour by this part of white per pixel,
EDGE_DEG = 6.0  # and its direction in the photo is good to this
SEGMENT_PX, GAP_PX = 24.0, 6.0  # shortest segment, and longest gap in one
SIDE_PX = 4.0  # colours are taken so far beside an edge,
ALIKE = 0.08  # and are one surface's when they differ by no more than this
LINE_VIEWS = 3  # fewest photos that show an edge
FARTHEST_M = 25.0  # a line is sought so far from a camera
POSE_M = 0.02  # what poses may be off
REFITS = 5


@dataclass(frozen=True)
class Edgels:
    """Edge pixels of a photo.

    Attributes:
        position: shape ``(N, 2)`` [pixels].
        across: unit direction in which the photo changes most, shape ``(N, 2)``.
        strength: change per pixel of the colour that changes most, of all pixels, shape ``(H, W)``.
    """

    position: np.ndarray
    across: np.ndarray
    strength: np.ndarray


@dataclass(frozen=True)
class Line:
    """A straight edge in space.

    Attributes:
        axis: the direction it runs along.
        at: its place on the two axes that follow in cyclic order [m], shape ``(2,)``.
        low, high: where it begins and ends along its axis [m].
        views: the cameras that show it.
    """

    axis: int
    at: np.ndarray
    low: float
    high: float
    views: tuple[int, ...]

    @property
    def weight(self) -> float:
        """How well it is known: its length times the number of its views, ten at most."""
        return (self.high - self.low) * min(len(self.views), 10)

    def height(self, axis: int) -> float:
        """Its place on another axis than its own."""
        return float(self.at[(axis - self.axis) % 3 - 1])

    @property
    def ends(self) -> np.ndarray:
        """Where it begins and ends [m], shape ``(2, 3)``."""
        return self.points(np.array([self.low, self.high]))

    def points(self, along: np.ndarray) -> np.ndarray:
        """Points at these places along its axis, shape ``(N, 3)``."""
        result = np.empty((len(along), 3))
        result[:, self.axis] = along
        result[:, (self.axis + 1) % 3], result[:, (self.axis + 2) % 3] = self.at
        return result


def find_edgels(image: np.ndarray) -> Edgels:
    """Edge pixels of a photo ``(H, W, 3)`` in [0, 1], to a fraction of a pixel (the scheme of Canny, 1986)."""
    blur = [BLUR_PX, BLUR_PX, 0]
    change = [ndimage.gaussian_filter(image, blur, order=order) for order in ((0, 1, 0), (1, 0, 0))]
    main = (change[0] ** 2 + change[1] ** 2).argmax(axis=2)[..., None]
    dx, dy = (np.take_along_axis(c, main, axis=2)[..., 0].astype(np.float64) for c in change)
    strength = np.hypot(dx, dy)
    inside = np.zeros(strength.shape, dtype=bool)
    inside[2:-2, 2:-2] = True
    y, x = np.nonzero(inside & (strength > EDGE))
    here = strength[y, x]
    across = np.stack([dx[y, x], dy[y, x]], axis=1) / here[:, None]
    before, after = (
        ndimage.map_coordinates(strength, [y + s * across[:, 1], x + s * across[:, 0]], order=1)
        for s in (-1, 1)
    )
    top = (here >= before) & (here > after)
    here, before, after, across = here[top], before[top], after[top], across[top]
    shift = 0.5 * (before - after) / np.minimum(before - 2 * here + after, -1e-9)  # top of the parabola
    position = np.stack([x[top] + 0.5, y[top] + 0.5], axis=1) + np.clip(shift, -0.5, 0.5)[:, None] * across
    return Edgels(position, across, strength)


@dataclass(frozen=True)
class Segments(Rows):
    """N segments of photos along one direction.

    Attributes:
        camera: which camera shows it, shape ``(N,)``.
        bearing: from the camera in the cross-section [rad], shape ``(N,)``.
        rise: where it begins and ends: metres along the direction per metre of distance, shape ``(N, 2)``.
        across, along: place of the camera in the cross-section, shape ``(N, 2)``, and along the direction, ``(N,)`` [m].
        towards: unit vector of the bearing, shape ``(N, 2)``.
        pixel: radians of bearing that a pixel is worth, shape ``(N,)``.
        length: [pixels], shape ``(N,)``.
        sides: colours on the side of smaller and of larger bearing, shape ``(N, 2, 3)``.
    """

    camera: np.ndarray
    bearing: np.ndarray
    rise: np.ndarray
    pixel: np.ndarray
    length: np.ndarray
    sides: np.ndarray
    across: np.ndarray
    along: np.ndarray
    towards: np.ndarray

    def alike(self, k: int) -> np.ndarray:
        """Which have the colour of segment ``k`` on one side at least (an occluding edge keeps only one)."""
        return np.abs(self.sides - self.sides[k]).max(axis=2).min(axis=1) < ALIKE


def find_segments(
    camera: Camera, number: int, image: np.ndarray, edgels: Edgels, axis: int
) -> list[tuple[int, float, tuple[float, float], float, float, np.ndarray]]:
    """Rows of :class:`Segments` along ``axis`` in one photo."""
    position, across = edgels.position, edgels.across
    rays, along_image = lines_through(camera, position, axis)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    size = np.hypot(rays[:, u], rays[:, v])
    straight = np.abs((along_image * across).sum(axis=1)) < np.sin(np.radians(EDGE_DEG))
    # 0.15: a ray closer to the direction than this (sine) fixes no bearing
    own = np.flatnonzero(straight & (size > 0.15 * np.linalg.norm(rays, axis=1)))
    # How the bearing changes along ``across``, per pixel.
    step = np.pad(across / [camera.fx, camera.fy], [(0, 0), (0, 1)]) @ camera.rotation
    turn = (step[:, v] * rays[:, u] - step[:, u] * rays[:, v]) / np.maximum(size, 1e-9) ** 2
    bearing, rise = np.arctan2(rays[:, v], rays[:, u]), rays[:, axis] / np.maximum(size, 1e-9)
    own = own[np.argsort(bearing[own], kind="stable")]
    wide = 1.2 * np.abs(turn[own])
    first = np.searchsorted(bearing[own], bearing[own] - wide)
    last = np.searchsorted(bearing[own], bearing[own] + wide, side="right")
    used, result = np.zeros(len(own), dtype=bool), []
    x, y = position[own].T
    for k in np.argsort(first - last, kind="stable"):
        if last[k] - first[k] < SEGMENT_PX:
            break
        if used[k]:  # the others of its window were tried with it
            continue
        group = first[k] + np.flatnonzero(~used[first[k] : last[k]])
        if len(group) < SEGMENT_PX:
            continue
        group = group[np.argsort(rise[own[group]], kind="stable")]
        gap = np.hypot(np.diff(x[group]), np.diff(y[group]))
        ends_at = np.concatenate([[0], np.flatnonzero(gap > GAP_PX) + 1, [len(group)]])
        for run_at in np.flatnonzero(np.diff(ends_at) >= SEGMENT_PX):
            run = group[ends_at[run_at] : ends_at[run_at + 1]]
            pixels = own[run]
            length = float(np.linalg.norm(position[pixels[-1]] - position[pixels[0]]))
            if length < SEGMENT_PX or len(run) < 0.6 * length:
                continue
            used[run] = True
            ends = float(rise[pixels[0]]), float(rise[pixels[-1]])
            outward = np.sign(turn[pixels])[:, None] * across[pixels]
            sides = np.stack([_colour(image, position[pixels] + s * SIDE_PX * outward) for s in (-1, 1)])
            angle, pixel = float(np.median(bearing[pixels])), float(np.abs(turn[pixels]).mean())
            result.append((number, angle, ends, pixel, length, sides))
    return result


def lines_through(
    camera: Camera, pixels: np.ndarray, axis: int | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays of pixels, shape ``(N, 3)``, of depth one, and the image direction of lines along ``axis`` (one, or one a pixel)
    there, ``(N, 2)``."""
    lens = np.array([camera.fx, camera.fy])
    local = np.pad((pixels - [camera.cx, camera.cy]) / lens, [(0, 0), (0, 1)], constant_values=1.0)
    towards = camera.rotation.T[axis]
    image = lens * (towards[..., :2] - local[:, :2] * towards[..., 2:])
    return local @ camera.rotation, image / np.maximum(np.linalg.norm(image, axis=1, keepdims=True), 1e-9)


def _colour(image: np.ndarray, positions: np.ndarray) -> np.ndarray:
    x, y = positions.astype(int).T
    taken = image[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)]
    return np.median(taken, axis=0)


def find_lines(
    cameras: Sequence[Camera], images: Sequence[np.ndarray], edgels: Sequence[Edgels]
) -> list[Line]:
    """Lines along the three axes that at least ``LINE_VIEWS`` photos show, from different directions."""
    positions = np.array([camera.position for camera in cameras])
    lines = []
    for axis in range(3):
        rows = [
            row
            for k, (camera, image) in enumerate(zip(cameras, images, strict=True))
            for row in find_segments(camera, k, image, edgels[k], axis)
        ]
        if rows:
            camera, bearing, rise, pixel, length, sides = map(np.array, zip(*rows, strict=True))
            eye, towards = positions[camera], np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
            place = eye[:, [(axis + 1) % 3, (axis + 2) % 3]], eye[:, axis]
            lines += _placed(Segments(camera, bearing, rise, pixel, length, sides, *place, towards), axis)
    return lines


def _placed(segments: Segments, axis: int) -> list[Line]:
    """Lines where segments meet, the best supported first; each segment belongs to one."""
    guesses = [_met(segments, k) for k in range(len(segments.camera))]
    support = np.array([weight for weight, _ in guesses])
    free, lines = np.ones(len(support), dtype=bool), []
    for k in np.argsort(-support, kind="stable"):
        # 0.5: segments that meet, by how sharply: a guess with less is not tried
        if support[k] < 0.5:
            break
        if not free[k]:
            continue
        distance = guesses[k][1]
        alike = np.flatnonzero(free & segments.alike(k))
        place = segments.across[k] + distance * segments.towards[k]
        ends = segments.along[k] + distance * segments.rise[k]
        place, chosen = _fitted(segments.take(alike), place, ends)
        line = _extent(segments.take(alike[chosen]), place, axis)
        if line is not None:
            free[alike[chosen]] = False
            lines.append(line)
    return lines


def _met(segments: Segments, k: int) -> tuple[float, float]:
    """How many segments of other photos meet segment ``k`` at one place, by weight, and at which distance [m]."""
    across, along, towards = segments.across, segments.along, segments.towards
    sine = towards[k, 0] * towards[:, 1] - towards[k, 1] * towards[:, 0]
    # 3.0: two bearings that differ by less meet nowhere for sure
    meet = np.abs(sine) > np.sin(np.radians(3.0))
    others = np.flatnonzero(meet & (segments.camera != segments.camera[k]) & segments.alike(k))
    apart, towards_k, towards, sine = across[others] - across[k], towards[k], towards[others], sine[others]
    mine = (apart[:, 0] * towards[:, 1] - apart[:, 1] * towards[:, 0]) / sine
    theirs = (apart[:, 0] * towards_k[1] - apart[:, 1] * towards_k[0]) / sine
    ok = (np.minimum(mine, theirs) > 0.15) & (np.maximum(mine, theirs) < FARTHEST_M)
    ends = along[others, None] + segments.rise[others] * theirs[:, None]
    own = along[k] + segments.rise[k] * mine[:, None]
    ok &= np.minimum(ends[:, 1], own[:, 1]) - np.maximum(ends[:, 0], own[:, 0]) > 0.05
    blur = (1.5 * (segments.pixel[others] * theirs + segments.pixel[k] * mine) + POSE_M) / np.abs(sine)
    ok &= blur < 0.4
    if not ok.any():
        return 0.0, 0.0
    weight = np.minimum(1.0, 0.08 / blur[ok])
    stop = np.concatenate([mine[ok] - blur[ok], mine[ok] + blur[ok]])
    order = np.argsort(stop, kind="stable")
    total = np.cumsum(np.concatenate([weight, -weight])[order])
    best = int(total.argmax())
    return float(total[best]), float(stop[order][best : best + 2].mean())


def _fitted(segments: Segments, place: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place in the cross-section that those of the segments near a first guess fix, and which these are, shape ``(N,)``."""
    low, high = ends
    towards, pixel = segments.towards, segments.pixel
    for step in range(REFITS):
        reach = place - segments.across
        distance = np.hypot(reach[:, 0], reach[:, 1])
        miss = reach[:, 0] * towards[:, 1] - reach[:, 1] * towards[:, 0]
        near = (2 if step > 1 else 3) * pixel * distance + POSE_M
        ends = segments.along[:, None] + segments.rise * distance[:, None]
        chosen = ((reach * towards).sum(axis=1) > 0.1) & (np.abs(miss) < near)
        chosen &= np.minimum(ends[:, 1], high) - np.maximum(ends[:, 0], low) > -0.3
        if chosen.sum() < 2:
            break
        normal = np.stack([towards[chosen, 1], -towards[chosen, 0]], axis=1)
        sure = np.minimum(segments.length, 100) / ((pixel * distance) ** 2 + 1e-4)
        w = (sure / (1 + (2 * miss / near) ** 2))[chosen, None] * normal
        at = (normal * segments.across[chosen]).sum(axis=1)
        place = np.linalg.lstsq(w.T @ normal, w.T @ at, rcond=1e-9)[0]
        low, high = np.percentile(ends[chosen, 0], 2), np.percentile(ends[chosen, 1], 98)
    return place, chosen


def _extent(segments: Segments, place: np.ndarray, axis: int) -> Line | None:
    """The line at ``place``, from where to where two photos at least show it; None where too few show any of it."""
    views = np.unique(segments.camera)
    if len(views) < LINE_VIEWS:
        return None
    distance = np.linalg.norm(place - segments.across, axis=1)
    ends = segments.along[:, None] + segments.rise * distance[:, None]
    bins = np.arange(ends.min(), ends.max() + 0.05, 0.05)
    shown = np.zeros(len(bins), dtype=int)
    for view in views:
        own = ends[segments.camera == view]
        shown += ((bins >= own[:, :1]) & (bins <= own[:, 1:])).any(axis=0)
    twice = bins[shown >= 2]
    if not len(twice):
        return None
    return Line(axis, place, float(twice[0]), float(twice[-1]), tuple(int(view) for view in views))
