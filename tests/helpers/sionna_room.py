"""A room that Sionna RT and we both read, and Sionna itself where it is installed."""

import pytest
from radio_scenes import box_mesh, joined

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


def write_scene(folder):
    """A room and a block in it, as PLY files and the XML that Sionna reads."""
    parts = {
        "walls": box_mesh([-7, -6, 0], [8, 6, 4], inward=True),
        "block": box_mesh([-1.5, -2, -0.01], [0.5, 1.5, 2.2]),
    }
    shapes = ""
    for name, (vertices, faces) in parts.items():
        header = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
        header += "property float x\nproperty float y\nproperty float z\n"
        header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        rows = [" ".join(f"{x:.9g}" for x in v) for v in vertices] + [f"3 {a} {b} {c}" for a, b, c in faces]
        (folder / f"{name}.ply").write_text(header + "\n".join(rows) + "\n")
        shapes += (
            f'<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>'
            '<boolean name="face_normals" value="true"/><ref id="mat-itu_concrete" name="bsdf"/></shape>\n'
        )
    xml = folder / "scene.xml"
    bsdf = '<bsdf type="diffuse" id="mat-itu_concrete"/>'
    xml.write_text(f'<scene version="3.0.0">\n{bsdf}\n{shapes}</scene>\n')
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
