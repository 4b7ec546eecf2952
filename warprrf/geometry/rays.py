"""Search of a triangle mesh along rays: Warp's hierarchy on any device, or Embree's on a CPU.

Both answer in float32 which face a ray meets; distances [m] are then taken in float64 from that face's plane (see
`kernels.rays`), so the back ends agree. :class:`warprrf.geometry.mesh.Mesh` is the public side of it.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.geometry import embree, o3d
from warprrf.geometry.ray_room import ROWS_KEPT, room_for_packed
from warprrf.kernels.raster.lanes import LANES
from warprrf.kernels.rays.mesh import (
    AGAIN,
    BAD,
    BLOCKED,
    FREE,
    GRAZING,
    cast_rays,
    look,
)
from warprrf.kernels.rays.packed_rays import pack_rays, pick_rays, place_hits
from warprrf.kernels.rays.packed_segments import judge_segments, pack_segments

BACKENDS = ("auto", "warp", "embree")
"""What searches the mesh: ``"auto"`` takes Embree on a CPU where Open3D is installed and there are many rays."""

EMBREE_RAYS = 2_000
"""From this many rays on ``"auto"`` takes Embree if Open3D is loaded: a call costs 0.3 ms more than Warp's."""

EMBREE_RAYS_TO_LOAD = 200_000
"""From this many rays on it is loaded for them: that takes one to three seconds, once a process."""

# Rays that Embree gets at a time, at most: a call and its launches cost 0.5 ms, and a ray 60 bytes.
_EMBREE_CHUNK = ROWS_KEPT
# Blocks of 16 rays that are worth another thread: waking it costs 60 us. Where a kernel only moves rays, memory limits
# it: two threads of two take as long as one, and twice the processor.
_BLOCKS_A_THREAD = 1_024
# Beyond this share of free segments a search for any hit, before one for the first, saves time: it takes about half as
# long, and blocked segments need both.
_FREE_SHARE = 0.5
_PROBE = 2_048
# Faces that block most, asked before the hierarchy: at most so many, each the first to block this share of segments at
# least. Asking costs a segment 1 ns a face, and searching it 100 to 500.
_BLOCKERS = 16
_BLOCKER_SHARE = 0.01
# From this many faces on, rays without order are put in order of start and direction before they are cast: the parts of
# the hierarchy that they meet are then still in the cache.
_FACES_TO_SORT = 100_000
# A ray aimed exactly at a vertex of a closed mesh can slip through; turned by this much it meets a face [rad].
_JITTER = 1e-5
_RECASTS = 4


class Hit:
    """What rays met, one entry a ray. Normals and points are computed when first asked for.

    Attributes:
        t: Distance along the unit direction [m], shape ``(N,)``, float64; inf where nothing was met.
        face: Index of the face, shape ``(N,)``, int32; -1 where nothing was met.
    """

    def __init__(
        self,
        t: np.ndarray,
        face: np.ndarray,
        face_normals: np.ndarray,
        origins: np.ndarray,
        directions: np.ndarray,
    ) -> None:
        self.t = t
        self.face = face
        self._face_normals = face_normals
        self._origins = origins
        self._directions = directions

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
        return self._origins + t * (
            self._directions / np.linalg.norm(self._directions, axis=1, keepdims=True)
        )


