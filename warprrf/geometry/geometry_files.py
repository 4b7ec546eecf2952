"""Geometry on disk: Gaussians, planes, patches and a mesh with a header, in one safetensors file, replaced at once.

:class:`Steps` keeps the steps of a run so, each for what it was made from.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.device import check_array
from warprrf.files import write_atomically
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.patches import PlanarPatch
from warprrf.geometry.photos.planes import Plane
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.marks import log_other_code

_GAUSSIANS = ("means", "quaternions", "scales", "opacities", "sh")


def write(
    path: Path,
    header: dict[str, Any],
    *,
    gaussians: Gaussians | None = None,
    planes: Sequence[Plane] | None = None,
    patches: Sequence[PlanarPatch] | None = None,
    mesh: Mesh | None = None,
) -> None:
    """Write ``header`` (plain values) and what is given to ``path``."""
    from safetensors.numpy import save_file

    head = dict(header)
    arrays: dict[str, np.ndarray] = {}
    if gaussians is not None:
        arrays |= {name: getattr(gaussians, name) for name in _GAUSSIANS}
    if planes is not None:
        head["planes"] = [
            {
                "normal": p.normal.tolist(), "offset": p.offset, "rms_m": p.rms_m, "axes": p.axes.tolist(),
                "corner": p.corner.tolist(), "cell_m": p.cell_m,
            }
            for p in planes
        ]  # fmt: skip
        for k, plane in enumerate(planes):
            arrays |= {f"plane_{k}_inliers": plane.inliers, f"plane_{k}_occupied": plane.occupied}
    if patches is not None:
        head["patches"] = [{"normal": p.normal.tolist(), "offset": p.offset, "area": p.area} for p in patches]
        arrays |= {f"patch_{k}": p.faces.astype(np.int64) for k, p in enumerate(patches)}
    if mesh is not None:
        arrays |= {"vertices": mesh.vertices, "faces": mesh.faces}
    whole = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    write_atomically(path, lambda file: save_file(whole, file, metadata={"header": json.dumps(head)}))


@dataclass(frozen=True)
class Stored:
    """What a file holds; a part that it does not hold raises KeyError.

    Attributes:
        header: plain values.
        arrays: all arrays, by name.
    """

    header: dict[str, Any]
    arrays: dict[str, np.ndarray] = field(repr=False)

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians."""
        return Gaussians(*(self.arrays[name] for name in _GAUSSIANS))

    @property
    def planes(self) -> list[Plane]:
        """Planes detected among sparse points."""
        return [
            Plane(
                np.array(p["normal"]),
                p["offset"],
                check_array("inliers", self.arrays[f"plane_{k}_inliers"], None, np.int64),
                p["rms_m"],
                np.array(p["axes"]),
                np.array(p["corner"]),
                p["cell_m"],
                self.arrays[f"plane_{k}_occupied"],
            )
            for k, p in enumerate(self.header["planes"])
        ]

    @property
    def patches(self) -> list[PlanarPatch]:
        """Planar patches of the mesh."""
        return [
            PlanarPatch(np.array(p["normal"]), p["offset"], self.arrays[f"patch_{k}"], p["area"])
            for k, p in enumerate(self.header["patches"])
        ]

    @property
    def has_mesh(self) -> bool:
        """Whether there is a mesh."""
        return "faces" in self.arrays

    @property
    def mesh(self) -> Mesh:
        """The mesh."""
        return Mesh(self.arrays["vertices"], self.arrays["faces"])


def read(path: Path) -> Stored:
    """What :func:`write` wrote.

    Raises:
        ValueError: if the file is damaged or none of these.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            header = json.loads((file.metadata() or {})["header"])
            return Stored(header, {k: file.get_tensor(k) for k in file.keys()})  # noqa: SIM118 (not a mapping)
    except (SafetensorError, KeyError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is damaged or not ours: {error}; delete it, or restore it") from error


class Steps:
    """Finished steps of a run, in their order: one file each, valid for what went in, the code, and the steps before.

    Args:
        folder: where the files lie; made if missing.
        inputs: what the first step starts from, as plain values.
    """

    def __init__(self, folder: Path, inputs: Any) -> None:
        self.folder = folder
        self._key = _digest(inputs)
        folder.mkdir(parents=True, exist_ok=True)

    def step(self, name: str, code: str, make: Callable[[str], dict[str, Any]]) -> Stored:
        """What step ``name`` leaves: its file if the same code made it from the same, else what ``make`` makes.

        Args:
            code: mark of the step's code; see :func:`warprrf.marks.code_mark`.
            make: called with a key of the step; returns the parts that :func:`write` takes.
        """
        header = {"key": self._key, "code": code}
        self._key = _digest(header)
        path = self.folder / f"{name}.safetensors"
        if path.is_file():
            found = read(path)
            if header.items() <= found.header.items():
                return found
            if found.header.get("key") == header["key"]:
                log_other_code(path)
        write(path, header, **make(self._key))
        return read(path)

    def only(self, name: str, pattern: str) -> Path:
        """The path of ``name``; files of the same pattern that belong to other keys are removed."""
        for path in self.folder.glob(pattern):
            if path.name != name:
                path.unlink()
        return self.folder / name


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()
