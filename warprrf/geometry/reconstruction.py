"""What stage 1 gives: the geometry of a place, on disk and in memory, from photos or from your own files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf import tensor_files
from warprrf.checks import (
    LARGEST_M,
    Expected,
    check_arrays,
    check_number,
    check_similarity,
    check_type,
    checked,
    index_to,
    lengths,
)
from warprrf.device import DeviceLike, Progress
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.posed.sfm import read_colmap
from warprrf.geometry.photos.posed.sparse import known_similarity
from warprrf.geometry.photos.posed.undistort import Lens, lenses_in_use
from warprrf.geometry.photos.surface.fusion import depth_maps, depth_views, fuse_maps
from warprrf.geometry.planar_patches import PlanarPatches, planar_patches
from warprrf.geometry.planes import Plane
from warprrf.geometry.report import write_report
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.tensor_files import named

GAUSSIANS = tuple(f.name for f in fields(Gaussians))
MESH = ("vertices", "faces", "face_colours", "face_label")
PATCHES = tuple(f.name for f in fields(PlanarPatches) if f.init and f.name != "mesh")
PATCH_ARRAYS = {
    "patch_face_patch": index_to("P", "F", -1),
    "patch_normal": Expected("P 3", -1.001, 1.001),
    "patch_offset": lengths("P"),
    "patch_area": Expected("P", 0.0, LARGEST_M**2),
    "patch_group": Expected("P", -1, kind="iu"),
    "patch_first": index_to("F", "F"),
}
"""What the arrays of patches must be: F faces, P patches."""
PLANE_ARRAYS = {
    "planes": lengths("K 8"),
    "plane_shapes": Expected("K 2", 0, 2**15, kind="iu"),
    "plane_cells": Expected("C", kind="b"),
    "plane_plain": Expected("K", kind="b"),
}
"""What the arrays of planes must be: K planes, C cells of all of them."""
Arrays = dict[str, np.ndarray]

FILE = "reconstruction.safetensors"
FORMAT = 2  # 1 held a list of patches, each with its faces


@checked
class Reconstruction:
    """Geometry of a place, frozen.

    Attributes:
        gaussians: the Gaussians; an error where there are none, as in what a mesh alone gave.
        cameras: photo name to :class:`Camera`; empty for splats without poses.
        patches: planar patches of the mesh, largest first; None without a mesh.
        scale_rms_m: rms distance left between surveyed and reconstructed camera positions [m]; NaN without survey.
        metric: whether lengths are metres (else they are an assumed scale).
        unposed: names of photos without a pose.
        causes: why each of them has none, by name, where that is known.
        pieces: names of photos that were posed together, the largest piece first, which ``cameras`` are of. The others share
            no view with it; their COLMAP models are ``sfm/model-2`` and so on in the workspace, fit for ``poses=``.
        photos: image files of the cameras, by name, as the Gaussians were fitted to them.
        held_out: names of photos that the Gaussians were not fitted to.
        guessed: what nobody measured and the photos do not show, a sentence each.
        lenses: photo name to the :class:`~warprrf.geometry.photos.posed.undistort.Lens` that took it; ``cameras`` are those of the
            photos undistorted, turned upright and reduced.
    """

    def __init__(
        self,
        gaussians: Gaussians | None = None,
        mesh: Mesh | None = None,
        cameras: Mapping[str, Camera] | None = None,
        *,
        patches: PlanarPatches | None = None,
        scale_rms_m: float = float("nan"),
        metric: bool = True,
        unposed: Sequence[str] = (),
        held_out: Sequence[str] = (),
        guessed: Sequence[str] = (),
        lenses: Mapping[str, Lens] | None = None,
        causes: Mapping[str, str] | None = None,
        pieces: Sequence[Sequence[str]] = (),
        photos: Mapping[str, Path] | None = None,
    ) -> None:
        if gaussians is None and mesh is None:
            raise ValueError("gaussians, mesh: got neither, expected Gaussians, a mesh or both")
        self._gaussians = gaussians
        self._mesh = mesh
        self.cameras = dict(cameras or {})
        self.patches = patches
        self.scale_rms_m = scale_rms_m
        self.metric = metric
        self.unposed = tuple(unposed)
        self.held_out = tuple(held_out)
        self.guessed = tuple(guessed)
        self.lenses = dict(lenses or {})
        self.causes = dict(causes or {})
        for piece in pieces:
            if isinstance(piece, str) or not isinstance(piece, Sequence):
                raise TypeError(
                    f"pieces: got {piece!r} among them, expected each to be a sequence of photos' names"
                )
        self.pieces = tuple(map(tuple, pieces))
        for name, file in (photos or {}).items():
            if not isinstance(file, str | os.PathLike):
                raise TypeError(f"photos: got {type(file).__name__} for {name!r}, expected an image file")
        self.photos = {name: Path(file) for name, file in (photos or {}).items()}

    def __repr__(self) -> str:
        faces = f"{len(self._mesh.faces)} triangles" if self._mesh is not None else "no mesh"
        splats = f"{len(self._gaussians)} Gaussians" if self._gaussians is not None else "no Gaussians"
        return f"Reconstruction({splats}, {faces}, {len(self.cameras)} cameras)"

    @property
    def has_gaussians(self) -> bool:
        """Whether there are Gaussians."""
        return self._gaussians is not None

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians.

        Raises:
            ValueError: if this reconstruction has none.
        """
        if self._gaussians is None:
            raise ValueError(
                "this reconstruction is a mesh alone and has no Gaussians, which pictures need: give "
                "Reconstruction.from_files a ply=, or make it from photos (reconstruct)"
            )
        return self._gaussians

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

    def transformed(
        self, *, scale: float = 1.0, rotation: ArrayLike | None = None, shift: ArrayLike = (0.0, 0.0, 0.0)
    ) -> Reconstruction:
        """Everything at ``scale rotation x + shift``: Gaussians, mesh, cameras and patches.

        Args:
            scale: metres of the new frame for each of this one.
            rotation: shape ``(3, 3)``; none by default. z must stay up for spectra and radio maps to mean what they say.
            shift: shape ``(3,)`` [m].

        Raises:
            ValueError: for a scale that is not positive or a matrix that is no rotation.

        Example:
            >>> turned = rec.transformed(rotation=[[0, -1, 0], [1, 0, 0], [0, 0, 1]])  # doctest: +SKIP
        """
        number, turn, moved = check_similarity(scale, rotation, shift)
        how: dict[str, Any] = {"scale": number, "rotation": turn, "shift": moved}
        patches = None if self.patches is None else self.patches.transformed(**how)
        mesh = None if self._mesh is None else self._mesh.transformed(**how)
        return Reconstruction(
            None if self._gaussians is None else self._gaussians.transformed(**how),
            mesh if patches is None else patches.mesh,
            {name: camera.transformed(**how) for name, camera in self.cameras.items()},
            patches=patches, scale_rms_m=number * self.scale_rms_m, metric=self.metric, unposed=self.unposed,
            held_out=self.held_out, guessed=self.guessed, lenses=self.lenses, causes=self.causes, pieces=self.pieces,
            photos=self.photos,
        )  # fmt: skip

    def aligned(self, known_positions: Mapping[str, ArrayLike]) -> Reconstruction:
        """In the frame and the metres of surveyed camera positions, by the similarity that meets them best.

        It brings photos into the frame in which transmitter and receivers were measured: survey three cameras or more
        with the same instrument. :attr:`scale_rms_m` says how well they are met.

        Args:
            known_positions: photo name (or its file name, where that is unique) to camera position (3,) [m], three or more
                that are not on a line.

        Raises:
            ValueError: for fewer, a name that is no photo, or photos without a pose.

        Example:
            >>> rec = rec.aligned({"a.jpg": (0, 0, 1.5), "b.jpg": (4, 0, 1.5), "c.jpg": (4, 3, 1.2)})  # doctest: +SKIP
        """
        scale, rotation, shift, rms_m = known_similarity(self.cameras, self.unposed, known_positions)
        moved = self.transformed(scale=scale, rotation=rotation, shift=shift)
        moved.scale_rms_m, moved.metric = rms_m, True
        # Known now:
        moved.guessed = tuple(
            line for line in self.guessed if not line.startswith(("scale:", "up:", "floor:"))
        )
        return moved

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
            "scale_rms_m": None if np.isnan(self.scale_rms_m) else self.scale_rms_m,
            "metric": self.metric, "unposed": self.unposed, "held_out": self.held_out,
            "guessed": self.guessed, "causes": self.causes, "pieces": self.pieces,
            "photos": {name: str(file) for name, file in self.photos.items()},
            "lenses": [{**asdict(lens), "photos": names} for lens, names in lenses_in_use(self.lenses).items()],
            "labels": () if self._mesh is None else self._mesh.labels,
        }  # fmt: skip
        arrays = {} if self._gaussians is None else of_gaussians(self._gaussians)
        if self.patches is not None:
            arrays |= of_patches(self.patches)
        elif self._mesh is not None:
            arrays |= of_mesh(self._mesh)
        tensor_files.write(Path(folder) / FILE, arrays, header, None)

    def report(
        self,
        path: str | os.PathLike[str],
        *,
        progress: Progress | None = None,
        device: DeviceLike = None,
    ) -> None:
        """Write what went in, what came out and how far it can be trusted as one HTML page, pictures included.

        Cameras from above, held-out photos beside their renderings, the mesh from four sides and coloured by how often
        each surface was seen, lenses, photos without a pose, and what was guessed::

            rec.report("room.html")

        Args:
            path: file to write.
            progress: called as ``progress("report", done, total)``.
            device: Warp device.

        Raises:
            OSError: if ``path`` cannot be written.
            ImportError: if Pillow is not installed.
        """
        write_report(path, self, self._gaussians, self._mesh, progress=progress, device=device)

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
        arrays, header = tensor_files.read(path, None)
        if header.get("format") != FORMAT:
            raise ValueError(
                f"folder: {path} has format {header.get('format')}, this version reads {FORMAT}; make it again from "
                "its photos (reconstruct)"
            )
        with named(path, "damaged or incomplete"):
            names = header.get("labels", ())
            patches = to_patches(arrays, names) if any(n.startswith("patch") for n in arrays) else None
            mesh = None if patches is None else patches.mesh
            if mesh is None and "faces" in arrays:
                mesh = to_mesh(arrays, names)
            splats = None if mesh is not None and "means" not in arrays else to_gaussians(arrays)
            rms = header["scale_rms_m"]
            check_type("metric", header["metric"], bool)
            guessed = header.get("guessed", ())
            causes, photos = header.get("causes", {}), header.get("photos", {})
            pieces = header.get("pieces", ())
            words = (*causes.values(), *photos.values(), *chain.from_iterable(pieces))
            for name in (*header["unposed"], *header["held_out"], *guessed, *words):
                check_type("unposed, held_out, guessed, causes, pieces, photos", name, str)
            return cls(
                splats,
                mesh,
                {name: _camera(camera) for name, camera in header["cameras"].items()},
                patches=patches,
                scale_rms_m=float("nan") if rms is None else check_number("scale_rms_m", rms, 0.0),
                metric=header["metric"],
                unposed=header["unposed"],
                held_out=header["held_out"],
                guessed=guessed,
                lenses=_lenses(header.get("lenses", ())),
                causes=causes,
                pieces=pieces,
                photos=photos,
            )

    @classmethod
    def from_files(
        cls,
        ply: str | os.PathLike[str] | None = None,
        mesh: Mesh | str | os.PathLike[str] | None = None,
        colmap: str | os.PathLike[str] | None = None,
        *,
        config: ReconstructionConfig | None = None,
        progress: Progress | None = None,
        device: DeviceLike = None,
    ) -> Reconstruction:
        """Your own geometry: skips stage 1. Splats, mesh and poses must share one metric, z-up frame.

        A mesh alone is enough for line of sight, mirrors and ``bistatic`` fields.

        Args:
            ply: splats in the INRIA PLY layout.
            mesh: a :class:`Mesh` or a mesh file, which is read by :meth:`Mesh.load` (call that for another unit or axis).
            colmap: a COLMAP model folder (``.bin`` or ``.txt``) with the camera poses. Without ``mesh``, one is fused
                from depth maps of ``ply`` rendered at these poses. With neither, :attr:`mesh` raises when it is needed.

        Raises:
            FileNotFoundError, ValueError: if a file is missing, damaged, or no surface can be fused; if there is
                neither ``ply`` nor ``mesh``.
        """
        if ply is None and mesh is None:
            raise ValueError("ply, mesh: got neither, expected a file of splats, a mesh or both")
        gaussians = None if ply is None else Gaussians.load_ply(ply)
        cameras = read_colmap(colmap).cameras if colmap is not None else {}
        patches: PlanarPatches | None = None
        if mesh is not None:
            mesh = mesh if isinstance(mesh, Mesh) else Mesh.load(mesh)
            patches = planar_patches(mesh)
        elif cameras and gaussians is not None:
            config, poses = config or ReconstructionConfig(), list(cameras.values())
            depths = depth_maps(gaussians, poses, config=config, progress=progress, device=device)
            views = depth_views(poses, config.surface)
            patches, _ = fuse_maps(views, depths, config=config, progress=progress)
            mesh = patches.mesh
        return cls(gaussians, mesh, cameras, patches=patches)


