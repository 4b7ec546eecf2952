"""The exact paths among all: line of sight and mirror reflections.

Mirror reflections follow the image method on planar patches (adjacent coplanar faces of one material), in float64:
lengths are exact to rounding. Angles: arrival points from the receiver to the last interaction, departure from the
transmitter to the first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warprrf import device as _device
from warprrf.geometry.mesh import Mesh, as_mesh
from warprrf.rf.em.fresnel import SPEED_OF_LIGHT, SurfaceTable, slab_reflection, surface_table
from warprrf.rf.em.waves import check_frequency
from warprrf.rf.paths.path_set import Paths
from warprrf.rf.spectra.spectrum import transverse_basis

# Faces belong to one patch if they share an edge, their normals agree to 1.4e-3 rad and their corners lie this close to
# the common plane [m]: float32 STL files need it.
_COPLANAR_COSINE = 1.0 - 1e-6
_COPLANAR_M = 1e-5
# A mirror point may lie this far outside its patch, in barycentric units: faces of a patch leave no seam between them.
_EDGE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class PlanarPatches:
    """Maximal sets of adjacent coplanar faces of one material.

    Attributes:
        face_patch: Patch of each face, shape ``(F,)``, int32; -1 for a face without area.
        normal: Unit normal, shape ``(P, 3)``.
        offset: Plane equation normal . x = offset [m], shape ``(P,)``.
        material: Material index, shape ``(P,)``, int32; -1 for a bare mesh.
        area: Area [m^2], shape ``(P,)``.
        order: Faces sorted by patch; patch p owns ``order[start[p] : start[p + 1]]``.
        start: Shape ``(P + 1,)``.
    """

    face_patch: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    material: np.ndarray
    area: np.ndarray
    order: np.ndarray
    start: np.ndarray

    def __len__(self) -> int:
        return len(self.offset)


def planar_patches(mesh: Mesh, face_material: Any = None) -> PlanarPatches:
    """Group the faces of ``mesh`` into planar patches; ``face_material`` (F,) keeps materials apart."""
    count = len(mesh.faces)
    material = (
        np.full(count, -1, dtype=np.int32) if face_material is None else np.asarray(face_material, np.int32)
    )
    if material.shape != (count,):
        raise ValueError(f"face_material: got shape {material.shape}, expected ({count},), one index a face")
    edges = np.sort(mesh.welded_faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(count), 3)
    order = np.lexsort((owner, edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    # Where more than two faces share an edge, neighbours in sorted order are not all pairs: look 3 ahead.
    pairs = [np.column_stack([owner[:-1][same], owner[1:][same]])]
    for step in (2, 3):
        far = (edges[step:] == edges[:-step]).all(axis=1)
        pairs.append(np.column_stack([owner[:-step][far], owner[step:][far]]))
    a, b = np.concatenate(pairs).T
    cosine = np.einsum("ni,ni->n", mesh.face_normals[a], mesh.face_normals[b])
    offset = np.einsum("ni,ni->n", mesh.face_normals, mesh.triangles[:, 0])
    big, small = np.where(mesh.areas[a] >= mesh.areas[b], (a, b), (b, a))
    gap = np.abs(
        np.einsum("nki,ni->nk", mesh.triangles[small], mesh.face_normals[big]) - offset[big][:, None]
    )
    joined = (
        (cosine > _COPLANAR_COSINE)
        & (gap.max(axis=1, initial=0.0) < _COPLANAR_M)
        & (material[a] == material[b])
    )
    label = _connected(count, a[joined], b[joined])
    solid = mesh.areas > 0
    patch = np.full(count, -1, dtype=np.int32)
    patch[solid] = np.unique(label[solid], return_inverse=True)[1].reshape(-1)
    by_patch = np.lexsort((-mesh.areas, patch))
    by_patch = by_patch[patch[by_patch] >= 0]
    start = (
        np.concatenate([[0], np.cumsum(np.bincount(patch[solid]))]) if solid.any() else np.zeros(1, dtype=int)
    )
    largest = by_patch[start[:-1]]
    return PlanarPatches(
        face_patch=patch,
        normal=mesh.face_normals[largest],
        offset=offset[largest],
        material=material[largest],
        area=np.bincount(patch[solid], weights=mesh.areas[solid]) if solid.any() else np.zeros(0),
        order=by_patch,
        start=start,
    )


def _connected(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Label of each of ``count`` nodes: the lowest index that it is connected to through the pairs."""
    label = np.arange(count)
    while True:
        lowest = label.copy()
        np.minimum.at(lowest, a, label[b])
        np.minimum.at(lowest, b, label[a])
        lowest = lowest[lowest]
        if np.array_equal(lowest, label):
            return label
        label = lowest


