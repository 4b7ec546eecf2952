"""What is fuzzed with: a small room, its spectra, fields, Gaussians and paths, made once and kept in a folder."""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from warprrf.device import require
from warprrf.geometry.mesh_files import write_mesh
from warprrf.geometry.splats.gaussians import discs_on_mesh

ROOT = Path(__file__).parents[2]
CARRIER = 300e9
TRANSMITTER = np.array([0.8, 0.9, 2.2])
SHAPE = (12, 24)
SIGMA = float(np.radians(12.0))


def box(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a box with outward normals."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return np.array(low) + corners * (np.array(high) - low), faces


class Place:
    """A room of 5 x 4 x 3 m with a block in it, and what the library makes of it.

    Args:
        folder: where its files lie; :meth:`make` writes them.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)

    def make(self) -> Place:
        """Write what is missing of the files."""
        if (self.folder / "made").exists():
            return self
        self.folder.mkdir(parents=True, exist_ok=True)
        self._make_scene()
        self.spectra.save(self.folder / "spectra.nc")
        header = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,power_db\n"
        at = ",".join(map(str, [*TRANSMITTER, *self.receivers[0]]))
        (self.folder / "readings.csv").write_text(header + f"{at},-80.0\n{at},-81.5\n")
        pictures = self.folder / "pictures"
        (pictures / "spectrum").mkdir(parents=True)
        for k in (1, 2):
            require("PIL.Image", extra="mesh").fromarray(np.full((3, 4), 90 * k, np.uint8)).save(
                pictures / "spectrum" / f"{k}.png"
            )
        (pictures / "tx_pos.csv").write_text("x,y,z\n1,2,1\n2,1,1\n")
        (pictures / "train_index.txt").write_text("1\n2\n")
        (pictures / "gateway_info.yml").write_text("position: [4, 3, 1]\norientation: [0, 0, 0, 1]\n")
        self.spectra.save(self.folder / "compact.nc", compact=True)
        for name, model, options in (
            ("bistatic", "bistatic", {}),
            ("harmonic", "rf3dgs+", {"iterations": 20}),
            ("rf3dgs", "rf3dgs", {"iterations": 20}),
        ):
            geometry = self.scene if model == "bistatic" else self.reconstruction
            wr.RadioField.fit(geometry, self.train, model, **options).save(
                self.folder / f"{name}.safetensors"
            )
        setting: dict[str, Any] = {"transmitter": TRANSMITTER, "frequency_hz": CARRIER, "shape": SHAPE}
        wr.relevance(self.scene, receivers=self.receivers[:2], **setting).save(self.folder / "relevance.json")
        self.field.radio_map(1.2, 0.8).save(self.folder / "map.nc")
        self.gaussians.save_ply(self.folder / "splats.ply")
        self.reconstruction.save(self.folder / "reconstruction")
        self.paths.save(self.folder / "paths.nc")
        self._make_photos()
        self._make_foreign()
        (self.folder / "made").touch()
        return self

    def _make_scene(self) -> None:
        shapes = ""
        walls, faces = box((0, 0, 0), (5, 4, 3))
        block = box((2.2, 1.2, -0.01), (3.0, 2.8, 2.6))
        for name, material, part in (
            ("walls", "concrete", (walls, faces[:, ::-1])),
            ("block", "marble", block),
        ):
            write_mesh(self.folder / f"{name}.ply", *part)
            shapes += (
                f'<bsdf type="diffuse" id="mat-itu_{material}"/><shape type="ply" id="{name}"><string name="filename" '
                f'value="{name}.ply"/><ref id="mat-itu_{material}" name="bsdf"/></shape>\n'
            )
        (self.folder / "scene.xml").write_text(f'<scene version="3.0.0">\n{shapes}</scene>\n')
        table = (ROOT / "data/lobby/materials.json").read_text(encoding="utf-8")
        (self.folder / "materials.json").write_text(table)

    def _make_photos(self) -> None:
        from PIL import Image

        photos = self.folder / "photos"
        photos.mkdir(exist_ok=True)
        rng = np.random.default_rng(0)
        for k, suffix in enumerate(("png", "jpg", "png")):
            pixels = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(photos / f"{k}.{suffix}")

    def _make_foreign(self) -> None:
        """What other software writes: a COLMAP model, meshes."""
        import pycolmap
        import trimesh

        model, meshes = (self.folder / name for name in ("colmap", "meshes"))
        for folder in (model, meshes):
            folder.mkdir(exist_ok=True)
        write_mesh(meshes / "mesh.ply", self.mesh.vertices, self.mesh.faces)
        for suffix in ("obj", "stl", "glb"):
            trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, process=False).export(
                meshes / f"mesh.{suffix}"
            )
        options = pycolmap.SyntheticDatasetOptions(
            num_points3D=20, num_frames_per_rig=3, camera_model_id=pycolmap.CameraModelId.PINHOLE,
            camera_width=64, camera_height=48, camera_params=[60.0, 60.0, 32.0, 24.0], num_points2D_without_point3D=0,
        )  # fmt: skip
        model_made = pycolmap.synthesize_dataset(options)
        model_made.write_binary(str(model))
        (self.folder / "colmap_text").mkdir(exist_ok=True)
        model_made.write_text(str(self.folder / "colmap_text"))

    @cached_property
    def scene(self) -> wr.Scene:
        """Walls of concrete, a block of marble."""
        return wr.Scene.load(self.folder / "scene.xml")

    @cached_property
    def mesh(self) -> wr.Mesh:
        """Its surfaces."""
        return self.scene.mesh

    @cached_property
    def receivers(self) -> np.ndarray:
        """Places in the air [m], shape ``(10, 3)``."""
        return wr.sample_receivers(self.scene, 10, clearance=0.2, seed=3)

    @cached_property
    def spectra(self) -> wr.SpectrumDataset:
        """By the exact engine; 8 for training, 2 for tests."""
        if (self.folder / "spectra.nc").exists():
            return wr.SpectrumDataset.load(self.folder / "spectra.nc")
        return wr.simulate(
            self.scene, transmitter=TRANSMITTER, receivers=self.receivers, frequency_hz=CARRIER, shape=SHAPE,
            beam_sigma_rad=SIGMA, roles=["train"] * 8 + ["test"] * 2, device="cpu",
        )  # fmt: skip

    @property
    def train(self) -> wr.SpectrumDataset:
        """The eight."""
        return self.spectra.split(8)[0]

    @property
    def test(self) -> wr.SpectrumDataset:
        """The two."""
        return self.spectra.split(8)[1]

    @cached_property
    def gaussians(self) -> wr.Gaussians:
        """Discs on the mesh."""
        return discs_on_mesh(self.mesh, 200)

    @cached_property
    def reconstruction(self) -> wr.Reconstruction:
        """Discs, mesh and one camera."""
        return wr.Reconstruction(self.gaussians, self.mesh, {"0.png": self.camera})

    @cached_property
    def camera(self) -> wr.Camera:
        """A pinhole camera at (1, 1, 1.5) that looks along +x."""
        pose = np.eye(4)
        pose[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
        pose[:3, 3] = -pose[:3, :3] @ [1.0, 1.0, 1.5]
        return wr.Camera.pinhole(16, 12, fx=10.0, fy=10.0, cx=8.0, cy=6.0, world_to_camera=pose)

    @cached_property
    def field(self) -> wr.RadioField:
        """A bistatic field."""
        return wr.RadioField.load(self.folder / "bistatic.safetensors")

    @cached_property
    def harmonic(self) -> wr.RadioField:
        """A field of RF-3DGS+."""
        return wr.RadioField.load(self.folder / "harmonic.safetensors")

    @cached_property
    def paths(self) -> wr.Paths:
        """Line of sight and mirrors to three receivers."""
        return wr.trace_paths(
            self.scene, transmitter=TRANSMITTER, receivers=self.receivers[:3], frequency_hz=CARRIER
        )

    @cached_property
    def channels(self) -> np.ndarray:
        """Random channels of two users from four antennas, shape ``(2, 4)``."""
        rng = np.random.default_rng(0)
        return rng.normal(size=(2, 4)) + 1j * rng.normal(size=(2, 4))

    @cached_property
    def array(self) -> wr.PlanarArray:
        """Two by two elements."""
        return wr.PlanarArray(2, 2)

    @cached_property
    def codebook(self) -> Any:
        """Beams of :attr:`array`."""
        return wr.channel.dft_codebook(self.array)

    @cached_property
    def map(self) -> wr.RadioMap:
        """Of the field, in cells of 0.8 m."""
        return wr.RadioMap.load(self.folder / "map.nc")

    @cached_property
    def relevance(self) -> wr.Relevance:
        """What the room needs."""
        return wr.Relevance.load(self.folder / "relevance.json")
