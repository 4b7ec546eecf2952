"""Every file format: an example of it, how it is read, what is asked of it then, and what is done to it.

An edit is a name and two numbers, which pick the place and the value, so that it fits a file of any size and can be
repeated. Edits of bytes fit every file. A codec takes a file apart into nested dictionaries, lists and arrays, and puts it
together again with whatever checksum the format has: that tests what stands behind the checksum.
"""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from model_files import obj_with_materials, room_glb, room_gltf
from twin_fields import known_field

import warprrf as wr
from fuzz.place import MANY, POINTS, Place
from fuzz.values import ARRAYS, PLAIN
from warprrf import tensor_files
from warprrf.cli.inputs import read_positions, read_receivers
from warprrf.files import check_seal, read_arrays, read_json, write_arrays, write_bytes, write_json
from warprrf.geometry.mesh_files import read_mesh
from warprrf.geometry.photos.posed.photo_files import check_photos, find_photos, read_photo
from warprrf.geometry.photos.posed.poses import DepthFile, read_depth, read_poses
from warprrf.geometry.photos.posed.sfm import read_colmap
from warprrf.netcdf_files import check_heaps
from warprrf.rf.interop.twin import write_twin
from warprrf.steps import Steps

Edit = tuple[str, int, int]
INSERTED = [
    *(n.to_bytes(w, order, signed=True) for n in (-1, 0, 2**31 - 1, 10**9, 10**6) for w in (4, 8) for order in ("little", "big")),
    *(bytes([n]) for n in (0, 255, 127, 128, 10, 32, 45, 57)), b"",
]  # fmt: skip
"""What stands for sizes, letters and ends in files, and nothing."""


def _flip(data: bytearray, a: int, b: int) -> None:
    data[a % len(data)] ^= 1 << b % 8


def _cut(data: bytearray, a: int, b: int) -> None:
    del data[a % len(data) :]


