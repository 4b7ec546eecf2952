"""What several benchmarks read: the data set of each truth, the frozen reconstruction, the true scene."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.lobby.spectra import FILES
from benchmarks.runner import option
from warprrf.device import Progress
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.rf.fields.harmonic.transport import Transport, transport
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.steps import digest

DATA = "data/lobby"
GEOMETRY = "runs/lobby/reconstruction"
GAUSSIANS = 40_000  # that stand for a mesh
TRUTHS = tuple(FILES)


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """Options of what compares methods on data sets.

    Attributes:
        data: folder with the spectra of each truth and ``scene.xml``, or the spectra's files (NetCDF), one a truth.
        geometry: folder of a saved reconstruction.
        scene: true scene (XML); by default the one in the folder ``data``, or beside the first file, or the lobby's.
    """

    data: tuple[str, ...] = option((DATA,), "folder of spectra and scene, or NetCDF files, one a truth")
    geometry: str = option(GEOMETRY, "folder of a saved reconstruction")
    scene: str | None = option(None, "true scene (XML): the one beside the data by default")

    @property
    def xml(self) -> Path:
        """The true scene's file."""
        return Path(self.scene) if self.scene is not None else scene_of(self.data)

    def place(self, device: Any = None) -> Geometry:
        """What is known of the room.

        Raises:
            ValueError: if there is no such reconstruction.
        """
        folder = Path(self.geometry)
        if not folder.is_dir():
            raise ValueError(
                f"geometry: there is no folder {folder}; expected a saved reconstruction, such as "
                f"python -m benchmarks lobby leaves in {GEOMETRY}"
            )
        return Geometry(folder, self.xml, device)


@dataclass(frozen=True)
class Truth:
    """One data set, as its rows use it.

    Attributes:
        name: its engine.
        key: digest of the file's content.
        data: all receivers.
        counts: numbers of training receivers that it can give.
        every: every n-th test receiver counts.
    """

    name: str
    key: str
    data: SpectrumDataset
    counts: tuple[int, ...]
    every: int

    @classmethod
    def load(cls, file: Path, counts: Sequence[int], every: int = 1) -> Truth:
        """Read ``file`` and see which of ``counts`` it holds.

        Raises:
            FileNotFoundError, ValueError: as :meth:`SpectrumDataset.load` does; if none of ``counts`` is held.
        """
        data = SpectrumDataset.load(file)
        held = int(np.count_nonzero(data.role == "train"))
        kept = tuple(sorted({n for n in counts if 1 <= n <= held}))
        if not kept:
            raise ValueError(
                f"counts: got {', '.join(map(str, counts))}, expected a number of training receivers that {file} "
                f"holds, 1 to {held}"
            )
        return cls(data.engine, digest(Path(file)), data, kept, every)

    def train(self, count: int, seed: int = 0) -> SpectrumDataset:
        """The first ``count`` training receivers, in the order that ``seed`` gives them."""
        return self.data.split(count, seed=seed)[0]

    @cached_property
    def test(self) -> SpectrumDataset:
        """The test receivers that count."""
        test = self.data.split(self.counts[0])[1]
        return test.subset(np.arange(0, len(test), self.every))

    @property
    def few(self) -> int:
        """The smallest number of training receivers: that of the checks besides the main table."""
        return self.counts[0]


