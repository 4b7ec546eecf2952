"""Paths as NetCDF-4 files: dimensions ``receiver``, ``path``, ``vertex``, ``xyz``; complex numbers as two.

``gain_real`` and ``gain_imag`` (receiver, path) hold the gain at ``frequency_hz`` between isotropic antennas, its power
averaged over transmit and summed over receive polarisations; ``jones_real`` and ``jones_imag`` the Jones matrices,
where known.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from warprrf import device as _device
from warprrf.files import write_atomically
from warprrf.rf.channel.path_arrays import PathArrays
from warprrf.rf.em.absorption import Air

KINDS = ("", "los", "mirror", "diffuse")
"""What the values 0, 1, ... of the variable ``kind`` mean."""

_FORMAT = "warprrf paths 1"
_SEVERAL = ("receiver", "path")
_UNITS = {
    "tau": ("s", "delay"),
    "theta_r": ("rad", "zenith of arrival"),
    "phi_r": ("rad", "azimuth of arrival"),
    "theta_t": ("rad", "zenith of departure"),
    "phi_t": ("rad", "azimuth of departure"),
}


def write(path: str | os.PathLike[str], paths: PathArrays) -> None:
    """Write ``paths`` to a NetCDF-4 file, whole or not at all."""
    xarray = _device.require("xarray", extra="all")
    several = paths.as_several()
    codes = sum(k * (several.kind == name) for k, name in enumerate(KINDS))
    flags = {"flag_values": list(range(len(KINDS))), "flag_meanings": "none los mirror diffuse"}
    points = {"units": "m", "long_name": "interaction points from the transmitter on"}
    variables: dict[str, Any] = {
        "vertices": ((*_SEVERAL, "vertex", "xyz"), several.vertices, points),
        "kind": (_SEVERAL, np.asarray(codes, dtype=np.int8), flags),
        "valid": (_SEVERAL, several.valid.astype(np.int8), {}),
    }
    for name, (unit, text) in _UNITS.items():
        variables[name] = (_SEVERAL, getattr(several, name), {"units": unit, "long_name": text})
    for part in ("real", "imag"):
        variables[f"gain_{part}"] = (_SEVERAL, getattr(several.gain, part), {"units": "1"})
        if several.jones is not None:
            matrix = (*_SEVERAL, "receive", "transmit")
            variables[f"jones_{part}"] = (matrix, getattr(several.jones, part), {"units": "1"})
    if several.receiver is not None:
        variables["receiver_position"] = (("receiver", "xyz"), several.receiver, {"units": "m"})
    if several.transmitter is not None:
        variables["transmitter_position"] = (("xyz",), several.transmitter, {"units": "m"})
    attributes: dict[str, Any] = {"format": _FORMAT, "single_receiver": int(not paths.batched)}
    if several.frequency_hz is not None:
        attributes["frequency_hz"] = several.frequency_hz
    if several.air is not None:
        attributes |= several.air.attributes
    data = xarray.Dataset(variables, attrs=attributes)
    write_atomically(path, lambda file: data.to_netcdf(file, engine="h5netcdf"))


def read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], bool]:
    """The fields of what :func:`write` wrote, as paths of several receivers, and whether it was one receiver's.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file holds something else.
    """
    xarray = _device.require("xarray", extra="all")
    if not Path(path).is_file():
        raise FileNotFoundError(f"path: there is no file {path}")
    with xarray.open_dataset(path, engine="h5netcdf", decode_times=False) as data:
        if data.attrs.get("format") != _FORMAT:
            raise ValueError(f"path: {path} holds {data.attrs.get('format')!r}, expected {_FORMAT!r}")
        held = {name: np.asarray(data[name].values) for name in data.variables}
        attributes = dict(data.attrs)
    fields: dict[str, Any] = {
        "gain": held["gain_real"] + 1j * held["gain_imag"],
        "vertices": held["vertices"],
        "kind": np.array(KINDS, dtype="<U7")[held["kind"].astype(int)],
        "valid": held["valid"].astype(bool),
        "jones": held["jones_real"] + 1j * held["jones_imag"] if "jones_real" in held else None,
        "frequency_hz": float(attributes["frequency_hz"]) if "frequency_hz" in attributes else None,
        "transmitter": held.get("transmitter_position"),
        "receiver": held.get("receiver_position"),
        "air": Air.from_attributes(attributes),
        **{name: held[name] for name in _UNITS},
    }
    return fields, bool(attributes["single_receiver"])
