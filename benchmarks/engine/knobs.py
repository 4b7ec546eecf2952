"""Speed against error of the rasteriser's knobs, and how cost grows; every row is a dict of one setting.

The scene is a room of Gaussians (:mod:`benchmarks.engine.scenes`) whose gain varies over 60 dB, seen as a spectrum.
Unless a knob says otherwise the error of an image is the rms over pixels of its difference in dB, on a floor 60 dB below
the brightest pixel, from a float64 rendering whose cutoffs are out of the way (:data:`TIGHT`), and time is the shortest
of the repeats by the clock, settings in turn. Where the question is the geometry, not the image, discs on the room's
mesh are compared with rays cast at the mesh.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

import warprrf as wr
from benchmarks.engine.scenes import best_seconds, gain, gaussians, positions, room_mesh
from benchmarks.report import Row
from warprrf.device import resolve
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.geometry.splats.rasterizer import RADIO, Blending, Rasterizer
from warprrf.geometry.splats.render import blend_weights
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.fields.harmonic.transport import (
    INTERACTION_POINTS,
    interaction_points,
    path_lengths,
    transport,
)
from warprrf.rf.spectra.spectrum import pixel_directions, to_db

DEPTH_DB = 60.0
"""The floor lies this far below the brightest pixel."""

TIGHT = Blending(alpha_min=1e-8, alpha_max=1 - 1e-9, transmittance_min=1e-9)
"""Cutoffs that change nothing at 60 dB."""

ALPHA_MIN = (1e-1, 3e-2, 1e-2, 1 / 255, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6)
TRANSMITTER = (2.0, 3.0, 3.2)


class Scene:
    """A room of Gaussians with their gains, seen from one receiver.

    Args:
        count: Gaussians.
        shape: rows and columns of the spectrum.
    """

    def __init__(self, count: int, shape: tuple[int, int], *, seed: int = 0, device: Any = None) -> None:
        self.gaussians, self.shape, self.device = gaussians(count, seed), shape, resolve(device)
        self.position = positions(1, seed)[0]
        self.gains = gain(self.gaussians.means)

    def camera(self, shape: tuple[int, int] | None = None) -> Camera:
        """The receiver's panorama."""
        rows, columns = shape or self.shape
        return Camera.spherical(columns, rows, position=self.position)

    def renderer(
        self, blending: Blending, real: Any = wp.float32, shape: tuple[int, int] | None = None
    ) -> Callable[[], np.ndarray]:
        """A function that renders the image (H, W) from Gaussians that are on the device."""
        raster = Rasterizer(device=self.device, blending=blending, real=real)
        arrays = raster.upload(self.gaussians)
        features = wp.array(self.gains[:, None], dtype=real, device=self.device)
        camera = self.camera(shape)

        def run() -> np.ndarray:
            image: np.ndarray = raster.rasterize(*arrays, features, camera).features.numpy()[..., 0]
            return image

        return run

    def reference(self, blending: Blending = TIGHT) -> np.ndarray:
        """The image in float64."""
        return self.renderer(blending, wp.float64)()


def error_of(image: np.ndarray, reference: np.ndarray) -> Row:
    """``error_rms_db``, ``error_worst_db`` (largest) and ``error_total_db`` (of the sum over pixels)."""
    floor = float(reference.max()) * 10 ** (-DEPTH_DB / 10)
    difference = to_db(image, floor) - to_db(reference, floor)
    total = np.sum(image, dtype=np.float64) / np.sum(reference, dtype=np.float64)
    return {
        "error_rms_db": float(np.sqrt(np.mean(difference**2))),
        "error_worst_db": float(np.abs(difference).max()),
        "error_total_db": float(abs(10 * np.log10(total))),
    }


def cutoff_rows(scene: Scene, values: Sequence[float] = ALPHA_MIN, *, repeats: int = 5) -> list[Row]:
    """One row a value of ``alpha_min``, the other cutoffs as for radio: error and seconds."""
    runners = {f"{value!r}": scene.renderer(replace(RADIO, alpha_min=value)) for value in values}
    seconds, reference = best_seconds(runners, repeats), scene.reference()
    return [
        {"value": value, "seconds": seconds[f"{value!r}"], **error_of(runners[f"{value!r}"](), reference)}
        for value in values
    ]


def top_k_rows(scene: Scene, values: Sequence[int], *, repeats: int = 3) -> list[Row]:
    """One row a ``K``: seconds to list a receiver's weights, and the error of the image made of them.

    The reference is the image of all weights at the same cutoffs, so that the error is that of K alone.
    """

    def listing(k: int) -> Callable[[], Any]:
        return lambda: blend_weights(scene.gaussians, scene.camera(), top_k=k, device=scene.device)

    def image(k: int) -> np.ndarray:
        found = listing(k)()
        return np.asarray(
            (found.weight * np.where(found.index >= 0, scene.gains[found.index], 0.0)).sum(axis=-1)
        )

    seconds = best_seconds({f"{k}": listing(k) for k in values}, repeats)
    reference = image(max(4 * max(values), 256))
    return [{"value": k, "seconds": seconds[f"{k}"], **error_of(image(k), reference)} for k in values]


