"""Mesh rays per second: Warp's hierarchy, Embree's, and what ``Mesh`` chooses, against Embree called bare.

Two yardsticks, both Embree through Open3D on the same threads: ``embree bare`` gets rays that are already packed in
float32 and returns float32 distances; ``embree from arrays`` starts, as :meth:`Mesh.cast` does, from float64 origins
and directions of any length, and so packs and normalises them in NumPy first. ``Mesh.cast`` returns float64 distances
besides. ``Mesh.visible`` is compared with Embree's search for any hit, which judges the ends of a segment in float32.
All of one row are run in turn in one process, in another order each time, and the best of the repeats counts: by the
clock, and by processor time, which other work on the machine disturbs less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import Progress, resolve, threads
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.o3d import installed
from warprrf.geometry.rays import EmbreeScene
from warprrf.rf.scene import Scene


def run_rays(
    *,
    scene: str | Path = "data/lobby/scene.xml",
    triangles: int = 200_000,
    rays: int = 1_000_000,
    repeats: int = 5,
    seed: int = 0,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Rays per second on the scene's mesh and on a bumpy sphere of about ``triangles`` faces.

    Args:
        scene: Scene file of the first mesh.
        triangles: Faces of the second.
        rays: Rays a launch, at least 1.
        repeats: Times that each is run after a first that doesn't count, at least 1.
        seed: Of the incoherent rays.
        device: Where Warp and ``Mesh.cast`` run; without a GPU's own yardstick, ratios are to Embree on the CPU.
        progress: Called with ("rays", rows done, rows).

    Returns:
        One row a mesh and kind of rays (``panorama``: one origin, neighbours in order; ``incoherent``: origins and
        directions at random; ``sight, free`` and ``sight, blocked``: segments between points in the bounds, for
        ``Mesh.visible``): ``mesh, faces, kind, rays, threads``, and for each runner ``rays_per_s``,
        ``rays_per_cpu_s`` and, over both yardsticks, ``over_bare`` and ``over_arrays`` (by processor time on a CPU,
        else by the clock); ``t_difference_m``, the largest between Warp and Embree, and ``other_faces``, the share of
        rays for which they name different faces. Without Open3D the Embree entries are absent.

    Raises:
        ValueError: if ``rays`` or ``repeats`` is below 1.
    """
    for name, value in (("rays", rays), ("repeats", repeats)):
        if value < 1:
            raise ValueError(f"{name}: got {value}, expected at least 1")
    on = resolve(device)
    meshes = {"scene": Scene.load(scene).mesh, "bumpy sphere": bumpy_sphere(triangles)}
    rng, rows = np.random.default_rng(seed), []
    for name, mesh in meshes.items():
        figures: dict[str, Any]
        for kind in ("panorama", "incoherent"):
            origins, directions = _rays(mesh, kind, rays, rng)
            figures, agreement = _measure(mesh, origins, directions, repeats, on)
            about = {"mesh": name, "faces": len(mesh.faces), "kind": kind, "rays": len(directions)}
            rows.append({**about, "threads": threads(), "device": str(on), **figures, **agreement})
            if progress is not None:
                progress("rays", len(rows), 4 * len(meshes))
        a, b = rng.uniform(mesh.bounds[0], mesh.bounds[1], (2, rays, 3))
        free = mesh.visible(a, b, device=on)
        for kind, chosen in (("sight, free", free), ("sight, blocked", ~free)):
            if chosen.any():
                pick = np.resize(np.flatnonzero(chosen), rays)
                figures, agreement = _measure_sight(mesh, a[pick], b[pick], repeats, on)
                about = {"mesh": name, "faces": len(mesh.faces), "kind": kind, "rays": rays}
                rows.append({**about, "threads": threads(), "device": str(on), **figures, **agreement})
            if progress is not None:
                progress("rays", len(rows), 4 * len(meshes))
    return rows


def bumpy_sphere(triangles: int) -> Mesh:
    """A closed surface of about ``triangles`` faces, 4.5 to 5.5 m about the origin, which sees all of it.

    Raises:
        ValueError: below 100 faces.
    """
    if triangles < 100:
        raise ValueError(f"triangles: got {triangles}, expected at least 100")
    rings = int(np.sqrt(triangles)) // 2
    around = 2 * rings
    zenith, azimuth = np.meshgrid(
        np.arange(1, rings) * np.pi / rings, np.arange(around) * 2 * np.pi / around, indexing="ij"
    )
    radius = 5.0 + 0.5 * np.sin(7 * zenith) * np.cos(9 * azimuth)
    grid = radius[..., None] * np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1
    )
    vertices = np.concatenate([grid.reshape(-1, 3), [[0, 0, 5.0], [0, 0, -5.0]]])
    index = np.arange((rings - 1) * around).reshape(rings - 1, around)
    after = np.roll(index, -1, axis=1)
    poles = np.full(around, len(vertices) - 2)
    parts = [
        (poles, index[0], after[0]),
        (poles + 1, after[-1], index[-1]),
        (index[:-1], index[1:], after[1:]),
        (index[:-1], after[1:], after[:-1]),
    ]
    return Mesh(vertices, np.concatenate([np.stack(p, axis=-1).reshape(-1, 3) for p in parts]))


