"""What is computed on first use and kept: bounded, and safe to ask for from several threads and after a fork.

All first uses share two locks, and a fork waits for both: no child starts with a thing half made, or with a lock whose
owner does not live there. What is kept already is handed out without them.
"""

from __future__ import annotations

import functools
import os
from collections import OrderedDict
from collections.abc import Callable, Hashable
from contextlib import suppress
from threading import RLock
from typing import Any, ParamSpec, Self, TypeVar, overload

P = ParamSpec("P")
T = TypeVar("T")

making = RLock()
"""Held while something is made at its first use."""
loading = RLock()
"""Held while Warp starts or loads kernels. Who holds :data:`making` may wait for it, never the other way round."""


def _wait() -> None:
    making.acquire()
    loading.acquire()


def _go_on() -> None:
    loading.release()
    making.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_wait, after_in_parent=_go_on, after_in_child=_go_on)


def once(build: Callable[P, T]) -> Callable[P, T]:
    """As ``functools.cache``, for what starts Warp or makes kernels: by one thread, while none loads kernels."""
    kept = functools.cache(build)

    @functools.wraps(build)
    def locked(*args: P.args, **kwargs: P.kwargs) -> T:
        with loading:
            return kept(*args, **kwargs)  # type: ignore[arg-type]

    return locked


class cached_property(functools.cached_property[T]):  # as functools names it
    """An attribute that is computed when first asked for, by one thread while others wait for it.

    That of ``functools`` has a lock for each class in Python 3.11, which stays locked in a child that is forked while
    another thread holds it, and none from 3.12 on.
    """

    @overload
    def __get__(self, instance: None, owner: type[Any] | None = None) -> Self: ...
    @overload
    def __get__(self, instance: object, owner: type[Any] | None = None) -> T: ...
    def __get__(self, instance: object | None, owner: type[Any] | None = None) -> Self | T:
        if instance is None:
            return self
        with making:
            return super().__get__(instance, owner)


class Cache:
    """The ``size`` results used last, by key. A result is made once, while other threads wait for it.

    Copies and pickles are empty: whatever is kept can be made again.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._kept: OrderedDict[Hashable, object] = OrderedDict()

    def __reduce__(self) -> tuple[type[Cache], tuple[int]]:
        return Cache, (self.size,)

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """What is kept under ``key``, else what ``make`` returns, which is kept from now on."""
        with suppress(KeyError):  # another thread may throw it out between the two
            self._kept.move_to_end(key)
            return self._kept[key]  # type: ignore[return-value]
        with making:
            if key not in self._kept:
                made = make()
                self._kept[key] = made
                while len(self._kept) > self.size:
                    self._kept.popitem(last=False)
                return made
            return self._kept[key]  # type: ignore[return-value]
