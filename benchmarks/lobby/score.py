"""How far a reconstruction is from the truth: camera positions, surface distance, surface normals, completeness.

The true scene and the true poses are read here and nowhere else in stage 1. The surface is scored where a photo sees
it: rays of the photo cameras are cast at the reconstructed mesh, and what they meet is compared with the nearest point
of the true surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera

RAYS_PER_CAMERA = 1500
CLOSE_M = 0.05  # a true surface point counts as reconstructed when the mesh is this close


class MeshScore(NamedTuple):
    """Errors of a mesh.

    Attributes:
        figures: numbers by name, as they stand in the report.
        points: what the photo rays met on the reconstructed mesh [m], shape ``(K, 3)``.
        distance_m: their distance to the true surface, shape ``(K,)``.
        normal_deg: angle between reconstructed and true normal, shape ``(K,)``.
    """

    figures: dict[str, float]
    points: np.ndarray
    distance_m: np.ndarray
    normal_deg: np.ndarray


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
    return {
        "camera_rms_m": float(np.sqrt((gap**2).mean())),
        "camera_max_m": float(gap.max()),
        "camera_rotation_median_deg": float(np.median(turn)),
        "cameras_posed": len(cameras),
        "cameras_total": len(truth),
    }


def score_mesh(
    mesh: Mesh, truth: Mesh, cameras: Sequence[Camera], *, seed: int = 0, device: Any = None
) -> MeshScore:
    """Errors of ``mesh`` where the photos of the (true) ``cameras`` see it.

    Figures: ``mesh_distance_median_m``, ``mesh_distance_p90_m`` (from what photo rays meet to the nearest surface),
    ``mesh_normal_median_deg``, ``mesh_missed`` (share of photo rays that meet the truth but not the mesh),
    ``mesh_complete`` (share of what the photos see of the true surface with the mesh within 5 cm).
    """
    rng = np.random.default_rng(seed)
    origins, directions = [], []
    for camera in cameras:
        rays = camera.directions().reshape(-1, 3)
        chosen = rng.choice(len(rays), size=min(RAYS_PER_CAMERA, len(rays)), replace=False)
        directions.append(rays[chosen])
        origins.append(np.broadcast_to(camera.position, directions[-1].shape))
    o, d = np.concatenate(origins), np.concatenate(directions)
    met, true = mesh.cast(o, d, device=device), truth.cast(o, d, device=device)
    points = met.point[met.valid]
    nearest = truth.closest(points, device=device)
    cosine = np.abs((met.normal[met.valid] * truth.face_normals[nearest.face]).sum(axis=1))
    normal_deg = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    back = mesh.distance(true.point[true.valid], device=device)
    figures = {
        "mesh_distance_median_m": float(np.median(nearest.distance)),
        "mesh_distance_p90_m": float(np.percentile(nearest.distance, 90)),
        "mesh_normal_median_deg": float(np.median(normal_deg)),
        "mesh_missed": float(np.mean(~met.valid[true.valid])),
        "mesh_complete": float(np.mean(back < CLOSE_M)),
    }
    return MeshScore(figures, points, nearest.distance, normal_deg)
