"""Triangle mesh with ray queries: visibility, surface hits and closest points, in metres.

The bounding volume hierarchy is Warp's, or Embree's for many rays on a CPU, in float32 and about the mesh's own
centre; it names the face that is hit. Distances and points are then recomputed in float64 from that face's plane,
because at 300 GHz a wavelength is 1 mm and float32 alone errs by 5e-5 m at 5 m. Hierarchies are built at the first
query, which may come from several threads at once.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from warprrf.cache import Cache, cached_property
from warprrf.checks import (
    LARGEST_M,
    Count,
    NotNegative,
    Number,
    check_array,
    check_similarity,
    checked,
    one_line,
)
from warprrf.device import DeviceLike, launch, resolve
from warprrf.geometry.mesh_files import load_mesh
from warprrf.geometry.rays import Hit, RaySearch, check_rows
from warprrf.kernels.rays.mesh import closest_faces, find_crossings, find_touching
from warprrf.rows import couples, distinct_rows

ENDPOINT_CLEARANCE = 1e-4
"""Length at both ends of a segment in which :meth:`Mesh.visible` ignores surfaces [m]."""


LARGEST_HOLE = 0.4, 1.0
"""Holes no larger than this share of a surface, and than this [m], leave it an inside: a scan's do, a doorway doesn't."""
_KEPT = ("vertices", "faces", "face_colours", "face_label", "labels")


@dataclass(frozen=True)
class Closest:
    """Nearest surface points.

    Attributes:
        distance: Distance to the surface [m], shape ``(N,)``.
        point: Nearest point on the surface [m], shape ``(N, 3)``.
        face: Its face, shape ``(N,)``, int32.
    """

    __repr__ = one_line

    distance: np.ndarray
    point: np.ndarray
    face: np.ndarray


@checked
class Mesh:
    """A triangle mesh in metres, and what is known of its faces: they tell a radio field which surfaces are alike.

    Args:
        vertices: Positions [m], shape ``(V, 3)``; kept in float64.
        faces: Vertex indices, shape ``(F, 3)``, counter-clockwise seen from outside.
        face_colours: Colours as a photo has them (sRGB, 0 to 1), shape ``(F, 3)``, NaN where unknown.
        face_label: Index into ``labels`` of each face, -1 for none, shape ``(F,)``.
        labels: Names that tell what faces are made of; their file's names of materials.

    Raises:
        TypeError: if the arguments don't read as arrays, or faces are not whole numbers.
        ValueError: on a wrong shape, no face that has an area, an index out of range, or vertices that are not finite.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        face_colours: ArrayLike | None = None,
        face_label: ArrayLike | None = None,
        labels: Sequence[str] = (),
    ) -> None:
        self.vertices: np.ndarray = check_array("vertices", vertices, (None, 3)).copy()
        if np.abs(self.vertices).max(initial=0.0) > LARGEST_M:
            raise ValueError(
                f"vertices: got coordinates up to {np.abs(self.vertices).max():g} m, expected at most {LARGEST_M:g}"
            )
        self.faces: np.ndarray = check_array("faces", faces, (None, 3), dtype=np.int32).copy()
        if len(self.faces) == 0:
            raise ValueError("faces: got none, expected at least one triangle")
        low, high = int(self.faces.min()), int(self.faces.max())
        if low < 0 or high >= len(self.vertices):
            raise ValueError(
                f"faces: got indices from {low} to {high}, expected 0 to {len(self.vertices) - 1} "
                f"for {len(self.vertices)} vertices"
            )
        if not np.cross(*np.diff(self.vertices[self.faces], axis=1).swapaxes(0, 1)).any():
            raise ValueError("faces: got none that has an area, expected at least one")
        for array in (self.vertices, self.faces):
            _fixed(array)
        self.face_colours = self._checked_colours(face_colours)
        self.face_label, self.labels = self._checked_labels(face_label, labels)
        self._boxed = Cache(8)

    def _checked_colours(self, colours: ArrayLike | None) -> np.ndarray | None:
        if colours is None:
            return None
        found = check_array(
            "face_colours", colours, (len(self.faces), 3), dtype=np.float32, finite=False
        ).copy()
        if not ((found >= 0) & (found <= 1) | np.isnan(found)).all():
            raise ValueError("face_colours: got values outside 0 to 1, expected sRGB, NaN where unknown")
        return _fixed(found)

    def _checked_labels(
        self, material: ArrayLike | None, names: Sequence[str]
    ) -> tuple[np.ndarray | None, tuple[str, ...]]:
        if isinstance(names, str) or not all(isinstance(name, str) for name in names):
            raise TypeError(f"labels: got {names!r:.60}, expected a list of names")
        if material is None:
            if len(names):
                raise ValueError("face_label: got none, expected one index a face to labels")
            return None, ()
        found = check_array("face_label", material, (len(self.faces),), dtype=np.int32).copy()
        if found.min() < -1 or found.max() >= len(names):
            raise ValueError(
                f"face_label: got indices from {found.min()} to {found.max()}, expected -1 (none) to {len(names) - 1}"
            )
        return _fixed(found), tuple(names)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        unit: str | None = None,
        up: str | None = None,
        *,
        simplify: int | None = None,
        allow_outside: bool = False,
    ) -> Mesh:
        """Read a mesh file: PLY, OBJ, STL, glTF or GLB, by the suffix.

        Instances stand in their places. Vertices at one place become one. Colours come from textures (sampled in each
        face), vertices or materials. Names are those of materials; numbered pages of a scan's texture are none.

        Args:
            path: The file.
            unit: Its unit of length, ``"mm"``, ``"cm"``, ``"m"``, ``"in"`` or ``"ft"``; metres by default, as glTF has it.
            up: Its axis that points up, ``"x"``, ``"y"`` or ``"z"``. By default ``"y"`` for glTF, which says so, and
                ``"z"`` for the others, which don't say: OBJ files are often y-up. Of a y-up file x stays, y becomes z.
            simplify: Most triangles (about); by default all stay. Colours and names are those of the nearest face.
            allow_outside: Whether the file may name materials, textures and buffers outside its folder.

        Raises:
            OSError: naming the file, if it cannot be read.
            ValueError: naming it, if it is damaged or holds no triangles; for an unknown unit or axis.
            ImportError: if the package that the format or ``simplify`` needs is not installed.

        Warns:
            UserWarning: if no unit is given and the size is no room's or city's in metres, or a texture is missing.

        Example:
            >>> mesh = Mesh.load("room.stl", unit="mm")  # doctest: +SKIP
        """
        content = load_mesh(path, unit=unit, up=up, simplify=simplify, allow_outside=allow_outside)
        return cls(content.vertices, content.faces, **content.known)

    def __repr__(self) -> str:
        known = f", labels {', '.join(self.labels)}" if self.labels else ""
        colours = ", colours" if self.face_colours is not None else ""
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces{known}{colours})"

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in _KEPT}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    @cached_property
    def triangles(self) -> np.ndarray:
        """Corner positions [m], shape ``(F, 3, 3)``."""
        return _fixed(self.vertices[self.faces])

    @cached_property
    def _crosses(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> np.ndarray:
        """Face areas [m^2], shape ``(F,)``."""
        return _fixed(0.5 * np.linalg.norm(self._crosses, axis=1))

    @cached_property
    def face_normals(self) -> np.ndarray:
        """Unit normals by winding, shape ``(F, 3)``; zero for a face without area."""
        length = np.linalg.norm(self._crosses, axis=1, keepdims=True)
        return _fixed(np.divide(self._crosses, length, out=np.zeros_like(self._crosses), where=length > 0))

    @cached_property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of the box around the faces [m], shape ``(2, 3)``."""
        corners = self.vertices[np.unique(self.faces)]
        return _fixed(np.stack([corners.min(axis=0), corners.max(axis=0)]))

    @cached_property
    def rounding_m(self) -> float:
        """What float32 may have rounded coordinates by [m]: about the mesh's own centre, or where they were rounded.

        A mesh that was rounded far from its centre has coordinates that are odd multiples of float32's spacing there.
        """
        near = float(np.spacing(np.float32(0.5 * np.ptp(self.bounds, axis=0).max())))
        step = np.spacing(np.abs(self.vertices).astype(np.float32)).astype(float)
        count = self.vertices / step
        if not (count == np.rint(count)).all():
            return near
        return max(near, float(step[count % 2 == 1].max(initial=0.0)))

    @cached_property
    def weld_m(self) -> float:
        """How near to each other vertices are one [m]: 1e-6 of the box's half diagonal."""
        return max(2.0 * self.rounding_m, 0.5e-6 * float(np.linalg.norm(np.ptp(self.bounds, axis=0))))

    @cached_property
    def places(self) -> np.ndarray:
        """Position of each index of :attr:`welded_faces` [m]."""
        place = np.zeros((int(self.welded_faces.max()) + 1, 3))
        place[self.welded_faces.reshape(-1)[::-1]] = self.triangles.reshape(-1, 3)[::-1]
        return place

    @cached_property
    def welded_faces(self) -> np.ndarray:
        """Faces with vertices at one place (:attr:`weld_m`) given one index, shape ``(F, 3)``."""
        first, index, _ = distinct_rows(self.vertices)
        point = self.vertices[first]
        near = cKDTree(point - self.center).query_pairs(self.weld_m, output_type="ndarray")
        return components(len(point), near)[index][self.faces]

    @cached_property
    def first_at_place(self) -> np.ndarray:
        """The first face with the same three corners: itself unless it repeats one, however wound, shape ``(F,)``."""
        first, index, _ = distinct_rows(np.sort(self.welded_faces, axis=1))
        return first[index]

    @cached_property
    def is_closed(self) -> bool:
        """Whether every edge, after welding, and cut where others end, belongs to an even number of faces.

        Faces whose corners fall together and repeats of a face are left out: they open and close nothing.
        """
        return len(self.cornered_faces) > 0 and not (distinct_rows(self._edges[0])[2] % 2).any()

    @cached_property
    def distinct_faces(self) -> np.ndarray:
        """Faces of which no earlier one has the same three corners, however wound, shape ``(K,)``."""
        return np.unique(self.first_at_place)

    @cached_property
    def cornered_faces(self) -> np.ndarray:
        """Those of :attr:`distinct_faces` whose corners do not fall together, shape ``(K,)``."""
        corner = self.welded_faces[self.distinct_faces]
        return self.distinct_faces[(corner != np.roll(corner, 1, axis=1)).all(axis=1)]

    @cached_property
    def closed_part_of(self) -> np.ndarray:
        """Which closed part of the surface each face belongs to, -1 for none and for a repeat of a face, shape ``(F,)``.

        A connected part is closed, and so has an inside, if all its edges belong to an even number of faces, or if its
        holes are small, as a scan's (:data:`LARGEST_HOLE`). A sheet has none, nor has a room with a doorway.
        """

        def diagonals(points: np.ndarray, owner: np.ndarray) -> np.ndarray:
            boxes = boxes_of(points, owner, owner.max(initial=-1) + 1)
            return np.asarray(np.linalg.norm(np.ptp(boxes, axis=1), axis=1))

        (edge, owner), part = self._edges, components(len(self.faces), self.neighbours)[self.cornered_faces]
        part = np.unique(part, return_inverse=True)[1]
        first, _, count = distinct_rows(edge)
        rim = first[count % 2 == 1]
        own, ends = part[owner[rim]], edge[rim]
        # Holes that touch in a vertex are two: borders go on where exactly two edges meet.
        border = components(len(rim), couples(np.column_stack([own.repeat(2), ends.reshape(-1)])).T // 2)
        faces = np.bincount(part)
        hole = np.zeros(len(faces))
        np.maximum.at(hole, own, diagonals(self.places[ends], border)[border])
        share, most = LARGEST_HOLE
        size = diagonals(self.triangles[self.cornered_faces], part)
        closed = (faces > 3) & (hole <= np.minimum(share * size, most))
        found = np.full(len(self.faces), -1)
        found[self.cornered_faces] = np.where(closed, np.cumsum(closed) - 1, -1)[part]
        return found

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Pairs of :attr:`cornered_faces` that share a side, or a part of one, shape ``(N, 2)``."""
        edge, owner = self._edges
        return _sharing(edge, self.cornered_faces[owner])

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges of :attr:`cornered_faces`, ``(N, 2)``, and which of these each is of; at a border cut where others end."""
        edge = sides_of(self.welded_faces[self.cornered_faces])
        owner = np.arange(len(edge)) // 3
        _, index, count = distinct_rows(edge)
        loose = count[index] % 2 == 1
        if not loose.any():
            return edge, owner
        at = np.unique(edge[loose])
        start, end = self.places[edge[loose].T]
        radius = np.linalg.norm(end - start, axis=1) / 2 + self.weld_m
        near = cKDTree(self.places[at]).query_ball_point((start + end) / 2, radius)
        row = np.repeat(np.arange(len(near)), [len(n) for n in near])
        pieces, row = cut(edge[loose], row, at[np.concatenate(near)], self)
        return np.concatenate([edge[~loose], pieces]), np.concatenate([owner[~loose], owner[loose][row]])

    @cached_property
    def closed_parts(self) -> list[Mesh]:
        """The parts of :attr:`closed_part_of`, each a mesh of its own."""
        count = self.closed_part_of.max() + 1
        return [Mesh(self.vertices, self.faces[self.closed_part_of == k]) for k in range(count)]

    def parts_by_box(self, reach_m: float) -> np.ndarray:
        """Number of each of :attr:`closed_parts`; copies fill one box, to ``reach_m``, and have one."""
        boxes = np.array([part.bounds.ravel() for part in self.closed_parts]).reshape(-1, 6)
        return components(len(boxes), cKDTree(boxes).query_pairs(reach_m, output_type="ndarray"))

    @cached_property
    def center(self) -> np.ndarray:
        """Middle of the bounds [m], shape ``(3,)``: the origin of the float32 copy that devices hold."""
        return _fixed(self.bounds.mean(axis=0))

    @cached_property
    def _rays(self) -> RaySearch:
        return RaySearch(self.vertices, self.faces, self.face_normals, self.bounds)

    def on_device(self, device: DeviceLike = None) -> wp.Mesh:
        """The Warp mesh on ``device`` with its vertices relative to :attr:`center`, built once per device."""
        return self._rays.on_device(resolve(device))[0]

    def cast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        per_origin: Count = 1,
        device: DeviceLike = None,
        backend: str = "auto",
    ) -> Hit:
        """The nearest surface along rays; one that passes through a ray's very start is not met.

        Args:
            origins: Ray starts [m], shape ``(N, 3)`` or ``(3,)`` for all.
            directions: Ray directions, any length but zero, shape ``(N, 3)`` or ``(3,)`` for all.
            per_origin: Rays of each origin, one origin's after another's; directions may be as many, for all origins.
            device: Where the hierarchy is searched.
            backend: One of :data:`~warprrf.geometry.rays.BACKENDS`. All agree on distances; on an edge they may
                name either face.

        Returns:
            Hits in float64. On a closed mesh a ray from inside that slips through between faces is cast again, turned
            by 1e-5 rad.

        Raises:
            ValueError: on a wrong shape, NaN, a direction of length zero, an unknown back end, or Embree on a GPU.
            ImportError: if Embree is asked for and Open3D is not installed.
        """
        o, d = check_rows(("origins", origins), ("directions", directions), per_origin)
        where = resolve(device)
        t, face = self._rays.nearest(o, d, per_origin=per_origin, device=where, backend=backend)
        if face.min(initial=0) < 0 and self.is_closed:
            self._rays.recast(o, d, t, face, per_origin=per_origin, device=where, backend=backend)
        # Points may be asked for after the caller has changed its arrays.
        return Hit(t, face, self.face_normals, o.copy(), d.copy(), per_origin)

    def visible(
        self,
        a: ArrayLike,
        b: ArrayLike,
        *,
        device: DeviceLike = None,
        clearance: NotNegative = ENDPOINT_CLEARANCE,
        backend: str = "auto",
    ) -> np.ndarray:
        """Whether nothing lies strictly between points.

        Args:
            a: Ends [m], shape ``(N, 3)`` or ``(3,)`` for all.
            b: Other ends [m], shape ``(N, 3)`` or ``(3,)`` for all.
            clearance: Surfaces nearer than this to either end, measured along the segment, don't block [m]: ends may
                lie on surfaces. Distances are judged in float64, so it need not cover float32 errors.
            device, backend: As for :meth:`cast`.

        Returns:
            Shape ``(N,)``, bool.
        """
        start, end = check_rows(("a", a), ("b", b))
        where = resolve(device)
        return self._rays.free(start, end, clearance=clearance, device=where, backend=backend)

    def closest(self, points: ArrayLike, *, device: DeviceLike = None) -> Closest:
        """The nearest point of the surface to each of ``points`` (N, 3) [m], in float64 once the face is known."""
        p = check_array("points", points, (None, 3))
        where = resolve(device)
        face = wp.zeros(len(p), dtype=wp.int32, device=where)
        reach = float(
            np.abs(p - self.center).max(initial=0.0) * 4.0 + np.ptp(self.bounds, axis=0).sum() * 4.0 + 1.0
        )
        launch(
            closest_faces,
            len(p),
            [self.on_device(where).id, p - self.center, reach, face],
            device=where,
        )
        index = face.numpy()
        nearest = _closest_on_triangles(p, self.triangles[index])
        return Closest(distance=np.linalg.norm(nearest - p, axis=1), point=nearest, face=index)

    def distance(self, points: ArrayLike, *, device: DeviceLike = None) -> np.ndarray:
        """Distance from each of ``points`` (N, 3) [m] to the surface [m], shape ``(N,)``."""
        return self.closest(points, device=device).distance

    def crossings(
        self, points: ArrayLike, directions: ArrayLike, *, device: DeviceLike = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """What rays in the same ``directions`` (D, 3) cross from each of ``points`` (N, 3) [m].

        Returns:
            How many surfaces they leave less those that they enter, by the surfaces' normals, repeated faces once; of a
            closed mesh that is the winding number, whatever the direction. And the side from which they meet the first:
            1 where its normal points to the point, -1 where it points away, 0 where there is none. Shapes ``(N, D)``,
            int32.
        """
        p, d = check_array("points", points, (None, 3)), check_array("directions", directions, (None, 3))
        where = resolve(device)
        bvh, corners = self._boxes(where)
        winding, side = (wp.zeros(len(p) * len(d), dtype=wp.int32, device=where) for _ in range(2))
        inputs = [bvh.id, corners, p - self.center, d, winding, side]
        launch(find_crossings, len(p) * len(d), inputs, device=where)
        return winding.numpy().reshape(len(p), len(d)), side.numpy().reshape(len(p), len(d))

    def faces_at(
        self, points: ArrayLike, reach_m: NotNegative, *, device: DeviceLike = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """All faces that ``points`` (N, 3) [m] lie on, to ``reach_m``: index of the point and face, by point, ``(L,)`` each.

        Of repeated faces the first is named.
        """
        p = check_array("points", points, (None, 3))
        where = resolve(device)
        bvh, corners = self._boxes(where)
        put = wp.array(p - self.center, dtype=wp.vec3d, device=where)
        start, count, face = (wp.zeros(n, dtype=wp.int32, device=where) for n in (len(p), len(p), 0))
        for _ in range(2):  # how many, then which
            launch(find_touching, len(p), [bvh.id, corners, put, reach_m, start, count, face], device=where)
            many = count.numpy()
            start = wp.array(np.cumsum(many) - many, dtype=wp.int32, device=where)
            row = np.repeat(np.arange(len(p)), many)
            if face.shape[0] == 0:
                face = wp.zeros(len(row), dtype=wp.int32, device=where)
        found = self.distinct_faces[face.numpy()]
        order = np.lexsort((found, row))  # trees differ by device
        return row, found[order]

    def _boxes(self, where: wp.Device) -> tuple[wp.Bvh, wp.array]:
        """Boxes of the distinct faces, which a ray can be asked for all of, and their corners about the centre."""

        def build() -> tuple[wp.Bvh, wp.array]:
            corners = self.triangles[self.distinct_faces] - self.center
            margin = 1e-6 * float(np.ptp(self.bounds, axis=0).max())
            bounds = [corners.min(axis=1) - margin, corners.max(axis=1) + margin]
            low, high = (wp.array(x, dtype=wp.vec3, device=where) for x in bounds)
            bvh = wp.Bvh(low, high, constructor="sah")  # as on a CPU
            return bvh, wp.array(corners, dtype=wp.vec3d, device=where)

        return self._boxed.get(str(where), build)

    def transformed(
        self, *, scale: float = 1.0, rotation: ArrayLike | None = None, shift: ArrayLike = (0.0, 0.0, 0.0)
    ) -> Mesh:
        """The mesh at ``scale rotation x + shift``, with what is known of its faces.

        Arguments and errors: see :func:`warprrf.checks.check_similarity`.
        """
        scale, turn, moved = check_similarity(scale, rotation, shift)
        return Mesh(**self.__getstate__() | {"vertices": scale * self.vertices @ turn.T + moved})

    def cross_section(self, height: Number) -> np.ndarray:
        """Line segments in which the surface meets the plane z = ``height`` [m]: a floor plan, shape ``(S, 2, 2)`` [m]."""
        a, b = self.triangles, np.roll(self.triangles, -1, axis=1)
        crosses = (a[:, :, 2] > height) != (b[:, :, 2] > height)
        a, way = a[crosses], (b - a)[crosses]
        share = (height - a[:, 2:]) / way[:, 2:]
        return (a + share * way)[:, :2].reshape(-1, 2, 2)


def _fixed(array: np.ndarray) -> np.ndarray:
    """``array``, which is kept and handed out: nobody may write into it."""
    array.setflags(write=False)
    return array


def vectors_across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across each unit direction ``(N, 3)`` and each other."""
    u = headings(np.cross(direction, np.eye(3)[np.abs(direction).argmin(axis=1)]))[0]
    return u, np.cross(direction, u)


def headings(way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions of ways ``(..., 3)`` and their lengths ``(...)``; one without length has no direction: zeros."""
    length = np.linalg.norm(way, axis=-1)
    return way / np.maximum(length, 1e-12)[..., None], length


class Geometry(Protocol):
    """Anything with a mesh: a Reconstruction, a Scene, planar patches, a fitted field's surface."""

    @property
    def mesh(self) -> Mesh:
        """Its surfaces."""


GeometryLike: TypeAlias = Mesh | Geometry
"""What functions that need a room's surfaces take: a mesh or anything that has one."""


def as_mesh(mesh_or_scene: GeometryLike, name: str = "mesh_or_scene") -> Mesh:
    """The mesh of a scene, a reconstruction or anything else that has one, or the mesh itself; ``name`` is
    the argument that it came by.
    """
    if isinstance(mesh_or_scene, Mesh):
        return mesh_or_scene
    mesh = getattr(mesh_or_scene, "mesh", None)
    if isinstance(mesh, Mesh):
        return mesh
    raise TypeError(
        f"{name}: got {type(mesh_or_scene).__name__}, expected a Mesh, a Scene or anything else with a mesh"
    )


def _closest_on_triangles(p: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Nearest point of triangle k to point k: the foot on the plane if inside, else the nearest on its edges."""
    edge, off = np.roll(triangles, -1, axis=1) - triangles, p[:, None] - triangles
    square = (edge**2).sum(axis=2)
    along = (off * edge).sum(axis=2) / np.where(square > 0, square, 1.0)
    feet = triangles + along.clip(0.0, 1.0)[..., None] * edge
    normal = np.cross(edge[:, 0], edge[:, 1])[:, None]
    size = (normal**2).sum(axis=2)
    inside = ((np.cross(edge, off) * normal).sum(axis=2) >= 0).all(axis=1) & (size[:, 0] > 0)
    height = (off[:, :1] * normal).sum(axis=2) / np.where(size > 0, size, 1.0)
    feet = np.concatenate([p[:, None] - height[..., None] * normal, feet], axis=1)
    distance = np.linalg.norm(feet - p[:, None], axis=2)
    distance[~inside, 0] = np.inf
    return feet[np.arange(len(p)), distance.argmin(axis=1)]


def boxes_of(points: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """Lowest and highest corner of the ``points`` (N, K, 3) of each of ``count`` owners, shape ``(count, 2, 3)``."""
    boxes = np.full((count, 2, 3), np.inf) * [[1.0], [-1.0]]
    np.minimum.at(boxes[:, 0], owner, points.min(axis=1))
    np.maximum.at(boxes[:, 1], owner, points.max(axis=1))
    return boxes


def components(count: int, pairs: np.ndarray) -> np.ndarray:
    """Number of the connected component of each of ``count`` things, of which ``pairs`` (N, 2) are linked, ``(count,)``."""
    link = sparse.coo_array((np.ones(len(pairs), bool), pairs.T), shape=(count, count))
    return csgraph.connected_components(link, directed=False)[1]


def sides_of(corner: np.ndarray) -> np.ndarray:
    """Sides of the faces ``corner`` (F, 3), the smaller index first, shape ``(3 F, 2)``."""
    return np.sort(corner[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)


def cut(sides: np.ndarray, row: np.ndarray, at: np.ndarray, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Pieces (P, 2) of ``sides`` (S, 2) between those places ``at`` (N,) of a mesh that lie on the side ``row`` (N,), its ends
    among them; and of which side each is, ``(P,)``."""
    start, end = mesh.places[sides.T]
    along, length = headings(end - start)
    way = mesh.places[at] - start[row]
    far = (way * along[row]).sum(axis=1)
    on = np.linalg.norm(way - far.clip(0.0, length[row])[:, None] * along[row], axis=1) <= mesh.weld_m
    order = np.flatnonzero(on)[np.lexsort((far[on], row[on]))]
    first, last = order[:-1], order[1:]
    same = row[first] == row[last]
    return np.sort(at[np.column_stack([first, last])[same]], axis=1), row[first[same]]


def edge_pairs(corner: np.ndarray) -> np.ndarray:
    """Pairs of the faces ``corner`` (F, 3) that share a side, shape ``(N, 2)``."""
    return _sharing(sides_of(corner), np.repeat(np.arange(len(corner)), 3))


def _sharing(edge: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Pairs of the ``owner`` (E,) of equal rows of ``edge`` (E, 2), shape ``(N, 2)``."""
    order = np.lexsort((owner, edge[:, 1], edge[:, 0]))
    edge, owner = edge[order], owner[order]
    # Where more than two faces share an edge, neighbours in sorted order are not all pairs: look three ahead.
    pairs = [np.zeros((0, 2), int)]
    for step in (1, 2, 3):
        same = (edge[step:] == edge[:-step]).all(axis=1)
        pairs.append(np.column_stack([owner[:-step][same], owner[step:][same]]))
    return np.concatenate(pairs)


def face_neighbours(faces: np.ndarray) -> np.ndarray:
    """The face across each edge, -1 at a border (and at edges of more than two faces), shape ``(F, 3)`` int64."""
    pairs = couples(sides_of(faces))
    across = np.full(3 * len(faces), -1, dtype=np.int64)
    across[pairs] = pairs[::-1] // 3
    return across.reshape(-1, 3)


def joined(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> Mesh:
    """One mesh of vertices ``(V, 3)`` and faces ``(F, 3)`` of each part, in their order; nothing is welded."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, first, strict=False)]
    return Mesh(np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces))


def connected_pieces(mesh: Mesh, label: np.ndarray) -> np.ndarray:
    """Numbers of the connected pieces of faces that share a label, shape ``(F,)``; a face labelled -1 is a piece."""
    ring = face_neighbours(mesh.faces)
    face, side = np.nonzero((ring >= 0) & (label >= 0)[:, None] & (label[ring] == label[:, None]))
    return components(len(label), np.column_stack([face, ring[face, side]]))


def smoothed_normals(mesh: Mesh, rounds: int) -> np.ndarray:
    """Face normals averaged, by area, with those of the faces across the edges, ``rounds`` times, shape ``(F, 3)``.

    A face across a sharp edge (more than 45 degrees) takes no part.
    """
    ring = face_neighbours(mesh.faces)
    normals = np.nan_to_num(mesh.face_normals)
    area = np.where(ring >= 0, mesh.areas[ring], 0.0)
    for _ in range(rounds):
        weight = np.where(np.einsum("fi,fki->fk", normals, normals[ring]) > np.sqrt(0.5), area, 0.0)[
            ..., None
        ]
        total = mesh.areas[:, None] * normals + (weight * normals[ring]).sum(axis=1)
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return normals
