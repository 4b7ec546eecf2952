"""Depth maps made flat where a photo's colours say that one surface is there.

Nothing can be matched within a bare cabinet door, and what is matched on a poster is noisy. But both have one colour, or
few, up to their edges. A photo is cut into segments of like colour (Felzenszwalb and Huttenlocher, "Efficient
graph-based image segmentation", 2004). Where many of the depths that photos prove in a segment lie on one plane, all of
the segment does (in the spirit of Bleyer and Gelautz, "A layered stereo matching algorithm using image segmentation and
global visibility constraints", 2005), as far as these depths fix the plane. On a plane inverse range is a linear
function of the direction of the ray: ``1 / r = c . d`` where ``c . x = 1`` is the plane seen from the camera.

Constants were chosen on a filmed kitchen (7-Scenes) and looked at again on a filmed lounge and on drawn rooms with bare
walls; the figures change little with any of them.
"""

from __future__ import annotations

import numpy as np

from warprrf.device import require
from warprrf.geometry.photos.posed.images import resized
from warprrf.geometry.splats.camera import Camera

COARSENESS = 60.0  # of the segments, of colours from 0 to 255
BLUR_PX, LEAST_PX = 0.6, 80  # before a photo is cut, and pixels of the smallest segment
TRIALS, DRAWN = 48, 300  # planes through three proved pixels, and pixels that they are judged by
UNSURE = 0.02  # where a plane's standard deviation is larger than this part of the depth, it says nothing
NEAR = 0.12  # proved depths that differ by more than this part from the plane are something else, and stay


def with_segments(
    depth: np.ndarray, proved: np.ndarray, shown: np.ndarray, segment: np.ndarray, view: Camera
) -> np.ndarray:
    """A depth map with the pixels of each flat segment on its plane.

    Args:
        depth: ranges [m], 0 where unknown, shape ``(height, width)`` of ``view``.
        proved: pixels whose depth photos prove, same shape, bool.
        shown: pixels that may have a depth: what is not masked, same shape, bool.
        segment: of each pixel, as :func:`segments_of` numbers them, same shape.
    """
    segment, rays = segment.ravel(), view.directions().reshape(-1, 3)
    inverse = np.where(depth.ravel() > 0, 1 / np.maximum(depth.ravel(), 1e-9), 0.0)
    result, sure = depth.flatten(), proved.ravel()
    order = np.argsort(segment, kind="stable")
    proved_px, proved_share = 15, 0.04  # so many pixels of a segment, and such a part of it, must be proved
    for pixels in np.split(order, np.flatnonzero(np.diff(segment[order])) + 1):
        own = pixels[sure[pixels]]
        if len(own) < max(proved_px, proved_share * len(pixels)):
            continue
        found = _plane(rays[own], inverse[own], np.random.default_rng(int(pixels[0])))
        if found is None:
            continue
        plane, covariance = found
        there = rays[pixels] @ plane
        spread = np.sqrt(((rays[pixels] @ covariance) * rays[pixels]).sum(axis=1))
        put = shown.ravel()[pixels] & (there > 1e-6) & (spread < UNSURE * there)
        put &= ~sure[pixels] | (np.abs(there - inverse[pixels]) < NEAR * inverse[pixels])
        result[pixels[put]] = 1 / there[put]
    return result.reshape(depth.shape)


def segments_of(photo: np.ndarray, view: Camera) -> np.ndarray:
    """A number for the segment of each pixel of ``view`` in its ``photo``, in [0, 1], shape ``(H, W, 3)``, of any size."""
    segmentation = require("skimage.segmentation", extra="photos")
    colours = resized(np.round(255 * np.asarray(photo)).astype(np.uint8), view)
    segment = segmentation.felzenszwalb(colours, scale=COARSENESS, sigma=BLUR_PX, min_size=LEAST_PX)
    return np.asarray(segment)


def _plane(
    rays: np.ndarray, inverse: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """The plane on which many of a segment's depths lie, its coefficients and their covariance; None if few lie on one."""
    drawn = rng.permutation(len(rays))[:DRAWN]
    three = drawn[rng.integers(0, len(drawn), (TRIALS, 3))]
    corner = rays[three]
    across = np.cross(corner[:, [1, 2, 0]], corner[:, [2, 0, 1]])  # Cramer's rule
    volume = (corner[:, 0] * across[:, 0]).sum(axis=1)
    tried = (inverse[three][:, None] @ across)[:, 0] / np.where(volume == 0, 1.0, volume)[:, None]
    off = np.abs(tried @ rays[drawn].T / inverse[drawn] - 1)
    tolerance = 0.02  # a depth that differs from a plane's by less than this part lies on it
    plane = tried[(off < tolerance).sum(axis=1).argmax()]
    for _ in range(4):
        weighted = rays / (inverse * (1 + ((rays @ plane / inverse - 1) / tolerance) ** 2))[:, None] ** 2
        plane = np.linalg.solve(_regular(weighted.T @ rays), weighted.T @ inverse)
    left = rays @ plane - inverse
    on = np.abs(left) < tolerance * inverse
    # 0.4: part of the proved depths of a segment that must lie on its plane
    if on.mean() < 0.4:
        return None
    # 25.0: neighbouring pixels, of which errors are alike
    return plane, 25.0 * left[on].var() * np.linalg.inv(_regular(rays[on].T @ rays[on]))


def _regular(normal_matrix: np.ndarray) -> np.ndarray:
    """A normal matrix that can be inverted though all pixels lie on one line."""
    return normal_matrix + 1e-12 * np.trace(normal_matrix) * np.eye(3)
