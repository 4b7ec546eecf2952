"""What the networks of this package share: reproducible starts, the loop over steps, pictures and back to path gain.

Every step's random choices follow from the seed and the step's number alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from warprrf.checks import check_array
from warprrf.device import Progress, require
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.metrics import unit_image
from warprrf.rf.spectra.spectrum import Spectrum

UNIT_CEILING = 1.5
"""A prediction may exceed the brightest training pixel by half the range; more is cut, so that float32 holds it."""


def torch_module() -> ModuleType:
    """torch, or an ImportError that names the extra."""
    return require("torch", extra="baselines")


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Torch's global generator set to ``seed`` on the CPU, and given back as it was."""
    torch = torch_module()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def draws(seed: int, step: int) -> np.random.Generator:
    """The generator of one step's random choices."""
    return np.random.default_rng([seed, 1, step])


@dataclass(frozen=True)
class Training:
    """How a network is trained.

    Attributes:
        iterations: steps.
        seed: of weights and of every step's random choices.
        device: "cpu" or "cuda:0"; CUDA where there is a GPU by default.
        progress: called with the stage ``"fit"``.
    """

    iterations: int = 30_000
    seed: int = 0
    device: Any = None
    progress: Progress | None = None

    @property
    def place(self) -> Any:
        """The torch device."""
        torch = torch_module()
        return torch.device(self.device or ("cuda" if torch.cuda.is_available() else "cpu"))


def learn(step: Callable[[int], float], how: Training) -> tuple[list[float], float]:
    """Do every step ``i``, which returns its loss: all losses, and the seconds that they took.

    Raises:
        RuntimeError: if the loss stops being a number.
    """
    losses: list[float] = []
    start = time.monotonic()
    for i in range(how.iterations):
        losses.append(step(i))
        if not np.isfinite(losses[-1]):
            raise RuntimeError(
                f"loss: got {losses[-1]} at step {i}; lower the learning rate or check the spectra"
            )
        if how.progress is not None:
            how.progress("fit", i + 1, how.iterations)
    return losses, time.monotonic() - start


@dataclass(frozen=True)
class Trained:
    """A network that draws spectra.

    Attributes:
        network: torch module.
        image: from a receiver position (3,) [m] to a picture ``(H, W)``, about [0, 1].
        floor, range_db: by which [0, 1] is a dB image.
        losses: of each step.
        seconds: time of all steps.
    """

    network: Any = field(repr=False)
    image: Callable[[np.ndarray], np.ndarray] = field(repr=False)
    floor: float
    range_db: tuple[float, float]
    losses: list[float] = field(repr=False)
    seconds: float

    def spectrum(self, receiver: Any) -> Spectrum:
        """The spatial spectrum at ``receiver`` (3,) [m], without delays or angles of departure."""
        unit = self.image(check_array("receiver", receiver, (3,)))
        return Spectrum(
            path_gain=path_gain_of(unit, self.floor, self.range_db), floor=self.floor, range_db=self.range_db
        )

    @property
    def size_bytes(self) -> int:
        """Size of the weights that a prediction needs."""
        return sum(tensor.numel() * tensor.element_size() for tensor in self.network.state_dict().values())


def pictures(data: SpectrumDataset) -> np.ndarray:
    """The data set's dB images mapped to [0, 1] by its floor and range, shape ``(R, H, W)`` float32."""
    return np.asarray(unit_image(data.path_gain, float(data.floor), data.range_db), np.float32)


def path_gain_of(unit: np.ndarray, floor: float, range_db: tuple[float, float]) -> np.ndarray:
    """Path gain of a picture, the inverse of :func:`pictures`: float32, never negative."""
    low, high = range_db
    level = low + np.clip(np.asarray(unit, np.float64), 0.0, UNIT_CEILING) * (high - low)
    return np.maximum(10.0 ** (level / 10.0) - floor, 0.0).astype(np.float32)
