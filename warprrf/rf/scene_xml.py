"""Scenes in Mitsuba's XML, as Sionna RT 2 reads them; neither of the two is needed.

Read are shapes (meshes in PLY and OBJ files, Mitsuba's primitives, ``merge``) with their transforms, materials
(``itu-radio-material``, ``radio-material``, and any other ``bsdf`` that is named after a material of ITU-R P.2040 or
holds or refers to such a one), ``default`` values and ``$names``, ``include`` and ``alias``. Cameras, lights, textures
and integrators are passed over. Who wrote the file is not trusted: it declares no document type (entities), is not
nested without end, and names no file outside its folder.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from warprrf.checks import LARGEST_M
from warprrf.geometry.mesh_content import Folder
from warprrf.geometry.mesh_files import read_mesh
from warprrf.rf.em.materials import ITU_BANDS, Material, itu_material, itu_name
from warprrf.rf.scene_parts import MaterialChoice, ScenePart

MOST_NESTED = 50  # elements within each other; expat and Python take thousands
ROUND = 64  # facets around a primitive that is round

Element = ElementTree.Element


def read_scene_xml(path: Path, choice: MaterialChoice, *, allow_outside: bool = False) -> list[ScenePart]:
    """The objects of a scene file; errors are those of :meth:`Scene.load`."""
    return _SceneFile(path, choice, allow_outside).parts()


class _SceneFile:
    """One scene file, with what it includes, being read."""

    def __init__(self, path: Path, choice: MaterialChoice, allow_outside: bool) -> None:
        self.path, self.choice, self.allow_outside = path, choice, allow_outside
        self.top = list(self._included(path, 0))
        self._replace_names()
        named = [e for e in self.top if e.tag == "bsdf" and e.get("id") is not None]
        self.bsdfs = {e.get("id"): e for e in named}
        if len(self.bsdfs) < len(named):
            raise ValueError(f"path: {path} names two bsdfs alike, expected an id of its own for each")
        for element in self.top:
            if element.tag == "alias" and element.get("id") in self.bsdfs:
                self.bsdfs[element.get("as")] = self.bsdfs[element.get("id")]

    def parts(self) -> list[ScenePart]:
        roots = [element for element in self.top if element.tag == "shape"]
        shapes = [shape for root in roots for shape in root.iter("shape") if shape.get("type") != "merge"]
        if not shapes:
            raise ValueError(f"path: {self.path} holds no shapes")
        ids = [shape.get("id") or f"shape_{k}" for k, shape in enumerate(shapes)]
        plain = [identifier.removeprefix("mesh-") for identifier in ids]  # as Sionna RT names its objects
        names = plain if len(set(plain)) == len(plain) else ids
        if len(set(names)) < len(names):
            raise ValueError(f"path: {self.path} names two shapes alike, expected an id of its own for each")
        found = []
        for shape, name in zip(shapes, names, strict=True):
            material = self._material(shape, name)
            vertices, faces = self._surface(shape, name)
            found.append(ScenePart(name, vertices, faces, material))
        return found

    def wrong(self, name: str, what: str) -> ValueError:
        return ValueError(f"path: object {name!r} of {self.path} {what}")

    # files

    def _included(self, path: Path, depth: int) -> list[Element]:
        most_included = 8
        if depth > most_included:
            raise ValueError(f"path: {self.path} includes files within files more than {most_included} deep")
        found: list[Element] = []
        for element in read_xml(path):
            if element.tag == "include":
                inner = self._file(element.get("filename"), "the included file")
                found += self._included(inner, depth + 1)
            else:
                found.append(element)
        return found

    def _file(self, filename: str | None, what: str) -> Path:
        """The file of this name, relative to the scene's folder."""
        if not filename:
            raise ValueError(f"path: {self.path} gives no name of {what}")
        try:
            return Folder(self.path, self.allow_outside).find(filename)
        except (ValueError, FileNotFoundError) as error:
            raise type(error)(f"path: {what}: {str(error).removeprefix('path: ')}") from error

    def _replace_names(self) -> None:
        """Put the values of ``default`` elements where attributes hold their ``$names``; ``toWorld``, as older files have it,
        is ``to_world``, and so for all properties."""
        values: dict[str, str] = {}

        most_letters = 10_000  # of a value after $names are replaced

        def put(text: str) -> str:
            def value(found: re.Match[str]) -> str:
                if found[1] not in values:
                    raise ValueError(f"path: {self.path} uses ${found[1]}, which no <default> element gives")
                return values[found[1]]

            text = re.sub(r"\$(\w+)", value, text)
            if len(text) > most_letters:
                raise ValueError(f"path: {self.path} holds a value of more than {most_letters} characters")
            return text

        for element in self.top:
            if element.tag == "default":
                values.setdefault(element.get("name", ""), put(element.get("value", "")))
        for element in self.top:
            for part in element.iter():
                for key, text in part.attrib.items():
                    if key == "name":
                        text = re.sub("(?<=[a-z])[A-Z]", lambda capital: f"_{capital[0].lower()}", text)
                    part.set(key, put(text) if "$" in text else text)

    # materials

    def _material(self, shape: Element, name: str) -> Material:
        """What a shape is made of: its own ``bsdf``, or the one that it refers to."""
        element = shape.find("bsdf")
        if element is None:
            links = shape.findall("ref")
            known = [link for link in links if link.get("id") in self.bsdfs]
            link = next(iter(known or [link for link in links if link.get("name", "bsdf") == "bsdf"]), None)
            if link is None or link.get("id") is None:
                raise self.wrong(name, "names no material (a <ref id=...> to a bsdf)")
            element = self.bsdfs.get(link.get("id"), link)
        itu = element.get("id") or _text(element, "type") or ""
        label = re.sub("^(mat-)?(itu[_-])?", "", itu)
        if not label:
            raise self.wrong(name, "has a material without an id")
        return self.choice.choose(label, lambda: self._declared(element, label, name))

    def _declared(self, element: Element, label: str, name: str) -> Material:
        """The material that the file itself gives for the name ``label``."""
        for candidate in self._within(element, 0):
            try:
                found = _radio_material(candidate, label)
            except ValueError as error:
                raise self.wrong(name, f"is made of {label!r}: {error}") from error
            if found is not None:
                return found
        tables = f"; the table of materials has {', '.join(self.choice.names)}" if self.choice.names else ""
        raise self.wrong(
            name,
            f"is made of {label!r}, which is neither a radio material nor one of ITU-R P.2040 "
            f"({', '.join(sorted(ITU_BANDS))}){tables}; give it by materials={{{label!r}: ...}}",
        )

    def _within(self, element: Element, depth: int) -> list[Element]:
        """``element``, then the materials that it holds or refers to (as ``twosided`` does)."""
        if depth > MOST_NESTED:
            raise ValueError(f"path: {self.path} holds materials that refer to each other in a circle")
        found = [element]
        for part in element:
            if part.tag == "bsdf":
                found += self._within(part, depth + 1)
            elif part.tag == "ref" and part.get("id") in self.bsdfs:
                found += self._within(self.bsdfs[part.get("id")], depth + 1)
        return found

    # surfaces

    def _surface(self, shape: Element, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [m] and faces of a shape where it stands."""
        kind = shape.get("type", "")
        try:
            if kind in ("ply", "obj"):
                file = self._file(_text(shape, "filename"), f"the mesh of object {name!r}")
                mesh = read_mesh(file, colours=False)
                vertices, faces = mesh.vertices, mesh.faces
            elif kind in _PRIMITIVES:
                vertices, faces = _PRIMITIVES[kind](shape)
            else:
                raise self.wrong(
                    name,
                    f"is a {kind!r}, expected one of ply, obj, {', '.join(_PRIMITIVES)}; export it as a mesh",
                )
            matrix = to_world(shape.findall("transform[@name='to_world']/*"))
        except ValueError as error:
            if str(error).startswith("path: "):
                raise
            raise self.wrong(name, str(error)) from error
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if not (np.abs(vertices) <= LARGEST_M).all():
            raise self.wrong(name, f"holds places that are NaN, infinite or beyond {LARGEST_M:g} m")
        flipped = (_text(shape, "flip_normals", "boolean") or "").strip().lower() == "true"
        if flipped != (np.linalg.det(matrix[:3, :3]) < 0):  # a mirrored solid keeps its outer side
            faces = faces[:, ::-1]
        return vertices, faces


def read_xml(path: Path) -> Element:
    """The root element of an XML file.

    Raises:
        ValueError: naming the file, if it is not well-formed, too large or too deep, or declares a document type.
    """
    most_bytes = 200_000_000  # of an XML file; that of 4735 objects has a million
    if path.stat().st_size > most_bytes:
        raise ValueError(f"path: {path} has {path.stat().st_size} bytes, expected at most {most_bytes}")
    parser = ElementTree.XMLParser(target=_Builder())
    try:
        parser.feed(path.read_bytes())
        root: Element = parser.close()
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the second: of its encoding
        raise ValueError(f"path: {path} is not well-formed, or no scene: {error}") from error
    return root


class _Builder(ElementTree.TreeBuilder):
    """Elements of a file that is not trusted."""

    depth = 0

    def start(self, tag: str, attributes: dict[str, str]) -> Element:
        self.depth += 1
        if self.depth > MOST_NESTED:
            raise ValueError(f"it is nested more than {MOST_NESTED} deep")
        return super().start(tag, attributes)

    def end(self, tag: str) -> Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, *_: object) -> None:
        raise ValueError("it declares a document type, which a scene has no use for")


def _text(element: Element, name: str, tag: str = "string") -> str | None:
    part = element.find(f"{tag}[@name='{name}']")
    return None if part is None else part.get("value", "")


def _value(element: Element, name: str, default: float) -> float:
    for tag in ("float", "integer"):
        text = _text(element, name, tag)
        if text is not None:
            return _numbers(text, f"{name!r}", 1)[0]
    return default


def _numbers(text: str, what: str, *counts: int) -> list[float]:
    """The numbers of ``text``, between which stand commas or blanks."""
    try:
        found = [float(word) for word in re.split(r"[\s,]+", text.strip())]
    except ValueError as error:
        raise ValueError(f"has {what} {text!r:.60}, expected numbers") from error
    if len(found) not in counts or not np.isfinite(found).all():
        wanted = " or ".join(str(n) for n in counts)
        raise ValueError(f"has {what} {text!r:.60}, expected {wanted} finite numbers")
    return found


def _radio_material(element: Element, label: str) -> Material | None:
    """The radio material that ``element`` itself gives, called ``label``; None for one of looks alone.

    Sionna RT takes every ``bsdf`` whose id begins with ``itu_`` for that material of P.2040, whatever its type.
    """
    kind, identifier = element.get("type"), element.get("id") or ""
    exponent = _value(element, "alpha_r", 4)
    if exponent % 1:
        raise ValueError(f"has 'alpha_r' {exponent:g}, expected a whole number")
    common: dict[str, Any] = {
        "thickness_m": _value(element, "thickness", Material.thickness_m),
        "scattering": _value(element, "scattering_coefficient", 0.0),
        "xpd": _value(element, "xpd_coefficient", 0.0),
        "pattern": _text(element, "scattering_pattern") or "lambertian",
        "alpha_r": int(exponent),
    }
    prefixed = identifier.removeprefix("mat-").startswith(("itu_", "itu-"))
    if kind == "itu-radio-material" or prefixed:
        itu = _text(element, "type") or identifier
        return itu_material(itu, name=label, **common)
    if kind == "absorber-radio-material":  # nothing comes back
        return Material.custom(label, relative_permittivity=1.0)
    if kind == "radio-material":
        constant = Material.custom(
            label,
            relative_permittivity=_value(element, "relative_permittivity", 1.0),
            conductivity=_value(element, "conductivity", 0.0),
        )
        return replace(constant, **common)
    return itu_material(identifier, name=label, **common) if itu_name(identifier) else None


def to_world(parts: list[Element]) -> np.ndarray:
    """The matrix of the parts of a ``transform`` element, shape ``(4, 4)``: they apply one after the other, first to last."""
    matrix = np.eye(4)
    for part in parts:
        if part.tag not in _TRANSFORMS:
            raise ValueError(
                f"has the transform {part.tag!r}, expected one of {', '.join(_TRANSFORMS)}; apply it to the mesh"
            )
        matrix = _TRANSFORMS[part.tag](part) @ matrix
    return matrix


def _vector(part: Element, name: str, default: float | None) -> np.ndarray:
    """``x``, ``y`` and ``z``, or ``value`` with three numbers or one, or ``name`` with three."""
    for key, counts in (("value", (1, 3)), (name, (3,))):
        text = part.get(key)
        if text is not None:
            return np.broadcast_to(_numbers(text, f"the {part.tag} {key}", *counts), 3).astype(float)
    if default is None:
        raise ValueError(f"has a {part.tag} without {name!r}")
    return np.array([_numbers(part.get(k, str(default)), f"the {part.tag} {k}", 1)[0] for k in "xyz"])


def _affine(linear: np.ndarray, offset: np.ndarray | float = 0.0) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


def _unit(vector: np.ndarray, what: str) -> np.ndarray:
    length = np.linalg.norm(vector)
    if not length > 0:
        raise ValueError(f"has {what} of no length")
    return vector / length


def _rotate(part: Element) -> np.ndarray:
    axis = _vector(part, "axis", 0.0)
    if not np.isclose(np.linalg.norm(axis), 1.0, rtol=1e-4):  # Mitsuba takes it as it is, and bends the shape
        raise ValueError(f"has a rotation about {axis.tolist()}, expected an axis of length 1")
    angle = np.deg2rad(_numbers(part.get("angle", "0"), "the rotation angle", 1)[0])
    return _affine(Rotation.from_rotvec(angle * _unit(axis, "an axis")).as_matrix())


def _look_at(part: Element) -> np.ndarray:
    given = {"up": "0, 0, 1", **part.attrib}
    if not {"origin", "target"} <= given.keys():
        raise ValueError("has a lookat without 'origin' or 'target'")
    names = "origin", "target", "up"
    origin, target, up = (np.array(_numbers(given[name], f"the lookat {name}", 3)) for name in names)
    forward = _unit(target - origin, "a lookat from origin to target")
    left = _unit(np.cross(up, forward), "a lookat whose 'up' lies along it,")
    return _affine(np.column_stack([left, np.cross(forward, left), forward]), origin)


def _matrix(part: Element) -> np.ndarray:
    values = np.array(_numbers(part.get("value", ""), "the matrix", 9, 16))
    if len(values) == 9:
        return _affine(values.reshape(3, 3))
    matrix = values.reshape(4, 4)
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"has a matrix whose last row is {matrix[3].tolist()}, expected 0, 0, 0, 1")
    return matrix


_TRANSFORMS: dict[str, Callable[[Element], np.ndarray]] = {
    "translate": lambda part: _affine(np.eye(3), _vector(part, "offset", 0.0)),
    "scale": lambda part: _affine(np.diag(_vector(part, "factors", 1.0))),
    "rotate": _rotate,
    "lookat": _look_at,
    "look_at": _look_at,
    "matrix": _matrix,
}


def _revolved(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The surface that (radius, z) points ``(N, 2)`` sweep about the z axis, normals to the left of their course."""
    turn = np.arange(ROUND) * 2 * np.pi / ROUND
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.ones(ROUND)])
    vertices = (ring * profile[:, None, [0, 0, 1]]).reshape(-1, 3)
    start, along = np.meshgrid(np.arange(len(profile) - 1) * ROUND, np.arange(ROUND), indexing="ij")
    a, b = start + along, start + (along + 1) % ROUND
    c, d = b + ROUND, a + ROUND
    poles = profile[:, 0] == 0
    kept = [np.stack([a, d, c], -1)[~poles[1:]], np.stack([a, c, b], -1)[~poles[:-1]]]  # others have no area
    return vertices, np.concatenate([faces.reshape(-1, 3) for faces in kept]).astype(np.int32)


