"""What the paper's evaluation consists of: runs, sizes, splits of the receivers, and the truths.

A run is one method with one number of training receivers of one truth, one seed and one split. Test receivers are the
same for every method, training subsets are nested. ``random``: test receivers are scattered among the others, as in the
paper. ``region``: a quarter of the room, the farthest from the transmitter along the longer side, is held out; training
receivers there are left out and test receivers elsewhere are not asked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.data import Truth
from benchmarks.methods import METHODS, Effort
from warprrf.rf.spectra.dataset import SpectrumDataset

TRUTHS = {"exact": "exact", "sionna": "Sionna RT", "paper-law": "paper's law"}
"""Truths and their names; ``paper-law`` is made from the exact engine's paths, see :mod:`.paper_law`."""
SPLITS = ("random", "region")
HELD_OUT = 0.25  # of the receivers' extent along the longer side

TABLE_METHODS = tuple(m for m in METHODS if m != "rf3dgs+los")
CURVE_METHODS = ("bistatic", "rf3dgs+", "rf3dgs", "nearest", "idw", "constant")
OPACITY_METHODS = ("rf3dgs+alpha", "rf3dgs-alpha")
LAW_METHODS = ("rf3dgs+", "rf3dgs")
"""Methods that the paper's law is tried on: its finding is about these two."""


@dataclass(frozen=True, order=True)
class Run:
    """One run.

    Attributes:
        truth: of :data:`TRUTHS`.
        split: of :data:`SPLITS`.
        count: training receivers; 0 for methods that see no spectrum.
        seed: orders the training receivers and starts the method.
        method: of :data:`METHODS`.
        variant: of the method's variants, "" if it has one only.
    """

    truth: str
    split: str
    count: int
    seed: int
    method: str
    variant: str = ""

    @property
    def key(self) -> str:
        """Name of its files."""
        parts = [self.truth, self.split, str(self.count), f"s{self.seed}", self.method, self.variant]
        return "-".join(part.replace(" ", "_").replace(",", "") for part in parts if part)


@dataclass(frozen=True)
class Scale:
    """How large an evaluation is.

    Attributes:
        name: "small" or "paper".
        table_counts: training receivers of the table.
        curve_counts: training receivers of the sparsity curves.
        network_counts: those of them that NeRF2 and the GAN are trained on.
        network_truths: truths that they are trained on.
        opacity_counts: those of them that opacity is trained on, too.
        seeds, truths, splits: which.
        region_counts: training receivers of the region split.
        every: each how-manieth test receiver counts.
        effort: how long iterative methods may work.
        least_shape: rows and columns that spectra should have at least.
    """

    name: str
    table_counts: tuple[int, ...]
    curve_counts: tuple[int, ...]
    network_counts: tuple[int, ...]
    network_truths: tuple[str, ...]
    opacity_counts: tuple[int, ...]
    seeds: tuple[int, ...]
    truths: tuple[str, ...]
    splits: tuple[str, ...]
    region_counts: tuple[int, ...]
    every: int
    effort: Effort
    least_shape: tuple[int, int]


PUBLISHED_COUNTS = (10, 15, 20, 25, 50, 100, 200, 400, 700)
SCALES = {
    "small": Scale(
        name="small",
        table_counts=(10, 50, 400),
        curve_counts=(10, 15, 20, 25, 50, 100, 200, 400),
        network_counts=(10, 50, 400),
        network_truths=("exact",),
        opacity_counts=(10, 50),
        seeds=(0,),
        truths=("exact", "paper-law"),
        splits=("random", "region"),
        region_counts=(50,),
        every=4,
        effort=Effort(
            nerf2_iterations=500, nerf2_rays=256, nerf2_samples=32, cgan_iterations=500, cgan_batch=2
        ),
        least_shape=(60, 120),
    ),
    "paper": Scale(
        name="paper",
        table_counts=PUBLISHED_COUNTS,
        curve_counts=PUBLISHED_COUNTS,
        network_counts=PUBLISHED_COUNTS,
        network_truths=("exact", "sionna"),
        opacity_counts=PUBLISHED_COUNTS,
        seeds=(0, 1, 2),
        truths=("exact", "sionna", "paper-law"),
        splits=("random", "region"),
        region_counts=(50, 400),
        every=1,
        effort=Effort(
            nerf2_iterations=30_000, nerf2_rays=8192, nerf2_samples=64, cgan_iterations=30_000, cgan_batch=8
        ),
        least_shape=(90, 180),
    ),
}


