"""What stands on a straight way and lets a wave through: slabs, found by rays.

Two faces of one closed part, met one after the other and not at right angles, at most :data:`THICKEST_M` apart, are one slab
of that thickness. Any other face is a sheet, at corners too: a slab as thick as its material is said to be. So a
wall drawn as a sheet and the same wall drawn as a closed solid let the same through. The way is not bent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from warprrf.cache import cached_property
from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh, headings
from warprrf.rf.em.fresnel import slab_passage, slab_transmission
from warprrf.rows import Rows

MOST_SLABS = 8
"""Most that may be asked for on one way: five partitions stand between the ends of links on a floor of offices."""
THICKEST_M = 1.0
"""Thicker solids are taken to be hollow, a cabinet's or a room's: two sheets."""
ALIKE = 0.1
"""Least cosine between the normals, taken along the way, by which a slab is entered and left: at right angles rounding must not
decide."""


@dataclass(frozen=True)
class Slabs(Rows):
    """Slabs that N straight ways pass, in the order they are met, up to K each.

    Attributes:
        face: face by which each is entered, -1 past the last, shape ``(N, K)`` int32.
        cosine: of incidence, 0 past the last, shape ``(N, K)``.
        thickness_m: of a solid between two faces, NaN of a sheet and past the last [m], shape ``(N, K)``.
        range_m: where each is met, from the start [m], infinite past the last, shape ``(N, K)``.
    """

    face: np.ndarray
    cosine: np.ndarray
    thickness_m: np.ndarray
    range_m: np.ndarray

    @classmethod
    def none(cls, count: int, most: int) -> Slabs:
        """No slab on any of ``count`` ways."""
        size = count, most
        return cls(np.full(size, -1, np.int32), np.zeros(size), np.full(size, np.nan), np.full(size, np.inf))

    @property
    def count(self) -> np.ndarray:
        """Slabs on each way, shape ``(N,)``."""
        return (self.face >= 0).sum(axis=1)

    @property
    def reversed(self) -> Slabs:
        """The same in the other order; what is past the last comes first."""
        return Slabs(*(getattr(self, f.name)[:, ::-1] for f in fields(self)))

    @property
    def trimmed(self) -> Slabs:
        """The same without columns that no way uses; one at least."""
        used = np.asarray((self.face >= 0).any(axis=0))
        used[:1] |= ~used.any()
        return Slabs(*(getattr(self, f.name)[:, used] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class Walls:
    """Faces of a mesh that may be passed.

    Attributes:
        mesh: the mesh.
        passes: which faces let something through, shape ``(F,)`` bool.
        permittivity, thickness_m: of the slabs, if they are sheets, shape ``(F,)`` each.
        known: of which faces these are known, not assumed: others are as thick as that, drawn as solids too, ``(F,)`` bool.
        wavelength_m: wavelength [m].
        most: most slabs on one way.
        clearance_m: ways end so far before what lies at their end, and go on so far behind each face.
        device: where rays are cast.
    """

    mesh: Mesh
    passes: np.ndarray
    permittivity: np.ndarray
    thickness_m: np.ndarray
    known: np.ndarray
    wavelength_m: float
    most: int
    clearance_m: float
    device: DeviceLike = None

    @classmethod
    def of_slabs(
        cls,
        mesh: Mesh,
        permittivity: np.ndarray,
        thickness_m: np.ndarray,
        wavelength_m: float,
        most: int,
        clearance_m: float,
        device: DeviceLike = None,
        *,
        known: np.ndarray | None = None,
    ) -> Walls:
        """Those of which slabs of ``permittivity`` (F,) and ``thickness_m`` (F,), if they are sheets, let more than a
        millionth of the power through; of what is not ``known`` (F,) these are assumed."""
        # A solid is perhaps only a centimetre thick.
        thickness = np.where(mesh.closed_part_of >= 0, np.minimum(thickness_m, 0.01), thickness_m)
        te = slab_transmission(1.0, permittivity, thickness, wavelength_m)[0]
        passes = np.abs(te) ** 2 > 1e-6
        known = np.ones(len(passes), bool) if known is None else known
        return cls(mesh, passes, permittivity, thickness_m, known, wavelength_m, most, clearance_m, device)

    def field(self, slabs: Slabs) -> np.ndarray:
        """Field behind slabs over that without them, mean of both polarisations, complex, shape ``(N,)``."""
        met = slabs.face >= 0
        face, solid, found = slabs.face[met], slabs.thickness_m[met], np.ones(met.shape, complex)
        thickness = np.where(np.isnan(solid) | ~self.known[face], self.thickness_m[face], solid)
        cosine, permittivity = slabs.cosine[met], self.permittivity[face]
        te, tm, longer = slab_passage(cosine, permittivity, thickness, self.wavelength_m)
        found[met] = 0.5 * (te + tm) * np.exp(-2j * np.pi / self.wavelength_m * longer)
        return np.asarray(found.prod(axis=1))

    @cached_property
    def _part(self) -> np.ndarray:
        """Closed part of each face, -1 for none; copies that lie micrometres apart are one."""
        return np.append(self.mesh.parts_by_box(self.clearance_m), -1)[self.mesh.closed_part_of]

    @cached_property
    def _thin_m(self) -> np.ndarray:
        """Of solids so thin that a ray behind one face is behind them the extent across their largest face [m], of other faces
        NaN, shape ``(F,)``. What is thinner than the clearance is a sheet that was drawn twice."""
        mesh, own, found = self.mesh, np.flatnonzero(self._part >= 0), np.full(len(self._part), np.nan)
        part, order = self._part[own], np.argsort(self.mesh.areas[own], kind="stable")
        normal = np.zeros((part.max(initial=-1) + 1, 3))
        normal[part[order]] = mesh.face_normals[own[order]]  # the largest comes last, and stays
        height = _dot(mesh.triangles[own], normal[part, None])
        lowest, highest = np.full((2, len(normal)), [[np.inf], [-np.inf]])
        np.minimum.at(lowest, part, height.min(axis=1))
        np.maximum.at(highest, part, height.max(axis=1))
        thick = highest - lowest
        thin = (self.clearance_m < thick) & (thick < 3.0 * self.clearance_m)
        found[own] = np.where(thin, thick, np.nan)[part]
        return found

    def between(self, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, Slabs]:
        """Which of the ways from ``start`` to ``end``, (N, 3) or (3,), arrive, and the slabs that those pass."""
        start, end = (np.ascontiguousarray(a) for a in np.broadcast_arrays(start, end))
        toward, length = headings(end - start)
        arrived = [(np.zeros(0, int), Slabs.none(0, self.most))]
        for row, face, _, slabs in self._stops(start, toward, length - self.clearance_m):
            there = row[face < 0]
            arrived.append((there, slabs.take(there)))
        return _joined(arrived)

    def behind(
        self, start: np.ndarray, direction: np.ndarray, face: np.ndarray, range_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Slabs]:
        """What rays (N, 3) meet behind the first face that they hit: rows of rays, more than once where they go on, the
        faces met, their ranges [m], and the slabs passed before."""
        found = [(np.zeros(0, int), np.zeros(0, int), np.zeros(0), Slabs.none(0, self.most))]
        endless = np.full(len(start), np.inf)
        for k, (row, met, t, slabs) in enumerate(self._stops(start, direction, endless, (face, range_m))):
            own = (met >= 0) & (k > 0)
            found.append((row[own], met[own], t[own], slabs.take(row[own])))
        row, slabs = _joined([(a, d) for a, _, _, d in found])
        face, range_m = (np.concatenate([part[j] for part in found]) for j in (1, 2))  # type: ignore[misc]
        return row, face, range_m, slabs

    def _stops(
        self,
        start: np.ndarray,
        direction: np.ndarray,
        limit: np.ndarray,
        known: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, Slabs]]:
        """Where rays stop, one face after another: rows, faces, -1 where nothing is met before ``limit``, ranges, and the
        slabs of all rays so far. ``known`` are faces and ranges of what is met first."""
        row, slabs = np.arange(len(start)), Slabs.none(len(start), self.most)
        gone, last, count = np.zeros(len(start)), np.full(len(start), -1), np.zeros(len(start), int)
        part, first, normal = self._part, self.mesh.first_at_place, self.mesh.face_normals
        while len(row):
            if known is None:
                point = start[row] + gone[row, None] * direction[row]
                hit = self.mesh.cast(point, direction[row], device=self.device)
                face, t = np.asarray(hit.face), gone[row] + hit.t
            else:
                (face, t), known = known, None
            met = (face >= 0) & (t < limit[row])
            face = np.where(met, first[face], -1)
            cosine = np.abs(_dot(normal[face], direction[row]))
            before, place = last[row], count[row] - 1
            again = np.flatnonzero(met & (before >= 0) & (part[face] >= 0) & (part[face] == part[before]))
            r, k = row[again], place[again]
            apart = (t[again] - slabs.range_m[r, k]) * slabs.cosine[r, k]
            along, left, entered = direction[row[again]], normal[face[again]], normal[before[again]]
            turned = np.sign(_dot(left, along) * _dot(entered, along))  # however they are wound
            alike = turned * _dot(left, entered)
            back = (apart <= THICKEST_M + self.clearance_m) & (alike > ALIKE)
            slabs.thickness_m[r[back], k[back]] = apart[back]
            out = np.zeros(len(row), bool)
            out[again[back]] = True
            yield row[~out], face[~out], t[~out], slabs
            on = met & ~out & self.passes[face] & (place + 1 < self.most)
            r, k = row[on], place[on] + 1
            slabs.face[r, k], slabs.cosine[r, k], slabs.range_m[r, k] = face[on], cosine[on], t[on]
            slabs.thickness_m[r, k] = self._thin_m[face[on]]
            last[row] = np.where(on, face, -1)
            count[r] += 1
            # Sheets closer than the clearance, seen at a slant, are one.
            gone[row] = np.where(met, t + 3.0 * self.clearance_m / np.maximum(cosine, 0.1), 0.0)
            row = row[on | out]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("...i,...i->...", a, b))


def _joined(parts: list[tuple[np.ndarray, Slabs]]) -> tuple[np.ndarray, Slabs]:
    rows, slabs = zip(*parts, strict=True)
    return np.concatenate(rows), Slabs.joined(slabs)
