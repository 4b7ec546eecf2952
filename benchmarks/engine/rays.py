"""Mesh rays per second: Warp's hierarchy and what ``Mesh`` chooses, against Embree called bare.

Two yardsticks, both Embree through Open3D on the same threads: ``embree bare`` gets rays that are already packed in
float32 and returns float32 distances; ``embree from arrays`` starts, as :meth:`Mesh.cast` does, from float64 origins
and directions of any length, packs them in NumPy, and takes the distances in float64 from the faces' planes. Sight is
compared with Embree's search for any hit. All of one row are run in turn in one process, and the best of the repeats
counts, by processor time on a CPU, which other work on the machine disturbs less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from benchmarks.report import Row
from warprrf.device import Progress, require, resolve, threads
from warprrf.geometry.mesh import Mesh
from warprrf.rf.spectra.spectrum import pixel_directions

KINDS = ("panorama", "incoherent", "sight")


def ray_rows(
    meshes: dict[str, Mesh], *, rays: int = 1_000_000, repeats: int = 5, seed: int = 0, device: Any = "cpu",
    progress: Progress | None = None,
) -> list[Row]:  # fmt: skip
    """Rays per second on each mesh.

    Returns:
        One row a mesh and kind of rays (``panorama``: one origin, neighbours in order; ``incoherent``: origins and
        directions at random; ``sight``: segments between points in the bounds, for ``Mesh.visible``):
        ``mesh, faces, kind, rays, threads, device``, and for each runner ``rays_per_s`` and, over both yardsticks,
        ``over_bare`` and ``over_arrays``; ``t_difference_m``, the largest between Warp and the second yardstick.

    Raises:
        ValueError: if ``rays`` or ``repeats`` is below 1.
        ImportError: without Open3D.
    """
    for name, value in (("rays", rays), ("repeats", repeats)):
        if value < 1:
            raise ValueError(f"{name}: got {value}, expected at least 1")
    on, rng = resolve(device), np.random.default_rng(seed)
    rows = []
    for name, mesh in meshes.items():
        for kind in KINDS:
            origins, directions = _rays(mesh, kind, rays, rng)
            runners = _runners(mesh, kind == "sight", origins, directions, on)
            warp, other = runners["warp"](), runners["embree from arrays"]()
            known = np.isfinite(warp) & np.isfinite(other)
            row = {
                "mesh": name, "faces": len(mesh.faces), "kind": kind, "rays": len(directions), "threads": threads(),
                "device": str(on), "other_hits": float((np.isfinite(warp) != np.isfinite(other)).mean()),
                "t_difference_m": float(np.abs(warp[known] - other[known]).max(initial=0.0)),
            }  # fmt: skip
            rows.append({**row, **_speeds(runners, len(directions), repeats, on.is_cpu)})
            if progress is not None:
                progress("rays", len(rows), len(KINDS) * len(meshes))
    return rows


def bumpy_sphere(triangles: int) -> Mesh:
    """A closed surface of about ``triangles`` faces, 4.5 to 5.5 m about the origin, which sees all of it.

    Raises:
        ValueError: below 100 faces.
    """
    if triangles < 100:
        raise ValueError(f"triangles: got {triangles}, expected at least 100")
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
) -> dict[str, Callable[[], np.ndarray]]:
    """Distances of rays [m], or 0 where a segment is blocked and inf where not, by name of who finds them."""
    o3d = require("open3d", extra="photos")
    scene = o3d.t.geometry.RaycastingScene()
    vertices = (mesh.vertices - mesh.center).astype(np.float32)
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    ends = origins + directions
    corner, normal = mesh.triangles[:, 0], mesh.face_normals

    def pack(toward: np.ndarray) -> Any:
        return o3d.core.Tensor(np.concatenate([origins - mesh.center, toward], axis=1).astype(np.float32))

    def unit() -> np.ndarray:
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))

    def occluded(packed: Any) -> np.ndarray:
        return np.where(scene.test_occlusions(packed, 0.0, 1.0).numpy(), 0.0, np.inf)

    def from_arrays() -> np.ndarray:
        if sight:
            return occluded(pack(directions))
        toward = unit()
        found = scene.cast_rays(pack(toward))["primitive_ids"].numpy()
        met = found != o3d.t.geometry.RaycastingScene.INVALID_ID
        face = found[met]
        t = np.full(len(toward), np.inf)
        across = ((corner[face] - origins[met]) * normal[face]).sum(axis=1)
        t[met] = across / (toward[met] * normal[face]).sum(axis=1)
        return t

    def ours(backend: str) -> Callable[[], np.ndarray]:
        if sight:
            return lambda: np.where(mesh.visible(origins, ends, device=device, backend=backend), np.inf, 0.0)
        return lambda: mesh.cast(origins, directions, device=device, backend=backend).t

    ready = pack(directions if sight else unit())
    bare = (lambda: occluded(ready)) if sight else (lambda: scene.cast_rays(ready)["t_hit"].numpy())
    return {
        "warp": ours("warp"),
        "chosen": ours("auto"),
        "embree bare": bare,
        "embree from arrays": from_arrays,
    }


def _speeds(
    runners: dict[str, Callable[[], np.ndarray]], rays: int, repeats: int, by_processor: bool
) -> dict[str, dict[str, float]]:
    """Rays per second of each runner and its speed over the yardsticks; the best of runs in turn after one that doesn't
    count, each turn in an order of its own: what a runner leaves of the heap, the next one pays for in page faults."""
    clock, yard = dict.fromkeys(runners, np.inf), dict.fromkeys(runners, np.inf)
    rng = np.random.default_rng(0)
    for turn in range(repeats + 1):
        for name in rng.permutation(list(runners)).tolist():
            began, used = time.perf_counter(), time.process_time()
            runners[name]()
            if turn:
                spent = time.perf_counter() - began
                clock[name] = min(clock[name], spent)
                yard[name] = min(yard[name], time.process_time() - used if by_processor else spent)
    return {
        name: {
            "rays_per_s": rays / clock[name],
            "over_bare": yard["embree bare"] / yard[name],
            "over_arrays": yard["embree from arrays"] / yard[name],
        }
        for name in runners
    }
