"""What reaches a receiver behind an obstacle, estimated: round its edges by diffraction, through it by transmission.

Neither is part of a radio field; fits and :func:`warprrf.relevance` tell with these estimates where that matters. They err on
the strong side: an edge is a knife edge seen alone, and of an obstacle only the wall that a ray enters by weakens it.
What goes over two edges is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from warprrf.device import DeviceLike
from warprrf.geometry.edges import mesh_edges
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.fresnel import slab_transmission
from warprrf.rf.spectra.spectrum import pixel_of

LEAST_BEND_RAD = np.radians(20.0)  # faces that are bent less, by a scanner's errors say, make no edge
MOST_EDGES = 400  # of a receiver, those of least detour: the others are weaker
MOST_CROSSINGS = 32  # faces on a ray; one that meets more brings nothing
LIFT_M = 1e-3  # edges are looked at from this far off
APART = (90, 180)  # edges that a receiver sees in one cell of such a grid count once, the strongest


LOSS_TANGENT = 0.06
"""Of walls of unknown loss: as of plasterboard and wood at 300 GHz in ITU-R P.2040-4, table 3."""
ASSUMED_PERMITTIVITY = 4.0
"""Of walls whose material is not known, real part."""
ASSUMED_THICKNESS_M = 0.0125  # a plasterboard: thin walls let more through


@dataclass(frozen=True)
class Walls:
    """What transmission goes through: mesh, and complex permittivity and thickness [m] of each face ``(F,)``; and whether
    these are assumed."""

    mesh: Mesh
    permittivity: np.ndarray
    thickness_m: np.ndarray
    assumed: bool = False

    @classmethod
    def of(
        cls, mesh: Mesh, permittivity: ArrayLike = ASSUMED_PERMITTIVITY, thickness_m: ArrayLike = np.nan
    ) -> Walls:
        """Those of which the real part of each face's permittivity is known, or nothing, and the thickness if not NaN."""
        real, thickness = (np.broadcast_to(a, len(mesh.faces)) for a in (permittivity, thickness_m))
        known = np.where(np.isnan(thickness), ASSUMED_THICKNESS_M, thickness)
        return cls(mesh, real * (1.0 - 1j * LOSS_TANGENT), known, True)


@dataclass(frozen=True)
class SidePaths:
    """Estimated paths past obstacles, in rows.

    Attributes:
        receiver: index of the receiver, shape ``(L,)``.
        power: path gain [linear], shape ``(L,)``.
        arrival: unit direction of arrival, shape ``(L, 3)``.
        length_m: length, shape ``(L,)``.
    """

    receiver: np.ndarray
    power: np.ndarray
    arrival: np.ndarray
    length_m: np.ndarray


def knife_edge_loss_db(v: ArrayLike) -> np.ndarray:
    """Loss J(v) of a knife edge over free space [dB]; v is positive in the shadow. Source: ITU-R P.526-15, eq. (31),
    which holds for v > -0.78; nothing is lost below."""
    v = np.asarray(v, dtype=np.float64)
    x = np.maximum(v, -0.78) - 0.1
    return np.where(v > -0.78, 6.9 + 20.0 * np.log10(np.sqrt(x**2 + 1.0) + x), 0.0)


def past_obstacles(
    walls: Walls,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    wavelength_m: float,
    *,
    position_error_m: float,
    device: DeviceLike = None,
) -> dict[str, SidePaths]:
    """``"diffraction"`` and ``"transmission"`` to ``receivers`` (R, 3), all without line of sight."""
    mesh, link = walls.mesh, (transmitter, receivers, wavelength_m)
    edges = diffracted(mesh, *link, lift_m=max(LIFT_M, position_error_m), device=device)
    through = transmitted(
        mesh, *link, walls.permittivity, walls.thickness_m, position_error_m=position_error_m, device=device
    )
    return {"diffraction": edges, "transmission": through}


