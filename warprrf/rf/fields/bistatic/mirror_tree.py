"""Which patches of a surface can reflect a transmitter one after the other, and where: images of images, pruned.

An image of the transmitter shines through its patch as through a window. A further patch can follow only if the cone
from the image through the window's bounding ball meets its own: small patches far apart drop out, and what is left of
the P^k chains of a room is few enough to try for every receiver.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.kernels.radio.mirrors import Chains, find_chains, unfold_chains
from warprrf.rf.fields.bistatic.surface import Surface

SLACK_M = 0.1  # boxes of patches are widened by it: outlines of a reconstructed mesh are torn


@dataclass(frozen=True)
class Level:
    """All chains of k reflections.

    Attributes:
        patch: patches in the order in which the wave meets them, shape ``(C, k)``.
        parent: the chain of the level before that each continues, shape ``(C,)``.
        image: image of the transmitter in the last patch, shape ``(C, 3)``.
        depth: height of the image before over the last patch's plane [m], shape ``(C,)``, positive.
    """

    patch: np.ndarray
    parent: np.ndarray
    image: np.ndarray
    depth: np.ndarray


class MirrorTree:
    """Chains of up to ``order`` mirror reflections of a transmitter on the patches of a surface.

    Args:
        surface: its patches.
        transmitter: position (3,) [m].
        order: most reflections.
    """

    def __init__(self, surface: Surface, transmitter: np.ndarray, order: int) -> None:
        self.surface = surface
        self.transmitter = np.asarray(transmitter, float)
        self.normal, self.offset = surface.plane_normal, surface.plane_offset
        self.low, self.high = surface.patch_boxes
        self.middle = 0.5 * (self.low + self.high)
        self.radius = 0.5 * np.linalg.norm(self.high - self.low, axis=1) + SLACK_M
        corner = np.array(np.meshgrid(*[[0.0, 1.0]] * 3)).reshape(3, -1).T
        boxes = self.low[:, None] + corner * (self.high - self.low)[:, None]
        reach = np.einsum("bck,ak->abc", boxes, self.normal) - self.offset[:, None, None]
        before = reach.max(axis=2) > 0.0
        self._mutual = before & before.T
        self._uploaded: dict[str, Any] = {}
        self.levels: list[Level] = []
        for k in range(min(order, len(self.offset)) if len(self.offset) else 0):
            self.levels.append(self._next(self.levels[-1]) if k else self._first())

    @property
    def order(self) -> int:
        """Most reflections."""
        return len(self.levels)

    def _first(self) -> Level:
        height = self.normal @ self.transmitter - self.offset
        p = np.flatnonzero(height > 0)
        image = self.transmitter - 2.0 * height[p, None] * self.normal[p]
        return Level(p[:, None], np.full(len(p), -1), image, height[p])

    def _next(self, last: Level) -> Level:
        a = last.patch[:, -1]
        height = last.image @ self.normal.T - self.offset
        chain, b = np.nonzero((height > 0) & self._mutual[a])
        # the cone from the image through the window's ball must meet the next ball
        to_window = self.middle[a[chain]] - last.image[chain]
        to_next = self.middle[b] - last.image[chain]
        far, further = np.linalg.norm(to_window, axis=1), np.linalg.norm(to_next, axis=1)
        window = _angular_radius(self.radius[a[chain]], far)
        own = _angular_radius(self.radius[b], further)
        cosine = (to_window * to_next).sum(axis=1) / np.maximum(far * further, 1e-12)
        keep = np.arccos(np.clip(cosine, -1.0, 1.0)) <= window + own
        keep &= further + self.radius[b] >= far - self.radius[a[chain]]
        chain, b = chain[keep], b[keep]
        depth = height[chain, b]
        image = last.image[chain] - 2.0 * depth[:, None] * self.normal[b]
        return Level(np.column_stack([last.patch[chain], b]), chain, image, depth)

    def candidates(
        self,
        points: np.ndarray,
        order: int,
        *,
        chains: np.ndarray | None = None,
        rows: np.ndarray | None = None,
        device: Any = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Chains of ``order`` reflections whose points lie in the boxes of their patches; nothing is cast.

        Args:
            points: where the chains end (N, 3).
            order: reflections.
            chains, rows: pairs of a chain and a point to try; all by default.
            device: where all are tried.

        Returns:
            Index of the point and of the chain, shape ``(L,)`` each, and interaction points from the transmitter on,
            shape ``(L, order, 3)``.
        """
        where = _device.resolve(device)
        first = sum(len(level.depth) for level in self.levels[: order - 1])
        ends = wp.array(points, dtype=wp.vec3d, device=where)
        if chains is None or rows is None:
            count = len(self.levels[order - 1].depth)
            words = wp.zeros((len(points), -(-count // 32)), dtype=wp.uint32, device=where)
            inputs = [self._on_device(where), first, first + count, ends, words]
            _device.launch(find_chains, words.size, inputs, device=where)
            octets = words.numpy().astype("<u4", copy=False).view(np.uint8)
            rows, chains = np.nonzero(np.unpackbits(octets, axis=1, bitorder="little"))
        found = wp.zeros((len(rows), order), dtype=wp.vec3d, device=where)
        inside = wp.zeros(len(rows), dtype=wp.bool, device=where)
        pairs = [wp.array(index, dtype=wp.int32, device=where) for index in (rows, first + chains)]
        _device.launch(
            unfold_chains, len(rows), [self._on_device(where), ends, *pairs, found, inside], device=where
        )
        kept = np.flatnonzero(inside.numpy())
        return rows[kept], chains[kept], found.numpy()[kept]

    def _on_device(self, where: Any) -> Any:
        """The kernels' view of all chains, level after level."""
        key = str(where)
        if key not in self._uploaded:
            shift = np.cumsum([0, *(len(level.depth) for level in self.levels)])
            parent = [
                np.where(level.parent < 0, -1, level.parent + shift[max(k - 1, 0)])
                for k, level in enumerate(self.levels)
            ]
            chains = Chains()
            chains.patch = wp.array(
                np.concatenate([level.patch[:, -1] for level in self.levels]), dtype=wp.int32, device=where
            )
            chains.parent = wp.array(np.concatenate(parent), dtype=wp.int32, device=where)
            chains.image = wp.array(
                np.concatenate([level.image for level in self.levels]), dtype=wp.vec3d, device=where
            )
            chains.depth = wp.array(
                np.concatenate([level.depth for level in self.levels]), dtype=wp.float64, device=where
            )
            chains.normal = wp.array(self.normal, dtype=wp.vec3d, device=where)
            chains.plane_offset = wp.array(self.offset, dtype=wp.float64, device=where)
            half = 0.5 * (self.high - self.low) + SLACK_M
            chains.middle = wp.array(self.middle, dtype=wp.vec3d, device=where)
            chains.half = wp.array(half, dtype=wp.vec3d, device=where)
            self._uploaded[key] = chains
        return self._uploaded[key]


def _angular_radius(radius: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Angle under which a ball is seen [rad]; pi from inside."""
    return np.where(
        distance > radius, np.arcsin(np.clip(radius / np.maximum(distance, 1e-12), 0.0, 1.0)), np.pi
    )
