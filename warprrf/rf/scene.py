"""A scene for radio propagation: one mesh, a material for each face, and the XML it came from.

The XML is the subset of Mitsuba's scene format that Sionna RT reads: ``bsdf`` elements whose identifiers name radio
materials (``mat-itu_concrete``, ``itu_concrete`` or ``concrete``), and ``shape`` elements that load a PLY or OBJ file
each. Neither Mitsuba nor Sionna is needed to read it. The values of the materials stand in a table beside the XML.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_number, check_type
from warprrf.device import DeviceLike
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_files import read_mesh
from warprrf.rf.em.materials import Material, load_materials

T = TypeVar("T")


class Scene:
    """Surfaces and what they are made of.

    Attributes:
        mesh: all surfaces, closed solids with outward normals where the scene is a room's furniture.
        materials: the materials in use.
        face_material: index into ``materials`` of each face, shape ``(F,)``, int32.
        face_object: index into ``object_names`` of each face, shape ``(F,)``, int32.
        object_names: names of the objects.
        xml_path: the file it was loaded from, or None.
    """

    def __init__(
        self,
        mesh: Mesh,
        materials: Sequence[Material],
        face_material: ArrayLike,
        *,
        face_object: ArrayLike | None = None,
        object_names: Sequence[str] = ("object",),
        xml_path: str | os.PathLike[str] | None = None,
    ) -> None:
        check_type("mesh", mesh, Mesh)
        faces = len(mesh.faces)
        if face_object is None:
            face_object = np.zeros(faces, dtype=np.int32)
        self.mesh = mesh
        self.materials = _named_list("materials", materials, Material)
        self.face_material = check_array("face_material", face_material, (faces,), dtype=np.int32)
        self.face_object = check_array("face_object", face_object, (faces,), dtype=np.int32)
        self.object_names = _named_list("object_names", object_names, str)
        self.xml_path = None if xml_path is None else Path(xml_path)
        if len(set(self.object_names)) < len(self.object_names):
            raise ValueError("object_names: got a name twice, expected each once")
        for name, index, table in (
            ("face_material", self.face_material, self.materials),
            ("face_object", self.face_object, self.object_names),
        ):
            if faces and (index.min() < 0 or index.max() >= len(table)):
                raise ValueError(
                    f"{name}: got indices {index.min()} to {index.max()}, expected 0 to {len(table) - 1}"
                )

    def __repr__(self) -> str:
        return (
            f"Scene({len(self.mesh.faces)} faces, {len(self.object_names)} objects, materials "
            f"{', '.join(material.name for material in self.materials)})"
        )

    @classmethod
    def load(
        cls,
        xml: str | os.PathLike[str],
        *,
        materials: str | os.PathLike[str] | None = None,
        allow_outside: bool = False,
    ) -> Scene:
        """Read a scene.

        Args:
            xml: the scene file.
            materials: table of materials; ``materials.json`` beside ``xml`` by default.
            allow_outside: read meshes outside the folder of ``xml`` too. A scene from elsewhere may name any file.

        Raises:
            FileNotFoundError: if the XML, a mesh or the table is missing.
            ValueError: if the XML cannot be parsed, uses what we don't read, names a material without an entry, or a
                mesh outside its folder.
        """
        xml = Path(xml)
        if not xml.is_file():
            raise FileNotFoundError(f"xml: there is no scene file {xml}")
        table = load_materials(xml.parent / "materials.json" if materials is None else materials)
        try:
            root = ElementTree.parse(xml).getroot()
        except (ElementTree.ParseError, LookupError, ValueError) as error:  # the latter two: of its encoding
            raise ValueError(f"xml: {xml} is not well-formed: {error}") from error
        shapes = root.findall("shape")
        if not shapes:
            raise ValueError(f"xml: {xml} holds no shapes")
        vertices: list[np.ndarray] = []
        faces: list[np.ndarray] = []
        names: list[str] = []
        used: list[str] = []
        start = 0
        for shape in shapes:
            name = shape.get("id") or f"shape_{len(names)}"
            material = _material_name(shape, name, xml)
            if material not in table:
                raise ValueError(
                    f"xml: object {name!r} of {xml} is made of {material!r}, which the table of materials lacks; "
                    f"it has {', '.join(sorted(table))}"
                )
            part = read_mesh(_mesh_path(shape, name, xml, allow_outside))
            vertices.append(part.vertices)
            faces.append(part.faces + start)
            start += len(part.vertices)
            names.append(name)
            used.append(material)
        order = list(dict.fromkeys(used))
        counts = [len(f) for f in faces]
        return cls(
            Mesh(np.concatenate(vertices), np.concatenate(faces)),
            [table[name] for name in order],
            np.repeat([order.index(name) for name in used], counts),
            face_object=np.repeat(np.arange(len(names)), counts),
            object_names=names,
            xml_path=xml,
        )

    def with_materials(self, materials: Sequence[Material]) -> Scene:
        """The same surfaces made of other materials, one for each of :attr:`materials`.

        Raises:
            ValueError: if there are not as many.
        """
        materials = _named_list("materials", materials, Material)
        if len(materials) != len(self.materials):
            raise ValueError(f"materials: got {len(materials)}, expected {len(self.materials)}, one for each")
        return Scene(
            self.mesh,
            materials,
            self.face_material,
            face_object=self.face_object,
            object_names=self.object_names,
            xml_path=self.xml_path,
        )

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper corner of the mesh [m], shape ``(2, 3)``."""
        return np.stack([self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)])

    def object_faces(self, name: str) -> np.ndarray:
        """Indices of the faces of one object; ValueError for an unknown name."""
        if name not in self.object_names:
            raise ValueError(f"name: got {name!r}, expected one of {', '.join(self.object_names)}")
        return np.flatnonzero(self.face_object == self.object_names.index(name))

    def is_free(
        self, points: ArrayLike, *, clearance_m: float = 0.0, device: DeviceLike = None
    ) -> np.ndarray:
        """Whether points lie in the air of a room of closed solids, shape ``(N,)``, bool.

        A point is in the air if rays from it in three directions all first meet a surface from its outer side, and no
        solid of a closed mesh holds it (one solid may end within another);
        ``clearance_m`` asks for that distance [m] from every surface besides.
        """
        points = check_array("points", points, (None, 3))
        check_number("clearance_m", clearance_m, 0.0)
        free = np.ones(len(points), dtype=bool)
        for direction in ((0.021, 0.013, 1.0), (0.017, -0.011, -1.0), (1.0, 0.37, 0.113)):
            unit = np.asarray(direction) / np.linalg.norm(direction)
            hit = self.mesh.cast(points, np.tile(unit, (len(points), 1)), device=device)
            outer = np.where(hit.face >= 0, self.mesh.face_normals[hit.face] @ unit < 0, False)
            free &= outer
        if self.mesh.is_closed and free.any():
            free[free] = self.mesh.winding_number(points[free]) < 0.5
        if clearance_m > 0 and free.any():
            near = free.copy()
            near[free] = self.mesh.distance(points[free], device=device) >= clearance_m
            free = near
        return free


