"""What figures were measured with: the code and what it computes, processor, cores, versions; the workers of a cluster, and
the memory that a run took."""

from __future__ import annotations

import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import warp as wp

from warprrf.device import require, resolve, threads
from warprrf.steps import digest

PACKAGES = (
    "warprrf",
    "warp-lang",
    "numpy",
    "pycolmap",
    "open3d",
    "h5netcdf",
    "safetensors",
    "torch",
    "gsplat",
    "sionna-rt",
    "distributed",
)

VERSIONS = {
    "geometry": 8,
    "renderer": 1,
    "metrics": 1,
    "exact": 2,
    "sionna": 1,
    "bistatic": 15,
    "harmonic": 1,
    "lookups": 1,
    "networks": 1,
}
"""Count one up when the library or a baseline computes something else there: results of before are then stale. The figures
of a method depend on its own number and that of the metrics, other result files on what :data:`DEPENDS` names."""
DEPENDS = {
    "arrays": ("bistatic",),
    "bare_mesh": ("bistatic",),
    "beams": ("geometry", "exact", "bistatic"),
    "bistatic": ("geometry", "bistatic"),
    "edited": ("exact", "bistatic"),
    "engine": ("renderer",),
    "filmed": ("geometry", "bistatic"),
    "gpu": ("renderer",),
    "lobby": ("geometry", "bistatic", "harmonic"),
    "lobby_seeds": ("geometry", "bistatic", "harmonic"),
    "locate": ("bistatic",),
    "map": ("geometry", "bistatic"),
    "measured_flat": ("bistatic",),
    "measured_hall": ("bistatic",),
    "measured_office": ("bistatic",),
    "measurements": ("geometry", "bistatic"),
    "office": ("bistatic",),
    "outside": ("bistatic",),
    "relevance": ("exact", "bistatic"),
    "suggest": ("geometry", "bistatic"),
    "truths": ("exact",),
}
"""What the figures of a file in ``benchmarks/results`` depend on. Those of ``paper.json`` say it run by run; others hold facts, or
are settled."""
HERE = Path(__file__).parent


def processor_name() -> str:
    """The processor's name."""
    processor = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").is_file():
        names = [
            line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")
        ]
        processor = names[0].split(":", 1)[1].strip() if names else processor
    return processor


def commit() -> str | None:
    """Version of the code, with a plus where files differ from it; None outside a repository."""
    asked = [
        "git",
        "-C",
        str(HERE),
        "describe",
        "--always",
        "--abbrev=12",
        "--exclude=*",
        "--dirty=+",
    ]
    try:
        return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def machine(device: Any = None) -> dict[str, Any]:
    """What figures were measured with: commit, hashes and :data:`VERSIONS` of the code, processor, cores, system, packages."""
    processor, on = processor_name(), resolve(device)
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "commit": commit(),
        "code": {
            folder.name: digest(*sorted(folder.rglob("*.py")))[:12]
            for folder in (HERE.parent / "warprrf", HERE)
        },
        "computes": VERSIONS,
        "processor": processor,
        "cores": threads(),
        "device": f"{on} ({on.name})" if on.is_cuda else str(on),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": versions,
    }


@contextmanager
def connected(scheduler: str | None, workers: int, share: int | None = None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a local cluster of processes with ``share`` threads each, equal parts
    of the cores by default; None for no workers.

    Raises:
        ImportError: without dask.distributed, where it is needed.
    """
    if scheduler is None and workers == 0:
        yield None
        return
    distributed = require("distributed", extra="cluster")
    if scheduler is not None:
        with distributed.Client(scheduler, set_as_default=False) as client:
            yield client
        return
    threads_each = str(share or max(1, (os.cpu_count() or 1) // workers))
    with (
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,  # a part may need what the machine has: no worker is stopped for it
            dashboard_address=None,
            env={"WARPRRF_THREADS": threads_each, "OMP_NUM_THREADS": threads_each},
            silence_logs="CRITICAL",
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def peak_memory(device: Any = None) -> Iterator[dict[str, Any]]:
    """Fills what it yields with the process's largest resident memory inside the block, and the GPU's where one works.

    ``peak_memory_bytes`` is of the whole process, what was loaded before included. Where the kernel does not let the
    mark be reset it is that of the process's life.
    """
    found: dict[str, Any] = {}
    reset_mark = Path("/proc/self/clear_refs")
    try:
        reset_mark.write_text("5")  # resets VmHWM, man 5 proc
    except OSError:
        found["peak_memory_of_life"] = True
    where = resolve(device)
    torch = sys.modules.get("torch") if where.is_cuda else None
    if torch is not None:
        torch.cuda.reset_peak_memory_stats()
    yield found
    found["peak_memory_bytes"] = _high_water_mark()
    if where.is_cuda:
        torch = sys.modules.get("torch")
        warp_bytes = wp.get_mempool_used_mem_high(where)
        found["peak_gpu_bytes"] = int(warp_bytes) + (
            int(torch.cuda.max_memory_allocated()) if torch is not None else 0
        )


def _high_water_mark() -> int:
    status = Path("/proc/self/status")
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
