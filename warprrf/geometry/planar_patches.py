"""Planar patches of a mesh: the flat pieces that mirror, found whatever exporters and scanners did to the faces.

A patch is a connected set of faces of one group (a material, say) that lie in one plane. The plane is fitted: least
squares over the faces, weighted by area. What must not matter does not: which way faces are wound, a face that is there
twice, a surface that lies on another of its group, an order or a finer subdivision of faces, coordinates rounded to
float32, and small errors of vertices. A curved surface is not flat at any such error: its facets stay patches of their
own. Lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warprrf.cache import Cache, cached_property
from warprrf.checks import check_similarity, warn
from warprrf.device import filled, launch, resolve
from warprrf.geometry.edges import Edges, mesh_edges
from warprrf.geometry.mesh import Mesh, boxes_of, components, headings, vectors_across
from warprrf.kernels.rays.mesh import OverlapFaces, find_overlaps
from warprrf.kernels.rays.patches import PatchFaces, lie_in_patches
from warprrf.rows import spans, sums_of

FLAT_M = 1e-5
"""Corners may lie this far from their patch's plane [m], and six standard deviations of vertices' errors more."""
FLAT_RAD = 1.4e-3
"""Faces may be turned this much against their patch [rad], and by three standard deviations over their heights more."""


BENT_RAD = 0.8
"""Neighbours that are bent this much may still be coplanar: errors of 2 cm bend faces of 10 cm by 0.3."""
FACETS = 6
FACET_BEND_RAD = (0.03, 0.62)
"""Facets of a smooth surface: more than a bay window's, bent by less than an octagon's 45 degrees."""
SEAM_M = 1e-9
"""Width added to every face, so that faces leave no seam between them [m]."""
MOST_NOISE_M = 0.05
"""Standard deviation of vertices' errors up to which unevenness is taken for a scanner's [m]."""


@dataclass(frozen=True, eq=False)
class PlanarPatches:
    """P planar patches of a mesh of F faces.

    Attributes:
        mesh: The mesh that they are of.
        face_patch: Patch of each face, -1 for none, shape ``(F,)``, int32. A repeated face has the patch of the first.
        normal: Unit normal, shape ``(P, 3)``; its sign is that of the patch's largest face and means a side only where
            ``two_sided`` is False.
        offset: The plane is ``normal . x = offset`` [m], shape ``(P,)``.
        area: Area, repeated faces counted once, others that lie on each other each [m^2], shape ``(P,)``.
        group: What :func:`planar_patches` was told to keep apart, shape ``(P,)``, int32; -1 where nothing was.
        first: The first face at the place of each, shape ``(F,)``: itself unless it repeats one.
        tolerance_m: Corners of a patch lie this near to its plane [m]; rays that end on it ignore what is nearer.
        two_sided: Whether both sides are surfaces. False: only the side that ``normal`` points to.
    """

    mesh: Mesh
    face_patch: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    area: np.ndarray
    group: np.ndarray
    first: np.ndarray
    tolerance_m: float
    two_sided: bool = True

    def __len__(self) -> int:
        return len(self.offset)

    @cached_property
    def edges(self) -> Edges:
        """Edges between patches: what is one patch has none, however its faces are bent by errors."""
        patch = np.maximum(self.face_patch, 0)
        normal = np.where(self.face_patch[:, None] >= 0, self.normal[patch], 0.0)
        turned = (normal * self.mesh.face_normals).sum(axis=1) < 0
        return mesh_edges(self.mesh, np.where(turned[:, None], -normal, normal), self.group[patch])

    @classmethod
    def from_planes(
        cls,
        mesh: Mesh,
        face_patch: ArrayLike,
        normal: ArrayLike,
        offset: ArrayLike,
        *,
        tolerance_m: float,
        two_sided: bool = False,
    ) -> PlanarPatches:
        """Patches whose planes are known, of a reconstruction, say: its normals point to the side that photos saw.

        Args:
            face_patch: Patch of each face, -1 for none, shape ``(F,)``.
            normal, offset: Planes ``normal . x = offset`` [m], shapes ``(P, 3)`` and ``(P,)``.
            tolerance_m, two_sided: As the attributes.
        """
        label = np.asarray(face_patch, np.int32)
        planes = np.asarray(normal, float).reshape(-1, 3), np.asarray(offset, float).reshape(-1)
        if label.shape != (len(mesh.faces),) or label.max(initial=-1) >= len(planes[1]):
            raise ValueError(
                f"face_patch: got shape {label.shape} and patches up to {label.max(initial=-1)}, expected "
                f"({len(mesh.faces)},) and less than {len(planes[1])}"
            )
        own = label >= 0
        area = np.bincount(label[own], mesh.areas[own], minlength=len(planes[1]))
        group = np.full(len(planes[1]), -1, np.int32)
        return cls(mesh, label, *planes, area, group, np.arange(len(label)), tolerance_m, two_sided)

    def transformed(
        self, *, scale: float = 1.0, rotation: ArrayLike | None = None, shift: ArrayLike = (0.0, 0.0, 0.0)
    ) -> PlanarPatches:
        """The patches of the mesh at ``scale rotation x + shift``.

        Arguments and errors: see :func:`warprrf.checks.check_similarity`.
        """
        scale, turn, moved = check_similarity(scale, rotation, shift)
        normal = self.normal @ turn.T
        return replace(
            self,
            mesh=self.mesh.transformed(scale=scale, rotation=turn, shift=moved),
            normal=normal,
            offset=scale * self.offset + normal @ moved,
            area=scale**2 * self.area,
            tolerance_m=scale * self.tolerance_m,
        )

    @property
    def once(self) -> np.ndarray:
        """Faces that repeat no other, shape ``(F,)``, bool."""
        return self.first == np.arange(len(self.first))

    @cached_property
    def curved_m2(self) -> float:
        """Area of the patches that are facets of smooth surfaces, as a round pillar's [m^2]: :data:`FACETS` or more that
        meet one after the other at angles between :data:`FACET_BEND_RAD`."""
        pair = self.face_patch[self.mesh.neighbours]
        pair = pair[(pair >= 0).all(axis=1)]
        bend = np.arccos(
            np.abs((self.normal[pair[:, 0]] * self.normal[pair[:, 1]]).sum(axis=1)).clip(0.0, 1.0)
        )
        piece = components(len(self), pair[(bend > FACET_BEND_RAD[0]) & (bend < FACET_BEND_RAD[1])])
        return float(self.area[np.bincount(piece)[piece] >= FACETS].sum())

    @cached_property
    def _faces_and_ends(self) -> tuple[np.ndarray, np.ndarray]:
        own = np.flatnonzero((self.face_patch >= 0) & self.once)
        order = own[np.argsort(self.face_patch[own], kind="stable")]
        return order, np.searchsorted(self.face_patch[order], np.arange(len(self) + 1))

    def faces(self, patch: int) -> np.ndarray:
        """Faces of one patch, repeated ones once, shape ``(K,)``, int64."""
        order, ends = self._faces_and_ends
        return order[ends[patch] : ends[patch + 1]]

    @cached_property
    def boxes(self) -> np.ndarray:
        """Lowest and highest corner of each patch [m], shape ``(P, 2, 3)``."""
        own = self.face_patch >= 0
        return boxes_of(self.mesh.triangles[own], self.face_patch[own], len(self))

    @cached_property
    def _kept(self) -> Cache:
        return Cache(1)  # which a pickle leaves empty: a structure of Warp's has none

    def _by_patch(self) -> PatchFaces:
        """Faces patch by patch on the CPU, with boxes of patches and faces and what lies close beside them."""
        order, ends = self._faces_and_ends
        corner, reach = self.mesh.triangles[order], self.tolerance_m + SEAM_M
        return filled(
            PatchFaces, "cpu", ends=ends, normal=self.normal, corners=corner, low=self.boxes[:, 0] - reach,
            high=self.boxes[:, 1] + reach, face_low=corner.min(axis=1) - reach, face_high=corner.max(axis=1) + reach,
        )  # fmt: skip

    def contains(self, patch: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Whether point k [m], on the plane of patch ``patch[k]``, lies in it or close beside it, shape ``(N,)``."""
        where, inside = resolve("cpu"), np.empty(len(patch), dtype=bool)
        given = partial(wp.array, device=where, copy=False)
        inputs = [
            self._kept.get(0, self._by_patch), SEAM_M, given(np.asarray(patch, np.int32), dtype=wp.int32),
            given(np.asarray(points, float), dtype=wp.vec3d), given(inside, dtype=wp.bool),
        ]  # fmt: skip
        launch(lie_in_patches, len(patch), inputs, device=where)
        return inside


