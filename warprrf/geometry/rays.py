"""Search of a triangle mesh along rays: by Embree (through Open3D) on a CPU, or by Warp's hierarchy on any device.

Both keep the mesh in float32 about its middle and answer which face a ray meets. The distance [m] is then taken in
float64 from the plane of that face (:mod:`warprrf.kernels.rays.mesh`), so the two agree.
:class:`warprrf.geometry.mesh.Mesh` is the public side.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp

from warprrf.cache import Cache, cached_property
from warprrf.checks import check_array, check_choice
from warprrf.device import launch, require, threads
from warprrf.kernels.rays.mesh import (
    AGAIN,
    BAD,
    GRAZING,
    cast_rays,
    pack_rays,
    pack_segments,
    place_hits,
    see,
)

BACKENDS = ("auto", "warp", "embree")
"""What searches the mesh: ``"auto"`` takes Embree on a CPU where Open3D is installed and there are many rays."""

EMBREE_RAYS = 2_000
"""From this many rays on ``"auto"`` takes Embree if Open3D is loaded: a call costs 0.3 ms more than Warp's."""

EMBREE_RAYS_TO_LOAD = 200_000
"""From this many rays on it is loaded for them: that takes one to three seconds, once a process."""

# A ray aimed exactly at a vertex of a closed mesh can slip through; turned by this much it meets a face [rad].
_JITTER = 1e-5
_RECASTS = 4
# How often Embree casts rays again that met a surface at their start.
_ROUNDS = 8
# Rays that are worth another thread of Embree's: starting and stopping it takes as long as a thousand rays do.
_RAYS_A_THREAD = 4_096
# Longer segments overflow where Embree squares them in float32 [m].
_LONGEST = 1e18


@dataclass(eq=False)
class Hit:
    """What rays met, one entry a ray.

    Attributes:
        t: Distance along the unit direction [m], shape ``(N,)``, float64; inf where nothing was met.
        face: Index of the face, shape ``(N,)``, int32; -1 where nothing was met.
    """

    t: np.ndarray
    face: np.ndarray
    _face_normals: np.ndarray
    _origins: np.ndarray
    _directions: np.ndarray
    _per_origin: int

    def __repr__(self) -> str:
        return f"Hit({np.count_nonzero(self.valid)} of {len(self.t)} rays met a face)"

    @property
    def valid(self) -> np.ndarray:
        """Whether the ray met a face, shape ``(N,)``, bool."""
        return self.face >= 0

    @cached_property
    def normal(self) -> np.ndarray:
        """Unit face normal as wound (not turned towards the ray), shape ``(N, 3)``; NaN where nothing was met."""
        normal = self._face_normals[self.face]
        normal[~self.valid] = np.nan
        return normal

    @cached_property
    def point(self) -> np.ndarray:
        """Point met [m], shape ``(N, 3)``, float64; NaN where nothing was met."""
        t = np.where(self.valid, self.t, np.nan)[:, None]
        o, d = rays_of(self._origins, self._directions, self._per_origin, np.arange(len(t)))
        return o + t * (d / np.linalg.norm(d, axis=1, keepdims=True))


