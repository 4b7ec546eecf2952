"""NeWRF's published conference room: its mesh and receivers, to read.

NeWRF (Lu, Vattheuer, Mirzasoleiman, Abari, ICML 2024; github.com/LuHaofan/NeWRF, MIT licence).
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warprrf.checks import check_array
from warprrf.files import read_arrays
from warprrf.geometry.mesh import Mesh

RAYS_FILE = "newrf_conference.npz"
MESH_FILE = "conferenceroom.stl"


@dataclass(frozen=True)
class NewrfRoom:
    """The room.

    Attributes:
        receivers: Positions [m], shape ``(R, 3)``, in NeWRF's order.
        mesh: The room's surfaces; nothing is said of their materials.
    """

    receivers: np.ndarray
    mesh: Mesh


def load_newrf(folder: str | os.PathLike[str]) -> NewrfRoom:
    """Read ``newrf_conference.npz`` and ``conferenceroom.stl`` from ``folder``.

    Raises:
        FileNotFoundError: if one of the files is missing.
        ValueError: if one does not read, or there are no receivers in it.
    """
    base = Path(folder)
    for name in (RAYS_FILE, MESH_FILE):
        if not (base / name).is_file():
            raise FileNotFoundError(
                f"folder: there is no {base / name}, expected {RAYS_FILE} and {MESH_FILE}"
            )
    data = read_arrays(base / RAYS_FILE)
    if "receivers" not in data:
        raise ValueError(f"{base / RAYS_FILE}: lacks receivers")
    return NewrfRoom(check_array("receivers", data["receivers"], (None, 3)), Mesh.load(base / MESH_FILE))
