"""What is fuzzed with: a small room and what the library makes of it, by the names that arguments have."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from golden import make
from small_room import TRANSMITTER, small_room

import warprrf as wr
from warprrf.geometry.splats.gaussians import discs_on_mesh

POINTS = np.array([[1.0, 1.0, 1.5], [4.0, 3.0, 1.0], [1.0, 3.0, 2.0]])
ANGLES = np.linspace(0.3, 2.5, 5)
TOWARDS = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])
MANY = POINTS[0] + np.linspace(0.0, 0.5, 30)[:, None] * [1.0, 0.2, 0.1]
"""Receivers of a store, more than are traced at once."""
GIVEN: dict[str, Any] = {
    "frequency_hz": 300e9, "wavelength_m": 1e-3, "transmitter": np.array(TRANSMITTER),
    "receiver": POINTS[0], "position": POINTS[0], "points": POINTS, "candidates": POINTS, "directions": TOWARDS,
    "direction": TOWARDS[1], "a": POINTS[:2], "b": POINTS[1:].copy(), "origins": POINTS[:2], "n": 1, "seed": 0, "k": 4,
    "top_k": 4, "index": 1, "count": 8, "number": 1, "n_train": 4, "height": 1.2, "width_rad": 0.2, "noise": 0.1,
    "cos_incidence": np.cos(ANGLES / 2), "thickness_m": 0.1, "tau": 1e-8 * ANGLES, "tx": np.array([0, 1]),
    "power": np.array([1e-9, 2e-9, 5e-10, 1e-10, 0.0]), "rows": np.array([0, 2]), "indices": np.array([0, 1]),
    "materials": (wr.Material.conductor(),) * 2, "path": "saved", "home": "folder", "reach_m": 1e-3,
    "permittivity": 5.0 - 0.1j, "roughness_m": 1e-4, "itu": "concrete", "angle": ANGLES, "distance_m": 3.0, "values": ANGLES,
    "weights": np.ones(5), "length_m": np.array([1.0, 2.0]), "quantity": "total_path_gain", "powers": np.array([1e-9, 1e-10]),
}  # fmt: skip
"""What arguments are given, by their names."""


class Place:
    """The room of :func:`small_room`, with files of all kinds.

    Args:
        folder: where its files lie; :meth:`make` writes them.
        device: where what is made for one lies.
    """

    def __init__(self, folder: str | os.PathLike[str], device: str = "cpu") -> None:
        self.folder, self.device = Path(folder), device

    def __getattr__(self, name: str) -> Any:
        """What :data:`GIVEN` has by that name, or :data:`MADE`, made when first asked for."""
        if name not in GIVEN and name not in MADE:
            raise AttributeError(name)
        setattr(self, name, GIVEN[name] if name in GIVEN else MADE[name](self))
        return getattr(self, name)

    def make(self) -> Place:
        """Write the files, if they are not there."""
        if (self.folder / "made").exists():
            return self
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        small_room(self.folder)
        self.spectra.save(self.folder / "compact.nc", compact=True)
        wr.RadioField.fit(self.scene, self.train).save(self.folder / "bistatic.safetensors")
        for name, model in (("harmonic", "rf3dgs+"), ("rf3dgs", "rf3dgs")):
            field = wr.RadioField.fit(self.reconstruction, self.train, model, iterations=20)
            field.save(self.folder / f"{name}.safetensors")
        where = {"receivers": self.receivers[:2], "transmitter": TRANSMITTER, "frequency_hz": 300e9}
        wr.relevance(self.field, **where).save(self.folder / "relevance.json")
        with suppress(InterruptedError):
            self.field.spectra(MANY, store=self.folder / "store.nc", progress=_stop)
        self.field.radio_map(1.2, 0.8).save(self.folder / "map.nc")
        self.gaussians.save_ply(self.folder / "splats.ply")
        self.paths.save(self.folder / "paths.nc")
        at = ",".join(map(str, [*TRANSMITTER, *self.receivers[0]]))
        table = f"tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,power_db\n{at},-80.0\n{at},-81.5\n"
        (self.folder / "readings.csv").write_text(table)
        cut = "\n".join(f"{angle} {min(angle, 360 - angle) / 10}" for angle in range(0, 360, 10))
        (self.folder / "sector.msi").write_text(
            f"NAME sector\nGAIN 12 dBi\nHORIZONTAL 36\n{cut}\nVERTICAL 36\n{cut}\n"
        )
        self._make_pictures()
        self._make_colmap()
        (self.folder / "made").touch()
        return self

    def _make_pictures(self) -> None:
        from PIL import Image

        rng = np.random.default_rng(0)
        (self.folder / "photos").mkdir()
        for name in ("0.png", "1.jpg", "2.png"):
            pixels = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(self.folder / "photos" / name)
        array = self.folder / "pictures"
        (array / "spectrum").mkdir(parents=True)
        for k in (1, 2):
            Image.fromarray(np.full((3, 4), 90 * k, np.uint8)).save(array / "spectrum" / f"{k}.png")
        (array / "tx_pos.csv").write_text("x,y,z\n1,2,1\n2,1,1\n")
        (array / "train_index.txt").write_text("1\n2\n")
        (array / "gateway_info.yml").write_text("position: [4, 3, 1]\norientation: [0, 0, 0, 1]\n")

    def _make_colmap(self) -> None:
        import pycolmap

        options = pycolmap.SyntheticDatasetOptions(
            num_points3D=20, num_frames_per_rig=3, camera_model_id=pycolmap.CameraModelId.PINHOLE,
            camera_width=64, camera_height=48, camera_params=[60.0, 60.0, 32.0, 24.0], num_points2D_without_point3D=0,
        )  # fmt: skip
        model = pycolmap.synthesize_dataset(options)
        for name, write in (("colmap", model.write_binary), ("colmap_text", model.write_text)):
            (self.folder / name).mkdir()
            write(str(self.folder / name))


def _stop(stage: str, done: int, total: int) -> None:
    if done:
        raise InterruptedError


def _uploaded(p: Place) -> dict[str, Any]:
    """Parameters of Gaussians on the device, and colours."""
    means, quaternions, scales, opacities = p.raster.upload(p.gaussians)
    sh = wp.array(p.gaussians.sh, dtype=float, device=p.device)
    features = p.raster.colors(means, sh, p.camera)
    return {
        "means": means, "quaternions": quaternions, "scales": scales, "opacities": opacities, "sh": sh,
        "features": features, "out": wp.zeros_like(features, requires_grad=True),
        "origin": wp.array([p.camera.position], dtype=wp.vec3, device=p.device),
        "prepared": p.raster.prepare(means, quaternions, scales, opacities, p.camera),
    }  # fmt: skip


RNG = np.random.default_rng(0)
READINGS: dict[str, Any] = {
    "transmitters": TRANSMITTER, "receivers": POINTS[0], "power": np.array([1e-8, 1e-9, 1e-10]), "frequency_hz": 300e9,
    "floor": 1e-14, "arrival": np.array([[1.5, 0.0], [1.5, 1.0], [1.5, 2.0]]), "std_db": 1.0,
    "receive_pattern": np.linspace(1.0, 0.0, 19),
}  # fmt: skip

MADE: dict[str, Callable[[Place], Any]] = {
    "scene": lambda p: wr.Scene.load(p.folder / "scene.xml"),
    "mesh": lambda p: p.scene.mesh,
    "spectra": lambda p: wr.SpectrumDataset.load(p.folder / "spectra.nc"),
    "train": lambda p: p.spectra.split(8)[0],
    "measured": lambda p: p.train.subset([0]),
    "test": lambda p: p.spectra.split(8)[1].subset([0, 1]),
    "receivers": lambda p: np.array(p.spectra.receivers[:3]),
    "gaussians": lambda p: discs_on_mesh(p.mesh, 200),
    "camera": lambda p: make.pinhole().resized(16, 12),
    "reconstruction": lambda p: wr.Reconstruction(p.gaussians, p.mesh, {"0.png": p.camera}),
    "harmonic": lambda p: wr.RadioField.load(p.folder / "harmonic.safetensors"),
    "filmed": lambda p: wr.Reconstruction(
        mesh=p.mesh,
        cameras={str(k): wr.Camera.spherical(8, 4, position=at) for k, at in enumerate([*POINTS, (2, 2, 1)])},
    ),  # fmt: skip
    "field": lambda p: wr.RadioField.load(p.folder / "bistatic.safetensors"),
    "readings": lambda p: wr.Readings(**READINGS),
    "paths": lambda p: wr.trace_paths(
        p.scene, transmitter=TRANSMITTER, receivers=p.receivers, frequency_hz=300e9
    ),
    "sources": lambda p: list(p.paths.each()),
    "channels": lambda p: RNG.normal(size=(2, 4)) + 1j * RNG.normal(size=(2, 4)),
    "array": lambda p: wr.PlanarArray(2, 2),
    "codebook": lambda p: wr.channel.dft_codebook(p.array),
    "map": lambda p: wr.RadioMap.load(p.folder / "map.nc"),
    "relevance": lambda p: wr.Relevance.load(p.folder / "relevance.json"),
    "path_gain": lambda p: np.asarray(p.spectra.path_gain[0], dtype=float),
    "prediction": lambda p: wr.metrics.unit_image(p.path_gain, p.spectra.floor, p.spectra.range_db),
    "truth": lambda p: p.prediction[::-1].copy(),
    "raster": lambda p: wr.splats.Rasterizer(device=p.device),
    "uploaded": _uploaded,
}
