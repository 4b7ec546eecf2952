"""Line of sight and mirror paths of many receivers: the image method, with hard or soft blocking.

Hard blocking is for meshes that are true: a path is there if its mirror points lie in their patches and nothing stands
between. Soft blocking is for a surface fused from photos, which is right to centimetres and torn at its edges, so that a
single ray is a poor judge of what it lets through. Each path is tried along several rays that fill its first Fresnel
zone, widened by the mesh's position error; the share that arrives is taken as the share of the field (Kirchhoff's
approximation of a partly covered zone), so that power falls with its square.

Where :class:`~warprrf.rf.paths.slabs.Walls` are given, a path may also pass them. Its mirror points are the same, because a
slab does not bend its way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import ENDPOINT_CLEARANCE, Mesh, vectors_across
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.kernels.radio.records import EDGE, MIRROR, SLAB
from warprrf.rf.paths.images import MirrorImages
from warprrf.rf.paths.polarisation import turns
from warprrf.rf.paths.slabs import Slabs, Walls
from warprrf.rows import Rows


@dataclass(frozen=True)
class MirrorPaths(Rows):
    """Line of sight and mirror paths of several receivers, L rows, over up to K mirrors and slabs.

    Attributes:
        receiver: Index of the receiver, shape ``(L,)``.
        patch: Patches that mirror, from the transmitter on, -1 for a slab and past the last, shape ``(L, K)``.
        slab: Faces by which slabs are entered, -1 for a mirror and past the last, shape ``(L, K)``.
        point: Points where either is met [m], shape ``(L, K, 3)``; NaN past the last.
        share: Part of the field that is not blocked, shape ``(L,)``, in (0, 1].
        length_m: Unfolded length, shape ``(L,)``.
        excess_m: What slabs make it longer by for a wave, shape ``(L,)``; 0 where their materials were not asked.
        arrival: Unit direction from the receiver to what it sees last, shape ``(L, 3)``.
        normal: Unit normal of each, either way, shape ``(L, K, 3)``; NaN past the last.
        cosine: Cosine of incidence at each, 0 past the last, shape ``(L, K)``.
        turn: Angle of its plane of incidence to the one before [rad], shape ``(L, K)``; see :mod:`.polarisation`.
        thickness_m: Of a slab that is a solid, else NaN, shape ``(L, K)``.
        code: What happens at each: 1 mirror, 4 slab, 8 edge, 0 past the last, shape ``(L, K)`` int8. The mirror of a path over
            an edge has no patch: ``share`` counts it.
    """

    receiver: np.ndarray
    patch: np.ndarray
    slab: np.ndarray
    point: np.ndarray
    share: np.ndarray
    length_m: np.ndarray
    excess_m: np.ndarray
    arrival: np.ndarray
    normal: np.ndarray
    cosine: np.ndarray
    turn: np.ndarray
    thickness_m: np.ndarray
    code: np.ndarray

    @property
    def delay_m(self) -> np.ndarray:
        """How far light goes in air in the time that each takes [m], shape ``(L,)``."""
        return self.length_m + self.excess_m

    @property
    def order(self) -> np.ndarray:
        """Number of reflections, shape ``(L,)``: 0 is line of sight, or a path over an edge."""
        return (self.patch >= 0).sum(axis=1)

    @property
    def over_edge(self) -> np.ndarray:
        """Which go over an edge, shape ``(L,)``."""
        return np.asarray((self.code == EDGE).any(axis=1))

    @property
    def in_sight(self) -> np.ndarray:
        """Which are line of sight, shape ``(L,)``."""
        return (self.order == 0) & (self.slabs == 0) & ~self.over_edge

    @property
    def kind(self) -> NDArray[np.str_]:
        """``"los"``, ``"mirror"``, ``"slab"`` or ``"edge"``, shape ``(L,)``."""
        told = [self.over_edge, self.slabs > 0, self.order > 0]
        return np.select(told, ["edge", "slab", "mirror"], "los").astype("<U7")

    @property
    def slabs(self) -> np.ndarray:
        """Number of slabs that are passed, shape ``(L,)``."""
        return (self.slab >= 0).sum(axis=1)

    def of_width(self, most: int) -> MirrorPaths:
        """The same with ``most`` columns, the last ones left off or empty ones behind."""
        wide: dict[str, Any] = {}
        for name, empty in _EMPTY.items():
            column = getattr(self, name)[:, :most]
            pad = [(0, 0), (0, most - column.shape[1]), (0, 0)][: column.ndim]
            wide[name] = np.pad(column, pad, constant_values=empty)
        return replace(self, **wide)

    def of(self, receivers: np.ndarray) -> MirrorPaths:
        """The rows of ``receivers`` (N,), ascending, which are counted anew."""
        own = self.take(np.isin(self.receiver, receivers))
        return replace(own, receiver=np.searchsorted(receivers, own.receiver))


_EMPTY = {
    "patch": -1, "slab": -1, "point": np.nan, "normal": np.nan, "cosine": 0.0, "turn": 0.0, "thickness_m": np.nan, "code": 0,
}  # fmt: skip
"""What columns hold past a path's last mirror or slab."""


