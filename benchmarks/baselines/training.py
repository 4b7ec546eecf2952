"""What the networks of this package share: reproducible starts, resumable training, files without pickle.

Every step's random choices follow from the seed and the step's number alone, and the learning rate from the step, so
that a resumed training ends with the same bits as one that was never stopped (on one CPU, with one number of threads).
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Self

import numpy as np

from benchmarks.baselines.images import SpectrumImages, path_gain_of
from warprrf import tensor_files
from warprrf.checks import check_array
from warprrf.device import Progress, require
from warprrf.rf.spectra.spectrum import Spectrum
from warprrf.steps import digest

FORMAT = "warprrf baseline 1"
CHECKPOINT_FORMAT = "warprrf baseline checkpoint 2"
CHECKPOINT_S = 20.0  # a killed training loses at most this much, and saving costs little beside it


def torch_module() -> ModuleType:
    """torch, or an ImportError that names the extra."""
    return require("torch", extra="baselines")


def torch_device(device: Any = None) -> Any:
    """The torch device of ``device``: "cpu", "cuda:0"; CUDA where there is a GPU by default.

    Raises:
        ValueError: if torch has no such device.
    """
    torch = torch_module()
    if device is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        found = torch.device(str(device))
    except RuntimeError as error:
        raise ValueError(f"device: got {device!r}, expected cpu or cuda:0") from error
    if found.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device: got {device!r}, but torch sees no GPU; expected cpu")
    return found


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


def whole_number(name: str, value: Any, least: int = 1) -> int:
    """``value`` if it is a whole number of at least ``least``; else a ValueError that names the argument."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name}: got {value!r}, expected a whole number of at least {least}")
    return int(value)


@dataclass(frozen=True)
class Training:
    """How a network is trained.

    Attributes:
        iterations: steps.
        seed: of weights and of every step's random choices.
        device: "cpu" or "cuda:0"; CUDA where there is a GPU by default.
        checkpoint: file to save progress to every 20 s and when training is done, and to go on from.
        progress: called with the stage ``"fit"``.
    """

    iterations: int = 30_000
    seed: int = 0
    device: Any = None
    checkpoint: str | os.PathLike[str] | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        whole_number("iterations", self.iterations)


@dataclass(frozen=True)
class Learner:
    """What is trained: torch modules and Adam optimisers by name, which is all that changes, and the function that does
    iteration ``i`` and returns its loss."""

    networks: dict[str, Any]
    optimisers: dict[str, Any]
    step: Callable[[int], float]


def train(learner: Learner, how: Training, identity: str) -> tuple[list[float], float]:
    """Do every step, from where the checkpoint stands.

    Returns:
        The loss of each step, and the seconds that all of them took, those of earlier processes included.

    Args:
        identity: digest of everything that the result depends on.

    Raises:
        ValueError: for a checkpoint of another training.
        RuntimeError: if the loss stops being a number.
    """
    path = None if how.checkpoint is None else Path(how.checkpoint)
    losses: list[float] = []
    before_s = 0.0
    if path is not None and path.exists():
        tensors, header = tensor_files.read(path, CHECKPOINT_FORMAT)
        if header.get("identity") != identity:
            raise ValueError(
                f"checkpoint: {path} belongs to a training with other data or options; delete it or name another file"
            )
        _restore(learner.networks, learner.optimisers, tensors)
        losses, before_s = list(header["losses"]), header["seconds"]
    start = saved = time.monotonic()
    for i in range(len(losses), how.iterations):
        losses.append(learner.step(i))
        if not np.isfinite(losses[-1]):
            raise RuntimeError(
                f"loss: got {losses[-1]} at step {i}; lower the learning rate or check the spectra"
            )
        if how.progress is not None:
            how.progress("fit", i + 1, how.iterations)
        last = i + 1 == how.iterations
        if path is not None and (last or time.monotonic() - saved > CHECKPOINT_S):
            tensor_files.write(
                path,
                _state(learner.networks, learner.optimisers),
                {"identity": identity, "losses": losses, "seconds": before_s + time.monotonic() - start},
                CHECKPOINT_FORMAT,
            )
            saved = time.monotonic()
    return losses, before_s + time.monotonic() - start


def _array(tensor: Any) -> np.ndarray:
    return np.asarray(tensor.detach().cpu().numpy())


def weights_of(network: Any) -> dict[str, np.ndarray]:
    """A network's weights by name."""
    return {name: _array(tensor) for name, tensor in network.state_dict().items()}


def set_weights(network: Any, tensors: dict[str, np.ndarray]) -> None:
    """Give a network the weights of :func:`weights_of`; ValueError if they do not fit."""
    torch = torch_module()
    try:
        network.load_state_dict({name: torch.from_numpy(np.array(value)) for name, value in tensors.items()})
    except RuntimeError as error:
        raise ValueError(f"weights that do not fit the network: {error}") from error


def _state(networks: dict[str, Any], optimisers: dict[str, Any]) -> dict[str, np.ndarray]:
    found = {f"network/{n}/{k}": v for n, network in networks.items() for k, v in weights_of(network).items()}
    for name, optimiser in optimisers.items():
        for index, parameter in enumerate(p for group in optimiser.param_groups for p in group["params"]):
            for key, value in optimiser.state.get(parameter, {}).items():
                found[f"optimiser/{name}/{index}/{key}"] = _array(value)
    return found


