"""Angular spectra of small coherent arrays, as they are measured: by number, or in NeRF2's folders of pictures.

An array of M elements that hears the channel h is steered to u by the plane wave's response a(u). Its spectrum is

    P(u) = |a(u)^H h|^2 / M^2,

so that one path alone peaks at its path gain. It is quadratic in the amplitudes of paths: those that arrive within a beam
of each other add up with their phases. Antennas at both ends are vertical: along the zenith unit vector of a path.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from warprrf.checks import NotNegative, Positive, check_array, check_type, checked, one_of
from warprrf.device import require
from warprrf.rf.channel.arrays import PlanarArray, check_unpolarised
from warprrf.rf.em.absorption import Air
from warprrf.rf.spectra.readings import PowerTable

UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Turns an array to lie in x and y and look along z, as a gateway's does."""


@checked
@dataclass(frozen=True, repr=False)
class ArraySpectra(PowerTable):
    """N angular spectra of one array, which stands at ``receivers``.

    An array that sends to a single antenna hears the same by reciprocity: give its place as the receiver's.

    Attributes:
        transmitters: positions of the single antenna [m], shape ``(N, 3)``, or ``(3,)`` for one.
        receivers: positions of the array's centre [m], shape ``(N, 3)``, or ``(3,)``.
        power: |a^H h|^2 / M^2 [linear], shape ``(N, ...)``; NaN where nothing was measured.
        frequency_hz: carrier [Hz].
        array: the array, turned as it stands; without polarisation.
        directions: unit vectors in world axes that it is steered to, shape ``(..., 3)``.
        floor: below which values say nothing, in units of ``power``.
        relative: whether each spectrum has a gain of its own that is not known, as those have that are normalised to
            their peak.
        length_std_m: how well the lengths of paths are known [m]. Paths add up with their phases as far as that leaves
            them, exp(-(2 pi std / lambda)^2 / 2) of their amplitude, and in power beyond: 0 for a true mesh, a wavelength
            for one that says nothing of phases.
        air: whose absorption is in the powers; None for none.
        name: by which a report tells these readings from others; several of one name are numbered in the order given.

    Raises:
        TypeError, ValueError: naming the argument.
    """

    array: PlanarArray
    directions: np.ndarray
    floor: Positive = 0.01
    relative: bool = True
    length_std_m: NotNegative = 0.0
    air: Air | None = None
    name: str = "array spectra"

    def __post_init__(self) -> None:
        directions = check_steering(self.array, self.directions)
        fields = self._checked(*directions.shape[:-1])
        if not (fields["power"] > self.floor).any():
            raise ValueError(f"power: got no value above the floor of {self.floor:g}")
        for name, value in (fields | {"directions": directions}).items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.power.shape[1:]))
        return (
            f"ArraySpectra({len(self)} of {size} directions, {self.array.rows} x {self.array.cols} elements, at "
            f"{self.frequency_hz / 1e9:g} GHz)"
        )

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        frequency_hz: float,
        part: Annotated[str | None, one_of(None, "train", "test")] = None,
        array: PlanarArray | None = None,
        **settings: Any,
    ) -> ArraySpectra:
        """Spectra in NeRF2's layout: the array (the gateway) stands still, the transmitter moves.

        ``spectrum/7.png``, grey of 8 bits, 255 at its peak, belongs to the 7th row of positions in ``tx_pos.csv``. Its
        rows are elevations from 1 to 90 degrees, its columns azimuths from 1 to 360 degrees in the gateway's frame, whose
        place and orientation (quaternion xyzw) are in ``gateway_info.yml`` (github.com/XPengZhao/NeRF2).

        Args:
            path: the folder.
            frequency_hz: carrier [Hz], which it does not say.
            part: ``"train"`` or ``"test"``: those that ``train_index.txt`` or ``test_index.txt`` names, in its order; None:
                all, by number.
            array: the array; by default 4 x 4 elements half a wavelength apart, in the gateway's x and y.
            settings: other arguments of :class:`ArraySpectra`.

        Raises:
            FileNotFoundError: naming what is missing.
            ValueError: naming the file whose content does not fit.
            ImportError: without Pillow (extra ``mesh``).
        """
        folder = Path(path)
        needed = ["spectrum", "tx_pos.csv", "gateway_info.yml", *([f"{part}_index.txt"] if part else [])]
        for name in needed:
            if not (folder / name).exists():
                raise FileNotFoundError(f"path: {folder / name} is missing, expected NeRF2's layout")
        position, rotation = _gateway(folder / "gateway_info.yml")
        senders = _positions(folder / "tx_pos.csv")
        if part:
            names = (folder / f"{part}_index.txt").read_text(encoding="utf-8", errors="replace").split()
        else:
            names = [file.stem for file in (folder / "spectrum").glob("*.png")]
            names.sort(key=lambda name: _number(name, folder))
        if not names:
            raise ValueError(f"path: {folder} names no spectra, expected spectrum/1.png and so on")
        numbers = np.array([_number(name, folder) for name in names])
        if numbers.max() > len(senders):
            raise ValueError(
                f"path: {folder / 'tx_pos.csv'}: got {len(senders)} positions, expected one for each of {numbers.max()} "
                "spectra"
            )
        first = _picture(folder / "spectrum" / f"{names[0]}.png", None)
        power = np.stack([_picture(folder / "spectrum" / f"{name}.png", first.shape) for name in names])
        given = {
            "directions": hemisphere(first.shape) @ rotation.T, "array": array or PlanarArray(4, 4, orientation=rotation @ UP)
        } | settings  # fmt: skip
        return cls(
            transmitters=senders[numbers - 1],
            receivers=position,
            power=power,
            frequency_hz=frequency_hz,
            **given,
        )


