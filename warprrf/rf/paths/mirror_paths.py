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

from warprrf.device import Progress
from warprrf.geometry.mesh import Mesh, headings, vectors_across
from warprrf.kernels.radio.records import EDGE, MIRROR, SLAB
from warprrf.rf.paths.images import MirrorImages
from warprrf.rf.paths.polarisation import across_incidence, turns
from warprrf.rf.paths.slabs import Walls
from warprrf.rf.paths.ways import Ways, distinct, stops_of
from warprrf.rows import Rows


@dataclass(frozen=True)
class MirrorPaths(Rows):
    """Paths without scattering of several receivers, L rows: line of sight, over up to K mirrors and slabs, and over edges.

    Attributes:
        receiver: Index of the receiver, shape ``(L,)``.
        patch: Patches that mirror, from the transmitter on, -1 for a slab and past the last, shape ``(L, K)``.
        slab: Faces by which slabs are entered, -1 for a mirror and past the last, shape ``(L, K)``.
        point: Points where either is met [m], shape ``(L, K, 3)``; NaN past the last.
        share: Field over that of a free path of this length, shape ``(L,)``: what blocking leaves, in (0, 1], or all that an edge
            makes of it with its mirror or slab.
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
        """Number of mirrors, shape ``(L,)``: 0 through slabs alone too, and over any edge."""
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
        """Number of slabs that are passed, shape ``(L,)``; 0 over any edge."""
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
    """
    patches, parts = images.patches, list[MirrorPaths]()
    for k, ways in enumerate(images.search(receivers, order, progress)):
        ways = _off_edges(images, receivers, ways)
        for j in range(k):
            ways = ways.take(patches.contains(ways.patch[:, j], ways.point[:, j]))
        free = ways.unobstructed(images.device, beyond_m=1e-8)  # rounding does not decide
        found = [ways.take(free)]
        if walls is not None:
            found.append(ways.take(~free).through(walls)[1])
        for own in found:
            # Sheets closer than the tolerance don't hide each other: seen at a slant, their mirror points lie further apart.
            once = distinct(own.row, own.point, 3.0 * patches.tolerance_m)
            parts.append(described(own.take(once), order, walls))
    paths = MirrorPaths.joined(parts)
    return paths.take(np.argsort(paths.receiver, kind="stable"))


def _off_edges(images: MirrorImages, receivers: np.ndarray, ways: Ways) -> Ways:
    """``ways``, those through the edge of two mirrors as they are a micrometre beside it: over the one that comes first there, and
    none where the mirrors are not turned to each other."""
    at_edge = (np.diff(ways.point, axis=1) == 0).all(axis=2).any(axis=1)
    if not at_edge.any():
        return ways
    own = np.unique(ways.row[at_edge])
    beside_m = 1e-6 * np.array([0.57, 0.65, 0.5])
    near = images.candidates(receivers[own] + beside_m, ways.patch.shape[1])
    near = near.take((np.linalg.norm(np.diff(near.point, axis=1), axis=2) < 1e-4).any(axis=1))
    near = replace(near.over(-1, receivers[own[near.row]]), row=own[near.row])
    return Ways.joined([ways.take(~at_edge), near])


