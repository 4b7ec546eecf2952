"""Stage 1: from photos and a few surveyed camera positions to Gaussians, a mesh and its planar patches, in metres.

Structure from motion, similarity to metres, cleaning, planes, initial Gaussians, photometric refinement, depth maps,
fusion, planar patches. Every finished step is kept in the workspace under a fingerprint of all that it was made from:
a stopped run continues, a changed input starts over from the first step it changes.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import Progress, check_array, require
from warprrf.geometry import sfm, surface, sweep
from warprrf.geometry.camera import Camera
from warprrf.geometry.completion import complete
from warprrf.geometry.edges import meeting
from warprrf.geometry.gaussians import Gaussians, replacing
from warprrf.geometry.initial import initial_gaussians, seen_cells
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.planes import Plane, aligned, occupancy
from warprrf.geometry.refine import RefineConfig, refine
from warprrf.geometry.render import render
from warprrf.geometry.surface import PlanarPatch

FILE = "reconstruction.safetensors"
FORMAT = 1
# Without surveyed positions the scale is unknown: the median distance from a camera to a point it sees becomes this.
ASSUMED_DISTANCE_M = 3.0


@dataclass(frozen=True)
class ReconstructionConfig:
    """Settings of :func:`reconstruct`.

    Attributes:
        max_features: SIFT features per photo.
        pairs: which photos are matched, ``"auto"`` or ``"exhaustive"``.
        max_reprojection_error: sparse points above it are dropped [pixels].
        plane_distance_m: band of the plane detection.
        plane_points: fewest sparse points of a plane.
        cell_m: side of a plane's cells.
        sweep: correct and complete the planes by comparing the photos (see :mod:`warprrf.geometry.sweep`).
        gaussians: Gaussians to start the refinement from (about).
        refine: settings of the photometric refinement.
        depth_downscale: depth maps are rendered at the photos' size divided by this.
        depth_views: at most so many depth maps are fused, spread over all cameras.
        alpha: a depth counts where at least so much light is blocked.
        depth_spread: and where the blended depth and that of the dominant Gaussian differ by no more than this part.
        voxel_m: side of a voxel of the fusion.
        patch_distance_m: a face this close to a plane can belong to its patch.
        min_patch_m2: smallest planar patch.
        complete: close holes and straighten borders where the planes allow it (see
            :mod:`warprrf.geometry.completion`).
        complete_cell_m: largest side of the boxes that space is divided into for that.
    """

    max_features: int = 2400
    pairs: str = "auto"
    max_reprojection_error: float = 1.0
    plane_distance_m: float = 0.015
    plane_points: int = 40
    cell_m: float = 0.1
    sweep: bool = True
    gaussians: int = 32_000
    refine: RefineConfig = field(default_factory=RefineConfig)
    depth_downscale: int = 2
    depth_views: int = 120
    alpha: float = 0.6
    depth_spread: float = 0.05
    voxel_m: float = 0.05
    patch_distance_m: float = 0.06
    min_patch_m2: float = 0.15
    complete: bool = True
    complete_cell_m: float = 0.1


class Reconstruction:
    """Geometry of a place, frozen.

    Attributes:
        gaussians: the Gaussians.
        cameras: photo name to :class:`Camera`; empty for splats without poses.
        patches: planar patches of the mesh, largest first.
        planes: planes detected among the sparse points.
        scale_rms_m: rms distance left between surveyed and reconstructed camera positions [m]; NaN without survey.
        metric: whether lengths are metres (else they are an assumed scale).
        unposed: names of photos without a pose.
        held_out: names of photos that the Gaussians were not fitted to.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        mesh: Mesh | None = None,
        cameras: Mapping[str, Camera] | None = None,
        *,
        patches: Sequence[PlanarPatch] = (),
        planes: Sequence[Plane] = (),
        scale_rms_m: float = float("nan"),
        metric: bool = True,
        unposed: Sequence[str] = (),
        held_out: Sequence[str] = (),
    ) -> None:
        self.gaussians = gaussians
        self._mesh = mesh
        self.cameras = dict(cameras or {})
        self.patches = list(patches)
        self.planes = list(planes)
        self.scale_rms_m = float(scale_rms_m)
        self.metric = bool(metric)
        self.unposed = tuple(unposed)
        self.held_out = tuple(held_out)

    def __repr__(self) -> str:
        faces = f"{len(self._mesh.faces)} triangles" if self._mesh is not None else "no mesh"
        return f"Reconstruction({len(self.gaussians)} Gaussians, {faces}, {len(self.cameras)} cameras)"

    @property
    def has_mesh(self) -> bool:
        """Whether there is a mesh."""
        return self._mesh is not None

    @property
    def mesh(self) -> Mesh:
        """The surface.

        Raises:
            ValueError: if this reconstruction has none.
        """
        if self._mesh is None:
            raise ValueError(
                "this reconstruction has no mesh, and line of sight, normals and mirror points need one: give "
                "Reconstruction.from_files a mesh=, or colmap= with the camera poses to fuse one from depth maps"
            )
        return self._mesh

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write everything to ``folder`` (one safetensors file, replaced at once)."""
        header = {
            "format": FORMAT,
            "cameras": {
                name: {
                    "kind": c.kind, "size": [c.width, c.height], "lens": [c.fx, c.fy, c.cx, c.cy],
                    "world_to_camera": c.world_to_camera.tolist(),
                }
                for name, c in self.cameras.items()
            },
            "patches": [{"normal": p.normal.tolist(), "offset": p.offset, "area": p.area} for p in self.patches],
            "planes": [_plane_header(p) for p in self.planes],
            "scale_rms_m": None if np.isnan(self.scale_rms_m) else self.scale_rms_m,
            "metric": self.metric, "unposed": self.unposed, "held_out": self.held_out,
        }  # fmt: skip
        arrays = _gaussian_arrays(self.gaussians) | _plane_arrays(self.planes)
        arrays |= {f"patch_{k}": p.faces.astype(np.int64) for k, p in enumerate(self.patches)}
        if self._mesh is not None:
            arrays |= {"vertices": self._mesh.vertices, "faces": self._mesh.faces}
        _write(Path(folder) / FILE, header, arrays)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Reconstruction:
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: if the folder holds no reconstruction, or the file is damaged or of another format.
        """
        path = Path(folder) / FILE
        if not path.is_file():
            raise ValueError(
                f"folder: {folder} holds no {FILE}; expected a folder that Reconstruction.save wrote"
            )
        header, arrays = _read(path)
        if header.get("format") != FORMAT:
            raise ValueError(f"folder: {path} has format {header.get('format')}, this version reads {FORMAT}")
        try:
            cameras = {
                name: Camera(
                    c["kind"],
                    c["size"][0],
                    c["size"][1],
                    np.array(c["world_to_camera"]),
                    **dict(zip(("fx", "fy", "cx", "cy"), c["lens"], strict=True)),
                )  # fmt: skip
                for name, c in header["cameras"].items()
            }
            patches = [
                PlanarPatch(np.array(p["normal"]), p["offset"], arrays[f"patch_{k}"], p["area"])
                for k, p in enumerate(header["patches"])
            ]
            rms = header["scale_rms_m"]
            return cls(
                _gaussians(arrays),
                Mesh(arrays["vertices"], arrays["faces"]) if "faces" in arrays else None,
                cameras,
                patches=patches,
                planes=_planes(header["planes"], arrays),
                scale_rms_m=float("nan") if rms is None else rms,
                metric=header["metric"],
                unposed=header["unposed"],
                held_out=header["held_out"],
            )
        except (KeyError, TypeError) as error:
            raise ValueError(f"folder: {path} is incomplete: {error!r} does not fit") from error

    @classmethod
    def from_files(
        cls,
        ply: str | os.PathLike[str],
        mesh: Mesh | str | os.PathLike[str] | None = None,
        colmap: str | os.PathLike[str] | None = None,
        *,
        config: ReconstructionConfig | None = None,
        progress: Progress | None = None,
        device: Any = None,
    ) -> Reconstruction:
        """Your own splats: skips stage 1. Splats, mesh and poses must share one metric, z-up frame.

        Args:
            ply: splats in the INRIA PLY layout.
            mesh: a :class:`Mesh` or a mesh file (PLY, OBJ).
            colmap: a COLMAP model folder (``.bin`` or ``.txt``) with the camera poses. Without ``mesh``, one is fused
                from depth maps rendered at these poses. With neither, :attr:`mesh` raises when it is needed.

        Raises:
            FileNotFoundError, ValueError: if a file is missing, damaged, or no surface can be fused.
        """
        gaussians = Gaussians.load_ply(ply)
        cameras = sfm.read_colmap(colmap).cameras if colmap is not None else {}
        config = config or ReconstructionConfig()
        patches: list[PlanarPatch] = []
        if mesh is None and cameras:
            mesh, patches = fuse_gaussians(
                gaussians, list(cameras.values()), config=config, progress=progress, device=device
            )
        elif mesh is not None:
            mesh = mesh if isinstance(mesh, Mesh) else _mesh_from_file(mesh)
            patches = surface.planar_patches(mesh, distance_m=0.01, min_area_m2=config.min_patch_m2)
        return cls(gaussians, mesh, cameras, patches=patches)


