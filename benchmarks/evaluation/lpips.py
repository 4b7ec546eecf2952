"""LPIPS (Zhang, Isola, Efros, Shechtman and Wang, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric",
CVPR 2018) of dB images, where its weights are on the machine; nothing is downloaded.

Two files: AlexNet's convolutions, as torchvision publishes them, and the metric's five 1 x 1 layers (v0.1), as the
package ``lpips`` carries them.
"""

from __future__ import annotations

import importlib.util
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baselines.training import torch_module

BACKBONE = "alexnet-owt-7be5be79.pth"  # in torch's cache
LAYERS = "weights/v0.1/alex.pth"  # in the package lpips
CONVOLUTIONS = ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1))  # index in AlexNet, stride, padding
POOLED = (3, 6)  # convolutions that a maximum over 3 x 3 pixels at a stride of 2 precedes
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of the three colours
LEAST = 1e-10  # added to a feature's length
SIDE = 31  # pixels that leave one to the last convolution


class Lpips:
    """The metric.

    Args:
        backbone: AlexNet's weights (a state dict of torch).
        layers: weights of the metric.

    Raises:
        ValueError: if a file does not hold them.
    """

    def __init__(self, backbone: Path, layers: Path) -> None:
        self._torch = torch_module()
        convolutions, linear = self._read(backbone), self._read(layers)
        try:
            self._convolutions = [
                (convolutions[f"features.{k}.weight"], convolutions[f"features.{k}.bias"])
                for k, *_ in CONVOLUTIONS
            ]
            self._linear = [linear[f"lin{k}.model.1.weight"] for k in range(len(CONVOLUTIONS))]
        except (KeyError, TypeError) as error:
            raise ValueError(
                f"lpips: got {backbone} and {layers}, expected weights of AlexNet and of LPIPS v0.1; {error} is missing"
            ) from error

    @classmethod
    def found(cls, files: Sequence[str] = (), shape: Sequence[int] = (SIDE, SIDE)) -> Lpips | str:
        """The metric of images of ``shape`` from ``files`` (AlexNet's, the metric's), or by default from torch's cache and
        the package ``lpips``; why there is none otherwise.

        Raises:
            FileNotFoundError, ValueError: if ``files`` are named and do not serve, or not for such images.
        """
        if min(shape) < SIDE:
            small = (
                f"got images of {' x '.join(map(str, shape))} pixels, AlexNet takes at least {SIDE} x {SIDE}"
            )
            if files:
                raise ValueError(f"lpips: {small}")
            return small
        if files:
            if len(files) != 2:
                raise ValueError(f"lpips: got {len(files)} files, expected two: AlexNet's weights and LPIPS'")
            for file in map(Path, files):
                if not file.is_file():
                    raise FileNotFoundError(f"lpips: there is no file {file}")
            return cls(Path(files[0]), Path(files[1]))
        if importlib.util.find_spec("torch") is None:
            return "torch is not installed"
        package = importlib.util.find_spec("lpips")
        places = (
            [Path(folder) / LAYERS for folder in (package.submodule_search_locations or ())]
            if package
            else []
        )
        backbone = Path(torch_module().hub.get_dir()) / "checkpoints" / BACKBONE
        if not backbone.is_file() or not places or not places[0].is_file():
            return "its weights are neither named nor in torch's cache, and nothing is downloaded"
        return cls(backbone, places[0])

    def _read(self, file: Path) -> Any:
        try:
            return self._torch.load(file, map_location="cpu", weights_only=True)
        except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
            raise ValueError(f"lpips: {file} is no file of weights: {error}") from error

    def __call__(self, one: np.ndarray, other: np.ndarray) -> float:
        """The distance of two images, shape ``(H, W)`` each, 0 to 1, shown in grey."""
        with self._torch.no_grad():
            pairs = zip(self._features(one), self._features(other), self._linear, strict=True)
            return float(sum((((a - b) ** 2) * w).sum(dim=1).mean() for a, b, w in pairs))

    def _features(self, image: np.ndarray) -> list[Any]:
        torch = self._torch
        colours = torch.from_numpy(np.repeat(np.asarray(image, np.float32)[None, None], 3, axis=1))
        shift, scale = (torch.tensor(values).reshape(1, 3, 1, 1) for values in (SHIFT, SCALE))
        now, found = (2.0 * colours - 1.0 - shift) / scale, []
        for (k, stride, padding), (weight, bias) in zip(CONVOLUTIONS, self._convolutions, strict=True):
            if k in POOLED:
                now = torch.nn.functional.max_pool2d(now, 3, 2)
            now = torch.relu(torch.nn.functional.conv2d(now, weight, bias, stride, padding))
            found.append(now / (now.square().sum(dim=1, keepdim=True).sqrt() + LEAST))
        return found
