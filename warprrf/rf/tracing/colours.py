"""Groups of faces by planar patch and colour: of the Gaussians before them, or that their mesh's file gives them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from warprrf.geometry.mesh import Mesh, connected_pieces
from warprrf.geometry.splats.gaussians import Y00, Gaussians

GROUP_M2 = 0.5  # smaller groups, from which nothing is learned, join the one that looks most like them


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
        mesh: F faces.
        patch: planar patch of each, -1 for none, shape ``(F,)``.
        colours: on its faces.

    Returns:
        The group of each face, shape ``(F,)``; the material that each group is taken for, shape ``(G,)``; and its
        colour in steps, shape ``(G, 4)``.
    """
    cell_m, curved = 0.4, 2.0  # that colours are averaged over; pieces off all patches this near are one
    sheet = _sheets(mesh, patch)
    place = np.floor((mesh.triangles.mean(axis=1) - mesh.bounds[0]) / cell_m).astype(np.int64)
    unit = np.unique(np.column_stack([sheet, place]), axis=0, return_inverse=True)[1].reshape(-1)
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
    colour = np.stack([np.bincount(piece, size * channel) for channel in feature.T], axis=1) / area[:, None]
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
    sheet[own] = np.unique(key[own], return_inverse=True)[1].reshape(-1)
    return sheet


def _colours(unit: np.ndarray, owner: np.ndarray, size: np.ndarray, colours: Colours) -> np.ndarray:
    """Colour of each unit in steps, shape ``(U, 4)``: the mean of ``colours``, which stand at ``unit``; of one without
    any that of its sheet, or of all."""
    count = len(owner)
    weight, log = colours.weight, np.log(np.clip(colours.rgb, 0.01, 1.0))
    total = np.bincount(unit, weight, minlength=count)
    known = total > 1e-9
    mean = np.stack([np.bincount(unit, weight * channel, minlength=count) for channel in log.T], axis=1)
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
    for _ in range(20):  # Lloyd's steps, with weights, which SciPy's do without
        centre = np.stack([np.average(feature[label == k], axis=0, weights=size[label == k]) for k in (0, 1)])
        nearest = cdist(feature, centre).argmin(axis=1)
        if (nearest == label).all() or nearest.all() or not nearest.any():
            break
        label = nearest
    share = size[label == 1].sum() / size.sum()
    if not 0.03 < share < 0.97:
        return one
    centre = np.stack([np.average(feature[label == k], axis=0, weights=size[label == k]) for k in (0, 1)])
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
    large_m2 = 1.5  # of one colour and one patch: a group of its own
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
        material = np.unique(material, return_inverse=True)[1].reshape(-1)
        whole = np.bincount(material, area)
        tiny = int(whole.argmin())
        if len(whole) < 2 or whole[tiny] >= GROUP_M2:
            return material
        centre = (
            np.stack([np.bincount(material, area * channel) for channel in colour.T], axis=1) / whole[:, None]
        )
        gap = np.linalg.norm(centre - centre[tiny], axis=1)
        gap[tiny] = np.inf
        material[material == tiny] = gap.argmin()