class RaySearch:
    """The hierarchies of one mesh, each built when first needed, by one thread.

    Rays and segments hold one row or N of either end: one stands for all. ``per_origin`` is as for :meth:`Mesh.cast`.

    Args:
        vertices: Positions [m], shape ``(V, 3)``.
        faces: Vertex indices, shape ``(F, 3)``.
        face_normals: Unit normals, shape ``(F, 3)``; zero for a face without area.
        bounds: Lowest and highest corner [m], shape ``(2, 3)``.
    """

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, face_normals: np.ndarray, bounds: np.ndarray
    ) -> None:
        self._bounds = bounds
        self._center = bounds.mean(axis=0)
        self._radius = 0.5 * float(np.linalg.norm(bounds[1] - bounds[0]))
        offset = np.einsum("ni,ni->n", face_normals, vertices[faces[:, 0]] - self._center)
        self._planes = np.column_stack([face_normals, offset])
        self._vertices = (vertices - self._center).astype(np.float32)
        self._faces = faces
        self._on_device = Cache(8)

    def on_device(self, device: wp.Device) -> tuple[wp.Mesh, wp.array]:
        """The Warp mesh on ``device``, its vertices relative to the middle of the bounds, and the faces' planes."""

        def build() -> tuple[wp.Mesh, wp.array]:
            mesh = wp.Mesh(
                points=wp.array(self._vertices, dtype=wp.vec3, device=device),
                indices=wp.array(self._faces.reshape(-1), dtype=wp.int32, device=device),
                bvh_constructor="sah",  # as on a CPU: slower to build than a GPU's own, and for good
            )
            return mesh, wp.array(self._planes, dtype=wp.vec4d, device=device)

        return self._on_device.get(str(device), build)

    @cached_property
    def _embree(self) -> EmbreeScene:
        return EmbreeScene(self._vertices, self._faces, np.flatnonzero(self._planes[:, :3].any(axis=1)))

    def nearest(
        self,
        o: np.ndarray,
        d: np.ndarray,
        *,
        per_origin: int = 1,
        reach: np.ndarray | float = np.inf,
        clearance: float = 0.0,
        device: wp.Device,
        backend: str,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N,) [m], float64, and face (N,) of what rays meet beyond ``clearance`` [m]; inf and -1 at a miss.

        ``reach`` [m] is one number or N: no need to look further.
        """
        count = max(len(o) * per_origin, len(d)) if min(len(o), len(d)) else 0
        if choose_backend(backend, device, count) == "embree" and count:
            t, face = self._nearest_embree(o, d, per_origin, clearance, device)
        else:
            mesh, planes = self.on_device(device)
            distance = wp.empty(count, dtype=wp.float64, device=device)
            found = wp.empty(count, dtype=wp.int32, device=device)
            inputs = [
                mesh.id, *self._frame, planes, clearance, _given(o, wp.vec3d, device), per_origin,
                _given(d, wp.vec3d, device), _given(np.atleast_1d(reach), wp.float64, device), distance, found,
            ]  # fmt: skip
            launch(cast_rays, count, inputs, device=device)
            t, face = distance.numpy(), found.numpy()
        if face.min(initial=0) == BAD:
            _refuse(("origins", o), ("directions", d))
        return t, face

    @property
    def _frame(self) -> tuple[wp.vec3d, float]:
        return wp.vec3d(*self._center), self._radius

    def _nearest_embree(
        self,
        o: np.ndarray,
        d: np.ndarray,
        per_origin: int,
        clearance: float,
        cpu: wp.Device,
        start: np.ndarray | None = None,
        rounds: int = _ROUNDS,
    ) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`nearest`, from ``start`` (N) [m] on, or from ``clearance``. Rays that met a surface at their start are
        cast again from behind it; the few that glide along it go on in the kernel, where a step costs less."""
        count = max(len(o) * per_origin, len(d))
        begin = _given(np.empty(0) if start is None else start, wp.float64, cpu)
        ends = _given(o, wp.vec3d, cpu), per_origin, _given(d, wp.vec3d, cpu)
        rays = np.empty((count, 6), dtype=np.float32)
        inputs = [*self._frame, clearance, begin, *ends, _given(rays.reshape(-1, 3), wp.vec3, cpu)]
        launch(pack_rays, count, inputs, device=cpu)
        near, met = self._embree.cast(rays)
        t, face = np.empty(count), np.empty(count, dtype=np.int32)
        inputs = [
            *self._frame, _given(self._planes, wp.vec4d, cpu), clearance, begin, *ends, _given(near, wp.float32, cpu),
            _given(met, wp.int32, cpu), _given(t, wp.float64, cpu), _given(face, wp.int32, cpu),
        ]  # fmt: skip
        launch(place_hits, count, inputs, device=cpu)
        which = np.flatnonzero(face == AGAIN)
        if len(which):
            some = rays_of(o, d, per_origin, which)
            if rounds > 1:
                t[which], face[which] = self._nearest_embree(*some, 1, clearance, cpu, t[which], rounds - 1)
            else:
                t[which], face[which] = self.nearest(*some, clearance=clearance, device=cpu, backend="warp")
        return t, face

    def free(
        self, a: np.ndarray, b: np.ndarray, *, clearance: float, device: wp.Device, backend: str
    ) -> np.ndarray:
        """Whether nothing lies between ``a`` and ``b`` but within ``clearance`` [m] of an end, shape (N,), bool."""
        count = max(len(a), len(b)) if min(len(a), len(b)) else 0
        if choose_backend(backend, device, count) == "embree" and count:
            return self._free_embree(a, b, count, clearance, device)
        mesh, planes = self.on_device(device)
        seen = wp.empty(count, dtype=wp.int8, device=device)
        ends = _given(a, wp.vec3d, device), _given(b, wp.vec3d, device)
        launch(see, count, [mesh.id, *self._frame, planes, clearance, *ends, seen], device=device)
        free = seen.numpy()
        if free.min(initial=0) == BAD:
            _refuse(("a", a), ("b", b))
        return free.astype(bool)

    def _free_embree(
        self, a: np.ndarray, b: np.ndarray, count: int, clearance: float, cpu: wp.Device
    ) -> np.ndarray:
        """As :meth:`free`. Most segments are free, and to find out that nothing is met at all takes half as long as what is
        met."""
        rays, length = np.empty((count, 6), dtype=np.float32), np.empty(count)
        inputs = [
            *self._frame, clearance, _LONGEST, _given(a, wp.vec3d, cpu), _given(b, wp.vec3d, cpu),
            _given(rays.reshape(-1, 3), wp.vec3, cpu), _given(length, wp.float64, cpu),
        ]  # fmt: skip
        launch(pack_segments, count, inputs, device=cpu)
        if not np.isfinite(length).all():
            _refuse(("a", a), ("b", b))
        free, which = np.ones(count, dtype=bool), np.flatnonzero(self._embree.blocked(rays))
        if len(which) == 0:
            return free
        inner, (start, end) = length[which] - clearance, rays_of(a, b, 1, which)
        way = end - start
        t, _ = self.nearest(start, way, reach=inner, clearance=clearance, device=cpu, backend="embree")
        free[which] = t >= inner
        return free

    def recast(
        self,
        o: np.ndarray,
        d: np.ndarray,
        t: np.ndarray,
        face: np.ndarray,
        *,
        per_origin: int,
        device: wp.Device,
        backend: str,
    ) -> None:
        """Cast rays that met nothing and start within the bounds again, a little turned; fills ``t`` and ``face``."""
        missed = np.flatnonzero(face < 0)
        start, _ = rays_of(o, d, per_origin, missed)
        missed = missed[((self._bounds[0] <= start) & (start <= self._bounds[1])).all(axis=1)]
        rng = np.random.default_rng(0)
        for _ in range(_RECASTS):
            if len(missed) == 0:
                return
            start, toward = rays_of(o, d, per_origin, missed)
            toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
            turned = toward + _JITTER * rng.standard_normal((len(missed), 3))
            near, found = self.nearest(start, turned, device=device, backend=backend)
            # The distance is that of the ray asked for to the plane of the face found.
            plane = self._planes[found]
            slope = (plane[:, :3] * toward).sum(axis=1)
            height = plane[:, 3] - (plane[:, :3] * (start - self._center)).sum(axis=1)
            steep = (found >= 0) & (np.abs(slope) > GRAZING)
            t[missed] = np.divide(height, slope, out=near, where=steep)
            face[missed] = found
            missed = missed[found < 0]


