"""Groups of a reconstruction's faces by planar patch and by the colour that photos gave them."""

from __future__ import annotations

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_topology import connected_pieces
from warprrf.geometry.splats.gaussians import Gaussians

LARGE_PIECE_M2 = 1.5  # a piece of a patch this large is a group of its own
SMALLEST_GROUP_M2 = 0.5
SMALLEST_SHEET_M2 = 0.2
COLOUR_CELL_M = 0.4  # colours are averaged over cells of this size
CHROMA_STEP = 0.05  # log chromaticities that differ by less look alike
LUMINANCE_STEP = 0.3  # and log luminances
Y00 = 0.28209479177387814  # harmonic of degree 0


def colour_groups(
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
