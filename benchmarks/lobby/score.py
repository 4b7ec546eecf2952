"""How far a reconstruction is from the truth: camera positions, surface distance, surface normals, completeness.

The true scene and the true poses are read here and nowhere else in stage 1. The surface is scored where a photo sees
it: rays of the photo cameras are cast at the reconstructed mesh, and what they meet is compared with the nearest point
of the true surface.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera

RAYS_PER_CAMERA = 1500
SAMPLES = 100_000
CLOSE_M = 0.05  # a true surface point counts as reconstructed when the mesh is this close


@dataclass(frozen=True)
class MeshScore:
    """Errors of a mesh.

    Attributes:
        figures: numbers by name, as they stand in the report.
        points: what the photo rays met on the reconstructed mesh [m], shape ``(K, 3)``.
        distance_m: their distance to the true surface, shape ``(K,)``.
        normal_deg: angle between reconstructed and true normal, shape ``(K,)``.
    """

    figures: dict[str, float]
    points: np.ndarray = field(repr=False)
    distance_m: np.ndarray = field(repr=False)
    normal_deg: np.ndarray = field(repr=False)


def true_cameras(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """Cameras of ``poses_true.json``."""
    content = json.loads(Path(path).read_text(encoding="utf-8"))
    lens = {k: content[k] for k in ("fx", "fy", "cx", "cy")}
    return {
        name: Camera.pinhole(
            content["width"], content["height"], **lens, world_to_camera=np.array(view["world_to_camera"])
        )
        for name, view in content["views"].items()
    }


def score_cameras(cameras: Mapping[str, Camera], truth: Mapping[str, Camera]) -> dict[str, float]:
    """Errors of all posed cameras, not only of the surveyed ones.

    Raises:
        ValueError: if a camera has no true pose.
    """
    missing = [name for name in cameras if name not in truth]
    if missing:
        raise ValueError(f"truth: no true pose for {', '.join(missing[:5])}")
    gap = np.array([np.linalg.norm(c.position - truth[n].position) for n, c in cameras.items()])
    turn = [
        np.degrees(np.arccos(np.clip((np.trace(c.rotation @ truth[n].rotation.T) - 1) / 2, -1, 1)))
        for n, c in cameras.items()
    ]
    focal = np.array([c.fx / truth[n].fx - 1 for n, c in cameras.items()])
    return {
        "camera_rms_m": float(np.sqrt((gap**2).mean())),
        "camera_max_m": float(gap.max()),
        "camera_rotation_median_deg": float(np.median(turn)),
        "focal_error_percent": float(100 * np.abs(focal).max()),
        "cameras_posed": len(cameras),
        "cameras_total": len(truth),
    }


def score_mesh(
    mesh: Mesh,
    truth: Mesh,
    cameras: Sequence[Camera],
    *,
    rays_per_camera: int = RAYS_PER_CAMERA,
    samples: int = SAMPLES,
    seed: int = 0,
    device: Any = None,
) -> MeshScore:
    """Errors of ``mesh`` where the photos of the (true) ``cameras`` see it.

    Figures: ``mesh_distance_median_m``, ``mesh_distance_p90_m`` (from what photo rays meet to the nearest surface),
    ``mesh_normal_median_deg``, ``mesh_range_median_m`` and ``_p90_m`` (difference of ranges along the same rays),
    ``mesh_missed`` (share of photo rays that meet the truth but not the mesh), ``mesh_complete`` (share of what the
    photos see of the true surface with the mesh within 5 cm), ``mesh_surface_median_m`` and ``_p90_m`` (points drawn
    evenly on the whole mesh, seen or not).
    """
    rng = np.random.default_rng(seed)
    origins, directions = [], []
    for camera in cameras:
        rays = camera.directions().reshape(-1, 3)
        chosen = rng.choice(len(rays), size=min(rays_per_camera, len(rays)), replace=False)
        directions.append(rays[chosen])
        origins.append(np.broadcast_to(camera.position, directions[-1].shape))
    o, d = np.concatenate(origins), np.concatenate(directions)
    met, true = mesh.cast(o, d, device=device), truth.cast(o, d, device=device)
    points = met.point[met.valid]
    nearest = truth.closest(points, device=device)
    cosine = np.abs((met.normal[met.valid] * truth.face_normals[nearest.face]).sum(axis=1))
    normal_deg = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    both = met.valid & true.valid
    range_error = np.abs(met.t[both] - true.t[both])
    back = mesh.distance(true.point[true.valid], device=device)
    even = truth.distance(sample_surface(mesh, samples, rng), device=device)
    figures = {
        "mesh_distance_median_m": float(np.median(nearest.distance)),
        "mesh_distance_p90_m": float(np.percentile(nearest.distance, 90)),
        "mesh_normal_median_deg": float(np.median(normal_deg)),
        "mesh_normal_p90_deg": float(np.percentile(normal_deg, 90)),
        "mesh_range_median_m": float(np.median(range_error)),
        "mesh_range_p90_m": float(np.percentile(range_error, 90)),
        "mesh_missed": float(np.mean(~met.valid[true.valid])),
        "mesh_complete": float(np.mean(back < CLOSE_M)),
        "mesh_surface_median_m": float(np.median(even)),
        "mesh_surface_p90_m": float(np.percentile(even, 90)),
        "mesh_triangles": len(mesh.faces),
    }
    return MeshScore(figures, points, nearest.distance, normal_deg)


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points spread evenly by area, shape ``(count, 3)``."""
    faces = rng.choice(len(mesh.faces), size=count, p=mesh.areas / mesh.areas.sum())
    u, v = rng.random((2, count, 1))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = (mesh.vertices[mesh.faces[faces, k]] for k in range(3))
    return a + u * (b - a) + v * (c - a)