class RaySearch:
    """The hierarchies of one mesh, each built when first needed.

    Args:
        triangles: Corners [m], shape ``(F, 3, 3)``.
        face_normals: Unit normals, shape ``(F, 3)``; zero for a face without area.
        vertices: Positions [m], shape ``(V, 3)``.
        faces: Vertex indices, shape ``(F, 3)``.
        bounds: Lowest and highest corner [m], shape ``(2, 3)``.
    """

    def __init__(
        self,
        triangles: np.ndarray,
        face_normals: np.ndarray,
        vertices: np.ndarray,
        faces: np.ndarray,
        bounds: np.ndarray,
    ) -> None:
        self._bounds = bounds
        self._center = bounds.mean(axis=0)
        self._radius = 0.5 * float(np.linalg.norm(bounds[1] - bounds[0]))
        offset = np.einsum("ni,ni->n", face_normals, triangles[:, 0] - self._center)
        self._planes = np.column_stack([face_normals, offset])
        self._triangles = triangles
        self._vertices = (vertices - self._center).astype(np.float32)
        self._faces = faces
        self._on_device: dict[str, tuple[wp.Mesh, wp.array]] = {}

    def on_device(self, device: wp.Device) -> wp.Mesh:
        """The Warp mesh on ``device`` with its vertices relative to the middle of the bounds."""
        return self._built(device)[0]

    def _built(self, device: wp.Device) -> tuple[wp.Mesh, wp.array]:
        if str(device) not in self._on_device:
            mesh = wp.Mesh(
                points=wp.array(self._vertices, dtype=wp.vec3, device=device),
                indices=wp.array(self._faces.reshape(-1), dtype=wp.int32, device=device),
            )
            self._on_device[str(device)] = mesh, wp.array(self._planes, dtype=wp.vec4d, device=device)
        return self._on_device[str(device)]

    @cached_property
    def _embree(self) -> tuple[embree.EmbreeScene, np.ndarray]:
        """Embree's hierarchy of the faces that have an area, and which faces those are; empty if all of them."""
        names = np.flatnonzero(self._planes[:, :3].any(axis=1)).astype(np.int32)
        scene = embree.EmbreeScene(self._vertices, self._faces[names])
        return scene, names if len(names) < len(self._faces) else names[:0]

    def nearest(
        self,
        o: np.ndarray,
        d: np.ndarray,
        *,
        reach: np.ndarray,
        clearance: float,
        device: Any,
        backend: str,
        own: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N,) [m], float64, and face (N,) of what rays meet beyond ``clearance`` [m]; inf and -1 at a miss.

        ``o`` and ``d`` hold one row or N, ``reach`` [m] one number or N: no need to look further. ``own``, if given,
        become copies of both.

        Raises:
            ValueError: if a ray is not finite or has no direction, or on an unknown back end, or Embree on a GPU.
        """
        where = _device.resolve(device)
        count = max(len(o), len(d)) if min(len(o), len(d)) else 0
        by_embree = choose_backend(backend, where, count) == "embree" and count > 0
        for copy, rays in zip(own or (), (o, d), strict=False):
            if not by_embree or len(rays) == 1:  # Embree's are copied where they are packed
                copy[:] = rays
        if by_embree:
            t, face = self._nearest_embree(o, d, clearance, where, own=own)
        else:
            mesh, planes = self._built(where)
            distance = wp.empty(count, dtype=wp.float64, device=where)
            found = wp.empty(count, dtype=wp.int32, device=where)
            inputs = [
                mesh.id, wp.vec3d(*self._center), self._radius, planes, clearance, _given(o, wp.vec3d, where),
                _given(d, wp.vec3d, where), _given(reach, wp.float64, where), distance, found,
            ]  # fmt: skip
            _device.launch(cast_rays, count, inputs, device=where)
            t, face = distance.numpy(), found.numpy()
        if face.min(initial=0) == BAD:
            _refuse(o, d)
        return t, face

    def _nearest_embree(
        self,
        o: np.ndarray,
        d: np.ndarray,
        clearance: float,
        cpu: wp.Device,
        own: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        t, face = self._embree_pass(o, d, clearance, cpu, own=own)
        again = np.flatnonzero(face == AGAIN if face.min() == AGAIN else [])
        # A ray that leaves its face at a slope of 1e-5 meets it for thousands of passes: few rays take more than two.
        while len(again):
            t[again], face[again] = self._embree_pass(
                rows(o, again), rows(d, again), clearance, cpu, start=t[again]
            )
            again = again[face[again] == AGAIN]
        return t, face

    def _embree_pass(
        self,
        o: np.ndarray,
        d: np.ndarray,
        clearance: float,
        cpu: wp.Device,
        start: np.ndarray | None = None,
        own: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """As :meth:`nearest`, but rays that met a surface at their start are AGAIN, to go on from the distance."""
        scene, names = self._embree
        count = max(len(o), len(d))
        chunk = min(count, _EMBREE_CHUNK)
        t, face = np.empty(count), np.empty(count, dtype=np.int32)
        rays = room_for_packed(chunk)
        keys = np.empty(chunk if len(self._faces) >= _FACES_TO_SORT else 0, dtype=np.uint16)
        center, planes, faces = wp.vec3d(*self._center), self._built(cpu)[1], _given(names, wp.int32, cpu)
        given = [
            clearance, _given(np.empty(0) if start is None else start, wp.float64, cpu),
            _given(o, wp.vec3d, cpu), _given(d, wp.vec3d, cpu),
        ]  # fmt: skip
        out = [_given(t, wp.float64, cpu), _given(face, wp.int32, cpu)]
        copies = [_given(copy, wp.vec3d, cpu) for copy in own or (np.empty((0, 3)), np.empty((0, 3)))]
        for first in range(0, count, chunk):
            size = min(chunk, count - first)
            blocks = -(-size // LANES)
            inputs = [first, size, center, self._radius, *given, rays, _given(keys, wp.uint16, cpu), *copies]
            _launch(pack_rays, blocks, inputs, cpu, streams=True)
            met_at, met = _cast(scene, rays, size, keys[:size])
            hits = [_given(met_at, wp.float32, cpu), _given(met, wp.int32, cpu)]
            inputs = [first, size, center, self._radius, planes, faces, *given, *hits, *out]
            _launch(place_hits, blocks, inputs, cpu)
        return t, face

    def free(
        self, a: np.ndarray, b: np.ndarray, *, clearance: float, device: Any, backend: str
    ) -> np.ndarray:
        """Whether nothing lies between ``a`` and ``b`` but within ``clearance`` [m] of an end, shape (N,), bool.

        Both hold one row or N.

        Raises:
            ValueError: if a point is not finite, or on an unknown back end, or Embree on a GPU.
        """
        where = _device.resolve(device)
        count = max(len(a), len(b)) if min(len(a), len(b)) else 0
        sight = np.empty(count, dtype=np.int8)
        if choose_backend(backend, where, count) == "embree" and count:
            self._free_embree(a, b, sight, clearance, where)
        else:
            mesh, planes = self._built(where)
            found = _given(sight, wp.int8, where)
            ends = [_given(a, wp.vec3d, where), _given(b, wp.vec3d, where)]
            inputs = [mesh.id, wp.vec3d(*self._center), self._radius, planes, clearance, *ends, found]
            _device.launch(look, count, inputs, device=where)
            sight = found.numpy()
        if sight.min(initial=0) == BAD:
            _refuse(a, b, names=("a", "b"))
        return sight == FREE

    def _free_embree(
        self, a: np.ndarray, b: np.ndarray, sight: np.ndarray, clearance: float, cpu: wp.Device
    ) -> None:
        """Fill ``sight`` with FREE, BLOCKED and BAD.

        The first hit names a face, whose plane judges in float64. A probe says what the others will be like: mostly
        free segments are sorted out by a search for any hit at all, which is cheaper; mostly blocked ones by the few
        faces that block most, if there are such, before the hierarchy is asked. What a search finds is still judged.
        """
        scene, names = self._embree
        count = len(sight)
        chunk = min(count, _EMBREE_CHUNK)
        rays = room_for_packed(chunk)
        keys = np.empty(chunk if len(self._faces) >= _FACES_TO_SORT else 0, dtype=np.uint16)
        center, planes, faces = wp.vec3d(*self._center), self._built(cpu)[1], _given(names, wp.int32, cpu)
        given = [clearance, _given(a, wp.vec3d, cpu), _given(b, wp.vec3d, cpu)]
        out = _given(sight, wp.int8, cpu)
        starts = [0, *range(min(_PROBE, chunk), count, chunk)] if count > 4 * _PROBE else [0]
        mostly_free, none = False, np.empty(0)
        frequent = none
        for first, end in zip(starts, [*starts[1:], count], strict=True):
            size = end - first
            known, kept = (none, keys[:0]) if mostly_free else (frequent, keys)
            inputs = [
                first, size, center, self._radius, *given, _given(known, wp.float64, cpu), rays,
                _given(kept, wp.uint16, cpu), out,
            ]  # fmt: skip
            _launch(pack_segments, -(-size // LANES), inputs, cpu, streams=len(known) == 0)
            part = sight[first:end]
            if mostly_free:
                which = np.flatnonzero(scene.blocked(_rows_of(rays, size)))
            else:
                which = np.flatnonzero(part == FREE)
            if len(which):
                met = _cast(scene, rays, size, kept, which)[1]
                chosen = _given(which.astype(np.int32), wp.int32, cpu)
                inputs = [
                    first, len(which), chosen, center, self._radius, planes, faces, *given,
                    _given(met, wp.int32, cpu), out,
                ]  # fmt: skip
                _launch(judge_segments, -(-len(which) // LANES), inputs, cpu)
            if end == count:
                break
            mostly_free = int(np.count_nonzero(part == FREE)) > _FREE_SHARE * size
            if first == 0 and len(which) and not mostly_free:
                frequent = self._frequent_blockers(met[part[which] == BLOCKED], size)
        if sight.min() == AGAIN:
            again = np.flatnonzero(sight == AGAIN)
            start = rows(a, again)
            way = rows(b, again) - start
            inner = np.linalg.norm(way, axis=1) - clearance
            t, face = self._nearest_embree(start, way, clearance, cpu)
            sight[again] = np.where((face < 0) | (t >= inner), FREE, BLOCKED)

    def _frequent_blockers(self, met: np.ndarray, size: int) -> np.ndarray:
        """The faces, as `pack_segments` knows them, that come first often among ``met``, found by ``size`` segments."""
        names = self._embree[1]
        often = np.bincount(met[met >= 0], minlength=1)
        chosen = np.argsort(-often, kind="stable")[:_BLOCKERS]
        chosen = chosen[often[chosen] > _BLOCKER_SHARE * size]
        if len(names):
            chosen = names[chosen]
        normal = self._planes[chosen, :3]
        corners = self._triangles[chosen] - self._center
        rows = [self._planes[chosen]]
        for k in (1, 2):
            # A barycentric coordinate grows from 0 at the edge between the others to 1 at corner k.
            edge = corners[:, 3 - k] - corners[:, 0]
            inward = np.cross(normal, edge)
            inward /= (inward * (corners[:, k] - corners[:, 0])).sum(axis=1, keepdims=True)
            rows.append(np.column_stack([inward, -(inward * corners[:, 0]).sum(axis=1)]))
        return np.concatenate(rows, axis=1).reshape(-1)

    def recast(
        self, o: np.ndarray, d: np.ndarray, t: np.ndarray, face: np.ndarray, *, device: Any, backend: str
    ) -> None:
        """Cast rays that met nothing and start within the bounds again, a little turned; fills ``t`` and ``face``."""
        missed = np.flatnonzero(face < 0)
        if len(missed) == 0:
            return
        inside = ((self._bounds[0] <= o) & (o <= self._bounds[1])).all(axis=1)
        missed = missed[np.broadcast_to(inside, face.shape)[missed]]
        rng = np.random.default_rng(0)
        for _ in range(_RECASTS):
            if len(missed) == 0:
                return
            start, toward = rows(o, missed), rows(d, missed)
            toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
            turned = toward + _JITTER * rng.standard_normal((len(missed), 3))
            near, found = self.nearest(
                start, turned, reach=np.full(1, np.inf), clearance=0.0, device=device, backend=backend
            )
            # The distance is that of the ray asked for to the plane of the face found.
            plane = self._planes[found]
            slope = (plane[:, :3] * toward).sum(axis=1)
            height = plane[:, 3] - (plane[:, :3] * (start - self._center)).sum(axis=1)
            steep = (found >= 0) & (np.abs(slope) > GRAZING)
            t[missed] = np.divide(height, slope, out=near, where=steep)
            face[missed] = found
            missed = missed[found < 0]


def choose_backend(backend: str, device: wp.Device, count: int) -> str:
    """``"warp"`` or ``"embree"`` for ``count`` rays on ``device``.

    Raises:
        ValueError: on an unknown name, or Embree on a GPU.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: got {backend!r}, expected one of {', '.join(BACKENDS)}")
    if backend == "embree" and _device.is_cuda(device):
        raise ValueError(f'backend: got "embree" on {device}, expected "warp" there, or device="cpu"')
    if backend != "auto":
        return backend
    least = EMBREE_RAYS if o3d.loaded() else EMBREE_RAYS_TO_LOAD
    return "embree" if count >= least and not _device.is_cuda(device) and o3d.installed() else "warp"


