"""Line of sight and mirror paths of many receivers: the image method, with hard or soft blocking.

Hard blocking is for meshes that are true: a path is there if its mirror points lie in their patches and nothing stands
between. Soft blocking is for a surface fused from photos, which is right to centimetres and torn at its edges, so that a
single ray is a poor judge of what it lets through. Each path is tried along several rays that fill its first Fresnel
zone, widened by the mesh's position error; the share that arrives is taken as the share of the field (Kirchhoff's
approximation of a partly covered zone), so that power falls with its square.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import chain

import numpy as np

from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import ENDPOINT_CLEARANCE, vectors_across
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.rf.paths.images import MirrorImages
from warprrf.rf.paths.polarisation import turns

ZONE_RINGS = ((0.0, 1), (0.5, 6), (0.9, 8))
"""Radii (share of a Fresnel zone's) and numbers of the rays that fill it: about equal areas each."""
LEAST_SHARE = 0.05  # paths that keep less of their field are dropped: -26 dB


@dataclass(frozen=True)
class MirrorPaths:
    """Line of sight and mirror paths of several receivers, L rows, of up to K reflections.

    Attributes:
        receiver: Index of the receiver, shape ``(L,)``.
        patch: Patches met, from the transmitter on, -1 past the last, shape ``(L, K)``.
        point: Mirror points [m], shape ``(L, K, 3)``; NaN past the last.
        share: Part of the field that is not blocked, shape ``(L,)``, in (0, 1].
        length_m: Unfolded length, shape ``(L,)``.
        arrival: Unit direction from the receiver to what it sees last, shape ``(L, 3)``.
        cosine: Cosine of incidence at each mirror, 0 past the last, shape ``(L, K)``.
        turn: Angle of its plane of incidence to the one before [rad], shape ``(L, K)``; see :mod:`.polarisation`.
    """

    receiver: np.ndarray
    patch: np.ndarray
    point: np.ndarray
    share: np.ndarray
    length_m: np.ndarray
    arrival: np.ndarray
    cosine: np.ndarray
    turn: np.ndarray

    def __len__(self) -> int:
        return len(self.receiver)

    @property
    def order(self) -> np.ndarray:
        """Number of reflections, shape ``(L,)``: 0 is line of sight."""
        return (self.patch >= 0).sum(axis=1)

    def subset(self, chosen: np.ndarray) -> MirrorPaths:
        """The rows ``chosen``."""
        return MirrorPaths(**{f.name: getattr(self, f.name)[chosen] for f in fields(self)})

    def of(self, receivers: np.ndarray) -> MirrorPaths:
        """The rows of ``receivers`` (N,), ascending, which are counted anew."""
        own = self.subset(np.isin(self.receiver, receivers))
        return replace(own, receiver=np.searchsorted(receivers, own.receiver))


def exact_paths(
    images: MirrorImages, receivers: np.ndarray, order: int, progress: Progress | None = None
) -> MirrorPaths:
    """All unobstructed paths to ``receivers`` (R, 3) with at most ``order`` reflections, by receiver, then by order.

    A mirror point lies in its patch's faces. Paths through one place on two patches (faces that overlap, or the seam
    between them) count once.

    Raises:
        ValueError: before anything is traced, if more chains would be tried than ``images`` allow.
    """
    patches, source = images.patches, images.transmitter
    parts, none = [], np.zeros((len(receivers), 0))
    direct = np.arange(len(receivers)), none.astype(np.int32), none[..., None].repeat(3, axis=2)
    for k, (row, patch, point) in enumerate(chain([direct], images.search(receivers, order, progress))):
        for j in range(k):
            own = patches.contains(patch[:, j], point[:, j])
            row, patch, point = row[own], patch[own], point[own]
        free = unobstructed(patches, source, receivers[row], patch, point, images.device)
        row, patch, point = row[free], patch[free], point[free]
        # Sheets closer than the tolerance don't hide each other: seen at a slant, their mirror points lie further apart.
        once = _distinct(row, point, 3.0 * patches.tolerance_m)
        parts.append(
            _described(
                patches, source, receivers, (row[once], patch[once], point[once], np.ones(len(once))), order
            )
        )
    paths = _joined(parts)
    return paths.subset(np.argsort(paths.receiver, kind="stable"))


def zone_paths(
    images: MirrorImages,
    receivers: np.ndarray,
    order: int,
    wavelength_m: float,
    position_error_m: float,
    progress: Progress | None = None,
) -> MirrorPaths:
    """Paths to ``receivers`` (R, 3) with at most ``order`` reflections, and what share of their Fresnel zones is free.

    A mirror point needs a surface of the patch at that place, not a face of exact outline. Of several reflections the
    middle ray must be free; line of sight and single mirrors may be partly covered anywhere.

    Args:
        images: Its boxes say how far beside its faces a patch may still mirror.
        receivers: Positions [m].
        order: Most reflections.
        wavelength_m: Wavelength [m].
        position_error_m: Position error of the surface: zones are wider, and rays end that much before it [m].
        progress: Called with the stage ``"mirrors"``.

    Returns:
        Rows by order. Those with less than :data:`LEAST_SHARE` of their field are left out.

    Raises:
        ValueError: before anything is traced, if more chains would be tried than ``images`` allow.
    """
    zone = ZoneRays(images.patches, images.transmitter, wavelength_m, position_error_m, images.device)
    parts = [_described(images.patches, images.transmitter, receivers, zone.line_of_sight(receivers), order)]
    for row, patch, point in images.search(receivers, order, progress):
        if patch.shape[1] > 1:
            free = zone.reached(receivers[row], patch, point)
            row, patch, point = row[free], patch[free], point[free]
        share = zone.mirror_share(receivers[row], patch, point)
        parts.append(
            _described(images.patches, images.transmitter, receivers, (row, patch, point, share), order)
        )
    return _joined(parts)


class ZoneRays:
    """Rays that fill Fresnel zones on a surface with a position error; see :func:`zone_paths`."""

    def __init__(
        self,
        patches: PlanarPatches,
        source: np.ndarray,
        wavelength_m: float,
        position_error_m: float,
        device: DeviceLike,
    ) -> None:
        self.patches, self.source, self.wavelength_m = patches, source, wavelength_m
        self.position_error_m, self.device = position_error_m, device
        self.samples = np.array(
            [
                (radius * np.cos(a), radius * np.sin(a))
                for ring, (radius, count) in enumerate(ZONE_RINGS)
                for a in 2 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
            ]
        )

    def radius(self, near: np.ndarray, far: np.ndarray) -> np.ndarray:
        """Radius of the first zone between two legs, widened by the mesh's error [m]."""
        return np.sqrt(
            self.wavelength_m * near * far / np.maximum(near + far, 1e-9) + self.position_error_m**2
        )

    def line_of_sight(self, receivers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Receiver, no patches, no points, and share, by rays over the zone's widest place."""
        count = len(receivers)
        way = self.source - receivers
        length = np.linalg.norm(way, axis=1)
        radius = self.radius(0.5 * length, 0.5 * length)
        u, v = vectors_across(way / np.maximum(length, 1e-12)[:, None])
        offset = self.samples[:, 0, None] * u[:, None] + self.samples[:, 1, None] * v[:, None]
        middle = (0.5 * (receivers + self.source))[:, None] + radius[:, None, None] * offset
        start = np.broadcast_to(receivers[:, None], middle.shape).reshape(-1, 3)
        free = self.clear(start, middle.reshape(-1, 3))
        left = np.flatnonzero(free)
        free[left] = self.clear(middle.reshape(-1, 3)[left], np.broadcast_to(self.source, (len(left), 3)))
        share = free.reshape(count, len(self.samples)).mean(axis=1)
        none = np.zeros((count, 0))
        return np.arange(count), none.astype(np.int32), np.zeros((count, 0, 3)), share

    def mirror_share(self, ends: np.ndarray, patch: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Share of each path's rays that arrive; a zone cuts a patch's plane in an ellipse, longer by 1 / cos."""
        count, order = patch.shape
        legs = np.diff(stops_of(self.source, point, ends), axis=1)
        lengths = np.linalg.norm(legs, axis=2)
        along = legs / np.maximum(lengths, 1e-12)[..., None]
        before = np.cumsum(lengths, axis=1)[:, :-1]
        radius = self.radius(before, lengths.sum(axis=1)[:, None] - before)
        around = np.repeat(point[:, None], len(self.samples), axis=1)
        for k in range(order):
            normal = self.patches.normal[patch[:, k]]
            cosine = np.abs((along[:, k] * normal).sum(axis=1))
            across = np.cross(along[:, k], normal)
            size = np.linalg.norm(across, axis=1, keepdims=True)
            across = np.where(size > 1e-6, across / np.maximum(size, 1e-12), vectors_across(normal)[0])
            further = np.cross(normal, across) / np.maximum(cosine, 0.05)[:, None]
            offset = self.samples[:, 0, None] * across[:, None] + self.samples[:, 1, None] * further[:, None]
            around[:, :, k] += radius[:, k, None, None] * offset
        each, which = (np.repeat(a, len(self.samples), axis=0) for a in (ends, patch))
        met = self.reached(each, which, around.reshape(-1, order, 3))
        return met.reshape(count, len(self.samples)).mean(axis=1)

    def reached(
        self, ends: np.ndarray, patch: np.ndarray, point: np.ndarray, lift: np.ndarray | None = None
    ) -> np.ndarray:
        """Whether each leg reaches its patch and nothing stands between, shape ``(L,)``.

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
        own = np.flatnonzero(free)
        free[own] = self.clear(point[own, 0], np.broadcast_to(self.source, (len(own), 3)))
        return free

    def clear(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether nothing lies between a and b (N, 3), but within the position error of either end."""
        way = b - a
        length = np.linalg.norm(way, axis=1)
        toward = way / np.maximum(length, 1e-12)[:, None]
        hit = self.patches.mesh.cast(a + self.position_error_m * toward, toward, device=self.device)
        return (length <= 2 * self.position_error_m) | (hit.t >= length - 2 * self.position_error_m)

    def _meets(self, start: np.ndarray, target: np.ndarray, patch: np.ndarray) -> np.ndarray:
        """Whether the ray from ``start`` first meets a surface at ``target``, on the plane of ``patch``."""
        p = self.patches
        way = target - start
        length = np.linalg.norm(way, axis=1)
        hit = p.mesh.cast(start, way / np.maximum(length, 1e-12)[:, None], device=self.device)
        near = np.abs(hit.t - length) <= 2.0 * self.position_error_m
        met = p.face_patch[np.maximum(hit.face, 0)]
        # A torn seam of the patch passes for it, another patch does not.
        off = np.abs((np.nan_to_num(hit.point) * p.normal[patch]).sum(axis=1) - p.offset[patch])
        return (hit.face >= 0) & ((met == patch) | (near & (off <= self.position_error_m) & (met < 0)))


def unobstructed(
    patches: PlanarPatches,
    source: np.ndarray,
    ends: np.ndarray,
    patch: np.ndarray,
    point: np.ndarray,
    device: DeviceLike,
) -> np.ndarray:
    """Whether every leg of each path is free, shape ``(L,)``.

    A leg begins off its mirror by the patches' tolerance, so that the mirror's own faces are not met; it is drawn out by
    the clearance that :meth:`Mesh.visible` leaves at ends, so that whatever lies further off than the tolerance is.
    """
    stops = stops_of(source, point, ends)
    free = np.ones(len(patch), bool)
    for k in range(patch.shape[1] + 1):
        own = np.flatnonzero(free)
        a, b = stops[own, k], stops[own, k + 1]
        toward = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-12)
        begin = _off_mirror(patches, patch[own], a, b, k - 1) - (k > 0) * ENDPOINT_CLEARANCE * toward
        end = _off_mirror(patches, patch[own], b, a, k) + (k < patch.shape[1]) * ENDPOINT_CLEARANCE * toward
        free[own] = patches.mesh.visible(begin, end, device=device) if len(own) else False
    return free


def _off_mirror(
    patches: PlanarPatches, patch: np.ndarray, point: np.ndarray, other: np.ndarray, k: int
) -> np.ndarray:
    """``point`` (L, 3) on mirror k of each path, off it by the mirrors' tolerance on the side of ``other``; as it is for
    the ends of the path."""
    if not 0 <= k < patch.shape[1]:
        return point
    normal, offset = patches.normal[patch[:, k]], patches.offset[patch[:, k]]
    side = np.sign((other * normal).sum(axis=1) - offset)
    return point + (patches.tolerance_m * side)[:, None] * normal


def _distinct(row: np.ndarray, point: np.ndarray, distance_m: float) -> np.ndarray:
    """Indices of paths that no earlier one of the same receiver repeats, all points within ``distance_m``, sorted."""
    if point.shape[1] == 0 or len(row) < 2:
        return np.arange(len(row))
    same = np.zeros(len(row), bool)
    key = np.lexsort((point[:, 0, 0], row))
    for step in range(1, len(key)):
        a, b = key[:-step], key[step:]
        close = (row[a] == row[b]) & (np.abs(point[a, 0, 0] - point[b, 0, 0]) <= distance_m)
        if not close.any():
            break
        a, b = a[close], b[close]
        equal = (np.linalg.norm(point[a] - point[b], axis=2) <= distance_m).all(axis=1)
        same[np.maximum(a, b)[equal]] = True
    return np.flatnonzero(~same)


def _described(
    patches: PlanarPatches,
    source: np.ndarray,
    receivers: np.ndarray,
    found: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    columns: int,
) -> MirrorPaths:
    """Rows of paths of one order (receiver, patch, point, share), what they lack of ``columns`` filled up."""
    row, patch, point, share = (a[found[3] >= LEAST_SHARE] for a in found)
    stops = stops_of(source, point, receivers[row])
    legs = np.diff(stops, axis=1)
    lengths = np.linalg.norm(legs, axis=2)
    along = legs / np.maximum(lengths, 1e-12)[..., None]
    normal = patches.normal[patch]
    empty = max(columns, 1) - patch.shape[1]
    rest = ((0, 0), (0, empty))
    return MirrorPaths(
        receiver=row,
        patch=np.pad(patch, rest, constant_values=-1),
        point=np.pad(point, (*rest, (0, 0)), constant_values=np.nan),
        share=share,
        length_m=lengths.sum(axis=1),
        arrival=-along[:, -1],
        cosine=np.pad(np.abs((along[:, :-1] * normal).sum(axis=2)), rest),
        turn=np.pad(turns(stops, normal), rest),
    )


def stops_of(source: np.ndarray, point: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Transmitter, mirror points and receiver of each path, shape ``(L, k + 2, 3)``."""
    return np.concatenate([np.broadcast_to(source, (len(ends), 1, 3)), point, ends[:, None]], axis=1)


def _joined(parts: list[MirrorPaths]) -> MirrorPaths:
    return MirrorPaths(
        **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(MirrorPaths)}
    )