def _rays(mesh: Mesh, kind: str, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    if kind == "panorama":
        height = max(1, int(np.sqrt(count / 2)))
        theta = (np.arange(height) + 0.5) * np.pi / height
        phi = -np.pi + (np.arange(2 * height) + 0.5) * np.pi / height
        th, ph = np.meshgrid(theta, phi, indexing="ij")
        toward = np.stack([np.sin(th) * np.cos(ph), np.sin(th) * np.sin(ph), np.cos(th)], axis=-1)
        return mesh.center[None] + [[0.1, 0.2, 0.3]], toward.reshape(-1, 3)
    return mesh.center + rng.uniform(-1.0, 1.0, (count, 3)), rng.standard_normal((count, 3))


def _measure(
    mesh: Mesh, origins: np.ndarray, directions: np.ndarray, repeats: int, device: Any
) -> tuple[dict[str, Any], dict[str, float]]:
    runners: dict[str, Callable[[], Any]] = {
        "warp": lambda: mesh.cast(origins, directions, device=device, backend="warp"),
        "chosen": lambda: mesh.cast(origins, directions, device=device),
    }
    agreement = {}
    if installed():
        scene = EmbreeScene(mesh.vertices - mesh.center, mesh.faces, np.arange(len(mesh.faces)))
        packed = _pack(mesh, origins, directions)
        runners["embree bare"] = lambda: scene.cast(packed)
        runners["embree from arrays"] = lambda: scene.cast(_pack(mesh, origins, directions))
        runners["embree"] = lambda: mesh.cast(origins, directions, device="cpu", backend="embree")
        ours, other = runners["warp"](), runners["embree"]()
        both = ours.valid & other.valid
        agreement = {
            "t_difference_m": float(np.abs(ours.t[both] - other.t[both]).max(initial=0.0)),
            "other_faces": float((ours.face != other.face).mean()),
        }
    return _figures(runners, len(directions), repeats, device), agreement


def _measure_sight(
    mesh: Mesh, a: np.ndarray, b: np.ndarray, repeats: int, device: Any
) -> tuple[dict[str, Any], dict[str, float]]:
    runners: dict[str, Callable[[], Any]] = {
        "warp": lambda: mesh.visible(a, b, device=device, backend="warp"),
        "chosen": lambda: mesh.visible(a, b, device=device),
    }
    agreement = {}
    if installed():
        scene = EmbreeScene(mesh.vertices - mesh.center, mesh.faces, np.arange(len(mesh.faces)))
        packed = np.column_stack([a - mesh.center, b - a]).astype(np.float32)
        runners["embree bare"] = lambda: scene.blocked(packed)
        runners["embree from arrays"] = lambda: scene.blocked(
            np.column_stack([a - mesh.center, b - a]).astype(np.float32)
        )
        runners["embree"] = lambda: mesh.visible(a, b, device="cpu", backend="embree")
        agreement = {"other_sight": float((runners["warp"]() != runners["embree"]()).mean())}
    return _figures(runners, len(a), repeats, device), agreement


def _figures(runners: dict[str, Callable[[], Any]], rays: int, repeats: int, device: Any) -> dict[str, Any]:
    """Rays per second of each runner and its speed over the yardsticks."""
    clock, processor = _best_times(runners, repeats)
    figures: dict[str, Any] = {}
    yard = processor if device.is_cpu else clock
    for name in runners:
        figures[name] = {"rays_per_s": rays / clock[name], "rays_per_cpu_s": rays / processor[name]}
        if "embree bare" in runners:
            figures[name]["over_bare"] = yard["embree bare"] / yard[name]
            figures[name]["over_arrays"] = yard["embree from arrays"] / yard[name]
    return figures


def _pack(mesh: Mesh, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Rays for Embree by NumPy, as its Python users write it."""
    packed = np.empty((len(directions), 6), dtype=np.float32)
    packed[:, :3] = origins - mesh.center
    packed[:, 3:] = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return packed


def _best_times(
    runners: dict[str, Callable[[], Any]], repeats: int
) -> tuple[dict[str, float], dict[str, float]]:
    """Shortest run of each [s], by the clock and in processor time, run in turn after one that doesn't count.

    Each turn has an order of its own: what a runner leaves of the heap, the next one pays for in page faults.
    """
    clock, processor = dict.fromkeys(runners, np.inf), dict.fromkeys(runners, np.inf)
    rng = np.random.default_rng(0)
    for turn in range(repeats + 1):
        for name in rng.permutation(list(runners)).tolist():
            run = runners[name]
            began, used = time.perf_counter(), time.process_time()
            run()
            if turn:
                clock[name] = min(clock[name], time.perf_counter() - began)
                processor[name] = min(processor[name], time.process_time() - used)
    return clock, processor
