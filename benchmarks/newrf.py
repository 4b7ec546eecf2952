"""The second room of the paper's evaluation: NeWRF's conference room, with materials of ITU-R P.2040 and Sionna RT's spectra.

The mesh says nothing of materials: floor, ceiling, walls and the things in the room get one each, by their place and
size. P.2040's rows end below 300 GHz for some of them and are continued.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

import warprrf as wr
from benchmarks.bare_mesh import named_by_part
from benchmarks.lobby.spectra import FREQUENCY_HZ, FULL_SHAPE, SEED
from benchmarks.newrf_rays import load_newrf
from benchmarks.runner import Benchmark, Job, option
from warprrf.files import write_atomically, write_json
from warprrf.geometry.mesh_files import write_mesh
from warprrf.rf.em.materials import itu_material, table_entry
from warprrf.rf.spectra.dataset import assign_roles

HELP = """\
Leaves spectra.nc and scene.xml in its folder, for `python -m benchmarks paper`. Needs NeWRF's files and the extra sionna;
takes minutes, and goes on where it was stopped.

examples:
  python -m benchmarks newrf --source external/newrf
"""
SCATTERING = {"floorboard": 0.5, "ceiling_board": 0.7, "plasterboard": 0.4, "wood": 0.6, "metal": 0.3}
"""Floor, ceiling, walls and two kinds of things; scattering coefficients are assumed."""


@dataclass(frozen=True)
class Options:
    """Options of the second room.

    Attributes:
        source: folder of NeWRF's files; see :mod:`benchmarks.newrf_rays`.
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
        FileNotFoundError, ValueError: as :func:`load_newrf` does.
    """
    room = load_newrf(options.source)
    materials = [replace(itu_material(n, scattering=s).extrapolated(), name=n) for n, s in SCATTERING.items()]
    scene, count = named_by_part(room.mesh, materials), 2 * options.receivers
    write_scene(scene, job.out)
    low, high = scene.mesh.bounds
    spectra = wr.simulate(
        scene,
        transmitter=low + [0.9, 0.9, 0.9] * (high - low),
        receivers=np.random.default_rng(SEED).permutation(room.receivers)[:count],
        frequency_hz=FREQUENCY_HZ,
        shape=options.shape,
        engine=options.engine,
        roles=assign_roles(count, test=options.receivers, seed=SEED),
        workspace=job.out / "workspace",
        progress=job.progress,
        device=job.device,
    )
    write_atomically(job.out / "spectra.nc", spectra.save)


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
