"""Gaussians on a known mesh: flat discs that cover its surface, for scenes that need no photos.

They stand in for a reconstruction: blending, radio fits and tests then work on true geometry.
"""

from __future__ import annotations

import numpy as np

from warprrf.checks import check_count
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.gaussians import Gaussians

OVERSAMPLING = 8  # candidates per disc before thinning: enough to fill 95 % of the cells
RADIUS = 0.75  # standard deviation of a disc in units of the mean spacing: leaves no holes, blurs little
FLATNESS = 0.01  # thickness over radius
OPACITY = 0.999


def discs_on_mesh(mesh: Mesh, count: int = 30_000, *, seed: int = 0) -> Gaussians:
    """About ``count`` flat Gaussians, evenly spread over ``mesh``, normals along its faces.

    Args:
        mesh: surface to cover.
        count: wanted number; a few per cent fewer come out.
        seed: of the sampling.

    Raises:
        ValueError: for a count below 1.
    """
    check_count("count", count)
    rng = np.random.default_rng(seed)
    area = np.where(mesh.first_at_place == np.arange(len(mesh.faces)), mesh.areas, 0.0)
    spacing = float(np.sqrt(area.sum() / count))
    face = rng.choice(len(area), size=OVERSAMPLING * count, p=area / area.sum())
    root, v = np.sqrt(rng.random(len(face))), rng.random(len(face))
    barycentric = np.stack([1 - root, root * (1 - v), root * v], axis=-1)
    points = np.einsum("nk,nkj->nj", barycentric, mesh.triangles[face])
    # One disc per cell and side of the surface: opposite faces of a thin plate keep theirs.
    side = np.round(2 * mesh.face_normals[face]).astype(np.int64)
    cells = np.concatenate([np.floor((points - mesh.bounds[0]) / spacing).astype(np.int64), side], axis=1)
    kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    points, normal = points[kept], mesh.face_normals[face[kept]]
    radius = RADIUS * spacing
    return Gaussians(
        means=points,
        quaternions=_turning_z_to(normal),
        scales=np.tile([radius, radius, FLATNESS * radius], (len(points), 1)),
        opacities=np.full(len(points), OPACITY),
        sh=np.zeros((len(points), 1, 3)),
    )


def _turning_z_to(normal: np.ndarray) -> np.ndarray:
    """Quaternions wxyz ``(N, 4)`` that turn the z axis to unit vectors ``(N, 3)``; a half turn about x for -z."""
    quaternion = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=-1)
    quaternion[np.linalg.norm(quaternion, axis=1) < 1e-6] = [0.0, 1.0, 0.0, 0.0]
    return quaternion