def reconstruct(
    photos: Any,
    *,
    workspace: str | os.PathLike[str],
    known_positions: Mapping[str, Any] | None = None,
    held_out: Sequence[str] = (),
    iterations: int | None = None,
    config: ReconstructionConfig | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    device: Any = None,
) -> Reconstruction:
    """Geometry of a static place from photos of it.

    Args:
        photos: a folder, or a sequence of image files: one size, one undistorted camera.
        workspace: folder of unfinished and finished steps; a stopped run continues from it.
        known_positions: photo name to surveyed camera position (3,) [m], three or more that are not on a line. Without
            them scale and axes are assumed: median viewing distance 3 m, z against the mean "down" of the photos.
        held_out: names of photos that get a pose but that the Gaussians are not fitted to.
        iterations: of the photometric refinement; default: the configuration's.
        config: all other settings.
        seed: seed of every random draw.
        progress: ``progress(stage, done, total)``.
        device: Warp device of the refinement and the depth maps.

    Raises:
        ValueError: for bad photos or positions (see :func:`~warprrf.geometry.sfm.structure_from_motion` and
            :func:`~warprrf.geometry.sfm.align_to_known`).
        ImportError: if the extra ``photos`` is not installed.
    """
    config = config or ReconstructionConfig()
    if iterations is not None:
        config = replace(config, refine=replace(config.refine, iterations=iterations))
    report = progress or (lambda stage, done, total: None)
    named = sfm.find_photos(photos)
    skipped = set(sfm.match_names("held_out", held_out, list(named)))
    if known_positions is not None:
        sfm.match_names("known_positions", known_positions, list(named))
    steps = _Steps(Path(workspace))

    sparse = sfm.structure_from_motion(
        photos,
        workspace=workspace,
        max_features=config.max_features,
        pairs=config.pairs,
        seed=seed,
        progress=progress,
    )
    sparse = (
        sfm.align_to_known(sparse, known_positions) if known_positions is not None else _assumed_scale(sparse)
    )
    cameras = {n: c for n, c in sparse.cameras.items() if n not in skipped}
    if not cameras:
        raise ValueError(
            f"held_out: all {len(sparse.cameras)} posed photos are held out; none is left to fit to"
        )

    before = [
        (Path(workspace) / "sfm" / "photos.json").read_text(),
        [[n, c.world_to_camera.tolist()] for n, c in sparse.cameras.items()],
        sorted(skipped),
        asdict(config),
        seed,
    ]
    start_key = _fingerprint(before)
    images: list[np.ndarray] = []

    def photos_of(cameras: Mapping[str, Camera]) -> list[np.ndarray]:
        if not images:
            images.extend(read_photo(named[n]) for n in cameras)
        return images

    stored = steps.load("start", start_key)
    if stored is None:
        report("planes", 0, 5)
        planes, start = _start(sparse, cameras, photos_of(cameras), config, seed, report, device)
        steps.save("start", start_key, {"planes": [_plane_header(p) for p in planes]},
                   _gaussian_arrays(start) | _plane_arrays(planes))  # fmt: skip
    else:
        header, arrays = stored
        planes, start = _planes(header["planes"], arrays), _gaussians(arrays)

    stored = steps.load("refined", start_key)
    if stored is None:
        gaussians = refine(
            start,
            photos_of(cameras),
            list(cameras.values()),
            config=config.refine,
            planes=planes,
            seed=seed,
            progress=progress,
            checkpoint=steps.only(f"refine-{start_key[:12]}.checkpoint", "refine-*.checkpoint"),
            device=device,
        )
        steps.save("refined", start_key, {}, _gaussian_arrays(gaussians))
    else:
        gaussians = _gaussians(stored[1])
    images.clear()

    stored = steps.load("surface", start_key)
    if stored is None:
        mesh, patches = fuse_gaussians(
            gaussians,
            list(sparse.cameras.values()),
            planes=planes,
            config=config,
            progress=progress,
            device=device,
        )
        header = {
            "patches": [{"normal": p.normal.tolist(), "offset": p.offset, "area": p.area} for p in patches]
        }
        arrays = {f"patch_{k}": p.faces for k, p in enumerate(patches)}
        steps.save("surface", start_key, header, arrays | {"vertices": mesh.vertices, "faces": mesh.faces})
    else:
        header, arrays = stored
        mesh = Mesh(arrays["vertices"], arrays["faces"])
        patches = [
            PlanarPatch(np.array(p["normal"]), p["offset"], arrays[f"patch_{k}"], p["area"])
            for k, p in enumerate(header["patches"])
        ]
    return Reconstruction(
        gaussians,
        mesh,
        sparse.cameras,
        patches=patches,
        planes=planes,
        scale_rms_m=sparse.scale_rms_m,
        metric=sparse.metric,
        unposed=sparse.unposed,
        held_out=sorted(skipped),
    )


