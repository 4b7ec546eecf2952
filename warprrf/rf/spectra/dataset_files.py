"""Spectra of one transmitter as a NetCDF-4 file (xarray over h5netcdf), SI units, with all that is needed to read it.

What goes in and comes out are the fields of :class:`~warprrf.rf.spectra.dataset.SpectrumDataset`, by name. A compact file holds
the same variables with mantissas rounded to what matters, so that zlib finds something to compress.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import require
from warprrf.files import write_atomically
from warprrf.rf.spectra.spectrum import pixel_angles

# What a compact file keeps. A relative step of 2^-7 errs by at most 0.017 dB, half of N0 / 64 moves the dB image by at
# most 0.034 dB.
COMPACT_GAIN_BITS = 7  # explicit mantissa bits
COMPACT_GAIN_OF_FLOOR = 2.0**-6  # absolute step, times N0
COMPACT_DELAY_STEP_S = 2.0**-39  # 1.8 ps between values: errors below 0.91 ps, 0.27 mm
COMPACT_AOD_STEP_RAD = 2.0**-10  # 9.8e-4 rad between values: errors below 4.9e-4 rad
_CHUNK_BYTES = 2_000_000  # spectra are packed several to a chunk

_PIXEL = ("receiver", "zenith", "azimuth")
_VARIABLES: dict[str, tuple[str, tuple[str, ...], dict[str, Any]]] = {
    "receiver_position": ("receivers", ("receiver", "xyz"), {"units": "m"}),
    "transmitter_position": ("transmitter", ("xyz",), {"units": "m"}),
    "path_gain": ("path_gain", _PIXEL, {"units": "1", "long_name": "path gain per pixel, linear"}),
    "delay": ("delay_s", _PIXEL, {"units": "s", "long_name": "delay of the pixel's strongest path"}),
    "aod": (
        "aod",
        (*_PIXEL, "angle"),
        {"units": "rad", "long_name": "zenith and azimuth of departure of the pixel's strongest path"},
    ),
    "role": (
        "role",
        ("receiver",),
        {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "train test"},
    ),
    "line_of_sight": ("line_of_sight", ("receiver",), {"units": "1"}),
}
"""Field, dimensions and attributes of each variable."""
_FIELDS = ("frequency_hz", "beam_sigma_rad", "floor", "engine", "polarisation", "seed")
"""Fields that are attributes of the file by the same name."""
_EXPLAINED = {
    "title": "Spatial radio spectra",
    "beam": "von Mises-Fisher, kappa = 1 / beam_sigma_rad^2, sums to one over the pixels for each path",
    "floor_meaning": "N0 [linear]: dB images are 10 log10(path_gain + N0)",
    "axes": "metres, z up; zenith 0 to pi, azimuth -pi to pi; arrival points from the receiver",
}


def write(path: str | os.PathLike[str], values: Mapping[str, Any], *, compact: bool = False) -> None:
    """Write the fields ``values`` of a data set; see :meth:`~warprrf.rf.spectra.dataset.SpectrumDataset.save`."""
    xarray = require("xarray", extra="all")
    require("h5netcdf", extra="all")
    arrays = {name: values[field] for name, (field, _, _) in _VARIABLES.items()}
    arrays["role"] = (arrays["role"] == "test").astype(np.int8)
    arrays["line_of_sight"] = arrays["line_of_sight"].astype(np.int8)
    attributes: dict[str, Any] = {
        **_EXPLAINED,
        **{name: values[name] for name in _FIELDS},
        "range_low_db": values["range_db"][0],
        "range_high_db": values["range_db"][1],
        "compact": int(compact),
        **values["attributes"],
    }
    if compact:
        arrays |= _rounded(arrays, values["floor"])
        attributes["compact_rounding"] = (
            f"path_gain: {COMPACT_GAIN_BITS} mantissa bits and steps of floor * {COMPACT_GAIN_OF_FLOOR:g}; "
            f"delay: {COMPACT_DELAY_STEP_S:g} s; aod: {COMPACT_AOD_STEP_RAD:g} rad"
        )
    gain = arrays["path_gain"]
    zenith, azimuth = pixel_angles(gain.shape[1:])
    data = xarray.Dataset(
        {name: (sizes, arrays[name], about) for name, (_, sizes, about) in _VARIABLES.items()},
        coords={
            "zenith": (("zenith",), zenith, {"units": "rad"}),
            "azimuth": (("azimuth",), azimuth, {"units": "rad"}),
            "xyz": ["x", "y", "z"],
            "angle": ["zenith", "azimuth"],
        },
        attrs=attributes,
    )
    packing: dict[str, Any] = {"zlib": True, "shuffle": True, "complevel": 9 if compact else 4}
    encoding = {}
    for name in ("path_gain", "delay", "aod"):
        one = data[name][0].nbytes if len(gain) else 1
        chunk = (max(1, min(len(gain), _CHUNK_BYTES // one)), *data[name].shape[1:])
        encoding[name] = {**packing, "_FillValue": None, "chunksizes": chunk}
    write_atomically(path, lambda part: data.to_netcdf(part, engine="h5netcdf", encoding=encoding))


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The fields of the data set in a file that :func:`write` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a readable NetCDF file of spectra.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"path: there is no data set {file}; warprrf simulate makes one")
    xarray = require("xarray", extra="all")
    require("h5netcdf", extra="all")
    try:
        with xarray.open_dataset(file, engine="h5netcdf", decode_cf=False) as opened:
            data = opened.load()
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        raise ValueError(f"path: {file} does not read as NetCDF-4 ({error}); is it whole?") from error
    known = {*_FIELDS, "range_low_db", "range_high_db"}
    missing = sorted((known - set(data.attrs)) | (set(_VARIABLES) - set(data.variables)))
    if missing:
        raise ValueError(f"path: {file} lacks {', '.join(missing)}, expected a data set saved by warprrf")
    attributes = {name: _plain(value) for name, value in data.attrs.items()}
    spare = {*known, *_EXPLAINED, "compact", "compact_rounding"}
    return {
        **{field: data[name].values for name, (field, _, _) in _VARIABLES.items()},
        **{name: attributes[name] for name in _FIELDS},
        "range_db": (attributes["range_low_db"], attributes["range_high_db"]),
        "role": np.where(data["role"].values == 1, "test", "train"),
        "line_of_sight": data["line_of_sight"].values.astype(bool),
        "attributes": {name: value for name, value in attributes.items() if name not in spare},
    }


def _rounded(arrays: Mapping[str, np.ndarray], floor: float) -> dict[str, np.ndarray]:
    """What a compact file holds of path gain, delay and departure; a pixel that becomes zero is empty altogether."""
    gain = _round_mantissa(arrays["path_gain"], COMPACT_GAIN_BITS, COMPACT_GAIN_OF_FLOOR * floor)
    delay = np.where(
        gain == 0, np.nan, np.round(arrays["delay"] / COMPACT_DELAY_STEP_S) * COMPACT_DELAY_STEP_S
    )
    aod = (np.round(arrays["aod"] / COMPACT_AOD_STEP_RAD) * COMPACT_AOD_STEP_RAD).astype(np.float32)
    aod[gain == 0] = np.nan
    return {"path_gain": gain, "delay": delay, "aod": aod}


def _round_mantissa(values: np.ndarray, bits: int, step: float) -> np.ndarray:
    """float32 values with ``bits`` explicit mantissa bits, and no finer than a power of two of at most ``step``."""
    step = 2.0 ** np.floor(np.log2(step))
    coarse = np.round(values / np.float32(step)) * np.float32(step)
    rounded = np.where(values < step * 2.0**bits, coarse, values).astype(np.float32)
    drop = 23 - bits
    whole = rounded.view(np.uint32)
    half = np.uint32((1 << (drop - 1)) - 1) + ((whole >> np.uint32(drop)) & np.uint32(1))  # ties to even
    return ((whole + half) & np.uint32(0xFFFFFFFF ^ ((1 << drop) - 1))).view(np.float32)


def _plain(value: Any) -> Any:
    """A NetCDF attribute as a Python value."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, np.generic):
        return value.item()
    return value.decode() if isinstance(value, bytes) else value