def hemisphere(shape: tuple[int, int]) -> np.ndarray:
    """Unit vectors of NeRF2's pictures in the gateway's frame: elevation down the rows, azimuth along the columns."""
    elevation = np.radians(np.linspace(1.0, 90.0, shape[0]))[:, None]
    azimuth = np.radians(np.linspace(1.0, 360.0, shape[1]))[None, :]
    x, y, z = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def check_steering(array: PlanarArray, directions: ArrayLike) -> np.ndarray:
    """``directions`` (..., 3) of unit length, if ``array`` is one that spectra are of."""
    check_type("array", array, PlanarArray)
    check_unpolarised("array", array)
    found = check_array("directions", directions, (..., None, 3))
    if found.size == 0:
        raise ValueError(f"directions: got shape {found.shape}, expected (..., 3)")
    length = np.linalg.norm(found, axis=-1, keepdims=True)
    if not (np.abs(length - 1.0) < 1e-3).all():
        raise ValueError("directions: got vectors of another length than 1, expected unit vectors")
    return found / length


def _number(name: str, folder: Path) -> int:
    if not (name.isascii() and name.isdigit() and len(name) < 10 and int(name) > 0):
        raise ValueError(f"path: {folder}: got a spectrum named {name!r:.40}, expected whole numbers from 1")
    return int(name)


def _picture(path: Path, shape: tuple[int, ...] | None) -> np.ndarray:
    """Grey levels of 8 bits as [0, 1]; the header is looked at before anything is decoded."""
    image = require("PIL.Image", extra="mesh")
    most = 4_000_000  # pixels; NeRF2's have 32,400
    if not path.is_file():
        raise FileNotFoundError(f"path: {path} is missing, though an index names it")
    try:
        with image.open(path, formats=["PNG"]) as opened:
            width, height = opened.size
            if opened.mode != "L" or width * height > most:
                raise ValueError(f"got {width} x {height} of mode {opened.mode}, expected grey of 8 bits")
            if shape not in (None, (height, width)):
                raise ValueError(f"got {height} rows of {width}, expected {shape} as of the first spectrum")
            return np.asarray(opened, np.float32) / np.float32(255.0)
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"path: {path}: {error}") from error


def _positions(path: Path) -> np.ndarray:
    try:
        return check_array("x,y,z", np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2), (None, 3))
    except ValueError as error:
        raise ValueError(f"path: {path}: expected a line of names, then rows x,y,z ({error})") from error


def _gateway(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Position of the gateway and the rotation from its frame to the world."""
    text, found = path.read_text(encoding="utf-8", errors="replace"), []
    for key, size in (("position", 3), ("orientation", 4)):
        entries = re.findall(rf"^\s*{key}\s*:\s*\[([^\]\n]*)\]", text, re.MULTILINE)
        try:
            if len(entries) != 1:
                raise ValueError(f"got {len(entries)} of it")
            found.append(check_array(key, [float(value) for value in entries[0].split(",")], (size,)))
        except ValueError as error:
            raise ValueError(f"path: {path}: expected one {key}: [{size} numbers] ({error})") from error
    if not np.linalg.norm(found[1]) > 0:
        raise ValueError(f"path: {path}: got an orientation of length zero, expected a quaternion xyzw")
    return found[0], Rotation.from_quat(found[1]).as_matrix()
