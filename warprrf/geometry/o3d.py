"""Open3D, which stage 1 and Embree's rays use: the one place that imports it, when first called."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from types import ModuleType

from warprrf.device import require


def load() -> ModuleType:
    """The package.

    Raises:
        ImportError: naming the extra that brings it, if it is not installed.
    """
    return require("open3d", extra="photos")


@cache
def installed() -> bool:
    """Whether it can be imported here; it is not imported to find out."""
    return importlib.util.find_spec("open3d") is not None


def loaded() -> bool:
    """Whether this process has imported it already."""
    return "open3d" in sys.modules
