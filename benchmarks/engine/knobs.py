"""Speed against error of the rasteriser's knobs, and how cost grows; every row is a dict of one setting.

The scene is a room of Gaussians (:func:`benchmarks.engine.transport.cover`) whose gain varies over 60 dB, seen as a
spectrum. Unless a knob says otherwise the error of an image is the rms over pixels of its difference in dB, on a floor
60 dB below the brightest pixel, from a float64 rendering whose cutoffs are out of the way (:data:`TIGHT`), and time is
the shortest of the repeats by the clock, settings in turn. Where the question is the geometry, not the image, discs on
the room's mesh are compared with rays cast at the mesh.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from benchmarks.engine.forms import best_seconds
from benchmarks.engine.scenes import ROOM
from benchmarks.engine.transport import cover, positions
from benchmarks.interaction_points import interaction_point_rows
from warprrf.device import resolve
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.discs import discs_on_mesh
from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.rasterizer import RADIO, Blending, Rasterizer
from warprrf.rf.fields.harmonic.transport import transport
from warprrf.rf.spectra.spectrum import pixel_directions, to_db

DEPTH_DB = 60.0
"""The floor lies this far below the brightest pixel."""

TIGHT = Blending(alpha_min=1e-8, alpha_max=1 - 1e-9, transmittance_min=1e-9)
"""Cutoffs that change nothing at 60 dB."""

ALPHA_MIN = (1e-1, 3e-2, 1e-2, 1 / 255, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6)
ALPHA_MAX = (0.9, 0.99, 0.999, 1 - 1e-4, 1 - 1e-5, 1 - 1e-6, 1 - 1e-7)
TRANSMITTER = (2.0, 3.0, 3.2)

Row = dict[str, Any]


def room_mesh() -> Mesh:
    """The room's six sides, wound inwards."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * np.asarray(ROOM)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return Mesh(corners, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def gain(points: np.ndarray) -> np.ndarray:
    """Linear gain that varies smoothly over some 60 dB on the walls, with one glint; points ``(..., 3)`` [m]."""
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    db = -35 + 15 * np.sin(1.3 * x) * np.cos(1.7 * y) + 10 * np.sin(2.1 * z + x)
    glint = np.exp(-0.5 * ((x - 9.0) ** 2 + (y - 12.0) ** 2 + (z - 2.0) ** 2) / 0.3**2)
    return 10 ** (db / 10) + glint


class Scene:
    """A room of Gaussians with their gains, uploaded once in each precision.

    Args:
        gaussians: their number.
        shape: rows and columns of the spectrum.
    """

    def __init__(self, gaussians: int, shape: tuple[int, int], *, seed: int = 0, device: Any = None) -> None:
        self.gaussians, self.shape, self.device = cover(gaussians, seed), shape, resolve(device)
        self.position = positions(1, seed)[0]
        self.gains = gain(self.gaussians.means)

    @classmethod
    def screened(cls, gaussians: int, shape: tuple[int, int], *, seed: int = 0, device: Any = None) -> Scene:
        """Opaque discs on the room's mesh and on a dark screen through it, that hides what is bright behind."""
        scene = cls(1, shape, seed=seed, device=device)
        y, z = ROOM[1] - 0.5, ROOM[2] - 0.2
        corners = [[9.0, 0.5, 0.2], [9.0, y, 0.2], [9.0, y, z], [9.0, 0.5, z]]
        room = room_mesh()
        faces = np.concatenate([room.faces, np.array([[0, 1, 2], [0, 2, 3]]) + len(room.vertices)])
        mesh = Mesh(np.concatenate([room.vertices, corners]), faces)
        scene.gaussians = discs_on_mesh(mesh, gaussians, opacity=1.0, seed=seed)
        dark = np.abs(scene.gaussians.means[:, 0] - 9.0) < 1e-3
        scene.gains = np.where(dark, 10 ** (-DEPTH_DB / 10), gain(scene.gaussians.means))
        return scene

    @property
    def camera(self) -> Camera:
        """The receiver's panorama."""
        return Camera.spherical(self.shape[1], self.shape[0], position=self.position)

    def renderer(
        self, blending: Blending, real: Any = wp.float32, shape: tuple[int, int] | None = None
    ) -> Callable[[], np.ndarray]:
        """A function that renders the image (H, W) from Gaussians that are on the device."""
        raster = Rasterizer(device=self.device, blending=blending, real=real)
        arrays = raster.upload(self.gaussians)
        features = wp.array(self.gains[:, None], dtype=real, device=self.device)
        rows, columns = shape or self.shape
        camera = Camera.spherical(columns, rows, position=self.position)

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


def cutoff_rows(scene: Scene, knob: str, values: Sequence[float], *, repeats: int = 5) -> list[Row]:
    """One row a value of the cutoff ``knob`` of :class:`Blending`, the others as for radio: error and seconds."""
    runners = {
        f"{value!r}": scene.renderer(replace(RADIO, **{knob: value}))  # type: ignore[arg-type]
        for value in values
    }
    seconds, reference = best_seconds(runners, repeats), scene.reference()
    return [
        {"value": value, "seconds": seconds[f"{value!r}"], **error_of(runners[f"{value!r}"](), reference)}
        for value in values
    ]


