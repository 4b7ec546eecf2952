"""A room that Sionna RT and we both read, and Sionna itself where it is installed."""

import pytest
from radio_scenes import box_mesh, joined

from warprrf.geometry.mesh_files import write_mesh
from warprrf.rf import scene_sionna
from warprrf.rf.em.materials import Material
from warprrf.rf.scene import Scene


def sionna_or_skip():
    try:
        scene_sionna.select_llvm()
    except ImportError as error:
        pytest.skip(str(error))
    pytest.importorskip("sionna.rt", reason="Sionna RT is an extra", exc_type=ImportError)
    from warprrf.rf.interop.sionna_engine import SionnaEngine

    return SionnaEngine


def placed(rt, live, transmitter, receivers, array=None):
    """A scene of Sionna's with a transmitter and receivers, of one element of both polarisations unless told."""
    one = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="VH")
    live.tx_array = live.rx_array = array or one
    live.add(rt.Transmitter("tx", position=[float(x) for x in transmitter]))
    for k, point in enumerate(receivers):
        live.add(rt.Receiver(f"rx{k}", position=[float(x) for x in point]))
    return live


def write_xml(folder, parts):
    """Named parts, each of an ITU material and its vertices and faces, as PLY files and the XML that Sionna reads."""
    shapes = ""
    for name, (itu, mesh) in parts.items():
        write_mesh(folder / f"{name}.ply", *mesh)
        shapes += (
            f'<bsdf type="diffuse" id="mat-itu_{itu}"/><shape type="ply" id="{name}">'
            f'<string name="filename" value="{name}.ply"/><boolean name="face_normals" value="true"/>'
            f'<ref id="mat-itu_{itu}" name="bsdf"/></shape>\n'
        )
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">\n{shapes}</scene>\n')
    return folder / "scene.xml"


def write_scene(folder):
    """A room and a block in it, and its files."""
    parts = {
        "walls": box_mesh([-7, -6, 0], [8, 6, 4], inward=True),
        "block": box_mesh([-1.5, -2, -0.01], [0.5, 1.5, 2.2]),
    }
    itu = zip(parts, ("concrete", "brick"), strict=True)
    xml = write_xml(folder, {name: (material, parts[name]) for name, material in itu})
    mesh, part = joined(*parts.values())
    stone = Material.custom(
        "stone",
        relative_permittivity=5.0,
        conductivity=5.0,
        thickness_m=0.05,
        scattering=0.6,
        pattern="directive",
    )
    board = Material.custom(
        "board", relative_permittivity=1.6, conductivity=1.0, thickness_m=0.013, scattering=0.9
    )
    return Scene(mesh, [stone, board], part, face_object=part, object_names=list(parts), xml_path=xml)