def planar_patches(mesh: Mesh, groups: ArrayLike | None = None) -> PlanarPatches:
    """The planar patches of ``mesh``.

    Args:
        mesh: Any triangle mesh; faces that share an edge at one place are neighbours, whatever their vertices' indices.
        groups: Index of what must not share a patch, for each face, shape ``(F,)``; materials, say.

    Returns:
        Patches, largest first. Faces with hardly any area that fit no neighbour have none.

    Warns:
        UserWarning: if faces at one place are of different groups: the first is taken.
    """
    count = len(mesh.faces)
    group = np.full(count, -1, np.int32) if groups is None else np.asarray(groups, np.int32)
    if group.shape != (count,):
        raise ValueError(f"groups: got shape {group.shape}, expected ({count},), one index a face")
    rounding, first = mesh.rounding_m, mesh.first_at_place
    if differ := int((group[first] != group).sum()):
        warn(
            f"mesh: {differ} faces lie on another of a different material or group; the first of each is taken"
        )
    longest = np.linalg.norm(mesh.triangles - np.roll(mesh.triangles, 1, axis=1), axis=2).max(axis=1)
    height = 2.0 * mesh.areas / np.maximum(longest, 1e-300)
    own = mesh.cornered_faces
    own = own[height[own] > 4.0 * rounding]  # less is made by rounding alone, and has no plane of its own
    once = np.isin(np.arange(count), own)
    pairs = mesh.neighbours[once[mesh.neighbours].all(axis=1)]
    noise = vertex_noise(mesh, pairs, rounding)
    faces = _Faces(mesh, group, height, FLAT_M + 6.0 * noise, 3.0 * noise)
    piece = _pieces(faces, once, pairs)
    return _assembled(faces, piece, first)