def _material_name(shape: ElementTree.Element, name: str, xml: Path) -> str:
    """The radio material of a shape: its bsdf's identifier without ``mat-`` and ``itu_``."""
    element = next((r for r in shape.findall("ref")), None)
    if element is None:
        element = shape.find("bsdf")
    identifier = None if element is None else element.get("id")
    if identifier is None:
        raise ValueError(f"xml: object {name!r} of {xml} names no material (a <ref id=...> to a bsdf)")
    identifier = identifier.removeprefix("mat-")
    return identifier[4:] if identifier.startswith(("itu_", "itu-")) else identifier


def _named_list(name: str, values: Iterable[T], kind: type[T]) -> list[T]:
    """``values`` as a list whose items are all of ``kind``."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise TypeError(f"{name}: got {values!r:.60}, expected a list of {kind.__name__}")
    found = list(values)
    for k, value in enumerate(found):
        check_type(f"{name}[{k}]", value, kind)
    return found


def _mesh_path(shape: ElementTree.Element, name: str, xml: Path, allow_outside: bool) -> Path:
    if shape.get("type") not in ("ply", "obj"):
        raise ValueError(
            f"xml: object {name!r} of {xml} is a {shape.get('type')!r}, expected 'ply' or 'obj'; export it as a mesh"
        )
    if shape.find("transform") is not None:
        raise ValueError(f"xml: object {name!r} of {xml} has a transform; apply it to the mesh before")
    filename = next((s.get("value") for s in shape.findall("string") if s.get("name") == "filename"), None)
    if filename is None:
        raise ValueError(f"xml: object {name!r} of {xml} names no mesh file")
    path = xml.parent / filename
    if not allow_outside and not path.resolve().is_relative_to(xml.parent.resolve()):
        raise ValueError(
            f"xml: object {name!r} of {xml} names the mesh {filename}, which lies outside the scene's folder; move it "
            "there, or trust the scene and load it with allow_outside=True"
        )
    if not path.is_file():
        raise FileNotFoundError(f"xml: object {name!r} of {xml} needs the mesh {path}, which is missing")
    return path
