"""A fitted field in a room that changed: what stays keeps its materials, what is new brings its own.

Groups of what stays keep their parameters, and cells their residual. A new thing is of a group of the field if it is said to be
made of that; else its parameters follow from a :class:`Material`: lobes of S^2 and a mirrored share of 1 - S^2, and the
permittivity of a half-space that reflects as much head on. So thin sheets do not interfere in what they reflect, and metal
reflects 1.2 dB too little head on.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf.checks import check_type, users_level
from warprrf.geometry.mesh import GeometryLike, Mesh
from warprrf.rf.em.materials import Material, is_name_alone, library_material, library_names
from warprrf.rf.fields.bistatic.needs import assumed
from warprrf.rf.tracing.edits import Pieces, edited, pieces_of
from warprrf.rf.tracing.model import ARRAYS, MOST_NEPERS, Parameters
from warprrf.rf.tracing.surface import Surface

if TYPE_CHECKING:
    from warprrf.rf.fields.bistatic.field import BistaticField

LOST = 0.02, 0.01
"""Share of a material's area, and area [m^2], whose loss is worth a warning."""
MOST_EXCESS = 1e6  # of epsilon_r - 1, of a conductor


def with_geometry(field: BistaticField, geometry: GeometryLike) -> dict[str, Any]:
    """The parts of ``field`` that are others in ``geometry``, by name."""
    kept, pieces = pieces_of(field.surface, geometry)
    stated = {m.name: m for m in getattr(geometry, "materials", ()) if isinstance(m, Material) and not is_name_alone(m)}
    names = () if pieces is None else pieces.names
    found = [stated[name] if name in stated else library_material(name) for name in names]
    parts = _parts(field, kept, pieces, found)
    surface: Surface = parts.get("surface", field.surface)
    for name, material, g in zip(names, found, range(field.surface.groups, surface.groups), strict=True):
        if material is None:
            own = surface.group == g
            warnings.warn(
                f"geometry: {_described(surface, own)} is new, of {name!r}, a material that nobody knows: it is taken for what "
                "surfaces are before any measurement; name it after one of ITU-R P.2040, or use with_objects(materials=)",
                UserWarning,
                stacklevel=users_level(),
            )
    _warn_of_lost(field.surface, kept, surface)
    return parts


def with_objects(
    field: BistaticField,
    objects: Mapping[str, Mesh | None],
    materials: Mapping[str, Material | str] | None,
) -> dict[str, Any]:
    """The parts of ``field`` that are others with ``objects``, by name."""
    surface, given = field.surface, dict(materials or {})
    check_type("objects", objects, Mapping, "of names to meshes")
    for name in given:
        if name not in objects:
            raise ValueError(f"materials: got {name!r}, expected among the objects {', '.join(map(repr, objects))}")
    kept, parts = np.ones(len(surface.mesh.faces), bool), []
    names: list[str] = []  # of new groups
    found: list[Material | None] = []
    for name, mesh in objects.items():
        check_type("objects: a name", name, str)
        own = surface.faces_of(name)
        kept &= ~own
        if mesh is None:
            if not own.any():
                raise ValueError(f"objects: got None for {name!r}, which is not there; {_known(surface)}")
            continue
        check_type(f"objects[{name!r}]", mesh, Mesh)
        material = given.get(name)
        group = surface.group_of(name) if material is None else None
        if isinstance(material, str) and material in surface.group_names:
            group = surface.group_names.index(material)
        if group is None:
            made = library_material(material) if isinstance(material, str) else material
            if made is None:
                raise ValueError(
                    f"materials[{name!r}]: got {material!r}, expected a Material, one of the library ({', '.join(library_names())}) or "
                    f"one of the field's ({', '.join(surface.group_names)}); {_known(surface)}"
                )
            check_type(f"materials[{name!r}]", made, Material)
            title = made.name
            if title in surface.group_names:  # another Material of that name than what was fitted
                title = name if name not in surface.group_names else f"{name}_{surface.groups + len(names)}"
            if title not in names or found[names.index(title)] != made:
                names.append(title)
                found.append(made)
            group = surface.groups + max(k for k, one in enumerate(found) if one == made)
        parts.append((name, mesh, group))
    return _parts(field, kept, _together(parts, tuple(names)), found)


