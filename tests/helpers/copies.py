"""Bytes that go to a device and come back, counted where NumPy's arrays become Warp's and Warp's NumPy's."""

from collections import Counter
from contextlib import contextmanager
from unittest import mock

import warp as wp


@contextmanager
def counted_copies(device):
    """How many bytes went ``up`` to a device and came ``down`` from it so far, and how many copies that took."""
    counted = Counter()
    make, read, assign = wp.array.__init__, wp.array.numpy, wp.array.assign

    def count(way, array):
        if str(array.device) == device:
            counted[way] += array.size * wp.types.type_size_in_bytes(array.dtype)
            counted[f"{way}, copies"] += 1

    def made(self, data=None, *args, **kwargs):
        make(self, data, *args, **kwargs)
        if data is not None and not isinstance(data, wp.array):
            count("up", self)

    def read_back(self):
        count("down", self)
        return read(self)

    def assigned(self, src):
        if not isinstance(src, wp.array):
            count("up", self)
        return assign(self, src)

    with (
        mock.patch.object(wp.array, "__init__", made),
        mock.patch.object(wp.array, "numpy", read_back),
        mock.patch.object(wp.array, "assign", assigned),
    ):
        yield counted