def trace_paths(
    mesh_or_scene: Any,
    *,
    transmitter: Any,
    receivers: Any,
    frequency_hz: float,
    mirror_order: int = 1,
    gas: Any = False,
    device: Any = None,
) -> Paths:
    """Line of sight and mirror reflections by the image method, in float64.

    A bare mesh reflects perfectly and without a sign change. A scene's surfaces reflect as ITU-R P.2040 slabs, less
    sqrt(1 - S^2) for what scatters. |gain|^2 is then the power averaged over both transmit and summed over both receive
    polarisations (half the squared Frobenius norm of the Jones matrix); its phase is -2 pi f tau plus the phase of
    the TE coefficient of each reflection (-1 for a conductor), because one number cannot carry both polarisations;
    ``jones`` carries them. A bare mesh says nothing of polarisation: its paths have no ``jones``.

    Args:
        mesh_or_scene: A :class:`Mesh`, or a scene with ``mesh``, ``face_material`` and ``materials``.
        transmitter: Position [m], shape ``(3,)``.
        receivers: Positions [m], shape ``(3,)`` or ``(R, 3)``.
        frequency_hz: Carrier frequency [Hz].
        mirror_order: Most reflections on one path: 0, 1 or 2. Order 2 tries all pairs of patches.
        gas: Absorption of the air in every gain: see :meth:`Paths.with_gas`.

    Returns:
        Arrays ``(L,)`` for one receiver, ``(R, L)`` for several; line of sight first, then by order, then by delay.

    Raises:
        ValueError: on bad positions, a frequency that is not positive or outside a material's band, another order.
    """
    tracer = MirrorTracer(mesh_or_scene, transmitter=transmitter, frequency_hz=frequency_hz, device=device)
    points = _device.check_array("receivers", receivers)
    if points.ndim not in (1, 2) or points.shape[-1] != 3:
        raise ValueError(f"receivers: got shape {points.shape}, expected (3,) or (R, 3)")
    if points.ndim == 1:
        return tracer.trace(points, mirror_order).with_gas(gas)
    return Paths.stack([tracer.trace(p, mirror_order) for p in points]).with_gas(gas)


