"""Spectra of one transmitter as a NetCDF-4 file (h5netcdf), SI units, with all that is needed to read it.

What goes in and comes out are the fields of :class:`~warprrf.rf.spectra.dataset.SpectrumDataset`, by name. A compact file holds
the same variables with mantissas rounded to what matters, so that zlib finds something to compress.
One spectrum alone also goes to OpenEXR: channels path_gain, delay, aod_zenith and aod_azimuth, 32-bit;
numbers in the header are text, because EXR headers hold 32-bit floats only.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warprrf import netcdf_files
from warprrf.device import require
from warprrf.files import write_atomically
from warprrf.netcdf_files import XYZ, Axis, Variable
from warprrf.rf.spectra.spectrum import Spectrum, pixel_angles
from warprrf.tensor_files import named

# What a compact file keeps; of path gain see _rounded.
COMPACT_DELAY_STEP_S = 2.0**-39  # 1.8 ps between values: errors below 0.91 ps, 0.27 mm
COMPACT_AOD_STEP_RAD = 2.0**-10  # 9.8e-4 rad between values: errors below 4.9e-4 rad

_PIXEL = ("receiver", "zenith", "azimuth")
_DELAY = {"long_name": "delay of the pixel's strongest path"}
_VARIABLES = {
    "receiver_position": Variable(("receiver", "xyz"), "m", field="receivers"),
    "transmitter_position": Variable(("xyz",), "m", field="transmitter"),
    "path_gain": Variable(_PIXEL, "1", {"long_name": "path gain per pixel, linear"}, packed=True),
    "delay": Variable(_PIXEL, "s", _DELAY, packed=True, field="delay_s"),
    "aod": Variable(
        (*_PIXEL, "angle"),
        "rad",
        {"long_name": "zenith and azimuth of departure of the pixel's strongest path"},
        packed=True,
    ),
    "role": Variable(
        ("receiver",),
        about={"flag_values": np.array([0, 1], np.int8), "flag_meanings": "train test"},
        codes=("train", "test"),
    ),
    "line_of_sight": Variable(("receiver",), "1", codes=(False, True)),
}
_AXES = {
    "zenith": Axis(lambda rows: pixel_angles((rows, 2))[0], "rad"),
    "azimuth": Axis(lambda columns: pixel_angles((2, columns))[1], "rad", 2.0 * np.pi),
    "xyz": XYZ,
    "angle": Axis(lambda _: np.array(["zenith", "azimuth"])),
}
_FIELDS = ("frequency_hz", "beam_sigma_rad", "floor", "engine", "polarisation", "seed")
"""Fields that are attributes of the file by the same name."""
_EXPLAINED = {
    "title": "Spatial radio spectra",
    "beam": "von Mises-Fisher, kappa = 1 / beam_sigma_rad^2, sums to one over the pixels for each path",
    "floor_meaning": "N0 [linear]: dB images are 10 log10(path_gain + N0)",
    "axes": "metres, z up; zenith 0 to pi, azimuth -pi to pi; arrival points from the receiver",
}

RESERVED = {
    *_FIELDS, *(it.field or name for name, it in _VARIABLES.items()), "range_db", "attributes", "range_low_db",
    "range_high_db", *_EXPLAINED, "compact",
    "compact_rounding", "CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST",
}  # fmt: skip
"""Names that the file needs itself, fields among them, and those of HDF5's dimensions."""

# Of a spectrum in OpenEXR:
_CHANNELS = ("path_gain", "delay", "aod_zenith", "aod_azimuth")
_NUMBERS = ("frequency_hz", "beam_sigma_rad", "receiver", "transmitter")  # attributes of a data set's spectra
_WORDS = ("engine", "polarisation")


