"""What an evaluation reads: data sets of each truth, the frozen reconstruction, the true scene."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import warprrf as wr
from benchmarks.lobby.spectra import FILES
from benchmarks.stages import fingerprint
from warprrf.device import Progress
from warprrf.rf.fields.bistatic.training import TrainingViews, trace
from warprrf.rf.fields.files import fingerprint as fingerprint_arrays
from warprrf.rf.fields.harmonic.transport import Transport, transport
from warprrf.rf.spectra.dataset import SpectrumDataset

DATA = "data/lobby"
TRUTHS = tuple(FILES)


@dataclass(frozen=True)
class Truth:
    """One data set, as its rows use it.

    Attributes:
        name: its engine.
        mark: fingerprint of the file's content.
        data: all receivers.
        counts: numbers of training receivers that it can give.
        left_out: asked numbers that it cannot.
        every: each how-manieth test receiver counts.
    """

    name: str
    mark: str
    data: SpectrumDataset
    counts: tuple[int, ...]
    left_out: tuple[int, ...]
    every: int

    @classmethod
    def load(cls, file: Path, counts: tuple[int, ...], every: int) -> Truth:
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
        left_out = tuple(sorted(set(counts) - set(kept)))
        return cls(data.engine, fingerprint([file]), data, kept, left_out, every)

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
    """The frozen reconstruction, the true scene, and what receivers see of them, kept until another set is asked for.

    Args:
        reconstruction: folder of a saved :class:`Reconstruction`.
        scene: true scene (XML).
        device: where to compute.
    """

    def __init__(self, reconstruction: Path, scene: Path, device: Any = None) -> None:
        self.folder, self.xml, self.device = reconstruction, scene, device
        self._rays: dict[str, tuple[str, TrainingViews]] = {}
        self._weights: dict[str, tuple[str, Transport, float]] = {}

    @cached_property
    def reconstruction(self) -> Any:
        """The reconstruction."""
        return wr.Reconstruction.load(self.folder)

    @cached_property
    def scene(self) -> Any:
        """The true scene."""
        return wr.Scene.load(self.xml)

    @cached_property
    def mark(self) -> str:
        """Fingerprint of the reconstruction."""
        return fingerprint([self.folder])

    @cached_property
    def scene_mark(self) -> str:
        """Fingerprint of the true scene."""
        s = self.scene
        return fingerprint_arrays(
            s.mesh.vertices, s.mesh.faces, s.face_material, s.object_names, *s.materials
        )

    def rays(
        self,
        ds: SpectrumDataset,
        *,
        slot: str = "train",
        true: bool = False,
        progress: Progress | None = None,
    ) -> TrainingViews:
        """What the receivers of ``ds`` see of the reconstruction, or of the true scene; one set is kept per slot."""
        key = fingerprint([ds.receivers, ds.transmitter, ds.frequency_hz, list(ds.shape), true])
        if self._rays.get(slot, ("",))[0] != key:
            self._rays.pop(slot, None)  # hundreds of receivers fill gigabytes: not two sets at once
            seen = trace(
                self.scene if true else self.reconstruction,
                ds,
                device=self.device,
                progress=progress,
            )
            self._rays[slot] = key, seen
        return self._rays[slot][1]

    def weights(
        self, ds: SpectrumDataset, *, slot: str = "train", progress: Progress | None = None
    ) -> tuple[Transport, float]:
        """Blending weights of the receivers of ``ds`` and the seconds that they took; one set is kept per slot."""
        key = fingerprint([ds.receivers, list(ds.range_db), list(ds.shape)])
        if self._weights.get(slot, ("",))[0] != key:
            start = time.perf_counter()
            seen = transport(
                self.reconstruction.gaussians,
                ds.receivers,
                ds.shape,
                range_db=ds.range_db,
                device=self.device,
                progress=progress,
            )
            self._weights[slot] = key, seen, time.perf_counter() - start
        return self._weights[slot][1:]

    def forget(self, keep: str = "") -> None:
        """Drop what training receivers see, hundreds of them fill gigabytes; but for ``"rays"`` or ``"weights"``.

        Rays of test receivers go with the others: they are as large. Their weights are small, and stay.
        """
        if keep != "rays":
            self._rays.clear()
        if keep != "weights":
            self._weights.pop("train", None)


def files(
    data: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], truths: Sequence[str]
) -> list[Path]:
    """The file of each truth: in a folder the full set before the sample, or as given, told apart by their engine.

    Raises:
        ValueError: if there is none for a truth, or two.
    """
    if isinstance(data, str | os.PathLike):
        folder = Path(data)
        if folder.is_dir():
            names = {t: (f"{Path(FILES[t]).stem}_full.nc", FILES[t]) for t in truths}
            found = {t: next((folder / n for n in names[t] if (folder / n).is_file()), None) for t in truths}
            lacking = [" or ".join(names[t]) for t, file in found.items() if file is None]
            if lacking:
                raise ValueError(f"data: {folder} lacks {', '.join(lacking)}; warprrf data makes them")
            return [file for file in found.values() if file is not None]
        data = [data]
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


def scene_of(data: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> Path:
    """The scene that belongs to ``data``: ``scene.xml`` in the folder or beside the first file, else the lobby's."""
    first = Path(data) if isinstance(data, str | os.PathLike) else Path(next(iter(data)))
    folder = first if first.is_dir() else first.parent
    own = folder / "scene.xml"
    return own if own.is_file() else Path(DATA) / "scene.xml"
