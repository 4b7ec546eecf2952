"""What is computed on first use and kept: bounded, and safe to ask for from several threads."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import RLock
from typing import TypeVar

T = TypeVar("T")


class Cache:
    """The ``size`` results used last, by key. A result is made once, while other threads wait for it.

    Copies and pickles are empty: whatever is kept can be made again.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._kept: OrderedDict[Hashable, object] = OrderedDict()
        self._lock = RLock()

    def __reduce__(self) -> tuple[type[Cache], tuple[int]]:
        return Cache, (self.size,)

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """What is kept under ``key``, else what ``make`` returns, which is kept from now on."""
        with self._lock:
            if key not in self._kept:
                self._kept[key] = make()
            self._kept.move_to_end(key)
            while len(self._kept) > self.size:
                self._kept.popitem(last=False)
            return self._kept[key]  # type: ignore[return-value]