def _launch(kernel: Any, blocks: int, inputs: list[Any], cpu: wp.Device, *, streams: bool = False) -> None:
    """Launch a kernel on blocks of rays, on as many threads as they are worth; half of all if it ``streams`` them."""
    threads = max(1, _device.threads() // 2) if streams else _device.threads()
    pieces = min(threads, 1 + blocks // _BLOCKS_A_THREAD)
    _device.launch(kernel, blocks, inputs, device=cpu, pieces=pieces)


def _rows_of(rays: wp.array, size: int) -> np.ndarray:
    """The first ``size`` packed rays, as Embree takes them."""
    packed: np.ndarray = rays.numpy().reshape(-1, 6)[:size]
    return packed


def _cast(
    scene: embree.EmbreeScene, rays: wp.array, size: int, keys: np.ndarray, which: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """First hits of the first ``size`` packed rays, or of those that ``which`` names.

    Where neighbours among them have other ``keys``, they are sorted by key for the search.
    """
    if which is not None and len(keys):
        keys = keys[which]
    if 2 * np.count_nonzero(keys[1:] != keys[:-1]) <= len(keys):
        if which is None or len(which) == size:
            return scene.cast(_rows_of(rays, size))
        return scene.cast(_picked(rays, which))
    order = np.argsort(keys, kind="stable")
    met_at, met = np.empty(len(order), dtype=np.float32), np.empty(len(order), dtype=np.int32)
    met_at[order], met[order] = scene.cast(_picked(rays, order if which is None else which[order]))
    return met_at, met


def _picked(rays: wp.array, which: np.ndarray) -> np.ndarray:
    """Packed rays that ``which`` names, in this order."""
    picked = wp.empty(2 * len(which), dtype=wp.vec3, device="cpu")
    inputs = [len(which), rays, _given(which, wp.int64, picked.device), picked]
    _launch(pick_rays, -(-len(which) // LANES), inputs, picked.device)
    return _rows_of(picked, len(which))


def rows(array: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Rows of rays that may hold one row for all."""
    return array if len(array) == 1 else array[index]


def _given(array: np.ndarray, dtype: Any, device: wp.Device) -> wp.array:
    """``array`` for a kernel, without a copy on a CPU."""
    return wp.array(array, dtype=dtype, device=device, copy=False)


def ray_arrays(origins: Any, directions: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rays as float64 rows, one or N of each; :meth:`RaySearch.nearest` refuses numbers that are not finite."""
    o = np.atleast_2d(_device.check_array("origins", origins, finite=False))
    d = np.atleast_2d(_device.check_array("directions", directions, finite=False))
    for name, array in (("origins", o), ("directions", d)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name}: got shape {array.shape}, expected (N, 3) or (3,)")
    if len(o) != len(d) and 1 not in (len(o), len(d)):
        raise ValueError(f"directions: got {len(d)} for {len(o)} origins, expected as many, or one of either")
    return o, d


def _refuse(
    origins: np.ndarray, directions: np.ndarray, names: tuple[str, str] = ("origins", "directions")
) -> None:
    """Say what is wrong with rays, or with segments, of which a kernel found some to be bad."""
    for name, array in zip(names, (origins, directions), strict=True):
        _device.check_array(name, array)
    if names[1] == "directions" and (np.linalg.norm(directions, axis=1) == 0).any():
        raise ValueError("directions: got a vector of length zero, expected directions")
    raise ValueError(f"{', '.join(names)}: got numbers too large to square, expected metres")
