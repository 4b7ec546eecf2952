"""What is done to files: to their bytes, and to their contents behind checksums and headers.

An edit is a name and two numbers, which pick the place and the value, so that it fits a file of any size and can be
repeated. A codec takes a file apart into nested dictionaries, lists and arrays, and puts it together again with whatever
checksum the format has: that tests what stands behind the checksum.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz.values import ARRAYS, PLAIN

Edit = tuple[str, int, int]
_SIZES = tuple(
    n.to_bytes(w, order, signed=n < 0)
    for n in (-1, 0, 2**31 - 1, 10**9, 10**6)
    for w in (4, 8)
    for order in ("little", "big")  # type: ignore[var-annotated]
)


def _flip(data: bytearray, a: int, b: int) -> None:
    data[a % len(data)] ^= 1 << b % 8


def _set(data: bytearray, a: int, b: int) -> None:
    data[a % len(data)] = (0, 255, 127, 128, 10, 32, 45, 57)[b % 8]


def _cut(data: bytearray, a: int, b: int) -> None:
    del data[a % len(data) :]


def _insert(data: bytearray, a: int, b: int) -> None:
    at = a % len(data)
    data[at:at] = bytes((b + k) % 256 for k in range(1 + b % 9))


def _remove(data: bytearray, a: int, b: int) -> None:
    at = a % len(data)
    del data[at : at + 1 + b % 64]


def _swap(data: bytearray, a: int, b: int) -> None:
    one, other, size = a % len(data), b % len(data), 16
    first, second = bytes(data[one : one + size]), bytes(data[other : other + size])
    data[one : one + size], data[other : other + size] = second, first


def _size(data: bytearray, a: int, b: int) -> None:
    value = _SIZES[b % len(_SIZES)]
    at = a % len(data) // 4 * 4
    data[at : at + len(value)] = value


def _append(data: bytearray, a: int, b: int) -> None:
    data += bytes(data[: 1 + a % len(data)])


def _header(edit: Callable[[bytearray, int, int], None]) -> Callable[[bytearray, int, int], None]:
    """The same within the first bytes, which say how to read the others."""
    return lambda data, a, b: edit(data, a % min(len(data), 512), b)


BYTES: dict[str, Callable[[bytearray, int, int], None]] = {
    "flip": _flip,
    "set": _set,
    "cut": _cut,
    "insert": _insert,
    "remove": _remove,
    "swap": _swap,
    "size": _size,
    "append": _append,
    "flip early": _header(_flip),
    "set early": _header(_set),
    "cut early": _header(_cut),
    "size early": _header(_size),
    "remove early": _header(_remove),
}
"""Edits of bytes: what they do at ``a`` with ``b``."""


def damage(path: Path, codec: str, edits: tuple[Edit, ...]) -> None:
    """Edit a file in place.

    Raises:
        Unfit: if the codec cannot write what was made of the contents.
    """
    for name, a, b in edits:
        if name in BYTES:
            data = bytearray(path.read_bytes())
            if data:
                BYTES[name](data, a, b)
            path.write_bytes(data)
            continue
        unpack, pack = CODECS[codec]
        try:
            tree = unpack(path)
        except Exception as error:  # an earlier edit broke it
            raise Unfit(str(error)) from error
        _edit_tree(tree, name, a, b)
        try:
            pack(path, tree)
        except Exception as error:  # whatever writers trip over: there is no such file to read
            raise Unfit(str(error)) from error


class Unfit(Exception):
    """There is no file with this damage."""


TREE = ("drop", "rename", "replace", "double", "blank")
"""Edits of contents: an item is left out, gets another name, another value, comes twice, loses what it holds."""


def _edit_tree(tree: Any, name: str, a: int, b: int) -> None:
    places = list(_places(tree))
    if not places:
        raise Unfit("nothing to edit")
    inside, key = places[a % len(places)]
    value = inside[key]
    if name == "drop":
        del inside[key]
    elif name == "rename" and isinstance(inside, dict):
        inside[f"{key}_"] = inside.pop(key)
    elif name == "double" and isinstance(inside, list):
        inside.insert(key, deepcopy(value))
    elif name == "blank":
        inside[key] = (
            type(value)() if isinstance(value, (dict, list, str, int, float)) else np.zeros_like(value)
        )
    else:
        values = PLAIN | ARRAYS if isinstance(value, np.ndarray) else PLAIN
        try:
            inside[key] = values[list(values)[b % len(values)]](value)
        except (TypeError, ValueError, IndexError) as error:
            raise Unfit(str(error)) from error


def _places(tree: Any) -> Any:
    """Every item of nested dictionaries and lists, as what holds it and its key there."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(items):
        yield tree, key
        yield from _places(value)