def fuse_gaussians(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    *,
    planes: Sequence[Plane] = (),
    config: ReconstructionConfig | None = None,
    progress: Progress | None = None,
    device: Any = None,
) -> tuple[Mesh, list[PlanarPatch]]:
    """Mesh of Gaussians from depth maps rendered at ``cameras``, and its planar patches; planes known beforehand are
    what the mesh snaps to first."""
    config = config or ReconstructionConfig()
    report = progress or (lambda stage, done, total: None)
    small, depths = _depth_maps(gaussians, cameras, config, report, device)
    report("surface", 0, 4)
    mesh = surface.fuse_depth(depths, small, voxel_m=config.voxel_m)
    report("surface", 1, 4)
    patches = surface.planar_patches(
        mesh, planes=planes, distance_m=config.patch_distance_m, min_area_m2=config.min_patch_m2
    )
    flat = surface.flatten(mesh, patches)
    report("surface", 2, 4)
    result = surface.simplify(flat, patches)
    report("surface", 3, 4)
    if config.complete:
        result = _complete(*result, small, depths, planes, config)
    report("surface", 4, 4)
    return result


def completed(
    reconstruction: Reconstruction,
    *,
    config: ReconstructionConfig | None = None,
    progress: Progress | None = None,
    device: Any = None,
) -> Reconstruction:
    """``reconstruction`` with its mesh completed, as :func:`reconstruct` does: for one saved without that.

    Depth maps are rendered again at its cameras. Without cameras, or where its mesh has no planes along three
    perpendicular directions, the mesh stays as it is.

    Raises:
        ValueError: if there is no mesh.
    """
    config = config or ReconstructionConfig()
    report = progress or (lambda stage, done, total: None)
    mesh, patches = reconstruction.mesh, reconstruction.patches
    if reconstruction.cameras:
        cameras = list(reconstruction.cameras.values())
        small, depths = _depth_maps(reconstruction.gaussians, cameras, config, report, device)
        mesh, patches = _complete(mesh, patches, small, depths, reconstruction.planes, config)
    return Reconstruction(
        reconstruction.gaussians,
        mesh,
        reconstruction.cameras,
        patches=patches,
        planes=reconstruction.planes,
        scale_rms_m=reconstruction.scale_rms_m,
        metric=reconstruction.metric,
        unposed=reconstruction.unposed,
        held_out=reconstruction.held_out,
    )


