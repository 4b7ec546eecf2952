"""glTF 2.0 files, text or binary (GLB): the triangles of the default scene in their places, with names and colours.

What a file's tables state is held against what is there before it is read; what is not read is an error: compressed or
sparse data, fans, skins, morphed shapes, nodes in circles. Files that it names are found by us: they don't leave the folder.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from warprrf.checks import warn
from warprrf.geometry.mesh_content import (
    LARGEST_FACES,
    Folder,
    MeshContent,
    material_name,
    numbered,
    read_picture,
    sampled,
    to_srgb,
)

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_JSON = 0x4E4F534A  # kind of the chunk that holds the header
_HARMLESS = ("KHR_materials_", "KHR_lights_", "KHR_texture_transform", "EXT_texture_webp", "KHR_xmp")
"""Beginnings of the names of extensions that do not change where surfaces are."""
_INSTANCES = "EXT_mesh_gpu_instancing"


def read_gltf(folder: Folder) -> MeshContent:
    """Read the glTF or GLB file of ``folder``: every instance of its default scene, in its place.

    Raises:
        FileNotFoundError: if a buffer beside it is missing.
        ValueError: naming the file, if it is damaged, compressed, or names files outside its folder.

    Warns:
        UserWarning: if a texture is missing: those colours stay unknown.
    """
    try:
        return _joined(_File(folder))
    except (ImportError, OSError, MemoryError):
        raise
    except Exception as error:  # a header may hold anything in place of anything
        reason = error if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        reason = str(reason).removeprefix(f"path: {folder.path} ")
        raise ValueError(f"path: {folder.path} is not a readable mesh: {reason}") from error


@dataclass(frozen=True)
class _Material:
    """A name, a linear colour (3,), and the picture that it is multiplied with."""

    name: str | None
    factor: np.ndarray
    picture: np.ndarray | None = None


_Part = tuple[str | None, np.ndarray, np.ndarray, np.ndarray]
"""Of a mesh: a material's name, positions (V, 3), corners (F, 3) and linear colours (F, 3) of its triangles."""