def write(path: str | os.PathLike[str], values: Mapping[str, Any], *, compact: bool = False) -> None:
    """Write the fields ``values`` of a data set; see :meth:`~warprrf.rf.spectra.dataset.SpectrumDataset.save`."""
    arrays = netcdf_files.encoded(values, _VARIABLES)
    attributes: dict[str, Any] = {
        **_EXPLAINED,
        **{name: values[name] for name in _FIELDS},
        "range_low_db": values["range_db"][0],
        "range_high_db": values["range_db"][1],
        "compact": int(compact),
        **values["attributes"],
    }
    if compact:
        rounded, attributes["compact_rounding"] = _rounded(arrays, values["floor"])
        arrays |= rounded
    netcdf_files.write(path, arrays, _VARIABLES, _AXES, attributes, level=9 if compact else 4)


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The fields of the data set in a file that :func:`write` wrote.

    Raises:
        OSError: naming the file, if it cannot be read.
        ValueError: if it is damaged, or no NetCDF file of spectra.
    """
    file = os.fspath(path)
    arrays, attributes = netcdf_files.read(path, _VARIABLES, _AXES)
    if lacking := sorted({*_FIELDS, "range_low_db", "range_high_db"} - set(attributes)):
        raise ValueError(f"{file}: lacks {', '.join(lacking)}, expected a data set saved by warprrf")
    with named(path, "damaged"):
        fields = netcdf_files.decoded(arrays, _VARIABLES)
    return {
        **fields,
        **{name: attributes[name] for name in _FIELDS},
        "range_db": (attributes["range_low_db"], attributes["range_high_db"]),
        "attributes": {name: value for name, value in attributes.items() if name not in RESERVED},
    }


def _rounded(arrays: Mapping[str, np.ndarray], floor: float) -> tuple[dict[str, np.ndarray], str]:
    """What a compact file holds of path gain, delay and departure, and how that is rounded; a pixel that becomes zero is empty
    altogether."""
    # A relative step of 2^-7 errs by at most 0.017 dB, half of N0 / 64 moves the dB image by at most 0.034 dB.
    bits, of_floor = 7, 2.0**-6
    gain = _round_mantissa(arrays["path_gain"], bits, of_floor * floor)
    delay = np.round(arrays["delay"] / COMPACT_DELAY_STEP_S) * COMPACT_DELAY_STEP_S
    aod = (np.round(arrays["aod"] / COMPACT_AOD_STEP_RAD) * COMPACT_AOD_STEP_RAD).astype(np.float32)
    delay[gain == 0] = aod[gain == 0] = np.nan
    how = (
        f"path_gain: {bits} mantissa bits and steps of floor * {of_floor:g}; "
        f"delay: {COMPACT_DELAY_STEP_S:g} s; aod: {COMPACT_AOD_STEP_RAD:g} rad"
    )
    return {"path_gain": gain, "delay": delay, "aod": aod}, how


def _round_mantissa(values: np.ndarray, bits: int, step: float) -> np.ndarray:
    """float32 values with ``bits`` explicit mantissa bits, and no finer than a power of two of at most ``step``."""
    last_bit = np.frexp(values)[1] - 1 - bits  # the power of two that it stands for
    steps = np.ldexp(1.0, np.maximum(last_bit, int(np.floor(np.log2(step)))))
    return (np.round(values / steps) * steps).astype(np.float32)


def export_exr(path: str | os.PathLike[str], spectrum: Spectrum) -> None:
    """Write ``spectrum`` with its floor, range, and of its attributes position, frequency, beam and engine.

    Raises:
        OSError: naming the file, if the system does not take it.
        ValueError: if it lacks delay, angles of departure or a range.
        ImportError: if OpenEXR is not installed.
    """
    exr = require("OpenEXR", extra="exr")
    if spectrum.delay_s is None or spectrum.aod is None or spectrum.range_db is None:
        raise ValueError("spectrum: got one without delay, aod or range_db, expected one of a data set")
    planes = (spectrum.path_gain, spectrum.delay_s, spectrum.aod[..., 0], spectrum.aod[..., 1])
    named = zip(_CHANNELS, planes, strict=True)
    channels = {name: np.ascontiguousarray(plane, np.float32) for name, plane in named}
    numbers: dict[str, Any] = {"floor": spectrum.floor, "range_db": spectrum.range_db}
    numbers |= {name: spectrum.attributes[name] for name in _NUMBERS if name in spectrum.attributes}
    header: dict[str, Any] = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    for name, value in numbers.items():
        header[f"warprrf_{name}"] = " ".join(repr(float(v)) for v in np.atleast_1d(value))
    for name in _WORDS:
        header[f"warprrf_{name}"] = str(spectrum.attributes.get(name, ""))

    def write(file: Path) -> None:
        try:
            exr.File(header, channels).write(str(file))
        except RuntimeError as error:
            raise OSError(errno.EIO, f"OpenEXR could not write it ({error})", os.fspath(path)) from error

    write_atomically(path, write)
