"""glTF 2.0 files, text or binary (GLB), by trimesh, which no other module touches.

A file's tables are held against what is there before trimesh reads them, and what it would pass over is an error: parts
outside their buffers, compressed or sparse data, nodes in circles. Files are found by us: names don't leave the folder.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import require
from warprrf.geometry.mesh_colours import read_picture, sampled, to_srgb
from warprrf.geometry.mesh_content import LARGEST_FACES, Folder, MeshContent, material_name, numbered

_SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # bytes of a component
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_FLOAT = 5126
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_texture_transform", "EXT_texture_webp", "KHR_xmp")
"""Beginnings of the names of extensions that do not change where surfaces are."""


def read_gltf(folder: Folder) -> MeshContent:
    """Read the glTF or GLB file of ``folder``: every instance of its default scene, in its place.

    Raises:
        FileNotFoundError: if a buffer beside it is missing.
        ValueError: naming the file, if it is damaged, compressed, or names files outside its folder.

    Warns:
        UserWarning: if a texture is missing: those colours stay unknown.
    """
    path = folder.path
    trimesh = require("trimesh", extra="mesh")
    try:
        header, binary = _split(path)
        buffers = _buffers(header, binary, folder)
        _check(header, buffers)
        colours = [_base_colour(header, k, buffers, folder) for k in range(len(header.get("materials", [])))]
        text = json.dumps(_prepared(header)).encode()
        held = {f"buffer-{k}": data for k, data in enumerate(buffers)}
        scene = trimesh.load(io.BytesIO(text), file_type="gltf", resolver=held, process=False, force="scene")
        return _joined(scene, [*colours, _Colour(None, np.ones(3))])
    except (ImportError, OSError, MemoryError):
        raise
    except Exception as error:  # trimesh raises whatever its parsers trip over
        told = error if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        told = str(told).removeprefix(f"path: {path} ")
        raise ValueError(f"path: {path} is not a readable mesh: {told}") from error


@dataclass(frozen=True)
class _Colour:
    """A material's name, its linear colour (3,), and the picture that it is multiplied with."""

    name: str | None
    factor: np.ndarray
    picture: np.ndarray | None = None