class Geometry:
    """What methods know of the room, the true scene, and the blending weights of receivers, kept for the next method.

    Args:
        room: folder of a saved :class:`Reconstruction`; or a mesh or a scene, of which only the mesh is known: it is covered
            with flat Gaussians.
        xml: true scene.
        device: where to compute.
    """

    def __init__(self, room: Path, xml: Path, device: Any = None) -> None:
        self.room, self.xml, self.device = room, xml, device
        self._weights: tuple[str, Transport, float] | None = None

    @cached_property
    def reconstruction(self) -> wr.Reconstruction:
        """The reconstruction, or what stands for one."""
        if self.room.is_dir():
            return wr.Reconstruction.load(self.room)
        mesh = wr.Scene.load(self.room).mesh if self.room.suffix == ".xml" else wr.Mesh.load(self.room)
        bare = wr.Mesh(mesh.vertices, mesh.faces)
        return wr.Reconstruction(discs_on_mesh(bare, GAUSSIANS), bare)

    @cached_property
    def scene(self) -> wr.Scene:
        """The true scene."""
        return wr.Scene.load(self.xml)

    @cached_property
    def key(self) -> str:
        """Digest of what is known of the room."""
        return digest(self.room) if self.room.is_dir() else digest(self.reconstruction.mesh.triangles)

    def weights(self, ds: SpectrumDataset, progress: Progress | None = None) -> tuple[Transport, float]:
        """Blending weights of the receivers of ``ds`` and the seconds that they took; one set is kept, which also serves some
        of its receivers."""
        # Cutoffs follow from the range, so two truths share weights only if the range is the same.
        key = digest(list(ds.range_db), list(ds.shape))
        kept = self._weights
        if kept is not None and kept[0] == key:
            order = {tuple(place): k for k, place in enumerate(kept[1].receivers)}
            rows = [order.get(tuple(place), -1) for place in ds.receivers]
            if rows == list(range(len(order))):
                return kept[1:]
            if min(rows) >= 0:
                return kept[1].subset(rows), kept[2] * len(rows) / len(order)
        self._weights = None  # hundreds of receivers fill gigabytes: not two sets at once
        start = time.perf_counter()
        seen = transport(
            self.reconstruction.gaussians,
            ds.receivers,
            ds.shape,
            range_db=ds.range_db,
            device=self.device,
            progress=progress,
        )
        self._weights = key, seen, time.perf_counter() - start
        return self._weights[1:]


def checked(name: str, value: int, least: int) -> int:
    """``value`` if it is a whole number of at least ``least``; else a ValueError that names the option."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}: got {value!r}, expected a whole number of at least {least}")
    return int(value)


def files(data: Sequence[str], truths: Sequence[str]) -> list[Path]:
    """The file of each truth: in a folder the full set before the sample, or as given, distinguished by their engine.

    Raises:
        ValueError: if there is none for a truth, or two, or a truth is unknown.
    """
    unknown = [name for name in truths if name not in TRUTHS]
    if unknown or not truths:
        raise ValueError(f"truths: got {list(truths)!r}, expected one or both of {', '.join(TRUTHS)}")
    first = Path(data[0])
    if len(data) == 1 and first.is_dir():
        names = {t: (f"{Path(FILES[t]).stem}_full.nc", FILES[t]) for t in truths}
        found = {t: next((first / n for n in names[t] if (first / n).is_file()), None) for t in truths}
        lacking = [" or ".join(names[t]) for t, file in found.items() if file is None]
        if lacking:
            raise ValueError(
                f"data: {first} lacks {', '.join(lacking)}; python -m benchmarks data makes them"
            )
        return [file for file in found.values() if file is not None]
    by_engine: dict[str, Path] = {}
    for file in map(Path, data):
        engine = SpectrumDataset.load(file).engine
        if engine in by_engine:
            raise ValueError(f"data: {by_engine[engine]} and {file} are both {engine}, expected one a truth")
        by_engine[engine] = file
    absent = [t for t in truths if t not in by_engine]
    if absent:
        raise ValueError(f"data: no file of engine {', '.join(absent)} among {', '.join(map(str, data))}")
    return [by_engine[t] for t in truths]


def scene_of(data: Sequence[str]) -> Path:
    """The scene that belongs to ``data``: ``scene.xml`` in the folder or beside the first file, else the lobby's."""
    first = Path(data[0])
    own = (first if first.is_dir() else first.parent) / "scene.xml"
    return own if own.is_file() else Path(DATA) / "scene.xml"
