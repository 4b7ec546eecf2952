"""Line of sight and mirror paths on a reconstructed surface: exact lengths by images, blocking softened.

A mesh fused from photos is right to centimetres and torn at its edges, so a single ray is a poor judge of what it lets
through. Each path is tried along several rays that fill its first Fresnel zone, widened by the mesh's position error;
the share that arrives is taken as the share of the field (Kirchhoff's approximation of a partly covered zone), so that
power falls with its square. A mirror point needs a surface of the patch at that place, not a face of exact outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.rf.fields.bistatic.chains import turns
from warprrf.rf.fields.bistatic.mirror_tree import SLACK_M, MirrorTree
from warprrf.rf.fields.bistatic.surface import Surface

_RINGS = ((0.0, 1), (0.5, 6), (0.9, 8))
"""Radii (share of the zone's) and numbers of the rays that fill it: about equal areas each."""
MOST_MIRRORS = 3
"""Most reflections on a path."""
LEAST_SHARE = 0.05  # paths that keep less of their field are dropped: -26 dB


@dataclass(frozen=True)
class SpecularPaths:
    """Line of sight and mirror paths of several receivers, in rows.

    Attributes:
        receiver: index of the receiver, shape ``(L,)``.
        order: reflections, 0 for line of sight, shape ``(L,)``.
        patch: patches met, from the transmitter on, -1 where fewer, shape ``(L, 3)``.
        cosine: cosine of incidence at each, shape ``(L, 3)``.
        turn: angle of its plane of incidence to the one before [rad], shape ``(L, 3)``; see :mod:`chains`.
        point: mirror points [m], shape ``(L, 3, 3)``; NaN where fewer.
        length_m: total length, shape ``(L,)``.
        arrival: unit direction of arrival, shape ``(L, 3)``.
        share: part of the field that is not blocked, shape ``(L,)``, in (0, 1].
    """

    receiver: np.ndarray
    order: np.ndarray
    patch: np.ndarray
    cosine: np.ndarray
    turn: np.ndarray
    point: np.ndarray
    length_m: np.ndarray
    arrival: np.ndarray
    share: np.ndarray

    def __len__(self) -> int:
        return len(self.receiver)

    def subset(self, chosen: np.ndarray) -> SpecularPaths:
        """The rows ``chosen``."""
        return SpecularPaths(**{name: value[chosen] for name, value in vars(self).items()})


def specular_paths(
    surface: Surface,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    wavelength_m: float,
    *,
    order: int = 1,
    tree: MirrorTree | None = None,
    device: Any = None,
) -> SpecularPaths:
    """Paths of ``receivers`` (R, 3) with at most ``order`` (0 to 3) reflections.

    ``tree`` holds chains of at least that order, if they are known already.
    """
    samples = zone_samples()
    parts = [_line_of_sight(surface, transmitter, receivers, wavelength_m, samples, device)]
    if order >= 1 and len(surface.plane_offset):
        parts.append(_mirror_once(surface, transmitter, receivers, wavelength_m, samples, device))
    if order >= 2 and len(surface.plane_offset):
        tree = tree or MirrorTree(surface, transmitter, order)
        parts += [
            _mirror_chains(surface, tree, receivers, k, wavelength_m, samples, device)
            for k in range(2, order + 1)
        ]
    return SpecularPaths(
        **{
            name: np.concatenate([getattr(p, name) for p in parts])
            for name in SpecularPaths.__dataclass_fields__
        }
    )


def zone_samples() -> np.ndarray:
    """Offsets in a unit disc, shape ``(S, 2)``."""
    turns = [
        (radius * np.cos(a), radius * np.sin(a))
        for ring, (radius, count) in enumerate(_RINGS)
        for a in 2 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
    ]
    return np.array(turns)


def _across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across each unit direction ``(N, 3)``."""
    least = np.eye(3)[np.abs(direction).argmin(axis=1)]
    u = np.cross(direction, least)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(direction, u)


def _clear(mesh: Mesh, a: np.ndarray, b: np.ndarray, skin: float, device: Any) -> np.ndarray:
    """Whether nothing lies between a and b (N, 3), but within ``skin`` of either end."""
    way = b - a
    length = np.linalg.norm(way, axis=1)
    toward = way / np.maximum(length, 1e-12)[:, None]
    short = length <= 2 * skin
    hit = mesh.cast(a + skin * toward, toward, device=device)
    return short | (hit.t >= length - 2 * skin)


def _zone_radius(wavelength: float, near: np.ndarray, far: np.ndarray, skin: float) -> np.ndarray:
    """Radius of the first Fresnel zone between two legs, widened by the mesh's error [m]."""
    return np.sqrt(wavelength * near * far / np.maximum(near + far, 1e-9) + skin**2)


def _rows(
    receiver: np.ndarray, order: int, patch: np.ndarray, cosine: np.ndarray, turn: np.ndarray, point: np.ndarray,
    length: np.ndarray, arrival: np.ndarray, share: np.ndarray,
) -> SpecularPaths:  # fmt: skip
    """Rows of paths with ``order`` reflections, what they lack of ``MOST_MIRRORS`` filled up."""
    kept = np.flatnonzero(share >= LEAST_SHARE)
    empty = MOST_MIRRORS - order
    return SpecularPaths(
        receiver, np.full(len(receiver), order), np.pad(patch, ((0, 0), (0, empty)), constant_values=-1),
        np.pad(cosine, ((0, 0), (0, empty))), np.pad(turn, ((0, 0), (0, empty))),
        np.pad(point, ((0, 0), (0, empty), (0, 0)), constant_values=np.nan),
        length, arrival, share,
    ).subset(kept)  # fmt: skip


def _line_of_sight(
    surface: Surface,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    wavelength: float,
    samples: np.ndarray,
    device: Any,
) -> SpecularPaths:
    count = len(receivers)
    way = transmitter - receivers
    length = np.linalg.norm(way, axis=1)
    toward = way / np.maximum(length, 1e-12)[:, None]
    u, v = _across(toward)
    radius = _zone_radius(wavelength, 0.5 * length, 0.5 * length, surface.skin_m)
    offset = radius[:, None, None] * (samples[:, 0, None] * u[:, None] + samples[:, 1, None] * v[:, None])
    middle = (0.5 * (receivers + transmitter))[:, None] + offset
    rx = np.broadcast_to(receivers[:, None], middle.shape).reshape(-1, 3)
    free = _clear(surface.mesh, rx, middle.reshape(-1, 3), surface.skin_m, device)
    left = np.flatnonzero(free)
    tx = np.broadcast_to(transmitter, (len(left), 3))
    free[left] = _clear(surface.mesh, middle.reshape(-1, 3)[left], tx, surface.skin_m, device)
    share = free.reshape(count, -1).mean(axis=1)
    nothing = np.zeros((count, 0))
    return _rows(
        np.arange(count),
        0,
        nothing.astype(int),
        nothing,
        nothing,
        np.zeros((count, 0, 3)),
        length,
        toward,
        share,
    )


def _mirror_once(
    surface: Surface,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    wavelength: float,
    samples: np.ndarray,
    device: Any,
) -> SpecularPaths:
    image, height = surface.images(transmitter)
    below = receivers @ surface.plane_normal.T - surface.plane_offset
    r, p = np.nonzero((below > 0) & (height > 0))
    way = image[p] - receivers[r]
    length = np.linalg.norm(way, axis=1)
    toward = way / length[:, None]
    t = length * below[r, p] / (below[r, p] + height[p])
    point = receivers[r] + t[:, None] * toward
    cosine = np.abs((toward * surface.plane_normal[p]).sum(axis=1))
    radius = _zone_radius(wavelength, t, length - t, surface.skin_m)
    target = point[:, None] + radius[:, None, None] * _cut(toward, surface.plane_normal[p], samples)
    shape = target.shape
    start = np.broadcast_to(receivers[r][:, None], shape).reshape(-1, 3)
    which = np.repeat(p, len(samples))
    probable = np.repeat(_near_patch(surface, point, p), len(samples))  # saves most rays
    met = np.zeros(len(start), bool)
    idx = np.flatnonzero(probable)
    flat = target.reshape(-1, 3)
    met[idx] = _reaches(surface, start[idx], flat[idx], which[idx], device)
    idx = np.flatnonzero(met)
    tx = np.broadcast_to(transmitter, (len(idx), 3))
    met[idx] = _clear(surface.mesh, flat[idx], tx, surface.skin_m, device)
    share = met.reshape(shape[:2]).mean(axis=1)
    only = np.zeros((len(r), 1))
    return _rows(r, 1, p[:, None], cosine[:, None], only, point[:, None], length, toward, share)


def _cut(toward: np.ndarray, normal: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Offsets of ``samples`` of a zone of unit radius about ``toward`` (N, 3), on planes of ``normal`` (N, 3).

    The cut is an ellipse, longer by 1 / cos along the plane of incidence; shape ``(N, S, 3)``.
    """
    cosine = np.abs((toward * normal).sum(axis=1))
    across = np.cross(toward, normal)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(size > 1e-6, across / np.maximum(size, 1e-12), _across(normal)[0])
    along = np.cross(normal, across) / np.maximum(cosine, 0.05)[:, None]
    return samples[:, 0, None] * across[:, None] + samples[:, 1, None] * along[:, None]


def _near_patch(surface: Surface, point: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Whether ``point`` lies in the box of its patch, a little widened."""
    low, high = surface.patch_boxes
    return ((point >= low[patch] - SLACK_M) & (point <= high[patch] + SLACK_M)).all(axis=1)


def _reaches(
    surface: Surface, start: np.ndarray, target: np.ndarray, patch: np.ndarray, device: Any
) -> np.ndarray:
    """Whether the ray from ``start`` first meets a surface at ``target``, on the plane of ``patch``."""
    way = target - start
    length = np.linalg.norm(way, axis=1)
    hit = surface.mesh.cast(start, way / np.maximum(length, 1e-12)[:, None], device=device)
    near = np.abs(hit.t - length) <= 2.0 * surface.skin_m
    face = np.maximum(hit.face, 0)
    same = surface.patch[face] == patch
    # A torn seam of the patch passes for it, another patch does not.
    off = np.abs(
        (np.nan_to_num(hit.point) * surface.plane_normal[patch]).sum(axis=1) - surface.plane_offset[patch]
    )
    return (hit.face >= 0) & (same | (near & (off <= surface.skin_m) & (surface.patch[face] < 0)))


def _mirror_chains(
    surface: Surface,
    tree: MirrorTree,
    receivers: np.ndarray,
    order: int,
    wavelength: float,
    samples: np.ndarray,
    device: Any,
) -> SpecularPaths:
    """Paths of ``order`` reflections whose middle ray is free; the others of their zone say what share is."""
    row, chain, point = tree.candidates(receivers, order, device=device)
    free = unobstructed(surface, tree, receivers[row], chain, point, device)
    row, chain, point = row[free], chain[free], point[free]
    patch = tree.levels[order - 1].patch[chain]
    stops = np.concatenate(
        [np.broadcast_to(tree.transmitter, (len(row), 1, 3)), point, receivers[row][:, None]], axis=1
    )
    legs = np.diff(stops, axis=1)
    lengths = np.linalg.norm(legs, axis=2)
    length = lengths.sum(axis=1)
    along = legs / np.maximum(lengths, 1e-12)[..., None]
    normal = surface.plane_normal[patch]
    cosine = np.abs((along[:, :-1] * normal).sum(axis=2))
    before = np.cumsum(lengths, axis=1)[:, :-1]
    radius = _zone_radius(wavelength, before, length[:, None] - before, surface.skin_m)
    around = np.repeat(point[:, None], len(samples), axis=1)
    for k in range(order):
        around[:, :, k] += radius[:, k, None, None] * _cut(along[:, k], normal[:, k], samples)
    ends, which = (np.repeat(a, len(samples), axis=0) for a in (receivers[row], chain))
    met = unobstructed(surface, tree, ends, which, around.reshape(-1, order, 3), device)
    share = met.reshape(len(row), len(samples)).mean(axis=1)
    return _rows(row, order, patch, cosine, turns(stops, normal), point, length, -along[:, -1], share)


def unobstructed(
    surface: Surface,
    tree: MirrorTree,
    ends: np.ndarray,
    chain: np.ndarray,
    point: np.ndarray,
    device: Any = None,
    lift: np.ndarray | None = None,
) -> np.ndarray:
    """Whether each chain's legs reach their patches and nothing stands between, shape ``(L,)``.

    Args:
        surface: what blocks.
        tree: patches of the chains.
        ends: receivers, shape ``(L, 3)``.
        chain, point: as :meth:`MirrorTree.candidates` gives them.
        lift: added to ``ends`` where rays start, for ends on a surface.
    """
    order = point.shape[1]
    free = np.ones(len(chain), bool)
    here = ends if lift is None else ends + lift
    for k in range(order - 1, -1, -1):
        own = np.flatnonzero(free)
        patch = tree.levels[order - 1].patch[chain[own], k]
        free[own] = _reaches(surface, here[own], point[own, k], patch, device)
        here = point[:, k] + surface.skin_m * surface.plane_normal[tree.levels[order - 1].patch[chain, k]]
    own = np.flatnonzero(free)
    source = np.broadcast_to(tree.transmitter, (len(own), 3))
    free[own] = _clear(surface.mesh, point[own, 0], source, surface.skin_m, device)
    return free