def _split(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """The header, and the binary chunk of a GLB file."""
    data, binary = path.read_bytes(), None
    if data[:4] == b"glTF":
        version, length = np.frombuffer(data[4:12], "<u4")
        if version != 2 or length != len(data):
            raise ValueError(f"it states version {version} and {length} bytes, expected 2 and {len(data)}")
        text, place = b"", 12
        while place < len(data):
            size, kind = (int(x) for x in np.frombuffer(data[place : place + 8], "<u4"))
            chunk = data[place + 8 : place + 8 + size]
            if len(chunk) != size:
                raise ValueError("it is cut short within a chunk")
            if kind == 0x4E4F534A and not text:
                text = chunk
            elif kind == 0x004E4942 and binary is None:
                binary = chunk
            place += 8 + size
        data = text
    header = json.loads(data.decode("utf-8"))
    if not isinstance(header, dict) or not str(header.get("asset", {}).get("version", "")).startswith("2."):
        raise ValueError("it states no glTF version 2 (asset.version)")
    return header, binary


def _content(uri: str, folder: Folder) -> bytes:
    """What a URI gives: data in itself, or a file's content."""
    if not uri.startswith("data:"):
        return folder.read(uri)
    try:
        return base64.b64decode(uri.partition("base64,")[2], validate=True)
    except binascii.Error as error:
        raise ValueError(f"data in a URI: {error}") from error


def _buffers(header: Mapping[str, Any], binary: bytes | None, folder: Folder) -> list[bytes]:
    found = []
    for k, buffer in enumerate(header.get("buffers", [])):
        data = _content(buffer["uri"], folder) if "uri" in buffer else binary if k == 0 else None
        if data is None or len(data) < buffer["byteLength"]:
            raise ValueError(
                f"buffer {k} is not there, or shorter than the {buffer['byteLength']} bytes stated"
            )
        found.append(data)
    return found


def _row(table: Mapping[str, Any], name: str, index: object) -> dict[str, Any]:
    """One row of a table of the header."""
    rows = table.get(name, [])
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(rows):
        raise ValueError(f"it names {name} {index!r} of {len(rows)}")
    return dict(rows[index])


def _span(what: str, start: object, length: object, whole: int) -> None:
    numbers = [x for x in (start, length) if isinstance(x, int) and not isinstance(x, bool) and x >= 0]
    if len(numbers) < 2 or sum(numbers) > whole:
        raise ValueError(f"{what} states {length!r} bytes from {start!r} on, of {whole}")


def _check(header: Mapping[str, Any], buffers: list[bytes]) -> None:
    """Hold the header's tables against each other and the buffers."""
    unread = [x for x in header.get("extensionsRequired", []) if not str(x).startswith(_HARMLESS)]
    if unread:
        raise ValueError(f"it needs the extension {', '.join(unread)}; export it without compression")
    for k, view in enumerate(header.get("bufferViews", [])):
        _row(header, "buffers", view["buffer"])
        _span(f"buffer view {k}", view.get("byteOffset", 0), view["byteLength"], len(buffers[view["buffer"]]))
    for k, accessor in enumerate(header.get("accessors", [])):
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError(f"accessor {k} is sparse or without data; export it without compression")
        view = _row(header, "bufferViews", accessor["bufferView"])
        item = _SIZES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
        stride = view.get("byteStride", item)
        if not isinstance(stride, int) or not item <= stride <= 252 and "byteStride" in view:
            raise ValueError(f"accessor {k} has items of {item} bytes every {stride!r} bytes")
        length = stride * (accessor["count"] - 1) + item
        _span(f"accessor {k}", accessor.get("byteOffset", 0), length, view["byteLength"])
    for k, mesh in enumerate(header.get("meshes", [])):
        for primitive in mesh["primitives"]:
            _check_primitive(header, k, primitive)
    _check_nodes(header)


def _check_primitive(header: Mapping[str, Any], mesh: int, primitive: Mapping[str, Any]) -> None:
    if primitive.get("mode", _TRIANGLES) == _FAN:
        raise ValueError(f"mesh {mesh} is of fans of triangles; export it as triangles")
    rows = {name: _row(header, "accessors", index) for name, index in primitive["attributes"].items()}
    position = rows["POSITION"]
    if position["type"] != "VEC3" or position.get("normalized"):
        raise ValueError(f"positions of mesh {mesh} are {position['type']}, or compressed")
    for name, row in rows.items():
        if name.startswith("TEXCOORD") and row["componentType"] != _FLOAT:
            raise ValueError(f"texture coordinates of mesh {mesh} are compressed; export them as numbers")
        if row["count"] != position["count"]:
            raise ValueError(f"mesh {mesh} has {row['count']} of {name} for {position['count']} vertices")
    if "indices" in primitive:
        row = _row(header, "accessors", primitive["indices"])
        if row["type"] != "SCALAR" or row["componentType"] not in (5121, 5123, 5125):
            raise ValueError(f"indices of mesh {mesh} are no whole numbers")
    if "material" in primitive:
        _row(header, "materials", primitive["material"])


def _check_nodes(header: Mapping[str, Any]) -> None:
    """Each node has one parent at most, and the instances are not too many."""
    nodes = header.get("nodes", [])
    children = [child for node in nodes for child in node.get("children", [])]
    roots = _row(header, "scenes", header.get("scene", 0)).get("nodes", [])
    for index in (*children, *roots):
        _row(header, "nodes", index)
    if len({*children, *roots}) < len(children) + len(set(roots)):
        raise ValueError("a node has two parents, or its own children above it")
    total = 0
    for node in nodes:
        mesh = _row(header, "meshes", node["mesh"]) if "mesh" in node else {"primitives": []}
        for primitive in mesh["primitives"]:
            corners = primitive.get("indices", primitive["attributes"]["POSITION"])
            total += header["accessors"][corners]["count"] // 3
    if total > LARGEST_FACES:
        raise ValueError(f"it makes {total} triangles, expected at most {LARGEST_FACES}")


def _prepared(header: Mapping[str, Any]) -> dict[str, Any]:
    """What trimesh is given: geometry alone, each material a number in its name, the last for what has none."""
    materials = header.get("materials", [])
    keep = {
        name: header[name]
        for name in ("asset", "bufferViews", "accessors", "scenes", "scene")
        if name in header
    }
    meshes = []
    for k, mesh in enumerate(header.get("meshes", [])):
        primitives = []
        for primitive in mesh["primitives"]:
            own = primitive.get("material", len(materials))
            channel = _texture(materials[own] if own < len(materials) else {}).get("texCoord", 0)
            attributes = primitive["attributes"]
            taken = {"POSITION": "POSITION", "COLOR_0": "COLOR_0", "TEXCOORD_0": f"TEXCOORD_{channel}"}
            part = {name: primitive[name] for name in ("indices", "mode") if name in primitive}
            part["attributes"] = {name: attributes[of] for name, of in taken.items() if of in attributes}
            primitives.append(part | {"material": own})
        meshes.append({"name": f"mesh {k}", "primitives": primitives})
    nodes = []
    for k, node in enumerate(header.get("nodes", [])):
        part = {name: node[name] for name in node if name in _NODE}
        nodes.append(part | {"name": f"{node.get('name', 'node')}#{k}"})
    return keep | {
        "buffers": [{**b, "uri": f"buffer-{k}"} for k, b in enumerate(header.get("buffers", []))],
        "materials": [{"name": str(k)} for k in range(len(materials) + 1)],
        "meshes": meshes, "nodes": nodes,
    }  # fmt: skip


_NODE = ("mesh", "children", "matrix", "translation", "rotation", "scale")


def _texture(material: Mapping[str, Any]) -> dict[str, Any]:
    """The entry of a material's base colour texture; empty without any."""
    return dict(material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {}))


