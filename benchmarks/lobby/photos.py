"""Where the lobby is photographed from: a walk round the room with two cameras, and views that fill its gaps.

The walk passes every corner of the room twice, at two heights. Each view overlaps the one before it and, among those
that do, shows most of the surface that receivers see and fewer than five photos show so far. Further views from
anywhere in the room are chosen greedily by the same measure.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.lobby.mitsuba_photos import render_photos
from warprrf.device import Progress, require
from warprrf.files import write_json
from warprrf.geometry.splats.camera import Camera
from warprrf.rf.scene import Scene

WIDTH, HEIGHT, FOCAL = 640, 480, 395.0  # pixels; 78 degrees across
CLEARANCE = 0.5  # m between a camera and anything
HELD_OUT_EVERY = 10
SURVEYED = 8
NOISE_VIEWS = 3
WANTED_VIEWS = 5  # photos that should show each piece of surface
OVERLAP = 0.4  # share of what a photo of the walk shows that the one before it shows too, where possible
FARTHEST, GRAZING = (
    9.0,
    0.2,
)  # a photo shows a piece nearer than this [m], at a cosine of incidence above this

WALK = [
    (2.5, 5.3), (2.6, 3.4), (3.0, 1.4), (5.0, 1.2), (5.2, 3.4), (5.2, 5.0), (7.2, 5.2), (7.2, 2.6), (7.3, 1.0),
    (9.4, 1.0), (10.6, 1.9), (12.0, 1.8), (13.6, 2.2), (13.5, 4.2), (11.6, 4.9), (10.4, 5.2), (10.4, 7.2), (11.9, 8.2),
    (13.3, 8.3), (13.2, 10.4), (11.6, 10.3), (11.0, 9.0), (9.0, 8.6), (6.7, 8.4), (6.6, 10.4), (5.0, 10.8), (3.0, 10.7),
    (1.3, 10.6), (1.0, 9.0), (2.3, 7.9),
]  # fmt: skip
"""Corners of the closed walk (x, y) [m]; it is rounded off between them."""


@dataclass(frozen=True)
class PhotoPlan:
    """Cameras by file name, and the roles of the photos.

    Attributes:
        cameras: true cameras by file name.
        held_out: photos that take part in structure from motion but not in the photometric optimisation.
        surveyed: photos whose camera position counts as known.
    """

    cameras: dict[str, Camera]
    held_out: list[str]
    surveyed: list[str]


def look(position: np.ndarray, yaw: float, pitch: float) -> Camera:
    """A photo camera at ``position`` [m] looking along azimuth ``yaw``, ``pitch`` above the horizon [rad]."""
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(position, dtype=np.float64)
    return Camera.pinhole(
        WIDTH, HEIGHT, fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2, world_to_camera=pose
    )


def _path(steps: int) -> np.ndarray:
    """Positions (x, y) [m] along the rounded walk, shape ``(steps, 2)``."""
    corners = np.array([*WALK, WALK[0]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    dense = np.linspace(0, length[-1], 100 * steps, endpoint=False)
    path = np.column_stack([np.interp(dense, length, corners[:, k]) for k in range(2)])
    frequency = np.fft.fftfreq(len(dense), length[-1] / len(dense))
    smooth = np.exp(-2 * (np.pi * frequency * 0.35) ** 2)[:, None]  # rounds corners off over 0.35 m
    return np.fft.ifft(np.fft.fft(path, axis=0) * smooth, axis=0).real[::100]


def surface_samples(
    scene: Scene, rng: np.random.Generator, *, per_m2: float = 5.0
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals on the surface that a receiver 0.8 to 2.2 m high can see, shapes ``(S, 3)``."""
    mesh = scene.mesh
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    face = rng.choice(len(areas), int(per_m2 * areas.sum()), p=areas / areas.sum())
    a, b = rng.random((2, len(face), 1))
    flip = a + b > 1
    a, b = np.where(flip, 1 - a, a), np.where(flip, 1 - b, b)
    points = corners[face, 0] * (1 - a - b) + corners[face, 1] * a + corners[face, 2] * b
    normals = mesh.face_normals[face]
    receivers = rng.uniform([0, 0, 0.8], [15, 12, 2.2], (400, 3))
    receivers = receivers[scene.is_free(receivers, clearance_m=0.3)][:80]
    off = points + 0.005 * normals
    seen = np.zeros(len(points), dtype=bool)
    for receiver in receivers:
        left = np.flatnonzero(~seen & (np.einsum("ij,ij->i", receiver - points, normals) > 0))
        seen[left] = mesh.visible(np.tile(receiver, (len(left), 1)), off[left])
    return points[seen], normals[seen]


