"""NeRF2 (Zhao, An, Pan, Yang, MobiCom 2023), single channel, in our own code.

A network maps a point, a viewing direction and the transmitter's position to what the point sends on (amplitude and
phase) and what it takes away (amplitude and phase). Along a pixel's ray with samples t_0 .. t_{n-1} the picture holds

    | sum_i s_i exp(j phi_i) prod_{k<i} exp(-a_k dt_k) exp(j sum_{k<i} p_k dt_k) c / t_{i+1} |

with all values in the ranges of the published code, and is compared with the training picture by mean square error.
The room's surfaces are unknown to it; it is told where receivers and transmitter are and how far the room reaches.

Published schedule: 30 000 iterations of 8192 rays with 64 samples each, Adam of 8e-4 with weight decay 5e-5, cosine to
1e-6. Positions are encoded in units of ``scale_m``, as the published option of the world's size does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.baselines.training import Trained, Training, draws, learn, pictures, seeded, torch_module
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import pixel_directions

ADAM_RATE, ADAM_DECAY, FINAL_RATE = 8e-4, 5e-5, 1e-6
SPREADING_M = (
    0.025  # the c above, lambda / (4 pi) of the published 915 MHz; amplitudes are learned on top of it
)
LAST_STEP_M = 1e10  # the published length of the last sample: what reaches it stays there
OPAQUE_LEAK = 1e-10
RAYS_AT_ONCE = 2048  # of a prediction: bounds its memory


@dataclass(frozen=True)
class NeRF2Options:
    """The network and its rays; defaults as published.

    Attributes:
        far_m: where rays end [m]: must span the room.
        scale_m: positions are encoded in this unit [m].
        rays: per step, drawn evenly from all pixels of all spectra.
        samples: points on a ray.
        depth, width, skip: of the trunk: layers, units, the layer that the encoded point is joined to again.
        octaves: of the encodings of point, direction and transmitter; the plain input is joined to each.
    """

    far_m: float
    scale_m: float = 1.0
    rays: int = 8192
    samples: int = 64
    depth: int = 8
    width: int = 256
    skip: int = 4
    octaves: int = 10


def fit_nerf2(data: SpectrumDataset, options: NeRF2Options, how: Training) -> Trained:
    """Train on spectra.

    Raises:
        ImportError: without torch.
        RuntimeError: if the loss stops being a number.
    """
    torch, where = torch_module(), how.place
    network = build(options, how.seed).to(where)
    optimiser = torch.optim.Adam(network.parameters(), lr=ADAM_RATE, weight_decay=ADAM_DECAY)

    def upload(values: Any) -> Any:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32)).to(where)

    target, toward = upload(pictures(data).reshape(-1)), upload(pixel_directions(data.shape).reshape(-1, 3))
    origin, source = upload(data.receivers), upload(data.transmitter)

    def step(i: int) -> float:
        chosen = torch.from_numpy(draws(how.seed, i).integers(len(target), size=options.rays)).to(where)
        view, pixel = chosen // len(toward), chosen % len(toward)
        cosine = 0.5 * (1.0 + np.cos(np.pi * i / how.iterations))
        for group in optimiser.param_groups:
            group["lr"] = FINAL_RATE + (ADAM_RATE - FINAL_RATE) * cosine
        shown = render(network, options, origin[view], toward[pixel], source)
        loss = torch.mean((shown - target[chosen]) ** 2)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        return float(loss.detach())

    def image(receiver: np.ndarray) -> np.ndarray:
        at = upload(receiver)
        with torch.inference_mode():
            parts = [
                render(network, options, at.expand_as(d), d, source)
                for d in torch.split(toward, RAYS_AT_ONCE)
            ]
            return np.asarray(torch.cat(parts).cpu().numpy()).reshape(data.shape)

    losses, seconds = learn(step, how)
    return Trained(network.eval(), image, float(data.floor), data.range_db, losses, seconds)


def build(options: NeRF2Options, seed: int) -> Any:
    """The network before its training, on the CPU."""
    nn = torch_module().nn
    encoded, width = 3 + 6 * options.octaves, options.width
    joined = [width + (encoded if i == options.skip + 1 else 0) for i in range(options.depth)]
    joined[0] = encoded
    with seeded(seed):
        return nn.ModuleDict(
            {
                "trunk": nn.ModuleList([nn.Linear(n, width) for n in joined]),
                "attenuation": nn.Linear(width, 2),
                "feature": nn.Linear(width, width),
                "signal": nn.Sequential(
                    nn.Linear(width + 2 * encoded, width),
                    nn.ReLU(),
                    nn.Linear(width, width // 2),
                    nn.ReLU(),
                    nn.Linear(width // 2, 2),
                ),
            }
        )


def encode(values: Any, octaves: int) -> Any:
    """``values`` (..., 3) with sines and cosines of 1, 2, 4, ... times them, shape ``(..., 3 + 6 octaves)``."""
    torch = torch_module()
    turns = values[..., None, :] * 2.0 ** torch.arange(octaves, device=values.device)[:, None]
    return torch.cat([values, torch.sin(turns).flatten(-2), torch.cos(turns).flatten(-2)], dim=-1)


def render(network: Any, options: NeRF2Options, origin: Any, toward: Any, source: Any) -> Any:
    """Brightness of rays, shape ``(B,)``, from ``origin`` along ``toward``, ``(B, 3)`` each, sent at ``source`` ``(3,)``."""
    torch = torch_module()
    functional = torch.nn.functional
    t = torch.linspace(0.0, options.far_m, options.samples, device=origin.device)
    points = origin[:, None] + toward[:, None] * t[:, None]
    encoded = encode(points / options.scale_m, options.octaves)
    x = encoded
    for i, layer in enumerate(network["trunk"]):
        if i == options.skip + 1:
            x = torch.cat([encoded, x], dim=-1)
        x = torch.relu(layer(x))
    attenuation = network["attenuation"](x)
    # Direction and transmitter do not change along a ray, so they are encoded once a ray.
    sent = encode(source.expand_as(toward) / options.scale_m, options.octaves)
    ray = torch.cat([encode(toward, options.octaves), sent], dim=-1)[:, None].expand(-1, options.samples, -1)
    signal = network["signal"](torch.cat([network["feature"](x), ray], dim=-1))

    lost = functional.leaky_relu(attenuation[..., 0]).abs()
    turned = 2.0 * np.pi * torch.sigmoid(attenuation[..., 1])
    amplitude = functional.leaky_relu(signal[..., 0]).abs()
    phase = 2.0 * np.pi * torch.sigmoid(signal[..., 1])
    step = torch.diff(t)
    # What the last sample takes away and turns reaches nothing behind it.
    passed = torch.cumprod(torch.exp(-lost[:, :-1] * step) + OPAQUE_LEAK, dim=1)
    passed = torch.cat([torch.ones_like(passed[:, :1]), passed], dim=1)
    angle = torch.cumsum(turned[:, :-1] * step, dim=1)
    angle = phase + torch.cat([torch.zeros_like(angle[:, :1]), angle], dim=1)
    distance = torch.cat([t[1:], t.new_tensor([LAST_STEP_M])])
    strength = amplitude * passed * (SPREADING_M / distance)
    real, imaginary = (strength * torch.cos(angle)).sum(dim=1), (strength * torch.sin(angle)).sum(dim=1)
    return torch.sqrt(real**2 + imaginary**2 + 1e-20)  # the root has no slope at zero