def vertex_noise(mesh: Mesh, pairs: np.ndarray, rounding_m: float) -> float:
    """Standard deviation of vertices' errors [m], from neighbours that may be coplanar; at least ``rounding_m``.

    On a flat piece errors bend a face towards one neighbour and away from another; on a smooth curved one all bend the
    same way. Only if most of the area with three neighbours is bent both ways is that noise, and only up to
    :data:`MOST_NOISE_M`: hills are not.

    Args:
        pairs: Neighbouring faces, shape ``(N, 2)``.
    """
    a, b = np.concatenate([pairs, pairs[:, ::-1]]).T
    n, x = mesh.face_normals, mesh.triangles
    flat = np.abs(np.einsum("ni,ni->n", n[a], n[b])) > np.cos(BENT_RAD)
    a, b = a[flat], b[flat]
    rise = np.einsum("nki,ni->nk", x[b] - x[a][:, :1], n[a])
    rise = rise[np.arange(len(a)), np.abs(rise).argmax(axis=1)] if len(a) else np.zeros(0)
    count = len(mesh.faces)
    inner = np.bincount(a, minlength=count) >= 3
    # A face that was cut up says what it did whole: its pieces rise less, by the root of areas.
    cut = np.abs(rise) <= 2.0 * rounding_m
    facet = components(count, np.column_stack([a, b])[cut])
    rise *= np.sqrt(np.bincount(facet, mesh.areas)[facet[b]] / np.maximum(mesh.areas[b], 1e-300))
    a, rise = facet[a][~cut], rise[~cut]
    low, high = np.zeros(count), np.zeros(count)
    np.minimum.at(low, a, rise)
    np.maximum.at(high, a, rise)
    # Bent as much, within a factor of ten, one way as the other: facets of a pipe with errors are not.
    both = np.minimum(high, -low) > np.maximum(rounding_m, 0.1 * np.maximum(high, -low))
    if mesh.areas[inner & both[facet]].sum() <= 0.55 * mesh.areas[inner].sum():
        return rounding_m
    # The corner across an edge lies off the neighbour's plane by twice a vertex's error (of a parallelogram).
    noise = float(np.median(np.abs(rise)) / 0.6745 / 2.0)
    return max(rounding_m, noise) if noise <= MOST_NOISE_M else rounding_m


