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
# most 0.034 dB; a pixel that becomes zero is empty, so its delay and AoD go too.
COMPACT_GAIN_BITS = 7  # explicit mantissa bits
COMPACT_GAIN_OF_FLOOR = 2.0**-6  # absolute step, times N0
COMPACT_DELAY_STEP_S = 2.0**-39  # 1.8 ps between values: errors below 0.91 ps, 0.27 mm
COMPACT_AOD_STEP_RAD = 2.0**-10  # 9.8e-4 rad between values: errors below 4.9e-4 rad
_CHUNK_BYTES = 2_000_000  # spectra are packed several to a chunk


def write(path: str | os.PathLike[str], values: Mapping[str, Any], *, compact: bool = False) -> None:
    """Write the fields ``values`` of a data set; see :meth:`~warprrf.rf.spectra.dataset.SpectrumDataset.save`."""
    xarray = require("xarray", extra="all")
    require("h5netcdf", extra="all")
    gain, delay, aod = values["path_gain"], values["delay_s"], values["aod"]
    attributes: dict[str, Any] = {
        "title": "Spatial radio spectra",
        "frequency_hz": values["frequency_hz"],
        "beam": "von Mises-Fisher, kappa = 1 / beam_sigma_rad^2, sums to one over the pixels for each path",
        "beam_sigma_rad": values["beam_sigma_rad"],
        "floor": values["floor"],
        "floor_meaning": "N0 [linear]: dB images are 10 log10(path_gain + N0)",
        "range_low_db": values["range_db"][0],
        "range_high_db": values["range_db"][1],
        "engine": values["engine"],
        "polarisation": values["polarisation"],
        "seed": values["seed"],
        "axes": "metres, z up; zenith 0 to pi, azimuth -pi to pi; arrival points from the receiver",
        "compact": int(compact),
        **values["attributes"],
    }
    if compact:
        gain = _round_mantissa(gain, COMPACT_GAIN_BITS, COMPACT_GAIN_OF_FLOOR * values["floor"])
        empty = gain == 0
        delay = np.where(empty, np.nan, np.round(delay / COMPACT_DELAY_STEP_S) * COMPACT_DELAY_STEP_S)
        aod = (np.round(aod / COMPACT_AOD_STEP_RAD) * COMPACT_AOD_STEP_RAD).astype(np.float32)
        aod[empty] = np.nan
        attributes["compact_rounding"] = (
            f"path_gain: {COMPACT_GAIN_BITS} mantissa bits and steps of floor * {COMPACT_GAIN_OF_FLOOR:g}; "
            f"delay: {COMPACT_DELAY_STEP_S:g} s; aod: {COMPACT_AOD_STEP_RAD:g} rad"
        )
    zenith, azimuth = pixel_angles(gain.shape[1:])
    pixel = ("receiver", "zenith", "azimuth")
    data = xarray.Dataset(
        {
            "receiver_position": (("receiver", "xyz"), values["receivers"], {"units": "m"}),
            "transmitter_position": (("xyz",), values["transmitter"], {"units": "m"}),
            "path_gain": (pixel, gain, {"units": "1", "long_name": "path gain per pixel, linear"}),
            "delay": (pixel, delay, {"units": "s", "long_name": "delay of the pixel's strongest path"}),
            "aod": (
                (*pixel, "angle"),
                aod,
                {
                    "units": "rad",
                    "long_name": "zenith and azimuth of departure of the pixel's strongest path",
                },
            ),
            "role": (
                ("receiver",),
                (values["role"] == "test").astype(np.int8),
                {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "train test"},
            ),
            "line_of_sight": (("receiver",), values["line_of_sight"].astype(np.int8), {"units": "1"}),
        },
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
    known = {"frequency_hz", "beam_sigma_rad", "floor", "range_low_db", "range_high_db"}
    known |= {"engine", "polarisation", "seed"}
    variables = {
        "receiver_position",
        "transmitter_position",
        "path_gain",
        "delay",
        "aod",
        "role",
        "line_of_sight",
    }
    missing = sorted((known - set(data.attrs)) | (variables - set(data.variables)))
    if missing:
        raise ValueError(f"path: {file} lacks {', '.join(missing)}, expected a data set saved by warprrf")
    a = {name: _plain(value) for name, value in data.attrs.items()}
    spare = {"title", "beam", "floor_meaning", "axes", "compact", "compact_rounding"}
    return {
        "receivers": data["receiver_position"].values,
        "transmitter": data["transmitter_position"].values,
        "frequency_hz": a["frequency_hz"],
        "path_gain": data["path_gain"].values,
        "delay_s": data["delay"].values,
        "aod": data["aod"].values,
        "floor": a["floor"],
        "range_db": (a["range_low_db"], a["range_high_db"]),
        "beam_sigma_rad": a["beam_sigma_rad"],
        "engine": str(a["engine"]),
        "polarisation": str(a["polarisation"]),
        "seed": int(a["seed"]),
        "role": np.where(data["role"].values == 1, "test", "train"),
        "line_of_sight": data["line_of_sight"].values.astype(bool),
        "attributes": {name: value for name, value in a.items() if name not in known | spare},
    }


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
