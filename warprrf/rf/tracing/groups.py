"""Groups of faces that may be of a material of their own: by planar patch and colour, or by shape where there are no colours.

Colours are those of the Gaussians before the faces, or what their mesh's file gives them. A mesh without colours and
names is taken apart into pieces: connected parts of a plane, or of a smooth curved surface. Which pieces are of one material no
shape can tell, but things are mostly made of one: the pieces of a connected part are taken for one material before any
measurement. A part that reaches through the whole room (its shell, or a scan in which all hangs together) is no such
thing: there each piece stands for itself. The spectra then decide which of them are alike, and where they say nothing,
pieces of like extent, height and place are (:mod:`warprrf.rf.fields.bistatic.merging`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from warprrf.geometry.mesh import Mesh, components, connected_pieces, edge_pairs
from warprrf.geometry.splats.gaussians import Y00, Gaussians
from warprrf.rows import distinct_rows, sums_of

SHAPES = 6  # numbers that tell shapes apart

GROUP_M2 = 0.5  # smaller materials, from which nothing is learned, join the one that looks most like them


@dataclass(frozen=True)
class Colours:
    """Colours on a mesh.

    Attributes:
        face: where each is, shape ``(N,)``.
        weight: of each, shape ``(N,)``.
        rgb: as a photo has them, 0 to 1, shape ``(N, 3)``.
    """

    face: np.ndarray
    weight: np.ndarray
    rgb: np.ndarray

    @classmethod
    def of_gaussians(cls, mesh: Mesh, gaussians: Gaussians) -> Colours:
        """Of Gaussians, on the faces that are nearest to them."""
        weight = gaussians.opacities * np.sort(gaussians.scales, axis=1)[:, 1:].prod(axis=1)
        rgb = gaussians.sh[:, 0, :].astype(np.float64) * Y00 + 0.5
        return cls(mesh.closest(gaussians.means).face, weight, rgb)

    @classmethod
    def of_faces(cls, mesh: Mesh) -> Colours | None:
        """Of the mesh's own faces; None where they tell nothing apart."""
        rgb = mesh.face_colours
        told_apart = 0.02  # colours that differ by less are one: what exporters write by default
        known = np.zeros(0, np.int64) if rgb is None else np.flatnonzero(~np.isnan(rgb).any(axis=1))
        if rgb is None or len(known) == 0 or np.ptp(rgb[known], axis=0).max() < told_apart:
            return None
        return cls(known, mesh.areas[known], rgb[known].astype(np.float64))