def exact_paths(
    images: MirrorImages,
    receivers: np.ndarray,
    order: int,
    progress: Progress | None = None,
    walls: Walls | None = None,
) -> MirrorPaths:
    """All unobstructed paths to ``receivers`` (R, 3) with at most ``order`` reflections, and those that ``walls`` let
    through, by receiver, then by order.

    A mirror point lies in its patch's faces. Paths through one place on two patches (faces that overlap, or the seam
    between them) count once.

    Raises:
        ValueError: before anything is traced, if more chains would be tried than ``images`` allow.
    """
    patches, source, parts = images.patches, images.transmitter, list[MirrorPaths]()
    for k, (row, patch, point) in enumerate(images.search(receivers, order, progress)):
        for j in range(k):
            own = patches.contains(patch[:, j], point[:, j])
            row, patch, point = row[own], patch[own], point[own]
        # Sheets closer than the tolerance don't hide each other: seen at a slant, their mirror points lie further apart.
        free = unobstructed(patches, source, receivers[row], patch, point, images.device)
        clear = np.flatnonzero(free)
        clear = clear[distinct(row[clear], point[clear], 3.0 * patches.tolerance_m)]
        found = row[clear], patch[clear], point[clear], np.ones(len(clear))
        parts.append(described(patches, source, receivers, found, order, walls))
        if walls is not None:
            dark = np.flatnonzero(~free)
            legs = legs_of(
                patches, source, receivers[row[dark]], patch[dark], point[dark], patches.tolerance_m
            )
            through, slabs = passed(walls, *legs)
            through = dark[through]
            own = distinct(row[through], point[through], 3.0 * patches.tolerance_m)
            own, slabs = through[own], [s.take(own) for s in slabs]
            found = row[own], patch[own], point[own], np.ones(len(own))
            parts.append(described(patches, source, receivers, found, order, walls, slabs))
    paths = MirrorPaths.joined(parts)
    return paths.take(np.argsort(paths.receiver, kind="stable"))


