"""One spectrum to and from OpenEXR: channels path_gain, delay, aod_zenith and aod_azimuth, 32-bit.

Numbers in the header are text, because EXR headers hold 32-bit floats only.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import require
from warprrf.files import check_seal, write_atomically
from warprrf.rf.spectra.spectrum import Spectrum, check_range_db

_CHANNELS = ("path_gain", "delay", "aod_zenith", "aod_azimuth")
_NUMBERS = ("frequency_hz", "beam_sigma_rad", "receiver", "transmitter")  # attributes of a data set's spectra
_WORDS = ("engine", "polarisation")


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

    def write(file: Path) -> None:
        try:
            exr.File(header, channels).write(str(file))
        except RuntimeError as error:
            raise OSError(errno.EIO, f"OpenEXR could not write it ({error})", os.fspath(path)) from error

    write_atomically(path, write, seal=True)


def import_exr(path: str | os.PathLike[str]) -> Spectrum:
    """Read one spectrum from OpenEXR; position, frequency, beam and engine are in its ``attributes``.

    Raises:
        OSError: naming the file, if it cannot be read.
        ValueError: naming it, if it is damaged, or does not read as one of ours.
    """
    file = os.fspath(path)
    check_seal(file)
    exr = require("OpenEXR", extra="exr")
    try:
        with exr.File(file, separate_channels=True) as opened:
            header = dict(opened.header())
            channels = {name: np.array(channel.pixels) for name, channel in opened.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"{file}: damaged, or no OpenEXR file: {error}") from error
    lacking = [n for n in _CHANNELS if n not in channels] + [
        n for n in ("floor", "range_db") if f"warprrf_{n}" not in header
    ]
    if lacking:
        raise ValueError(f"{file}: lacks {', '.join(lacking)}, expected a spectrum exported by warprrf")
    try:
        numbers: dict[str, Any] = {}
        for name in (n for n in (*_NUMBERS, "floor", "range_db") if f"warprrf_{n}" in header):
            row = np.array([float(v) for v in str(header[f"warprrf_{name}"]).split()])
            numbers[name] = row if len(row) > 1 else float(row[0])
        return Spectrum(
            path_gain=channels["path_gain"],
            delay_s=channels["delay"].astype(np.float64),
            aod=np.stack([channels["aod_zenith"], channels["aod_azimuth"]], axis=-1),
            floor=numbers.pop("floor"),
            range_db=check_range_db(numbers.pop("range_db")),
            attributes=numbers | {name: str(header.get(f"warprrf_{name}", "")) for name in _WORDS},
        )
    except (IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: {error}") from error