def _lenses(stored: Sequence[Mapping[str, Any]]) -> dict[str, Lens]:
    """Lenses by photo, from a list of lenses with their photos."""
    found: dict[str, Lens] = {}
    for entry in stored:
        values = dict(entry)
        names = values.pop("photos")
        found |= dict.fromkeys(names, Lens(**values))
    return dict(sorted(found.items()))


def _camera(stored: Mapping[str, Any]) -> Camera:
    width, height = stored["size"]
    lens = dict(zip(("fx", "fy", "cx", "cy"), stored["lens"], strict=True))
    return Camera(stored["kind"], width, height, np.array(stored["world_to_camera"]), **lens)


def of_gaussians(gaussians: Gaussians) -> Arrays:
    """Arrays of Gaussians."""
    return {name: getattr(gaussians, name) for name in GAUSSIANS}


def to_gaussians(arrays: Arrays) -> Gaussians:
    """What :func:`of_gaussians` took apart."""
    return Gaussians(*(arrays[name] for name in GAUSSIANS))


def of_planes(planes: Sequence[Plane]) -> Arrays:
    """Arrays of planes and their cells; the points that they were fitted to are left out."""
    rows = [[*p.normal, p.offset, p.rms_m, *p.corner, p.cell_m] for p in planes]
    cells = [p.occupied.ravel() for p in planes]
    return {
        "planes": np.array(rows, dtype=np.float64).reshape(-1, 8),
        "plane_shapes": np.array([p.occupied.shape for p in planes], dtype=np.int64).reshape(-1, 2),
        "plane_cells": np.concatenate(cells) if cells else np.zeros(0, dtype=bool),
        "plane_plain": np.array([p.plain for p in planes], dtype=bool),
    }


