"""NeRF2's public spectrum format: a folder with ``spectrum/*.png``, ``tx_pos.csv`` and ``gateway_info.yml``.

One receiver array (the gateway) stands still and the transmitter moves. ``spectrum/7.png`` belongs to the 7th row of
positions, is grey of 8 bits, and its rows are elevations from 1 to 90 degrees, its columns azimuths from 1 to 360
degrees in the gateway's frame, whose orientation is a quaternion xyzw. ``train_index.txt`` and ``test_index.txt``, if
they are there, name the pictures of either set (github.com/XPengZhao/NeRF2, dataset_tools).
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baselines.images import SpectrumImages
from warprrf.checks import check_array
from warprrf.device import require


def load_nerf2_spectra(folder: str | os.PathLike[str], part: str | None = None) -> SpectrumImages:
    """Read a folder of NeRF2's spectra.

    Args:
        folder: with ``spectrum/*.png``, ``tx_pos.csv`` and ``gateway_info.yml``.
        part: ``"train"`` or ``"test"``: those that the index file names, in its order; None: all, by number.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: naming the file whose content does not fit.
        ImportError: without Pillow or PyYAML (extra ``baselines``).
    """
    folder = Path(folder)
    if part not in (None, "train", "test"):
        raise ValueError(f'part: got {part!r}, expected "train", "test" or None')
    needed = [folder / "spectrum", folder / "tx_pos.csv", folder / "gateway_info.yml"]
    needed += [folder / f"{part}_index.txt"] if part else []
    for place in needed:
        if not place.exists():
            raise FileNotFoundError(f"folder: {place} is missing, expected NeRF2's spectrum layout")
    position, rotation = _gateway(folder / "gateway_info.yml")
    senders = _positions(folder / "tx_pos.csv")
    if part:
        names = (folder / f"{part}_index.txt").read_text().split()
    else:
        names = [file.stem for file in (folder / "spectrum").glob("*.png")]
        names.sort(key=lambda name: _number(name, folder))
    if not names:
        raise ValueError(f"folder: {folder} names no spectra, expected spectrum/1.png and so on")
    numbers = np.array([_number(name, folder) for name in names])
    if numbers.max() > len(senders):
        raise ValueError(
            f"{folder / 'tx_pos.csv'}: got {len(senders)} positions, expected one for each of {numbers.max()} spectra"
        )
    images = [_picture(folder / "spectrum" / f"{name}.png") for name in names]
    odd = [name for name, image in zip(names, images, strict=True) if image.shape != images[0].shape]
    if odd:
        raise ValueError(f"{folder}: spectrum {odd[0]} has another size than {names[0]}, expected one size")
    rows, columns = images[0].shape
    elevation = np.radians(np.linspace(1.0, 90.0, rows))[:, None]
    azimuth = np.radians(np.linspace(1.0, 360.0, columns))[None, :]
    own = np.stack(
        np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ),
        axis=-1,
    )
    return SpectrumImages(
        images=np.stack(images),
        receivers=np.broadcast_to(position, (len(images), 3)),
        transmitters=senders[numbers - 1],
        directions=own @ rotation.T,
    )


def _number(name: str, folder: Path) -> int:
    if not name.isdigit() or int(name) < 1:
        raise ValueError(f"{folder}: got a spectrum named {name!r}, expected whole numbers from 1, as 1.png")
    return int(name)


def _picture(path: Path) -> np.ndarray:
    """Grey levels of 8 bits as [0, 1]."""
    image = require("PIL.Image", extra="baselines")
    if not path.is_file():
        raise FileNotFoundError(f"folder: {path} is missing, though an index names it")
    with image.open(path) as opened:
        if opened.mode not in ("L", "1"):
            raise ValueError(f"{path}: got a picture of mode {opened.mode}, expected grey of 8 bits")
        return np.asarray(opened.convert("L"), np.float32) / np.float32(255.0)


def _positions(path: Path) -> np.ndarray:
    try:
        found = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path}: expected a line of names, then rows x,y,z ({error})") from error
    return check_array(str(path), found, (None, 3))


def _gateway(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Position of the gateway and the rotation from its frame to the world."""
    yaml = require("yaml", extra="baselines")
    try:
        entry: dict[str, Any] = yaml.safe_load(path.read_text())["gateway1"]
        position = check_array("position", entry["position"], (3,))
        x, y, z, w = check_array("orientation", entry["orientation"], (4,))
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: expected gateway1 with a position (3) and an orientation (quaternion xyzw): {error!r}"
        ) from error
    norm = np.sqrt(x * x + y * y + z * z + w * w)
    if norm == 0:
        raise ValueError(f"{path}: got an orientation of length zero, expected a quaternion xyzw")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return position, np.array(rotation)
