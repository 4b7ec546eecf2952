"""What stage 1 gives: the geometry of a place, on disk and in memory, from photos or from your own files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import Progress
from warprrf.geometry import geometry_files as stored
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_files import read_mesh
from warprrf.geometry.photos import sfm, surface
from warprrf.geometry.photos.config import ReconstructionConfig
from warprrf.geometry.photos.fusion import complete_seen, fuse_gaussians
from warprrf.geometry.photos.planes import Plane
from warprrf.geometry.photos.surface import PlanarPatch
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians

FILE = "reconstruction.safetensors"
FORMAT = 1


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
            "scale_rms_m": None if np.isnan(self.scale_rms_m) else self.scale_rms_m,
            "metric": self.metric, "unposed": self.unposed, "held_out": self.held_out,
        }  # fmt: skip
        stored.write(
            Path(folder) / FILE,
            header,
            gaussians=self.gaussians,
            planes=self.planes,
            patches=self.patches,
            mesh=self._mesh,
        )

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
        found = stored.read(path)
        header = found.header
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
            rms = header["scale_rms_m"]
            return cls(
                found.gaussians,
                found.mesh if found.has_mesh else None,
                cameras,
                patches=found.patches,
                planes=found.planes,
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


def completed(
    reconstruction: Reconstruction,
    *,
    config: ReconstructionConfig | None = None,
    progress: Progress | None = None,
    device: Any = None,
) -> Reconstruction:
    """``reconstruction`` with its mesh completed, as :func:`warprrf.reconstruct` does: for one saved without that.

    Depth maps are rendered again at its cameras. Without cameras, or where its mesh has no planes along three
    perpendicular directions, the mesh stays as it is.

    Raises:
        ValueError: if there is no mesh.
    """
    mesh, patches = reconstruction.mesh, reconstruction.patches
    if reconstruction.cameras:
        mesh, patches = complete_seen(
            mesh,
            patches,
            reconstruction.gaussians,
            list(reconstruction.cameras.values()),
            planes=reconstruction.planes,
            config=config,
            progress=progress,
            device=device,
        )
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


def _mesh_from_file(path: str | os.PathLike[str]) -> Mesh:
    content = read_mesh(path)
    return Mesh(content.vertices, content.faces)
