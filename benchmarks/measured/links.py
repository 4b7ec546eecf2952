"""Received power of links between fixed ends and cells of a floor: means, their noise, and what is held out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import warprrf as wr
from benchmarks.fits import rms
from benchmarks.runner import Job
from warprrf.steps import Steps

DARK_DB = -300.0  # of what no path reaches


@dataclass(frozen=True)
class Links:
    """Means over the readings of a link, L of them.

    Attributes:
        senders: position of the fixed end [m], shape ``(L, 3)``.
        receivers: mean position of the readings [m], shape ``(L, 3)``.
        level_db: mean of their power [dB], shape ``(L,)``.
        anchor: number of the fixed end, shape ``(L,)``.
        cell: number of the cell, shape ``(L,)``.
        room: name of the room of the cell, or of its block of a walk, shape ``(L,)``.
        walls: how many walls of each kind the straight way crosses, shape ``(L, kinds)``.
    """

    senders: np.ndarray
    receivers: np.ndarray
    level_db: np.ndarray
    anchor: np.ndarray
    cell: np.ndarray
    room: np.ndarray
    walls: np.ndarray

    def __len__(self) -> int:
        return len(self.level_db)

    @property
    def behind(self) -> np.ndarray:
        """Whether a wall stands between, shape ``(L,)``, bool."""
        return np.asarray(self.walls.sum(axis=1) > 0)

    @property
    def distance_m(self) -> np.ndarray:
        """Between the ends [m], shape ``(L,)``."""
        return np.linalg.norm(self.senders - self.receivers, axis=1)

    def subset(self, chosen: np.ndarray) -> Links:
        """The links named by a mask or by their numbers."""
        return replace(self, **{name: values[chosen] for name, values in vars(self).items()})

    def held_out(self, kinds: Sequence[str]) -> Iterator[tuple[str, str, np.ndarray]]:
        """What is held out together: its kind, "anchor", "pair", "room", "block" or "height", which, and a mask of its links."""
        own = {"anchor": self.anchor, "pair": self.anchor, "room": self.room, "block": self.room}
        own["height"] = self.receivers[:, 2]
        for kind in kinds:
            for which in combinations(np.unique(own[kind]), 2 if kind == "pair" else 1):
                yield kind, " and ".join(map(str, which)), np.isin(own[kind], which)


@dataclass(frozen=True)
class Place:
    """A measured place, as the command takes it.

    Attributes:
        about: what it is, in a sentence.
        files: what it was read from: files and folders.
        links: what was measured.
        frequency_hz: at which paths are traced [Hz].
        floor_db: the least power that is told from nothing [dB].
        samples: independent samples of fading that a mean has at least.
        kinds: what is held out, one at a time: see :meth:`Links.held_out`.
        traced: rows of sharp paths: the scene as it is known and guessed, and options of their tracing.
        fields: rows of fields: the scene, and the effects.
        noise: of the measurement, as figures.
        said: the same in words.
        more: figures of this place alone.
        fitted: makes more of them by fits of its own, and says them in words.
    """

    about: str
    files: tuple[Path, ...]
    links: Links
    frequency_hz: float
    floor_db: float
    samples: int
    kinds: tuple[str, ...]
    traced: Mapping[str, tuple[wr.Scene, Mapping[str, Any]]]
    fields: Mapping[str, tuple[wr.Scene, wr.Effects]]
    noise: Mapping[str, Any]
    said: str
    more: Mapping[str, Any] = field(default_factory=dict)
    fitted: Callable[[Job, Steps], tuple[Mapping[str, Any], str]] | None = None


def db(power: ArrayLike) -> np.ndarray:
    """Power in dB, at least :data:`DARK_DB`."""
    return np.asarray(10.0 * np.log10(np.maximum(power, 10.0 ** (DARK_DB / 10.0))))


def mean_db(power_db: np.ndarray) -> float:
    """Mean of power, in dB as it comes and goes."""
    return float(10.0 * np.log10(np.mean(10.0 ** (power_db / 10.0))))


def noise_db(readings: list[np.ndarray], seed: int) -> dict[str, float]:
    """Noise of means [dB] from halves: half the rms difference of the means of the halves.

    Args:
        readings: of each link, in the order in which they were read [dB].
        seed: of halves by chance.

    Returns:
        ``halves_by_time``: the first half against the second, so that what drifts counts as noise (the antenna's heading, people,
        where in its cell a receiver is); ``halves_by_chance``: without that; ``single_reading``: spread of one.
    """
    rng = np.random.default_rng(seed)

    def split(orders: list[np.ndarray]) -> float:
        halves = [(one[: len(one) // 2], one[len(one) // 2 :]) for one in orders]
        return 0.5 * rms(np.array([mean_db(a) - mean_db(b) for a, b in halves]))

    return {
        "halves_by_time": split(readings),
        "halves_by_chance": split([rng.permutation(one) for one in readings]),
        "single_reading": rms(np.array([np.std(one, ddof=1) for one in readings])),
    }


def crossings(scene: wr.Scene, start: np.ndarray, end: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """How many surfaces of each kind lie between ``start`` and ``end`` (L, 3), shape ``(L, kinds)``.

    ``kind`` is that of each face, shape ``(F,)``.
    """
    a, b, c = np.moveaxis(scene.mesh.triangles, 1, 0)
    normal, found = np.cross(b - a, c - a), np.zeros((len(start), kind.max() + 1), int)
    for link, (p, q) in enumerate(zip(start, end, strict=True)):
        along = normal @ (q - p)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.einsum("fi,fi->f", normal, a - p) / along
        at = p + np.where(np.isfinite(t), t, 0.0)[:, None] * (q - p)
        sides = [np.einsum("fi,fi->f", np.cross(v - u, at - u), normal) for u, v in ((a, b), (b, c), (c, a))]
        met = (t > 0) & (t < 1) & (sides[0] >= 0) & (sides[1] > 0) & (sides[2] > 0)
        found[link] = np.bincount(kind[met], minlength=found.shape[1])
    return found