def _read_tensors(path: Path) -> Any:
    from safetensors import safe_open

    from warprrf import tensor_files

    with safe_open(path, framework="numpy") as file:
        kind = (file.metadata() or {}).get("format")
    tensors, header = tensor_files.read(path, kind)
    return {"kind": kind, "tensors": tensors, "header": header}


def _write_tensors(path: Path, tree: Any) -> None:
    from warprrf import tensor_files

    tensors = {k: np.asarray(v) for k, v in tree["tensors"].items()}
    tensor_files.write(path, tensors, tree["header"], tree["kind"])


def _read_netcdf(path: Path) -> Any:
    import xarray

    with xarray.open_dataset(path, engine="h5netcdf", decode_cf=False) as opened:
        data = opened.load()
    return {
        "variables": {
            str(k): [list(map(str, v.dims)), v.values, dict(v.attrs)] for k, v in data.variables.items()
        },
        "attributes": dict(data.attrs),
    }


def _write_netcdf(path: Path, tree: Any) -> None:
    import xarray

    variables = {k: (tuple(d), np.asarray(v), a) for k, (d, v, a) in tree["variables"].items()}
    xarray.Dataset(variables, attrs=tree["attributes"]).to_netcdf(path, engine="h5netcdf")


def _read_zip(path: Path) -> Any:
    with np.load(path, allow_pickle=False) as stored:
        return dict(stored)


def _write_zip(path: Path, tree: Any) -> None:
    with path.open("wb") as out:
        np.savez_compressed(out, **{k: np.asarray(v) for k, v in tree.items()})  # type: ignore[arg-type]


def _read_xml(path: Path) -> Any:
    return _element(ElementTree.parse(path).getroot())


def _element(e: ElementTree.Element) -> dict[str, Any]:
    return {"tag": e.tag, "attributes": dict(e.attrib), "children": [_element(c) for c in e]}


def _write_xml(path: Path, tree: Any) -> None:
    path.write_text(_xml(tree), encoding="utf-8")


def _xml(tree: Any) -> str:
    if not isinstance(tree, dict):
        return str(tree)
    attributes = tree.get("attributes", {})
    pairs = attributes.items() if isinstance(attributes, dict) else []
    words = " ".join(f'{k}="{v}"' for k, v in pairs)
    inside = "".join(map(_xml, tree.get("children") or []))
    tag = tree.get("tag", "none")
    return f"<{tag} {words}>{inside}</{tag}>"


def _read_words(path: Path) -> Any:
    """Lines of words; what follows a header that ends so is kept as it is."""
    head, end, body = path.read_bytes().partition(b"end_header\n")
    return {
        "lines": [line.split(" ") for line in head.decode("latin-1").split("\n")],
        "rest": [(end + body).hex()],
    }


def _write_words(path: Path, tree: Any) -> None:
    lines = (line if isinstance(line, list) else [line] for line in tree.get("lines") or [])
    text = "\n".join(" ".join(map(str, line)) for line in lines)
    path.write_bytes(text.encode("latin-1", "replace") + bytes.fromhex("".join(tree.get("rest") or [])))


CODECS: dict[str, tuple[Callable[[Path], Any], Callable[[Path, Any], None]]] = {
    "json": (
        lambda p: [json.loads(p.read_text())],
        lambda p, t: None if p.write_text(json.dumps(*t)) else None,
    ),
    "tensors": (_read_tensors, _write_tensors),
    "netcdf": (_read_netcdf, _write_netcdf),
    "zip": (_read_zip, _write_zip),
    "xml": (_read_xml, _write_xml),
    "words": (_read_words, _write_words),
}
"""How contents are taken out of a file and put back."""
