"""Paths over one edge, and over one edge and one mirror or slab on either side, of many receivers: exact points, in float64.

The point on an edge follows from equal angles (Keller's cone) in closed form; mirrors are images of the transmitter before
the edge, of the receiver behind it. Of all pairs of an edge and a mirror, those whose ways miss the mirror's box are sorted
out by cones against balls around edges (:mod:`.images`), those whose power cannot reach a stated level by the size of the
coefficient's terms, and the rest is tested as mirror paths are. Slabs do not bend a way. Lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warprrf.device import Progress, with_progress
from warprrf.geometry.mesh import ENDPOINT_CLEARANCE, headings, vectors_across
from warprrf.kernels.radio.records import EDGE, MIRROR, SLAB
from warprrf.rf.em.diffraction import ON_BOUNDARY, EdgeRays, Pair, boundary_fields, diffraction_matrices
from warprrf.rf.em.fresnel import SurfaceTable
from warprrf.rf.paths.images import EdgeLeaves, MirrorImages
from warprrf.rf.paths.mirror_paths import MirrorPaths, met_at
from warprrf.rf.paths.polarisation import across_incidence
from warprrf.rf.paths.slabs import Walls
from warprrf.rf.paths.ways import Ways, distinct, passed, stops_of
from warprrf.rf.spectra.spectrum import transverse_basis
from warprrf.rows import Rows

AT_ONCE = 100_000
"""Pairs of an edge and mirrors from which on no further receiver is looked at in the same pass."""


@dataclass(frozen=True)
class EdgePaths(Rows):
    """L paths over one edge each, with a mirror or a slab before it, behind it, or none.

    Attributes:
        receiver: Index of the receiver, shape ``(L,)``.
        patch: Patch of the mirror before and of that behind the edge, -1 for none, shape ``(L, 2)``.
        code: What happens at each point, from the transmitter on: 1 mirror, 4 slab, 8 edge, 0 past the last, shape ``(L, 2)``.
        point: Where [m], shape ``(L, 2, 3)``; NaN past the last.
        length_m: Length, shape ``(L,)``.
        excess_m: What a slab makes it longer by for a wave, shape ``(L,)``.
        detour_m: What it is longer by than the straight line between the ends, shape ``(L,)``.
        departure: Unit direction from the transmitter, shape ``(L, 3)``.
        arrival: Unit direction from the receiver to the last point, shape ``(L, 3)``.
        matrix: From the field along the zenith and azimuth unit vectors of departure to that along those of arrival, complex,
            shape ``(L, 2, 2)``: times the wavelength over 4 pi length, and the phase of the length, it is the Jones matrix.
            Conductors without polarisation (a bare mesh) have one number, the "hard" coefficient, on its diagonal.
        amplitude: Its modulus squared is the path gain, half the squared Frobenius norm, spreading included; its phase that of
            the field along the edge, of TE at a mirror, of the one number where there is one. Complex, shape ``(L,)``.
        wavelength_m: Wavelength [m].
    """

    receiver: np.ndarray
    patch: np.ndarray
    code: np.ndarray
    point: np.ndarray
    length_m: np.ndarray
    excess_m: np.ndarray
    detour_m: np.ndarray
    departure: np.ndarray
    arrival: np.ndarray
    matrix: np.ndarray
    amplitude: np.ndarray
    wavelength_m: float

    @property
    def power(self) -> np.ndarray:
        """Path gain [linear], shape ``(L,)``."""
        return np.abs(self.amplitude) ** 2

    def beside(self, found: MirrorPaths) -> MirrorPaths:
        """``found`` with these paths of the same receivers, whose share is what the edge makes of the field.

        Near a shadow's boundary the share of a Fresnel zone that is free, on which those rest, already tells how the field
        falls (Kirchhoff's approximation). There, up to a detour of a wavelength, paths over an edge only bring what is
        left of theirs.
        """
        count = max(2, found.patch.shape[1])
        found = found.of_width(count)
        friis = self.wavelength_m / (4.0 * np.pi * self.length_m)
        share = np.sqrt(self.power) / friis
        parents = found.order + found.slabs <= 1
        keys = found.receiver, found.patch.max(axis=1, initial=-1), found.slabs
        known = zip(*(k[parents].tolist() for k in keys), strict=True)
        free = dict(zip(known, found.share[parents], strict=True))
        keys = self.receiver, self.patch.max(axis=1, initial=-1), (self.code == SLAB).sum(axis=1)
        left = np.array([1.0 - free.get(key, 0.0) for key in zip(*(k.tolist() for k in keys), strict=True)])
        near = self.detour_m < self.wavelength_m
        share = share * np.where(near & (left < 1.0), left, 1.0)

        none, zero = np.full(self.code.shape, -1, np.int32), np.zeros(self.code.shape)
        edges = MirrorPaths(
            self.receiver, none, none, self.point, share, self.length_m, self.excess_m, self.arrival,
            np.full_like(self.point, np.nan), zero, zero, np.full_like(zero, np.nan), self.code,
        ).of_width(count)  # fmt: skip
        return MirrorPaths.joined([found, edges.take(np.flatnonzero(share > 0))])


class EdgeFinder:
    """Paths of one transmitter over the edges of a mesh.

    Args:
        images: The transmitter and what mirrors.
        table: Radio properties of the patches' groups; None for a bare mesh: fields without polarisation, reflected
            without a sign change.
        group: Row of ``table`` of each face; it is looked at if there are walls.
    """

    def __init__(
        self,
        images: MirrorImages,
        wavelength_m: float,
        table: SurfaceTable | None,
        *,
        walls: Walls | None,
        group: np.ndarray,
    ) -> None:
        self.images, self.wavelength_m, self.table = images, wavelength_m, table
        self.edges, self.walls, self.group = images.patches.edges, walls, group
        self._leaves = EdgeLeaves(self.edges, images.device)

    def find(self, receivers: np.ndarray, mirrors: int = 1, progress: Progress | None = None) -> EdgePaths:
        """All paths to ``receivers`` (R, 3) over one edge and at most ``mirrors`` mirrors, or a slab, by receiver, then by length.

        Args:
            mirrors: Most mirrors on a path, 0 or 1.
        """
        nothing = np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2), int)
        parts, waiting = list[EdgePaths](), [nothing]
        for k, receiver in enumerate(with_progress(receivers, "edges", progress)):
            waiting += self._candidates(k, receiver, mirrors)
            if sum(len(edge) for _, edge, _ in waiting) > AT_ONCE:
                parts.append(self._paths(receivers, waiting))
                waiting = [nothing]
        return EdgePaths.joined([*parts, self._paths(receivers, waiting)])

    def _candidates(
        self, k: int, receiver: np.ndarray, mirrors: int
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """What may reach receiver ``k``, without a mirror, with one before the edge, and one behind it: of each ``k`` (L,), edges
        (L,) and patches of mirrors (L, 2)."""
        images, parts = self.images, []
        for side in range(1 + 2 * mirrors):
            seen, end = (images, receiver) if side < 2 else (images.seen_from(receiver), images.transmitter)
            edge, chain = seen.over_edges(self._leaves, end, min(side, 1))
            patch = np.full((len(edge), 2), -1)
            if side:
                patch[:, side - 1] = chain[:, 0]
            parts.append((np.full(len(edge), k), edge, patch))
        return parts

    def _paths(self, points: np.ndarray, found: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> EdgePaths:
        """Those candidates that are paths to receivers at ``points`` (R, 3), unobstructed or through a slab."""
        row, edge, patch = (np.concatenate(column) for column in zip(*found, strict=True))
        ends = np.stack([np.broadcast_to(self.images.transmitter, (len(row), 3)), points[row]], axis=1)
        ways = self._over(row, edge, patch, ends)
        for sieve in (self._in_reach, self._strong, self._on_mirrors):
            ways = ways.take(np.flatnonzero(sieve(ways)))
        free = self._unobstructed(ways)
        ways = _EdgeWays.joined([ways.take(free), self._passing(ways.take(~free))])
        # Wedges before the borders of their faces.
        ways = ways.take(np.argsort(self.edges.n[ways.edge], kind="stable"))
        ways = ways.take(ways.distinct(3.0 * self.images.patches.tolerance_m))
        paths = self._described(self._decided(ways))
        return paths.take(np.lexsort((paths.length_m, paths.receiver)))

    def _over(self, row: np.ndarray, edge: np.ndarray, patch: np.ndarray, end: np.ndarray) -> _EdgeWays:
        """Of receivers ``row`` (L,), between two points ``end`` (L, 2, 3) each, over the edges ``edge`` (L,), by images of either
        in ``patch`` (L, 2)."""
        e, patches = self.edges.take(edge), self.images.patches
        normal, offset = patches.normal[patch], patches.offset[patch]
        mirrored = (patch >= 0)[..., None]
        height = ((end * normal).sum(axis=2) - offset)[..., None]
        image = np.where(mirrored, end - 2.0 * height * normal, end)
        way = image - e.start[:, None]
        along = (way * e.along[:, None]).sum(axis=2)
        across = way - along[..., None] * e.along[:, None]
        reach = np.linalg.norm(across, axis=2)
        at = (along[:, 0] * reach[:, 1] + along[:, 1] * reach[:, 0]) / np.maximum(reach.sum(axis=1), 1e-300)
        point = e.start + at[:, None] * e.along
        leg = np.hypot(reach, along - at[:, None])
        third = np.cross(e.along, e.inward)
        angle = np.arctan2((across * third[:, None]).sum(axis=2), (across * e.inward[:, None]).sum(axis=2))
        angle = np.where(angle < -1e-12, angle + 2.0 * np.pi, np.maximum(angle, 0.0))
        direction = np.array([-1.0, 1.0])[:, None] * (image - point[:, None])
        direction /= np.maximum(leg, 1e-300)[..., None]
        depth = ((point[:, None] * normal).sum(axis=2) - offset)[..., None]
        between = depth + height  # the image is as far behind the plane as the end is before it
        share = np.divide(depth, between, out=np.zeros_like(depth), where=between != 0)
        stop = np.where(mirrored, point[:, None] + share * (image - point[:, None]), np.nan)
        slab, solid = np.full(patch.shape, -1), np.full(patch.shape, np.nan)
        return _EdgeWays(row, edge, patch, slab, stop, solid, point, at, leg, angle, direction, end)

    def _in_reach(self, ways: _EdgeWays) -> np.ndarray:
        """Whether the point lies on the edge, both legs in the air and what is mirrored not in the mirror's own plane."""
        patches, n = self.images.patches, self.edges.n[ways.edge] * np.pi
        height = (ways.point[:, None] * patches.normal[ways.patch]).sum(axis=2) - patches.offset[ways.patch]
        apart = (ways.patch < 0) | (np.abs(height) > 2.0 * patches.tolerance_m)
        on_edge = (ways.at > 0) & (ways.at < self.edges.length[ways.edge])
        return np.asarray(on_edge & ((ways.angle <= n[:, None]) & apart).all(axis=1))

    def _strong(self, ways: _EdgeWays) -> np.ndarray:
        """Whether paths reach -80 dB of an unobstructed straight path between the ends, even if every face and mirror reflects
        all."""
        most = np.abs(boundary_fields(self._rays(ways))).sum(axis=0) * ways.direct / ways.leg.sum(axis=1)
        return np.asarray(20.0 * np.log10(np.maximum(most, 1e-300)) > -80.0)

    def _on_mirrors(self, ways: _EdgeWays) -> np.ndarray:
        mirrored = ways.patch >= 0
        found = np.ones(mirrored.shape, bool)
        found[mirrored] = self.images.patches.contains(ways.patch[mirrored], ways.stop[mirrored])
        return np.asarray(found.all(axis=1))

    def _beside(self, ways: _EdgeWays) -> np.ndarray:
        """Points off the edges, halfway between their faces, so that rays to them do not meet these, shape ``(L, 3)``."""
        off = 2.0 * self.images.patches.tolerance_m + ENDPOINT_CLEARANCE
        return np.asarray(ways.point + off * self.edges.outward[ways.edge])

    def _passing(self, ways: _EdgeWays) -> _EdgeWays:
        """Those without a mirror that pass one slab."""
        if self.walls is None:
            return ways.take(np.zeros(0, int))
        ways = ways.take(np.flatnonzero((ways.patch < 0).all(axis=1)))
        start = np.repeat(self._beside(ways)[:, None], 2, axis=1)
        rows, slab, thickness_m = passed(self.walls, start, ways.end)
        one = (slab >= 0).sum(axis=(1, 2)) == 1
        ways, face, thickness = ways.take(rows[one]), slab[one, :, 0], thickness_m[one, :, 0]
        here = ways.point[:, None]
        stop, _ = met_at(self.walls.mesh, face, here, ways.end - here)
        return replace(ways, slab=face, thickness_m=thickness, stop=stop)

    def _unobstructed(self, ways: _EdgeWays) -> np.ndarray:
        beside = self._beside(ways)
        found = np.ones(len(ways.edge), bool)
        for j in range(2):
            for mirrored in (False, True):
                own = np.flatnonzero(found & ((ways.patch[:, j] >= 0) == mirrored))
                patch, mirror = (a[own, j : j + int(mirrored)] for a in (ways.patch, ways.stop))
                stops = stops_of(ways.end[own, j], mirror, beside[own])
                legs = Ways.of(self.images.patches, own, patch, stops)
                found[own] = legs.unobstructed(self.images.device)
        return found

    def _decided(self, ways: _EdgeWays) -> _EdgeWays:
        """The same; of ends on the boundary of a shadow, those that do not see each other are in it."""
        turn, angle, patches = ways.angle[:, 1] - ways.angle[:, 0], ways.angle.copy(), self.images.patches
        on = np.flatnonzero((np.abs(np.abs(turn) - np.pi) < ON_BOUNDARY) & (ways.patch < 0).all(axis=1))
        seen = Ways.of(patches, on, ways.patch[on, :0], ways.end[on]).unobstructed(self.images.device)
        angle[on[~seen], 1] += 2.0 * ON_BOUNDARY * np.sign(turn[on[~seen]])
        return replace(ways, angle=angle)

    def _rays(self, ways: _EdgeWays) -> EdgeRays:
        e = ways.edge
        cosine = (ways.direction[:, 0] * self.edges.along[e]).sum(axis=1)
        angle, leg = ways.angle.T, ways.leg.T
        return EdgeRays(self.edges.n[e], angle[0], angle[1], cosine, leg[0], leg[1], self.wavelength_m)

    def _reflection(self, patch: np.ndarray, cosine: np.ndarray) -> Pair:
        """TE and TM of mirrors and faces of the patches ``(L,)``."""
        if self.table is None:
            return -np.ones(len(patch)), np.ones(len(patch))
        return self.table.reflection(self.images.patches.group[patch], cosine, self.wavelength_m)

    def _described(self, ways: _EdgeWays) -> EdgePaths:
        edges, patches, rays = self.edges.take(ways.edge), self.images.patches, self._rays(ways)
        faces, cosines = patches.face_patch[edges.face], rays.incidence_cosines()
        reflected = [self._reflection(faces[:, j], cosines[2 + j]) for j in range(2)]
        through: list[Pair] | None = None
        if self.walls is not None and self.table is not None:
            through = []
            for j in range(2):  # of the way in air, behind a sheet; nothing passes a wedge
                te, tm, longer = self.table.passage(patches.group[faces[:, j]], cosines[j], self.wavelength_m)
                late = np.where(edges.n > 1.99, np.exp(-2j * np.pi / self.wavelength_m * longer), 0.0)
                through.append((te * late, tm * late))
        bent = diffraction_matrices(rays, reflected, through)
        before, behind = (_edge_basis(edges.along, ways.direction[:, j]) for j in range(2))
        field, sign = np.swapaxes(behind, 1, 2) @ bent @ before, bent[:, 0, 0].copy()
        outer, excess = ways.direction.copy(), np.zeros(len(ways.edge))
        legs = np.tile(np.eye(3, dtype=complex), (2, len(ways.edge), 1, 1))
        for j in range(2):  # what a mirror or a slab, one at most, makes of the field
            way, te, tm = ways.direction[:, j], *np.ones((2, len(ways.edge)), complex)
            slab, mirror = (np.flatnonzero(met[:, j] >= 0) for met in (ways.slab, ways.patch))
            normal = patches.normal[ways.patch[:, j]]
            normal[slab] = patches.mesh.face_normals[ways.slab[slab, j]]
            cosine = (way * normal).sum(axis=1)
            outer[mirror, j] -= 2.0 * cosine[mirror, None] * normal[mirror]
            te[mirror], tm[mirror] = self._reflection(ways.patch[mirror, j], np.abs(cosine[mirror]))
            if self.walls is not None and self.table is not None:
                te[slab], tm[slab], excess[slab] = self.table.passage(
                    self.group[ways.slab[slab, j]], np.abs(cosine[slab]), self.wavelength_m, ways.thickness_m[slab, j]
                )  # fmt: skip
            own = np.union1d(slab, mirror)
            comes, goes = (outer[own, j], way[own])[:: 1 - 2 * j]
            legs[j, own] = _at_plane(normal[own], comes, goes, te[own], tm[own])
            sign *= te
        field = legs[1] @ field @ legs[0]
        departure, arrival, length = outer[:, 0], -outer[:, 1], ways.leg.sum(axis=1)
        matrix = transverse_basis(arrival) @ field @ np.swapaxes(transverse_basis(departure), 1, 2)
        if self.table is None:
            sign, matrix = bent[:, 1, 1], bent[:, 1, 1, None, None] * np.eye(2)
        norm = np.sqrt(0.5 * (np.abs(matrix) ** 2).sum(axis=(1, 2)))
        size = self.wavelength_m / (4.0 * np.pi * length) * norm
        code, point = ways.stops()
        return EdgePaths(
            ways.receiver, ways.patch, code, point, length, excess, length - ways.direct, departure, arrival, matrix,
            size * sign / np.maximum(np.abs(sign), 1e-300), self.wavelength_m,
        )  # fmt: skip


@dataclass(frozen=True)
class _EdgeWays(Rows):
    """L ways over an edge each: the index of the ``receiver`` (L,) and of the ``edge`` (L,); the ``patch`` that mirrors or the face
    of the ``slab`` (L, 2) before and behind, -1 for none, where that ``stop`` is (L, 2, 3), and the ``thickness_m`` of a solid
    (L, 2); the ``point`` on the edge (L, 3) and ``at`` how far along (L,); and of both legs, unfolded at mirrors, lengths ``leg``
    (L, 2), ``angle`` about the edge (L, 2) and ``direction`` of propagation (L, 2, 3); the ``end`` points (L, 2, 3)."""

    receiver: np.ndarray
    edge: np.ndarray
    patch: np.ndarray
    slab: np.ndarray
    stop: np.ndarray
    thickness_m: np.ndarray
    point: np.ndarray
    at: np.ndarray
    leg: np.ndarray
    angle: np.ndarray
    direction: np.ndarray
    end: np.ndarray

    @property
    def direct(self) -> np.ndarray:
        """Length of the straight line between the ends [m], shape ``(L,)``."""
        return np.linalg.norm(self.end[:, 1] - self.end[:, 0], axis=1)

    @property
    def _points(self) -> np.ndarray:
        return np.stack([self.stop[:, 0], self.point, self.stop[:, 1]], axis=1)

    def distinct(self, distance_m: float) -> np.ndarray:
        """Indices of ways that no earlier one of the same receiver repeats, with mirrors on the same sides and all points within
        ``distance_m``: edges that lie so close are one."""
        side = (self.patch >= 0) @ np.array([1, 2]) + (self.slab >= 0) @ np.array([4, 8])
        return distinct(side + 16 * self.receiver, np.nan_to_num(self._points), distance_m)

    def stops(self) -> tuple[np.ndarray, np.ndarray]:
        """Codes ``(L, 2)`` and points ``(L, 2, 3)`` of the interactions, from the transmitter on."""
        all_codes = np.where(self.patch >= 0, MIRROR, np.where(self.slab >= 0, SLAB, 0))
        code = np.column_stack([all_codes[:, 0], np.full(len(self.edge), EDGE), all_codes[:, 1]])
        order = np.argsort(code == 0, axis=1, kind="stable")[:, :2]
        code = np.take_along_axis(code, order, axis=1).astype(np.int8)
        return code, np.take_along_axis(self._points, order[..., None], axis=1)


def _edge_basis(along: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Rows (b, p) of fields fixed to the edge, shape ``(L, 2, 3)``; see :mod:`warprrf.rf.em.diffraction`."""
    p = headings(np.cross(along, direction))[0]
    return np.stack([np.cross(direction, p), p], axis=1)


def _at_plane(
    normal: np.ndarray, before: np.ndarray, behind: np.ndarray, te: np.ndarray, tm: np.ndarray
) -> np.ndarray:
    """What a mirror or a slab makes of field vectors, shape ``(L, 3, 3)``."""
    across = across_incidence(before, normal, vectors_across(before)[0])
    inwards, outwards = np.cross(across, before), np.cross(across, behind)
    of_te = te[:, None, None] * across[:, :, None] * across[:, None, :]
    return of_te + tm[:, None, None] * outwards[:, :, None] * inwards[:, None, :]