def _put(data: bytearray, a: int, b: int) -> None:
    """Something in the place of as many bytes, of none, or of some."""
    at, new = a % len(data) // (1 + 3 * (b % 2)) * (1 + 3 * (b % 2)), INSERTED[b % len(INSERTED)]
    data[at : at + (len(new), 0, a % 64)[b // 64 % 3]] = new


def _copy_part(data: bytearray, a: int, b: int) -> None:
    """A part, or all from the beginning, once more, in the place of another part, or between."""
    part = data[: 1 + a % len(data)] if b % 4 == 0 else data[a % len(data) :][:16]
    at = len(data) if b % 4 == 0 else b % len(data)
    data[at : at + 16 * (b % 2)] = part


BYTES: dict[str, Callable[[bytearray, int, int], None]] = {
    "flip": _flip, "cut": _cut, "put": _put, "copy": _copy_part,
}  # fmt: skip
BYTES |= {
    # the first bytes say how to read the others
    f"{name} early": lambda data, a, b, edit=BYTES[name]: edit(data, a % min(len(data), 512), b)
    for name in ("flip", "cut", "put")
}
"""Edits of bytes: what they do at ``a`` with ``b``."""

TREE = ("drop", "rename", "replace", "double", "blank")
"""Edits of contents: an item is left out, gets another name, another value, comes twice, loses what it holds."""


class Unfit(Exception):
    """There is no file with this damage."""


def damage(path: Path, codec: str, edits: tuple[Edit, ...]) -> None:
    """Edit a file in place.

    Raises:
        Unfit: if the codec cannot write what was made of the contents, or there is none.
    """
    for name, a, b in edits:
        if name in BYTES:
            data = bytearray(path.read_bytes())
            if data:
                BYTES[name](data, a, b)
            path.write_bytes(data)
            continue
        if not codec:
            raise Unfit("bytes only")
        unpack, pack = CODECS[codec]
        try:
            tree = unpack(path)
            _edit_tree(tree, name, a, b)
            pack(path, tree)
        # An earlier edit broke it, or whatever writers trip over: there is no such file.
        except Exception as error:
            raise Unfit(str(error)) from error


def _edit_tree(tree: Any, name: str, a: int, b: int) -> None:
    places = list(_places(tree))
    inside, key = places[a % len(places)]
    value = inside[key]
    if name == "drop":
        del inside[key]
    elif name == "rename" and isinstance(inside, dict):
        inside[f"{key}_"] = inside.pop(key)
    elif name == "double" and isinstance(inside, list):
        inside.insert(key, deepcopy(value))
    elif name == "blank":
        simple = isinstance(value, (dict, list, str, int, float))
        inside[key] = type(value)() if simple else np.zeros_like(value)
    else:
        made = list(ARRAYS.values()) if isinstance(value, np.ndarray) else []
        k = b % (len(PLAIN) + len(made))
        inside[key] = [*PLAIN.values()][k] if k < len(PLAIN) else made[k - len(PLAIN)](value)


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every item of nested dictionaries and lists, as what holds it and its key there."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(items):
        yield tree, key
        yield from _places(value)


def _read_tensors(path: Path) -> Any:
    from safetensors import safe_open

    with safe_open(path, framework="numpy") as file:
        kind = (file.metadata() or {}).get("format")
    tensors, header = tensor_files.read(path, kind)
    return {"kind": kind, "tensors": tensors, "header": header}


def _write_tensors(path: Path, tree: Any) -> None:
    tensors = {k: np.asarray(v) for k, v in tree["tensors"].items()}
    tensor_files.write(path, tensors, tree["header"], tree["kind"])


def _read_netcdf(path: Path) -> Any:
    import xarray

    check_heaps(path)
    with xarray.open_dataset(path, engine="h5netcdf", decode_cf=False) as opened:
        data = opened.load()
    parts = {str(k): [list(map(str, v.dims)), v.values, dict(v.attrs)] for k, v in data.variables.items()}
    return {"variables": parts, "attributes": dict(data.attrs)}


def _write_netcdf(path: Path, tree: Any) -> None:
    import xarray

    variables = {k: (tuple(d), np.asarray(v), a) for k, (d, v, a) in tree["variables"].items()}
    xarray.Dataset(variables, attrs=tree["attributes"]).to_netcdf(path, engine="h5netcdf")


def _read_zip(path: Path) -> Any:
    with np.load(path, allow_pickle=False) as stored:
        return dict(stored)


def _write_zip(path: Path, tree: Any) -> None:
    with path.open("wb") as out:
        np.savez_compressed(out, **{k: np.asarray(v) for k, v in tree.items()})


def _element(e: ElementTree.Element) -> dict[str, Any]:
    return {"tag": e.tag, "attributes": dict(e.attrib), "children": [_element(c) for c in e]}


def _xml(tree: Any) -> str:
    if not isinstance(tree, dict):
        return str(tree)
    attributes = tree.get("attributes", {})
    words = " ".join(f'{k}="{v}"' for k, v in (attributes.items() if isinstance(attributes, dict) else ()))
    inside, tag = "".join(map(_xml, tree.get("children") or [])), tree.get("tag", "none")
    return f"<{tag} {words}>{inside}</{tag}>"


def _read_words(path: Path) -> Any:
    """Lines of words; what follows a header that ends so is kept as it is."""
    head, end, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split(" ") for line in head.decode("latin-1").split("\n")]
    return {"lines": lines, "rest": [(end + body).hex()]}


def _write_words(path: Path, tree: Any) -> None:
    lines = (line if isinstance(line, list) else [line] for line in tree.get("lines") or [])
    text = "\n".join(" ".join(map(str, line)) for line in lines)
    path.write_bytes(text.encode("latin-1", "replace") + bytes.fromhex("".join(tree.get("rest") or [])))


CODECS: dict[str, tuple[Callable[[Path], Any], Callable[[Path, Any], object]]] = {
    "json": (lambda p: [json.loads(p.read_text())], lambda p, t: p.write_text(json.dumps(*t))),
    "tensors": (_read_tensors, _write_tensors),
    "netcdf": (_read_netcdf, _write_netcdf),
    "zip": (_read_zip, _write_zip),
    "xml": (lambda p: _element(ElementTree.parse(p).getroot()), lambda p, t: p.write_text(_xml(t))),
    "words": (_read_words, _write_words),
}
"""How contents are taken out of a file and put back."""


@dataclass(frozen=True)
class Format:
    """One kind of file.

    Attributes:
        make: writes an example into a folder of its own and returns the file that is damaged.
        read: reads it, and asks what a user would ask of it: what was accepted must be of use.
        codec: how its contents are edited, by :data:`CODECS`; empty: bytes only.
        law: "sealed": it carries a checksum, edits of bytes are refused or change nothing. "one value": a flipped bit
            changes one value of the first part that is read (four numbers of a quaternion) at most, a cut nothing.
            "whole": a cut changes nothing. "numbers": what is read is numbers.
        held: attributes of what was read that its answers may be refused by.
        unknown: ends of the names of numbers that may be NaN, as a file may say that they were not measured.
    """

    make: Callable[[Place, Path], Path]
    read: Callable[[Path], Any]
    codec: str = ""
    law: str = ""
    held: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()


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


def _made(name: str, write: Callable[[Place, Path], object]) -> Callable[[Place, Path], Path]:
    """A file of that name, which ``write`` writes."""

    def make(place: Place, folder: Path) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write(place, path)
        return path

    return make


def _text(name: str, content: str) -> Callable[[Place, Path], Path]:
    return _made(name, lambda place, path: path.write_text(content))


def without_checksum(place: Place, path: Path) -> None:
    """The bistatic field as something else would write it."""
    data = (place.folder / "bistatic.safetensors").read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"].pop("sha256")
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + size :])


