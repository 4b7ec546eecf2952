"""The second room of the paper's evaluation: NeWRF's conference room, with materials of ITU-R P.2040 and Sionna RT's spectra.

NeWRF (Lu, Vattheuer, Mirzasoleiman, Abari, ICML 2024; github.com/LuHaofan/NeWRF, MIT licence) gives mesh and receivers. The
mesh says nothing of materials: floor, ceiling, walls and the things in the room get one each, by their place and
size. P.2040's rows end below 300 GHz for some of them and are continued.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

import warprrf as wr
from benchmarks.lobby.spectra import FREQUENCY_HZ, FULL_SHAPE, SEED
from benchmarks.runner import Benchmark, Job, option
from warprrf.files import read_arrays, write_atomically, write_json
from warprrf.geometry.mesh import components, edge_pairs
from warprrf.geometry.mesh_files import write_mesh
from warprrf.rf.em.materials import itu_material, table_entry
from warprrf.rf.spectra.dataset import assign_roles

HELP = """\
Leaves spectra.nc and scene.xml in its folder, for `python -m benchmarks paper`. Needs NeWRF's files and the extra sionna;
takes minutes, and goes on where it was stopped.

examples:
  python -m benchmarks newrf --source external/newrf
"""
RECEIVERS_FILE, MESH_FILE = "newrf_conference.npz", "conferenceroom.stl"
SCATTERING = {"floorboard": 0.5, "ceiling_board": 0.7, "plasterboard": 0.4, "wood": 0.6, "metal": 0.3}
"""Floor, ceiling, walls and two kinds of things; scattering coefficients are assumed."""


@dataclass(frozen=True)
class Options:
    """Options of the second room.

    Attributes:
        source: folder of ``newrf_conference.npz``, which holds ``receivers`` (R, 3), and ``conferenceroom.stl``.
        receivers: as many for training as for testing.
        engine: of the spectra.
        shape: rows and columns of the spectra.
    """

    source: str = option("external/newrf", "folder of NeWRF's files")
    receivers: int = option(100, "receivers for training, and as many for testing")
    engine: str = option("sionna", "of the spectra", choices=("sionna", "exact"))
    shape: tuple[int, int] = FULL_SHAPE


def run(options: Options, job: Job) -> None:
    """Make scene and spectra.

    Raises:
        FileNotFoundError: if one of NeWRF's files is missing.
        ValueError: if one does not read.
    """
    source = Path(options.source)
    for name in (RECEIVERS_FILE, MESH_FILE):
        if not (source / name).is_file():
            raise FileNotFoundError(
                f"source: there is no {source / name}, expected {RECEIVERS_FILE} and {MESH_FILE}"
            )
    mesh, receivers = wr.Mesh.load(source / MESH_FILE), read_arrays(source / RECEIVERS_FILE)["receivers"]
    materials = [replace(itu_material(n, scattering=s).extrapolated(), name=n) for n, s in SCATTERING.items()]
    scene, count = named_by_part(mesh, materials), 2 * options.receivers
    write_scene(scene, job.out)
    low, high = scene.mesh.bounds
    spectra = wr.simulate(
        scene,
        transmitter=low + [0.9, 0.9, 0.9] * (high - low),
        receivers=np.random.default_rng(SEED).permutation(receivers)[:count],
        frequency_hz=FREQUENCY_HZ,
        shape=options.shape,
        engine=options.engine,
        roles=assign_roles(count, test=options.receivers, seed=SEED),
        workspace=job.out / "workspace",
        progress=job.progress,
        device=job.device,
    )
    write_atomically(job.out / "spectra.nc", spectra.save)


def named_by_part(mesh: wr.Mesh, materials: Sequence[wr.Material]) -> wr.Scene:
    """``mesh`` with a material for its floor, ceiling and walls, and one for each size of the things in it."""
    part = components(len(mesh.faces), edge_pairs(mesh.welded_faces))
    area = np.bincount(part, mesh.areas)
    things = 3 + np.unique(np.round(area, 2), return_inverse=True)[1].reshape(-1) % (len(materials) - 3)
    upward = mesh.face_normals[:, 2]
    low = mesh.triangles[:, :, 2].max(axis=1) < mesh.center[2]
    side = np.where(np.abs(upward) < 0.5, 2, np.where(low, 0, 1))
    return wr.Scene(mesh, materials, np.where(part == area.argmax(), side, things[part]))


def write_scene(scene: wr.Scene, folder: Path) -> None:
    """Write ``scene`` as :meth:`wr.Scene.load` and Sionna RT read it, an object a material."""
    root = ElementTree.Element("scene", version="3.0.0")
    for k in np.unique(scene.face_material):
        material = scene.materials[k]
        used, faces = np.unique(scene.mesh.faces[scene.face_material == k], return_inverse=True)
        file = f"meshes/{material.name}.ply"
        write_mesh(folder / file, scene.mesh.vertices[used], faces.reshape(-1, 3))
        ElementTree.SubElement(root, "bsdf", type="diffuse", id=f"mat-{material.name}")
        shape = ElementTree.SubElement(root, "shape", type="ply", id=f"surface_{material.name}")
        ElementTree.SubElement(shape, "string", name="filename", value=file)
        ElementTree.SubElement(shape, "ref", id=f"mat-{material.name}", name="bsdf")
    write_json(folder / "materials.json", {"materials": [table_entry(m) for m in scene.materials]})
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(folder / "scene.xml")


BENCHMARKS = {"newrf": Benchmark("newrf", Options, run, HELP)}