def _complete(
    mesh: Mesh,
    patches: list[PlanarPatch],
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    planes: Sequence[Plane],
    config: ReconstructionConfig,
) -> tuple[Mesh, list[PlanarPatch]]:
    return complete(
        mesh, patches, cameras, depths, planes=planes,
        cell_m=config.complete_cell_m, min_patch_m2=config.min_patch_m2,
    )  # fmt: skip


def _depth_maps(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    config: ReconstructionConfig,
    report: Progress,
    device: Any,
) -> tuple[list[Camera], list[np.ndarray]]:
    """Smaller cameras spread over all ``cameras``, and their depths, 0 where no Gaussian is reliable."""
    chosen = list(cameras)
    if len(chosen) > config.depth_views:
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, config.depth_views).round().astype(int)]
    small, depths = [], []
    for k, camera in enumerate(chosen):
        report("depth", k, len(chosen))
        view = camera.resized(
            max(1, camera.width // config.depth_downscale), max(1, camera.height // config.depth_downscale)
        )
        out = render(gaussians, view, features=np.zeros((len(gaussians), 1), dtype=np.float32), device=device)
        with np.errstate(invalid="ignore"):
            solid = (out.alpha >= config.alpha) & (
                np.abs(out.depth - out.peak) <= config.depth_spread * out.peak
            )
        depths.append(np.where(solid, out.depth, 0.0))
        small.append(view)
    report("depth", len(chosen), len(chosen))
    return small, depths


def read_photo(path: str | os.PathLike[str]) -> np.ndarray:
    """A photo as RGB in [0, 1], shape ``(H, W, 3)`` float32.

    Raises:
        ValueError: if the file does not read as an image.
    """
    image = require("PIL.Image", extra="photos")
    try:
        with image.open(path) as photo:
            return np.asarray(photo.convert("RGB"), dtype=np.float32) / 255
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"photos: {path} does not read as an image: {error}") from error