def _field(path: Path) -> Any:
    field = wr.RadioField.load(path, device="cpu")
    return field, field.spectrum(POINTS[1]), field.paths(POINTS[1], max_paths=10)


def _resumed(path: Path) -> Any:
    field = wr.RadioField.load(path.with_name("bistatic.safetensors"), device="cpu")
    return np.array(field.spectra(MANY, store=path.with_name("store.nc")).path_gain)


def _splats(path: Path) -> Any:
    g = wr.Gaussians.load_ply(path)
    return g, wr.render(g, wr.Camera.spherical(24, 12, position=POINTS[0]), device="cpu")


def _photo(path: Path) -> Any:
    check_photos(find_photos(path.parent))
    return read_photo(path)


def _mesh(path: Path) -> Any:
    content = read_mesh(path)
    mesh = wr.Mesh(content.vertices, content.faces)
    return (mesh.vertices, mesh.faces, content.uv), mesh.distance(POINTS, device="cpu"), mesh.face_normals


def _scene(path: Path) -> Any:
    scene = wr.Scene.load(path.with_name("scene.xml"))
    values = [[m.permittivity(300e9), m.scattering_coefficient(300e9)] for m in scene.materials]
    return (scene.mesh.vertices, scene.mesh.faces, scene.face_material, np.array(values)), scene


def _paths(path: Path) -> Any:
    paths = wr.Paths.load(path)
    # Of paths without power no mean is known.
    return paths, paths.power, paths.dispersion() if paths.power.any() else None, paths.cir()


ARRAYS_HELD = {"a": np.linspace(0.0, 1.0, 60), "b": np.ones((9, 9), np.int32)}


def _cached(path: Path) -> Any:
    with Steps(path.parent, shared=True) as steps:
        return steps.arrays("step", lambda: ARRAYS_HELD, version=1, inputs=[1])


def _recorded(path: Path) -> Any:
    with Steps(path.parent.parent) as steps:
        found = steps.run("step", lambda attempt: {"a": 1.0}, version=1, inputs=[1])
        return found, steps.records["step"]


def _frame(place: Place, path: Path) -> None:
    np.savetxt(path.with_name("camera-intrinsics.txt"), np.array([[60.0, 0, 16], [0, 60, 12], [0, 0, 1]]))
    np.savetxt(path, np.eye(4))


def _depth(place: Place, path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.arange(600, dtype=np.uint16).reshape(20, 30)).save(path)


TRANSFORMS = (
    '{"fl_x": 60.0, "w": 32, "h": 24, "k1": 0.1, "frames": [{"file_path": "0.png", "transform_matrix": '
    "[[1, 0, 0, 1.0], [0, 1, 0, 2.0], [0, 0, 1, 1.5], [0, 0, 0, 1]]}]}\n"
)
SURVEYED = '{"0.png": [1.0, 2.0, 1.5], "1.jpg": [3.0, 1.0, 1.2]}\n'
ROOM = ("scene.xml", "materials.json", "walls.ply", "block.ply")
TWIN = _made("twin/scene.xml", lambda place, path: write_twin(known_field(), path.parent))
COLMAP = ("cameras", "images", "points3D")
READINGS = {"frequency_hz": 300e9, "floor": 1e-14}