def diffracted(
    mesh: Mesh,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    wavelength_m: float,
    *,
    lift_m: float = LIFT_M,
    device: DeviceLike = None,
) -> SidePaths:
    """Paths of ``receivers`` (R, 3), all without line of sight, over one edge of the mesh each.

    What goes over two edges, as round a thick pillar, loses at least both edges' losses and is left out. The point on
    an edge is the one of least detour (it lies between the edge's ends, or there is no path), and must see
    transmitter and receiver. Its loss is that of a knife edge, v = 2 sqrt(detour / wavelength), which for small angles
    is ITU-R P.526-15, eq. (26).
    """
    edges = mesh_edges(mesh, least_bend_rad=LEAST_BEND_RAD)
    start, along, length, outward = edges.start, edges.along, edges.length, edges.outward
    parts: list[tuple[np.ndarray, ...]] = []
    source_at, source_off = _on_line(transmitter, start, along)
    for r, receiver in enumerate(receivers):
        direct = float(np.linalg.norm(receiver - transmitter))
        at, off = _on_line(receiver, start, along)
        with np.errstate(invalid="ignore", divide="ignore"):
            s = (source_at * off + at * source_off) / (
                off + source_off
            )  # equal angles with the edge (Keller)
        total = np.hypot(off + source_off, at - source_at)
        k = np.flatnonzero((s > 0) & (s < length))
        k = k[np.argsort(total[k], kind="stable")[:MOST_EDGES]]
        point = start[k] + s[k, None] * along[k]
        lifted = point + lift_m * outward[k]
        free = mesh.visible(transmitter[None], lifted, device=device) if len(k) else np.zeros(0, bool)
        free[free] = mesh.visible(lifted[free], receiver[None], device=device) if free.any() else False
        k, point = k[free], point[free]
        v = 2.0 * np.sqrt(np.maximum(total[k] - direct, 0.0) / wavelength_m)
        power = (wavelength_m / (4.0 * np.pi * direct)) ** 2 * 10.0 ** (-knife_edge_loss_db(v) / 10.0)
        arrival = (point - receiver) / np.maximum(np.linalg.norm(point - receiver, axis=1), 1e-12)[:, None]
        strongest = np.argsort(-power, kind="stable")
        row, column = pixel_of(arrival[strongest], APART)
        keep = strongest[np.unique(row * APART[1] + column, return_index=True)[1]]
        parts.append((np.full(len(keep), r), power[keep], arrival[keep], total[k][keep]))
    return _gather(parts)


def transmitted(
    mesh: Mesh,
    transmitter: np.ndarray,
    receivers: np.ndarray,
    wavelength_m: float,
    permittivity: np.ndarray,
    thickness_m: np.ndarray,
    *,
    position_error_m: float = 1e-4,
    device: DeviceLike = None,
) -> SidePaths:
    """The straight path of each of ``receivers`` (R, 3) through all that stands in its way.

    Each face met is a slab (ITU-R P.2040-4) of its ``permittivity`` (F,), complex, and ``thickness_m`` (F,); on a
    closed mesh the faces by which a ray leaves an obstacle are not counted.
    """
    way = transmitter - receivers
    distance = np.linalg.norm(way, axis=1)
    toward = way / np.maximum(distance, 1e-12)[:, None]
    gone, share = np.zeros(len(receivers)), np.ones(len(receivers))
    open_rays = np.arange(len(receivers))
    for _ in range(MOST_CROSSINGS):
        hit = mesh.cast(
            receivers[open_rays] + gone[open_rays, None] * toward[open_rays], toward[open_rays], device=device
        )
        met = gone[open_rays] + hit.t < distance[open_rays] - position_error_m
        open_rays, face, t, normal = open_rays[met], hit.face[met], hit.t[met], hit.normal[met]
        if len(open_rays) == 0:
            break
        cosine = (toward[open_rays] * normal).sum(axis=1)
        fields = slab_transmission(np.abs(cosine), permittivity[face], thickness_m[face], wavelength_m)
        passed = 0.5 * (np.abs(fields[0]) ** 2 + np.abs(fields[1]) ** 2)
        share[open_rays] *= np.where((cosine < 0) | (not mesh.is_closed), passed, 1.0)
        gone[open_rays] += t + position_error_m
    share[open_rays] = 0.0
    power = (wavelength_m / (4.0 * np.pi * distance)) ** 2 * share
    return SidePaths(np.arange(len(receivers)), power, toward, distance)


def _on_line(point: np.ndarray, start: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where on each line the foot of ``point`` lies, and its distance from the line [m]."""
    way = point - start
    at = (way * along).sum(axis=1)
    return at, np.linalg.norm(way - at[:, None] * along, axis=1)


def _gather(parts: list[tuple[np.ndarray, ...]]) -> SidePaths:
    if not parts:
        return SidePaths(np.zeros(0, int), np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    return SidePaths(*(np.concatenate(column) for column in zip(*parts, strict=True)))
