"""Triangle mesh with ray queries: visibility, surface hits and closest points, in metres.

The bounding volume hierarchy is Warp's, or Embree's for many rays on a CPU, in float32 and about the mesh's own
centre; it names the face that is hit. Distances and points are then recomputed in float64 from that face's plane,
because at 300 GHz a wavelength is 1 mm and float32 alone errs by 5e-5 m at 5 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.geometry import embree
from warprrf.geometry.embree import EmbreeScene
from warprrf.kernels.rays import AGAIN, BAD, GRAZING, cast_rays, closest_faces, pack_rays, place_hits

ENDPOINT_CLEARANCE = 1e-4
"""Length at both ends of a segment in which :meth:`Mesh.visible` ignores surfaces [m]."""

BACKENDS = ("auto", "warp", "embree")
"""What searches the mesh: ``"auto"`` takes Embree on a CPU where Open3D is installed and there are many rays."""

# From this many rays on "auto" takes Embree; below, loading Open3D costs more than it saves.
EMBREE_RAYS = 50_000
# Rays that Embree gets at a time: enough to outweigh the launches, few enough for their copy to stay in the cache.
_EMBREE_CHUNK = 262_144
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
        self, mesh: Mesh, origins: np.ndarray, directions: np.ndarray, t: np.ndarray, face: np.ndarray
    ) -> None:
        self.t = t
        self.face = face
        self._mesh = mesh
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
        normal = self._mesh.face_normals[self.face]
        normal[~self.valid] = np.nan
        return normal

    @cached_property
    def point(self) -> np.ndarray:
        """Point met [m], shape ``(N, 3)``, float64; NaN where nothing was met."""
        t = np.where(self.valid, self.t, np.nan)[:, None]
        return self._origins + t * (
            self._directions / np.linalg.norm(self._directions, axis=1, keepdims=True)
        )


@dataclass(frozen=True)
class Closest:
    """Nearest surface points.

    Attributes:
        distance: Distance to the surface [m], shape ``(N,)``.
        point: Nearest point on the surface [m], shape ``(N, 3)``.
        face: Its face, shape ``(N,)``, int32.
    """

    distance: np.ndarray
    point: np.ndarray
    face: np.ndarray


class Mesh:
    """A triangle mesh in metres.

    Args:
        vertices: Positions [m], shape ``(V, 3)``; kept in float64.
        faces: Vertex indices, shape ``(F, 3)``, counter-clockwise seen from outside.

    Raises:
        TypeError: if the arguments don't read as arrays, or faces are not whole numbers.
        ValueError: on a wrong shape, no faces, an index out of range, or vertices that are not finite.
    """

    def __init__(self, vertices: Any, faces: Any) -> None:
        self.vertices: np.ndarray = _device.check_array("vertices", vertices, (None, 3)).copy()
        raw = _device.check_array("faces", faces, (None, 3), dtype=np.float64)
        self.faces: np.ndarray = raw.astype(np.int32)
        if len(raw) == 0:
            raise ValueError("faces: got none, expected at least one triangle")
        if not np.array_equal(raw, self.faces):
            raise TypeError("faces: got numbers that are not whole, expected vertex indices")
        low, high = int(self.faces.min()), int(self.faces.max())
        if low < 0 or high >= len(self.vertices):
            raise ValueError(
                f"faces: got indices from {low} to {high}, expected 0 to {len(self.vertices) - 1} "
                f"for {len(self.vertices)} vertices"
            )
        self.vertices.setflags(write=False)
        self.faces.setflags(write=False)
        self._warp_meshes: dict[str, wp.Mesh] = {}
        self._warp_planes: dict[str, wp.array] = {}

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces)"

    def __getstate__(self) -> dict[str, np.ndarray]:
        return {"vertices": self.vertices, "faces": self.faces}

    def __setstate__(self, state: dict[str, np.ndarray]) -> None:
        self.__init__(state["vertices"], state["faces"])  # type: ignore[misc]

    @cached_property
    def triangles(self) -> np.ndarray:
        """Corner positions [m], shape ``(F, 3, 3)``."""
        return self.vertices[self.faces]

    @cached_property
    def _crosses(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> np.ndarray:
        """Face areas [m^2], shape ``(F,)``."""
        return 0.5 * np.linalg.norm(self._crosses, axis=1)

    @cached_property
    def face_normals(self) -> np.ndarray:
        """Unit normals by winding, shape ``(F, 3)``; zero for a face without area."""
        length = np.linalg.norm(self._crosses, axis=1, keepdims=True)
        return np.divide(self._crosses, length, out=np.zeros_like(self._crosses), where=length > 0)

    @cached_property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of the box around the faces [m], shape ``(2, 3)``."""
        corners = self.vertices[np.unique(self.faces)]
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    @cached_property
    def welded_faces(self) -> np.ndarray:
        """Faces with vertices at one place (to 1e-7 of the box) given one index, shape ``(F, 3)``."""
        step = 1e-7 * max(float(np.ptp(self.bounds, axis=0).max()), 1e-12)
        cells = np.round((self.vertices - self.bounds[0]) / step).astype(np.int64)
        return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)[self.faces]

    @cached_property
    def is_closed(self) -> bool:
        """Whether every edge, after welding, belongs to an even number of faces.

        Faces whose corners fall together and repeats of a face (wound alike) are left out: they open nothing.
        """
        faces = self.welded_faces
        first, second, third = faces.T
        faces = faces[(first != second) & (second != third) & (third != first)]
        lowest = faces.argmin(axis=1)[:, None]
        faces = np.unique(np.take_along_axis(faces, (lowest + np.arange(3)) % 3, axis=1), axis=0)
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        return len(edges) > 0 and bool((np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all())

    @cached_property
    def center(self) -> np.ndarray:
        """Middle of the bounds [m], shape ``(3,)``: the origin of the float32 copy that devices hold."""
        return self.bounds.mean(axis=0)

    @cached_property
    def _radius(self) -> float:
        return 0.5 * float(np.linalg.norm(np.ptp(self.bounds, axis=0)))

    def on_device(self, device: Any = None) -> wp.Mesh:
        """The Warp mesh on ``device`` with its vertices relative to :attr:`center`, built once per device."""
        where = _device.resolve(device)
        if str(where) not in self._warp_meshes:
            self._warp_meshes[str(where)] = wp.Mesh(
                points=wp.array(
                    (self.vertices - self.center).astype(np.float32), dtype=wp.vec3, device=where
                ),
                indices=wp.array(self.faces.reshape(-1), dtype=wp.int32, device=where),
            )
        return self._warp_meshes[str(where)]

    def cast(self, origins: Any, directions: Any, *, device: Any = None, backend: str = "auto") -> Hit:
        """The nearest surface along rays; one that passes through a ray's very start is not met.

        Args:
            origins: Ray starts [m], shape ``(N, 3)`` or ``(3,)`` for all.
            directions: Ray directions, any length but zero, shape ``(N, 3)`` or ``(3,)`` for all.
            device: Where the hierarchy is searched.
            backend: One of :data:`BACKENDS`. Both agree on distances; on an edge they may name either face.

        Returns:
            Hits in float64. On a closed mesh a ray from inside that slips through between faces is cast again, turned
            by 1e-5 rad.

        Raises:
            ValueError: on a wrong shape, NaN, a direction of length zero, an unknown back end, or Embree on a GPU.
            ImportError: if Embree is asked for and Open3D is not installed.
        """
        o, d = _ray_arrays(origins, directions)
        t, face = self._search(o, d, np.full(1, np.inf), 0.0, device, backend)
        if (face == BAD).any():
            _check_rays(o, d)
        missed = np.flatnonzero(face < 0)
        if len(missed) and self.is_closed:
            self._recast(o, d, t, face, missed, device, backend)
        # Points may be asked for after the caller has changed its arrays.
        o, d = (
            x.copy() if np.may_share_memory(x, given) else x for x, given in ((o, origins), (d, directions))
        )
        return Hit(self, o, d, t, face)

    def visible(
        self,
        a: Any,
        b: Any,
        *,
        device: Any = None,
        clearance: float = ENDPOINT_CLEARANCE,
        backend: str = "auto",
    ) -> np.ndarray:
        """Whether nothing lies strictly between points.

        Args:
            a: Ends [m], shape ``(N, 3)`` or ``(3,)`` for all.
            b: Other ends [m], shape ``(N, 3)`` or ``(3,)`` for all.
            clearance: Surfaces nearer than this to either end, measured along the segment, don't block [m]: ends may
                lie on surfaces. Distances are judged in float64, so it need not cover float32 errors.
            device: Where the hierarchy is searched.
            backend: One of :data:`BACKENDS`.

        Returns:
            Shape ``(N,)``, bool.
        """
        start = np.atleast_2d(_device.check_array("a", a))
        end = np.atleast_2d(_device.check_array("b", b))
        if start.ndim != 2 or start.shape[1] != 3 or end.ndim != 2 or end.shape[1] != 3:
            raise ValueError(f"a, b: got shapes {np.shape(a)} and {np.shape(b)}, expected (N, 3) or (3,)")
        if len(start) != len(end) and 1 not in (len(start), len(end)):
            raise ValueError(
                f"a, b: got {len(start)} and {len(end)} points, expected as many of each, or one of either"
            )
        way = end - start
        length = np.linalg.norm(way, axis=1)
        free = np.ones(len(way), dtype=bool)
        long = np.flatnonzero(length > 2.0 * clearance)
        if len(long) == 0:
            return free
        t, face = self._search(
            _rows(start, long), way[long], length[long] - clearance, clearance, device, backend
        )
        if (face == BAD).any():
            _check_rays(start, way)
        free[long] = (face < 0) | (t >= length[long] - clearance)
        return free

    def closest(self, points: Any, *, device: Any = None) -> Closest:
        """The nearest point of the surface to each of ``points`` (N, 3) [m], in float64 once the face is known."""
        p = _device.check_array("points", points, (None, 3))
        where = _device.resolve(device)
        face = wp.zeros(len(p), dtype=wp.int32, device=where)
        reach = float(
            np.abs(p - self.center).max(initial=0.0) * 4.0 + np.ptp(self.bounds, axis=0).sum() * 4.0 + 1.0
        )
        _device.launch(
            closest_faces,
            len(p),
            [self.on_device(where).id, self._local(p, where), reach, face],
            device=where,
        )
        index = face.numpy()
        nearest = _closest_on_triangles(p, self.triangles[index])
        return Closest(distance=np.linalg.norm(nearest - p, axis=1), point=nearest, face=index)

    def distance(self, points: Any, *, device: Any = None) -> np.ndarray:
        """Distance from each of ``points`` (N, 3) [m] to the surface [m], shape ``(N,)``."""
        return self.closest(points, device=device).distance

    def winding_number(self, points: Any) -> np.ndarray:
        """Solid angle that the faces subtend at each of ``points`` (N, 3), over 4 pi, shape ``(N,)``.

        Of a closed mesh it is whole: how many of its parts, wound outward, a point lies in. Source: van Oosterom and
        Strackee, "The solid angle of a plane triangle", IEEE Trans. Biomed. Eng. 30 (1983).
        """
        p = _device.check_array("points", points, (None, 3))
        number = np.zeros(len(p))
        for k, point in enumerate(p):
            a, b, c = np.moveaxis(self.triangles - point, 1, 0)
            la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
            volume = np.einsum("ni,ni->n", a, np.cross(b, c))
            cosines = [np.einsum("ni,ni->n", x, y) for x, y in ((a, b), (b, c), (c, a))]
            below = la * lb * lc + cosines[0] * lc + cosines[1] * la + cosines[2] * lb
            number[k] = np.arctan2(volume, below).sum() / (2.0 * np.pi)
        return number

    def _local(self, points: np.ndarray, device: wp.Device) -> wp.array:
        return wp.array((points - self.center).astype(np.float32), dtype=wp.vec3, device=device)

    @cached_property
    def _planes(self) -> np.ndarray:
        """Unit normal and offset from :attr:`center` [m] of each face's plane, shape ``(F, 4)``."""
        offset = np.einsum("ni,ni->n", self.face_normals, self.triangles[:, 0] - self.center)
        return np.column_stack([self.face_normals, offset])

    @cached_property
    def _embree(self) -> tuple[EmbreeScene, np.ndarray]:
        """Embree's hierarchy of the faces that have an area, and which faces those are."""
        names = np.flatnonzero(self.areas > 0).astype(np.int32)
        return EmbreeScene((self.vertices - self.center).astype(np.float32), self.faces[names]), names

    def _recast(
        self, o: np.ndarray, d: np.ndarray, t: np.ndarray, face: np.ndarray, missed: np.ndarray, device: Any,
        backend: str,
    ) -> None:  # fmt: skip
        """Cast the ``missed`` rays that start within the bounds again, a little turned; fills in ``t`` and ``face``."""
        inside = ((self.bounds[0] <= o) & (o <= self.bounds[1])).all(axis=1)
        missed = missed[np.broadcast_to(inside, face.shape)[missed]]
        rng = np.random.default_rng(0)
        for _ in range(_RECASTS):
            if len(missed) == 0:
                return
            start, toward = _rows(o, missed), _rows(d, missed)
            toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
            turned = toward + _JITTER * rng.standard_normal((len(missed), 3))
            near, found = self._search(start, turned, np.full(1, np.inf), 0.0, device, backend)
            # The distance is that of the ray asked for to the plane of the face found.
            plane = self._planes[found]
            slope = (plane[:, :3] * toward).sum(axis=1)
            height = plane[:, 3] - (plane[:, :3] * (start - self.center)).sum(axis=1)
            steep = (found >= 0) & (np.abs(slope) > GRAZING)
            t[missed] = np.divide(height, slope, out=near, where=steep)
            face[missed] = found
            missed = missed[found < 0]

    def _planes_on(self, device: wp.Device) -> wp.array:
        if str(device) not in self._warp_planes:
            self._warp_planes[str(device)] = wp.array(self._planes, dtype=wp.vec4d, device=device)
        return self._warp_planes[str(device)]

    def _search(
        self, o: np.ndarray, d: np.ndarray, reach: np.ndarray, clearance: float, device: Any, backend: str
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N,) [m], float64, and face (N,) of what rays meet beyond ``clearance``; see `kernels.rays`.

        ``o`` and ``d`` hold one row or N, ``reach`` one number or N: how far it is worth looking.
        """
        where = _device.resolve(device)
        count = max(len(o), len(d)) if min(len(o), len(d)) else 0
        if _choose(backend, where, count) == "embree":
            return self._search_embree(o, d, clearance, where)
        t = wp.empty(count, dtype=wp.float64, device=where)
        face = wp.empty(count, dtype=wp.int32, device=where)
        inputs = [
            self.on_device(where).id, wp.vec3d(*self.center), self._radius, self._planes_on(where), clearance,
            _given(o, wp.vec3d, where), _given(d, wp.vec3d, where), _given(reach, wp.float64, where), t, face,
        ]  # fmt: skip
        _device.launch(cast_rays, count, inputs, device=where)
        return t.numpy(), face.numpy()

    def _search_embree(
        self, o: np.ndarray, d: np.ndarray, clearance: float, cpu: wp.Device, start: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        scene, names = self._embree
        count = max(len(o), len(d))
        t, face = np.empty(count), np.empty(count, dtype=np.int32)
        chunk = min(count, _EMBREE_CHUNK)
        rays = wp.empty(2 * chunk, dtype=wp.vec3, device=cpu)
        sizes = [wp.empty(chunk, dtype=wp.float64, device=cpu) for _ in range(2)]
        center, planes, faces = wp.vec3d(*self.center), self._planes_on(cpu), _given(names, wp.int32, cpu)
        given = [
            clearance, _given(np.empty(0) if start is None else start, wp.float64, cpu),
            _given(o, wp.vec3d, cpu), _given(d, wp.vec3d, cpu),
        ]  # fmt: skip
        out = [_given(t, wp.float64, cpu), _given(face, wp.int32, cpu)]
        pieces = _device.threads()
        for first in range(0, count, chunk):
            size = min(chunk, count - first)
            inputs = [first, center, self._radius, *given, rays, *sizes]
            _device.launch(pack_rays, size, inputs, device=cpu, pieces=pieces)
            met_at, met = scene.cast(rays.numpy().reshape(-1, 6)[:size])
            hits = [_given(met_at, wp.float32, cpu), _given(met, wp.int32, cpu)]
            inputs = [first, center, planes, faces, *given, *sizes, *hits, *out]
            _device.launch(place_hits, size, inputs, device=cpu, pieces=pieces)
        again = np.flatnonzero(face == AGAIN)
        if len(again):
            t[again], face[again] = self._search_embree(
                _rows(o, again), _rows(d, again), clearance, cpu, t[again]
            )
        return t, face


def _given(array: np.ndarray, dtype: Any, device: wp.Device) -> wp.array:
    """``array`` for a kernel, without a copy on a CPU."""
    return wp.array(array, dtype=dtype, device=device, copy=False)


def _rows(array: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Rows of rays that may hold one row for all."""
    return array if len(array) == 1 else array[index]


def _choose(backend: str, device: wp.Device, count: int) -> str:
    if backend not in BACKENDS:
        raise ValueError(f"backend: got {backend!r}, expected one of {', '.join(BACKENDS)}")
    if backend == "embree" and device.is_cuda:
        raise ValueError(f'backend: got "embree" on {device}, expected "warp" there, or device="cpu"')
    if backend != "auto" or count == 0:
        return "warp" if count == 0 else backend
    many = count >= EMBREE_RAYS and not device.is_cuda
    return "embree" if many and embree.installed() else "warp"


def _ray_arrays(origins: Any, directions: Any) -> tuple[np.ndarray, np.ndarray]:
    o = np.atleast_2d(_device.check_array("origins", origins, finite=False))
    d = np.atleast_2d(_device.check_array("directions", directions, finite=False))
    for name, array in (("origins", o), ("directions", d)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name}: got shape {array.shape}, expected (N, 3) or (3,)")
    if len(o) != len(d) and 1 not in (len(o), len(d)):
        raise ValueError(f"directions: got {len(d)} for {len(o)} origins, expected as many, or one of either")
    return o, d


def _check_rays(origins: np.ndarray, directions: np.ndarray) -> None:
    """Say what is wrong with rays of which a kernel found some to be bad."""
    for name, array in (("origins", origins), ("directions", directions)):
        _device.check_array(name, array)
    if (np.linalg.norm(directions, axis=1) == 0).any():
        raise ValueError("directions: got a vector of length zero, expected directions")
    raise ValueError("origins, directions: got numbers too large to square, expected metres")


def _closest_on_triangles(p: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Nearest point of triangle k to point k: the foot on the plane if inside, else the nearest on its edges."""
    corners = [triangles[:, k] for k in range(3)]
    ab, ac, ap = corners[1] - corners[0], corners[2] - corners[0], p - corners[0]
    gram = [np.einsum("ni,ni->n", x, y) for x, y in ((ab, ab), (ab, ac), (ac, ac), (ap, ab), (ap, ac))]
    det = gram[0] * gram[2] - gram[1] ** 2
    safe = np.where(det > 0, det, 1.0)
    v = (gram[2] * gram[3] - gram[1] * gram[4]) / safe
    w = (gram[0] * gram[4] - gram[1] * gram[3]) / safe
    inside = (det > 0) & (v >= 0) & (w >= 0) & (v + w <= 1)
    best = corners[0] + v[:, None] * ab + w[:, None] * ac
    best_distance = np.where(inside, np.linalg.norm(best - p, axis=1), np.inf)
    for k in range(3):
        start, edge = corners[k], corners[(k + 1) % 3] - corners[k]
        square = np.einsum("ni,ni->n", edge, edge)
        along = np.einsum("ni,ni->n", p - start, edge) / np.where(square > 0, square, 1.0)
        foot = start + along.clip(0.0, 1.0)[:, None] * edge
        distance = np.linalg.norm(foot - p, axis=1)
        nearer = distance < best_distance
        best[nearer], best_distance[nearer] = foot[nearer], distance[nearer]
    return best