def precision_rows(scene: Scene, *, pixels: int = 2000, repeats: int = 5, seed: int = 0) -> list[Row]:
    """float32 and float64 with the cutoffs of radio, against rays traced through the Gaussians one by one in float64.

    The reference shares no code with the rasteriser's projection, binning and blending; ``pixels`` of them are drawn.
    """
    runners = {"float32": scene.renderer(RADIO), "float64": scene.renderer(RADIO, wp.float64)}
    seconds = best_seconds(runners, repeats)
    count = scene.shape[0] * scene.shape[1]
    chosen = np.random.default_rng(seed).choice(count, min(pixels, count), replace=False)
    toward = scene.camera().directions().reshape(-1, 3)[chosen]
    rays = GaussianRays(scene.gaussians, blending=RADIO, device=scene.device)
    found = rays.hits(scene.position, toward, 256, order="range")
    reference = (found.weight * np.where(found.index >= 0, scene.gains[found.index], 0.0)).sum(axis=1)
    return [
        {
            "value": name,
            "seconds": seconds[name],
            **error_of(run().reshape(-1)[chosen].astype(np.float64), reference),
        }
        for name, run in runners.items()
    ]


def resolution_rows(scene: Scene, shapes: Sequence[tuple[int, int]], *, repeats: int = 3) -> list[Row]:
    """One row a grid: seconds, and the error of its nearest pixel against the finest grid's doubled resolution."""
    runners = {f"{s}": scene.renderer(RADIO, shape=s) for s in shapes}
    seconds = best_seconds(runners, repeats)
    rows, columns = (2 * max(s[axis] for s in shapes) for axis in (0, 1))
    reference = scene.renderer(TIGHT, wp.float64, (rows, columns))()
    out = []
    for shape in shapes:
        image = runners[f"{shape}"]()
        nearest = image[np.ix_(np.arange(rows) * shape[0] // rows, np.arange(columns) * shape[1] // columns)]
        out.append({"value": list(shape), "seconds": seconds[f"{shape}"], **error_of(nearest, reference)})
    return out


def growth_row(
    count: int, shape: tuple[int, int], *, repeats: int = 3, seed: int = 0, device: Any = None
) -> Row:
    """What ``count`` Gaussians cost, and how well as many discs stand for the room.

    Returns:
        ``gaussians``; ``seconds`` of a spectrum of overlapping Gaussians; of the discs, against rays cast at the mesh:
        errors of the image, ``range_error_median_m`` of the dominant disc's peak; ``transmittances_per_s``: random
        segments between points in the room through :class:`warprrf.GaussianRays`.
    """
    mesh, on, position = room_mesh(), resolve(device), positions(1, seed)[0]
    overlapping = Scene(count, shape, seed=seed, device=device).renderer(RADIO)
    discs = discs_on_mesh(mesh, count, seed=seed)
    camera = Camera.spherical(shape[1], shape[0], position=position)
    image = wr.render(discs, camera, features=gain(discs.means)[:, None], blending=RADIO, device=on)
    hit = mesh.cast(position, pixel_directions(shape).reshape(-1, 3), device=on)
    rays = GaussianRays(discs, device=on)
    segments = positions(20_000, seed + 1), positions(20_000, seed + 2)
    seconds = best_seconds(
        {"spectrum": overlapping, "segments": lambda: rays.transmittance(*segments)}, repeats
    )
    return {
        "gaussians": count,
        "seconds": seconds["spectrum"],
        **error_of(image.features[..., 0], gain(hit.point).reshape(shape)),
        "range_error_median_m": float(np.median(np.abs(image.peak - hit.t.reshape(shape)))),
        "transmittances_per_s": len(segments[0]) / seconds["segments"],
    }


def point_rows(
    count: int, receivers: int, shape: tuple[int, int], *, seed: int = 0, device: Any = None
) -> list[Row]:
    """What taking a ray's interaction point from a Gaussian costs in error, and what it saves: one row per option.

    The paper stands the centre of the dominant Gaussian in for the surface. Rows compare it with the peak of that
    Gaussian on the ray, with the blended expected depth, and with the mesh hit, on a room covered with discs.

    Returns:
        A dict per option: ``interaction_point``; ``length_error_median_m``, ``length_error_p90_m`` of the single-bounce
        length over pixels; ``delay_error_median_ns``; ``milliseconds_per_receiver``, blending weights apart, which all
        options share and which take ``weights_milliseconds_per_receiver``.
    """
    mesh = room_mesh()
    place = SimpleNamespace(gaussians=discs_on_mesh(mesh, count, seed=seed), mesh=mesh)
    at, source = positions(receivers, seed), np.asarray(TRANSMITTER)
    transport(place.gaussians, at[:1], shape, device=device)  # compile outside the clock
    start = time.perf_counter()
    seen = transport(place.gaussians, at, shape, device=device)
    blending_ms = 1e3 * (time.perf_counter() - start) / receivers
    size = (receivers, *shape, 3)
    truth = mesh.cast(
        np.broadcast_to(at[:, None, None], size).reshape(-1, 3),
        np.broadcast_to(pixel_directions(shape), size).reshape(-1, 3),
        device=device,
    )
    exact = path_lengths(truth.point.reshape(size), source, at).total

    def lengths(kind: str) -> np.ndarray:
        points = interaction_points(seen, place.gaussians, kind, mesh=mesh, device=device)
        return np.asarray(path_lengths(points, source, at).total)

    seconds = best_seconds({kind: partial(lengths, kind) for kind in INTERACTION_POINTS}, 3)
    rows = []
    for kind in INTERACTION_POINTS:
        error = np.abs(lengths(kind) - exact)
        error = error[np.isfinite(error)]
        rows.append(
            {
                "interaction_point": kind,
                "length_error_median_m": float(np.median(error)),
                "length_error_p90_m": float(np.percentile(error, 90)),
                "delay_error_median_ns": float(np.median(error) / SPEED_OF_LIGHT * 1e9),
                "milliseconds_per_receiver": 1e3 * seconds[kind] / receivers,
                "weights_milliseconds_per_receiver": blending_ms,
            }
        )
    return rows