def _base_colour(header: Mapping[str, Any], index: int, buffers: list[bytes], folder: Folder) -> _Colour:
    """A material's name and colour."""
    material = header["materials"][index]
    factor = np.array(
        material.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1.0] * 4), dtype=np.float64
    )
    if factor.shape != (4,) or not np.isfinite(factor).all():
        raise ValueError(f"material {index} has the colour {factor}, expected four numbers")
    name, entry = material.get("name"), _texture(material)
    picture = None
    if entry and folder.colours:
        texture = _row(header, "textures", entry["index"])
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source")
        image = _row(header, "images", texture.get("source", webp))
        try:
            picture = read_picture(
                _image(header, image, buffers, folder), f"texture of material {name or index}"
            )
        except FileNotFoundError as error:
            warnings.warn(f"{error}; its colours stay unknown", UserWarning, stacklevel=5)
            factor = np.full(4, np.nan)
    if "KHR_texture_transform" in entry.get("extensions", {}):
        warnings.warn(
            f"path: {folder.path}: material {name or index} turns or repeats its texture by KHR_texture_transform, "
            "which is not read: colours of its faces may be off",
            UserWarning,
            stacklevel=5,
        )
    return _Colour(material_name(name, picture is not None), factor[:3], picture)


def _image(
    header: Mapping[str, Any], image: Mapping[str, Any], buffers: list[bytes], folder: Folder
) -> bytes:
    if "uri" in image:
        return _content(image["uri"], folder)
    view = _row(header, "bufferViews", image.get("bufferView"))
    start = view.get("byteOffset", 0)
    return buffers[view["buffer"]][start : start + view["byteLength"]]


def _joined(scene: Any, colours: list[_Colour]) -> MeshContent:
    """All instances as one mesh."""
    vertices, faces, linear, materials, objects, counts = [], [], [], [], [], []
    start = 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name]
        if not hasattr(part, "faces"):  # lines and points
            continue
        corner = np.asarray(part.faces, dtype=np.int64).reshape(-1, 3)
        if corner.max(initial=-1) >= len(part.vertices) or corner.min(initial=0) < 0:
            raise ValueError(f"indices of {name} reach {corner.max()}, of {len(part.vertices)} vertices")
        material = colours[int(part.visual.material.name)]
        linear.append(_face_colours(part, corner, material))
        turned = corner[:, ::-1] if np.linalg.det(transform[:3, :3]) < 0 else corner
        vertices.append(np.asarray(part.vertices, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3])
        faces.append(turned + start)
        start += len(part.vertices)
        materials.append(material.name)
        objects.append(str(node).rpartition("#")[0] or str(node))
        counts.append(len(corner))
    if not faces:
        raise ValueError("its default scene holds no triangles")
    colour = np.concatenate(linear)
    names, parts = numbered(materials, counts), numbered(objects, counts)
    return MeshContent(
        np.concatenate(vertices), np.concatenate(faces).astype(np.int32),
        face_colours=None if np.isnan(colour).all() else to_srgb(colour).astype(np.float32),
        face_material=names[0], material_names=names[1], face_object=parts[0], object_names=parts[1],
    )  # fmt: skip


def _face_colours(part: Any, corner: np.ndarray, material: _Colour) -> np.ndarray:
    """Linear colours (F, 3): the factor, times the texture and the vertices' where there are any; NaN where nothing is."""
    colour = np.broadcast_to(material.factor, (len(corner), 3)).copy()
    uv, vertex = part.visual.uv, part.visual.vertex_attributes.get("color")
    plain = material.picture is None or uv is None
    if material.picture is not None and uv is not None:
        if not np.isfinite(uv).all():
            raise ValueError("texture coordinates that are not finite")
        colour *= sampled(material.picture, np.asarray(uv, dtype=np.float64)[corner])
    if vertex is not None:
        held = np.asarray(vertex)
        most = np.iinfo(held.dtype).max if held.dtype.kind in "iu" else 1
        colour *= (held[:, :3].astype(np.float64) / most)[corner].mean(axis=1).clip(0.0, 1.0)
    elif plain and material.name is None and (material.factor == 1.0).all():
        colour[:] = np.nan  # white is what a file says that says nothing
    return colour