class MirrorTracer:
    """Image method for one transmitter: patches and images are made once, then any receiver is traced."""

    def __init__(
        self, mesh_or_scene: Any, *, transmitter: Any, frequency_hz: float, device: Any = None
    ) -> None:
        self.mesh = as_mesh(mesh_or_scene)
        self.transmitter = _device.check_array("transmitter", transmitter, (3,))
        self.frequency_hz = check_frequency(frequency_hz)
        self.device = device
        bare = mesh_or_scene is self.mesh
        self.table: SurfaceTable | None = (
            None if bare else surface_table(mesh_or_scene.materials, frequency_hz)
        )
        self.patches = planar_patches(self.mesh, None if bare else mesh_or_scene.face_material)
        self._height = self.patches.normal @ self.transmitter - self.patches.offset
        self._image = self.transmitter - 2.0 * self._height[:, None] * self.patches.normal
        self._corners = self.mesh.triangles[self.patches.order]
        self._boxes = np.array(
            [
                (c.min(axis=(0, 1)), c.max(axis=(0, 1)))
                for c in np.split(self._corners, self.patches.start[1:-1])
                if len(c)
            ]
        ).reshape(-1, 2, 3)

    @property
    def wavelength_m(self) -> float:
        """Wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    def trace(self, receiver: Any, mirror_order: int = 1) -> Paths:
        """Paths of one receiver (3,); see :func:`trace_paths`."""
        if mirror_order not in (0, 1, 2):
            raise ValueError(f"mirror_order: got {mirror_order!r}, expected 0, 1 or 2")
        point = _device.check_array("receiver", receiver, (3,))
        distance = float(np.linalg.norm(point - self.transmitter))
        if distance == 0.0:
            raise ValueError("receivers: got a receiver at the transmitter's place, expected them apart")
        parts = [self._line_of_sight(point, distance, max(mirror_order, 1))]
        if mirror_order >= 1:
            parts.append(self._mirror_once(point))
        if mirror_order >= 2:
            parts.append(self._mirror_twice(point))
        return Paths.concatenate(parts)

    def _line_of_sight(self, point: np.ndarray, distance: float, depth: int) -> Paths:
        seen = bool(self.mesh.visible(self.transmitter, point, device=self.device)[0])
        amplitude = np.full(int(seen), self.wavelength_m / (4.0 * np.pi * distance), dtype=complex)
        nothing = np.full((int(seen), depth, 3), np.nan)
        jones = None
        if self.table is not None:
            way = point - self.transmitter
            across = transverse_basis(-way) @ transverse_basis(way).T
            jones = amplitude[:, None, None] * across
        return self._paths(point, nothing, amplitude, "los", jones)

    def _paths(
        self,
        point: np.ndarray,
        vertices: np.ndarray,
        amplitude: np.ndarray,
        kind: str,
        jones: np.ndarray | None,
    ) -> Paths:
        kinds = np.full(len(vertices), kind, dtype="<U7")
        paths = Paths.from_points(
            self.transmitter, point, vertices, amplitude, kinds, self.frequency_hz, jones
        )
        by_delay = np.argsort(paths.tau, kind="stable")
        return paths.select(by_delay)

    def _mirror_once(self, point: np.ndarray) -> Paths:
        p = self.patches
        below = p.normal @ point - p.offset
        found = np.flatnonzero(self._height * below > 0)
        hit = _cross_plane(self._image[found], point, -self._height[found], below[found])
        inside = self._inside(found, hit)
        found, hit = found[inside], hit[inside]
        free = self._free(
            np.stack([np.broadcast_to(self.transmitter, hit.shape), hit, np.broadcast_to(point, hit.shape)])
        )
        found, hit = found[free], hit[free]
        length = np.linalg.norm(point - self._image[found], axis=1)
        return self._paths(point, hit[:, None], *self._reflect(found[:, None], hit[:, None], point, length))

    def _mirror_twice(self, point: np.ndarray) -> Paths:
        p, none = self.patches, np.zeros((0, 2, 3))
        firsts, seconds, hits = [], [], []
        below = p.normal @ point - p.offset
        lit = np.flatnonzero(self._height != 0)
        for second in np.flatnonzero(below != 0):
            # Both the first image and the receiver must lie on one side of the second plane, else it isn't crossed.
            height = self._image[lit] @ p.normal[second] - p.offset[second]
            first = lit[(height * below[second] > 0) & (lit != second)]
            height = self._image[first] @ p.normal[second] - p.offset[second]
            image = self._image[first] - 2.0 * height[:, None] * p.normal[second]
            last = _cross_plane(image, point, -height, np.full(len(first), below[second]))
            keep = self._inside(np.full(len(first), second), last)
            first, last = first[keep], last[keep]
            side = np.einsum("ni,ni->n", p.normal[first], last) - p.offset[first]
            keep = side * self._height[first] > 0
            first, last, side = first[keep], last[keep], side[keep]
            start = _cross_plane(self._image[first], last, -self._height[first], side)
            keep = self._inside(first, start)
            firsts.append(first[keep])
            seconds.append(np.full(int(keep.sum()), second))
            hits.append(np.stack([start[keep], last[keep]], axis=1))
        if not hits:
            return self._paths(point, none, *self._reflect(np.zeros((0, 2), int), none, point, np.zeros(0)))
        patch = np.column_stack([np.concatenate(firsts), np.concatenate(seconds)])
        hit = np.concatenate([none, *hits])
        ends = np.broadcast_to(self.transmitter, (len(hit), 3)), np.broadcast_to(point, (len(hit), 3))
        free = self._free(np.stack([ends[0], hit[:, 0], hit[:, 1], ends[1]]))
        patch, hit = patch[free], hit[free]
        length = (
            np.linalg.norm(hit[:, 0] - self.transmitter, axis=1)
            + np.linalg.norm(hit[:, 1] - hit[:, 0], axis=1)
            + np.linalg.norm(point - hit[:, 1], axis=1)
        )
        return self._paths(point, hit, *self._reflect(patch, hit, point, length))

    def _free(self, chain: np.ndarray) -> np.ndarray:
        """Whether every leg of the polylines ``(legs + 1, N, 3)`` is unobstructed, shape ``(N,)``."""
        free = np.ones(chain.shape[1], dtype=bool)
        for a, b in zip(chain[:-1], chain[1:], strict=True):
            left = np.flatnonzero(free)
            if len(left):
                free[left] = self.mesh.visible(a[left], b[left], device=self.device)
        return free

    def _inside(self, patch: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Whether point k, on the plane of ``patch[k]``, lies in that patch, shape ``(N,)``."""
        slack = 1e-6
        box = self._boxes[patch]
        inside = ((point >= box[:, 0] - slack) & (point <= box[:, 1] + slack)).all(axis=1)
        near = np.flatnonzero(inside)
        if len(near) == 0:
            return inside
        first, last = self.patches.start[patch[near]], self.patches.start[patch[near] + 1]
        counts = last - first
        which = np.repeat(np.arange(len(near)), counts)
        face = (
            np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
        )
        corner = self._corners[face]
        met = _in_triangles(point[near][which], corner)
        inside[near] = np.bincount(which, weights=met, minlength=len(near)) > 0
        return inside

    def _reflect(
        self, patch: np.ndarray, hit: np.ndarray, point: np.ndarray, length: np.ndarray
    ) -> tuple[np.ndarray, str, np.ndarray | None]:
        """Amplitudes of paths of ``length`` (N,) reflected at ``patch`` (N, bounces), met at ``hit`` (N, bounces, 3).

        Returns:
            Complex amplitude ``(N,)`` (modulus: root of half the squared Frobenius norm of the Jones matrix; phase:
            that of the TE coefficients), the kind "mirror", and the Jones matrix ``(N, 2, 2)`` along zenith and
            azimuth unit vectors of departure and arrival; None for a bare mesh.
        """
        friis = self.wavelength_m / (4.0 * np.pi * length)
        if self.table is None:
            return friis.astype(complex), "mirror", None
        chain = np.concatenate(
            [
                np.broadcast_to(self.transmitter, (len(hit), 1, 3)),
                hit,
                np.broadcast_to(point, (len(hit), 1, 3)),
            ],
            axis=1,
        )
        legs = np.diff(chain, axis=1)
        legs = legs / np.linalg.norm(legs, axis=2, keepdims=True)
        jones = np.broadcast_to(np.eye(2, dtype=complex), (len(hit), 2, 2))
        phase = np.ones(len(hit), dtype=complex)
        first = basis = np.zeros((len(hit), 2, 3))
        for k in range(hit.shape[1]):
            index = patch[:, k]
            material, normal = self.patches.material[index], self.patches.normal[index]
            incoming, outgoing = legs[:, k], legs[:, k + 1]
            cos = np.abs(np.einsum("ni,ni->n", incoming, normal))
            te, tm = slab_reflection(
                cos, self.table.permittivity[material], self.table.thickness_m[material], self.wavelength_m
            )
            smooth = np.sqrt(1.0 - self.table.scattering[material] ** 2)
            across = _perpendicular(incoming, normal)
            into = np.stack([across, np.cross(across, incoming)], axis=1)  # TE, TM before
            if k == 0:
                first = into
            else:
                jones = np.einsum("nij,nkj->nik", into, basis) @ jones
            jones = (smooth[:, None] * np.stack([te, tm], axis=1))[:, :, None] * jones
            basis = np.stack([across, np.cross(across, outgoing)], axis=1)
            phase = phase * np.where(te == 0, 1.0, te / np.where(te == 0, 1.0, np.abs(te)))
        out = np.einsum("nij,nkj->nik", transverse_basis(-legs[:, -1]), basis)
        back = np.einsum("nij,nkj->nik", first, transverse_basis(legs[:, 0]))
        size = np.sqrt(0.5 * (np.abs(jones) ** 2).sum(axis=(1, 2)))
        return friis * size * phase, "mirror", friis[:, None, None] * (out @ jones @ back)


