"""What figures were measured on: processor, cores, system, versions."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path
from typing import Any

from warprrf.device import resolve, threads

PACKAGES = (
    "warprrf",
    "warp-lang",
    "numpy",
    "pycolmap",
    "open3d",
    "xarray",
    "h5netcdf",
    "safetensors",
    "torch",
    "gsplat",
    "sionna-rt",
    "distributed",
)


def processor_name() -> str:
    """The processor's name."""
    processor = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        names = [
            line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")
        ]
        processor = names[0].split(":", 1)[1].strip() if names else processor
    return processor


def machine(device: Any = None) -> dict[str, Any]:
    """What the figures were measured on: processor, cores, system, versions."""
    processor, on = processor_name(), resolve(device)
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "processor": processor,
        "cores": threads(),
        "device": f"{on} ({on.name})" if on.is_cuda else str(on),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": versions,
    }
