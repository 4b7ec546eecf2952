"""A conditional GAN from receiver position to spectrum. No public code of the published baseline exists: this is ours.

As pix2pix (Isola, Zhu, Zhou, Efros, CVPR 2017), with a position in the place of its input picture: a generator draws
the spectrum from the receiver's position and noise; a discriminator of patches sees spectrum and position and tells
true from drawn; the generator's loss is adversarial + 100 L1. Azimuth is periodic, so convolutions wrap round there.
Predictions are drawn at noise zero, the most likely one, and so are repeatable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.baselines.images import SpectrumImages
from benchmarks.baselines.training import (
    ImageModel,
    Learner,
    Training,
    draws,
    seeded,
    torch_device,
    torch_module,
    whole_number,
)

if TYPE_CHECKING:
    from warprrf.rf.spectra.dataset import SpectrumDataset

ADAM_RATE, ADAM_DECAYS = 2e-4, (0.5, 0.999)  # as pix2pix
L1_WEIGHT = 100.0
DOUBLINGS = 3  # the generator draws at an eighth of the size first


@dataclass(frozen=True)
class CGANOptions:
    """The networks.

    Attributes:
        centre_m, extent_m: positions are told as (position - centre) / extent, shape ``(3,)`` each; by default those
            of the training receivers' box.
        channels: of the generator's finest layer and the discriminator's coarsest.
        noise: length of the noise vector.
        octaves: sines and cosines of 1, 2, 4, ... half turns over the extent that tell the position besides.
    """

    centre_m: tuple[float, float, float]
    extent_m: tuple[float, float, float]
    channels: int = 32
    noise: int = 16
    octaves: int = 4

    def __post_init__(self) -> None:
        for name in ("centre_m", "extent_m"):
            value = tuple(float(v) for v in getattr(self, name))
            if len(value) != 3 or not np.isfinite(value).all() or (name == "extent_m" and min(value) <= 0):
                raise ValueError(f"{name}: got {value}, expected three finite lengths, an extent above zero")
            object.__setattr__(self, name, value)
        for name, least in (("channels", 8), ("noise", 1), ("octaves", 0)):
            whole_number(name, getattr(self, name), least)
        if self.channels % 8:
            raise ValueError(f"channels: got {self.channels}, expected a multiple of 8")

    @classmethod
    def around(cls, receivers: np.ndarray, **changed: Any) -> CGANOptions:
        """Options for positions such as ``receivers`` (R, 3)."""
        low, high = np.min(receivers, axis=0), np.max(receivers, axis=0)
        extent = np.maximum(0.5 * (high - low), 0.5)  # receivers at one height would have none
        return cls(tuple(0.5 * (low + high)), tuple(extent), **changed)


class CGAN(ImageModel):
    """A trained conditional GAN; build it with :meth:`fit` or :meth:`load`. Its ``network`` is the generator."""

    Options = CGANOptions

    @classmethod
    def fit(
        cls,
        data: SpectrumDataset | SpectrumImages,
        options: CGANOptions | None = None,
        how: Training | None = None,
        *,
        batch: int = 8,
    ) -> CGAN:
        """Train on spectra.

        Args:
            data: training set: spectra, or pictures of other origin.
            options: of the networks; by default around the training receivers.
            how: of the training; by default 30 000 iterations.
            batch: spectra per step.

        Raises:
            ImportError: without torch.
            ValueError: for bad options, or a checkpoint of another training.
        """
        torch = torch_module()
        known = SpectrumImages.of(data)
        how, batch = how or Training(), whole_number("batch", batch)
        chosen = options or CGANOptions.around(known.receivers)
        seed, where = int(how.seed), torch_device(how.device)
        generator = cls._build(chosen, known.shape, seed).to(where)
        with seeded(seed + 1):
            critic = _discriminator(torch, chosen).to(where)
        adams = {
            name: torch.optim.Adam(net.parameters(), lr=ADAM_RATE, betas=ADAM_DECAYS)
            for name, net in (("generator", generator), ("critic", critic))
        }
        images = torch.from_numpy(known.images)[:, None].to(where)
        told = torch.from_numpy(tell(chosen, known.receivers)).to(where)
        judge = torch.nn.functional.binary_cross_entropy_with_logits

        def verdict(pictures: Any, positions: Any, true: bool) -> Any:
            logits = _judge(critic, pictures, positions)
            return judge(logits, torch.full_like(logits, float(true)))

        def step(i: int) -> float:
            rng = draws(seed, i)
            pick = torch.from_numpy(rng.integers(len(images), size=batch)).to(where)
            noise = torch.from_numpy(rng.standard_normal((batch, chosen.noise), dtype=np.float32)).to(where)
            shown, position = images[pick], told[pick]
            drawn = _draw(generator, position, noise, known.shape)
            adams["critic"].zero_grad(set_to_none=True)
            (0.5 * (verdict(shown, position, True) + verdict(drawn.detach(), position, False))).backward()
            adams["critic"].step()
            adams["generator"].zero_grad(set_to_none=True)
            distance = torch.mean(torch.abs(drawn - shown))
            (verdict(drawn, position, True) + L1_WEIGHT * distance).backward()
            adams["generator"].step()
            return float(distance.detach())

        learner = Learner({"generator": generator, "critic": critic}, adams, step)
        about = {"batch": batch, "loss": "L1 of the generator"}
        return cls._trained(known, chosen, learner, how, about)

    def image(self, rx: Any, transmitter: Any = None) -> np.ndarray:
        """The picture at ``rx`` (3,) [m], shape ``(H, W)`` float32 in [0, 1]; it holds for the training transmitter."""
        torch = torch_module()
        receiver, source = self._positions(rx, transmitter)
        if not np.array_equal(source, self.transmitter):
            raise ValueError(
                f"transmitter: got {source.tolist()}, but this network was trained for {self.transmitter.tolist()}"
            )
        told = torch.from_numpy(tell(self.options, receiver[None])).to(self._torch_device)
        noise = told.new_zeros((1, self.options.noise))
        with torch.inference_mode():
            return np.asarray(_draw(self.network, told, noise, self.shape)[0, 0].cpu().numpy())

    @classmethod
    def _build(cls, options: CGANOptions, shape: tuple[int, int], seed: int) -> Any:
        nn = torch_module().nn
        rows, columns = (math.ceil(n / 2**DOUBLINGS) for n in shape)
        widths = [options.channels * 2**k for k in range(DOUBLINGS, -1, -1)]
        with seeded(seed):
            first = nn.Sequential(
                nn.Linear(_told(options) + options.noise, 4 * options.channels),
                nn.LeakyReLU(0.2),
                nn.Linear(4 * options.channels, widths[0] * rows * columns),
                nn.LeakyReLU(0.2),
                nn.Unflatten(1, (widths[0], rows, columns)),
            )
            finer = []
            for coarse, fine in zip(widths, widths[1:], strict=False):
                finer += [
                    nn.Upsample(scale_factor=2, mode="nearest"),
                    nn.CircularPad2d((1, 1, 0, 0)),
                    nn.Conv2d(coarse, fine, 3, padding=(1, 0)),
                    nn.GroupNorm(8, fine),
                    nn.LeakyReLU(0.2),
                ]
            last = [nn.CircularPad2d((1, 1, 0, 0)), nn.Conv2d(widths[-1], 1, 3, padding=(1, 0)), nn.Sigmoid()]
            return nn.Sequential(first, *finer, *last)


def tell(options: CGANOptions, positions: np.ndarray) -> np.ndarray:
    """What the networks are told of positions (R, 3), shape ``(R, 3 + 6 octaves)`` float32."""
    unit = (np.asarray(positions, np.float64) - options.centre_m) / options.extent_m
    turns = [np.pi * 2.0**k * unit for k in range(options.octaves)]
    waves = [wave(t) for t in turns for wave in (np.sin, np.cos)]
    return np.concatenate([unit, *waves], axis=1).astype(np.float32)


def _told(options: CGANOptions) -> int:
    return 3 + 6 * options.octaves


def _draw(generator: Any, told: Any, noise: Any, shape: tuple[int, int]) -> Any:
    """Pictures ``(B, 1, H, W)``: the generator's, cut to the size that eighths may exceed."""
    drawn = generator(torch_module().cat([told, noise], dim=1))
    return drawn[:, :, : shape[0], : shape[1]]


def _discriminator(torch: Any, options: CGANOptions) -> Any:
    nn = torch.nn
    c = options.channels
    return nn.Sequential(
        nn.Conv2d(1 + _told(options), c, 4, stride=2, padding=1),
        nn.LeakyReLU(0.2),
        nn.Conv2d(c, 2 * c, 4, stride=2, padding=1),
        nn.GroupNorm(8, 2 * c),
        nn.LeakyReLU(0.2),
        nn.Conv2d(2 * c, 4 * c, 3, padding=1),
        nn.GroupNorm(8, 4 * c),
        nn.LeakyReLU(0.2),
        nn.Conv2d(4 * c, 1, 3, padding=1),
    )


def _judge(critic: Any, pictures: Any, told: Any) -> Any:
    """Logits of patches ``(B, 1, h, w)``: true or drawn, given the position."""
    planes = told[:, :, None, None].expand(-1, -1, *pictures.shape[2:])
    return critic(torch_module().cat([pictures, planes], dim=1))
