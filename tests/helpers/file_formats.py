"""One small file of each format of the library, and what reading it gives: values and arrays by name.

A field is also asked for a spectrum, splats for a picture, a mesh for a ray: what was accepted must be of use.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from path_makers import random_paths
from radio_scenes import box_mesh
from twin_fields import BLOCKED, SEES, SIGMA, F, known_field, room

import warprrf as wr
from warprrf.geometry.mesh_files import read_mesh, write_mesh
from warprrf.geometry.planar_patches import planar_patches
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.rf.fields.bistatic.uncertainty import LEVEL_DB, STEEPNESS_DB, ErrorModel
from warprrf.rf.fields.harmonic.field import HarmonicField
from warprrf.rf.fields.harmonic.options import FieldOptions
from warprrf.rf.interop.twin import write_twin
from warprrf.rf.maps.radio_map import RadioMap
from warprrf.rf.spectra.dataset_files import export_exr, import_exr
from warprrf.rf.spectra.spectrum import Spectrum

Maker = Callable[[Path], Path]


def bistatic_field(folder: Path) -> Path:
    """A field with residuals and an error model."""
    field = known_field(shape=(12, 24))
    size = field.parameters.log_weight.shape[0] * (field.parameters.log_weight.shape[1] + 2)
    errors = ErrorModel(
        np.full((len(LEVEL_DB), len(STEEPNESS_DB)), 0.5), np.array(0.1), np.array(1.0), np.stack([SEES, BLOCKED]),
        1e-2 * np.eye(size), np.array(6.0),
    )  # fmt: skip
    terms = replace(field.terms, residual=True, sub_pixels=1)
    residual = np.random.default_rng(0).normal(0.0, 0.1, field.residual.shape)
    path = folder / "bistatic.safetensors"
    replace(field, errors=errors, terms=terms, residual=residual).with_gas().save(path)
    return path


def harmonic_field(folder: Path, model: str = "rf3dgs+") -> Path:
    """A field of few discs, with coefficients made up."""
    gaussians = discs_on_mesh(room().mesh, 60)
    rng = np.random.default_rng(0)
    names = ("gain",) if model == "rf3dgs+" else ("gain", "delay", "aod_x", "aod_y", "aod_z")
    field = HarmonicField(
        gaussians=gaussians, mesh=room().mesh, transmitter=np.array([0.8, 0.9, 2.2]), frequency_hz=F, shape=(12, 24),
        floor=1e-17, range_db=(-170.0, -80.0), beam_sigma_rad=SIGMA,
        options=FieldOptions(model=model), layers={
            name: rng.normal(0.0, 0.3, (len(gaussians), 16)).astype(np.float32) for name in names
        }, gain_unit=1e-3, delay_unit=1e-8,
    )  # fmt: skip
    path = folder / f"{model.rstrip('+')}.safetensors"
    field.save(path)
    return path


def reconstruction(folder: Path) -> Path:
    """A room with two cameras."""
    mesh = room().mesh
    camera = wr.Camera.pinhole(64, 48, fx=50.0, fy=50.0, cx=32.0, cy=24.0, world_to_camera=np.eye(4))
    wr.Reconstruction(
        discs_on_mesh(mesh, 60), mesh, {"a.jpg": camera, "b.jpg": camera}, patches=planar_patches(mesh)
    ).save(folder / "room")
    return folder / "room" / "reconstruction.safetensors"


def paths(folder: Path) -> Path:
    """Polarised paths of two receivers."""
    path = folder / "paths.nc"
    both = [random_paths(4, jones=True), random_paths(2, seed=1, kind="diffuse", jones=True)]
    wr.Paths.stack(both).with_gas().save(path)
    return path


def splats(folder: Path) -> Path:
    """A room's discs."""
    discs_on_mesh(room().mesh, 60).save_ply(folder / "splats.ply")
    return folder / "splats.ply"


def mesh_file(folder: Path) -> Path:
    """A box with texture coordinates."""
    path = folder / "box.ply"
    vertices, faces = box_mesh([0, 0, 0], [5, 4, 3], inward=True)
    write_mesh(path, vertices, faces, uv=vertices[:, :2] / 7.0)
    return path


def exr(folder: Path) -> Path:
    """One spectrum."""
    rng = np.random.default_rng(0)
    spectrum = Spectrum(
        rng.random((6, 12)).astype(np.float32), rng.random((6, 12)), rng.random((6, 12, 2)).astype(np.float32),
        floor=1e-3, range_db=(-30.0, 0.0),
    )  # fmt: skip
    export_exr(folder / "one.exr", spectrum)
    return folder / "one.exr"