def plan(
    kind: str,
    scale: Scale,
    *,
    methods: Sequence[str] | None = None,
    held: Mapping[tuple[str, str], Sequence[int]],
) -> list[Run]:
    """The runs of a command, those of one set of training receivers beside each other.

    Args:
        kind: ``"table1"``: all methods; ``"sparsity"``: the curves of the paper's figure.
        methods: only these.
        held: numbers of training receivers that each truth and split can give.
    """
    chosen = TABLE_METHODS if kind == "table1" else CURVE_METHODS
    if methods is not None:
        chosen = tuple(m for m in chosen if m in methods)
    runs: list[Run] = []
    for truth in scale.truths:
        for split in scale.splits:
            if split != "random" and (kind != "table1" or truth == "paper-law"):
                continue
            wanted = scale.region_counts if split == "region" else _counts(kind, scale)
            own = [m for m in chosen if truth != "paper-law" or m in LAW_METHODS]
            counts = [n for n in wanted if n in held[truth, split]]
            for seed in scale.seeds:
                for count in counts:
                    for method in (m for m in own if not METHODS[m].untaught):
                        if not _wanted(method, truth, split, count, scale):
                            continue
                        runs += [Run(truth, split, count, seed, method, v) for v in METHODS[method].variants]
            for method in (m for m in own if METHODS[m].untaught):
                seeds = scale.seeds if METHODS[method].random else scale.seeds[:1]
                runs += [Run(truth, split, 0, seed, method) for seed in seeds]
    return runs


def _wanted(method: str, truth: str, split: str, count: int, scale: Scale) -> bool:
    """Whether a costly method is asked for this set."""
    if METHODS[method].network:
        return split == "random" and truth in scale.network_truths and count in scale.network_counts
    return method not in OPACITY_METHODS or (split == "random" and count in scale.opacity_counts)


def _counts(kind: str, scale: Scale) -> tuple[int, ...]:
    return scale.table_counts if kind == "table1" else scale.curve_counts


def held_out(data: SpectrumDataset) -> np.ndarray:
    """Which receivers lie in the region that the ``region`` split holds out, shape ``(R,)`` bool."""
    low, high = data.receivers.min(axis=0), data.receivers.max(axis=0)
    axis = int(np.argmax((high - low)[:2]))
    along = (data.receivers[:, axis] - low[axis]) / (high[axis] - low[axis])
    near_end = data.transmitter[axis] < 0.5 * (low[axis] + high[axis])
    return np.asarray(along > 1.0 - HELD_OUT if near_end else along < HELD_OUT)


def split_data(data: SpectrumDataset, split: str) -> SpectrumDataset:
    """The receivers that take part in ``split``."""
    if split not in SPLITS:
        raise ValueError(f"split: got {split!r}, expected one of {', '.join(SPLITS)}")
    if split == "random":
        return data
    inside = held_out(data)
    return data.subset(np.where(data.role == "test", inside, ~inside))


def truth_of(name: str, key: str, data: SpectrumDataset, split: str, every: int) -> Truth:
    """A truth with the receivers of a split.

    Raises:
        ValueError: if the split leaves no training or no test receivers.
    """
    part = split_data(data, split)
    held = int(np.count_nonzero(part.role == "train"))
    if held == 0 or held == len(part):
        raise ValueError(
            f"data: the {split} split of {name} leaves {held} training and {len(part) - held} test receivers, expected "
            "some of both"
        )
    return Truth(name, key, part, tuple(range(1, held + 1)), (), every if split == "random" else 1)


def shown_receivers(test: SpectrumDataset) -> np.ndarray:
    """Indices of two test receivers whose spectra are drawn: of median path gain with line of sight, and without."""
    total = test.path_gain.sum(axis=(1, 2), dtype=np.float64)
    found = []
    for where in (test.line_of_sight, ~test.line_of_sight):
        index = np.flatnonzero(where)
        if len(index):
            found.append(index[np.argsort(total[index], kind="stable")][(len(index) - 1) // 2])
    return np.array(found, dtype=np.int64)


@dataclass(frozen=True)
class Setting:
    """Where everything lies that a run reads, in plain values, so that it travels to another process or machine.

    Attributes:
        files: file of each truth.
        keys: digest of each truth's file.
        geometry: folder of the reconstruction.
        geometry_key: digest of the reconstruction and the true scene.
        scene: true scene (XML).
        scratch: folder for half-done trainings and twins; workers on other machines need to see it for resuming only.
        every: each how-manieth test receiver of the random split counts.
        effort: how long iterative methods may work.
        device: Warp device.
    """

    files: tuple[tuple[str, str], ...]
    keys: tuple[tuple[str, str], ...]
    geometry: str
    geometry_key: str
    scene: str
    scratch: str
    every: int
    effort: Effort = field(default_factory=Effort)
    device: str | None = None

    def file(self, truth: str) -> Path:
        """The file of a truth."""
        return Path(dict(self.files)[truth])

    def key(self, truth: str) -> str:
        """The digest of a truth's file."""
        return dict(self.keys)[truth]
