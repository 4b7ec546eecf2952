"""Geometry as arrays by name, as files hold it: Gaussians, planes, and a mesh with its patches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from warprrf.checks import LARGEST_M, Expected, check_arrays, check_number, index_to, lengths
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.photos.planes import Plane
from warprrf.geometry.planar_patches import PlanarPatches
from warprrf.geometry.splats.gaussians import Gaussians

GAUSSIANS = tuple(f.name for f in fields(Gaussians))
MESH = ("vertices", "faces", "face_colours", "face_label")
PATCHES = tuple(f.name for f in fields(PlanarPatches) if f.name != "mesh")
PATCH_ARRAYS = {
    "patch_face_patch": index_to("P", "F", -1),
    "patch_normal": Expected("P 3", -1.001, 1.001),
    "patch_offset": lengths("P"),
    "patch_area": Expected("P", 0.0, LARGEST_M**2),
    "patch_group": Expected("P", -1, kind="iu"),
    "patch_first": index_to("F", "F"),
}
"""What the arrays of patches must be: F faces, P patches."""
PLANE_ARRAYS = {
    "planes": lengths("K 8"),
    "plane_shapes": Expected("K 2", 0, 2**15, kind="iu"),
    "plane_cells": Expected("C", kind="b"),
    "plane_plain": Expected("K", kind="b"),
}
"""What the arrays of planes must be: K planes, C cells of all of them."""
Arrays = dict[str, np.ndarray]


def of_gaussians(gaussians: Gaussians) -> Arrays:
    """Arrays of Gaussians."""
    return {name: getattr(gaussians, name) for name in GAUSSIANS}


def to_gaussians(arrays: Arrays) -> Gaussians:
    """What :func:`of_gaussians` took apart."""
    return Gaussians(*(arrays[name] for name in GAUSSIANS))


def of_planes(planes: Sequence[Plane]) -> Arrays:
    """Arrays of planes and their cells; the points that they were fitted to are left out."""
    rows = [[*p.normal, p.offset, p.rms_m, *p.corner, p.cell_m] for p in planes]
    cells = [p.occupied.ravel() for p in planes]
    return {
        "planes": np.array(rows, dtype=np.float64).reshape(-1, 8),
        "plane_shapes": np.array([p.occupied.shape for p in planes], dtype=np.int64).reshape(-1, 2),
        "plane_cells": np.concatenate(cells) if cells else np.zeros(0, dtype=bool),
        "plane_plain": np.array([p.plain for p in planes], dtype=bool),
    }


def to_planes(arrays: Arrays) -> list[Plane]:
    """What :func:`of_planes` took apart."""
    check_arrays(arrays, PLANE_ARRAYS, C=int(np.prod(arrays["plane_shapes"], axis=-1).sum()))
    shapes, nothing = arrays["plane_shapes"], np.zeros(0, dtype=np.int64)
    cells = np.split(arrays["plane_cells"], np.cumsum(shapes.prod(axis=1))[:-1])
    return [
        Plane(
            row[:3],
            float(row[3]),
            nothing,
            float(row[4]),
            row[5:7],
            float(row[7]),
            own.reshape(shape),
            bool(plain),
        )
        for row, shape, own, plain in zip(
            arrays["planes"], shapes, cells, arrays["plane_plain"], strict=False
        )
    ]


def of_mesh(mesh: Mesh) -> Arrays:
    """Arrays of a mesh; its labels are left to the header."""
    held = {name: getattr(mesh, name) for name in MESH}
    return {name: array for name, array in held.items() if array is not None}


def to_mesh(arrays: Arrays, labels: Sequence[str] = ()) -> Mesh:
    """What :func:`of_mesh` took apart."""
    known = {name: arrays.get(name) for name in MESH[2:]}
    return Mesh(arrays["vertices"], arrays["faces"], labels=labels, **known)


def of_patches(patches: PlanarPatches) -> Arrays:
    """Arrays of a mesh and its planar patches."""
    own = {f"patch_{name}": np.asarray(getattr(patches, name)) for name in PATCHES}
    return own | of_mesh(patches.mesh)


def to_patches(arrays: Arrays, labels: Sequence[str] = ()) -> PlanarPatches:
    """What :func:`of_patches` took apart."""
    mesh = to_mesh(arrays, labels)
    if "patch_once" in arrays:  # older files say which faces repeat none, not which ones others repeat
        itself = arrays["patch_once"] | (arrays["patch_face_patch"] < 0)
        arrays = arrays | {"patch_first": np.where(itself, np.arange(len(itself)), mesh.first_at_place)}
    check_arrays(arrays, PATCH_ARRAYS, F=len(mesh.faces))
    own: dict[str, Any] = {name: arrays[f"patch_{name}"] for name in PATCHES}
    own |= {name: own[name].item() for name in ("tolerance_m", "two_sided")}
    check_number("patch_tolerance_m", own["tolerance_m"], 0.0, LARGEST_M)
    return PlanarPatches(mesh, **own)
