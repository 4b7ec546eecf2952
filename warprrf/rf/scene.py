"""A scene for radio propagation: one mesh, a material for each face, and where transmitters and receivers stand.

Scenes come from files in Mitsuba's XML, as Sionna RT has them (neither of the two is needed), from live scenes of
Sionna RT, and from arrays.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import NotNegative, check_array, check_arrays, check_items, check_type, checked, index_to
from warprrf.device import DeviceLike
from warprrf.files import file_at
from warprrf.geometry.mesh import Mesh, joined
from warprrf.geometry.mesh_files import is_mesh_file
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.em.materials import Material
from warprrf.rf.em.waves import Hertz
from warprrf.rf.positions import is_free
from warprrf.rf.scene_parts import MaterialChoice, Materials, ScenePart, read_mesh_scene
from warprrf.rf.scene_sionna import parts_of, to_sionna_scene
from warprrf.rf.scene_xml import read_scene_xml


@checked
class Scene:
    """Surfaces and what they are made of.

    Attributes:
        mesh: all surfaces, closed solids with outward normals where the scene is a room's furniture.
        materials: the materials in use.
        face_material: index into ``materials`` of each face, shape ``(F,)``, int32.
        face_object: index into ``object_names`` of each face, shape ``(F,)``, int32.
        object_names: names of the objects.
        xml_path: the file it was loaded from, or None.
        transmitters, receivers: positions [m] by name, each ``(3,)``; may be empty.
        antennas: the array of a transmitter or receiver by its name, turned as it stands; may be empty.
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
        transmitters: Mapping[str, ArrayLike] | None = None,
        receivers: Mapping[str, ArrayLike] | None = None,
        antennas: Mapping[str, PlanarArray] | None = None,
    ) -> None:
        faces = len(mesh.faces)
        if face_object is None:
            face_object = np.zeros(faces, dtype=np.int32)
        self.mesh = mesh
        self.materials = check_items("materials", materials, Material)
        self.face_material = check_array("face_material", face_material, (faces,), dtype=np.int32).copy()
        self.face_object = check_array("face_object", face_object, (faces,), dtype=np.int32).copy()
        self.object_names = check_items("object_names", object_names, str)
        self.xml_path = None if xml_path is None else Path(xml_path)
        self.transmitters = _positions("transmitters", transmitters)
        self.receivers = _positions("receivers", receivers)
        self.antennas = dict(antennas or {})
        for name, array in self.antennas.items():
            check_type(f"antennas[{name!r}]", array, PlanarArray)
            if name not in self.transmitters | self.receivers:
                raise ValueError(f"antennas: got {name!r}, expected names of transmitters and receivers")
        if len(set(self.object_names)) < len(self.object_names):
            raise ValueError("object_names: got a name twice, expected each once")
        known = {"face_material": index_to("materials", "F"), "face_object": index_to("objects", "F")}
        check_arrays(vars(self), known, materials=len(self.materials), objects=len(self.object_names))

    def __repr__(self) -> str:
        return (
            f"Scene({len(self.mesh.faces)} faces, {len(self.object_names)} objects, materials "
            f"{', '.join(material.name for material in self.materials)})"
        )

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        materials: Materials | None = None,
        extrapolate: bool = False,
        allow_outside: bool = False,
        unit: str | None = None,
        up: str | None = None,
        simplify: int | None = None,
    ) -> Scene:
        """Read a scene file: any that Sionna RT 2 opens, such as ``sionna.rt.scene.munich``, or a mesh file.

        A mesh file (PLY, OBJ, STL, glTF, GLB) gives names of materials at most. Those of ITU-R P.2040 are known
        (``concrete``, ``itu_glass``, ``Wood_01``); the others are names alone until ``materials`` says more: they tell a
        radio field which surfaces are alike, but nothing can be simulated with them.

        Materials named after those of ITU-R P.2040 are known. ``materials`` goes first, then a table ``materials.json`` beside
        the file, which is read where ``materials`` has not every name, then what the file says. What scatters nothing in
        the file has a scattering coefficient of 0, as in Sionna.

        Args:
            path: the scene file (Mitsuba's XML), or a mesh file.
            materials: materials by the name of those that they replace, or a table's file (:func:`load_materials`).
            extrapolate: let materials hold outside the bands in which they are known; see
                :meth:`Material.extrapolated`.
            allow_outside: read files outside the folder of ``path`` too. A scene from elsewhere may name any file.
            unit, up, simplify: of a mesh file, as of :meth:`Mesh.load`.

        Raises:
            FileNotFoundError: if the file, a mesh or the table is missing.
            TypeError: if ``materials`` is neither a mapping nor a file.
            ValueError: if the file cannot be parsed, uses what we don't read, has a material that nobody knows, or a
                file outside its folder; if ``materials`` has a name of which nothing is made.

        Example::

            import sionna.rt
            scene = wr.Scene.load(sionna.rt.scene.munich, materials={"brick": wr.em.itu_material("concrete")})
        """
        path = file_at(path, "scene file")
        choice = MaterialChoice(materials, path.parent / "materials.json", extrapolate)
        if is_mesh_file(path):
            found = read_mesh_scene(
                path, choice, unit=unit, up=up, simplify=simplify, allow_outside=allow_outside
            )
            choice.check_used()
            return cls(**found)
        if (unit, up, simplify) != (None, None, None):
            raise ValueError(f"unit, up, simplify: {path} is no mesh file; its units are metres, z up")
        parts = read_scene_xml(path, choice, allow_outside=allow_outside)
        choice.check_used()
        return cls._of_parts(parts, xml_path=path)

    @classmethod
    def from_sionna(
        cls, rt_scene: Any, *, materials: Materials | None = None, extrapolate: bool = False
    ) -> Scene:
        """The surfaces, materials, transmitters and receivers of a live ``sionna.rt.Scene``.

        Load it with ``merge_shapes=False`` to keep its objects apart. A radio material with a law of its own in Python
        is known for the scene's frequency alone. What ``tx_array`` or ``rx_array`` is to a transmitter or receiver, turned as
        it stands, is in :attr:`antennas` under its name, custom patterns included (:func:`warprrf.interop.array_from_sionna`).

        Args:
            rt_scene: the scene.
            materials, extrapolate: as of :meth:`load`.

        Raises:
            ImportError: if Sionna RT is missing.
            TypeError: for what is no such scene.
            ValueError: for a scene without objects, or a material with a pattern that we don't have.

        Warns:
            UserWarning: of an array that does not stand in rows and columns, which is left out.

        Example::

            scene = wr.Scene.from_sionna(rt_scene)
            paths = wr.trace_paths(scene, transmitter=scene.transmitters["tx"], receivers=scene.receivers["rx"],
                                   frequency_hz=28e9)
            h = paths.cfr([28e9], tx_array=scene.antennas["tx"], rx_array=scene.antennas["rx"])
        """
        choice = MaterialChoice(materials, None, extrapolate)
        parts, devices = parts_of(rt_scene, choice)
        choice.check_used()
        return cls._of_parts(parts, **devices)

    @classmethod
    def _of_parts(cls, parts: Sequence[ScenePart], **options: Any) -> Scene:
        counts = [len(part.faces) for part in parts]
        materials = list({id(part.material): part.material for part in parts}.values())
        index = {id(material): k for k, material in enumerate(materials)}
        return cls(
            joined([(part.vertices, part.faces) for part in parts]),
            materials,
            np.repeat([index[id(part.material)] for part in parts], counts),
            face_object=np.repeat(np.arange(len(parts)), counts),
            object_names=[part.name for part in parts],
            **options,
        )

    def to_sionna(self, *, frequency_hz: Hertz = 3.5e9) -> Any:
        """The scene as a ``sionna.rt.Scene``, with scattering patterns, transmitters, receivers and their antennas.

        Objects keep their names (with ``_`` for ``.``) and are not merged; one of several materials becomes one object
        for each. Materials follow ``frequency`` of what comes back. Where the transmitters have one array, each turned in its way,
        that is ``tx_array``, of any pattern, interpolated between half degrees; and so for receivers.

        Args:
            frequency_hz: carrier frequency [Hz]; Sionna RT's own default if none is given.

        Raises:
            ImportError: if Sionna RT is missing, or only an LLVM that aborts it is installed.
            ValueError: if a material is not known at this frequency, is infinitely thick, or scatters in a lobe that
                is too narrow for Sionna's single precision.

        Warns:
            UserWarning: of antennas that are left out, because they differ, or have no polarisation; of coordinates too
                large for Sionna.
        """
        return to_sionna_scene(self._parts(), self.transmitters, self.receivers, self.antennas, frequency_hz)

    def _parts(self) -> list[ScenePart]:
        order = np.lexsort((self.face_material, self.face_object))
        key = np.stack([self.face_object[order], self.face_material[order]], axis=1)
        starts = np.flatnonzero(np.r_[True, (np.diff(key, axis=0) != 0).any(axis=1)])
        several = np.bincount(key[starts, 0], minlength=len(self.object_names)) > 1
        found = []
        for (thing, material), faces in zip(key[starts], np.split(order, starts[1:]), strict=True):
            used, own = np.unique(self.mesh.faces[faces], return_inverse=True)
            name, made_of = self.object_names[thing], self.materials[material]
            if several[thing]:
                name = f"{name}-{made_of.name}"
            found.append(ScenePart(name, self.mesh.vertices[used], own.reshape(-1, 3), made_of))
        return found

    def with_materials(self, materials: Sequence[Material]) -> Scene:
        """The same surfaces made of other materials, one for each of :attr:`materials`.

        Raises:
            ValueError: if there are not as many.
        """
        materials = check_items("materials", materials, Material)
        if len(materials) != len(self.materials):
            raise ValueError(f"materials: got {len(materials)}, expected {len(self.materials)}, one for each")
        other = copy(self)
        other.materials = materials
        return other

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper corner of the mesh [m], shape ``(2, 3)``."""
        return self.mesh.bounds

    def is_free(
        self, points: ArrayLike, *, clearance_m: NotNegative = 0.0, device: DeviceLike = None
    ) -> np.ndarray:
        """Whether points lie in the air of a room or a city, shape ``(N,)``, bool.

        See :mod:`warprrf.rf.positions` for what counts. ``clearance_m`` asks for that distance [m] from every surface
        besides.
        """
        points = check_array("points", points, (None, 3))
        return is_free(self.mesh, points, clearance_m=clearance_m, device=device)


def _positions(name: str, values: Mapping[str, ArrayLike] | None) -> dict[str, np.ndarray]:
    """Positions by name [m], each ``(3,)``."""
    found = {}
    for key, position in (values or {}).items():
        check_type(f"{name}: the name {key!r}", key, str)
        found[key] = check_array(f"{name}[{key!r}]", position, (3,)).copy()
    return found
