"""Mesh rays on a CPU by Embree, through Open3D's ``RaycastingScene``: an alternative to Warp's hierarchy.

It answers in float32 which face a ray meets first; :class:`warprrf.geometry.mesh.Mesh` takes the distance in float64,
as for Warp. Open3D keeps the interpreter lock while it casts, so one call runs on all threads.
"""

from __future__ import annotations

import os

import numpy as np

from warprrf.device import threads
from warprrf.geometry import o3d

# Rays that are worth another thread: starting and stopping it takes 0.1 ms of a processor, as a thousand rays do.
_RAYS_A_THREAD = 4_096


class EmbreeScene:
    """Triangles in Embree's hierarchy.

    Args:
        vertices: Positions [m], shape ``(V, 3)``, float32.
        faces: Vertex indices, shape ``(F, 3)``.

    Raises:
        ImportError: if Open3D is not installed.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self._o3d = o3d.load()
        self._threads = min(threads(), os.cpu_count() or 1)
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=self._threads)
        tensor = self._o3d.core.Tensor
        self._scene.add_triangles(
            tensor.from_numpy(np.ascontiguousarray(vertices, dtype=np.float32)),
            tensor.from_numpy(np.ascontiguousarray(faces, dtype=np.uint32)),
        )

    def cast(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of ``rays`` (N, 6), float32: distances (N,), float32, inf at a miss; faces (N,), int32, or -1."""
        hit = self._scene.cast_rays(self._o3d.core.Tensor.from_numpy(rays), nthreads=self._threads_for(rays))
        # Open3D's id of a miss is the largest uint32, which reads as -1.
        return hit["t_hit"].numpy(), hit["primitive_ids"].numpy().view(np.int32)

    def blocked(self, rays: np.ndarray) -> np.ndarray:
        """Whether rays (N, 6), float32, meet anything within the length of their direction, shape (N,), bool."""
        met = self._scene.test_occlusions(
            self._o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0, nthreads=self._threads_for(rays)
        )
        hit: np.ndarray = met.numpy()
        return hit

    def _threads_for(self, rays: np.ndarray) -> int:
        return min(self._threads, 1 + len(rays) // _RAYS_A_THREAD)