def _start(
    sparse: sfm.SparseModel,
    cameras: Mapping[str, Camera],
    images: Sequence[np.ndarray],
    config: ReconstructionConfig,
    seed: int,
    report: Progress,
    device: Any = None,
) -> tuple[list[Plane], Gaussians]:
    """Planes of the sparse points and the Gaussians that refinement starts from."""
    if len(sparse.points) < 3:
        raise ValueError(
            f"photos: only {len(sparse.points)} points were reconstructed; more overlap is needed"
        )
    keep = surface.clean_points(
        sparse.points,
        reprojection_error=sparse.reprojection_error,
        track_length=sparse.track_length,
        max_reprojection_error=config.max_reprojection_error,
    )
    if keep.sum() < 3:  # a handful of photos: few points are seen three times
        keep[:] = True
    sparse = sparse.subset(keep)
    normals = surface.estimate_normals(sparse.points, sparse.viewpoints())
    planes = surface.detect_room_planes(
        sparse.points,
        normals,
        sparse.viewpoints(),
        distance_m=config.plane_distance_m,
        min_points=config.plane_points,
        seed=seed,
    )
    planes = aligned(planes, sparse.points) if sparse.metric else planes
    eyes = np.array([c.position for c in sparse.cameras.values()])[sparse.track_camera]
    targets = np.repeat(sparse.points, sparse.track_length, axis=0)
    planes = occupancy(planes, sparse.points, eyes, targets, cell_m=config.cell_m)
    report("planes", 1, 5)
    if config.sweep and len(cameras) > 2 and planes:
        photos = sweep.Photos.upload(list(cameras.values()), images, device)
        planes = sweep.proven_cells(planes, sparse.points, photos)
        report("planes", 2, 5)
        if sparse.metric:  # else z is not up
            levels = []
            for k, up in enumerate((True, False)):
                levels += sweep.level_planes(
                    planes, sparse.points, photos, eyes, targets, cell_m=config.cell_m, up=up
                )
                report("planes", 3 + k, 5)
            planes = sweep.joined(planes, levels)
    planes = seen_cells(meeting(planes), list(sparse.cameras.values()))
    start = initial_gaussians(
        sparse.points, sparse.colors, normals, planes, list(cameras.values()), images, count=config.gaussians
    )
    report("planes", 5, 5)
    return planes, start


