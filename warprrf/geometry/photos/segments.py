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
from warprrf.geometry.splats.camera import Camera

COARSENESS = 60.0  # of the segments: scikit-image's ``scale``, of colours from 0 to 255
BLUR_PX, LEAST_PX = 0.6, 80  # before a photo is cut, and pixels of the smallest segment
PROVED_PX, PROVED_SHARE = 15, 0.04  # so many pixels of a segment, and such a part of it, must be proved
TOLERANCE = 0.02  # a depth that differs from a plane's by less than this part lies on it
ON_ONE_PLANE = 0.4  # part of the proved depths of a segment that must lie on its plane
TRIALS, DRAWN = 48, 300  # planes through three proved pixels, and pixels that they are judged by
UNSURE = 0.02  # where a plane's standard deviation is larger than this part of the depth, it says nothing
ALIKE_PX = 25.0  # neighbouring pixels, of which errors are alike
NEAR = 0.12  # proved depths that differ by more than this part from the plane are something else, and stay


def with_segments(
    depth: np.ndarray, proved: np.ndarray, shown: np.ndarray, photo: np.ndarray, view: Camera
) -> np.ndarray:
    """A depth map with the pixels of each flat segment on its plane.

    Args:
        depth: ranges [m], 0 where unknown, shape ``(height, width)`` of ``view``.
        proved: pixels whose depth photos prove, same shape, bool.
        shown: pixels that may have a depth: what is not masked, same shape, bool.
        photo: in [0, 1], shape ``(H, W, 3)``, of any size.
        view: pinhole camera of the depth map.
    """
    image = require("PIL.Image", extra="photos")
    segmentation = require("skimage.segmentation", extra="photos")
    bytes_ = np.round(255 * np.asarray(photo)).astype(np.uint8)
    colours = np.asarray(image.fromarray(bytes_).resize((view.width, view.height), image.BOX))
    segment = segmentation.felzenszwalb(colours, scale=COARSENESS, sigma=BLUR_PX, min_size=LEAST_PX).ravel()
    rays = view.directions().reshape(-1, 3)
    inverse = np.where(depth.ravel() > 0, 1 / np.maximum(depth.ravel(), 1e-9), 0.0)
    result, sure = depth.flatten(), proved.ravel()
    order = np.argsort(segment, kind="stable")
    for pixels in np.split(order, np.flatnonzero(np.diff(segment[order])) + 1):
        own = pixels[sure[pixels]]
        if len(own) < max(PROVED_PX, PROVED_SHARE * len(pixels)):
            continue
        found = _plane(rays[own], inverse[own], np.random.default_rng(int(pixels[0])))
        if found is None:
            continue
        plane, covariance = found
        there = rays[pixels] @ plane
        spread = np.sqrt(np.einsum("ni,ij,nj->n", rays[pixels], covariance, rays[pixels]))
        put = shown.ravel()[pixels] & (there > 1e-6) & (spread < UNSURE * there)
        put &= ~sure[pixels] | (np.abs(there - inverse[pixels]) < NEAR * inverse[pixels])
        result[pixels[put]] = 1 / there[put]
    return result.reshape(depth.shape)


def _plane(
    rays: np.ndarray, inverse: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """The plane on which many of a segment's depths lie, its coefficients and their covariance; None if few lie on one."""
    drawn = rng.permutation(len(rays))[:DRAWN]
    three = drawn[rng.integers(0, len(drawn), (TRIALS, 3))]
    tried = np.einsum("nij,nj->ni", np.linalg.pinv(rays[three]), inverse[three])
    off = np.abs(tried @ rays[drawn].T / inverse[drawn] - 1)
    plane = tried[(off < TOLERANCE).sum(axis=1).argmax()]
    for _ in range(4):
        weight = 1 / (1 + ((rays @ plane / inverse - 1) / TOLERANCE) ** 2) / inverse
        plane = np.linalg.lstsq(rays * weight[:, None], inverse * weight, rcond=None)[0]
    left = rays @ plane - inverse
    on = np.abs(left) < TOLERANCE * inverse
    if on.mean() < ON_ONE_PLANE:
        return None
    return plane, ALIKE_PX * left[on].var() * np.linalg.pinv(rays[on].T @ rays[on])
