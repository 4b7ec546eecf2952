"""The second room: NeWRF's conference room, a mesh by others, with materials of ITU-R P.2040 and Sionna RT's spectra.

The mesh says nothing of materials: floor, ceiling, walls and the things in the room get one each, by their place and
size. P.2040's rows end below 300 GHz for some of them and are continued. The geometry that methods are given is the mesh
without materials, covered with flat Gaussians.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

import warprrf as wr
from benchmarks.bare_mesh import named_by_part
from benchmarks.data import VERSIONS
from benchmarks.evaluation.protocol import Place
from benchmarks.lobby.spectra import FREQUENCY_HZ, FULL_SHAPE, SEED
from benchmarks.newrf_rays import load_newrf
from warprrf.files import write_atomically, write_json
from warprrf.geometry.mesh_files import write_mesh
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.rf.em.materials import itu_material, table_entry
from warprrf.rf.spectra.dataset import assign_roles
from warprrf.steps import Attempt, Steps, digest

TRAINING, TESTED = 100, 100
GAUSSIANS = 40_000
SCATTERING = {"floorboard": 0.5, "ceiling_board": 0.7, "plasterboard": 0.4, "wood": 0.6, "metal": 0.3}
"""Floor, ceiling, walls and two kinds of things; scattering coefficients are assumed."""
MATERIALS = tuple(
    replace(itu_material(name, scattering=share).extrapolated(), name=name)
    for name, share in SCATTERING.items()
)


def make(source: Path, steps: Steps, device: Any = None) -> Place:
    """Spectra, geometry and true scene of the room in ``source``, made in the folder of ``steps`` if they are not there.

    Raises:
        FileNotFoundError, ValueError: as :func:`load_newrf` does.
    """
    rays = load_newrf(source)
    scene, count = named_by_part(rays.mesh, MATERIALS), TRAINING + TESTED
    spectra, geometry, truth = "conference.nc", "conference", "conference_scene"

    def simulated(attempt: Attempt) -> dict[str, Any]:
        low, high = scene.mesh.bounds
        ds = wr.simulate(
            scene,
            transmitter=low + [0.9, 0.9, 0.9] * (high - low),
            receivers=np.random.default_rng(SEED).permutation(rays.receivers)[:count],
            frequency_hz=FREQUENCY_HZ,
            shape=FULL_SHAPE,
            engine="sionna",
            roles=assign_roles(count, test=TESTED, seed=SEED),
            workspace=attempt.folder,
            progress=attempt.progress,
            device=device,
        )
        write_atomically(steps.folder / spectra, ds.save)
        return {}

    def covered(attempt: Attempt) -> dict[str, Any]:
        mesh = wr.Mesh(rays.mesh.vertices, rays.mesh.faces)
        wr.Reconstruction(discs_on_mesh(mesh, GAUSSIANS), mesh).save(steps.folder / geometry)
        return {}

    def written(attempt: Attempt) -> dict[str, Any]:
        write_scene(scene, steps.folder / truth)
        return {}

    known = [rays.mesh.vertices, rays.mesh.faces, rays.receivers, list(SCATTERING.items())]
    steps.run("conference-spectra", simulated, version=VERSIONS["sionna"], inputs=known, outputs=[spectra])
    steps.run("conference-geometry", covered, version=1, inputs=known, outputs=[geometry])
    steps.run("conference-scene", written, version=1, inputs=known, outputs=[truth])
    return Place(
        file=str((steps.folder / spectra).resolve()),
        made=steps.key("conference-spectra"),
        content=digest(steps.folder / spectra),
        geometry=str((steps.folder / geometry).resolve()),
        geometry_made=steps.key("conference-geometry"),
        geometry_content=digest(steps.folder / geometry),
        xml=str((steps.folder / truth / "scene.xml").resolve()),
    )


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
