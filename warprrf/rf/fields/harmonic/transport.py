"""What a receiver sees of the frozen geometry: blending weights, and the points that its rays are taken to meet.

Geometry does not change while the radio part is learned, so the weights of a view are computed once, as a sparse
pixels-by-Gaussians matrix, and every fit and every model reuses them. Radio needs other cutoffs than photos: an image
60 dB deep shows what an opacity clamp of 0.99 leaks through a wall (-20 dB), so :func:`cutoffs` derives them from the
data set's range.

An interaction point stands for the whole ray, as in the paper: the centre of the Gaussian that contributes most
(``"centre"``), the peak of that Gaussian's response on the ray (``"peak"``), the blended mean of all peaks
(``"expected"``), or the mesh hit (``"mesh"``). Lengths are float64 metres: at 300 GHz a wavelength is 1 mm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from warprrf.cache import cached_property
from warprrf.checks import check_array
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians, rotations_of
from warprrf.geometry.splats.rasterizer import Blending
from warprrf.geometry.splats.render import BlendWeights, blend_weights_of_each
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.spectra.spectrum import check_shape, pixel_directions

TRANSMITTANCE = ("product", "exp")
TOP_K = 16  # Gaussians kept per pixel


@dataclass(frozen=True)
class Transport:
    """Blending weights of the frozen geometry for some receivers, as sparse rows: one row a pixel.

    Attributes:
        shape: rows and columns of a spectrum.
        receivers: positions [m], shape ``(R, 3)``.
        start: where each pixel's pairs begin, shape ``(R * H * W + 1,)`` int64.
        gaussian: Gaussian of each pair, front to back within a pixel, shape ``(E,)`` int32.
        weight: blending weight alpha T of each pair, shape ``(E,)`` float32; what top-K left out is shared among the
            pairs that stayed, so that a pixel's sum is that of all its Gaussians.
        dominant: Gaussian with the largest weight, shape ``(R, H, W)`` int32, -1 where there is none.
        expected_range: blended mean of the peak ranges [m], shape ``(R, H, W)`` float32, NaN where there is none.
        rule: transmittance rule, ``"product"`` or ``"exp"``.
    """

    shape: tuple[int, int]
    receivers: np.ndarray
    start: np.ndarray
    gaussian: np.ndarray
    weight: np.ndarray
    dominant: np.ndarray
    expected_range: np.ndarray
    rule: str

    def subset(self, indices: Sequence[int] | np.ndarray) -> Transport:
        """The receivers at ``indices``, in that order."""
        chosen = np.asarray(indices, dtype=np.int64)
        pixels = self.shape[0] * self.shape[1]
        pieces = [slice(self.start[r * pixels], self.start[(r + 1) * pixels]) for r in chosen]
        counts = np.diff(self.start).reshape(len(self.receivers), pixels)[chosen].ravel()
        return replace(
            self,
            receivers=self.receivers[chosen],
            start=np.concatenate([[0], np.cumsum(counts)]),
            gaussian=np.concatenate([self.gaussian[p] for p in pieces]),
            weight=np.concatenate([self.weight[p] for p in pieces]),
            dominant=self.dominant[chosen],
            expected_range=self.expected_range[chosen],
        )

    @cached_property
    def seen(self) -> np.ndarray:
        """Gaussians that any receiver sees, ascending."""
        return np.unique(self.gaussian)

    @property
    def pixel(self) -> np.ndarray:
        """Pixel of each pair, counted through all receivers, shape ``(E,)`` int32."""
        return np.repeat(np.arange(len(self.start) - 1, dtype=np.int32), np.diff(self.start))

    @property
    def pixel_weight(self) -> np.ndarray:
        """Sum of the weights per pixel, shape ``(R, H, W)`` float64; with the ``exp`` rule it can exceed one."""
        summed = np.add.reduceat(np.append(self.weight, np.float32(0)), self.start[:-1], dtype=np.float64)
        return np.where(np.diff(self.start) > 0, summed, 0.0).reshape(len(self.receivers), *self.shape)


def cutoffs(range_db: tuple[float, float], rule: str = "product") -> Blending:
    """How to blend for images that span ``range_db`` (lowest, highest) [dB].

    A wall may leak no more than the floor of the range, and blending stops when no more than that is left. An alpha
    below 1e-3 is left out: it changes what lies behind it by less than 0.005 dB.
    """
    depth = 10 ** (-(float(range_db[1]) - float(range_db[0])) / 10)
    leak = min(max(depth, 1e-6), 1e-2)
    return Blending(alpha_min=1e-3, alpha_max=1.0 - leak, transmittance_min=leak, rule=rule)


def transport(
    gaussians: Gaussians,
    receivers: ArrayLike,
    shape: tuple[int, int],
    *,
    range_db: tuple[float, float] = (-60.0, 0.0),
    rule: str = "product",
    top_k: int = TOP_K,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> Transport:
    """Blending weights of ``gaussians`` for every pixel of every receiver.

    Args:
        gaussians: the frozen geometry.
        receivers: positions [m], shape ``(R, 3)``.
        shape: rows and columns of a spectrum.
        range_db: lowest and highest value of the data set's dB images: sets :func:`cutoffs`.
        rule: transmittance: ``"product"`` of (1 - alpha), or the paper's ``"exp"`` of minus the sum of alphas.
        top_k: Gaussians kept per pixel.
        device: where blending runs.
        progress: called once a receiver with the stage ``"transport"``.

    Raises:
        ValueError: for positions that are not finite, or an unknown rule.
    """
    positions = check_array("receivers", receivers, (None, 3))
    if len(positions) == 0:
        raise ValueError("receivers: got none, expected at least one position")
    rows, columns = check_shape(shape)
    blending = cutoffs(range_db, rule)
    seen = views(gaussians, positions, (rows, columns), top_k, blending, device=device, progress=progress)
    counts, gaussian, weight, dominant, expected = zip(*map(_kept, seen), strict=True)
    return Transport(
        shape=(rows, columns),
        receivers=positions,
        start=np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64),
        gaussian=np.concatenate(gaussian),
        weight=np.concatenate(weight),
        dominant=np.stack(dominant),
        expected_range=np.stack(expected),
        rule=rule,
    )


def views(
    gaussians: Gaussians,
    receivers: np.ndarray,
    shape: tuple[int, int],
    top_k: int,
    blending: Blending,
    *,
    device: DeviceLike,
    progress: Progress | None,
) -> Iterator[BlendWeights]:
    """What each of ``receivers`` (R, 3) sees on a grid of ``shape``."""
    cameras = (Camera.spherical(shape[1], shape[0], position=position) for position in receivers)
    seen = blend_weights_of_each(gaussians, cameras, top_k=top_k, blending=blending, device=device)
    for k, weights in enumerate(seen):
        yield weights
        if progress is not None:
            progress("transport", k + 1, len(receivers))


def _kept(seen: BlendWeights) -> tuple[np.ndarray, ...]:
    """Pairs a pixel (H * W,), Gaussians and weights (E,), dominant Gaussian and mean range (H, W) of one receiver."""
    weight, index = np.asarray(seen.weight, dtype=np.float64), np.asarray(seen.index)
    listed = (index >= 0) & (weight > 0)
    total = np.sum(weight, axis=-1, where=listed, initial=0.0)
    min_weight = 1e-4  # smaller shares of a pixel's weight are given to the others: 0.0004 dB
    keep = listed & (weight > min_weight * total[..., None])
    kept = np.sum(weight, axis=-1, where=keep, initial=0.0)
    scale = np.divide(total + np.asarray(seen.dropped, float), kept, out=np.zeros_like(kept), where=kept > 0)
    expected = np.sum(weight * np.asarray(seen.range), axis=-1, where=keep, initial=0.0)
    expected = np.divide(expected, kept, out=np.full_like(kept, np.nan), where=kept > 0)
    return (
        np.count_nonzero(keep, axis=-1).ravel(),
        index[keep].astype(np.int32),
        (weight * scale[..., None])[keep].astype(np.float32),
        np.where(kept > 0, np.asarray(seen.dominant), -1).astype(np.int32),
        expected.astype(np.float32),
    )


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
        ValueError: for ``"mesh"`` without a mesh.
    """
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