def twin_xml(folder: Path) -> Path:
    """A twin's scene; its meshes and materials lie beside it."""
    return write_twin(known_field(), folder / "twin").xml


def twin_materials(folder: Path) -> Path:
    """A twin's materials; its scene lies beside it."""
    return twin_xml(folder).with_name("materials.json")


def read_field(path: Path) -> dict[str, Any]:
    """Spectrum and paths of a field."""
    field = wr.RadioField.load(path, device="cpu")
    spectrum = field.spectrum(SEES)
    assert spectrum.delay_s is not None
    found = {"path_gain": spectrum.path_gain, "lit": np.isfinite(spectrum.delay_s), "model": field.model}
    for name in ("frequency_hz", "floor", "range_db", "beam_sigma_rad", "transmitter", "mesh"):
        value = getattr(field, name)
        found[name] = value.vertices if isinstance(value, wr.Mesh) else value
    if getattr(field, "errors", None) is not None:
        found["std_db"] = field.spectrum(SEES, uncertainty=True).std_db  # type: ignore[call-arg]
    return found


def read_reconstruction(path: Path) -> dict[str, Any]:
    """Arrays of a reconstruction."""
    found = wr.Reconstruction.load(path.parent)
    assert found.patches is not None
    g = found.gaussians
    return {
        **{name: getattr(g, name) for name in ("means", "quaternions", "scales", "opacities", "sh")},
        "vertices": found.mesh.vertices, "faces": found.mesh.faces, "patch": found.patches.face_patch,
        "normal": found.patches.normal, "names": list(found.cameras),
        "poses": [c.world_to_camera for c in found.cameras.values()],
    }  # fmt: skip


def read_paths(path: Path) -> dict[str, Any]:
    """Arrays of paths."""
    found = wr.Paths.load(path)
    return {n: v for n, v in vars(found).items() if n != "air"} | {"cir": found[0].cir()[0]}


def read_splats(path: Path) -> dict[str, Any]:
    """Arrays of splats, and a small picture."""
    g = wr.Gaussians.load_ply(path)
    camera = wr.Camera.spherical(24, 12, position=SEES)
    picture = wr.render(g, camera, device="cpu").features
    arrays = {name: getattr(g, name) for name in ("means", "quaternions", "scales", "opacities", "sh")}
    return arrays | {"picture": picture}


def read_mesh_file(path: Path) -> dict[str, Any]:
    """A mesh, and how far it is along one ray."""
    found = read_mesh(path)
    mesh = wr.Mesh(found.vertices, found.faces)
    ray = mesh.cast([[1.0, 1.0, 1.0]], [[0.3, 0.2, 0.1]], device="cpu")
    return vars(found) | {"t": ray.t, "normals": mesh.face_normals}


def read_exr(path: Path) -> dict[str, Any]:
    """A spectrum."""
    found = import_exr(path)
    return {n: v for n, v in vars(found).items() if n != "attributes"}


def read_dataset(path: Path) -> dict[str, Any]:
    """All that a data set's file holds."""
    return {n: v for n, v in vars(wr.SpectrumDataset.load(path)).items() if n != "attributes"}


def read_map(path: Path) -> dict[str, Any]:
    """All that a radio map's file holds."""
    return vars(RadioMap.load(path))


def read_scene(path: Path) -> dict[str, Any]:
    """Surfaces and materials of the scene in the folder of ``path``."""
    scene = wr.Scene.load(path.with_name("scene.xml"))
    values = [[m.permittivity(F), m.scattering_coefficient(F)] for m in scene.materials]
    return {
        "vertices": scene.mesh.vertices, "faces": scene.mesh.faces, "face_material": scene.face_material,
        "names": [m.name for m in scene.materials], "values": np.array(values),
    }  # fmt: skip


def without_checksum(path: Path) -> Path:
    """A safetensors file as older versions wrote it."""
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"].pop("sha256", None)
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + size :])
    return path


MAKERS: dict[str, tuple[Maker, str]] = {
    "bistatic": (bistatic_field, "read_field"),
    "rf3dgs+": (harmonic_field, "read_field"),
    "rf3dgs": (lambda folder: harmonic_field(folder, "rf3dgs"), "read_field"),
    "reconstruction": (reconstruction, "read_reconstruction"),
    "paths": (paths, "read_paths"),
    "exr": (exr, "read_exr"),
    "splats": (splats, "read_splats"),
    "mesh ply": (mesh_file, "read_mesh_file"),
    "twin xml": (twin_xml, "read_scene"),
    "twin materials": (twin_materials, "read_scene"),
}
"""Of each format: what writes a file of it, and the name of what reads it."""
