"""Small mesh files of each format, made by trimesh: a room of two materials with a table that stands in it twice."""

import json
import struct
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

RED, BLUE = (200, 40, 40), (40, 40, 200)


def picture():
    """Red above, blue below."""
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32], pixels[32:] = RED, BLUE
    return Image.fromarray(pixels)


def room_scene():
    """A y-up room of 4 x 3 x 5 m of ``itu_concrete``, and a square of ``Wood_01`` in two places, once mirrored."""
    room = trimesh.creation.box((4.0, 3.0, 5.0))
    room.visual = TextureVisuals(
        material=PBRMaterial(name="itu_concrete", baseColorFactor=[128, 128, 128, 255])
    )
    table = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    uv = np.array([[0.0, 0.05], [1.0, 0.05], [1.0, 0.45], [0.0, 0.45]])
    table.visual = TextureVisuals(uv=uv, material=PBRMaterial(name="Wood_01", baseColorTexture=picture()))
    scene = trimesh.Scene()
    scene.add_geometry(room, node_name="room", geom_name="room")
    moved = trimesh.transformations.translation_matrix([0.2, 0.3, 0.4])
    scene.add_geometry(table, node_name="table", geom_name="table", transform=moved)
    mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
    scene.graph.update(frame_to="other table", matrix=mirrored, geometry="table")
    return scene


def room_glb(folder: Path) -> Path:
    """The room as a binary file."""
    room_scene().export(folder / "room.glb")
    return folder / "room.glb"


def room_gltf(folder: Path) -> Path:
    """The room as text, with its buffers beside it."""
    for name, data in trimesh.exchange.gltf.export_gltf(room_scene()).items():
        (folder / name).write_bytes(data)
    return folder / "model.gltf"


def changed_glb(path: Path, change) -> Path:
    """A binary file whose header is what ``change`` makes of it."""
    data = path.read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    header = json.loads(data[20 : 20 + size])
    change(header)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path.write_bytes(head + text + rest)
    return path


def obj_with_materials(folder: Path) -> Path:
    """A square of textured wood and a triangle of plain paint, which names its corners from the end."""
    (folder / "square.obj").write_text(
        "mtllib square.mtl\no floor\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 .4\nvt 0 .4\n"
        "usemtl Wood_01\nf 1/1 2/2 3/3 4/4\no wall\nusemtl Paint\nf -4// -3// -1//\n"
    )
    (folder / "square.mtl").write_text(
        "newmtl Wood_01\nKd 0.5 0.5 0.5\nmap_Kd pages/wood.png\nnewmtl Paint\nKd 0.9 0.1 0.2\n"
    )
    (folder / "pages").mkdir(exist_ok=True)
    picture().save(folder / "pages" / "wood.png")
    return folder / "square.obj"
