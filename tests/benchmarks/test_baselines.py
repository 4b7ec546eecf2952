"""Learned baselines on a handful of tiny spectra: they learn, and repeat themselves bit by bit."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from benchmarks.baselines import nerf2
from benchmarks.baselines.cgan import CGANOptions, fit_cgan
from benchmarks.baselines.training import Training, learn
from warprrf.rf.spectra import lookups, metrics
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import pixel_directions

SHAPE = (10, 20)
TRANSMITTER = np.array([4.0, 1.0, 2.0])
SMALL = nerf2.NeRF2Options(far_m=8.0, rays=128, samples=8, depth=3, width=32, skip=1, octaves=3, scale_m=2.5)
FITS = {"nerf2": (nerf2.fit_nerf2, SMALL, 250), "cgan": (fit_cgan, CGANOptions(batch=4, channels=8), 60)}


def spectra(count=12):
    """A glow around the transmitter's direction, weaker with distance, above a gradient from floor to ceiling."""
    rng = np.random.default_rng(0)
    receivers = rng.uniform([0.5, 0.5, 1.0], [3.5, 3.5, 2.0], (count, 3))
    directions = pixel_directions(SHAPE)
    images = []
    for receiver in receivers:
        toward = TRANSMITTER - receiver
        distance = np.linalg.norm(toward)
        glow = np.exp(6.0 * (directions @ (toward / distance) - 1.0)) / distance**2
        images.append(1e-9 * (glow + 0.002 * (1.2 + directions[..., 2])))
    return SpectrumDataset.from_spectra(
        receivers=receivers, transmitter=TRANSMITTER, frequency_hz=300e9, path_gain=np.array(images, np.float32),
        line_of_sight=np.ones(count, bool), beam_sigma_rad=0.1, floor=1e-13,
        role=["train"] * (count - 3) + ["test"] * 3,
    )  # fmt: skip


def fit(name, data, steps=None, seed=0):
    how, options, enough = FITS[name]
    return how(data, options, Training(steps or enough, seed, "cpu"))


@pytest.mark.parametrize("name", FITS)
def test_loss_falls_and_the_constant_is_beaten_on_held_out_receivers(name):
    train, test = spectra().split(9)
    found = fit(name, train)
    assert np.mean(found.losses[-10:]) < 0.5 * np.mean(found.losses[:10]) and found.size_bytes > 1000
    constant = metrics.evaluate(test, lookups.constant(train))
    scored = metrics.evaluate(test, found.spectrum)
    assert scored["psnr_db"] > constant["psnr_db"] + 1.0 and scored["rmse_db"] < constant["rmse_db"]
    with pytest.raises(ValueError, match="receiver: "):
        found.spectrum([np.nan, 0.0, 0.0])


@pytest.mark.parametrize("name", FITS)
def test_a_seed_repeats_bit_by_bit_and_another_one_differs(name):
    train, test = spectra().split(4)
    first, again, other = (fit(name, train, 6, seed) for seed in (3, 3, 4))
    assert first.losses == again.losses
    assert np.array_equal(first.image(test.receivers[0]), again.image(test.receivers[0]))
    assert not np.array_equal(first.image(test.receivers[0]), other.image(test.receivers[0]))


def test_a_loss_that_is_no_number_stops_the_training():
    with pytest.raises(RuntimeError, match="loss: got nan at step 2"):
        learn(lambda i: float("nan") if i == 2 else 1.0, Training(9))


def test_a_ray_is_the_sum_of_what_its_points_send_through_those_before_them():
    """NeRF2's renderer against complex numbers, point by point."""
    options = nerf2.NeRF2Options(far_m=6.0, samples=5, depth=2, width=8, octaves=2)
    network = nerf2.build(options, 1)
    origin, source = np.random.default_rng(2).normal(size=(2, 3)).astype(np.float32)
    toward = np.array([0.6, 0.0, 0.8], np.float32)
    asked = []
    for name in ("attenuation", "signal"):
        network[name].register_forward_hook(lambda _, __, out: asked.append(out.detach().numpy()[0]))
    rays = (torch.from_numpy(v)[None] for v in (origin, toward))
    shown = float(nerf2.render(network, options, *rays, torch.from_numpy(source)).detach()[0])
    attenuation, signal = (a.astype(np.float64) for a in asked)

    def positive(x):
        return abs(x if x > 0 else 0.01 * x)

    def angle(x):
        return 2 * np.pi / (1 + np.exp(-x))

    t = np.linspace(0.0, 6.0, 5)
    through, total = 1.0 + 0j, 0j
    for i in range(5):
        distance = t[i + 1] if i < 4 else 1e10
        total += positive(signal[i, 0]) * np.exp(1j * angle(signal[i, 1])) * through * 0.025 / distance
        if i < 4:
            step = t[i + 1] - t[i]
            through *= np.exp((1j * angle(attenuation[i, 1]) - positive(attenuation[i, 0])) * step)
    assert shown == pytest.approx(abs(total), rel=1e-4)