def _restore(networks: dict[str, Any], optimisers: dict[str, Any], tensors: dict[str, np.ndarray]) -> None:
    torch = torch_module()
    for name, network in networks.items():
        head = f"network/{name}/"
        set_weights(network, {k.removeprefix(head): v for k, v in tensors.items() if k.startswith(head)})
    for name, optimiser in optimisers.items():
        for index, parameter in enumerate(p for group in optimiser.param_groups for p in group["params"]):
            head = f"optimiser/{name}/{index}/"
            kept = {k.removeprefix(head): v for k, v in tensors.items() if k.startswith(head)}
            for key, value in kept.items():
                tensor = torch.from_numpy(np.array(value))
                # Adam counts steps on the CPU, the moments lie beside the weights
                optimiser.state[parameter][key] = tensor if key == "step" else tensor.to(parameter.device)


@dataclass(frozen=True, eq=False)
class ImageModel(ABC):
    """A trained network that draws spectra; see :class:`NeRF2` and :class:`CGAN`.

    Attributes:
        options: of the network.
        network: torch module.
        directions: of the pixels that it was trained on, shape ``(H, W, 3)``.
        transmitter: position of the first training picture [m], shape ``(3,)``.
        floor, range_db: by which [0, 1] is a dB image; None if it was trained on other pictures.
        report: how training went: receivers, seconds, losses, bytes of the weights.
        Options: class of ``options``.
    """

    Options: ClassVar[type[Any]]
    options: Any
    network: Any = field(repr=False)
    directions: np.ndarray = field(repr=False)
    transmitter: np.ndarray
    floor: float | None
    range_db: tuple[float, float] | None
    report: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a spectrum."""
        return self.directions.shape[0], self.directions.shape[1]

    @property
    def model_bytes(self) -> int:
        """Size of the weights that a prediction needs."""
        return sum(value.nbytes for value in weights_of(self.network).values())

    @abstractmethod
    def image(self, rx: Any, transmitter: Any = None) -> np.ndarray:
        """The picture at ``rx`` (3,) [m], shape ``(H, W)``, about [0, 1]."""

    def spectrum(self, rx: Any, transmitter: Any = None) -> Spectrum:
        """The spatial spectrum at ``rx`` (3,) [m], without delays or angles of departure.

        Raises:
            ValueError: for a position that is not three finite numbers, or a network trained on pictures that are no
                dB images.
        """
        if self.floor is None or self.range_db is None:
            raise ValueError("spectrum: this network was trained on pictures without a dB range; use image")
        unit = self.image(rx, transmitter)
        return Spectrum(
            path_gain=path_gain_of(unit, self.floor, self.range_db), floor=self.floor, range_db=self.range_db
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything that a prediction needs to one safetensors file."""
        tensors = {f"weights/{name}": value for name, value in weights_of(self.network).items()}
        tensors |= {"directions": self.directions, "transmitter": self.transmitter}
        header = {
            "model": type(self).__name__,
            "options": vars(self.options),
            "floor": self.floor,
            "range_db": self.range_db,
            "report": self.report,
        }
        tensor_files.write(path, tensors, header, FORMAT)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: Any = None) -> Any:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is corrupt, or another model's.
        """
        tensors, header = tensor_files.read(path, FORMAT)
        if header.get("model") != cls.__name__:
            raise ValueError(
                f"{os.fspath(path)}: holds a {header.get('model')!r}, expected a {cls.__name__!r}"
            )
        try:
            options = cls.Options(**header["options"])
            directions, transmitter = tensors["directions"], tensors["transmitter"]
            network = cls._build(options, (directions.shape[0], directions.shape[1]), 0)
            head = "weights/"
            set_weights(network, {k.removeprefix(head): v for k, v in tensors.items() if k.startswith(head)})
            limits = header["range_db"]
            return cls(
                options=options,
                network=network.to(torch_device(device)).eval(),
                directions=directions,
                transmitter=transmitter,
                floor=header["floor"],
                range_db=None if limits is None else (float(limits[0]), float(limits[1])),
                report=header["report"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{os.fspath(path)}: corrupt or no baseline of this version: {error}") from error

    @classmethod
    @abstractmethod
    def _build(cls, options: Any, shape: tuple[int, int], seed: int) -> Any:
        """A fresh network on the CPU."""

    @classmethod
    def _trained(
        cls,
        known: SpectrumImages,
        options: Any,
        learner: Learner,
        how: Training,
        about: dict[str, Any],
    ) -> Self:
        """The model whose network is the first of ``learner``'s, trained by :func:`train`.

        ``about`` is what the result depends on besides, and part of the report.
        """
        losses, seconds = train(
            learner, how, digest(cls.__name__, options, how.iterations, how.seed, about, known)
        )
        return cls(
            options=options,
            network=next(iter(learner.networks.values())).eval(),
            directions=known.directions,
            transmitter=known.transmitters[0],
            floor=known.floor,
            range_db=known.range_db,
            report={
                "receivers": len(known),
                "fit_time_s": seconds,
                "losses": losses,
                "seed": int(how.seed),
                "iterations": how.iterations,
                **about,
            },
        )

    @property
    def _torch_device(self) -> Any:
        return next(self.network.parameters()).device

    def _positions(self, rx: Any, transmitter: Any) -> tuple[np.ndarray, np.ndarray]:
        source = self.transmitter if transmitter is None else check_array("transmitter", transmitter, (3,))
        return check_array("rx", rx, (3,)), source