@dataclass(frozen=True)
class _Faces:
    """Faces and the tolerances that decide what is coplanar."""

    mesh: Mesh
    group: np.ndarray
    height: np.ndarray
    distance_m: float
    sway_m: float

    def turn_limit(self, height: np.ndarray) -> np.ndarray:
        """Greatest angle to a patch of a face of this height [rad]."""
        return FLAT_RAD + self.sway_m / np.maximum(height, 1e-300)

    def gap(self, face: np.ndarray, normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Largest distance of the corners of each face from its plane [m], shape ``(N,)``."""
        return np.abs(np.einsum("nki,ni->nk", self.mesh.triangles[face], normal) - offset[:, None]).max(
            axis=1, initial=0.0
        )


def _pieces(faces: _Faces, once: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Piece of each face, -1 where not ``once``, shape ``(F,)``."""
    mesh, n = faces.mesh, faces.mesh.face_normals
    pairs = pairs[faces.group[pairs[:, 0]] == faces.group[pairs[:, 1]]]
    big, small = np.where(
        (mesh.areas[pairs[:, 0]] >= mesh.areas[pairs[:, 1]])[:, None], pairs, pairs[:, ::-1]
    ).T
    turn = _angle(n[big], n[small])
    offset = np.einsum("ni,ni->n", n, mesh.triangles[:, 0])
    flat = turn <= np.hypot(faces.turn_limit(faces.height[big]), faces.turn_limit(faces.height[small]))
    # A face so slim that its normal says nothing joins its neighbours later, when it has a plane to be judged by.
    flat &= np.minimum(faces.height[big], faces.height[small]) > 8.0 * faces.sway_m
    flat &= faces.gap(small, n[big], offset[big]) <= faces.distance_m
    piece = components(len(mesh.faces), pairs[flat])
    piece = np.where(once, piece, -1)
    piece = _numbered(piece)
    own = np.flatnonzero(piece >= 0)
    normal, offset = _fit(mesh, own, piece[own])
    bad = np.unique(piece[own][faces.gap(own, normal[piece[own]], offset[piece[own]]) > faces.distance_m])
    if len(bad):
        piece = _numbered(_grown(faces, piece, np.isin(piece, bad), pairs))
    # Surfaces that lie on each other share no edge; they are one mirror all the same.
    pairs = np.concatenate([pairs, _overlaps(faces, piece)])
    while (joined := _joined(faces, piece, pairs)) is not None:
        piece = joined
    return piece


def _overlaps(faces: _Faces, piece: np.ndarray) -> np.ndarray:
    """Pairs of faces that lie on each other within the tolerance, in pieces of one group, shape ``(N, 2)``: each face with
    one of the largest such piece."""
    own = np.flatnonzero(piece >= 0)
    where = resolve("cpu")
    corners = faces.mesh.triangles[own] - faces.mesh.center
    margin = 2.0 * faces.distance_m  # float32's rounding is less
    low, high = corners.min(axis=1) - margin, corners.max(axis=1) + margin
    bvh = wp.Bvh(*(wp.array(x, dtype=wp.vec3, device=where) for x in (low, high)))
    area = faces.mesh.areas[own]
    held = filled(
        OverlapFaces, where, corners=corners, normal=faces.mesh.face_normals[own], area=area, part=piece[own],
        group=faces.group[own], part_area=np.bincount(piece[own], area),
    )  # fmt: skip
    other = wp.full(len(own), -1, dtype=wp.int32, device=where)
    launch(find_overlaps, len(own), [bvh.id, held, faces.distance_m, other], device=where)
    found = other.numpy()
    return np.column_stack([own, own[found]])[found >= 0]


def _grown(faces: _Faces, piece: np.ndarray, again: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Pieces with the faces ``again`` divided anew: each grows from its largest face while its own plane fits."""
    mesh, piece = faces.mesh, piece.copy()
    inside = again[pairs[:, 0]] & again[pairs[:, 1]]
    both = np.concatenate([pairs[inside], pairs[inside][:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    first = np.searchsorted(both[:, 0], np.arange(len(piece) + 1))
    free, label = again.copy(), int(piece.max(initial=-1)) + 1
    limit = faces.turn_limit(faces.height)
    for seed in np.flatnonzero(again)[np.argsort(-mesh.areas[again], kind="stable")]:
        if not free[seed]:
            continue
        members = new = np.array([seed])
        free[seed] = False
        normal = mesh.face_normals[seed]
        offset = float(normal @ mesh.triangles[seed, 0])
        while len(new):
            ring = np.unique(np.concatenate([both[first[f] : first[f + 1], 1] for f in new]))
            ring = ring[free[ring]]
            planes = np.broadcast_to(normal, (len(ring), 3)), np.full(len(ring), offset)
            new = ring[
                (faces.gap(ring, *planes) <= faces.distance_m)
                & (_angle(mesh.face_normals[ring], planes[0]) <= limit[ring])
            ]
            free[new] = False
            members = np.concatenate([members, new])
            if len(new):
                fitted = _fit(mesh, members, np.zeros(len(members), int))
                normal, offset = fitted[0][0], float(fitted[1][0])
        piece[members] = label
        label += 1
    return piece


def _joined(faces: _Faces, piece: np.ndarray, pairs: np.ndarray) -> np.ndarray | None:
    """Pieces after each joined the largest neighbour in whose plane it lies; None if none did."""
    mesh = faces.mesh
    own = piece >= 0
    normal, offset = _fit(mesh, np.flatnonzero(own), piece[own])
    area = np.bincount(piece[own], mesh.areas[own])
    both = np.unique(np.concatenate([piece[pairs], piece[pairs][:, ::-1]]), axis=0)
    small, big = both[(both[:, 0] != both[:, 1]) & (both >= 0).all(axis=1)].T
    less = (area[small] < area[big]) | ((area[small] == area[big]) & (small > big))
    small, big = small[less], big[less]
    height = np.zeros(len(area))
    np.maximum.at(height, piece[own], faces.height[own])
    fits = _angle(normal[small], normal[big]) <= faces.turn_limit(height[small])
    small, big = small[fits], big[fits]
    order = np.argsort(piece, kind="stable")
    ends = np.searchsorted(piece[order], np.arange(len(area) + 1))
    row, place = spans(ends[small], np.diff(ends)[small])
    gap = np.zeros(len(small))
    np.maximum.at(gap, row, faces.gap(order[place], normal[big][row], offset[big][row]))
    fits = gap <= faces.distance_m
    small, big = small[fits], big[fits]
    if len(small) == 0:
        return None
    target = np.arange(len(area))
    order = np.argsort(area[big], kind="stable")  # the largest is written last
    target[small[order]] = big[order]
    # What others join stays itself this time, so that planes are judged before they are merged on.
    moved = target != np.arange(len(area))
    moved &= ~np.isin(np.arange(len(area)), target[moved])
    if not moved.any():
        return None
    return _numbered(np.where(own, np.where(moved, target, np.arange(len(area)))[piece], -1))


def _assembled(faces: _Faces, piece: np.ndarray, first: np.ndarray) -> PlanarPatches:
    mesh = faces.mesh
    once = piece >= 0
    area = np.bincount(piece[once], mesh.areas[once])
    rank = np.empty(len(area), int)
    rank[np.argsort(-area, kind="stable")] = np.arange(len(area))
    piece = np.where(once, rank[piece], -1) if len(area) else piece
    normal, offset = _fit(mesh, np.flatnonzero(once), piece[once])
    group = np.full(len(area), -1, np.int32)
    group[piece[once]] = faces.group[once]
    return PlanarPatches(
        mesh=mesh,
        face_patch=piece[first].astype(np.int32),
        normal=normal,
        offset=offset,
        area=np.sort(area)[::-1],
        group=group,
        first=first,
        tolerance_m=faces.distance_m,
    )


def _fit(mesh: Mesh, own: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planes ``(P, 3)``, ``(P,)`` [m] of the pieces ``p`` of the faces ``own``: least squares, weighted by area.

    Found as a correction of the plane of the piece's largest face, so that flat pieces keep that to rounding.
    """
    order = np.lexsort((mesh.areas[own], p))
    own, p, count = own[order], p[order], int(p.max(initial=-1)) + 1
    largest = own[np.searchsorted(p, np.arange(count), side="right") - 1]
    normal = mesh.face_normals[largest]
    middle = (
        sums_of(mesh.areas[own, None] * mesh.triangles[own].mean(axis=1), p)
        / np.maximum(np.bincount(p, mesh.areas[own]), 1e-300)[:, None]
    )
    x = 0.5 * (mesh.triangles[own] + np.roll(mesh.triangles[own], 1, axis=1)) - middle[p][:, None]
    for _ in range(2):
        frame = np.stack([*vectors_across(normal), normal], axis=1)
        # Midpoints of edges integrate squares over a triangle exactly.
        a, b, r = np.moveaxis(np.einsum("nij,nkj->nki", frame[p], x), 2, 0)
        weight = mesh.areas[own][:, None] / 3.0
        aa, ab, bb, ar, br = (
            np.bincount(p, (weight * s * t).sum(axis=1), minlength=count)
            for s, t in ((a, a), (a, b), (b, b), (a, r), (b, r))
        )
        det = np.maximum(aa * bb - ab**2, 1e-300)
        slope = np.stack([(bb * ar - ab * br) / det, (aa * br - ab * ar) / det], axis=1)
        normal = headings(normal - np.einsum("pi,pij->pj", slope, frame[:, :2]))[0]
    return normal, np.einsum("pi,pi->p", normal, middle)


def _numbered(label: np.ndarray) -> np.ndarray:
    """Labels from 0 without gaps; negative ones stay -1."""
    number = np.unique(np.maximum(label, -1), return_inverse=True)[1]
    return number - int((label < 0).any())


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between lines along unit vectors [rad], in [0, pi / 2]; exact for small ones."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.arctan2(sine, np.abs(np.einsum("ni,ni->n", a, b)))
