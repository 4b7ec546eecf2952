"""A fitted field in a room that changed: what stays keeps its materials, what is new brings its own.

Groups of what stays keep their parameters, and cells their residual. A new thing is of a group of the field if it is said to be
made of that; else its parameters follow from a :class:`Material`: lobes of S^2 and a mirrored share of 1 - S^2, and the
permittivity of a half-space that reflects as much head on. So thin sheets do not interfere in what they reflect, and metal
reflects 1.2 dB too little head on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from warprrf.checks import check_type, warn
from warprrf.geometry.mesh import GeometryLike, Mesh, as_mesh
from warprrf.rf.em.materials import ITU_BANDS, Material, is_name_alone, library_material
from warprrf.rf.fields.bistatic.options import assumed
from warprrf.rf.tracing.edits import Called, Room, edited
from warprrf.rf.tracing.model import ARRAYS, MOST_NEPERS, Parameters
from warprrf.rf.tracing.surface import Surface, law_of


def with_geometry(field: Any, geometry: GeometryLike) -> dict[str, Any]:
    """The parts of a bistatic ``field`` that are others in ``geometry``, by name."""
    old, room = field.surface, Room.of(field.surface, geometry)
    known = {m.name: m for m in getattr(geometry, "materials", ()) if isinstance(m, Material)}
    names = [m.name for m in room.materials[old.groups :]]
    stated = [None if is_name_alone(known.get(name)) else known.get(name) for name in names]
    found = [m or library_material(name) for m, name in zip(stated, names, strict=True)]
    parts = _parts(field, room, found)
    new = parts.get("surface", old)
    before, after = (np.bincount(s.group, s.mesh.areas, new.groups) for s in (old, new))
    for g, material in enumerate(found, old.groups):
        if material is None:
            warn(
                f"geometry: {after[g]:.3g} m^2 are new, of {new.group_names[g]!r}, a material that nobody knows: it is taken for "
                "what surfaces are before any measurement; name it after one of ITU-R P.2040, or use with_objects(materials=)"
            )
    lost_share, lost_m2 = 0.02, 0.01  # of a material's area, whose loss is worth a warning
    for k in np.flatnonzero(before - after > np.maximum(lost_share * before, lost_m2)):
        what = f"of {before[k]:.3g} m^2 of the fitted surface {old.group_names[k]!r}"
        warn(f"geometry: {what}, {before[k] - after[k]:.3g} m^2 have vanished")
    return parts


def with_objects(
    field: Any, objects: Mapping[str, Mesh | None], materials: Mapping[str, Material | str]
) -> dict[str, Any]:
    """The parts of a bistatic ``field`` that are others with ``objects``, by name."""
    s, new, kept = field.surface, dict[str, Material](), np.ones(len(field.mesh.faces), bool)
    there = {name: as_mesh(one, f"objects[{name!r}]") for name, one in objects.items() if one is not None}
    if unknown := sorted(set(materials) - set(there)):
        raise ValueError(f"materials: got {unknown[0]!r}, expected among the objects {_some(list(there))}")
    for name in objects:
        own = s.faces_of(name)
        if name not in there and not own.any():
            known = _some(s.object_names or s.group_names)
            raise ValueError(f"objects: got None for {name!r}, expected one of {known}")
        kept &= ~own
    things = tuple(dict.fromkeys((*s.object_names, *there)))
    group, thing = [s.group[kept]], [s.face_object[kept]]
    vertices, faces = [s.mesh.vertices], [s.mesh.faces[kept]]
    for name, mesh in there.items():
        count = len(mesh.faces)
        group.append(np.full(count, _group(s, name, materials.get(name), new)))
        thing.append(np.full(count, things.index(name), np.int32))
        faces.append(mesh.faces + sum(map(len, vertices)))
        vertices.append(mesh.vertices)
    whole = Mesh(np.concatenate(vertices), np.concatenate(faces))
    called = tuple(map(Called, (*s.group_names, *new)))
    room = Room(whole, np.concatenate(group), called, np.concatenate(thing), things)
    return _parts(field, room, list(new.values()))


def _group(s: Surface, name: str, material: Material | str | None, new: dict[str, Material]) -> int:
    """Group of an object; one of ``new``, which it is then among, if it has to be."""
    own = s.faces_of(name)
    if material is None and own.any():  # that which it has most of
        return int(np.bincount(s.group[own], s.mesh.areas[own]).argmax())
    if isinstance(material, str) and material in s.group_names:
        return s.group_names.index(material)
    made = library_material(material) if isinstance(material, str) else material
    if made is None:
        raise ValueError(
            f"materials[{name!r}]: got {material!r}, expected a Material, 'skin', one of ITU-R P.2040 ({', '.join(ITU_BANDS)}) "
            f"or one of the field's: {_some(s.group_names)}"
        )
    check_type(f"materials[{name!r}]", made, Material)
    title = made.name
    while title in s.group_names or new.get(title, made) != made:  # another one of that name
        title += "_"
    new[title] = made
    return s.groups + list(new).index(title)


def _parts(field: Any, room: Room, materials: Sequence[Material | None]) -> dict[str, Any]:
    """The parts of ``field`` that are others in ``room``, whose new groups are of ``materials``; None where nobody knows."""
    frequency_hz, p, laws = field.frequency_hz, field.parameters, np.full((len(materials), 4), np.nan)
    new = zip(materials, room.materials[field.surface.groups :], strict=True)
    for k, (material, called) in enumerate(new):
        if material is not None:
            material.band(frequency_hz)  # it must be known there
            laws[k] = law_of(material, called.name, frequency_hz)
    thick = np.array([np.nan if m is None else m.thickness_m for m in materials], float)
    surface, cell = edited(field.surface, room, thickness_m=thick, dispersion=laws)
    if surface is field.surface:
        return {}
    unknown, rows = assumed(surface, frequency_hz), [p]
    for g, material in enumerate(materials, field.surface.groups):
        row = replace(Parameters.prior(1, p.lobes), log_excess=unknown.log_excess[[g]])
        row = row if material is None else _of_material(material, frequency_hz, p.lobes)
        rows.append(replace(row, log_through=unknown.log_through[[g]]))
    arrays: dict[str, Any] = {name: np.concatenate([getattr(row, name) for row in rows]) for name in ARRAYS}
    return {
        "surface": surface, "parameters": replace(p, **arrays), "errors": None,
        "residual": np.where(cell >= 0, field.residual[:, cell], 0.0),
        "material": np.append(field.material, field.material.max() + 1 + np.arange(len(materials))).astype(np.int32),
    }  # fmt: skip


def _of_material(material: Material, frequency_hz: float, lobes: tuple[int, ...]) -> Parameters:
    """Parameters of one group of ``material``: all that it scatters is in the lobe of the nearest exponent."""
    scattered = material.scattering_coefficient(frequency_hz) ** 2
    exponent = 0 if material.pattern == "lambertian" else material.alpha_r
    weight = np.full((1, len(lobes)), -MOST_NEPERS)
    nearest = np.argmin(np.abs(np.log1p(lobes) - np.log1p(exponent)))
    weight[0, nearest] = np.log(max(scattered, np.exp(-MOST_NEPERS)))
    root = np.sqrt(material.permittivity(frequency_hz))
    reflected = min(abs((1.0 - root) / (1.0 + root)), 1.0 - 1e-6)
    of_conductor = 1e6
    excess = np.clip(((1.0 + reflected) / (1.0 - reflected)) ** 2 - 1.0, 1e-6, of_conductor)
    mirrored = np.log(max(1.0 - scattered, np.exp(-MOST_NEPERS)))
    return Parameters(weight, np.log([excess]), np.array([mirrored]), lobes)


def _some(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names[:20])) + " ..." * (len(names) > 20)