class EmbreeScene:
    """Triangles in Embree's hierarchy: those of ``faces`` that ``kept`` names.

    Open3D keeps the interpreter lock while it casts, so one call runs on all threads.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, kept: np.ndarray) -> None:
        self._o3d = open3d()
        self._kept = None if len(kept) == len(faces) else kept.astype(np.int32)
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=threads())
        tensor = self._o3d.core.Tensor.from_numpy
        self._scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces[kept].astype(np.uint32)))

    def cast(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First hits of ``rays`` (N, 6), float32: distances (N,), float32, inf at a miss; faces (N,), int32, or -1."""
        hit = self._scene.cast_rays(self._o3d.core.Tensor.from_numpy(rays), nthreads=self._threads_for(rays))
        face = hit["primitive_ids"].numpy().view(np.int32)  # a miss is the largest uint32, which reads as -1
        if self._kept is not None and len(self._kept):
            face = np.where(face < 0, face, self._kept[face])
        return hit["t_hit"].numpy(), face

    def blocked(self, rays: np.ndarray) -> np.ndarray:
        """Whether rays (N, 6), float32, meet anything within the length of their direction, shape (N,), bool."""
        met = self._scene.test_occlusions(
            self._o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0, nthreads=self._threads_for(rays)
        )
        return met.numpy()

    def _threads_for(self, rays: np.ndarray) -> int:
        return min(threads(), os.cpu_count() or 1, 1 + len(rays) // _RAYS_A_THREAD)


def open3d() -> ModuleType:
    """Open3D, which stage 1 and Embree's rays use: the one place that imports it, when first called."""
    return require("open3d", extra="photos")


@cache
def open3d_installed() -> bool:
    """Whether it can be imported here; it is not imported to find out."""
    return importlib.util.find_spec("open3d") is not None


def choose_backend(backend: str, device: wp.Device, count: int) -> str:
    """``"warp"`` or ``"embree"`` for ``count`` rays on ``device``.

    Raises:
        ValueError: on an unknown name, or Embree on a GPU.
    """
    check_choice("backend", backend, BACKENDS)
    if backend == "embree" and device.is_cuda:
        raise ValueError(f'backend: got "embree" on {device}, expected "warp" there, or device="cpu"')
    if backend != "auto":
        return backend
    least = EMBREE_RAYS if "open3d" in sys.modules else EMBREE_RAYS_TO_LOAD
    return "embree" if count >= least and not device.is_cuda and open3d_installed() else "warp"


def rays_of(
    o: np.ndarray, d: np.ndarray, per_origin: int, which: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of some rays of a :class:`RaySearch`, a row for each."""
    return o.take(which // per_origin % len(o), axis=0), d.take(which % len(d), axis=0)


def check_rows(
    first: tuple[str, Any], second: tuple[str, Any], per_first: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Two named arrays of vectors as float64 rows, one or N of each; they may hold numbers that are not finite. If there are
    N / ``per_first`` of the first, there may be as many of the second as ``per_first``.
    """
    arrays = []
    for name, value in (first, second):
        array = np.atleast_2d(check_array(name, value, finite=False))
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name}: got shape {array.shape}, expected (N, 3) or (3,)")
        arrays.append(array)
    one, other = len(arrays[0]) * per_first, len(arrays[1])
    if one not in (1, other) and other not in (1, per_first):
        raise ValueError(f"{second[0]}: got {other} for {one} {first[0]}, expected as many, or one of either")
    return arrays[0], arrays[1]


def _given(array: np.ndarray, dtype: type, device: wp.Device) -> wp.array:
    """``array`` for a kernel, without a copy on a CPU."""
    return wp.array(array, dtype=dtype, device=device, copy=False)


def _refuse(*ends: tuple[str, np.ndarray]) -> None:
    for name, array in ends:
        check_array(name, array)
        if name == "directions" and (np.linalg.norm(array, axis=1) == 0).any():
            raise ValueError("directions: got a vector of length zero, expected directions")
    raise ValueError(
        f"{', '.join(name for name, _ in ends)}: got numbers too large to square, expected metres"
    )
