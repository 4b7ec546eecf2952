"""A second CPU device that the library takes for a GPU, so that its branches for one run where there is none.

An array made on the wrong one of the two shows, as Warp refuses to launch with it (see `conftest.py`). It says nothing
about speed, races, float atomics or kernels that work by blocks of threads: those take a card.
"""

import sys
from contextlib import contextmanager
from copy import copy
from functools import cache
from types import SimpleNamespace
from unittest import mock

import warp as wp
from warp._src import context

from warprrf import device

NAME = "cuda:0"
TAKE_IT_FOR_A_GPU = ("warprrf", "benchmarks")


@cache
def _twin():
    """The CPU's device under another name: one for good, as a scene keeps what lies on it from test to test."""
    device.start()
    twin = copy(wp.get_device("cpu"))
    twin.alias = NAME
    return twin


@contextmanager
def second_device():
    """The device is there, as `NAME`, and is the one that "cuda" means."""
    second = _twin()
    is_cuda, load, copy_array = context.Device.is_cuda.fget, device.load_module, wp.copy

    def taken_for_a_gpu(self):
        asking = sys._getframe(1).f_globals["__name__"].split(".")[0]
        return (self is second and asking in TAKE_IT_FOR_A_GPU) or is_cuda(self)

    def same(self, other):  # Warp's own compares CUDA contexts, and neither has one
        return self is other or self.alias == other

    def copied(dest, src, *args, stream=None, **kwargs):  # Warp asks the stream whether it is recorded
        return copy_array(dest, src, *args, stream=stream or SimpleNamespace(is_capturing=False), **kwargs)

    with (
        mock.patch.dict(context.runtime.device_map, {NAME: second, "cuda": second}),
        mock.patch.object(context.Device, "is_cuda", property(taken_for_a_gpu)),
        mock.patch.object(context.Device, "__eq__", same),
        mock.patch.object(wp, "copy", copied),
        # A CPU's blocks have one thread.
        mock.patch.object(device, "load_module", lambda module, where, block_dim: load(module, where, 1)),
    ):
        yield