FORMATS: dict[str, Format] = {
    **{
        f"{how}spectra": Format(
            _copy(file), wr.SpectrumDataset.load, "netcdf", "sealed", unknown=(".path_gain", ".delay_s", ".aod")
        )
        for how, file in (("", "spectra.nc"), ("compact ", "compact.nc"))
    },
    **{
        f"{name} field": Format(_copy(f"{name}.safetensors"), _field, "tensors", "sealed", ("transmitter",))
        for name in ("bistatic", "harmonic", "rf3dgs")
    },
    "field without checksum": Format(
        _made("old.safetensors", without_checksum), _field, "", "whole", ("transmitter", "receivers")
    ),
    "unfinished store": Format(_copy("store.nc.unfinished", "bistatic.safetensors"), _resumed, "", "sealed"),
    "paths": Format(_copy("paths.nc"), _paths, "netcdf", "sealed", unknown=(".jones",)),
    "reconstruction": Format(
        _copy("reconstruction/reconstruction.safetensors"), lambda p: wr.Reconstruction.load(p.parent), "tensors", "sealed"
    ),
    "radio map": Format(_copy("map.nc"), wr.RadioMap.load, "netcdf", "sealed"),
    "relevance": Format(_copy("relevance.json"), wr.Relevance.load, "json"),
    "step arrays": Format(
        _made("step.npz", lambda place, path: _cached(path)), _cached, "zip", "sealed", unknown=("",)  # of any kind
    ),
    "step record": Format(_made(".steps/step.json", lambda place, path: _recorded(path)), _recorded, "json"),
    **{
        f"arrays, {how}": Format(
            _made("a.npz", lambda p, path, c=c: write_arrays(path, ARRAYS_HELD, compress=c)), read_arrays, "", "sealed"
        )
        for how, c in (("compressed", True), ("plain", False))
    },
    "JSON": Format(
        _made("a.json", lambda p, path: write_json(path, {"b": [1, 2.5, 1e-30, None, "ö"], "a": {"c": True}}, seal=True)),
        read_json, "json", "sealed",
    ),
    "seal": Format(
        _made("a", lambda p, path: write_bytes(path, bytes(range(250)), seal=True)),
        lambda p: np.frombuffer(p.read_bytes() if check_seal(p) else bytes(range(250)), np.uint8)[:250], "", "sealed",
    ),
    "splats": Format(_copy("splats.ply"), _splats, "words", "one value"),
    "scene": Format(_copy(*ROOM), wr.Scene.load, "xml"),
    "scene as text": Format(_copy(*ROOM), wr.Scene.load, "words"),
    "twin": Format(TWIN, _scene, "xml", "one value"),
    "twin's materials": Format(
        lambda place, folder: TWIN(place, folder).with_name("materials.json"), _scene, "json", "sealed"
    ),
    "materials": Format(_copy("materials.json"), wr.em.load_materials, "json"),
    "antenna": Format(_copy("sector.msi"), wr.Antenna.load, "words"),
    "readings": Format(_copy("readings.csv"), lambda p: wr.Readings.load(p, **READINGS), "words"),
    "receivers CSV": Format(
        _text("receivers.csv", "x,y,z\n1.0,2.0,1.5\n3.0,1.0,1.2\n"), lambda p: read_receivers([str(p)]), "words"
    ),
    "receivers NPY": Format(_made("r.npy", lambda p, path: np.save(path, POINTS)), lambda p: read_receivers([str(p)])),
    "positions JSON": Format(_text("surveyed.json", SURVEYED), read_positions, "json"),
    "positions CSV": Format(_text("surveyed.csv", "file,x,y,z\n0.png,1,2,1.5\n"), read_positions, "words"),
    "transforms": Format(_text("transforms.json", TRANSFORMS), read_poses, "json"),
    "pose of a frame": Format(_made("frame-0.pose.txt", _frame), lambda p: read_poses(p.parent), "words"),
    "depth PNG": Format(_made("depth.png", _depth), lambda p: read_depth(DepthFile(p))),
    "PNG": Format(_copy("photos/0.png"), _photo),
    "JPEG": Format(_copy("photos/1.jpg"), _photo),
    "PLY mesh": Format(_copy("walls.ply"), _mesh, "words", "one value"),
    "OBJ mesh": Format(lambda place, folder: obj_with_materials(folder), _mesh, "words", "numbers"),
    "STL mesh": Format(_made("a.stl", lambda p, path: trimesh.creation.box().export(path)), _mesh, "", "whole"),
    "GLB mesh": Format(lambda place, folder: room_glb(folder), _mesh, "", "whole"),
    "glTF mesh": Format(lambda place, folder: room_gltf(folder), _mesh, "json", "numbers"),
    **{f"COLMAP {k}": Format(_copy(f"colmap/{k}.bin"), lambda p: read_colmap(p.parent)) for k in COLMAP},
    **{
        f"COLMAP {k} text": Format(_copy(f"colmap_text/{k}.txt"), lambda p: read_colmap(p.parent), "words") for k in COLMAP
    },
}  # fmt: skip
"""By name."""
