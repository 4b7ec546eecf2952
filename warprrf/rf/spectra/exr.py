"""One spectrum to and from OpenEXR: channels path_gain, delay, aod_zenith and aod_azimuth, 32-bit.

Numbers in the header are text, because EXR headers hold 32-bit floats only.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.checks import check_array, check_number, check_positive
from warprrf.device import require
from warprrf.files import check_seal, write_atomically
from warprrf.rf.spectra.spectrum import Spectrum, check_shape
from warprrf.tensor_files import named

_CHANNELS = ("path_gain", "delay", "aod_zenith", "aod_azimuth")
_NUMBERS = ("frequency_hz", "beam_sigma_rad", "receiver", "transmitter")  # attributes of a data set's spectra
_WORDS = ("engine", "polarisation")
_MAGIC = b"\x76\x2f\x31\x01"
_HEADER_BYTES = 4096  # ours is shorter
MOST_PIXELS = 8192  # along either side


def export_exr(path: str | os.PathLike[str], spectrum: Spectrum) -> None:
    """Write ``spectrum`` with its floor, range, and of its attributes position, frequency, beam and engine.

    Raises:
        ValueError: if it lacks delay, angles of departure or a range.
        ImportError: if OpenEXR is not installed.
    """
    exr = require("OpenEXR", extra="exr")
    if spectrum.delay_s is None or spectrum.aod is None or spectrum.range_db is None:
        raise ValueError("spectrum: got one without delay, aod or range_db, expected one of a data set")
    planes = (spectrum.path_gain, spectrum.delay_s, spectrum.aod[..., 0], spectrum.aod[..., 1])
    channels = {
        name: np.ascontiguousarray(plane, np.float32) for name, plane in zip(_CHANNELS, planes, strict=True)
    }
    numbers: dict[str, Any] = {"floor": spectrum.floor, "range_db": spectrum.range_db}
    numbers |= {name: spectrum.attributes[name] for name in _NUMBERS if name in spectrum.attributes}
    header: dict[str, Any] = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    for name, value in numbers.items():
        header[f"warprrf_{name}"] = " ".join(repr(float(v)) for v in np.atleast_1d(value))
    for name in _WORDS:
        header[f"warprrf_{name}"] = str(spectrum.attributes.get(name, ""))
    write_atomically(path, lambda file: exr.File(header, channels).write(str(file)), seal=True)


def import_exr(path: str | os.PathLike[str]) -> Spectrum:
    """Read one spectrum from OpenEXR; position, frequency, beam and engine are in its ``attributes``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it does not read as one of ours.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"path: there is no file {file}")
    check_seal(file)
    with named(file, "damaged, or no spectrum exported by warprrf"):
        _check_header(file.read_bytes()[:_HEADER_BYTES])
    exr = require("OpenEXR", extra="exr")
    try:
        with exr.File(str(file), separate_channels=True) as opened:
            header = dict(opened.header())
            channels = {name: np.array(channel.pixels) for name, channel in opened.channels().items()}
    except (OSError, RuntimeError, ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"path: {file} does not read as OpenEXR ({error})") from error
    with named(file, "damaged, or no spectrum exported by warprrf"):
        shape = check_shape(channels["path_gain"].shape)
        values = {name: check_array(name, channels[name], shape, finite=False) for name in _CHANNELS}
        numbers = {}
        for name in (*_NUMBERS, "floor", "range_db"):
            row = np.array([float(v) for v in str(header.get(f"warprrf_{name}", "nan")).split()])
            numbers[name] = row if len(row) > 1 else float(row[0])
        low, high = np.reshape(numbers.pop("range_db"), 2)
        return Spectrum(
            path_gain=check_array("path_gain", channels["path_gain"], shape, np.float32),
            delay_s=values["delay"],
            aod=np.stack([channels["aod_zenith"], channels["aod_azimuth"]], axis=-1),
            floor=check_positive("floor", numbers.pop("floor")),
            range_db=(check_number("range_db", low), check_number("range_db", high)),
            attributes=numbers | {name: str(header.get(f"warprrf_{name}", "")) for name in _WORDS},
        )


def _check_header(start: bytes) -> None:
    """Refuse what OpenEXR need not see: other files, other people's pictures, more pixels than a spectrum has."""
    if not start.startswith(_MAGIC):
        raise ValueError("got other first bytes than OpenEXR's")
    lacking = [n for n in ("floor", "range_db") if b"warprrf_" + n.encode() + b"\0string\0" not in start]
    if lacking:
        raise ValueError(f"it lacks {', '.join(lacking)}")
    window = start.partition(b"dataWindow\0box2i\0\x10\0\0\0")[2][:16]
    left, top, right, bottom = struct.unpack("<4i", window) if len(window) == 16 else (0, 0, 0, 0)
    if not (0 < right - left < MOST_PIXELS and 0 < bottom - top < MOST_PIXELS):
        raise ValueError(f"got a window of {right - left + 1} x {bottom - top + 1} pixels")
