"""What a viewer shows: things of the library, or files of them, sorted by what they are."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warprrf.geometry.mesh import Mesh
from warprrf.geometry.mesh_files import is_mesh_file
from warprrf.geometry.ply_files import holds_gaussians
from warprrf.geometry.reconstruction import FILE as RECONSTRUCTION_FILE
from warprrf.geometry.reconstruction import Reconstruction
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.rf.fields.base import RadioField
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.readings import Readings

CARRIER_HZ = 300e9  # where nothing says another
KINDS = "a Reconstruction, Gaussians, Mesh, Scene, RadioField, SpectrumDataset or Readings, or a file of one"


@dataclass
class Subject:
    """Everything to show; None or empty where there is none.

    Attributes:
        mesh: what is drawn, and what blocks where there is no field.
        gaussians, cameras, photos: of a reconstruction.
        scene: names its materials, and knows the truth.
        field: answers for receivers.
        spectra: truth at measured receivers.
        readings: tables of received power.
    """

    mesh: Mesh | None = None
    gaussians: Gaussians | None = None
    cameras: dict[str, Camera] = field(default_factory=dict)
    photos: dict[str, Path] = field(default_factory=dict)
    scene: Scene | None = None
    field: RadioField | None = None
    spectra: SpectrumDataset | None = None
    readings: Readings | None = None

    @classmethod
    def of(cls, things: Sequence[Any]) -> Subject:
        """Sort ``things``.

        Raises:
            TypeError: for a thing of another kind, or none at all.
            ValueError: for a file that cannot be read, or two things of one kind.
        """
        if not things:
            raise TypeError(f"things: got nothing to show, expected {KINDS}")
        found = cls()
        for thing in things:
            for part in _opened(Path(thing)) if isinstance(thing, str | os.PathLike) else [thing]:
                found._add(part)
        if found.mesh is None:
            whole = found.scene or found.field
            found.mesh = whole.mesh if whole is not None else None
        if found.mesh is None and found.gaussians is None:
            found.gaussians = getattr(found.field, "gaussians", None)
        if found.field is not None and found.spectra is not None:  # to compare them
            found.field = found.field.on_grid(found.spectra.path_gain.shape[1:])
        return found

    def _add(self, thing: Any) -> None:
        if isinstance(thing, Reconstruction):
            self.cameras, self.photos = thing.cameras, thing.photos
            if thing.has_gaussians:
                self._set("gaussians", thing.gaussians)
            if thing.has_mesh:
                self._set("mesh", thing.mesh)
            return
        for name, kind in _KINDS.items():
            if isinstance(thing, kind):
                self._set(name, thing)
                return
        raise TypeError(f"things: got {type(thing).__name__}, expected {KINDS}")

    def _set(self, name: str, thing: Any) -> None:
        if getattr(self, name) is not None:
            raise ValueError(f"things: got two for {name}, expected at most one of each kind")
        setattr(self, name, thing)

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of what is shown [m], shape ``(2, 3)``."""
        if self.mesh is not None:
            return self.mesh.bounds
        if self.gaussians is not None:
            return np.percentile(self.gaussians.means, [1, 99], axis=0)
        places = np.concatenate([d.receivers for d in (self.spectra, self.readings) if d is not None])
        if not len(places):
            raise ValueError("things: got spectra of no receiver, and nothing else that says where to look")
        return np.stack([places.min(axis=0) - 1.0, places.max(axis=0) + 1.0])

    @property
    def transmitter(self) -> np.ndarray | None:
        """Where the transmitter stands at first (3,) [m]."""
        for source in (self.field, self.spectra):
            if source is not None:
                return source.transmitter
        if self.readings is not None:
            return self.readings.transmitters[0]
        if self.scene is not None and self.scene.transmitters:
            return next(iter(self.scene.transmitters.values()))
        return None

    @property
    def carrier_hz(self) -> float:
        """That of the field, or of what was measured [Hz]."""
        for known in (self.field, self.spectra, self.readings):
            if known is not None:
                return known.frequency_hz
        return CARRIER_HZ

    @property
    def places(self) -> np.ndarray:
        """Where it was measured, shape ``(K, 3)`` [m]."""
        for known in (self.spectra, self.readings):
            if known is not None:
                return np.unique(np.atleast_2d(np.asarray(known.receivers, dtype=np.float64)), axis=0)
        return np.zeros((0, 3))


_KINDS: dict[str, type] = {
    "gaussians": Gaussians, "mesh": Mesh, "scene": Scene, "field": RadioField, "spectra": SpectrumDataset,
    "readings": Readings,
}  # fmt: skip
_FILES = {".safetensors": RadioField, ".nc": SpectrumDataset, ".xml": Scene}


def _opened(path: Path) -> list[Any]:
    if path.is_dir():
        return _folder(path)
    if not path.is_file():
        raise ValueError(f"things: {path}: no such file or folder")
    if holds_gaussians(path):
        return [Gaussians.load_ply(path)]
    kind: Any = _FILES.get(path.suffix.lower(), Mesh if is_mesh_file(path) else None)
    if kind is None:
        raise ValueError(f"things: {path}: got a file of another kind, expected {KINDS}")
    return [kind.load(path)]


def _folder(path: Path) -> list[Any]:
    """A reconstruction's folder, or one of `make lobby`'s form: a reconstruction and the field fitted to it."""
    for folder in (path, path / "reconstruction"):
        if (folder / RECONSTRUCTION_FILE).is_file():
            fields = [path / "field.safetensors"]
            return [Reconstruction.load(folder), *(RadioField.load(f) for f in fields if f.is_file())]
    raise ValueError(
        f"things: {path} holds no {RECONSTRUCTION_FILE}, expected what Reconstruction.save wrote"
    )