def _together(parts: list[tuple[str, Mesh, int]], names: tuple[str, ...]) -> Pieces | None:
    """Objects, each of a name, a mesh and a group, as pieces."""
    if not parts:
        return None
    starts = np.cumsum([0, *(len(mesh.vertices) for _, mesh, _ in parts)])
    counts = [len(mesh.faces) for _, mesh, _ in parts]
    mesh = Mesh(
        np.concatenate([mesh.vertices for _, mesh, _ in parts]),
        np.concatenate([mesh.faces + start for (_, mesh, _), start in zip(parts, starts, strict=False)]),
    )
    group = np.repeat([group for *_, group in parts], counts)
    return Pieces(mesh, group, names, np.repeat(np.arange(len(parts)), counts), tuple(name for name, *_ in parts))


def _parts(
    field: BistaticField, kept: np.ndarray, pieces: Pieces | None, materials: list[Material | None]
) -> dict[str, Any]:
    """The parts of ``field`` that are others once only the faces ``kept`` of its surface stay and ``pieces`` come, whose new groups
    are of ``materials``, None where nobody knows; empty if nothing changes."""
    if kept.all() and pieces is None:
        return {}
    frequency_hz, old = field.frequency_hz, field.surface
    laws = [None if m is None else m.band(frequency_hz) for m in materials]
    edit = edited(
        old, kept, pieces,
        thickness_m=np.array([np.nan if m is None else m.thickness_m for m in materials], float),
        dispersion=np.array([[np.nan] * 4 if law is None else [law.a, law.b, law.c, law.d] for law in laws]).reshape(-1, 4),
    )  # fmt: skip
    surface, rows = edit.surface, [field.parameters]
    unknown = replace(assumed(edit.surface, frequency_hz))
    through = surface.slabs(frequency_hz)[2]
    for g, material in enumerate(materials, old.groups):
        like = Parameters.prior(1, field.parameters.lobes)
        row = replace(like, log_excess=unknown.log_excess[[g]]) if material is None else _of_material(material, field)
        rows.append(replace(row, log_through=through[[g]]))
    arrays = {name: np.concatenate([getattr(row, name) for row in rows]) for name in ARRAYS}
    residual = np.where(edit.cell >= 0, field.residual[:, edit.cell], 0.0)
    first = field.material.max() + 1
    return {
        "surface": surface, "parameters": replace(field.parameters, **arrays), "residual": residual, "errors": None,
        "material": np.append(field.material, first + np.arange(len(materials))).astype(field.material.dtype),
    }  # fmt: skip


def _of_material(material: Material, field: BistaticField) -> Parameters:
    """Parameters of one group of ``material``, with the lobes of ``field``: all that it scatters is in that of the nearest exponent."""
    lobes, frequency_hz = field.parameters.lobes, field.frequency_hz
    scattered = material.scattering_coefficient(frequency_hz) ** 2
    exponent = 0 if material.pattern == "lambertian" else material.alpha_r
    lobe = int(np.argmin(np.abs(np.log1p(lobes) - np.log1p(exponent))))
    root = np.sqrt(complex(material.permittivity(frequency_hz)))
    reflected = abs((1.0 - root) / (1.0 + root))
    index = (1.0 + reflected) / max(1.0 - reflected, 1e-9)
    least = float(np.exp(-MOST_NEPERS))
    weight = np.full((1, len(lobes)), -MOST_NEPERS)
    weight[0, lobe] = np.log(max(scattered, least))
    return Parameters(
        weight, np.log([np.clip(index**2 - 1.0, 1e-9, MOST_EXCESS)]), np.log([max(1.0 - scattered, least)]), lobes
    )  # fmt: skip


def _warn_of_lost(old: Surface, kept: np.ndarray, new: Surface) -> None:
    """Warn of materials of which less is left."""
    before, after = (np.bincount(s.group, s.mesh.areas, old.groups)[: old.groups] for s in (old, new))
    lost = before - after
    for g in np.flatnonzero(lost > np.maximum(LOST[0] * before, LOST[1])):
        gone = ~kept & (old.group == g)
        warnings.warn(
            f"geometry: {_described(old, gone)}, a fitted surface of {old.group_names[g]!r}, has vanished: {lost[g]:.3g} m^2 of "
            f"{before[g]:.3g} m^2",
            UserWarning,
            stacklevel=users_level(),
        )


def _described(surface: Surface, face: np.ndarray) -> str:
    """Area and middle of faces (F,) bool."""
    area, centre = surface.mesh.areas[face], surface.mesh.triangles[face].mean(axis=1)
    x, y, z = np.average(centre, axis=0, weights=area)
    return f"{area.sum():.3g} m^2 about ({x:.1f}, {y:.1f}, {z:.1f}) m"


def _known(surface: Surface) -> str:
    names = surface.object_names or surface.group_names
    return f"the field's objects are {', '.join(map(repr, names[:20]))}{' ...' * (len(names) > 20)}"
