"""Mesh rays: ours beside Embree called with its arrays ready, in rays per second.

Rays go to Open3D's ``RaycastingScene``, which is Embree, in the same float32 form as ours do inside; its time is without
what makes arrays ready and turns hits into distances.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from benchmarks.report import Row
from warprrf.device import Progress, require
from warprrf.geometry.mesh import Mesh
from warprrf.rf.spectra.spectrum import pixel_directions

KINDS = ("panorama", "incoherent", "sight")
"""One origin, neighbours in order; origins and directions at random; segments between points in the bounds."""


def ray_rows(
    meshes: dict[str, Mesh],
    *,
    rays: int,
    repeats: int,
    seed: int = 0,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> list[Row]:
    """A row a mesh and kind of rays: ``rays_per_s`` of Warp's hierarchy and of what the library chooses, and their speed over
    Embree's, ``over_bare``.

    Raises:
        ImportError: without Open3D.
    """
    rng, rows = np.random.default_rng(seed), []
    for name, mesh in meshes.items():
        for kind in KINDS:
            origins, directions = _rays(mesh, kind, rays, rng)
            seconds = best_seconds(_runners(mesh, kind == "sight", origins, directions, device), repeats)
            bare = seconds.pop("embree")
            speeds = {
                k: {"rays_per_s": len(directions) / s, "over_bare": bare / s} for k, s in seconds.items()
            }
            rows.append(
                {"mesh": name, "faces": len(mesh.faces), "kind": kind, "rays": len(directions), **speeds}
            )
            if progress is not None:
                progress("rays", len(rows), len(KINDS) * len(meshes))
    return rows


def best_seconds(runners: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Shortest run of each [s], in turns of an order of their own after one that doesn't count: what a runner leaves of the
    heap, the next one pays for in page faults."""
    best, rng = dict.fromkeys(runners, np.inf), np.random.default_rng(0)
    for turn in range(repeats + 1):
        for name in rng.permutation(list(runners)).tolist():
            start = time.perf_counter()
            runners[name]()
            if turn:
                best[name] = min(best[name], time.perf_counter() - start)
    return best


def bumpy_sphere(triangles: int) -> Mesh:
    """A closed surface of about ``triangles`` faces, 4.5 to 5.5 m about the origin, which sees all of it."""
    k = np.arange(triangles // 2)
    z, azimuth = 1.0 - (2.0 * k + 1.0) / len(k), k * np.pi * (3.0 - np.sqrt(5.0))  # Fibonacci's lattice
    ring = np.sqrt(1.0 - z**2)
    unit = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
    faces = ConvexHull(unit).simplices
    a, b, c = unit[faces].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    radius = 5.0 + 0.5 * np.sin(7 * np.arccos(z)) * np.cos(9 * azimuth)
    return Mesh(radius[:, None] * unit, faces)


def _rays(mesh: Mesh, kind: str, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions; of segments, starts and what leads to their ends."""
    if kind == "panorama":
        height = max(1, int(np.sqrt(count / 2)))
        toward = pixel_directions((height, 2 * height)).reshape(-1, 3)
        return np.broadcast_to(mesh.center + [0.1, 0.2, 0.3], toward.shape).copy(), toward
    if kind == "incoherent":
        return mesh.center + rng.uniform(-1.0, 1.0, (count, 3)), rng.standard_normal((count, 3))
    a, b = rng.uniform(mesh.bounds[0], mesh.bounds[1], (2, count, 3))
    return a, b - a


def _runners(
    mesh: Mesh, sight: bool, origins: np.ndarray, directions: np.ndarray, device: Any
) -> dict[str, Callable[[], Any]]:
    o3d = require("open3d", extra="photos")
    scene = o3d.t.geometry.RaycastingScene()
    vertices = (mesh.vertices - mesh.center).astype(np.float32)
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    toward = directions if sight else directions / np.linalg.norm(directions, axis=1, keepdims=True)
    ready = o3d.core.Tensor(np.concatenate([origins - mesh.center, toward], axis=1).astype(np.float32))

    def ours(backend: str) -> Callable[[], Any]:
        if sight:
            return lambda: mesh.visible(origins, origins + directions, device=device, backend=backend)
        return lambda: mesh.cast(origins, directions, device=device, backend=backend)

    def embree() -> Any:
        return (scene.test_occlusions(ready, 0.0, 1.0) if sight else scene.cast_rays(ready)["t_hit"]).numpy()

    return {"warp": ours("warp"), "chosen": ours("auto"), "embree": embree}
