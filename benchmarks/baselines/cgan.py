"""A conditional GAN from receiver position to spectrum. No public code of the published baseline exists: this is ours.

As pix2pix (Isola, Zhu, Zhou, Efros, CVPR 2017), with a position in the place of its input picture: a generator draws
the spectrum from the receiver's position and noise; a discriminator of patches sees spectrum and position and tells
true from drawn; the generator's loss is adversarial + 100 L1. Azimuth is periodic, so convolutions wrap round there.
Predictions are drawn at noise zero, the most likely one, and so are repeatable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.baselines.training import Trained, Training, draws, learn, pictures, seeded, torch_module
from warprrf.rf.spectra.dataset import SpectrumDataset

ADAM_RATE, ADAM_DECAYS = 2e-4, (0.5, 0.999)  # as pix2pix
L1_WEIGHT = 100.0
DOUBLINGS = 3  # the generator draws at an eighth of the size first


@dataclass(frozen=True)
class CGANOptions:
    """The networks.

    Attributes:
        batch: spectra per step.
        channels: of the generator's finest layer and the discriminator's coarsest, a multiple of 8.
        noise: length of the noise vector.
        octaves: sines and cosines of 1, 2, 4, ... half turns over the room that tell the position besides.
    """

    batch: int = 8
    channels: int = 32
    noise: int = 16
    octaves: int = 4

    @property
    def inputs(self) -> int:
        """Numbers that tell a position."""
        return 3 + 6 * self.octaves


def fit_cgan(data: SpectrumDataset, options: CGANOptions, how: Training) -> Trained:
    """Train on spectra; the network of what is returned is the generator.

    Raises:
        ImportError: without torch.
        RuntimeError: if the loss stops being a number.
    """
    torch, where = torch_module(), how.place
    low, high = data.receivers.min(axis=0), data.receivers.max(axis=0)
    extent = np.maximum(0.5 * (high - low), 0.5)  # receivers at one height would have none

    def tell(positions: np.ndarray) -> Any:
        unit = (positions - 0.5 * (low + high)) / extent
        turns = [np.pi * 2.0**k * unit for k in range(options.octaves)]
        waves = [wave(t) for t in turns for wave in (np.sin, np.cos)]
        return torch.from_numpy(np.concatenate([unit, *waves], axis=1).astype(np.float32)).to(where)

    generator = _generator(torch.nn, options, data.shape, how.seed).to(where)
    with seeded(how.seed + 1):
        critic = _discriminator(torch.nn, options).to(where)
    for_generator, for_critic = (
        torch.optim.Adam(net.parameters(), lr=ADAM_RATE, betas=ADAM_DECAYS) for net in (generator, critic)
    )
    images, inputs = torch.from_numpy(pictures(data))[:, None].to(where), tell(data.receivers)
    judge = torch.nn.functional.binary_cross_entropy_with_logits

    def draw(position: Any, noise: Any) -> Any:
        drawn = generator(torch.cat([position, noise], dim=1))
        return drawn[:, :, : data.shape[0], : data.shape[1]]  # eighths may exceed the size

    def verdict(shown: Any, position: Any, true: bool) -> Any:
        planes = position[:, :, None, None].expand(-1, -1, *shown.shape[2:])
        logits = critic(torch.cat([shown, planes], dim=1))
        return judge(logits, torch.full_like(logits, float(true)))

    def step(i: int) -> float:
        rng = draws(how.seed, i)
        pick = torch.from_numpy(rng.integers(len(images), size=options.batch)).to(where)
        noise = torch.from_numpy(rng.standard_normal((options.batch, options.noise), dtype=np.float32)).to(
            where
        )
        shown, position = images[pick], inputs[pick]
        drawn = draw(position, noise)
        for_critic.zero_grad(set_to_none=True)
        (0.5 * (verdict(shown, position, True) + verdict(drawn.detach(), position, False))).backward()
        for_critic.step()
        for_generator.zero_grad(set_to_none=True)
        distance = torch.mean(torch.abs(drawn - shown))
        (verdict(drawn, position, True) + L1_WEIGHT * distance).backward()
        for_generator.step()
        return float(distance.detach())

    def image(receiver: np.ndarray) -> np.ndarray:
        position = tell(receiver[None])
        with torch.inference_mode():
            return np.asarray(draw(position, position.new_zeros((1, options.noise)))[0, 0].cpu().numpy())

    losses, seconds = learn(step, how)
    return Trained(generator.eval(), image, float(data.floor), data.range_db, losses, seconds)


def _generator(nn: Any, options: CGANOptions, shape: tuple[int, int], seed: int) -> Any:
    rows, columns = (math.ceil(n / 2**DOUBLINGS) for n in shape)
    widths = [options.channels * 2**k for k in range(DOUBLINGS, -1, -1)]
    with seeded(seed):
        first = nn.Sequential(
            nn.Linear(options.inputs + options.noise, 4 * options.channels),
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


def _discriminator(nn: Any, options: CGANOptions) -> Any:
    c = options.channels
    return nn.Sequential(
        nn.Conv2d(1 + options.inputs, c, 4, stride=2, padding=1),
        nn.LeakyReLU(0.2),
        nn.Conv2d(c, 2 * c, 4, stride=2, padding=1),
        nn.GroupNorm(8, 2 * c),
        nn.LeakyReLU(0.2),
        nn.Conv2d(2 * c, 4 * c, 3, padding=1),
        nn.GroupNorm(8, 4 * c),
        nn.LeakyReLU(0.2),
        nn.Conv2d(4 * c, 1, 3, padding=1),
    )