def zone_paths(
    images: MirrorImages,
    receivers: np.ndarray,
    order: int,
    wavelength_m: float,
    position_error_m: float,
    progress: Progress | None = None,
    walls: Walls | None = None,
) -> MirrorPaths:
    """Paths to ``receivers`` (R, 3) with at most ``order`` reflections, and what share of their Fresnel zones is free.

    A mirror point needs a surface of the patch at that place, not a face of exact outline. Of several reflections the
    middle ray must be free; line of sight and single mirrors may be partly covered anywhere. Where ``walls`` may be
    passed, a path whose middle ray meets some goes through what that one passes, with the share of its zone that arrives
    freely or through.

    Args:
        images: Its boxes say how far beside its faces a patch may still mirror.
        receivers: Positions [m].
        order: Most reflections.
        wavelength_m: Wavelength [m].
        position_error_m: Position error of the surface: zones are wider, and rays end that much before it [m].
        progress: Called with the stage ``"mirrors"``.
        walls: What may be passed.

    Returns:
        Rows by order. Those with less than a twentieth of their field, -26 dB, are left out.

    Raises:
        ValueError: before anything is traced, if more chains would be tried than ``images`` allow.
    """
    patches, source = images.patches, images.transmitter
    zone = ZoneRays(patches, source, wavelength_m, position_error_m, images.device)
    through = replace(zone, walls=walls)
    parts = list[MirrorPaths]()
    for k, (row, patch, point) in enumerate(images.search(receivers, order, progress)):
        kept = np.ones(len(row), bool)
        if k > 1 or walls is not None:
            free = zone.reached(receivers[row], patch, point)
            kept = free if k > 1 else kept
        if walls is not None:
            dark = np.flatnonzero(~free)
            dark = dark[through.reached(receivers[row[dark]], patch[dark], point[dark])]
            legs = legs_of(patches, source, receivers[row[dark]], patch[dark], point[dark], position_error_m)
            own, slabs = passed(walls, *legs)
            dark = dark[own]
            kept[dark] = False
            share = through.share(receivers[row[dark]], patch[dark], point[dark])
            found = row[dark], patch[dark], point[dark], share
            parts.append(described(patches, source, receivers, found, order, walls, slabs))
        row, patch, point = row[kept], patch[kept], point[kept]
        found = row, patch, point, zone.share(receivers[row], patch, point)
        parts.append(described(patches, source, receivers, found, order, walls))
    return MirrorPaths.joined(parts)


_RINGS = (0.0, 1), (0.5, 6), (0.9, 8)
"""Radii, as shares of a zone's, and numbers of rays: about equal areas each."""
_SAMPLES = np.array(
    [
        (radius * np.cos(a), radius * np.sin(a))
        for ring, (radius, count) in enumerate(_RINGS)
        for a in 2 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
    ]
)


