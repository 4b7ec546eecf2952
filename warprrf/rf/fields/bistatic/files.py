"""Bistatic fields on disk: surface, parameters, terms and report in one safetensors file."""

from __future__ import annotations

import os
from dataclasses import asdict
from typing import Any

import numpy as np

from warprrf import tensor_files
from warprrf.geometry.mesh import Mesh
from warprrf.rf.em.absorption import Air
from warprrf.rf.fields.bistatic.materials import Parameters
from warprrf.rf.fields.bistatic.surface import Surface
from warprrf.rf.fields.bistatic.terms import Terms
from warprrf.rf.fields.bistatic.uncertainty import ErrorModel

_PLAIN = ("frequency_hz", "shape", "floor", "range_db", "beam_sigma_rad")
_SURFACE = {
    name: name
    for name in ("normal", "patch", "plane_normal", "plane_offset", "group", "material", "patch_group", "element",
                 "element_centre", "element_area", "element_group")
} | {"colour": "look", "cell": "texel", "cell_element": "texel_element"}  # fmt: skip
"""Arrays of a surface, and what files call them."""
_PARAMETERS = ("log_weight", "log_excess", "log_mirror", "log_indirect")


def write(parts: dict[str, Any], path: str | os.PathLike[str]) -> None:
    """Write all ``parts`` of a field, by the names of its attributes, to one safetensors file, in one go."""
    s, p = parts["surface"], parts["parameters"]
    tensors = {f"surface/{filed}": np.asarray(getattr(s, name)) for name, filed in _SURFACE.items()}
    tensors |= {"mesh/vertices": s.mesh.vertices, "mesh/faces": s.mesh.faces}
    tensors |= {f"parameters/{name}": getattr(p, name) for name in _PARAMETERS}
    tensors |= {name: parts[name] for name in ("residual", "material", "transmitter")}
    if parts["errors"] is not None:
        tensors |= {f"errors/{name}": np.asarray(value) for name, value in vars(parts["errors"]).items()}
    header = {name: parts[name] for name in _PLAIN}
    header |= {"model": "bistatic", "terms": asdict(parts["terms"]), "report": parts["report"]}
    header |= {
        "log_gain": p.log_gain,
        "group_names": s.group_names,
        "skin_m": s.skin_m,
        "two_sided": s.two_sided,
    }
    header |= {} if parts["air"] is None else parts["air"].attributes
    tensor_files.write(path, tensors, header)


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What makes the field that :func:`write` wrote, by the names of its attributes; errors as for
    :meth:`RadioField.load`."""
    tensors, header = tensor_files.read(path)
    try:
        surface = Surface(
            mesh=Mesh(tensors["mesh/vertices"], tensors["mesh/faces"]),
            group_names=tuple(header["group_names"]),
            skin_m=float(header["skin_m"]),
            two_sided=bool(header.get("two_sided", False)),
            **{name: tensors[f"surface/{filed}"] for name, filed in _SURFACE.items()},
        )
        parameters = Parameters(
            **{name: tensors[f"parameters/{name}"] for name in _PARAMETERS}, log_gain=header["log_gain"]
        )
        if len(surface.patch) != len(surface.mesh.faces):
            raise ValueError("its surface does not fit its mesh")
        errors = {n.removeprefix("errors/"): t for n, t in tensors.items() if n.startswith("errors/")}
        plain = {name: header[name] for name in _PLAIN}
        return {
            **plain,
            "shape": tuple(plain["shape"]),
            "range_db": tuple(plain["range_db"]),
            "surface": surface,
            "transmitter": tensors["transmitter"],
            "terms": Terms(**header["terms"]),
            "parameters": parameters,
            "material": tensors["material"],
            "residual": tensors["residual"],
            "errors": ErrorModel(**errors) if errors else None,
            "air": Air.from_attributes(header),
            "report": header["report"],
        }
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{os.fspath(path)}: corrupt or no bistatic field of this version: {error}"
        ) from error
