"""A filmed room against an RGB-D camera's depth: photos alone are reconstructed, depth and poses are the reference.

Takes frames as 7-Scenes and many sets after it have them: ``frame-000000.color.jpg``, ``.depth.png`` [mm] and
``.pose.txt`` (camera to world, 4 x 4) beside ``camera-intrinsics.txt`` (3 x 3, of the depth camera).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.machine import machine
from benchmarks.report import Report, table
from benchmarks.runner import Benchmark, Job, option
from warprrf.device import Progress, require
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.posed.sparse import fit_similarity
from warprrf.geometry.photos.surface.fusion import fuse_depth
from warprrf.geometry.scans import SurfaceConfig, scanned_patches

HELP = """\
Reconstructs every eighth frame of a film from its colours, lays the cameras on the reference ones by a similarity, and
measures how far the mesh is from the fused reference depth, where the reference saw a surface. Then fits a radio field on
the mesh, and one on the reference, to spectra that Sionna RT makes on the reference.

examples:
  python -m benchmarks filmed --frames data/redkitchen
  python -m benchmarks filmed --frames data/redkitchen --every 16 --iterations 600     a first look
"""

UNKNOWN_MM = (0, 65535)  # depths that mean "not measured"
FAR_M = 4.0  # a structured light camera errs by centimetres beyond
REFERENCE = SurfaceConfig(voxel_m=0.02, truncation_voxels=4.0, max_range_m=FAR_M, min_component_faces=100)
LEVEL_CONES_DEG = (35, 20, 10, 5, 5, 5)  # what faces up, more and more exactly
STRIDE = 8  # every so many-th row and column of a depth image is a ray
RARE, ROUNDS = 13, 30  # every so many-th ray, and how often, when one mesh is laid on the other
CLOSE_M = 0.05
GRID_M, CLEAR_M = 0.4, 0.25  # between places of receivers, and from them to the nearest surface
THROUGH = 3  # frames that must see through a place
ENGINE, FREQUENCY_HZ, SHAPE = "sionna", 60e9, (90, 180)  # of the spectra
SCATTERING = 0.3  # of the plasterboard that all of the reference is made of
TRAINING = 20  # spectra that a field is fitted to
ROWS = (
    ("distance", "mesh to reference surface"),
    ("range", "along the reference's rays"),
    ("back", "reference surface to mesh"),
    ("laid_on_distance", "mesh to reference surface, laid on it"),
    ("laid_on_back", "reference surface to mesh, laid on it"),
    ("other_frames_distance", "the reference's own noise: a mesh of the frames in between, to it"),
)


@dataclass(frozen=True)
class Options:
    """Options of the comparison.

    Attributes:
        frames: folder of the frames.
        every: every n-th frame is a photo.
        reference_every: depth of every n-th frame is fused.
        iterations: of the photometric refinement; None: the library's.
    """

    frames: str | None = option(None, "folder of the frames (see above)")
    every: int = option(8, "every n-th frame is a photo")
    reference_every: int = option(2, "depth of every n-th frame is fused")
    iterations: int | None = option(None, "of the photometric refinement", kind=int)


@dataclass(frozen=True)
class Film:
    """Frames of an RGB-D camera.

    Attributes:
        stems: path of each frame without its endings, in order.
        poses: depth camera to world, z up, shape ``(N, 4, 4)``.
        lens: ``fx, fy, cx, cy`` of the depth camera [pixels].
    """

    stems: tuple[str, ...]
    poses: np.ndarray
    lens: tuple[float, float, float, float]

    @classmethod
    def open(cls, folder: str | None) -> Film:
        """The frames of ``folder``, turned until the cameras are upright on the whole.

        Raises:
            ValueError: if it is not such a folder.
        """
        found = sorted(Path(folder or "").glob("frame-*.pose.txt")) if folder else []
        if len(found) < 3:
            raise ValueError(
                f"frames: {folder} holds {len(found)} frames, expected a folder of frame-000000.color.jpg, "
                ".depth.png, .pose.txt, and so on, and camera-intrinsics.txt"
            )
        poses = np.array([np.loadtxt(path) for path in found])
        u, _, vt = np.linalg.svd(poses[:, :3, :3])  # written with few digits
        poses[:, :3, :3] = u @ vt
        up = -poses[:, :3, 1].mean(axis=0)
        up /= np.linalg.norm(up)
        ahead = np.cross(poses[:, :3, 0].mean(axis=0), -up)
        ahead /= np.linalg.norm(ahead)
        upright = np.eye(4)
        upright[:3, :3] = np.stack([np.cross(ahead, up), ahead, up])
        k = np.loadtxt(Path(str(folder)) / "camera-intrinsics.txt")
        stems = tuple(str(path).removesuffix(".pose.txt") for path in found)
        return cls(stems, upright @ poses, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))

    def photo(self, index: int) -> Path:
        """The colour image of a frame."""
        return next(Path(self.stems[index]).parent.glob(f"{Path(self.stems[index]).name}.color.*"))

    def depth(self, index: int) -> tuple[np.ndarray, wr.Camera]:
        """Euclidean ranges of a frame [m], 0 where unknown, and their camera."""
        image = require("PIL.Image", extra="photos")
        with image.open(f"{self.stems[index]}.depth.png") as picture:
            raw = np.asarray(picture, dtype=np.int64)
        fx, fy, cx, cy = self.lens
        camera = wr.Camera.pinhole(
            raw.shape[1], raw.shape[0], fx=fx, fy=fy, cx=cx, cy=cy,
            world_to_camera=np.linalg.inv(self.poses[index]),
        )  # fmt: skip
        z = np.where(np.isin(raw, UNKNOWN_MM), 0, raw) / 1e3
        ahead = camera.directions() @ self.poses[index][:3, 2]
        return np.where(z <= FAR_M, z / ahead, 0.0), camera

    def surface(self, chosen: Sequence[int], progress: Progress) -> Mesh:
        """Depth of the frames of these numbers fused."""
        depths, cameras = [], []
        for k, index in enumerate(chosen):
            progress("reference", k, len(chosen))
            depth, camera = self.depth(index)
            depths.append(depth.astype(np.float32))
            cameras.append(camera)
        mesh = fuse_depth(depths, cameras, config=REFERENCE)
        progress("reference", len(chosen), len(chosen))
        return mesh

    def levelled(self, surface: Mesh) -> tuple[Film, Mesh]:
        """Frames and their ``surface`` turned until the floor and what is parallel to it is level."""
        up = np.array([0.0, 0.0, 1.0])
        for cone_deg in LEVEL_CONES_DEG:
            facing = surface.face_normals @ up > np.cos(np.radians(cone_deg))
            up = surface.areas[facing] @ surface.face_normals[facing]
            up /= np.linalg.norm(up)
        ahead = np.cross([1.0, 0.0, 0.0], -up)
        ahead /= np.linalg.norm(ahead)
        turn = np.eye(4)
        turn[:3, :3] = np.stack([np.cross(ahead, up), ahead, up])
        mesh = Mesh(surface.vertices @ turn[:3, :3].T, surface.faces)
        return replace(self, poses=turn @ self.poses), mesh

    def free(self, surface: Mesh, every: int) -> np.ndarray:
        """Places of a grid which several of each ``every``-th frame see through, off the ``surface``, shape ``(K, 3)`` [m]."""
        axes = [np.arange(low + GRID_M / 2, high, GRID_M) for low, high in surface.bounds.T]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        through = np.zeros(len(places), dtype=np.int64)
        for index in range(0, len(self.stems), every):
            depth, camera = self.depth(index)
            inside, pixels = camera.in_frame(places)
            seen = np.where(inside, depth[pixels[:, 0], pixels[:, 1]], 0.0)
            through += seen > np.linalg.norm(places - camera.position, axis=1) + CLEAR_M
        return places[(through >= THROUGH) & (surface.distance(places) > CLEAR_M)]

    def rays(self, every: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Origins, directions and ranges [m] of known pixels of each ``every``-th frame."""
        origins, directions, ranges = [], [], []
        for index in range(0, len(self.stems), every):
            depth, camera = self.depth(index)
            part = (slice(STRIDE // 2, None, STRIDE),) * 2
            known = depth[part] > 0
            directions.append(camera.directions()[part][known])
            origins.append(np.broadcast_to(camera.position, directions[-1].shape))
            ranges.append(depth[part][known])
        return np.concatenate(origins), np.concatenate(directions), np.concatenate(ranges)


def score_cameras(
    cameras: Sequence[wr.Camera], poses: np.ndarray
) -> tuple[dict[str, Any], tuple[float, np.ndarray, np.ndarray]]:
    """Errors of ``cameras`` after the similarity that brings them to ``poses`` (N, 4, 4), and this similarity."""
    source = np.array([c.position for c in cameras])
    scale, rotation, shift = fit_similarity(source, poses[:, :3, 3])
    error = np.linalg.norm(scale * source @ rotation.T + shift - poses[:, :3, 3], axis=1)
    turns = np.array([c.rotation @ rotation.T for c in cameras]) @ poses[:, :3, :3]
    u, _, vt = np.linalg.svd(turns.mean(axis=0))  # the colour sensor is turned against the depth sensor
    cosine = (np.einsum("nij,ij->n", turns, u @ vt) - 1) / 2
    figures = {
        "camera_rms_m": float(np.sqrt((error**2).mean())),
        "camera_max_m": float(error.max()),
        "camera_rotation_median_deg": float(np.median(np.degrees(np.arccos(np.clip(cosine, -1, 1))))),
    }
    return figures, (scale, rotation, shift)


def score(mesh: Mesh, reference: Mesh, rays: tuple[np.ndarray, np.ndarray, np.ndarray]) -> dict[str, Any]:
    """Errors of ``mesh`` where the reference saw a surface: from what its rays meet to the fused reference, along these
    rays, and from the reference back to the mesh; the F score of both at 5 cm; the angle between normals where they are as
    close; and the share of the rays that meet the mesh at all."""
    origins, directions, ranges = rays
    met = mesh.cast(origins, directions)
    near = reference.closest(met.point[met.valid])
    close = near.distance < CLOSE_M  # farther off, the nearest surface is another one
    cosine = np.abs((met.normal[met.valid][close] * reference.face_normals[near.face[close]]).sum(axis=1))
    found = {
        "distance": near.distance,
        "range": np.abs(met.t - ranges)[met.valid],
        "back": mesh.distance(origins + ranges[:, None] * directions),
    }
    turned = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    figures: dict[str, Any] = {
        "covered": float(met.valid.mean()),
        "normal_median_deg": float(np.median(turned)) if len(turned) else float("nan"),
    }
    for name, error in found.items():
        figures |= {
            f"{name}_median_m": float(np.median(error)),
            f"{name}_p90_m": float(np.percentile(error, 90)),
            f"{name}_within_5_cm": float(np.mean(error < CLOSE_M)),
        }
    there, back = figures["distance_within_5_cm"], figures["back_within_5_cm"]
    return figures | {"f_5_cm": 2 * there * back / max(there + back, 1e-9)}


def laid_on(mesh: Mesh, reference: Mesh, rays: tuple[np.ndarray, np.ndarray, np.ndarray]) -> dict[str, Any]:
    """Scale, rotation and shift of the similarity after which what the rays meet of ``mesh`` lies best on ``reference``:
    without the errors of the cameras that it was aligned by (iterated closest points, Besl and McKay 1992)."""
    met = mesh.cast(rays[0][::RARE], rays[1][::RARE])
    source = met.point[met.valid]
    scale, rotation, shift = 1.0, np.eye(3), np.zeros(3)
    for _ in range(ROUNDS):
        near = reference.closest(scale * source @ rotation.T + shift).point
        error = np.linalg.norm(scale * source @ rotation.T + shift - near, axis=1)
        kept = error < max(3 * np.median(error), CLOSE_M)
        scale, rotation, shift = fit_similarity(source[kept], near[kept])
    return {"scale": scale, "rotation": rotation, "shift": shift}


def field_errors(
    reference: Mesh, places: np.ndarray, rooms: Mapping[str, Mesh | wr.Reconstruction], job: Job
) -> dict[str, Any]:
    """Errors of radio fields on the ``reference`` and on each of ``rooms``, fitted to spectra made on the reference.

    Args:
        places: free places, shape ``(K, 3)`` [m]: one is drawn for the transmitter, then those of training and test.

    Raises:
        ValueError: if there are too few.
        ImportError: if Sionna RT is not installed.
    """
    if len(places) < 2 * TRAINING:
        raise ValueError(f"frames: they show {len(places)} free places, expected {2 * TRAINING} at least")
    truth = scanned_patches(reference).mesh
    material = replace(wr.em.itu_material("plasterboard"), scattering=SCATTERING)
    places = np.random.default_rng(job.seed).permutation(places)
    data = wr.simulate(
        wr.Scene(truth, [material], np.zeros(len(truth.faces), np.int32)), transmitter=places[0], receivers=places[1:],
        frequency_hz=FREQUENCY_HZ, shape=SHAPE, engine=ENGINE, seed=job.seed, workspace=job.out / "spectra",
        progress=job.progress, device=job.device,
    )  # fmt: skip
    train, test = data.subset(range(TRAINING)), data.subset(range(TRAINING, len(data)))
    found: dict[str, Any] = {"train": len(train), "test": len(test)}
    for name, room in ({"reference": truth} | dict(rooms)).items():
        field = wr.RadioField.fit(room, train, model="bistatic", progress=job.progress, device=job.device)
        errors = wr.evaluate(test, field.spectrum, progress=job.progress)
        found[name] = {key: errors[key] for key in ("psnr_db", "rmse_db", "direction_within_3deg")}
    return found


def run(options: Options, job: Job) -> Report:
    """Reconstruct and compare.

    Raises:
        ValueError: for a folder that holds no such frames, or what :func:`warprrf.reconstruct` refuses.
    """
    film = Film.open(options.frames)
    fused = range(0, len(film.stems), options.reference_every)
    film, reference = film.levelled(film.surface(fused, job.progress))
    chosen = range(0, len(film.stems), options.every)
    photos = {film.photo(k).name: k for k in chosen}
    fresh, start = not (job.out / "workspace").exists(), time.perf_counter()
    rec = wr.reconstruct(
        [film.photo(k) for k in chosen],
        workspace=job.out / "workspace",
        known_positions={name: film.poses[k][:3, 3] for name, k in photos.items()},
        iterations=options.iterations,
        seed=job.seed,
        progress=job.progress,
        device=job.device,
    )
    seconds = time.perf_counter() - start
    figures: dict[str, Any] = {
        "machine": machine(job.device),
        "frames": len(photos),
        "posed": len(rec.cameras),
    }
    if fresh:  # else some steps were there already
        figures["seconds"] = seconds
    taken = film.poses[[photos[name] for name in rec.cameras]]
    errors, (scale, rotation, shift) = score_cameras(list(rec.cameras.values()), taken)
    rec, rays = rec.transformed(scale=scale, rotation=rotation, shift=shift), film.rays(options.every)
    laying = laid_on(rec.mesh, reference, rays)
    laid = rec.transformed(**laying)
    figures |= errors | score(rec.mesh, reference, rays) | {"laid_on_scale": laying["scale"]}
    figures |= {f"laid_on_{name}": value for name, value in score(laid.mesh, reference, rays).items()}
    other = film.surface(range(1, len(film.stems), options.reference_every), job.progress)
    figures |= {f"other_frames_{name}": value for name, value in score(other, reference, rays).items()}
    rooms: dict[str, Mesh | wr.Reconstruction] = {"other_frames": scanned_patches(other).mesh, "mesh": laid}
    figures["field"] = field_errors(reference, film.free(reference, options.every), rooms, job)
    return Report("filmed", figures, _text(figures))


def _text(figures: Mapping[str, Any]) -> str:
    rows = [
        [title, *(f"{figures[f'{key}_{part}']:.3f}" for part in ("median_m", "p90_m", "within_5_cm"))]
        for key, title in ROWS
    ]
    field = figures["field"]
    psnr = {name: field[name]["psnr_db"] for name in ("reference", "other_frames", "mesh")}
    took = f", {figures['seconds']:.0f} s" if "seconds" in figures else ""
    return (
        f"{figures['posed']} of {figures['frames']} frames posed{took}; cameras "
        f"{100 * figures['camera_rms_m']:.1f} cm rms off, {figures['camera_rotation_median_deg']:.2f} degrees; "
        f"{100 * figures['covered']:.0f} % of the reference's pixels meet the mesh, normals "
        f"{figures['laid_on_normal_median_deg']:.1f} degrees off (those of the frames in between "
        f"{figures['other_frames_normal_median_deg']:.1f}), F at 5 cm {figures['laid_on_f_5_cm']:.3f}. The mesh "
        "is aligned by its cameras; *laid "
        f"on it*, by its surface: scale {figures['laid_on_scale']:.3f}, what is left is the error of its shape.\n\n"
        + table(("", "median [m]", "90th percentile [m]", "within 5 cm"), rows)
        + f"\n\nA field fitted to {field['train']} of Sionna RT's spectra on the reference, PSNR at {field['test']} other "
        f"places: {psnr['reference']:.1f} dB on the reference, {psnr['other_frames']:.1f} dB on one of the frames in between, "
        f"{psnr['mesh']:.1f} dB on this mesh.\n"
    )


BENCHMARKS = {"filmed": Benchmark("filmed", Options, run, HELP)}
