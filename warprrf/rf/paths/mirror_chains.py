"""Mirror chains of many receivers at once, with the patches they touch: the image method on meshes of many patches.

Which pairs of patches can reflect one after the other does not depend on the receiver: the cone of rays that leave the
transmitter's image through the first patch must touch the ball around the second. The pairs left are tested exactly,
as :class:`warprrf.rf.paths.trace.MirrorTracer` tests every pair; no path is lost, to rounding. A room with 28 000 patches
takes seconds for hundreds of receivers, where all pairs would take hours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.kernels.radio.mirror_pairs import mirror_pairs
from warprrf.rf.paths.trace import MirrorTracer, _cross_plane

_SLACK_M = 1e-6  # balls and cones are this much too large: rounding loses no path
_BLOCK = 2_000_000  # numbers an intermediate array may hold, about
_LEAF = 16  # neighbouring receivers that are tried at once


@dataclass(frozen=True)
class MirrorChains:
    """Unobstructed chains of up to two mirror reflections, N of them over all receivers.

    Attributes:
        receiver: Index of the receiver, shape ``(N,)``, sorted.
        patch: Patches in the order in which the wave meets them, shape ``(N, 2)``; -1 past the last.
        vertices: Interaction points [m], shape ``(N, 2, 3)``; NaN past the last.
        length_m: Unfolded length [m], shape ``(N,)``.
        last_point: What the receiver sees last, shape ``(N, 3)`` [m]: the transmitter for line of sight.
    """

    receiver: np.ndarray
    patch: np.ndarray
    vertices: np.ndarray
    length_m: np.ndarray
    last_point: np.ndarray

    @property
    def order(self) -> np.ndarray:
        """Number of reflections, shape ``(N,)``: 0 is line of sight."""
        return (self.patch >= 0).sum(axis=1)

    def gain(self, wavelength_m: float) -> np.ndarray:
        """Complex gain ``(N,)`` of perfect reflectors without a sign change: Friis along the unfolded length."""
        turns = np.mod(self.length_m / wavelength_m, 1.0)
        return wavelength_m / (4.0 * np.pi * self.length_m) * np.exp(-2j * np.pi * turns)


def mirror_chains(tracer: MirrorTracer, receivers: Any, order: int = 1) -> MirrorChains:
    """Every chain from the tracer's transmitter to each of ``receivers``.

    Args:
        tracer: Transmitter, mesh and patches.
        receivers: Positions [m], shape ``(R, 3)``.
        order: Most reflections on one chain: 0, 1 or 2.

    Raises:
        ValueError: on another order or shape, NaN, or a receiver at the transmitter's place.
    """
    if order not in (0, 1, 2):
        raise ValueError(f"order: got {order!r}, expected 0, 1 or 2")
    points = _device.check_array("receivers", receivers, (None, 3))
    apart = np.linalg.norm(points - tracer.transmitter, axis=1)
    if (apart == 0.0).any():
        raise ValueError("receivers: got a receiver at the transmitter's place, expected them apart")
    parts = [_line_of_sight(tracer, points)]
    if order >= 1:
        blocks = range(0, len(points), max(1, _BLOCK // len(tracer.patches)) if len(tracer.patches) else 1)
        step = blocks.step
        parts += [_once(tracer, points[k : k + step], k) for k in blocks]
    if order >= 2 and len(points):
        parts.append(_twice(tracer, points))
    receiver, patch, vertices = (np.concatenate(p) for p in zip(*parts, strict=True))
    by_receiver = np.argsort(receiver, kind="stable")
    receiver, patch, vertices = receiver[by_receiver], patch[by_receiver], vertices[by_receiver]
    bounces = (patch >= 0).sum(axis=1)
    each = np.arange(len(receiver))
    last = np.where((bounces > 0)[:, None], vertices[each, np.maximum(bounces - 1, 0)], tracer.transmitter)
    first = np.where((bounces > 0)[:, None], vertices[:, 0], tracer.transmitter)
    length = (
        np.linalg.norm(first - tracer.transmitter, axis=1)
        + np.linalg.norm(last - first, axis=1)
        + np.linalg.norm(points[receiver] - last, axis=1)
    )
    return MirrorChains(receiver, patch, vertices, length, last)


_Part = tuple[np.ndarray, np.ndarray, np.ndarray]


def _line_of_sight(tracer: MirrorTracer, points: np.ndarray) -> _Part:
    seen = np.flatnonzero(tracer.mesh.visible(tracer.transmitter, points, device=tracer.device))
    return seen, np.full((len(seen), 2), -1), np.full((len(seen), 2, 3), np.nan)


def _once(tracer: MirrorTracer, points: np.ndarray, offset: int) -> _Part:
    p = tracer.patches
    below = points @ p.normal.T - p.offset
    receiver, patch = np.nonzero(tracer._height * below > 0)
    hit = _cross_plane(tracer._image[patch], points[receiver], -tracer._height[patch], below[receiver, patch])
    keep = tracer._inside(patch, hit)
    patch, receiver, hit = patch[keep], receiver[keep], hit[keep]
    free = tracer._free(np.stack([np.broadcast_to(tracer.transmitter, hit.shape), hit, points[receiver]]))
    vertices = np.full((int(free.sum()), 2, 3), np.nan)
    vertices[:, 0] = hit[free]
    return receiver[free] + offset, np.column_stack([patch[free], np.full(len(vertices), -1)]), vertices


def _twice(tracer: MirrorTracer, points: np.ndarray) -> _Part:
    p = tracer.patches
    a, b, receiver = _pairs(tracer, points).T
    point = points[receiver]
    height = np.einsum("ni,ni->n", tracer._image[a], p.normal[b]) - p.offset[b]
    image = tracer._image[a] - 2.0 * height[:, None] * p.normal[b]
    below = np.einsum("ni,ni->n", p.normal[b], point) - p.offset[b]
    last = _cross_plane(image, point, -height, below)
    side = np.einsum("ni,ni->n", p.normal[a], last) - p.offset[a]
    start = _cross_plane(tracer._image[a], last, -tracer._height[a], side)
    keep = tracer._inside(b, last) & tracer._inside(a, start)
    a, b, receiver, start, last, point = (x[keep] for x in (a, b, receiver, start, last, point))
    free = tracer._free(np.stack([np.broadcast_to(tracer.transmitter, start.shape), start, last, point]))
    return receiver[free], np.column_stack([a[free], b[free]]), np.stack([start[free], last[free]], axis=1)


def _pairs(tracer: MirrorTracer, points: np.ndarray) -> np.ndarray:
    """Triples (first patch, second patch, receiver) that may hold a double reflection, shape ``(T, 3)``."""
    p = tracer.patches
    lit = np.flatnonzero(tracer._height != 0)
    centre, radius = _balls(tracer)
    leaves = _leaves(points)
    order = np.concatenate(leaves)
    sizes = np.array([len(leaf) for leaf in leaves])
    middle = np.array([points[leaf].mean(axis=0) for leaf in leaves])
    reach = [np.linalg.norm(points[leaf] - m, axis=1).max() for leaf, m in zip(leaves, middle, strict=True)]
    where = _device.resolve(tracer.device)

    def put(array: Any, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(array), dtype=dtype, device=where)

    inputs = [
        put(lit.astype(np.int32), wp.int32),
        put(tracer._image, wp.vec3d),
        put(tracer._height, wp.float64),
        put(p.normal, wp.vec3d),
        put(p.offset, wp.float64),
        put(centre, wp.vec3d),
        put(radius, wp.float64),
        put(points[order], wp.vec3d),
        put(np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32), wp.int32),
        put(middle, wp.vec3d),
        put(np.array(reach) + _SLACK_M, wp.float64),
        wp.float64(_SLACK_M),
    ]
    start = np.zeros(len(lit), dtype=np.int32)
    count = wp.zeros(len(lit), dtype=wp.int32, device=where)
    found = wp.empty((0, 3), dtype=wp.int32, device=where)
    # Once to count, once to write: an index owns what it writes.
    for _ in range(2):
        _device.launch(
            mirror_pairs, len(lit), [*inputs, put(start, wp.int32), count, found], device=tracer.device
        )
        each = count.numpy()
        start = (np.cumsum(each) - each).astype(np.int32)
        if found.shape[0] == 0:
            found = wp.empty((int(each.sum()), 3), dtype=wp.int32, device=where)
    triples = found.numpy().astype(np.int64)
    triples[:, 2] = order[triples[:, 2]]
    return triples


def _balls(tracer: MirrorTracer) -> tuple[np.ndarray, np.ndarray]:
    """A ball around each patch: centre ``(P, 3)`` and radius ``(P,)`` [m]."""
    centre = tracer._boxes.mean(axis=1)
    owner = np.repeat(np.arange(len(centre)), np.diff(tracer.patches.start))
    reach = np.linalg.norm(tracer._corners - centre[owner][:, None], axis=2).max(axis=1, initial=0.0)
    radius = np.zeros(len(centre))
    np.maximum.at(radius, owner, reach)
    return centre, radius + _SLACK_M


def _leaves(points: np.ndarray) -> list[np.ndarray]:
    """Indices of neighbours, at most ``_LEAF`` together, by halving along the longest side."""
    waiting, done = [np.arange(len(points))], []
    while waiting:
        index = waiting.pop()
        if len(index) <= _LEAF:
            done.append(index)
            continue
        axis = int(np.argmax(np.ptp(points[index], axis=0)))
        half = len(index) // 2
        index = index[np.argpartition(points[index, axis], half)]
        waiting += [index[:half], index[half:]]
    return done
