"""Memory that is kept for rays: never given out twice at a time, and on the boundary that kernels rely on."""

from threading import Thread

import numpy as np
import pytest

from warprrf.geometry import ray_room
from warprrf.geometry.ray_room import ROWS_KEPT, aligned_rows, room_for_copy, room_for_packed


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch):
    monkeypatch.setattr(ray_room, "_kept", ray_room._Kept())


def address(array):
    return array.__array_interface__["data"][0]


@pytest.mark.parametrize("count", [0, 1, 1_999, 2_000, 30_001])
def test_rows_begin_on_a_line_of_the_cache(count):
    rays = np.zeros((count, 3))
    for room in (aligned_rows(count, np.float64), room_for_copy(rays), room_for_copy(rays[::-1])):
        assert room.shape == (count, 3) and room.dtype == np.float64 and room.flags.writeable
        assert count == 0 or address(room) % 64 == 0
    assert count == 0 or address(room_for_packed(count).numpy()) % 64 == 0


def test_room_is_used_again_once_the_last_array_on_it_is_gone():
    rays = np.zeros((5_000, 3))
    first = room_for_copy(rays)
    place, part = address(first), first[100:, 1]
    del first
    second = room_for_copy(rays)
    assert not np.shares_memory(part, second)
    del part
    assert address(room_for_copy(rays)) == place  # used again at once, and given back
    del second
    shorter = room_for_copy(rays[:3_000])
    assert shorter.shape == (3_000, 3)
    longer = room_for_copy(np.zeros((6_000, 3)))
    assert longer.shape == (6_000, 3) and not np.shares_memory(shorter, longer)


def test_little_is_kept_and_nothing_that_is_long():
    held = [room_for_copy(np.zeros((2_000, 3))) for _ in range(10)]
    held.append(room_for_copy(np.empty((ROWS_KEPT + 1, 3))))
    held.clear()
    assert [len(room) for room in ray_room._kept.copies] == [2_000] * 4


def test_threads_do_not_share_packed_rays():
    mine, others = room_for_packed(4_000), []
    thread = Thread(target=lambda: others.append(room_for_packed(4_000)))
    thread.start()
    thread.join()
    assert not np.shares_memory(mine.numpy(), others[0].numpy())
    assert address(room_for_packed(3_000).numpy()) == address(mine.numpy())
