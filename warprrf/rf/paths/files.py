"""Paths as NetCDF-4 files: dimensions ``receiver``, ``path``, ``vertex``, ``xyz``; complex numbers as two.

``gain_real`` and ``gain_imag`` (receiver, path) hold the gain at ``frequency_hz`` between isotropic antennas, its power
averaged over transmit and summed over receive polarisations; ``jones_real`` and ``jones_imag`` the Jones matrices,
where known.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from warprrf import netcdf_files
from warprrf.checks import Expected, check_arrays, check_positive, lengths
from warprrf.netcdf_files import Variable
from warprrf.rf.channel.path_arrays import PathArrays
from warprrf.rf.em.absorption import Air
from warprrf.tensor_files import named

KINDS = ("", "los", "mirror", "diffuse")
"""What the values 0, 1, ... of the variable ``kind`` mean."""

_FORMAT = "warprrf paths 1"
_SEVERAL = ("receiver", "path")
_MATRIX = (*_SEVERAL, "receive", "transmit")
_UNITS = {
    "tau": ("s", "delay"),
    "theta_r": ("rad", "zenith of arrival"),
    "phi_r": ("rad", "azimuth of arrival"),
    "theta_t": ("rad", "zenith of departure"),
    "phi_t": ("rad", "azimuth of departure"),
}
_FLAGS = {
    "flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": "none los mirror diffuse",
}  # fmt: skip
_VARIABLES = {
    "vertices": Variable(
        (*_SEVERAL, "vertex", "xyz"), "m", {"long_name": "interaction points from the transmitter on"}
    ),
    "kind": Variable(_SEVERAL, about=_FLAGS),
    "valid": Variable(_SEVERAL),
    **{name: Variable(_SEVERAL, unit, {"long_name": text}) for name, (unit, text) in _UNITS.items()},
    "gain_real": Variable(_SEVERAL, "1"),
    "gain_imag": Variable(_SEVERAL, "1"),
    "jones_real": Variable(_MATRIX, "1", optional=True),
    "jones_imag": Variable(_MATRIX, "1", optional=True),
    "receiver_position": Variable(("receiver", "xyz"), "m", optional=True),
    "transmitter_position": Variable(("xyz",), "m", optional=True),
}
_ARRAYS = {
    "gain_real": Expected("R L"),
    "gain_imag": Expected("R L"),
    "jones_real": Expected("R L 2 2", nan=True),
    "jones_imag": Expected("R L 2 2", nan=True),
    "vertices": Expected("R L D 3", nan=True),
    "kind": Expected("R L", 0, len(KINDS) - 1, kind="iu"),
    "valid": Expected("R L", 0, 1, kind="iu"),
    "tau": Expected("R L", 0.0, 1.0, nan=True),
    **{name: Expected("R L", -7.0, 7.0, nan=True) for name in list(_UNITS)[1:]},
    "receiver_position": lengths("R 3"),
    "transmitter_position": lengths("3"),
}
"""What the arrays in a file must be: R receivers, L paths, D interactions."""


def write(path: str | os.PathLike[str], paths: PathArrays) -> None:
    """Write ``paths`` to a NetCDF-4 file, whole or not at all."""
    several = paths.as_several()
    codes = sum(k * (several.kind == name) for k, name in enumerate(KINDS))
    arrays = {
        "vertices": several.vertices,
        "kind": np.asarray(codes, dtype=np.int8),
        "valid": several.valid.astype(np.int8),
        "receiver_position": several.receiver,
        "transmitter_position": several.transmitter,
    }
    for name, values in (("gain", several.gain), ("jones", several.jones)):
        if values is not None:
            arrays |= {f"{name}_real": values.real, f"{name}_imag": values.imag}
    arrays |= {name: getattr(several, name) for name in _UNITS}
    attributes: dict[str, Any] = {"format": _FORMAT, "single_receiver": int(not paths.batched)}
    if several.frequency_hz is not None:
        attributes["frequency_hz"] = several.frequency_hz
    if several.air is not None:
        attributes |= several.air.attributes
    known = {name: np.asarray(array) for name, array in arrays.items() if array is not None}
    netcdf_files.write(path, known, _VARIABLES, {}, attributes)


def read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], bool]:
    """The fields of what :func:`write` wrote, as paths of several receivers, and whether it was one receiver's.

    Raises:
        OSError: naming the file, if it cannot be read.
        ValueError: naming it, if it is damaged, or holds something else.
    """
    held, attributes = netcdf_files.read(path, _VARIABLES, {})
    with named(path, "damaged, or no paths"):
        if attributes.get("format") != _FORMAT:
            raise ValueError(f"it holds {attributes.get('format')!r}, expected {_FORMAT!r}")
        check_arrays(held, {name: wanted for name, wanted in _ARRAYS.items() if name in held})
        carrier = attributes.get("frequency_hz")
        fields: dict[str, Any] = {
            "gain": held["gain_real"] + 1j * held["gain_imag"],
            "vertices": held["vertices"],
            "kind": np.array(KINDS, dtype="<U7")[held["kind"].astype(int)],
            "valid": held["valid"].astype(bool),
            "jones": held["jones_real"] + 1j * held["jones_imag"] if "jones_real" in held else None,
            "frequency_hz": None if carrier is None else check_positive("frequency_hz", carrier),
            "transmitter": held.get("transmitter_position"),
            "receiver": held.get("receiver_position"),
            "air": Air.from_attributes(attributes),
            **{name: held[name] for name in _UNITS},
        }
        return fields, bool(attributes["single_receiver"])
