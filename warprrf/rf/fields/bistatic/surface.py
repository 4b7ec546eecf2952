"""Surfaces as radio sees them: planar patches, material groups, small elements, and images of a transmitter.

A group holds faces that look alike and so share radio parameters: a Scene's materials where they are known, else
patches of a reconstruction gathered by the colour that photos gave them. An element is a piece of one group, about half
a metre wide, at which scale surfaces light each other; a texel is a piece of an element: what differs within a group is
told apart at both scales.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_topology import connected_pieces, smoothed_normals
from warprrf.geometry.planar_patches import PlanarPatches, planar_patches
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.kernels.radio import bounce

ELEMENT_M = 0.5  # width of an element
TEXELS = 3  # along an element
LARGEST_FACE_M = 0.6  # longer edges are split, so that elements can be small
MIN_MIRROR_M2 = 0.05  # smaller patches reflect too little to search for
LARGE_PIECE_M2 = 1.5  # a piece of a patch this large is a group of its own
SMALLEST_GROUP_M2 = 0.5
SMALLEST_SHEET_M2 = 0.2
COLOUR_CELL_M = 0.4  # colours are averaged over cells of this size
CHROMA_STEP = 0.05  # log chromaticities that differ by less look alike
LUMINANCE_STEP = 0.3  # and log luminances
Y00 = 0.28209479177387814  # harmonic of degree 0
SKIN_M = 0.02  # depth of a reconstructed surface's skin: shadow rays ignore it
TRUE_SKIN_M = 1e-4


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh with what the radio field needs to know of each face.

    Attributes:
        mesh: the mesh, long edges split.
        normal: unit normals that scattering uses: of the patch, or smoothed, shape ``(F, 3)``.
        patch: planar patch of each face, -1 for none, shape ``(F,)`` int32.
        plane_normal, plane_offset: planes of the patches, ``normal . x = offset`` [m], shapes ``(P, 3)``, ``(P,)``.
        group: group of each face, the smallest unit that may be of a material of its own, shape ``(F,)`` int32.
        material: which groups are taken for the same material before any measurement, shape ``(G,)`` int32.
        look: colour of each group, scaled so that 1 tells materials apart, shape ``(G, 4)``; NaN where unknown.
        patch_group: group of each patch, shape ``(P,)`` int32.
        element: surface element of each face, shape ``(F,)`` int32.
        texel: texel of each face, shape ``(F,)`` int32.
        texel_element: element of each texel, shape ``(X,)`` int32.
        element_centre, element_area, element_group: of each element, shapes ``(E, 3)`` [m], ``(E,)`` [m^2], ``(E,)``.
        group_names: what the groups are called.
        skin_m: depth of the surface's skin.
    """

    mesh: Mesh = field(repr=False)
    normal: np.ndarray
    patch: np.ndarray
    plane_normal: np.ndarray
    plane_offset: np.ndarray
    group: np.ndarray
    material: np.ndarray
    look: np.ndarray
    patch_group: np.ndarray
    element: np.ndarray
    texel: np.ndarray
    texel_element: np.ndarray
    element_centre: np.ndarray
    element_area: np.ndarray
    element_group: np.ndarray
    group_names: tuple[str, ...]
    skin_m: float

    @property
    def groups(self) -> int:
        """Number of groups."""
        return len(self.group_names)

    @property
    def texels(self) -> int:
        """Number of texels."""
        return len(self.texel_element)

    @classmethod
    def of(cls, geometry: Any, *, element_m: float = ELEMENT_M) -> Surface:
        """Patches, groups and elements of a Reconstruction, a Scene (its materials become groups) or a bare Mesh.

        Raises:
            TypeError: if it has no mesh.
        """
        mesh = geometry if isinstance(geometry, Mesh) else getattr(geometry, "mesh", None)
        if not isinstance(mesh, Mesh):
            raise TypeError(
                f"geometry: got {type(geometry).__name__}, expected a Reconstruction, a Scene or a Mesh"
            )
        material = getattr(geometry, "face_material", None)
        gaussians = getattr(geometry, "gaussians", None)
        found = getattr(geometry, "patches", None)
        if material is None and isinstance(found, PlanarPatches) and isinstance(gaussians, Gaussians):
            patch, planes = found.face_patch, (found.normal, found.offset)
            normal = _normals(found)
            group, sort, look = _colour_groups(mesh, patch, gaussians)
            names, skin = tuple(f"group_{k}" for k in range(len(sort))), SKIN_M
        else:
            patches = planar_patches(mesh, material)
            large = np.flatnonzero(patches.area >= MIN_MIRROR_M2)
            order = np.full(len(patches) + 1, -1)
            order[large] = np.arange(len(large))
            patch = order[patches.face_patch].astype(np.int32)
            planes = patches.normal[large], patches.offset[large]
            # A mesh's error is not roughness: faces of a patch have its normal, and rays end so far before it.
            normal, skin = mesh.face_normals.copy(), max(TRUE_SKIN_M, patches.tolerance_m)
            flat = patches.face_patch >= 0
            whole = patches.normal[patches.face_patch[flat]]
            normal[flat] = np.where((whole * normal[flat]).sum(axis=1, keepdims=True) < 0, -whole, whole)
            if material is None:
                group, names = np.zeros(len(mesh.faces), np.int32), ("surface",)
            else:
                group = np.asarray(material, np.int32)
                names = tuple(m.name for m in geometry.materials)
            sort, look = np.arange(len(names), dtype=np.int32), np.full((len(names), 4), np.nan)
        mesh, parent = _split_long(mesh)
        return cls._assemble(
            mesh, normal[parent], patch[parent], planes, group[parent], (sort, look), names, skin, element_m
        )

    @classmethod
    def _assemble(
        cls,
        mesh: Mesh,
        normal: Any,
        patch: Any,
        planes: Any,
        group: Any,
        kinds: Any,
        names: Any,
        skin: float,
        element_m: float,
    ) -> Surface:
        centre, area = mesh.triangles.mean(axis=1), mesh.areas
        cells = np.floor(TEXELS * (centre - mesh.bounds[0]) / element_m).astype(np.int64)
        key = np.column_stack([group, patch, cells // TEXELS])
        element = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int32)
        pieces, texel = np.unique(np.column_stack([element, cells]), axis=0, return_inverse=True)
        total = np.maximum(np.bincount(element, area), 1e-12)
        middle = (
            np.stack([np.bincount(element, area * centre[:, k]) for k in range(3)], axis=1) / total[:, None]
        )
        owner = np.zeros(len(total), np.int32)
        owner[element] = group
        patch_group = np.zeros(len(planes[1]), np.int32)
        for p in range(len(planes[1])):
            own = patch == p
            if own.any():
                patch_group[p] = np.bincount(group[own], area[own]).argmax()
        return cls(
            mesh, np.asarray(normal), np.asarray(patch, np.int32), planes[0], planes[1], np.asarray(group, np.int32),
            kinds[0], kinds[1], patch_group, element, texel.reshape(-1).astype(np.int32),
            pieces[:, 0].astype(np.int32), middle, total, owner, tuple(names), skin,
        )  # fmt: skip

    def on_device(self, device: Any) -> Any:
        """The kernels' view of this surface."""
        where = _device.resolve(device)
        key = str(where)
        if key not in self._uploaded:
            s = bounce.Surface()
            s.mesh = self.mesh.on_device(where).id
            s.center = wp.vec3d(*self.mesh.center)
            s.corner = wp.array(self.mesh.triangles[:, 0], dtype=wp.vec3d, device=where)
            s.flat_normal = wp.array(self.mesh.face_normals, dtype=wp.vec3d, device=where)
            s.normal = wp.array(self.normal, dtype=wp.vec3, device=where)
            s.patch = wp.array(self.patch, dtype=wp.int32, device=where)
            s.group = wp.array(self.group, dtype=wp.int32, device=where)
            s.element = wp.array(self.element, dtype=wp.int32, device=where)
            s.clearance = self.skin_m
            self._uploaded[key] = s
        return self._uploaded[key]

    @cached_property
    def _uploaded(self) -> dict[str, Any]:
        return {}

    @cached_property
    def patch_boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corners of every patch's faces, ``(P, 3)`` each [m]."""
        low, high = (
            np.full((len(self.plane_offset), 3), np.inf),
            np.full((len(self.plane_offset), 3), -np.inf),
        )
        own = self.patch >= 0
        corner = self.mesh.triangles[own]
        np.minimum.at(low, self.patch[own], corner.min(axis=1))
        np.maximum.at(high, self.patch[own], corner.max(axis=1))
        return low, high

    def images(self, transmitter: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Image of ``transmitter`` (3,) in every patch's plane, ``(P, 3)``, and its height over it, ``(P,)`` [m]."""
        height = self.plane_normal @ transmitter - self.plane_offset
        return transmitter - 2.0 * height[:, None] * self.plane_normal, height


def _split_long(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """``mesh`` with faces halved across their longest edge until none is long, and each face's parent.

    Both faces at an edge are split at its midpoint or not at all, because the edge's length alone decides: no cracks.
    """
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    parent = np.arange(len(faces))
    done_faces, done_parent = [], []
    for _ in range(64):
        edge = np.linalg.norm(vertices[np.roll(faces, -1, axis=1)] - vertices[faces], axis=2)
        longest = edge.argmax(axis=1)
        long = edge.max(axis=1) > LARGEST_FACE_M
        done_faces.append(faces[~long])
        done_parent.append(parent[~long])
        if not long.any():
            break
        f, first = faces[long], longest[long]
        pick = np.arange(len(f))
        a, b, c = f[pick, first], f[pick, (first + 1) % 3], f[pick, (first + 2) % 3]
        ends = np.sort(np.column_stack([a, b]), axis=1)
        unique, index = np.unique(ends, axis=0, return_inverse=True)
        middle = len(vertices) + index.reshape(-1)
        vertices = np.concatenate([vertices, 0.5 * (vertices[unique[:, 0]] + vertices[unique[:, 1]])])
        faces = np.concatenate([np.column_stack([a, middle, c]), np.column_stack([middle, b, c])])
        parent = np.concatenate([parent[long], parent[long]])
    return Mesh(vertices, np.concatenate(done_faces)), np.concatenate(done_parent)


def _normals(patches: PlanarPatches) -> np.ndarray:
    """Normal of each face: of its patch, on the side that it is wound for, else smoothed, shape ``(F, 3)``."""
    mesh, own = patches.mesh, patches.face_patch >= 0
    normal = smoothed_normals(mesh, 3)
    flat = patches.normal[patches.face_patch[own]]
    turned = (flat * mesh.face_normals[own]).sum(axis=1) < 0
    normal[own] = np.where(turned[:, None], -flat, flat)
    return normal


def _colour_groups(
    mesh: Mesh, patch: np.ndarray, gaussians: Gaussians
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Groups of faces by patch and photo colour; the material that each is taken for, and its look.

    A patch is split into its connected sheets (other things in the same plane), and a sheet where its colour changes:
    such pieces are the groups. Each large one is taken for a material of its own: grey stone and grey paint look alike.
    Small pieces join the large one that looks most like them, if any does, else each other. Chromaticity counts more
    than luminance, which is also shade.
    """
    centre, area = mesh.triangles.mean(axis=1), mesh.areas
    colour = np.log(np.clip(gaussians.sh[:, 0, :].astype(np.float64) * Y00 + 0.5, 0.01, 1.0))
    face = mesh.closest(gaussians.means).face
    weight = gaussians.opacities * np.sort(gaussians.scales, axis=1)[:, 1:].prod(axis=1)
    sheet = _sheets(mesh, patch)
    key = np.column_stack([sheet, np.floor((centre - mesh.bounds[0]) / COLOUR_CELL_M).astype(np.int64)])
    unit = np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)
    count = int(unit.max()) + 1
    total = np.bincount(unit[face], weight, minlength=count)
    mean = np.stack(
        [np.bincount(unit[face], weight * colour[:, k], minlength=count) for k in range(3)], axis=1
    )
    size = np.bincount(unit, area, minlength=count) + 1e-9
    known = total > 1e-9
    mean[known] = mean[known] / total[known, None]
    owner = np.full(count, -1)
    owner[unit] = sheet
    for p in np.unique(owner):  # a unit without Gaussians looks like its sheet
        seen = (owner == p) & known
        usual = mean[seen] if seen.any() else mean[known]
        mean[(owner == p) & ~known] = np.average(
            usual, axis=0, weights=size[seen] if seen.any() else size[known]
        )
    luminance = mean.mean(axis=1, keepdims=True)
    feature = np.concatenate([(mean - luminance) / CHROMA_STEP, luminance / LUMINANCE_STEP], axis=1)

    piece = np.zeros(count, np.int64)
    looks: list[np.ndarray] = []
    sizes: list[float] = []
    for p in np.unique(owner):
        own = np.flatnonzero(owner == p)
        split = _clusters(feature[own], size[own]) if p >= 0 else _linkage(feature[own], size[own], 2.0)
        for k in range(split.max() + 1):
            part = own[split == k]
            piece[part] = len(looks)
            looks.append(np.average(feature[part], axis=0, weights=size[part]))
            sizes.append(float(size[part].sum()) if p >= 0 else 0.0)
    look, area_of = np.array(looks), np.array(sizes)
    large = np.flatnonzero(area_of >= LARGE_PIECE_M2)
    group = np.full(len(look), -1)
    group[large] = np.arange(len(large))
    small = np.flatnonzero(group < 0)
    if len(large) and len(small):
        gap = np.linalg.norm(look[small][:, None] - look[large][None], axis=2)
        alike = gap.min(axis=1) < 1.0
        group[small[alike]] = gap.argmin(axis=1)[alike]
    rest = np.flatnonzero(group < 0)
    if len(rest):
        group[rest] = len(large) + _linkage(look[rest], np.maximum(area_of[rest], 1e-3), 4.0)
    real = np.bincount(piece[unit], area, minlength=len(group))
    while len(np.unique(group)) > 1:  # too small to learn from: join what looks most like it
        whole = np.bincount(group, real)
        tiny = np.flatnonzero((whole > 0) & (whole < SMALLEST_GROUP_M2))
        if len(tiny) == 0:
            break
        centre_of: np.ndarray = np.stack([np.bincount(group, real * look[:, k]) for k in range(4)], axis=1)
        centre_of = centre_of / np.maximum(whole, 1e-12)[:, None]
        g = tiny[whole[tiny].argmin()]
        gap = np.where(whole > 0, np.linalg.norm(centre_of - centre_of[g], axis=1), np.inf)
        gap[g] = np.inf
        group[group == g] = gap.argmin()
    group = np.unique(group, return_inverse=True)[1].reshape(-1)
    return piece[unit].astype(np.int32), group.astype(np.int32), look


def _sheets(mesh: Mesh, patch: np.ndarray) -> np.ndarray:
    """Connected pieces of each patch, shape ``(F,)``, its crumbs together; -1 off all patches."""
    piece = connected_pieces(mesh, patch)
    crumb = np.bincount(piece, mesh.areas)[piece] < SMALLEST_SHEET_M2
    key = np.where(crumb, patch + int(piece.max()) + 1, piece)
    sheet = np.full(len(patch), -1)
    own = patch >= 0
    sheet[own] = np.unique(key[own], return_inverse=True)[1].reshape(-1)
    return sheet


def _clusters(feature: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Cluster of each row: halved as long as the halves are clearly apart."""
    label = _two_means(feature, size)
    if label.any():
        one, two = label == 0, label == 1
        first = _clusters(feature[one], size[one])
        label[one] = first
        label[two] = first.max() + 1 + _clusters(feature[two], size[two])
    return label


def _two_means(feature: np.ndarray, size: np.ndarray) -> np.ndarray:
    """0 or 1 for each row: two clusters if they are clearly apart, else one."""
    if len(feature) < 4 or size.sum() < 0.5:
        return np.zeros(len(feature), np.int64)
    mean = np.average(feature, axis=0, weights=size)
    axis = np.linalg.svd((feature - mean) * np.sqrt(size)[:, None], full_matrices=False)[2][0]
    label = ((feature - mean) @ axis > 0).astype(np.int64)
    for _ in range(20):
        if label.min() == label.max():
            return np.zeros(len(feature), np.int64)
        centre = np.stack([np.average(feature[label == k], axis=0, weights=size[label == k]) for k in (0, 1)])
        new = np.linalg.norm(feature[:, None] - centre, axis=2).argmin(axis=1)
        if (new == label).all():
            break
        label = new
    gap = centre[1] - centre[0]
    apart = np.linalg.norm(gap)
    along = (feature - centre[label]) @ (gap / apart)
    inner = np.sqrt(np.average(along**2, weights=size))
    share = size[label == 1].sum() / size.sum()
    return (
        label
        if apart > 1.2 and apart > 4.0 * inner and 0.03 < share < 0.97
        else np.zeros(len(feature), np.int64)
    )


def _linkage(centres: np.ndarray, weights: np.ndarray, step: float) -> np.ndarray:
    """Clusters by repeatedly joining the two nearest weighted means until they are ``step`` apart."""
    label = np.arange(len(centres))
    c, w = centres.copy(), weights.astype(float).copy() + 1e-9
    alive = np.ones(len(c), bool)
    gap = np.linalg.norm(c[:, None] - c[None], axis=2)
    np.fill_diagonal(gap, np.inf)
    while alive.sum() > 1:
        i, j = np.unravel_index(gap.argmin(), gap.shape)
        if gap[i, j] > step:
            break
        c[i] = (w[i] * c[i] + w[j] * c[j]) / (w[i] + w[j])
        w[i] += w[j]
        alive[j] = False
        label[label == j] = i
        gap[j], gap[:, j] = np.inf, np.inf
        gap[i] = np.where(alive, np.linalg.norm(c - c[i], axis=1), np.inf)
        gap[i, i] = np.inf
        gap[:, i] = gap[i]
    return np.unique(label, return_inverse=True)[1].reshape(-1)
