"""Every file format: an example of it, how it is read, and what is asked of it then."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.fuzz.place import Place
from warprrf.cli.inputs import read_positions, read_receivers
from warprrf.geometry.mesh_files import read_mesh
from warprrf.geometry.photos.photo_files import check_photos, find_photos, read_photo
from warprrf.geometry.photos.poses import DepthFile, read_depth, read_poses
from warprrf.geometry.photos.sfm import read_colmap
from warprrf.rf.spectra.dataset_files import export_exr, import_exr
from warprrf.steps import Steps

SEES = np.array([4.0, 3.0, 1.0])


@dataclass(frozen=True)
class Format:
    """One kind of file.

    Attributes:
        make: writes an example into a folder of its own and returns the file that is damaged.
        read: reads it, and asks what a user would ask of it.
        codec: how its contents are edited, by :data:`benchmarks.fuzz.damage.CODECS`; empty: bytes only.
        sealed: it carries a checksum: edits of bytes are refused, or change nothing.
        held: attributes of what was read that its answers may be refused by.
    """

    make: Callable[[Place, Path], Path]
    read: Callable[[Path], Any]
    codec: str = ""
    sealed: bool = False
    held: tuple[str, ...] = ()


def _copy(*names: str) -> Callable[[Place, Path], Path]:
    """Files of the place, the first of which is damaged; folders are copied with what they hold."""

    def make(place: Place, folder: Path) -> Path:
        for name in names:
            source = place.folder / name
            if source.parent != place.folder:
                shutil.copytree(source.parent, folder, dirs_exist_ok=True)
            else:
                shutil.copy(source, folder)
        return folder / Path(names[0]).name

    return make


def _text(name: str, content: str) -> Callable[[Place, Path], Path]:
    def make(place: Place, folder: Path) -> Path:
        (folder / name).write_text(content)
        return folder / name

    return make


def _field(path: Path) -> Any:
    field = wr.RadioField.load(path, device="cpu")
    return field, field.spectrum(SEES), field.paths(SEES, max_paths=10)


def _splats(path: Path) -> Any:
    g = wr.Gaussians.load_ply(path)
    pose = np.eye(4)
    pose[2, 3] = 2.0
    return g, wr.render(
        g, wr.Camera.pinhole(8, 6, fx=8, fy=8, cx=4, cy=3, world_to_camera=pose), device="cpu"
    )


def _photo(path: Path) -> Any:
    check_photos(find_photos(path.parent))
    return read_photo(path)


def _mesh(path: Path) -> Any:
    content = read_mesh(path)
    return wr.Mesh(content.vertices, content.faces).distance(SEES[None], device="cpu")


def _paths(path: Path) -> Any:
    paths = wr.Paths.load(path)
    return paths, paths.power, paths.dispersion(), paths.cir()


def _arrays(place: Place, folder: Path) -> Path:
    with Steps(folder, shared=True) as steps:
        steps.arrays("step", lambda: {"a": np.arange(5.0), "b": np.ones((2, 3))}, version=1, inputs=[1])
    return folder / "step.npz"


def _cached(path: Path) -> Any:
    with Steps(path.parent, shared=True) as steps:
        return steps.arrays(
            "step", lambda: {"a": np.arange(5.0), "b": np.ones((2, 3))}, version=1, inputs=[1]
        )


def _step(place: Place, folder: Path) -> Path:
    _recorded(folder / "x")
    return folder / ".steps" / "step.json"


def _recorded(path: Path) -> Any:
    folder = path.parent.parent if path.parent.name == ".steps" else path.parent
    with Steps(folder) as steps:
        found = steps.run("step", lambda attempt: {"a": 1.0}, version=1, inputs=[1])
        return found, steps.seconds(), steps.stages("step"), steps.attempts("step")


def _exr(place: Place, folder: Path) -> Path:
    export_exr(folder / "one.exr", place.spectra[0])
    return folder / "one.exr"


def _receivers(place: Place, folder: Path) -> Path:
    np.save(folder / "receivers.npy", place.receivers)
    return folder / "receivers.npy"


ROWS = "x,y,z\n1.0,2.0,1.5\n3.0,1.0,1.2\n"
SURVEYED = '{"0.png": [1.0, 2.0, 1.5], "1.jpg": [3.0, 1.0, 1.2]}\n'

TRANSFORMS = (
    '{"fl_x": 60.0, "w": 32, "h": 24, "k1": 0.1, "frames": [{"file_path": "0.png", "transform_matrix": '
    "[[1, 0, 0, 1.0], [0, 1, 0, 2.0], [0, 0, 1, 1.5], [0, 0, 0, 1]]}]}\n"
)


def _depth(place: Place, folder: Path) -> Path:
    from PIL import Image

    Image.fromarray(np.arange(600, dtype=np.uint16).reshape(20, 30)).save(folder / "depth.png")
    return folder / "depth.png"


def _frame(place: Place, folder: Path) -> Path:
    np.savetxt(folder / "camera-intrinsics.txt", np.array([[60.0, 0, 16], [0, 60, 12], [0, 0, 1]]))
    np.savetxt(folder / "frame-0.pose.txt", np.eye(4))
    return folder / "frame-0.pose.txt"


FORMATS: dict[str, Format] = {
    "spectra": Format(_copy("spectra.nc"), wr.SpectrumDataset.load, "netcdf", True),
    "compact spectra": Format(_copy("compact.nc"), wr.SpectrumDataset.load, "netcdf", True),
    **{
        f"{name} field": Format(_copy(f"{name}.safetensors"), _field, "tensors", True, ("transmitter",))
        for name in ("bistatic", "harmonic", "rf3dgs")
    },
    "paths": Format(_copy("paths.nc"), _paths, "netcdf", True),
    "reconstruction": Format(
        _copy("reconstruction/reconstruction.safetensors"),
        lambda p: wr.Reconstruction.load(p.parent),
        "tensors",
        True,
    ),
    "radio map": Format(_copy("map.nc"), wr.RadioMap.load, "netcdf", True),
    "relevance": Format(_copy("relevance.json"), wr.Relevance.load, "json"),
    "step arrays": Format(_arrays, _cached, "zip"),
    "step record": Format(_step, _recorded, "json"),
    "splats": Format(_copy("splats.ply"), _splats, "words"),
    "scene": Format(_copy("scene.xml", "materials.json", "walls.ply", "block.ply"), wr.Scene.load, "xml"),
    "scene as text": Format(
        _copy("scene.xml", "materials.json", "walls.ply", "block.ply"), wr.Scene.load, "words"
    ),
    "materials": Format(_copy("materials.json"), wr.em.load_materials, "json"),
    "receivers CSV": Format(_text("receivers.csv", ROWS), lambda p: read_receivers([str(p)]), "words"),
    "receivers NPY": Format(_receivers, lambda p: read_receivers([str(p)])),
    "positions JSON": Format(_text("surveyed.json", SURVEYED), read_positions, "json"),
    "positions CSV": Format(_text("surveyed.csv", "file,x,y,z\n0.png,1,2,1.5\n"), read_positions, "words"),
    "transforms": Format(_text("transforms.json", TRANSFORMS), read_poses, "json"),
    "pose of a frame": Format(_frame, lambda p: read_poses(p.parent), "words"),
    "depth PNG": Format(_depth, lambda p: read_depth(DepthFile(p))),
    "EXR": Format(_exr, import_exr),
    "PNG": Format(_copy("photos/0.png"), _photo),
    "JPEG": Format(_copy("photos/1.jpg"), _photo),
    "PLY mesh": Format(_copy("meshes/mesh.ply"), _mesh, "words"),
    "OBJ mesh": Format(_copy("meshes/mesh.obj"), _mesh, "words"),
    "STL mesh": Format(_copy("meshes/mesh.stl"), _mesh),
    "GLB mesh": Format(_copy("meshes/mesh.glb"), _mesh),
    **{
        f"COLMAP {name}": Format(_copy(f"colmap/{name}.bin"), lambda p: read_colmap(p.parent))
        for name in ("cameras", "images", "points3D")
    },
    **{
        f"COLMAP {name} text": Format(
            _copy(f"colmap_text/{name}.txt"), lambda p: read_colmap(p.parent), "words"
        )
        for name in ("cameras", "images", "points3D")
    },
}
"""By name."""
