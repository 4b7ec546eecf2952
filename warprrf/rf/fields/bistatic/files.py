"""Bistatic fields on disk: surface, parameters, terms and report in one safetensors file."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from warprrf.checks import check_type
from warprrf.geometry.mesh import Mesh
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel
from warprrf.rf.tracing.cells import ARRAYS as CELL_ARRAYS
from warprrf.rf.tracing.cells import Cells
from warprrf.rf.tracing.model import ARRAYS as PARAMETER_ARRAYS
from warprrf.rf.tracing.model import Effects, Parameters
from warprrf.rf.tracing.surface import ARRAYS as SURFACE_ARRAYS
from warprrf.rf.tracing.surface import Surface

_SINGLE = ("lobes", "reciprocal", "log_gain", "roughness")


def taken_apart(parts: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Tensors and header of the ``parts`` of a field, by the names of its attributes, but for what every model has."""
    s, p = parts["surface"], parts["parameters"]
    tensors = {"mesh/vertices": s.mesh.vertices, "mesh/faces": s.mesh.faces}
    tensors |= {f"surface/{name}": np.asarray(getattr(s, name)) for name in SURFACE_ARRAYS}
    tensors |= {f"cells/{name}": getattr(s.cells, name) for name in CELL_ARRAYS}
    tensors |= {f"parameters/{name}": getattr(p, name) for name in PARAMETER_ARRAYS}
    tensors |= {name: parts[name] for name in ("residual", "material")}
    if parts["errors"] is not None:
        tensors |= {f"errors/{name}": np.asarray(value) for name, value in vars(parts["errors"]).items()}
    header = {
        "effects": asdict(parts["effects"]),
        "sub_pixels": parts["sub_pixels"],
        **{name: getattr(p, name) for name in _SINGLE},
        "group_names": s.group_names,
        "position_error_m": s.position_error_m,
        "two_sided": s.two_sided,
        "object_names": s.object_names,
    }
    return tensors, header


def put_together(tensors: dict[str, np.ndarray], header: dict[str, Any]) -> dict[str, Any]:
    """See :meth:`RadioField._put_together`."""
    names, objects, two_sided = header["group_names"], header.get("object_names", []), header["two_sided"]
    check_type("two_sided", two_sided, bool)
    for what, every in (("group_names", names), ("object_names", objects)):
        check_type(what, every, list)
        for name in every:
            check_type(what, name, str)
    errors = {n.removeprefix("errors/"): t for n, t in tensors.items() if n.startswith("errors/")}
    errors.pop("outlier_db", None)  # older files know one, which nothing reads
    parameters: dict[str, Any] = {name: tensors[f"parameters/{name}"] for name in PARAMETER_ARRAYS}
    parameters |= {name: header[name] for name in _SINGLE}
    held: dict[str, Any] = {"surface/face_object": None, **tensors}  # older files know no objects
    arrays = {name: held[f"surface/{name}"] for name in SURFACE_ARRAYS}
    cells = _old_cells(tensors) if "surface/cell" in tensors else None  # of files whose faces were split
    cells = cells or Cells(**{name: tensors[f"cells/{name}"] for name in CELL_ARRAYS})
    return {
        "surface": Surface(
            mesh=Mesh(tensors["mesh/vertices"], tensors["mesh/faces"]),
            group_names=tuple(names),
            object_names=tuple(objects),
            position_error_m=header["position_error_m"],
            two_sided=two_sided,
            cells=cells,
            **arrays,
        ),
        "effects": Effects(**header["effects"]),
        "sub_pixels": header["sub_pixels"],
        "parameters": Parameters(**parameters),
        "material": tensors["material"],
        "residual": tensors["residual"],
        "errors": ErrorModel(**errors) if errors else None,
    }


def _old_cells(tensors: dict[str, np.ndarray]) -> Cells:
    """Those of files that name the cell and the element of each face."""
    cell, element = tensors["surface/cell"], tensors["surface/element"]
    of_cell = np.zeros(int(cell.max(initial=-1)) + 1, np.int32)
    of_cell[cell] = element
    return Cells.of_faces(cell, of_cell)
