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
from warprrf.rf.surface import Surface

_RINGS = ((0.0, 1), (0.5, 6), (0.9, 8))
"""Radii (share of the zone's) and numbers of the rays that fill it: about equal areas each."""
LEAST_SHARE = 0.05  # paths that keep less of their field are dropped: -26 dB


@dataclass(frozen=True)
class SpecularPaths:
    """Line of sight and mirror paths of several receivers, in rows.

    Attributes:
        receiver: index of the receiver, shape ``(L,)``.
        order: reflections, 0 for line of sight, shape ``(L,)``.
        patch: patches met, from the transmitter on, -1 where fewer, shape ``(L, 2)``.
        cosine: cosine of incidence at each, shape ``(L, 2)``.
        point: mirror points [m], shape ``(L, 2, 3)``; NaN where fewer.
        length_m: total length, shape ``(L,)``.
        arrival: unit direction of arrival, shape ``(L, 3)``.
        share: part of the field that is not blocked, shape ``(L,)``, in (0, 1].
    """

    receiver: np.ndarray
    order: np.ndarray
    patch: np.ndarray
    cosine: np.ndarray
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
    single_ray: bool = False,
    device: Any = None,
) -> SpecularPaths:
    """Paths of ``receivers`` (R, 3) with at most ``order`` (0, 1 or 2) reflections; ``single_ray``: one ray each."""
    samples = np.zeros((1, 2)) if single_ray else zone_samples()
    parts = [_line_of_sight(surface, transmitter, receivers, wavelength_m, samples, device)]
    if order >= 1 and len(surface.plane_offset):
        parts.append(_mirror_once(surface, transmitter, receivers, wavelength_m, samples, device))
    if order >= 2 and len(surface.plane_offset):
        parts.append(_mirror_twice(surface, transmitter, receivers, device))
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
    receiver: np.ndarray, order: int, patch: np.ndarray, cosine: np.ndarray, point: np.ndarray, length: np.ndarray,
    arrival: np.ndarray, share: np.ndarray,
) -> SpecularPaths:  # fmt: skip
    kept = np.flatnonzero(share >= LEAST_SHARE)
    return SpecularPaths(
        receiver, np.full(len(receiver), order), patch, cosine, point, length, arrival, share
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
    nothing = np.full((count, 2), -1)
    return _rows(
        np.arange(count),
        0,
        nothing,
        np.zeros((count, 2)),
        np.full((count, 2, 3), np.nan),
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
    # The zone's cut by the plane is an ellipse, longer by 1 / cos along the plane of incidence.
    radius = _zone_radius(wavelength, t, length - t, surface.skin_m)
    normal = surface.plane_normal[p]
    across = np.cross(toward, normal)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(size > 1e-6, across / np.maximum(size, 1e-12), _across(normal)[0])
    along = np.cross(normal, across) / np.maximum(cosine, 0.05)[:, None]
    target = point[:, None] + radius[:, None, None] * (
        samples[:, 0, None] * across[:, None] + samples[:, 1, None] * along[:, None]
    )
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
    patch = np.column_stack([p, np.full(len(p), -1)])
    points = np.stack([point, np.full_like(point, np.nan)], axis=1)
    return _rows(r, 1, patch, np.column_stack([cosine, np.zeros(len(p))]), points, length, toward, share)


def _near_patch(surface: Surface, point: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Whether ``point`` lies in the box of its patch, a little widened."""
    low = np.full((len(surface.plane_offset), 3), np.inf)
    high = np.full((len(surface.plane_offset), 3), -np.inf)
    own = surface.patch >= 0
    corner = surface.mesh.triangles[own]
    np.minimum.at(low, surface.patch[own], corner.min(axis=1))
    np.maximum.at(high, surface.patch[own], corner.max(axis=1))
    slack = 0.1
    return ((point >= low[patch] - slack) & (point <= high[patch] + slack)).all(axis=1)


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


def _mirror_twice(
    surface: Surface, transmitter: np.ndarray, receivers: np.ndarray, device: Any
) -> SpecularPaths:
    first_image, height = surface.images(transmitter)
    n, o = surface.plane_normal, surface.plane_offset
    # image of image a in plane b; the first mirror must lie before the second, and be lit
    behind = first_image @ n.T - o  # (a, b): height of image a over plane b
    a, b = np.nonzero((height[:, None] > 0) & (behind > 0))
    keep = a != b
    a, b = a[keep], b[keep]
    image = first_image[a] - 2.0 * behind[a, b][:, None] * n[b]
    parts = []
    for r, receiver in enumerate(receivers):
        below = (n[b] * receiver).sum(axis=1) - o[b]
        k = np.flatnonzero(below > 0)
        way = image[k] - receiver
        length = np.linalg.norm(way, axis=1)
        toward = way / length[:, None]
        t = length * below[k] / (below[k] + behind[a[k], b[k]])
        last = receiver + t[:, None] * toward
        ok = _near_patch(surface, last, b[k])
        k, length, toward, last = k[ok], length[ok], toward[ok], last[ok]
        back = first_image[a[k]] - last
        side = (n[a[k]] * last).sum(axis=1) - o[a[k]]
        share = side / (side + height[a[k]])
        start = last + share[:, None] * back
        ok = (side > 0) & _near_patch(surface, start, a[k])
        k, length, toward, last, start = k[ok], length[ok], toward[ok], last[ok], start[ok]
        if len(k) == 0:
            continue
        here = np.broadcast_to(receiver, last.shape)
        ok = _reaches(surface, here, last, b[k], device)
        idx = np.flatnonzero(ok)
        lift = surface.skin_m * n[b[k[idx]]]
        ok[idx] = _reaches(surface, last[idx] + lift, start[idx], a[k[idx]], device)
        idx = np.flatnonzero(ok)
        ok[idx] = _clear(
            surface.mesh, start[idx], np.broadcast_to(transmitter, (len(idx), 3)), surface.skin_m, device
        )
        k, length, toward, last, start = k[ok], length[ok], toward[ok], last[ok], start[ok]
        if len(k) == 0:
            continue
        leg = last - start
        leg /= np.linalg.norm(leg, axis=1, keepdims=True)
        cosine = np.column_stack(
            [np.abs((leg * n[a[k]]).sum(axis=1)), np.abs((toward * n[b[k]]).sum(axis=1))]
        )
        parts.append(
            _rows(
                np.full(len(k), r), 2, np.column_stack([a[k], b[k]]), cosine, np.stack([start, last], axis=1), length,
                toward, np.ones(len(k)),
            )
        )  # fmt: skip
    if not parts:
        return _rows(
            np.zeros(0, int), 2, np.zeros((0, 2), int), np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros(0),
            np.zeros((0, 3)), np.zeros(0),
        )  # fmt: skip
    return SpecularPaths(
        **{
            name: np.concatenate([getattr(q, name) for q in parts])
            for name in SpecularPaths.__dataclass_fields__
        }
    )
