"""NeWRF's published conference room: the rays that MATLAB traced there, to read.

NeWRF (Lu, Vattheuer, Mirzasoleiman, Abari, ICML 2024; github.com/LuHaofan/NeWRF, MIT licence) traces its rooms with
MATLAB's image method: perfect reflectors without a sign change, up to two reflections, isotropic antennas. Here that
data is an outside check: nothing in it was computed by this package.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from warprrf.checks import check_array, checked
from warprrf.files import read_arrays
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_files import read_mesh
from warprrf.rf.em.waves import SPEED_OF_LIGHT, check_frequency
from warprrf.tensor_files import named

RAYS_FILE = "newrf_conference.npz"
MESH_FILE = "conferenceroom.stl"

# A gain of theirs states the ray's length to 1e-7 m; lengths over their last point either agree with it to that or
# miss by millimetres and more, so anything between separates single from double reflections.
_ONCE_M = 1e-5
_AT_TRANSMITTER_M = 1e-6


@dataclass(frozen=True)
class NewrfRays:
    """Rays of one transmitter to R receivers, at most L each.

    Attributes:
        transmitter: Position [m], shape ``(3,)``.
        receivers: Positions [m], shape ``(R, 3)``, in NeWRF's order.
        frequency_hz: Carrier frequency [Hz].
        last_point: What the receiver sees last [m], shape ``(R, L, 3)``: the transmitter for line of sight, else the
            last reflection; NaN where not valid.
        gain: Complex gain between isotropic antennas, exp(-j 2 pi f tau) included, shape ``(R, L)``; 0 where not valid.
        valid: Whether there is a ray, shape ``(R, L)``, bool.
        line_of_sight: Whether the receiver sees the transmitter, shape ``(R,)``, bool.
        csi: Complex channel, the sum of the gains, shape ``(R,)``.
        mesh: The room.
    """

    transmitter: np.ndarray
    receivers: np.ndarray
    frequency_hz: float
    last_point: np.ndarray
    gain: np.ndarray
    valid: np.ndarray
    line_of_sight: np.ndarray
    csi: np.ndarray
    mesh: Mesh

    @property
    def wavelength_m(self) -> float:
        """Wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    @property
    def length_m(self) -> np.ndarray:
        """Unfolded length that the gain's modulus states (Friis) [m], shape ``(R, L)``; NaN where not valid."""
        size = np.where(self.valid, np.abs(self.gain), np.nan)
        return self.wavelength_m / (4.0 * np.pi * size)

    @property
    def order(self) -> np.ndarray:
        """Reflections of each ray, shape ``(R, L)``, int: 0, 1, 2 (two or more); -1 where not valid.

        A ray is reflected once if the way from the transmitter over its last point is as long as its gain says.
        """
        first = np.linalg.norm(self.last_point - self.transmitter, axis=2)
        over = first + np.linalg.norm(self.last_point - self.receivers[:, None], axis=2)
        order = np.where(np.abs(over - self.length_m) < _ONCE_M, 1, 2)
        order[first < _AT_TRANSMITTER_M] = 0
        return np.where(self.valid, order, -1)

    def split(self, n_train: int | None = None, share: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
        """Indices of training and held-out receivers after NeWRF's ``loaders.py``.

        Held out are the last 20 %, the same whatever the training; training are the first ``share``, of which the
        first ``n_train`` are taken.

        Raises:
            ValueError: if there are fewer training receivers.
        """
        count = len(self.receivers)
        most = int(count * share)
        chosen = most if n_train is None else n_train
        if not 0 <= chosen <= most:
            raise ValueError(
                f"n_train: got {n_train}, expected 0 to {most}, the training receivers there are"
            )
        return np.arange(chosen), np.arange(count - int(count * 0.2), count)


@checked
def load_newrf(folder: str | os.PathLike[str]) -> NewrfRays:
    """Read ``newrf_conference.npz`` and ``conferenceroom.stl`` from ``folder``.

    Raises:
        FileNotFoundError: if one of the files is missing.
        ValueError: if one does not read, lacks an array, or an array has the wrong shape.
    """
    base = Path(folder)
    for name in (RAYS_FILE, MESH_FILE):
        if not (base / name).is_file():
            raise FileNotFoundError(
                f"folder: there is no {base / name}, expected {RAYS_FILE} and {MESH_FILE}"
            )
    with named(base / RAYS_FILE, "damaged or of another kind"):
        return _rays(base)


def _rays(base: Path) -> NewrfRays:
    data = _read_npz(base / RAYS_FILE)
    count, most = _shape(data, base / RAYS_FILE)
    last = _array(data, "last_point", (count, most, 3), float)
    gain = _array(data, "gain", (count, most), complex)
    rays = _array(data, "rays", (count,), np.int64)
    if (rays < 0).any() or (rays > most).any():
        raise ValueError(
            f"rays: got {rays.min()} to {rays.max()}, expected 0 to {most}, the columns there are"
        )
    valid = np.arange(most) < rays[:, None]
    for name, array in (("last_point", last), ("gain", gain)):
        if not np.isfinite(array[valid]).all():
            raise ValueError(f"{name}: got NaN or infinite values among the rays that are there")
    if (gain[valid] == 0).any():
        raise ValueError("gain: got rays with a gain of zero, expected them left out")
    return NewrfRays(
        transmitter=check_array("transmitter", data["transmitter"], (3,)),
        receivers=check_array("receivers", data["receivers"], (count, 3)),
        frequency_hz=check_frequency(data["frequency_hz"]),
        last_point=np.where(valid[..., None], last, np.nan),
        gain=np.where(valid, gain, 0.0),
        valid=valid,
        line_of_sight=_array(data, "line_of_sight", (count,), bool),
        csi=check_array("csi", _array(data, "csi", (count,), complex), (count,), dtype=complex),
        mesh=_room(base / MESH_FILE),
    )


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    names = ("transmitter", "receivers", "frequency_hz", "last_point", "gain", "rays", "line_of_sight", "csi")
    data = read_arrays(path)
    missing = [name for name in names if name not in data]
    if missing:
        raise ValueError(f"{path}: lacks {', '.join(missing)}")
    return data


def _shape(data: dict[str, np.ndarray], path: Path) -> tuple[int, int]:
    shape = data["last_point"].shape
    if len(shape) != 3 or shape[2] != 3:
        raise ValueError(f"last_point: got shape {shape} in {path}, expected (receivers, rays, 3)")
    return shape[0], shape[1]


def _array(data: dict[str, np.ndarray], name: str, shape: tuple[int, ...], dtype: DTypeLike) -> np.ndarray:
    return check_array(name, data[name], shape, dtype=dtype, finite=False)


def _room(path: Path) -> Mesh:
    content = read_mesh(path)
    return Mesh(content.vertices, content.faces)