def _cross_plane(start: np.ndarray, end: np.ndarray, height: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Where the segments from ``start``, ``height`` from the plane, to ``end``, ``below`` from it, cross that plane."""
    share = height / (height - below)
    return start + share[:, None] * (end - start)


def _in_triangles(p: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Whether point k lies in triangle k, whose plane it is on (to rounding)."""
    ab, ac, ap = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0], p - corner[:, 0]
    aa, bb, cc = (np.einsum("ni,ni->n", x, y) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    pa, pc = np.einsum("ni,ni->n", ap, ab), np.einsum("ni,ni->n", ap, ac)
    det = aa * cc - bb**2
    v, w = (cc * pa - bb * pc) / det, (aa * pc - bb * pa) / det
    return (v >= -_EDGE_TOLERANCE) & (w >= -_EDGE_TOLERANCE) & (v + w <= 1.0 + _EDGE_TOLERANCE)


def _perpendicular(direction: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Unit vectors across the planes of incidence; at normal incidence any vector across the direction."""
    across = np.cross(direction, normal)
    size = np.linalg.norm(across, axis=1)
    least = np.eye(3)[np.abs(direction).argmin(axis=1)]
    across = np.where(size[:, None] > 1e-12, across, np.cross(direction, least))
    return across / np.linalg.norm(across, axis=1, keepdims=True)
