"""One spectrum to and from OpenEXR: channels path_gain, delay, aod_zenith and aod_azimuth, 32-bit.

Numbers in the header are text, because EXR headers hold 32-bit floats only.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import require
from warprrf.files import write_atomically
from warprrf.rf.spectra.spectrum import Spectrum

_CHANNELS = ("path_gain", "delay", "aod_zenith", "aod_azimuth")
_NUMBERS = ("frequency_hz", "beam_sigma_rad", "receiver", "transmitter")  # attributes of a data set's spectra
_WORDS = ("engine", "polarisation")


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
    write_atomically(path, lambda file: exr.File(header, channels).write(str(file)))


def import_exr(path: str | os.PathLike[str]) -> Spectrum:
    """Read one spectrum from OpenEXR; position, frequency, beam and engine are in its ``attributes``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it does not read as one of ours.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"path: there is no file {file}")
    exr = require("OpenEXR", extra="exr")
    try:
        with exr.File(str(file), separate_channels=True) as opened:
            header = dict(opened.header())
            channels = {name: np.array(channel.pixels) for name, channel in opened.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"path: {file} does not read as OpenEXR ({error})") from error
    lacking = [n for n in _CHANNELS if n not in channels] + [
        n for n in ("floor", "range_db") if f"warprrf_{n}" not in header
    ]
    if lacking:
        raise ValueError(f"path: {file} lacks {', '.join(lacking)}, expected a spectrum exported by warprrf")
    numbers = {}
    for name in (*_NUMBERS, "floor", "range_db"):
        row = np.array([float(v) for v in str(header.get(f"warprrf_{name}", "nan")).split()])
        numbers[name] = row if len(row) > 1 else float(row[0])
    low, high = np.reshape(numbers.pop("range_db"), 2)
    return Spectrum(
        path_gain=channels["path_gain"],
        delay_s=channels["delay"].astype(np.float64),
        aod=np.stack([channels["aod_zenith"], channels["aod_azimuth"]], axis=-1),
        floor=float(numbers.pop("floor")),
        range_db=(float(low), float(high)),
        attributes=numbers | {name: str(header.get(f"warprrf_{name}", "")) for name in _WORDS},
    )
