"""Surfaces as radio sees them: planar patches, material groups, small elements, and images of a transmitter.

A group is what a fit never parts: a Scene's material where that is known, else a piece of one colour in a plane, or of one
shape. A fit may take several groups for one material. An element is a piece of one group, about half a metre wide in a room and
wider in a street, at which scale surfaces light each other; a cell is a piece of an element: what differs within a group is
told apart at both scales.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from warprrf.cache import Cache, cached_property
from warprrf.checks import Expected, check_arrays, check_number, index_to, lengths
from warprrf.device import DeviceLike, resolve
from warprrf.geometry.mesh import GeometryLike, Mesh, as_mesh, components, smoothed_normals, vectors_across
from warprrf.geometry.planar_patches import PlanarPatches, planar_patches
from warprrf.geometry.scans import is_scan, scanned_patches
from warprrf.geometry.splats.gaussians import gaussians_of
from warprrf.rf.em.fresnel import SurfaceTable
from warprrf.rf.em.materials import VACUUM_PERMITTIVITY, Material, is_name_alone, itu_name, itu_permittivity
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.slabs import Walls
from warprrf.rf.tracing.cells import ELEMENT_M, Cells, Tiles
from warprrf.rf.tracing.groups import SHAPES, Colours, colour_groups, shape_groups
from warprrf.rows import distinct_rows

ELEMENTS = 30_000
"""Larger scenes have wider elements, so that there are about so many: light between them takes up to 50 kB each. The
least width holds up to 7500 m^2 of surfaces (a hall's), the largest of 25 m up to 19 km^2 (a town's)."""
POSITION_ERROR_M = 0.02  # of a reconstructed surface: shadow rays end so far before it
TRUE_ERROR_M = 1e-4
LOSSY = 4.0 * (1.0 - 0.06j)
"""Permittivity of walls of unknown material: the loss tangent of plasterboard and wood at 300 GHz (ITU-R P.2040-4, table 3)."""
_UNIT = Expected("F 3", -1.001, 1.001)
ARRAYS = {
    "normal": _UNIT,
    "patch": index_to("P", "F", -1),
    "plane_normal": replace(_UNIT, shape="P 3"),
    "plane_offset": lengths("P"),
    "group": index_to("G", "F"),
    "material": index_to("G", "G"),
    "appearance": Expected("G K", nan=True),
    "patch_group": index_to("G", "P"),
    "thickness_m": Expected("G", 0.0, np.inf, nan=True),
    "dispersion": Expected("G 4", nan=True),
    "face_object": index_to("O", "F", -1),
}
"""What the arrays of a :class:`Surface` must be: F faces, P patches, G groups, K looks, O objects."""


@dataclass(frozen=True)
class Parts:
    """Cells, and elements split where something stands on the surface.

    Attributes:
        element: of each cell, after the split, shape ``(X,)``.
        parted: whether something stands between a cell's middle and that of one beside it, shape ``(X,)``.
        middle: tile in the middle of each cell, shape ``(X,)``.
        tree: of places in these tiles [m].
    """

    element: np.ndarray
    parted: np.ndarray
    middle: np.ndarray
    tree: cKDTree


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with what the radio field needs to know of each face.

    Attributes:
        mesh: the mesh, without faces that lie on others.
        normal: unit normals that scattering uses: of the patch, or smoothed, shape ``(F, 3)``.
        patch: planar patch of each face, -1 for none, shape ``(F,)`` int32.
        plane_normal, plane_offset: planes of the patches, ``normal . x = offset`` [m], shapes ``(P, 3)``, ``(P,)``.
        group: group of each face, the smallest unit that may be of a material of its own, shape ``(F,)`` int32.
        material: number of the material that each group is taken for before any measurement, shape ``(G,)`` int32.
        appearance: what tells groups apart before any measurement, scaled so that 1 tells materials apart: log chromaticities
            and log luminance as photos show them, else place and extents, shape ``(G, 4)`` or ``(G, 6)``; NaN where names
            tell it.
        patch_group: group of each patch, shape ``(P,)`` int32.
        cells: the cells that its points belong to, X in all.
        thickness_m: thickness of what each group is a slab of [m], shape ``(G,)``; NaN where nobody knows.
        dispersion: a, b, c and d of each group's relative permittivity a f^b and conductivity c f^d [S/m], f in GHz, shape
            ``(G, 4)``; NaN where ITU-R P.2040-4 tells by the name, or nobody knows.
        group_names: what the groups are called.
        position_error_m: of the surface [m]: rays end so far before it.
        two_sided: whether faces have two sides; False: mirrors that of ``plane_normal``, elements the front one, of a surface
            that photos saw.
        face_object: object that each face belongs to, -1 for none, shape ``(F,)`` int32; by default none.
        object_names: what the objects are called.
        scattering: coefficient S of each group before any measurement, which mirrors beside edges lose, shape ``(G,)``; by
            default 0. It is not saved.
    """

    mesh: Mesh = field(repr=False)
    normal: np.ndarray
    patch: np.ndarray
    plane_normal: np.ndarray
    plane_offset: np.ndarray
    group: np.ndarray
    material: np.ndarray
    appearance: np.ndarray
    patch_group: np.ndarray
    cells: Cells = field(repr=False)
    thickness_m: np.ndarray
    dispersion: np.ndarray
    group_names: tuple[str, ...]
    position_error_m: float
    two_sided: bool = False
    face_object: np.ndarray = None  # type: ignore[assignment]  # made when it is not given
    object_names: tuple[str, ...] = ()
    scattering: np.ndarray = None  # type: ignore[assignment]
    _uploaded: Cache = field(init=False, repr=False, default_factory=lambda: Cache(4))

    def __post_init__(self) -> None:
        if self.face_object is None:
            object.__setattr__(self, "face_object", np.full(len(self.mesh.faces), -1, np.int32))
        if self.scattering is None:
            object.__setattr__(self, "scattering", np.zeros(len(self.group_names)))
        sizes = {"F": len(self.mesh.faces), "G": len(self.group_names), "O": len(self.object_names)}
        check_arrays(vars(self), ARRAYS, **sizes)
        check_number("position_error_m", self.position_error_m, 0.0, 10.0)
        if len(self.cells.axis) != sizes["F"]:
            raise ValueError(f"cells: got those of {len(self.cells.axis)} faces, expected {sizes['F']}")

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @cached_property
    def front_normal(self) -> np.ndarray:
        """``normal`` on the side that each face is wound for, shape ``(F, 3)``."""
        behind = (self.normal * self.mesh.face_normals).sum(axis=1, keepdims=True) < 0
        return np.where(behind, -self.normal, self.normal)

    @cached_property
    def side_normal(self) -> np.ndarray:
        """What the first side of each face's element faces, however its faces are wound, shape ``(F, 3)``."""
        if not self.two_sided:
            return self.front_normal
        own, normal = self.patch >= 0, self.front_normal.copy()
        normal[own] = self.plane_normal[self.patch[own]]
        return normal

    @cached_property
    def tiles(self) -> Tiles:
        """Its faces cut into pieces of single cells."""
        return self.cells.tiles(self.mesh)

    @property
    def element(self) -> np.ndarray:
        """Element of each cell: those of ``cells``, apart where a wall stands between them, shape ``(X,)``."""
        return self.parts.element

    @cached_property
    def parts(self) -> Parts:
        """Its cells, and elements as far as walls do not part them."""
        tiles, cell_m = self.tiles, float(np.sqrt(np.bincount(self.tiles.cell, self.tiles.area).max()))
        middle = tiles.middles(tiles.cell)
        face, place = tiles.face[middle], tiles.off_centre[middle]
        pair = cKDTree(place).query_pairs(1.4 * cell_m, output_type="ndarray")
        pair = pair[(np.ptp(self.patch[face[pair]], axis=1) == 0) & (self.patch[face[pair[:, 0]]] >= 0)]
        free, parted = self._see(place, face, pair), np.zeros(len(face), bool)
        parted[pair[~free]] = True
        # A cell in part under a cabinet is what of it is in the open.
        near = 0.25 * place[parted, None] + 0.75 * tiles.corners[middle[parted], :4]
        place[parted] = self._most_open(np.concatenate([place[parted, None], near], axis=1), face[parted])
        again = parted[pair].any(axis=1)
        free[again] = self._see(place, face, pair[again])
        parted[pair[~free]] = True
        linked = pair[free & (np.ptp(self.cells.element[pair], axis=1) == 0)]
        piece = np.where(self.patch[face] < 0, -1, components(len(face), linked))
        element = distinct_rows(np.column_stack([self.cells.element, piece]))[1]
        return Parts(element.astype(np.int32), parted, middle, cKDTree(place))

    def _sides(self, face: np.ndarray) -> list[np.ndarray]:
        """Normals (N, 3) of the sides that faces (N,) have."""
        return [sign * self.side_normal[face] for sign in (1.0, -1.0)[: 1 + self.two_sided]]

    def _see(self, place: np.ndarray, face: np.ndarray, pair: np.ndarray) -> np.ndarray:
        """Whether nothing stands on the surface between each ``pair`` (K, 2) of places (N, 3) on faces (N,), shape ``(K,)``."""
        above = [place + self._above_m * normal for normal in self._sides(face)]
        return np.all([self.mesh.visible(*at[pair.T], clearance=0.0) for at in above], axis=0)

    def _most_open(self, places: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Of ``places`` (N, K, 3) on each of faces (N,) the one with most air above it, by three rays a side, shape ``(N, 3)``."""
        room = np.zeros(places.shape[:2])
        for normal in self._sides(face):
            across, over = vectors_across(normal)
            for turn in 2.0 * np.pi / 3.0 * np.arange(3):
                toward = normal + np.cos(turn) * across + np.sin(turn) * over
                start = (places + self._above_m * normal[:, None]).reshape(-1, 3)
                hit = self.mesh.cast(start, np.repeat(toward, places.shape[1], axis=0))
                room += np.minimum(hit.t, 10.0 * ELEMENT_M).reshape(room.shape)
        return places[np.arange(len(face)), room.argmax(axis=1)]

    @property
    def _above_m(self) -> float:
        """How far above the surface it is asked what stands on it [m]."""
        return 3.0 * self.position_error_m

    def tile_at(self, face: np.ndarray, point: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Tile that rays of ``direction`` (N, 3) meet at ``point`` (N, 3) on ``face`` (N,). Where a wall stands between a point and
        the middle of its cell, that of the next cell on the point's side of it."""
        parts, tile = self.parts, self.cells.square_at(face, point)
        own = np.flatnonzero(parts.parted[self.cells.cell[tile]])
        start, middle = point[own], parts.tree.data[self.cells.cell[tile[own]]]
        normal = self._above_m * self.mesh.face_normals[face[own]]
        above = np.where((normal * direction[own]).sum(axis=1)[:, None] > 0, -normal, normal)
        hidden = ~self.mesh.visible(start + above, middle + above, clearance=0.0)
        own, start, above = own[hidden], start[hidden], above[hidden]
        near = parts.tree.query(start, range(1, 25))[1] % len(parts.middle)
        row, k = np.nonzero(self.patch[self.tiles.face[parts.middle[near]]] == self.patch[face[own]][:, None])
        middle = parts.tree.data[near[row, k]]
        seen = self.mesh.visible((start + above)[row], middle + above[row], clearance=0.0)
        row, first = np.unique(row[seen], return_index=True)
        tile[own[row]] = parts.middle[near[row, k[seen][first]]]
        return tile

    @cached_property
    def element_area(self) -> np.ndarray:
        """Area of each element [m^2], shape ``(E,)``."""
        return np.maximum(np.bincount(self.element[self.tiles.cell], self.tiles.area), 1e-12)

    @cached_property
    def element_group(self) -> np.ndarray:
        """Group of each element, shape ``(E,)`` int32."""
        found = np.zeros(len(self.element_area), np.int32)
        found[self.element[self.tiles.cell]] = self.group[self.tiles.face]
        return found

    @property
    def element_sides(self) -> int:
        """Number of elements' sides: two each, or that of a reconstructed surface which photos saw."""
        return (1 + self.two_sided) * len(self.element_area)

    def is_behind(self, face: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Whether rays of ``direction`` (N, 3) meet the second side of ``face`` (N,), shape ``(N,)`` bool."""
        if not self.two_sided:
            return np.zeros(len(face), bool)
        return np.asarray(np.einsum("ni,ni->n", self.side_normal[face], direction) > 0)

    @cached_property
    def tile_side(self) -> np.ndarray:
        """Side of an element that each side of a tile is of: first sides, then second ones, shape ``((1 + two_sided) T,)``."""
        element = self.element[self.cells.cell]
        sides = range(1 + self.two_sided)
        return np.concatenate([element + side * len(self.element_area) for side in sides])

    @property
    def groups(self) -> int:
        """Number of groups."""
        return len(self.group_names)

    @property
    def by_shape(self) -> bool:
        """Whether only shapes tell its groups apart."""
        return self.appearance.shape[1] == SHAPES

    def faces_of(self, name: str) -> np.ndarray:
        """Faces of the object called ``name``, else of the group that is, shape ``(F,)`` bool."""
        if name in self.object_names:
            return np.asarray(self.face_object == self.object_names.index(name))
        return np.asarray(self.group == (self.group_names.index(name) if name in self.group_names else -1))

    @classmethod
    def of(
        cls, geometry: GeometryLike, *, element_m: float | None = None, frequency_hz: float | None = None
    ) -> Surface:
        """Patches, groups and elements of a Reconstruction, a Scene or a Mesh; a Surface is returned as it is.

        Materials of a Scene become groups, and those that a Mesh has names of; else pieces of one colour, or of one shape
        where there are no colours. A mesh with the noise of a scan is flattened where planes are found in it. Elements are
        ``element_m`` wide; by default as the whole asks for. Materials of several bands are of that which holds
        ``frequency_hz``, by default the first.
        """
        if isinstance(geometry, Surface):
            return geometry
        mesh = as_mesh(geometry, "geometry")
        element_m = element_width(mesh) if element_m is None else element_m
        material, names = named_faces(geometry, mesh)
        patches, colours, measured = _patches_and_colours(geometry, mesh, material)
        mesh = patches.mesh
        if material is not None:
            group, alike = material, np.arange(len(names), dtype=np.int32)
            appearance = np.full((len(names), 4), np.nan)
        else:
            pieces = mesh, patches.face_patch
            group, alike, appearance = (
                shape_groups(*pieces) if colours is None else colour_groups(*pieces, colours)
            )
            names = tuple(f"group_{k}" for k in range(len(alike)))
        if measured:
            normal, error_m = _on_patches(patches, smoothed_normals(mesh, 3)), POSITION_ERROR_M
        else:
            # A mesh's error is not roughness: faces of a patch have its normal, and rays end so far before it.
            normal, error_m = _on_patches(patches, mesh.face_normals), max(TRUE_ERROR_M, patches.tolerance_m)
        patch, planes = patches.face_patch, (patches.normal, patches.offset)
        if patches.two_sided:
            # Smaller patches than a fifth of an element in a room reflect too little to search for.
            least_m2 = 0.2 * min(element_m, ELEMENT_M) ** 2
            patch, planes = _mirrors(_apart(patches, alike[group]), least_m2)
        sides = patches.two_sided
        parent = np.flatnonzero(patches.once)
        mesh = Mesh(mesh.vertices, mesh.faces[parent])
        group, patch = group[parent].astype(np.int32), patch[parent].astype(np.int32)
        cells = Cells.of(mesh, group, patch, planes[0], element_m)
        return cls(
            mesh=mesh, normal=np.asarray(normal[parent]), patch=patch, plane_normal=planes[0], plane_offset=planes[1],
            group=group, material=alike, appearance=appearance, patch_group=largest_groups(mesh, patch, group, len(planes[1])),
            **_slabs(geometry, material, len(names), frequency_hz), group_names=tuple(names), position_error_m=error_m,
            two_sided=sides, cells=cells, **objects_of(geometry, parent),
        )  # fmt: skip

    @classmethod
    def of_materials(cls, patches: PlanarPatches, material: np.ndarray, names: Sequence[str]) -> Surface:
        """That of faces of known materials (F,) on exact patches, all one element: nothing of it is learned."""
        mesh, groups = patches.mesh, len(names)
        one, faces = Cells.of_faces(np.zeros(len(mesh.faces)), np.zeros(1)), patches.group
        return cls(
            mesh=mesh, normal=mesh.face_normals, patch=patches.face_patch, plane_normal=patches.normal,
            plane_offset=patches.offset, group=material, material=np.arange(groups, dtype=np.int32),
            appearance=np.full((groups, 4), np.nan), patch_group=faces, cells=one,
            **_slabs(mesh, None, groups, None), group_names=tuple(names), position_error_m=TRUE_ERROR_M, two_sided=True,
        )  # fmt: skip

    @cached_property
    def side_group(self) -> np.ndarray:
        """Group of each element's side."""
        return np.tile(self.element_group, 1 + self.two_sided)

    def on_device(self, device: DeviceLike, real: Any) -> tuple[wp.array, wp.array]:
        """Normals of the faces, and those that scattering uses in precision ``real``, as kernels take them."""
        where = resolve(device)

        def upload() -> tuple[wp.array, wp.array]:
            flat = wp.array(self.mesh.face_normals, dtype=wp.vec3d, device=where)
            return flat, wp.array(self.normal, dtype=wp.types.vector(3, real), device=where)

        return self._uploaded.get((str(where), real), upload)

    def slab_properties(self, frequency_hz: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What each group lets through before any measurement: complex permittivity, 0 where that or the thickness is not known;
        thickness in wavelengths; and, where it is not known, ln of the share of power that is not absorbed, by an assumed
        one, else 0; shape ``(G,)`` each."""
        wavelength_m, eta = SPEED_OF_LIGHT / frequency_hz, np.full(self.groups, LOSSY)
        known = np.isfinite(self.dispersion).all(axis=1)
        a, b, c, d = self.dispersion[known].T
        ghz = frequency_hz / 1e9
        eta[known] = a * ghz**b - 1j * c * ghz**d / (2.0 * np.pi * frequency_hz * VACUUM_PERMITTIVITY)
        for g, name in enumerate(map(itu_name, self.group_names)):
            if name is not None and not known[g]:
                eta[g], known[g] = itu_permittivity(name, frequency_hz), True
        known_slab = known & ~np.isnan(self.thickness_m)
        plasterboard_m, most_nepers = 0.0125, 30.0
        thickness = np.where(np.isnan(self.thickness_m), plasterboard_m, self.thickness_m) / wavelength_m
        absorbed = 4.0 * np.pi * np.where(known_slab, 0.0, thickness) * np.sqrt(eta).imag
        return (
            np.where(known_slab, eta, 0.0),
            thickness,
            np.where(known_slab, 0.0, np.maximum(absorbed, -most_nepers)),
        )

    def table(self, frequency_hz: float) -> SurfaceTable:
        """Its groups as smooth surfaces, before any measurement: slabs where that is known, else half-spaces."""
        eta, thickness, _ = self.slab_properties(frequency_hz)
        known, none = np.abs(eta) > 0, np.zeros(self.groups, np.int32)
        thickness_m = np.where(known, thickness * SPEED_OF_LIGHT / frequency_hz, np.inf)
        return SurfaceTable(np.where(known, eta, LOSSY), thickness_m, self.scattering, none, none > 0)

    def walls(self, frequency_hz: float, most: int, device: DeviceLike = None) -> Walls:
        """Its faces that may be passed, as far as :meth:`slab_properties` tells, up to ``most`` on one way."""
        eta, thickness, absorbed = self.slab_properties(frequency_hz)
        wavelength_m, known = SPEED_OF_LIGHT / frequency_hz, np.abs(eta) > 0
        permittivity = np.where(known, eta, 1.0 + 0.5j * absorbed / (np.pi * thickness))[self.group]
        return Walls.of_slabs(
            self.mesh, permittivity, (wavelength_m * thickness)[self.group], wavelength_m, most, self.position_error_m, device,
            known=known[self.group],
        )  # fmt: skip

    @cached_property
    def patches(self) -> PlanarPatches:
        """Its patches."""
        found = PlanarPatches.from_planes(
            self.mesh, self.patch, self.plane_normal, self.plane_offset, tolerance_m=self.position_error_m, two_sided=self.two_sided
        )  # fmt: skip
        return replace(found, group=self.patch_group)  # edges ask what their faces are made of

    def images(self, transmitter: np.ndarray) -> np.ndarray:
        """Image of ``transmitter`` (3,) in every patch's plane [m], shape ``(P, 3)``."""
        height = self.plane_normal @ transmitter - self.plane_offset
        return np.asarray(transmitter - 2.0 * height[:, None] * self.plane_normal)


def _patches_and_colours(
    geometry: GeometryLike, mesh: Mesh, material: np.ndarray | None
) -> tuple[PlanarPatches, Colours | None, bool]:
    """Patches, with their mesh, which is another one if ``mesh`` is a scan; colours on it, None where there are none or
    ``material`` (F,) is known; and whether photos or a scanner measured them."""
    if material is not None:
        return planar_patches(mesh, material), None, False
    found, gaussians = getattr(geometry, "patches", None), gaussians_of(geometry)
    if isinstance(found, PlanarPatches) and gaussians is not None:
        return found, Colours.of_gaussians(mesh, gaussians), True
    colours = Colours.of_faces(mesh)
    if not is_scan(mesh):
        return planar_patches(mesh), colours, False
    flat = scanned_patches(mesh)
    if colours is not None:
        places = mesh.triangles[colours.face].mean(axis=1)
        colours = replace(colours, face=flat.mesh.closest(places).face)
    return flat, colours, True


def _apart(patches: PlanarPatches, material: np.ndarray) -> PlanarPatches:
    """``patches`` split where their faces are taken for different materials (F,): what lies in one plane need not mirror
    alike."""
    own = patches.face_patch >= 0
    key = np.column_stack([patches.face_patch, material])[own]
    pair, index = np.unique(key, axis=0, return_inverse=True)
    label = np.full(len(own), -1, np.int32)
    label[own] = index.reshape(-1)
    once = own & patches.once
    area = np.bincount(label[once], patches.mesh.areas[once], minlength=len(pair))
    normal, offset = patches.normal[pair[:, 0]], patches.offset[pair[:, 0]]
    return replace(
        patches, face_patch=label, normal=normal, offset=offset, area=area, group=pair[:, 1].astype(np.int32)
    )


def named_faces(geometry: GeometryLike, mesh: Mesh) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Index of each face's material, or None where there are no names to tell faces apart, and the names: those of a
    Scene's materials, else of the mesh's, the last for faces of none."""
    known, materials = getattr(geometry, "face_material", None), getattr(geometry, "materials", ())
    if known is not None and (len(materials) > 1 or not any(map(is_name_alone, materials))):
        return np.asarray(known, np.int32), tuple(m.name for m in materials)
    if mesh.face_label is None:
        return None, ()
    names = mesh.labels
    own = np.where(mesh.face_label < 0, len(names), mesh.face_label)
    used, group = np.unique(own, return_inverse=True)
    if len(used) < 2:
        return None, ()
    return group.reshape(-1).astype(np.int32), tuple((*names, "unnamed")[k] for k in used)


def _slabs(
    geometry: GeometryLike, named: np.ndarray | None, groups: int, frequency_hz: float | None
) -> dict[str, Any]:
    """Thickness and dispersion of each group, where the groups are a Scene's materials; else NaN."""
    materials = getattr(geometry, "materials", ())
    thickness, dispersion = np.full(groups, np.nan), np.full((groups, 4), np.nan)
    if named is not None and len(materials) == groups:
        for g, m in enumerate(materials):
            if not is_name_alone(m):
                thickness[g] = float(m.thickness_m)
                if isinstance(m, Material):
                    dispersion[g] = law_of(m, m.name, frequency_hz)
    return {"thickness_m": thickness, "dispersion": dispersion}


def law_of(
    material: Material, name: str, frequency_hz: float | None = None
) -> tuple[float, float, float, float]:
    """Dispersion of a group called ``name`` of a ``material`` whose bands are known, by that which holds ``frequency_hz`` or is
    nearest to it, by default the first; NaN where ITU-R P.2040-4 tells by the name."""
    if material.itu is not None and itu_name(name) == material.itu:
        return np.nan, np.nan, np.nan, np.nan
    band = material.bands[0] if frequency_hz is None else material.extrapolated().band(frequency_hz)
    return band.a, band.b, band.c, band.d


def objects_of(geometry: GeometryLike, parent: np.ndarray) -> dict[str, Any]:
    """Object of each face, a piece of ``parent`` (F,), and the objects' names, by the names of :class:`Surface`; none of a geometry
    that has none, or was flattened."""
    known, names = getattr(geometry, "face_object", None), tuple(getattr(geometry, "object_names", ()))
    if known is None or not names or len(known) <= parent.max():
        known, names = np.full(parent.max() + 1, -1), ()
    return {"face_object": np.asarray(known, np.int32)[parent], "object_names": names}


def largest_groups(mesh: Mesh, patch: np.ndarray, group: np.ndarray, patches: int) -> np.ndarray:
    """The group that has most of each patch's area, shape ``(P,)`` int32."""
    area = np.zeros((patches, int(group.max(initial=0)) + 1))
    own = patch >= 0
    np.add.at(area, (patch[own], group[own]), mesh.areas[own])
    return area.argmax(axis=1).astype(np.int32)


def element_width(mesh: Mesh) -> float:
    """Width of elements [m]: as many as :data:`ELEMENTS` at most, pieces of small patches apart; :data:`ELEMENT_M`, or less in
    scenes so small that there would be fewer than 300."""
    area, fewest, widest_m = float(mesh.areas.sum()), 300, 25.0
    width_m = max(min(ELEMENT_M, float(np.sqrt(area / fewest))), float(np.sqrt(area / ELEMENTS)))
    if width_m > widest_m:
        size = " x ".join(f"{e:.4g}" for e in np.ptp(mesh.bounds, axis=0))
        raise ValueError(
            f"geometry: its {area:.3g} m^2 of surfaces would be cut into elements of {width_m:.3g} m, expected at most "
            f"{widest_m:g} m; its box is {size} m: if that is not in metres but in millimetres, give "
            "Mesh(1e-3 * vertices, faces), else the part of it that was measured"
        )
    return width_m


def _mirrors(patches: PlanarPatches, least_m2: float) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Patches of at least ``least_m2``, those of one group in one plane as one: patch of each face, -1 for none, and planes.

    Faces that overlap in a plane, or sheets closer than the tolerance, would mirror twice.
    """
    large = np.flatnonzero(patches.area >= least_m2)
    middle = patches.mesh.center
    height = patches.offset[large] - patches.normal[large] @ middle
    reach = 0.5 * float(np.linalg.norm(np.ptp(patches.mesh.bounds, axis=0)))
    plane = np.column_stack([reach * patches.normal[large], height])
    count = len(large)
    near = cKDTree(np.concatenate([plane, -plane])).query_pairs(patches.tolerance_m, output_type="ndarray")
    near = near[(near[:, 0] < count) | (near[:, 1] < count)] % max(count, 1)
    near = near[patches.group[large][near[:, 0]] == patches.group[large][near[:, 1]]]
    piece = components(count, near)
    first, piece = np.unique(piece, return_index=True, return_inverse=True)[
        1:
    ]  # the largest: they stand by area
    order = np.full(len(patches) + 1, -1)
    order[large] = piece.reshape(-1)
    own = large[first]
    return order[patches.face_patch].astype(np.int32), (patches.normal[own], patches.offset[own])


def _on_patches(patches: PlanarPatches, normal: np.ndarray) -> np.ndarray:
    """``normal`` (F, 3), but of its patch where a face has one, on the side that the face is wound for; upward for faces
    without area."""
    own = patches.face_patch >= 0
    flat = patches.normal[patches.face_patch[own]]
    turned = (flat * patches.mesh.face_normals[own]).sum(axis=1, keepdims=True) < 0
    result = np.where(normal.any(axis=1, keepdims=True), normal, [0.0, 0.0, 1.0])
    result[own] = np.where(turned, -flat, flat)
    return result