class _File:
    """The header and the buffers of a file; its rows are read when they are asked for."""

    def __init__(self, folder: Folder) -> None:
        self.folder, self.triangles = folder, 0  # those that were made
        self.header, binary = _split(folder.path)
        needed = [*self.header.get("extensionsRequired", [])]
        if _INSTANCES in self.header.get("extensionsUsed", []):
            needed.append(_INSTANCES)  # without it copies are missing, required or not
        unread = [x for x in dict.fromkeys(map(str, needed)) if not x.startswith(_HARMLESS)]
        if unread:
            raise ValueError(f"it needs the extension {', '.join(unread)}; export it without")
        self.buffers = []
        for k, buffer in enumerate(self.header.get("buffers", [])):
            data = self.file(buffer["uri"]) if "uri" in buffer else binary if k == 0 else None
            if data is None or len(data) < buffer["byteLength"]:
                raise ValueError(
                    f"buffer {k} is not there, or shorter than the {buffer['byteLength']} bytes stated"
                )
            self.buffers.append(data)
        self.picture = lru_cache(None)(self._picture)  # materials share them
        self.material = lru_cache(None)(self._material)
        self.parts = lru_cache(None)(self._parts)

    def file(self, uri: str) -> bytes:
        if not uri.startswith("data:"):
            return self.folder.find(unquote(uri)).read_bytes()
        return base64.b64decode(uri.partition("base64,")[2], validate=True)

    def row(self, table: str, index: object) -> dict[str, Any]:
        rows = self.header.get(table, [])
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(rows):
            raise ValueError(f"it names {table} {index!r} of {len(rows)}")
        return dict(rows[index])

    def view(self, index: object) -> bytes:
        row = self.row("bufferViews", index)
        self.row("buffers", row["buffer"])
        data, start = self.buffers[row["buffer"]], row.get("byteOffset", 0)
        _check_span(f"buffer view {index}", start, row["byteLength"], len(data))
        return data[start : start + row["byteLength"]]

    def numbers(self, index: object) -> np.ndarray:
        """The numbers of an accessor, shape ``(count, width)``."""
        row = self.row("accessors", index)
        if "sparse" in row or "bufferView" not in row:
            raise ValueError(f"accessor {index} is sparse or without data; export it without compression")
        data, given = self.view(row["bufferView"]), self.row("bufferViews", row["bufferView"])
        kind, width = np.dtype(_TYPES[row["componentType"]]), _WIDTHS[row["type"]]
        item = kind.itemsize * width
        stride = given.get("byteStride", item)
        if not isinstance(stride, int) or not item <= stride <= max(item, 252):
            raise ValueError(f"accessor {index} has items of {item} bytes every {stride!r} bytes")
        start, length = row.get("byteOffset", 0), stride * (row["count"] - 1) + item
        _check_span(f"accessor {index}", start, length, len(data))
        return np.ndarray((row["count"], width), kind, data, start, (stride, kind.itemsize))

    def _parts(self, mesh: int) -> list[_Part]:
        """The triangles of a mesh; points and lines are left out."""
        kinds, found = (_TRIANGLES, _STRIP, _FAN), []
        for primitive in self.row("meshes", mesh)["primitives"]:
            if primitive.get("mode", _TRIANGLES) in kinds:
                try:
                    found.append(self._part(primitive))
                except ValueError as error:
                    raise ValueError(f"mesh {mesh}: {error}") from error
        return found

    def _part(self, primitive: Mapping[str, Any]) -> _Part:
        of_vertices = {name: self.numbers(index) for name, index in primitive["attributes"].items()}
        positions = of_vertices["POSITION"]
        for name, values in of_vertices.items():
            if len(values) != len(positions):
                raise ValueError(f"{len(values)} of {name} for {len(positions)} vertices")
        if positions.shape[1] != 3 or positions.dtype.kind != "f":
            raise ValueError("positions are no triples of numbers, or compressed")
        index = np.arange(len(positions))[:, None]
        if "indices" in primitive:
            index = self.numbers(primitive["indices"])
        if index.shape[1] != 1 or index.dtype.kind == "f":
            raise ValueError("indices are no whole numbers")
        corners = _corners(index[:, 0].astype(np.int64), primitive.get("mode", _TRIANGLES))
        if corners.max(initial=-1) >= len(positions) or corners.min(initial=0) < 0:
            raise ValueError(f"indices reach {corners.max()}, of {len(positions)} vertices")
        material, channel = _Material(None, np.ones(3)), 0
        if "material" in primitive:
            material = self.material(primitive["material"])
            channel = _colour(self.row("materials", primitive["material"]))[1].get("texCoord", 0)
        uv, own = of_vertices.get(f"TEXCOORD_{channel}"), of_vertices.get("COLOR_0")
        colours = np.tile(material.factor, (len(corners), 1))
        if uv is not None and material.picture is not None:
            if not np.isfinite(uv).all():
                raise ValueError("texture coordinates are not finite")
            u, v = _shares(uv).T
            colours *= sampled(material.picture, np.column_stack([u, 1.0 - v])[corners])
        elif own is None and material.name is None and (material.factor == 1.0).all():
            colours[:] = np.nan  # white is what a file says that says nothing
        if own is not None:
            colours *= _shares(own[:, :3])[corners].mean(axis=1).clip(0.0, 1.0)
        self.triangles = _counted(self.triangles, corners, positions)
        return material.name, positions.astype(np.float64), corners, colours

    def _picture(self, source: str | int) -> np.ndarray:
        data = self.file(source) if isinstance(source, str) else self.view(source)
        return read_picture(data, f"texture {source!r:.60}")

    def _material(self, index: int) -> _Material:
        material, path = self.row("materials", index), self.folder.path
        stated, entry = _colour(material)
        factor = np.array(stated, dtype=np.float64)
        if factor.shape != (4,) or not np.isfinite(factor).all():
            raise ValueError(f"material {index} has the colour {factor}, expected four numbers")
        name, picture = material.get("name"), None
        if entry and self.folder.colours:
            texture = self.row("textures", entry["index"])
            webp = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source")
            image = self.row("images", texture.get("source", webp))
            try:
                picture = self.picture(image["uri"] if "uri" in image else image.get("bufferView"))
            except FileNotFoundError as error:
                warn(f"{error}; its colours stay unknown")
                factor = np.full(4, np.nan)
        if "KHR_texture_transform" in entry.get("extensions", {}):
            warn(
                f"path: {path}: material {name or index} turns or repeats its texture by KHR_texture_transform, "
                "which is not read: colours of its faces may be off"
            )
        return _Material(material_name(name, picture is not None), factor[:3], picture)

    def instances(self) -> Iterator[tuple[str, np.ndarray, list[_Part]]]:
        """Name, place (4, 4) and parts of every node of the default scene that has a mesh."""
        if not self.header.get("scenes"):
            raise ValueError(
                "it is a library of parts without a scene, which says where they stand; export it with one"
            )
        roots = self.row("scenes", self.header.get("scene", 0)).get("nodes", [])
        todo, met = [(index, np.eye(4)) for index in reversed(roots)], set[int]()
        while todo:
            index, above = todo.pop()
            node = self.row("nodes", index)
            if index in met:
                raise ValueError("a node has two parents, or its own children above it")
            met.add(index)
            place = above @ _transform(node)
            todo += [(child, place) for child in reversed(node.get("children", []))]
            if "mesh" in node:
                mesh = self.row("meshes", node["mesh"])
                if "skin" in node or any(node.get("weights", mesh.get("weights", ()))):
                    raise ValueError(
                        f"node {index} is moved by a skin or morph weights; export it with these applied"
                    )
                yield str(node.get("name", mesh.get("name", "node"))), place, self.parts(node["mesh"])