def _assumed_scale(sparse: sfm.SparseModel) -> sfm.SparseModel:
    """``sparse`` with z up and a plausible size, where nobody measured either."""
    poses = list(sparse.cameras.values())
    up = -np.mean([c.rotation[1] for c in poses], axis=0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 1e-6 else np.array([0.0, 0.0, 1.0])
    ahead = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([ahead, np.cross(up, ahead), up])
    positions = np.array([c.position for c in poses])
    gap = np.linalg.norm(
        np.repeat(sparse.points, sparse.track_length, axis=0) - positions[sparse.track_camera], axis=1
    )
    scale = ASSUMED_DISTANCE_M / float(np.median(gap)) if len(gap) else 1.0
    return sfm.transformed(sparse, scale, rotation, -scale * rotation @ positions.mean(axis=0))


def _mesh_from_file(path: str | os.PathLike[str]) -> Mesh:
    from warprrf.geometry.meshio import read_mesh

    content = read_mesh(path)
    return Mesh(content.vertices, content.faces)


# ------------------------------------------------------------------------------------------------ files


class _Steps:
    """Finished steps of a run: one file each, valid for one fingerprint."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def save(self, name: str, key: str, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        _write(self.folder / f"{name}.safetensors", {**header, "key": key}, arrays)

    def load(self, name: str, key: str) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
        path = self.folder / f"{name}.safetensors"
        if not path.is_file():
            return None
        header, arrays = _read(path)
        return (header, arrays) if header.get("key") == key else None

    def only(self, name: str, pattern: str) -> Path:
        """The path of ``name``; files of the same pattern that belong to other fingerprints are removed."""
        for path in self.folder.glob(pattern):
            if path.name != name:
                path.unlink()
        return self.folder / name


def _fingerprint(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def _write(path: Path, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    from safetensors.numpy import save_file

    with replacing(path) as temporary:
        save_file(
            {k: np.ascontiguousarray(v) for k, v in arrays.items()},
            temporary,
            metadata={"header": json.dumps(header)},
        )


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})["header"])
            return header, {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, KeyError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is damaged or not ours: {error}; delete it, or restore it") from error


def _gaussian_arrays(g: Gaussians) -> dict[str, np.ndarray]:
    return {k: getattr(g, k) for k in ("means", "quaternions", "scales", "opacities", "sh")}


def _gaussians(arrays: Mapping[str, np.ndarray]) -> Gaussians:
    return Gaussians(*(arrays[k] for k in ("means", "quaternions", "scales", "opacities", "sh")))


def _plane_header(plane: Plane) -> dict[str, Any]:
    return {
        "normal": plane.normal.tolist(), "offset": plane.offset, "rms_m": plane.rms_m, "axes": plane.axes.tolist(),
        "corner": plane.corner.tolist(), "cell_m": plane.cell_m,
    }  # fmt: skip


def _plane_arrays(planes: Sequence[Plane]) -> dict[str, np.ndarray]:
    return {f"plane_{k}_inliers": p.inliers for k, p in enumerate(planes)} | {
        f"plane_{k}_occupied": p.occupied for k, p in enumerate(planes)
    }


def _planes(headers: Sequence[Mapping[str, Any]], arrays: Mapping[str, np.ndarray]) -> list[Plane]:
    return [
        Plane(
            np.array(h["normal"]), h["offset"], check_array("inliers", arrays[f"plane_{k}_inliers"], None, np.int64),
            h["rms_m"], np.array(h["axes"]), np.array(h["corner"]), h["cell_m"], arrays[f"plane_{k}_occupied"],
        )
        for k, h in enumerate(headers)
    ]  # fmt: skip
