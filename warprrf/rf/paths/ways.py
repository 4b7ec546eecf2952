"""Ways over mirrors as the image method has them, leg by leg: what stands on each leg, and what slabs it passes.

A leg begins and ends off the mirrors by a small length, so that their own faces are not met.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from warprrf.device import DeviceLike
from warprrf.geometry.mesh import ENDPOINT_CLEARANCE, headings
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.rf.paths.slabs import Slabs, Walls
from warprrf.rows import Rows


@dataclass(frozen=True)
class Ways(Rows):
    """L ways from a transmitter over K mirrors each.

    Attributes:
        row: Index of the point that each leads to, shape ``(L,)``.
        patch: Patches that mirror, from the transmitter on, shape ``(L, K)``.
        stops: Transmitter, mirror points and end [m], shape ``(L, K + 2, 3)``.
        slab: Faces by which slabs are entered on each leg, -1 past the last, shape ``(L, K + 1, S)``.
        thickness_m: Of a slab that is a solid, else NaN [m], shape ``(L, K + 1, S)``.
        patches: All that mirror.
    """

    row: np.ndarray
    patch: np.ndarray
    stops: np.ndarray
    slab: np.ndarray
    thickness_m: np.ndarray
    patches: PlanarPatches

    @classmethod
    def of(cls, patches: PlanarPatches, row: np.ndarray, patch: np.ndarray, stops: np.ndarray) -> Self:
        """Those of which no slabs are known."""
        none = np.zeros((len(row), patch.shape[1] + 1, 0))
        return cls(row, patch, stops, none.astype(np.int32), none, patches)

    @property
    def point(self) -> np.ndarray:
        """Mirror points [m], shape ``(L, K, 3)``."""
        return self.stops[:, 1:-1]

    def over(self, place: slice | int, stops: np.ndarray) -> Self:
        """The same with other ``stops`` [m] in one ``place`` or several."""
        moved = self.stops.copy()
        moved[:, place] = stops
        return replace(self, stops=moved)

    def legs(self, lift_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Starts and ends of the legs [m], off their mirrors by ``lift_m``, shape ``(L, K + 1, 3)`` each."""
        begin, end = self.stops[:, :-1].copy(), self.stops[:, 1:].copy()
        for k in range(self.patch.shape[1]):
            normal, offset = self.patches.normal[self.patch[:, k]], self.patches.offset[self.patch[:, k]]
            for place, leg, other in ((end, k, k), (begin, k + 1, k + 2)):
                side = np.sign((self.stops[:, other] * normal).sum(axis=1) - offset)
                place[:, leg] += (lift_m * side)[:, None] * normal
        return begin, end

    def unobstructed(self, device: DeviceLike, beyond_m: float = 0.0) -> np.ndarray:
        """Whether every leg of each is free, shape ``(L,)``.

        A leg is also drawn out by the clearance that :meth:`Mesh.visible` leaves at ends, so that whatever lies further off than
        the tolerance is met; and by ``beyond_m`` [m], so that what stands on a mirror where the way meets it is.
        """
        begin, end = self.legs(self.patches.tolerance_m)
        toward = headings(end - begin)[0]
        begin[:, 1:] -= (ENDPOINT_CLEARANCE + beyond_m) * toward[:, 1:]
        end[:, :-1] += (ENDPOINT_CLEARANCE + beyond_m) * toward[:, :-1]
        free = np.ones(len(self), bool)
        for k in range(begin.shape[1]):
            own = np.flatnonzero(free)
            if len(own):
                free[own] = self.patches.mesh.visible(begin[own, k], end[own, k], device=device)
        return free

    def through(self, walls: Walls) -> tuple[np.ndarray, Self]:
        """Which of them arrive through slabs, and those, with what each passes."""
        rows, slab, thickness_m = passed(walls, *self.legs(walls.clearance_m))
        return rows, replace(self.take(rows), slab=slab, thickness_m=thickness_m)


def passed(walls: Walls, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which ways arrive through slabs, at most as many as ``walls`` allow, and :attr:`Ways.slab` and :attr:`Ways.thickness_m` of
    those; of legs from ``begin`` to ``end`` (L, K + 1, 3)."""
    rows, legs = np.arange(len(begin)), list[Slabs]()
    for k in range(begin.shape[1]):
        arrived, slabs = walls.between(begin[rows, k], end[rows, k])
        rows, legs = rows[arrived], [*(leg.take(arrived) for leg in legs), slabs]
    slab, thickness_m = (np.stack([getattr(leg, n) for leg in legs], axis=1) for n in ("face", "thickness_m"))
    count = (slab >= 0).sum(axis=(1, 2))
    few = np.flatnonzero((count > 0) & (count <= walls.most))
    return rows[few], slab[few], thickness_m[few]


def distinct(row: np.ndarray, point: np.ndarray, distance_m: float) -> np.ndarray:
    """Indices of paths that no earlier one of the same receiver repeats, all points within ``distance_m``, sorted."""
    if point.shape[1] == 0 or len(row) < 2:
        return np.arange(len(row))
    # Other receivers' points are further away than any of its own that count.
    place = np.column_stack([3.0 * distance_m * row, point[:, 0]])
    a, b = cKDTree(place).query_pairs(distance_m, output_type="ndarray").T
    same = np.zeros(len(row), bool)
    same[b[(np.linalg.norm(point[a] - point[b], axis=2) <= distance_m).all(axis=1)]] = True
    return np.flatnonzero(~same)


def stops_of(source: np.ndarray, point: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Transmitter (3,) or (L, 3), mirror points and receiver of each path, shape ``(L, k + 2, 3)``."""
    return np.concatenate([np.broadcast_to(source, ends.shape)[:, None], point, ends[:, None]], axis=1)