def zone_paths(
    images: MirrorImages,
    receivers: np.ndarray,
    order: int,
    wavelength_m: float,
    progress: Progress | None = None,
    walls: Walls | None = None,
) -> MirrorPaths:
    """Paths to ``receivers`` (R, 3) with at most ``order`` reflections, and what share of their Fresnel zones is free.

    A mirror point needs a surface of the patch at that place, not a face of exact outline. Of several reflections the
    middle ray must be free; line of sight and single mirrors may be partly covered anywhere. Where ``walls`` may be
    passed, a path whose middle ray meets some goes through what that one passes, with the share of its zone that arrives
    freely or through; of any other what arrives through walls counts with what they leave of the field.

    Args:
        images: Its boxes say how far beside its faces a patch may still mirror, the tolerance of its patches what the position
            error of the surface is: zones are wider, and rays end that much before it [m].

    Returns:
        Rows by order. Those with less than a twentieth of their field, -26 dB, are left out.
    """
    zone, parts = ZoneRays(images, wavelength_m), list[MirrorPaths]()

    def keep(ways: Ways, rays: ZoneRays, beside: Walls | None = None) -> None:
        share = rays.share(ways, beside)
        kept = share >= 0.05
        parts.append(replace(described(ways.take(kept), order, walls), share=share[kept]))

    for k, ways in enumerate(images.search(receivers, order, progress)):
        kept = np.ones(len(ways), bool)
        if k > 1 or walls is not None:
            free = zone.reached(ways)
            kept = free if k > 1 else kept
        if walls is not None:
            own, beyond = zone.through(walls, ways, free)
            kept[own] = False
            keep(beyond, replace(zone, walls=walls))
        keep(ways.take(kept), zone, walls)
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

    images: MirrorImages
    wavelength_m: float
    walls: Walls | None = None

    @property
    def position_error_m(self) -> float:
        """Of the surface [m]."""
        return self.images.patches.tolerance_m

    def radius(self, near: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Radius of the first zone between two legs, widened by the mesh's error [m]."""
        zone = self.wavelength_m * near * far / np.maximum(near + far, 1e-9)
        return np.sqrt(zone + self.position_error_m**2)

    def share(self, ways: Ways, beside: Walls | None = None) -> np.ndarray:
        """Share of each path's field that arrives: of its rays, and what walls ``beside`` the path let through of others, in phase
        as far as that leaves them, shape ``(L,)``."""
        share = self._mirror_share if ways.patch.shape[1] else self._direct_share
        field = share(ways, beside).reshape(len(ways), len(_SAMPLES))
        return np.asarray(np.abs(field.mean(axis=1)))

    def _through_any(self, beside: Walls, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Field that arrives through some walls over legs from ``begin`` to ``end`` (N, K, 3), complex, shape ``(N,)``."""
        whole, count = np.ones(len(begin), complex), np.zeros(len(begin), int)
        for k in range(begin.shape[1]):
            rows, slabs = beside.between(begin[:, k], end[:, k])
            own = np.zeros(len(begin), complex)
            own[rows] = beside.field(slabs)
            count[rows] += slabs.count
            whole *= own
        return np.where(count > 0, whole, 0.0)

    def _direct_share(self, ways: Ways, beside: Walls | None) -> np.ndarray:
        """Field of each ray of line of sight, over the zone's widest place."""
        source, receivers = ways.stops[:, 0], ways.stops[:, 1]
        toward, length = headings(source - receivers)
        radius = self.radius(0.5 * length, 0.5 * length)
        u, v = vectors_across(toward)
        offset = _SAMPLES[:, 0, None] * u[:, None] + _SAMPLES[:, 1, None] * v[:, None]
        middle = (0.5 * (receivers + source))[:, None] + radius[:, None, None] * offset
        start = np.broadcast_to(receivers[:, None], middle.shape).reshape(-1, 3)
        middle = middle.reshape(-1, 3)
        free = self.clear(start, self._past(start, middle))
        left = np.flatnonzero(free)
        end = source[left // len(_SAMPLES)]
        free[left] = self.clear(self._past(end, middle[left]), end)
        field = free.astype(complex)
        if beside is not None:
            dark = np.flatnonzero(~free)
            knee = self._past(start[dark], middle[dark])  # what lies at the middle is passed once
            stops = np.stack([source[dark // len(_SAMPLES)], knee, start[dark]], axis=1)
            field[dark] = self._through_any(beside, stops[:, :2], stops[:, 1:])
        return field

    def _past(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Points so far behind b, seen from a, that a ray to them misses nothing at b, where no surface is, shape ``(N, 3)``."""
        return np.asarray(b + 2.0 * self.position_error_m * headings(b - a)[0])

    def _mirror_share(self, ways: Ways, beside: Walls | None) -> np.ndarray:
        """Field of each ray of mirror paths; a zone cuts a patch's plane in an ellipse, longer by 1 / cos."""
        count, order = ways.patch.shape
        along, lengths = headings(np.diff(ways.stops, axis=1))
        before = np.cumsum(lengths, axis=1)[:, :-1]
        radius = self.radius(before, lengths.sum(axis=1)[:, None] - before)
        around = np.repeat(ways.point[:, None], len(_SAMPLES), axis=1)
        for k in range(order):
            normal = ways.patches.normal[ways.patch[:, k]]
            cosine = np.abs((along[:, k] * normal).sum(axis=1))
            across = across_incidence(along[:, k], normal, vectors_across(normal)[0])
            further = np.cross(normal, across) / np.maximum(cosine, 0.05)[:, None]
            offset = _SAMPLES[:, 0, None] * across[:, None] + _SAMPLES[:, 1, None] * further[:, None]
            around[:, :, k] += radius[:, k, None, None] * offset
        each = ways.take(np.repeat(np.arange(count), len(_SAMPLES)))
        each = each.over(slice(1, -1), around.reshape(-1, order, 3))
        met = self.reached(each)
        field = met.astype(complex)
        if beside is not None:
            dark = np.flatnonzero(~met)
            dark = dark[replace(self, walls=beside).reached(each.take(dark))]
            field[dark] = self._through_any(beside, *each.take(dark).legs(beside.clearance_m))
        return field

    def reached(self, ways: Ways) -> np.ndarray:
        """Whether each leg reaches its patch and nothing stands between, or nothing but walls, shape ``(L,)``."""
        free, here = np.ones(len(ways), bool), ways.stops[:, -1]
        for k in range(ways.patch.shape[1] - 1, -1, -1):
            own, point, patch = np.flatnonzero(free), ways.point[:, k], ways.patch[:, k]
            free[own] = self._meets(here[own], point[own], patch[own])
            normal, offset = ways.patches.normal[patch], ways.patches.offset[patch]
            side = np.sign((here * normal).sum(axis=1) - offset)
            here = point + (self.position_error_m * side)[:, None] * normal
        own = np.flatnonzero(free)
        free[own] = self.clear(ways.stops[own, 1], ways.stops[own, 0])
        return free

    def through(self, walls: Walls, ways: Ways, free: np.ndarray) -> tuple[np.ndarray, Ways]:
        """Which of those that are not ``free`` (L,) arrive through some of ``walls``, and those, with what each passes."""
        dark = np.flatnonzero(~free)
        dark = dark[replace(self, walls=walls).reached(ways.take(dark))]
        own, beyond = ways.take(dark).through(walls)
        return dark[own], beyond

    def clear(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether nothing lies between a and b (N, 3), or nothing but walls, but within the position error of either end."""
        toward, length = headings(b - a)
        start = a + self.position_error_m * toward
        hit = self.images.patches.mesh.cast(start, toward, device=self.images.device)
        free = (length <= 2 * self.position_error_m) | (hit.t >= length - 2 * self.position_error_m)
        if self.walls is not None:
            dark = np.flatnonzero(~free)
            free[dark[self.walls.between(start[dark], b[dark])[0]]] = True
        return np.asarray(free)

    def _meets(self, start: np.ndarray, target: np.ndarray, patch: np.ndarray) -> np.ndarray:
        """Whether the ray from ``start`` first meets a surface, behind walls perhaps, at ``target``, on the plane of ``patch``."""
        p, reached = self.images.patches, np.ones(len(start), bool)
        if self.walls is not None:
            before = target + 3.0 * self.position_error_m * headings(start - target)[0]
            reached[:] = np.isin(np.arange(len(start)), self.walls.between(start, before)[0])
            start = before
        toward, length = headings(target - start)
        hit = p.mesh.cast(start, toward, device=self.images.device)
        near = np.abs(hit.t - length) <= 2.0 * self.position_error_m
        met = p.face_patch[np.maximum(hit.face, 0)]
        # A torn seam of the patch passes for it, another patch does not.
        off = np.abs((np.nan_to_num(hit.point) * p.normal[patch]).sum(axis=1) - p.offset[patch])
        seam = near & (off <= self.position_error_m) & (met < 0)
        return reached & (hit.face >= 0) & ((met == patch) | seam)


def described(ways: Ways, order: int, walls: Walls | None) -> MirrorPaths:
    """``ways`` with what is known of each mirror and slab, in columns for ``order`` mirrors and as many slabs as ``walls``
    allow."""
    most = max(order, 1) + (walls.most if walls else 0)
    row, mesh, normals = ways.row, ways.patches.mesh, ways.patches.normal[ways.patch]
    columns = []
    for k in range(ways.stops.shape[1] - 1):
        here, face, mirror = ways.stops[:, k, None], ways.slab[:, k], slice(k, k + 1)
        at, turned = met_at(mesh, face, here, ways.stops[:, k + 1, None] - here)
        columns.append((np.full_like(face, -1), face, at, turned, ways.thickness_m[:, k]))
        own = ways.patch[:, mirror]
        nothing = np.full_like(own, -1), np.full(own.shape, np.nan)
        columns.append((own, nothing[0], ways.point[:, mirror], normals[:, mirror], nothing[1]))
    patch, slab, point, normal, thickness = (np.concatenate(c, axis=1) for c in zip(*columns, strict=True))
    first = np.argsort((patch < 0) & (slab < 0), axis=1, kind="stable")
    patch, slab, thickness = (np.take_along_axis(a, first, axis=1) for a in (patch, slab, thickness))
    point, normal = (np.take_along_axis(a, first[..., None], axis=1) for a in (point, normal))
    count = ((patch >= 0) | (slab >= 0)).sum(axis=1)
    length, arrival = np.zeros(len(row)), np.zeros((len(row), 3))
    cosine, turn = np.zeros((2, *patch.shape))
    for k in np.unique(count):
        own = np.flatnonzero(count == k)
        stops = stops_of(ways.stops[own, 0], point[own, :k], ways.stops[own, -1])
        along, lengths = headings(np.diff(stops, axis=1))
        length[own], arrival[own] = lengths.sum(axis=1), -along[:, -1]
        cosine[own, :k] = np.abs((along[:, :-1] * normal[own, :k]).sum(axis=2))
        turn[own, :k] = turns(stops, normal[own, :k])

    code = np.where(slab >= 0, SLAB, np.where(patch >= 0, MIRROR, 0)).astype(np.int8)
    return MirrorPaths(
        row, patch, slab, point, np.ones(len(row)), length, 0.0 * length, arrival, normal, cosine, turn, thickness, code
    ).of_width(most)  # fmt: skip


def met_at(mesh: Mesh, face: np.ndarray, start: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where ``way`` (..., 3) from ``start`` meets the planes of faces ``face`` (...), and their normals, shape ``(..., 3)``;
    NaN for no face (-1)."""
    normal = np.where((face >= 0)[..., None], mesh.face_normals[face], np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):  # where none is met
        part = ((mesh.triangles[face, 0] - start) * normal).sum(axis=-1) / (way * normal).sum(axis=-1)
    return start + part[..., None] * way, normal