def shown(scene: Scene, camera: Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Which surface points a photo shows (in the frame, near, not grazing, not hidden), shape ``(S,)``, bool."""
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = np.maximum(local[:, 2], 1e-6)
    x, y = FOCAL * local[:, 0] / depth + WIDTH / 2, FOCAL * local[:, 1] / depth + HEIGHT / 2
    towards = camera.position - points
    distance = np.linalg.norm(towards, axis=1)
    good = (local[:, 2] > 0.1) & (x > 0) & (x < WIDTH) & (y > 0) & (y < HEIGHT) & (distance < FARTHEST)
    good &= np.einsum("ij,ij->i", towards, normals) > GRAZING * distance
    index = np.flatnonzero(good)
    good[index] = scene.mesh.visible(
        np.tile(camera.position, (len(index), 1)), points[index] + 0.005 * normals[index]
    )
    return good


def _open(scene: Scene, camera: Camera) -> bool:
    """Whether a view is not blocked by something close."""
    rays = camera.directions()[24::48, 32::64].reshape(-1, 3)
    hit = scene.mesh.cast(np.tile(camera.position, (len(rays), 1)), rays)
    return bool(np.median(hit.t) > 1.6 and (hit.t < 0.8).mean() < 0.15)


class _Coverage:
    """How many photos show each piece of surface, and what another one would be worth."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        self.points, self.normals = surface_samples(scene, rng)
        self.count = np.zeros(len(self.points), dtype=int)

    def sees(self, camera: Camera) -> np.ndarray:
        return shown(self.scene, camera, self.points, self.normals)

    def worth(self) -> np.ndarray:
        # A piece seen by few photos counts more; one that enough photos show counts (almost) nothing.
        return np.maximum(WANTED_VIEWS - self.count, 0.05) ** 2


def _walk(
    cover: _Coverage, steps: int, heights: tuple[float, ...], shift: float, start_yaw: float
) -> list[Camera]:
    """One series along the walk: each view turns at most 40 degrees from the last and overlaps it where it can."""
    views: list[Camera] = []
    yaw, before = start_yaw, None
    path = np.roll(_path(2 * steps), -round(2 * shift), axis=0)[::2]
    for k, place in enumerate(path):
        options = []
        for height in heights:
            position = np.array([*place, height + 0.1 * np.sin(2.4 * k)])
            if not cover.scene.is_free(position[None], clearance_m=CLEARANCE)[0]:
                continue
            for turn in np.radians(np.arange(-40, 41, 20)):
                for pitch in (-0.25, 0.05, 0.25):
                    camera = look(position, yaw + turn, pitch)
                    if _open(cover.scene, camera):
                        sees = cover.sees(camera)
                        shared = 1.0 if before is None else (sees & before).sum() / max(1, sees.sum())
                        options.append(
                            (min(shared, OVERLAP), float(sees @ cover.worth()), yaw + turn, camera, sees)
                        )
            if options:
                break
        if not options:
            continue
        _, _, yaw, camera, before = max(options, key=lambda option: option[:2])
        cover.count += before
        views.append(camera)
    return views


def plan(
    scene: Scene, *, views: int = 120, steps: int = 36, candidates: int = 900, seed: int = 0
) -> PhotoPlan:
    """Choose the cameras, ``views`` of them in all."""
    rng = np.random.default_rng(seed)
    cover = _Coverage(scene, rng)
    chosen = _walk(cover, steps, (1.5, 1.3), 0.0, 0.4)
    chosen += _walk(cover, steps, (2.15, 1.9, 1.7), 0.5, 3.0)
    chosen = chosen[:views]
    pool: list[Camera] = []
    while len(pool) < candidates:
        place = rng.uniform([0.6, 0.6, 1.3], [14.4, 11.4, 2.4])
        camera = look(place, rng.uniform(-np.pi, np.pi), rng.uniform(-0.45, 0.4))
        if scene.is_free(place[None], clearance_m=CLEARANCE)[0] and _open(scene, camera):
            pool.append(camera)
    sees = np.array([cover.sees(camera) for camera in pool])
    for _ in range(views - len(chosen)):
        known = sees @ (cover.count >= 1)  # a view must show enough that others show, or it cannot be matched
        value = sees @ cover.worth()
        best = int(np.argmax(np.where(known >= 0.4 * sees.sum(axis=1), value, 0.01 * value)))
        chosen.append(pool[best])
        cover.count += sees[best]
        sees[best] = False
    cameras = {f"view_{k:03d}.jpg": camera for k, camera in enumerate(chosen)}
    names = list(cameras)
    held_out = names[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY]
    return PhotoPlan(cameras, held_out, _spread_out({n: c for n, c in cameras.items() if n not in held_out}))


def _spread_out(cameras: dict[str, Camera]) -> list[str]:
    """Names of positions far from each other, the farthest from those taken next."""
    names = list(cameras)
    positions = np.array([cameras[n].position for n in names])
    taken = [0]
    while len(taken) < min(SURVEYED, len(names)):
        gaps = np.linalg.norm(positions[:, None] - positions[taken][None], axis=2).min(axis=1)
        taken.append(int(np.argmax(gaps)))
    return sorted(names[k] for k in taken)


def write_plan(
    directory: str | os.PathLike[str], photo_plan: PhotoPlan, *, rendering: dict[str, Any]
) -> None:
    """Write ``photos.json`` (roles, intrinsics), ``surveyed.json`` (positions) and ``poses_true.json`` (evaluation)."""
    directory = Path(directory)
    intrinsics = {
        "width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2
    }  # fmt: skip
    cameras = photo_plan.cameras
    write_json(
        directory / "photos.json",
        {
            "photos": list(cameras),
            "held_out": photo_plan.held_out,
            "noise": photo_plan.held_out[:: max(1, len(photo_plan.held_out) // NOISE_VIEWS)][:NOISE_VIEWS],
            "intrinsics": intrinsics,
            "rendering": rendering,
        },
    )
    write_json(
        directory / "surveyed.json",
        {name: [round(float(v), 4) for v in cameras[name].position] for name in photo_plan.surveyed},
    )
    write_json(
        directory / "poses_true.json",
        {
            "about": "True poses, for evaluation only. OpenCV axes (x right, y down, z forward), metres.",
            **intrinsics,
            "views": {
                name: {
                    "world_to_camera": camera.world_to_camera.tolist(),
                    "held_out": name in photo_plan.held_out,
                }
                for name, camera in cameras.items()
            },
        },
    )


def read_poses(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """True cameras by file name, from ``poses_true.json``."""
    table = json.loads(Path(path).read_text(encoding="utf-8"))
    size = {key: table[key] for key in ("fx", "fy", "cx", "cy")}
    return {
        name: Camera.pinhole(table["width"], table["height"], world_to_camera=view["world_to_camera"], **size)
        for name, view in table["views"].items()
    }


def noise_psnr_db(directory: str | os.PathLike[str]) -> float:
    """PSNR [dB] between photos and renders of the same views with other seeds: the photos' own noise.

    Mean over the views in ``photos_noise``, both as decoded 8-bit JPEG.

    Raises:
        FileNotFoundError: if there are no second renders.
    """
    directory = Path(directory)
    images = require("PIL.Image", extra="photos")
    second = sorted((directory / "photos_noise").glob("*.jpg"))
    if not second:
        raise FileNotFoundError(f"directory: {directory / 'photos_noise'} holds no second renders")
    values = []
    for path in second:
        a, b = (
            np.asarray(images.open(p), dtype=np.float64) / 255
            for p in (path, directory / "photos" / path.name)
        )
        values.append(-10 * np.log10(np.mean((a - b) ** 2)))
    return float(np.mean(values))


def make_photos(
    directory: str | os.PathLike[str],
    *,
    spp: int = 4,
    max_depth: int = 4,
    views: int = 120,
    seed: int = 0,
    progress: Progress | None = None,
) -> Path:
    """Photograph ``directory/scene.xml``: ``photos/``, ``photos_noise/`` and the JSON files; resumable.

    Returns the folder of photos.
    """
    directory = Path(directory)
    poses = directory / "poses_true.json"
    if not poses.is_file():
        made = plan(Scene.load(directory / "scene.xml"), views=views, seed=seed)
        write_plan(directory, made, rendering={"paths_per_pixel": spp, "max_depth": max_depth, "seed": seed})
    cameras = read_poses(poses)
    roles = json.loads((directory / "photos.json").read_text(encoding="utf-8"))
    xml = directory / "scene.xml"
    render_photos(
        xml, cameras, directory / "photos", spp=spp, seed=seed, max_depth=max_depth, progress=progress
    )
    again = {name: cameras[name] for name in roles["noise"]}
    render_photos(xml, again, directory / "photos_noise", spp=spp, seed=seed + 10_000, max_depth=max_depth)
    return directory / "photos"