def _split(path: Path) -> tuple[dict[str, Any], bytes | None]:
    data, binary = path.read_bytes(), None
    if data[:4] == b"glTF":
        version, whole, size, kind = np.frombuffer(data[4:20], "<u4").tolist()
        if version != 2 or whole != len(data):
            raise ValueError(f"it states version {version} and {whole} bytes, expected 2 and {len(data)}")
        rest = data[20 + size :]
        if (
            kind != _JSON
            or 20 + size > len(data)
            or rest
            and 8 + int.from_bytes(rest[:4], "little") > len(rest)
        ):
            raise ValueError("it is cut short within a chunk, or does not begin with its header")
        data, binary = data[20 : 20 + size], rest[8:]
    header = json.loads(data.decode("utf-8"))
    if not isinstance(header, dict) or not str(header.get("asset", {}).get("version", "")).startswith("2."):
        raise ValueError("it states no glTF version 2 (asset.version)")
    return header, binary


def _check_span(what: str, start: object, length: object, whole: int) -> None:
    numbers = [x for x in (start, length) if isinstance(x, int) and not isinstance(x, bool) and x >= 0]
    if len(numbers) < 2 or sum(numbers) > whole:
        raise ValueError(f"{what} states {length!r} bytes from {start!r} on, of {whole}")


def _counted(total: int, corners: np.ndarray, positions: np.ndarray) -> int:
    """``total`` with more triangles: a file of few bytes may make many."""
    total += max(len(corners), len(positions) // 3)
    if total > LARGEST_FACES:
        raise ValueError(f"it makes more than {LARGEST_FACES} triangles")
    return total


def _corners(index: np.ndarray, mode: int) -> np.ndarray:
    """Triangles (F, 3) of a list or a strip."""
    if mode == _FAN:
        raise ValueError("it is of fans of triangles; export it as triangles")
    if mode == _TRIANGLES:
        return index.reshape(-1, 3)
    strip = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    strip[1::2, :2] = strip[1::2, 1::-1]
    return strip[(strip != np.roll(strip, 1, axis=1)).all(axis=1)]


def _shares(values: np.ndarray) -> np.ndarray:
    """Numbers as they are, whole ones as shares of the largest."""
    return values / np.float64(1 if values.dtype.kind == "f" else np.iinfo(values.dtype).max)


def _colour(material: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The factor and the texture of a material's colour; those of glossy materials stand in an extension."""
    usual = material.get("pbrMetallicRoughness", {})
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    texture = usual.get("baseColorTexture", glossy.get("diffuseTexture", {}))
    return usual.get("baseColorFactor", glossy.get("diffuseFactor", [1.0] * 4)), dict(texture)


def _transform(node: Mapping[str, Any]) -> np.ndarray:
    """A node's place in the one above it, shape ``(4, 4)``."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    place = np.eye(4)
    scale = np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64).reshape(3)
    place[:3, :3] = Rotation.from_quat(node.get("rotation", (0.0, 0.0, 0.0, 1.0))).as_matrix() * scale
    place[:3, 3] = np.array(node.get("translation", (0.0, 0.0, 0.0)), dtype=np.float64).reshape(3)
    return place


def _joined(file: _File) -> MeshContent:
    vertices, faces, colours, materials, objects, counts = [], [], [], [], [], []
    start = total = 0
    for name, place, parts in file.instances():
        for material, positions, corners, colour in parts:
            total = _counted(total, corners, positions)
            vertices.append(positions @ place[:3, :3].T + place[:3, 3])
            faces.append((corners[:, ::-1] if np.linalg.det(place[:3, :3]) < 0 else corners) + start)
            start += len(positions)
            colours.append(colour)
            materials.append(material)
            objects.append(name)
            counts.append(len(corners))
    if not faces:
        raise ValueError("its default scene holds no triangles")
    colour = np.concatenate(colours)
    names, things = numbered(materials, counts), numbered(objects, counts)
    return MeshContent(
        np.concatenate(vertices), np.concatenate(faces).astype(np.int32),
        face_colours=None if np.isnan(colour).all() else to_srgb(colour).astype(np.float32),
        face_material=names[0], material_names=names[1], face_object=things[0], object_names=things[1],
    )  # fmt: skip
