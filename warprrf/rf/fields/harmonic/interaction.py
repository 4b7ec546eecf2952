"""Where a receiver's rays are taken to interact with the geometry, and how long the paths over these points are.

An interaction point stands for the whole ray, as in the paper: the centre of the Gaussian that contributes most
(``"centre"``), the peak of that Gaussian's response on the ray (``"peak"``), the blended mean of all peaks
(``"expected"``), or the mesh hit (``"mesh"``). Lengths are float64 metres: at 300 GHz a wavelength is 1 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.gaussians import Gaussians, rotations_of
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.harmonic.transport import Transport
from warprrf.rf.spectra.spectrum import pixel_directions

INTERACTION_POINTS = ("centre", "peak", "expected", "mesh")


@dataclass(frozen=True)
class Lengths:
    """Single-bounce path geometry per pixel; NaN where the ray meets nothing.

    Attributes:
        point: interaction point [m], shape ``(..., H, W, 3)``.
        total: length transmitter - point - receiver [m], shape ``(..., H, W)``.
        departure: unit direction from the transmitter to the point, shape ``(..., H, W, 3)``.
    """

    point: np.ndarray
    total: np.ndarray
    departure: np.ndarray

    @property
    def delay_s(self) -> np.ndarray:
        """Time of flight [s], shape ``(..., H, W)``."""
        return self.total / SPEED_OF_LIGHT


def interaction_points(
    seen: Transport,
    gaussians: Gaussians,
    kind: str,
    *,
    mesh: Mesh | None = None,
    device: DeviceLike = None,
) -> np.ndarray:
    """Where each pixel's ray is taken to interact [m], shape ``(R, H, W, 3)`` float64; NaN where it meets nothing.

    Args:
        kind: ``"centre"``, ``"peak"``, ``"expected"`` or ``"mesh"`` (see the module); a ray that misses the mesh falls
            back on ``"peak"``.

    Raises:
        ValueError: for an unknown kind, or ``"mesh"`` without a mesh.
    """
    if kind not in INTERACTION_POINTS:
        raise ValueError(f"interaction_point: got {kind!r}, expected one of {', '.join(INTERACTION_POINTS)}")
    if kind == "mesh" and mesh is None:
        raise ValueError('interaction_point: got "mesh", but the geometry has no mesh; use "peak"')
    directions = pixel_directions(seen.shape)
    means = np.asarray(gaussians.means, dtype=np.float64)
    dominant, expected = seen.dominant, seen.expected_range if kind == "expected" else None
    points = np.empty((*dominant.shape, 3))
    for r, origin in enumerate(seen.receivers):  # one at a time: what lies between is ten times the result
        empty = dominant[r] < 0
        if kind == "centre":
            points[r] = means[dominant[r]]
        elif expected is not None:
            points[r] = origin + expected[r].astype(np.float64)[..., None] * directions
        else:
            distance = _peak_range(gaussians, dominant[r], origin, directions)
            if mesh is not None and kind == "mesh":
                t = mesh.cast(origin, directions.reshape(-1, 3), device=device).t.reshape(seen.shape)
                distance = np.where(np.isfinite(t), t, distance)
                empty = empty & ~np.isfinite(t)
            points[r] = origin + distance[..., None] * directions
        points[r][empty] = np.nan
    return points


def path_lengths(points: np.ndarray, transmitter: np.ndarray, receivers: np.ndarray) -> Lengths:
    """Lengths and directions of departure of single bounces at ``points`` (R, H, W, 3) [m], in float64."""
    outward = points - transmitter
    previous = np.linalg.norm(outward, axis=-1)
    view = np.linalg.norm(points - receivers[:, None, None, :], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return Lengths(point=points, total=previous + view, departure=outward / previous[..., None])


def _peak_range(
    gaussians: Gaussians, dominant: np.ndarray, origin: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """Range [m] at which the dominant Gaussian's response peaks on the ray: t* = -(o.g) / (g.g), in float64."""
    scales = np.asarray(gaussians.scales[dominant], dtype=np.float64)
    rotations = rotations_of(gaussians.quaternions[dominant].reshape(-1, 4)).reshape(*dominant.shape, 3, 3)
    means = np.asarray(gaussians.means[dominant], dtype=np.float64)
    g = np.einsum("...ji,...j->...i", rotations, np.broadcast_to(directions, means.shape)) / scales
    o = np.einsum("...ji,...j->...i", rotations, origin - means) / scales
    return -np.einsum("...i,...i->...", o, g) / np.einsum("...i,...i->...", g, g)