@dataclass(frozen=True)
class ZoneRays:
    """Rays that fill Fresnel zones on a surface with a position error; see :func:`zone_paths`."""

    patches: PlanarPatches
    source: np.ndarray
    wavelength_m: float
    position_error_m: float
    device: DeviceLike
    walls: Walls | None = None

    def radius(self, near: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Radius of the first zone between two legs, widened by the mesh's error [m]."""
        return np.sqrt(
            self.wavelength_m * near * far / np.maximum(near + far, 1e-9) + self.position_error_m**2
        )

    def share(self, ends: np.ndarray, patch: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Share of each path's rays that arrive, shape ``(L,)``."""
        return self._mirror_share(ends, patch, point) if patch.shape[1] else self._direct_share(ends)

    def _direct_share(self, receivers: np.ndarray) -> np.ndarray:
        """That of line of sight, by rays over the zone's widest place."""
        count = len(receivers)
        way = self.source - receivers
        length = np.linalg.norm(way, axis=1)
        radius = self.radius(0.5 * length, 0.5 * length)
        u, v = vectors_across(way / np.maximum(length, 1e-12)[:, None])
        offset = _SAMPLES[:, 0, None] * u[:, None] + _SAMPLES[:, 1, None] * v[:, None]
        middle = (0.5 * (receivers + self.source))[:, None] + radius[:, None, None] * offset
        start = np.broadcast_to(receivers[:, None], middle.shape).reshape(-1, 3)
        middle = middle.reshape(-1, 3)
        free = self.clear(start, self._past(start, middle))
        left = np.flatnonzero(free)
        end = np.broadcast_to(self.source, (len(left), 3))
        free[left] = self.clear(self._past(end, middle[left]), end)
        return np.asarray(free.reshape(count, len(_SAMPLES)).mean(axis=1))

    def _past(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Points so far behind b, seen from a, that a ray to them misses nothing at b, where no surface is, shape ``(N, 3)``."""
        way = b - a
        length = np.linalg.norm(way, axis=1, keepdims=True)
        return np.asarray(b + 2.0 * self.position_error_m / np.maximum(length, 1e-12) * way)

    def _mirror_share(self, ends: np.ndarray, patch: np.ndarray, point: np.ndarray) -> np.ndarray:
        """That of mirror paths; a zone cuts a patch's plane in an ellipse, longer by 1 / cos."""
        count, order = patch.shape
        legs = np.diff(stops_of(self.source, point, ends), axis=1)
        lengths = np.linalg.norm(legs, axis=2)
        along = legs / np.maximum(lengths, 1e-12)[..., None]
        before = np.cumsum(lengths, axis=1)[:, :-1]
        radius = self.radius(before, lengths.sum(axis=1)[:, None] - before)
        around = np.repeat(point[:, None], len(_SAMPLES), axis=1)
        for k in range(order):
            normal = self.patches.normal[patch[:, k]]
            cosine = np.abs((along[:, k] * normal).sum(axis=1))
            across = np.cross(along[:, k], normal)
            size = np.linalg.norm(across, axis=1, keepdims=True)
            across = np.where(size > 1e-6, across / np.maximum(size, 1e-12), vectors_across(normal)[0])
            further = np.cross(normal, across) / np.maximum(cosine, 0.05)[:, None]
            offset = _SAMPLES[:, 0, None] * across[:, None] + _SAMPLES[:, 1, None] * further[:, None]
            around[:, :, k] += radius[:, k, None, None] * offset
        each, which = (np.repeat(a, len(_SAMPLES), axis=0) for a in (ends, patch))
        met = self.reached(each, which, around.reshape(-1, order, 3))
        return met.reshape(count, len(_SAMPLES)).mean(axis=1)

    def reached(
        self, ends: np.ndarray, patch: np.ndarray, point: np.ndarray, lift: np.ndarray | None = None
    ) -> np.ndarray:
        """Whether each leg reaches its patch and nothing stands between, or nothing but walls, shape ``(L,)``.

        ``lift`` is added to ``ends`` where rays start, for ends on a surface.
        """
        free = np.ones(len(patch), bool)
        here = ends if lift is None else ends + lift
        for k in range(patch.shape[1] - 1, -1, -1):
            own = np.flatnonzero(free)
            free[own] = self._meets(here[own], point[own, k], patch[own, k])
            normal, offset = self.patches.normal[patch[:, k]], self.patches.offset[patch[:, k]]
            side = np.sign((here * normal).sum(axis=1) - offset)
            here = point[:, k] + (self.position_error_m * side)[:, None] * normal
        own, last = np.flatnonzero(free), point[:, 0] if patch.shape[1] else here
        free[own] = self.clear(last[own], np.broadcast_to(self.source, (len(own), 3)))
        return free

    def clear(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether nothing lies between a and b (N, 3), or nothing but walls, but within the position error of either end."""
        way = b - a
        length = np.linalg.norm(way, axis=1)
        toward = way / np.maximum(length, 1e-12)[:, None]
        start = a + self.position_error_m * toward
        hit = self.patches.mesh.cast(start, toward, device=self.device)
        free = (length <= 2 * self.position_error_m) | (hit.t >= length - 2 * self.position_error_m)
        if self.walls is not None:
            dark = np.flatnonzero(~free)
            free[dark[self.walls.between(start[dark], b[dark])[0]]] = True
        return np.asarray(free)

    def _meets(self, start: np.ndarray, target: np.ndarray, patch: np.ndarray) -> np.ndarray:
        """Whether the ray from ``start`` first meets a surface, behind walls perhaps, at ``target``, on the plane of ``patch``."""
        p, reached = self.patches, np.ones(len(start), bool)
        if self.walls is not None:
            back = (start - target) / np.maximum(np.linalg.norm(start - target, axis=1, keepdims=True), 1e-12)
            before = target + 3.0 * self.position_error_m * back
            reached[:] = np.isin(np.arange(len(start)), self.walls.between(start, before)[0])
            start = before
        way = target - start
        length = np.linalg.norm(way, axis=1)
        hit = p.mesh.cast(start, way / np.maximum(length, 1e-12)[:, None], device=self.device)
        near = np.abs(hit.t - length) <= 2.0 * self.position_error_m
        met = p.face_patch[np.maximum(hit.face, 0)]
        # A torn seam of the patch passes for it, another patch does not.
        off = np.abs((np.nan_to_num(hit.point) * p.normal[patch]).sum(axis=1) - p.offset[patch])
        return (
            reached & (hit.face >= 0) & ((met == patch) | (near & (off <= self.position_error_m) & (met < 0)))
        )


def unobstructed(
    patches: PlanarPatches,
    source: np.ndarray,
    ends: np.ndarray,
    patch: np.ndarray,
    point: np.ndarray,
    device: DeviceLike,
) -> np.ndarray:
    """Whether every leg of each path is free, shape ``(L,)``.

    See :func:`legs_of`; a leg is also drawn out by the clearance that :meth:`Mesh.visible` leaves at ends, so that whatever
    lies further off than the tolerance is met.
    """
    begin, end = legs_of(patches, source, ends, patch, point, patches.tolerance_m)
    toward = (end - begin) / np.maximum(np.linalg.norm(end - begin, axis=2, keepdims=True), 1e-12)
    begin[:, 1:] -= ENDPOINT_CLEARANCE * toward[:, 1:]
    end[:, :-1] += ENDPOINT_CLEARANCE * toward[:, :-1]
    free = np.ones(len(patch), bool)
    for k in range(patch.shape[1] + 1):
        own = np.flatnonzero(free)
        free[own] = patches.mesh.visible(begin[own, k], end[own, k], device=device) if len(own) else False
    return free


def legs_of(
    patches: PlanarPatches,
    source: np.ndarray,
    ends: np.ndarray,
    patch: np.ndarray,
    point: np.ndarray,
    lift_m: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends of the legs of each path, shape ``(L, k + 1, 3)``: off their mirrors by ``lift_m``, so that the mirrors'
    own faces are not met."""
    stops = stops_of(source, point, ends)
    begin, end = stops[:, :-1].copy(), stops[:, 1:].copy()
    for k in range(patch.shape[1]):
        normal, offset = patches.normal[patch[:, k]], patches.offset[patch[:, k]]
        for place, leg, other in ((end, k, k), (begin, k + 1, k + 2)):
            side = np.sign((stops[:, other] * normal).sum(axis=1) - offset)
            place[:, leg] += (lift_m * side)[:, None] * normal
    return begin, end


def passed(walls: Walls, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, list[Slabs]]:
    """Which paths arrive through slabs, at most as many as ``walls`` allow, and what each leg passes on those."""
    rows, slabs = np.arange(len(begin)), list[Slabs]()
    for k in range(begin.shape[1]):
        arrived, found = walls.between(begin[rows, k], end[rows, k])
        rows, slabs = rows[arrived], [*(s.take(arrived) for s in slabs), found]
    count = sum((s.count for s in slabs), np.zeros(len(rows), int))
    few = np.flatnonzero((count > 0) & (count <= walls.most))
    return rows[few], [s.take(few) for s in slabs]


def distinct(row: np.ndarray, point: np.ndarray, distance_m: float) -> np.ndarray:
    """Indices of paths that no earlier one of the same receiver repeats, all points within ``distance_m``, sorted."""
    if point.shape[1] == 0 or len(row) < 2:
        return np.arange(len(row))
    # Other receivers' points are further away than any of its own that count.
    place = np.column_stack([3.0 * distance_m * row, point[:, 0]])
    a, b = cKDTree(place).query_pairs(distance_m, output_type="ndarray").T
    same = np.zeros(len(row), bool)
    same[b[(np.linalg.norm(point[a] - point[b], axis=2) <= distance_m).all(axis=1)]] = True
    return np.flatnonzero(~same)


def described(
    patches: PlanarPatches,
    source: np.ndarray,
    receivers: np.ndarray,
    found: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    order: int,
    walls: Walls | None = None,
    slabs: list[Slabs] | None = None,
) -> MirrorPaths:
    """Rows of paths of one order (receiver, patch, point, share) over what ``slabs`` each leg passes, what they lack of all
    columns filled up."""
    kept = np.flatnonzero(found[3] >= 0.05)
    row, patch, point, share = (a[kept] for a in found)
    most = max(order, 1) + (walls.most if walls else 0)
    normal, slab = patches.normal[patch], np.full(patch.shape, -1, np.int32)
    thickness = np.full(patch.shape, np.nan)
    if slabs is not None:
        stops = stops_of(source, point, receivers[row])
        columns: list[tuple[np.ndarray, ...]] = []
        for k, s in enumerate(s.take(kept) for s in slabs):
            here = stops[:, k, None]
            at, turned = met_at(patches.mesh, s.face, here, stops[:, k + 1, None] - here)
            columns.append((np.full_like(s.face, -1), s.face, at, turned, s.thickness_m))
            columns.append(tuple(a[:, k : k + 1] for a in (patch, slab, point, normal, thickness)))
        patch, slab, point, normal, thickness = (
            np.concatenate(c, axis=1) for c in zip(*columns, strict=True)
        )
        first = np.argsort((patch < 0) & (slab < 0), axis=1, kind="stable")
        patch, slab, thickness = (np.take_along_axis(a, first, axis=1) for a in (patch, slab, thickness))
        point, normal = (np.take_along_axis(a, first[..., None], axis=1) for a in (point, normal))
    count = ((patch >= 0) | (slab >= 0)).sum(axis=1)
    length, arrival = np.zeros(len(row)), np.zeros((len(row), 3))
    cosine, turn = np.zeros((2, *patch.shape))
    for k in np.unique(count):
        own = np.flatnonzero(count == k)
        stops = stops_of(source, point[own, :k], receivers[row[own]])
        legs = np.diff(stops, axis=1)
        lengths = np.linalg.norm(legs, axis=2)
        along = legs / np.maximum(lengths, 1e-12)[..., None]
        length[own], arrival[own] = lengths.sum(axis=1), -along[:, -1]
        cosine[own, :k] = np.abs((along[:, :-1] * normal[own, :k]).sum(axis=2))
        turn[own, :k] = turns(stops, normal[own, :k])

    code = np.where(slab >= 0, SLAB, np.where(patch >= 0, MIRROR, 0)).astype(np.int8)
    return MirrorPaths(
        row, patch, slab, point, share, length, 0.0 * length, arrival, normal, cosine, turn, thickness, code
    ).of_width(most)


def met_at(mesh: Mesh, face: np.ndarray, start: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where ``way`` (..., 3) from ``start`` meets the planes of faces ``face`` (...), and their normals, shape ``(..., 3)``;
    NaN for no face (-1)."""
    normal = np.where((face >= 0)[..., None], mesh.face_normals[face], np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):  # where none is met
        part = ((mesh.triangles[face, 0] - start) * normal).sum(axis=-1) / (way * normal).sum(axis=-1)
    return start + part[..., None] * way, normal


def stops_of(source: np.ndarray, point: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Transmitter, mirror points and receiver of each path, shape ``(L, k + 2, 3)``."""
    return np.concatenate([np.broadcast_to(source, (len(ends), 1, 3)), point, ends[:, None]], axis=1)