def colour_groups(
    mesh: Mesh, patch: np.ndarray, colours: Colours
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Groups of faces by patch and photo colour.

    A patch is split into its connected sheets (other things in the same plane), and a sheet where its colour changes:
    such pieces are the groups. Each large one is taken for a material of its own: grey stone and grey paint look alike.
    Small pieces join the large one that looks most like them, if any does, else each other. Chromaticity counts more
    than luminance, which is also shade.

    Args:
        patch: planar patch of each, -1 for none, shape ``(F,)``.
        colours: on its faces.

    Returns:
        The group of each face, shape ``(F,)``; the material that each group is taken for, shape ``(G,)``; and its
        colour in steps, shape ``(G, 4)``.
    """
    cell_m, curved = 0.4, 2.0  # that colours are averaged over; pieces off all patches this near are one
    sheet = _sheets(mesh, patch)
    place = np.floor((mesh.triangles.mean(axis=1) - mesh.bounds[0]) / cell_m).astype(np.int64)
    unit = distinct_rows(np.column_stack([sheet, place]))[1]
    owner = np.full(int(unit.max()) + 1, -1)
    owner[unit] = sheet
    size = np.bincount(unit, mesh.areas) + 1e-9
    feature = _colours(unit[colours.face], owner, size, colours)
    piece = np.zeros(len(owner), np.int64)
    for s in np.unique(owner):
        own = np.flatnonzero(owner == s)
        split = _halved(feature[own], size[own]) if s >= 0 else _joined(feature[own], curved)
        piece[own] = split + (piece.max() + 1 if s > owner.min() else 0)
    area = np.bincount(piece, size)
    colour = sums_of(size[:, None] * feature, piece) / area[:, None]
    flat = np.bincount(piece, size * (owner >= 0))
    material = _alike(colour, flat, area)
    return piece[unit].astype(np.int32), material.astype(np.int32), colour


def _sheets(mesh: Mesh, patch: np.ndarray) -> np.ndarray:
    """Connected pieces of each patch, shape ``(F,)``, its crumbs together; -1 off all patches."""
    piece, crumb_m2 = connected_pieces(mesh, patch), 0.2
    crumb = np.bincount(piece, mesh.areas)[piece] < crumb_m2
    key = np.where(crumb, patch + int(piece.max()) + 1, piece)
    sheet = np.full(len(patch), -1)
    own = patch >= 0
    sheet[own] = np.unique(key[own], return_inverse=True)[1]
    return sheet


def _colours(unit: np.ndarray, owner: np.ndarray, size: np.ndarray, colours: Colours) -> np.ndarray:
    """Colour of each unit in steps, shape ``(U, 4)``: the mean of ``colours``, which stand at ``unit``; of one without
    any that of its sheet, or of all."""
    count = len(owner)
    weight, log = colours.weight, np.log(np.clip(colours.rgb, 0.01, 1.0))
    total = np.bincount(unit, weight, minlength=count)
    known = total > 1e-9
    mean = sums_of(weight[:, None] * log, unit, count)
    mean[known] = mean[known] / total[known, None]
    for s in np.unique(owner[~known]):
        seen = (owner == s) & known
        seen = seen if seen.any() else known
        mean[(owner == s) & ~known] = np.average(mean[seen], axis=0, weights=size[seen])
    luminance = mean.mean(axis=1, keepdims=True)
    chroma_step, luminance_step = 0.05, 0.3  # of logarithms; luminance is also shade
    return np.concatenate([(mean - luminance) / chroma_step, luminance / luminance_step], axis=1)


def _halved(feature: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Cluster of each row: halved by two means as long as the halves are clearly apart."""
    one = np.zeros(len(feature), np.int64)
    if len(feature) < 4 or size.sum() < GROUP_M2:
        return one
    mean = np.average(feature, axis=0, weights=size)
    axis = np.linalg.svd((feature - mean) * np.sqrt(size)[:, None], full_matrices=False)[2][0]
    side = (feature - mean) @ axis > 0
    if side.all() or not side.any():
        return one
    label = side.astype(np.int64)

    def centres() -> np.ndarray:
        return np.stack([np.average(feature[label == k], axis=0, weights=size[label == k]) for k in (0, 1)])

    for _ in range(20):  # Lloyd's steps, with weights, which SciPy's do without
        nearest = cdist(feature, centres()).argmin(axis=1)
        if (nearest == label).all() or nearest.all() or not nearest.any():
            break
        label = nearest
    share = size[label == 1].sum() / size.sum()
    if not 0.03 < share < 0.97:
        return one
    centre = centres()
    gap = np.linalg.norm(centre[1] - centre[0])
    along = (feature - centre[label]) @ (centre[1] - centre[0]) / max(gap, 1e-12)
    apart, apart_std = 1.2, 4.0  # least distance of colours of one sheet, and in deviations within each
    if gap <= max(apart, apart_std * np.sqrt(np.average(along**2, weights=size))):
        return one
    for k in (0, 1):
        own = label == k
        one[own] = _halved(feature[own], size[own]) + (one.max() + 1 if k else 0)
    return one


def _joined(colour: np.ndarray, distance: float) -> np.ndarray:
    """Clusters whose centres are at least ``distance`` apart, shape ``(N,)``, from 0 on."""
    if len(colour) < 2:
        return np.zeros(len(colour), np.int64)
    return np.asarray(fcluster(linkage(colour, "centroid"), distance, "distance"), np.int64) - 1


def _alike(colour: np.ndarray, flat: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Material that each piece is taken for, numbered without gaps, shape ``(G,)``.

    Args:
        colour: of the pieces, shape ``(G, 4)``.
        flat: area on patches, shape ``(G,)`` [m^2].
        area: in all.
    """
    large_m2 = 1.5  # of one colour and one patch: a material of its own
    alike, rest_alike = 1.0, 4.0  # distance at which small pieces join large ones, and others each other
    large = np.flatnonzero(flat >= large_m2)
    material = np.full(len(colour), -1)
    material[large] = np.arange(len(large))
    small = np.flatnonzero(material < 0)
    if len(large) and len(small):
        distance, nearest = cKDTree(colour[large]).query(colour[small])
        material[small] = np.where(distance < alike, nearest, -1)
    rest = np.flatnonzero(material < 0)
    material[rest] = len(large) + _joined(colour[rest], rest_alike)
    while True:  # too small to learn from: join what looks most like it
        material = np.unique(material, return_inverse=True)[1]
        whole = np.bincount(material, area)
        tiny = int(whole.argmin())
        if len(whole) < 2 or whole[tiny] >= GROUP_M2:
            return material
        centre = sums_of(area[:, None] * colour, material) / whole[:, None]
        gap = np.linalg.norm(centre - centre[tiny], axis=1)
        gap[tiny] = np.inf
        material[material == tiny] = gap.argmin()


def shape_groups(mesh: Mesh, patch: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Groups of faces by planar patch and connected part: as :func:`colour_groups`, with the shape of each in steps instead of
    its colour: height and place of its body, and the body's extents upward, along and across, shape ``(G, 6)``."""
    shell = 0.5  # share of the mesh's extents along all axes that the room's shell has at least
    body_m2 = 0.5  # smaller bodies are taken for the material of the larger one that is most like them
    pairs = np.concatenate([edge_pairs(mesh.welded_faces), mesh.neighbours])
    part = components(len(mesh.faces), pairs)
    group = _without_crumbs(mesh, _pieces(mesh, patch, pairs), part)
    _, first = np.unique(group, return_index=True)
    through = _extents(mesh, part) >= shell * _extents(mesh, np.zeros(len(part), np.int64))
    lone = np.asarray(through.all(axis=1))[part[first]]
    body = np.unique(np.where(lone, np.arange(len(first)), len(first) + part[first]), return_inverse=True)[1]
    shape, area = _shape(mesh, body[group]), np.bincount(body[group], mesh.areas)
    large = np.flatnonzero(area >= min(body_m2, float(area.max())))
    material = cKDTree(shape[large]).query(shape)[1]
    material[large] = np.arange(len(large))
    return group.astype(np.int32), material[body].astype(np.int32), shape[body]


def _pieces(mesh: Mesh, patch: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Connected sheets of the patches, those that are facets of a smooth surface together, shape ``(F,)``."""
    # Pieces that are small enough to be facets of a curved one are, where they meet at a small angle.
    small_m2, smooth_rad = 1.5, 0.5
    a, b = pairs.T
    together = (patch[a] == patch[b]) & (patch[a] >= 0)
    sheet = components(len(patch), pairs[together])
    small = np.bincount(sheet, mesh.areas)[sheet] < small_m2
    n = mesh.face_normals
    bend = np.abs(np.einsum("ni,ni->n", n[a], n[b])) > np.cos(smooth_rad)
    return components(len(patch), pairs[together | (bend & small[a] & small[b])])


def _without_crumbs(mesh: Mesh, piece: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Pieces numbered without gaps, crumbs joined to the nearest piece of their part, or to each other, ``(F,)``."""
    crumb_m2 = 0.2  # from smaller ones nothing is learned
    crumb = np.bincount(piece, mesh.areas)[piece] < crumb_m2
    whole = np.zeros(int(part.max()) + 1, bool)
    whole[part[~crumb]] = True
    piece = np.where(crumb & ~whole[part], int(piece.max()) + 1 + part, piece)
    crumb &= whole[part]
    if crumb.any():
        reach = 2.0 * float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
        place = np.column_stack([mesh.triangles.mean(axis=1), reach * part])  # parts far apart
        keep = np.flatnonzero(~crumb)
        piece[crumb] = piece[keep[cKDTree(place[keep]).query(place[crumb])[1]]]
    return np.unique(piece, return_inverse=True)[1]


def _moments(mesh: Mesh, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres ``(N, 3)`` [m] and covariances ``(N, 3, 3)`` [m^2] of the surfaces of each of ``owner`` (F,)."""
    # Midpoints of edges are exact for squares.
    x = 0.5 * (mesh.triangles + np.roll(mesh.triangles, 1, axis=1))
    weight = np.repeat(mesh.areas + 1e-12, 3) / 3.0
    who, x = np.repeat(owner, 3), x.reshape(-1, 3)
    total = np.bincount(who, weight)
    centre = sums_of(weight[:, None] * x, who) / total[:, None]
    x = x - centre[who]
    second = [np.bincount(who, weight * x[:, i] * x[:, j]) / total for i in range(3) for j in range(3)]
    return centre, np.stack(second, axis=1).reshape(-1, 3, 3)


def _extents(mesh: Mesh, owner: np.ndarray) -> np.ndarray:
    """Extents upward, and horizontally along and across, of the surfaces of each of ``owner`` [m], shape ``(N, 3)``."""
    second = _moments(mesh, owner)[1]
    level = np.linalg.eigvalsh(second[:, :2, :2])[:, ::-1]
    return np.sqrt(12.0 * np.maximum(np.column_stack([second[:, 2, 2], level]), 0.0))


def _shape(mesh: Mesh, owner: np.ndarray) -> np.ndarray:
    """Shape of each of ``owner`` (F,) in steps, ``(N, 6)``; see :func:`shape_groups`."""
    # Distances of 1 m and ratios of extents of 10 count as much as a material's difference.
    place_m, ratio, thin_m = 1.0, 10.0, 0.03
    extents = np.log(np.maximum(_extents(mesh, owner), thin_m)) / np.log(ratio)
    return np.column_stack([(_moments(mesh, owner)[0] - mesh.center) / place_m, extents])
