"""How Warp is started and where it keeps compiled kernels: without a word where there is no GPU, and on any machine.

Warp announces on standard error that there is no CUDA driver, from its C library, whatever its log level; and it fails
where its cache of kernels (``WARP_CACHE_PATH``, a folder below the home folder by default) cannot be written.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from warprrf.cache import once

_NO_CUDA = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver"

_temporary: list[tempfile.TemporaryDirectory[str]] = []  # removed when the process ends


@once
def start() -> None:
    """Start Warp; a CPU is all it needs.

    Raises:
        OSError: if neither its cache nor a temporary folder can be written.
    """
    with _without_cuda_warning():
        try:
            wp.init()
        except OSError as error:
            _use_temporary_cache(error)
            wp.init()


def load(module: wp.Module, device: wp.Device, block_dim: int) -> None:
    """Load a module of kernels, which is compiled if the cache lacks it."""
    try:
        module.load(device, block_dim=block_dim)
    except OSError as error:
        _use_temporary_cache(error)
        module.load(device, block_dim=block_dim)


def _use_temporary_cache(error: OSError) -> None:
    """Keep kernels in a temporary folder from now on, because of ``error``."""
    folder = tempfile.TemporaryDirectory(prefix="warprrf-kernels-")
    _temporary.append(folder)
    warnings.warn(
        f"kernel cache: {error}; kernels are compiled anew by this process, into {folder.name}. Set WARP_CACHE_PATH to "
        "a folder that can be written",
        UserWarning,
        stacklevel=2,
    )
    wp.config.kernel_cache_dir = folder.name


@contextmanager
def _without_cuda_warning() -> Iterator[None]:
    """Hold standard error back, and give it out without the line about a missing CUDA driver."""
    try:
        held, shown = tempfile.TemporaryFile(), os.dup(2)
    except OSError:  # no temporary folder, or no standard error
        yield
        return
    with held:
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(shown, 2)
            os.close(shown)
            held.seek(0)
            for line in held:
                if not line.startswith(_NO_CUDA):
                    os.write(2, line)