def to_planes(arrays: Arrays) -> list[Plane]:
    """What :func:`of_planes` took apart."""
    check_arrays(arrays, PLANE_ARRAYS, C=int(np.prod(arrays["plane_shapes"], axis=-1).sum()))
    shapes = arrays["plane_shapes"]
    cells = np.split(arrays["plane_cells"], np.cumsum(shapes.prod(axis=1))[:-1])
    planes = []
    for row, shape, own, plain in zip(arrays["planes"], shapes, cells, arrays["plane_plain"], strict=False):
        offset, rms_m, cell_m = row[[3, 4, 7]].tolist()
        grid = Plane(row[:3], offset, rms_m=rms_m, corner=row[5:7], cell_m=cell_m, plain=bool(plain))
        planes.append(replace(grid, occupied=own.reshape(shape)))
    return planes


def of_mesh(mesh: Mesh) -> Arrays:
    """Arrays of a mesh; its labels are left to the header."""
    held = {name: getattr(mesh, name) for name in MESH}
    return {name: array for name, array in held.items() if array is not None}


def to_mesh(arrays: Arrays, labels: Sequence[str] = ()) -> Mesh:
    """What :func:`of_mesh` took apart."""
    known = {name: arrays.get(name) for name in MESH[2:]}
    return Mesh(arrays["vertices"], arrays["faces"], labels=labels, **known)


def of_patches(patches: PlanarPatches) -> Arrays:
    """Arrays of a mesh and its planar patches."""
    own = {f"patch_{name}": np.asarray(getattr(patches, name)) for name in PATCHES}
    return own | of_mesh(patches.mesh)


def to_patches(arrays: Arrays, labels: Sequence[str] = ()) -> PlanarPatches:
    """What :func:`of_patches` took apart."""
    mesh = to_mesh(arrays, labels)
    if "patch_once" in arrays:  # older files say which faces repeat none, not which ones others repeat
        itself = arrays["patch_once"] | (arrays["patch_face_patch"] < 0)
        arrays = arrays | {"patch_first": np.where(itself, np.arange(len(itself)), mesh.first_at_place)}
    check_arrays(arrays, PATCH_ARRAYS, F=len(mesh.faces))
    own: dict[str, Any] = {name: arrays[f"patch_{name}"] for name in PATCHES}
    own |= {name: own[name].item() for name in ("tolerance_m", "two_sided")}
    check_number("patch_tolerance_m", own["tolerance_m"], 0.0, LARGEST_M)
    return PlanarPatches(mesh, **own)
