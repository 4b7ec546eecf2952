"""Memory for rays on a CPU, kept from call to call: new pages cost more than what is written to them.

Rows of three numbers begin on a boundary of 64 bytes, as :mod:`warprrf.kernels.rays.ray_lanes` writes them past the cache. A
thread keeps room for the packed rays of its largest call and for the copies of four sets of origins or directions, of
at most :data:`ROWS_KEPT` rows each: 24 bytes a row.
"""

from __future__ import annotations

from collections import deque
from threading import local
from typing import Any

import numpy as np
import warp as wp

ROWS_KEPT = 1_048_576
"""Longer copies are not kept for the next ones."""

# Below this many rows memory comes from the allocator's own store, and is warm.
_FEW = 2_000
# The copies of a hit's rays, and those of a hit made before it that is still held.
_COPIES = 4


class _Kept(local):
    def __init__(self) -> None:
        self.packed = np.empty((0, 3), dtype=np.float32)
        self.copies: deque[np.ndarray] = deque(maxlen=_COPIES)


_kept = _Kept()


class _Lease:
    """What an array on kept room has for its base: once no array is left, the room may be used again."""

    def __init__(self, room: np.ndarray, count: int, owner: deque[np.ndarray]) -> None:
        self._room = room
        self._owner = owner
        self.__array_interface__ = room[:count].__array_interface__

    def __del__(self) -> None:
        self._owner.append(self._room)


def aligned_rows(count: int, dtype: Any) -> np.ndarray:
    """New room for ``count`` rows, shape ``(count, 3)``, on a boundary of 64 bytes."""
    size = 3 * count * np.dtype(dtype).itemsize
    room = np.empty(size + 64, dtype=np.uint8)
    skip = -room.ctypes.data % 64
    return room[skip : skip + size].view(dtype).reshape(count, 3)


def room_for_packed(count: int) -> wp.array:
    """Room for at least ``count`` packed rays, two rows each, float32: the same at each call in a thread."""
    if len(_kept.packed) < 2 * count:
        _kept.packed = aligned_rows(2 * count, np.float32)
    return wp.array(_kept.packed, dtype=wp.vec3, device="cpu", copy=False)


def room_for_copy(rays: np.ndarray) -> np.ndarray:
    """Room for a copy of ``rays`` (N, 3), float64: that of an earlier copy that nobody holds any more, if there is one.

    A row less than needed and the earlier room is given up.
    """
    count = len(rays)
    if not _FEW <= count <= ROWS_KEPT:
        return aligned_rows(count, np.float64)
    room = np.empty((0, 3))
    while _kept.copies and len(room) < count:
        room = _kept.copies.pop()
    if len(room) < count:
        room = aligned_rows(count, np.float64)
    return np.asarray(_Lease(room, count, _kept.copies))