def top_k_rows(scene: Scene, values: Sequence[int], *, repeats: int = 3) -> list[Row]:
    """One row a ``K``: seconds to list a receiver's weights, pairs a pixel, and the error of the image made of them.

    The reference is the image of all weights at the same cutoffs, so that the error is that of K alone.
    """

    def listing(k: int) -> Callable[[], Any]:
        return lambda: transport(
            scene.gaussians, scene.position[None], scene.shape, top_k=k, device=scene.device
        )

    def image(seen: Any) -> np.ndarray:
        pixel = np.repeat(np.arange(len(seen.start) - 1), np.diff(seen.start))
        power = np.bincount(
            pixel, weights=seen.weight * scene.gains[seen.gaussian], minlength=len(seen.start) - 1
        )
        return power.reshape(scene.shape)

    runners = {f"{k}": listing(k) for k in values}
    seconds = best_seconds(runners, repeats)
    most = listing(max(4 * max(values), 256))()
    reference, rows = image(most), []
    for k in values:
        seen = runners[f"{k}"]()
        rows.append(
            {
                "value": k,
                "seconds": seconds[f"{k}"],
                "pairs_per_pixel": seen.pairs / (scene.shape[0] * scene.shape[1]),
                "dropped_mean": seen.dropped[1],
                **error_of(image(seen), reference),
            }
        )
    return rows


def precision_rows(scene: Scene, *, pixels: int = 2000, repeats: int = 5, seed: int = 0) -> list[Row]:
    """float32 and float64 with the cutoffs of radio, against rays traced through the Gaussians one by one in float64.

    The reference shares no code with the rasteriser's projection, binning and blending; ``pixels`` of them are drawn.
    """
    runners = {"float32": scene.renderer(RADIO), "float64": scene.renderer(RADIO, wp.float64)}
    seconds = best_seconds(runners, repeats)
    count = scene.shape[0] * scene.shape[1]
    chosen = np.random.default_rng(seed).choice(count, min(pixels, count), replace=False)
    toward = scene.camera.directions().reshape(-1, 3)[chosen]
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
        out.append(
            {
                "value": list(shape),
                "pixels": shape[0] * shape[1],
                "seconds": seconds[f"{shape}"],
                **error_of(nearest, reference),
            }
        )
    return out


def count_row(
    count: int, shape: tuple[int, int], *, repeats: int = 3, seed: int = 0, device: Any = None
) -> Row:
    """How well about ``count`` discs stand for the room, against rays cast at its mesh, and what they cost.

    Returns:
        ``gaussians``; ``seconds`` of a spectrum; errors of the image against the gain at the true surface;
        ``range_error_median_m`` of the dominant disc's peak; ``transmittances_per_s``: random segments between points
        in the room through :class:`warprrf.GaussianRays`, and ``hierarchy_s`` to build it.
    """
    mesh, on, position = room_mesh(), resolve(device), positions(1, seed)[0]
    discs = discs_on_mesh(mesh, count, seed=seed)
    raster = Rasterizer(device=on, blending=RADIO)
    arrays = raster.upload(discs)
    features = wp.array(gain(discs.means)[:, None], dtype=wp.float32, device=on)
    camera = Camera.spherical(shape[1], shape[0], position=position)

    def run() -> Any:
        image = raster.rasterize(*arrays, features, camera)
        return image.features.numpy()[..., 0], image.peak.numpy()

    seconds = best_seconds({"spectrum": run}, repeats)["spectrum"]
    image, peak = run()
    hit = mesh.cast(position, pixel_directions(shape).reshape(-1, 3), device=on)
    start = time.perf_counter()
    rays = GaussianRays(discs, device=on)
    built = time.perf_counter() - start
    segments = positions(20_000, seed + 1), positions(20_000, seed + 2)
    spent = best_seconds({"segments": lambda: rays.transmittance(*segments)}, repeats)["segments"]
    return {
        "gaussians": len(discs),
        "seconds": seconds,
        **error_of(image, gain(hit.point).reshape(shape)),
        "range_error_median_m": float(np.median(np.abs(peak - hit.t.reshape(shape)))),
        "transmittances_per_s": len(segments[0]) / spent,
        "hierarchy_s": built,
    }


def growth_row(
    count: int, shape: tuple[int, int], *, repeats: int = 3, seed: int = 0, device: Any = None
) -> Row:
    """Seconds of a spectrum of the room of overlapping Gaussians, ``count`` of them."""
    seconds = best_seconds({"s": Scene(count, shape, seed=seed, device=device).renderer(RADIO)}, repeats)["s"]
    return {"gaussians": count, "seconds": seconds}


def receiver_rows(scene: Scene, counts: Sequence[int], *, repeats: int = 2, seed: int = 0) -> list[Row]:
    """Seconds to list the blending weights of so many receivers."""
    runners = {
        f"{n}": (lambda n=n: transport(scene.gaussians, positions(n, seed), scene.shape, device=scene.device))
        for n in counts
    }
    seconds = best_seconds(runners, repeats)
    return [{"receivers": n, "seconds": seconds[f"{n}"]} for n in counts]


def point_rows(
    count: int, receivers: int, shape: tuple[int, int], *, seed: int = 0, device: Any = None
) -> list[Row]:
    """Length error and cost of every interaction point on the room covered with discs; see
    :func:`benchmarks.interaction_points.interaction_point_rows`."""
    mesh = room_mesh()
    geometry = SimpleNamespace(gaussians=discs_on_mesh(mesh, count, seed=seed), mesh=mesh)
    return interaction_point_rows(
        geometry,
        mesh,
        transmitter=TRANSMITTER,
        receivers=positions(receivers, seed),
        shape=shape,
        device=device,
    )