def _sphere(shape: Element) -> tuple[np.ndarray, np.ndarray]:
    polar = np.linspace(0.0, np.pi, ROUND // 2 + 1)
    sine = np.sin(polar)
    sine[[0, -1]] = 0.0
    vertices, faces = _revolved(np.column_stack([sine, np.cos(polar)]))
    return _value(shape, "radius", 1.0) * vertices + _point(shape, "center", (0.0, 0.0, 0.0)), faces


def _cylinder(shape: Element) -> tuple[np.ndarray, np.ndarray]:
    radius, start = _value(shape, "radius", 1.0), _point(shape, "p0", (0.0, 0.0, 0.0))
    along = _point(shape, "p1", (0.0, 0.0, 1.0)) - start
    vertices, faces = _revolved(np.array([[radius, np.linalg.norm(along)], [radius, 0.0]]))
    up = _unit(along, "an axis")
    side = _unit(np.cross(np.eye(3)[np.abs(up).argmin()], up), "an axis")
    return vertices @ np.stack([side, np.cross(up, side), up]) + start, faces


def _point(shape: Element, name: str, default: tuple[float, float, float]) -> np.ndarray:
    part = shape.find(f"point[@name='{name}']")
    return np.array(default) if part is None else _vector(part, name, 0.0)


def _cube(_: Element) -> tuple[np.ndarray, np.ndarray]:
    vertices = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return vertices, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)


def _rectangle(_: Element) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


_PRIMITIVES: dict[str, Callable[[Element], tuple[np.ndarray, np.ndarray]]] = {
    "rectangle": _rectangle,
    "cube": _cube,
    "sphere": _sphere,
    "disk": lambda _: _revolved(np.array([[0.0, 0.0], [1.0, 0.0]])),
    "cylinder": _cylinder,
}
