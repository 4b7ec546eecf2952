"""What the paper's evaluation consists of: truths, splits of the receivers, and the runs at the paper's own size.

A run is one method with one number of training receivers of one truth, one seed and one split. Test receivers are the
same for every method, training subsets are nested. ``random``: test receivers are scattered among the others, as in the
paper. ``region``: a quarter of the room, the farthest from the transmitter along the longer side, is held out; training
receivers there are left out and test receivers elsewhere are not asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.data import Truth
from benchmarks.methods import METHODS, Effort
from warprrf.rf.spectra.dataset import SpectrumDataset

TRUTHS = {
    "exact": "exact",
    "sionna": "Sionna RT",
    "conference": "conference room, Sionna RT",
    "paper-law": "paper's law",
}
"""Truths and their names: two engines in the lobby, another room (:mod:`.conference`), and the lobby by the paper's law
(:mod:`.paper_law`)."""
SPLITS = ("random", "region")
HELD_OUT = 0.25  # of the receivers' extent along the longer side


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
class Group:
    """Runs of a kind: every combination of these, seed after seed, the largest sets first.

    Attributes:
        methods: of :data:`METHODS`.
        counts: training receivers; methods that see no spectrum run once.
        truths, splits: which.
        seeds: orders of the training receivers.
    """

    methods: tuple[str, ...]
    counts: tuple[int, ...]
    truths: tuple[str, ...] = ("exact", "sionna")
    splits: tuple[str, ...] = ("random",)
    seeds: tuple[int, ...] = (0,)

    def runs(self) -> Iterable[Run]:
        """Every run."""
        for truth in self.truths:
            for split in self.splits:
                for seed in self.seeds:
                    for count in sorted(self.counts, reverse=True):
                        for method in self.methods:
                            untaught = METHODS[method].untaught
                            for variant in METHODS[method].variants:
                                yield Run(truth, split, 0 if untaught else count, seed, method, variant)


COUNTS = (10, 20, 50, 100, 200, 400, 700)
FEW = (10, 100, 700)
LOOKUPS = ("nearest", "idw", "mean", "constant")
FIELDS = ("bistatic", "rf3dgs+", "rf3dgs")
LAW_METHODS = ("rf3dgs+", "rf3dgs")
"""Methods that the paper's law is tried on: its finding is about these two."""
OPACITY_METHODS = ("rf3dgs+alpha", "rf3dgs-alpha")
NETWORKS = ("nerf2", "cgan")
GROUPS = (
    Group((*FIELDS, *LOOKUPS), COUNTS),
    Group(("zero", "transmitter", "bistatic-quick"), FEW),
    Group((*FIELDS, *LOOKUPS, "bistatic-quick"), (10, 100), truths=("conference",)),
    Group((*FIELDS, *LOOKUPS), (100,), splits=("region",)),
    Group(("sionna", "sionna-calibrated"), FEW),
    Group(("sionna-again",), FEW, truths=("sionna", "conference")),
    Group(LAW_METHODS, FEW, truths=("paper-law",)),
    Group((*FIELDS, *LOOKUPS), COUNTS, seeds=(1, 2)),
    Group(("rf3dgs+los",), (10, 50, 400)),
    Group(OPACITY_METHODS, FEW),
    Group(NETWORKS, FEW),
)
"""All runs, the main ones first."""
EFFORT = Effort(nerf2_iterations=4000, nerf2_rays=256, nerf2_samples=32, cgan_iterations=4000, cgan_batch=2)
"""Networks train for a quarter of an hour or more on two cores; as published they take hours on a graphics card. Their
learning curves say what more would bring."""


def plan(
    held: Mapping[tuple[str, str], int],
    *,
    methods: Sequence[str] = (),
    counts: Sequence[int] = (),
    seeds: Sequence[int] = (),
) -> list[Run]:
    """The runs, in the order in which they are worth having.

    Args:
        held: truths and splits that there are, and how many training receivers each can give; with all of them the order
            of a seed changes nothing but the batches, so only the first seed has runs there.
        methods: only these.
        counts: training receivers of every group instead of its own.
        seeds: only these.
    """
    runs: dict[Run, None] = {}
    for group in GROUPS:
        asked = replace(group, counts=tuple(counts)) if counts else group
        for run in asked.runs():
            most = held.get((run.truth, run.split), -1)
            same = run.seed != 0 and (run.count == most or METHODS[run.method].untaught)
            wanted = (not methods or run.method in methods) and (not seeds or run.seed in seeds)
            if run.count <= most and wanted and not same:
                runs.setdefault(run)
    return list(runs)


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
class Place:
    """Where the data of a truth and its room lie, in plain values, so that they travel to another process or machine.

    Attributes:
        file: spectra (NetCDF).
        made: digest of how they were made: receivers, grid, scene, engine and its settings.
        content: digest of the file.
        geometry: folder of the reconstruction.
        geometry_made: digest of how it was made.
        geometry_content: digest of the reconstruction.
        xml: true scene.
    """

    file: str
    made: str
    content: str
    geometry: str
    geometry_made: str
    geometry_content: str
    xml: str


@dataclass(frozen=True)
class Setting:
    """What all runs share.

    Attributes:
        places: of each truth.
        scratch: folder for half-done trainings and twins; workers on other machines need to see it for resuming only.
        every: each how-manieth test receiver of the random split counts.
        effort: how long iterative methods may work.
        lpips: files of LPIPS' weights; see :mod:`.lpips`.
        device: Warp device.
    """

    places: tuple[tuple[str, Place], ...]
    scratch: str
    every: int = 1
    effort: Effort = EFFORT
    lpips: tuple[str, ...] = ()
    device: str | None = None

    def place(self, truth: str) -> Place:
        """The place of a truth."""
        return dict(self.places)[truth]
