"""Depth that a sensor measured along with the photos: as range maps of cameras, and as points that several of them see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from warprrf.geometry.photos.posed.images import shown_at
from warprrf.geometry.photos.posed.photo_files import read_mask, read_photo, spread
from warprrf.geometry.photos.posed.poses import DepthFile, read_depth
from warprrf.geometry.photos.posed.sparse import SparseModel
from warprrf.geometry.photos.posed.undistort import stored_pixels
from warprrf.geometry.splats.camera import Camera, slopes_of
from warprrf.rows import distinct_rows, sums_of


def range_maps(sparse: SparseModel, files: Mapping[str, DepthFile]) -> dict[str, tuple[Camera, np.ndarray]]:
    """Cameras of about the size of their depth images, and Euclidean ranges [m], 0 where unknown or masked; by photo."""
    found = {}
    views = 120  # most maps that are used, spread over all
    for name in spread((name for name in sparse.cameras if name in files), views):
        depth, camera, lens = read_depth(files[name]), sparse.cameras[name], sparse.lenses[name]
        height, width = depth.shape
        if abs(width / height / (lens.width / lens.height) - 1) > 0.02:
            raise ValueError(
                f"depth: {files[name].path} has {width} x {height} pixels, its photo {lens.width} x {lens.height}; "
                "expected depth in the frame of the photo"
            )
        share = width / lens.width * (lens.fx + lens.fy) / (camera.fx + camera.fy)
        view = camera.resized(max(1, round(camera.width * share)), max(1, round(camera.height * share)))
        x, y = slopes_of(view)
        columns, rows = stored_pixels(lens, np.column_stack([x.ravel(), y.ravel()]), files[name].turns).T
        place = (rows * height / lens.height).astype(int), (columns * width / lens.width).astype(int)
        known = (rows >= 0) & (columns >= 0) & (place[0] < height) & (place[1] < width)
        if (mask := read_mask(sparse.photos[name])) is not None:
            known &= shown_at(mask, view).ravel()
        z = np.zeros(x.size, dtype=np.float32)
        z[known] = depth[place[0][known], place[1][known]]
        found[name] = view, z.reshape(x.shape) * np.sqrt(1 + x**2 + y**2)
    return found


def with_points(sparse: SparseModel, files: Mapping[str, DepthFile]) -> SparseModel:
    """``sparse``, in metres, with points of measured depth, each seen by three cameras or more."""
    maps = range_maps(sparse, files)
    points, colors = _cloud(maps, sparse.photos)
    seen = np.zeros((len(points), len(maps)), dtype=bool)
    shown = through = 0
    near_m = 0.02  # a map shows a point that it measures this near to,
    near_share = 0.02  # or within this part of its range
    for k, (view, measured) in enumerate(maps.values()):
        inside, place = view.in_frame(points)
        here = np.linalg.norm(points - view.position, axis=1)
        there = np.where(inside, measured[place[:, 0], place[:, 1]], 0.0)
        known = there > 0
        off = there - here
        seen[:, k] = known & (np.abs(off) < near_m + near_share * here)
        shown += int(seen[:, k].sum())
        through += int((known & (off > near_m + near_share * here)).sum())
    shown -= len(points)  # by the map that it comes from
    # 0.5: least share of the points in a map's sight that it shows, over those that it looks through
    if shown < 0.5 * (shown + through):
        raise ValueError(
            f"depth: of the points in sight of another depth image {max(shown, 0) / max(shown + through, 1):.0%} are where it "
            "measures them; expected most: depth and poses differ in unit (scale=, depth_unit_scale_factor) or are of "
            "other axes"
        )
    keep = seen.sum(axis=1) >= 3
    seen = seen[keep]
    index = np.flatnonzero([name in maps for name in sparse.cameras])
    return replace(
        sparse,
        points=points[keep],
        colors=colors[keep],
        reprojection_error=np.zeros(len(seen)),
        track_length=seen.sum(axis=1),
        track_camera=index[np.nonzero(seen)[1]],
    )


def _cloud(
    maps: Mapping[str, tuple[Camera, np.ndarray]], photos: Mapping[str, Path]
) -> tuple[np.ndarray, np.ndarray]:
    """Points and colours of all maps, the mean of those in a cube."""
    # 400_000: of all maps that points are made of
    stride = max(1, int(np.ceil(np.sqrt(sum(r.size for _, r in maps.values()) / 400_000))))
    some = (slice(stride // 2, None, stride),) * 2
    points, colors = [], []
    for name, (view, measured) in maps.items():
        distance = measured[some].ravel()
        known = distance > 0
        towards = view.directions()[some].reshape(-1, 3)[known]
        points.append(view.position + distance[known, None] * towards)
        image = read_photo(photos[name])
        rows, columns = (
            (np.arange(size)[stride // 2 :: stride] + 0.5) * full / size
            for size, full in zip(measured.shape, image.shape[:2], strict=True)
        )
        colors.append(image[np.ix_(rows.astype(int), columns.astype(int))].reshape(-1, 3)[known])
    xyz, rgb = np.concatenate(points).astype(np.float64), np.concatenate(colors).astype(np.float64)
    # 0.03: one point for each cube of this side
    cell = np.floor(xyz / 0.03).astype(np.int64)
    _, group, count = distinct_rows(cell)
    return sums_of(xyz, group) / count[:, None], sums_of(rgb, group) / count[:, None]
