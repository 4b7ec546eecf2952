"""Learned baselines on a handful of tiny spectra: they learn, repeat themselves bit by bit, resume, and read files."""

from __future__ import annotations

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from benchmarks.baselines import (
    CGAN,
    CGANOptions,
    NeRF2,
    NeRF2Options,
    SpectrumImages,
    Training,
    training,
)
from benchmarks.baselines import nerf2 as nerf2_module
from benchmarks.baselines.images import path_gain_of
from warprrf.rf.channel.array_spectra import ArraySpectra, hemisphere
from warprrf.rf.channel.arrays import PlanarArray
from warprrf.rf.spectra import lookups, metrics
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import pixel_directions

SHAPE = (10, 20)
TRANSMITTER = np.array([4.0, 1.0, 2.0])
SMALL = NeRF2Options(far_m=8.0, samples=8, depth=3, width=32, skip=1, octaves=3, scale_m=2.5)
FIT: dict[str, dict[str, Any]] = {
    "NeRF2": {"iterations": 250, "rays": 128},
    "CGAN": {"iterations": 60, "batch": 4},
}


def spectra(count: int = 12) -> SpectrumDataset:
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
        receivers=receivers,
        transmitter=TRANSMITTER,
        frequency_hz=300e9,
        path_gain=np.array(images, np.float32),
        delay_s=np.full((count, *SHAPE), np.nan),
        aod=np.full((count, *SHAPE, 2), np.nan),
        line_of_sight=np.ones(count, bool),
        beam_sigma_rad=0.1,
        engine="exact",
        floor=1e-13,
        role=["train"] * (count - 3) + ["test"] * 3,
    )


def fit(name: str, data: Any, **changed: Any) -> Any:
    options = {**FIT[name], "device": "cpu", **changed}
    size = {k: options.pop(k) for k in ("rays", "batch") if k in options}
    how = Training(**options)
    if name == "NeRF2":
        return NeRF2.fit(data, SMALL, how, **size)
    return CGAN.fit(data, CGANOptions.around(SpectrumImages.of(data).receivers, channels=8), how, **size)


@pytest.fixture(scope="module")
def fitted() -> dict[str, Any]:
    train, _ = spectra().split(9)
    return {name: fit(name, train) for name in FIT}


@pytest.mark.parametrize("name", FIT)
def test_loss_falls_and_the_constant_is_beaten_on_held_out_receivers(
    name: str, fitted: dict[str, Any]
) -> None:
    train, test = spectra().split(9)
    losses = fitted[name].report["losses"]
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])
    constant = metrics.evaluate(test, lookups.constant(train))
    found = metrics.evaluate(test, fitted[name].spectrum)
    assert found["psnr_db"] > constant["psnr_db"] + 1.0
    assert found["rmse_db"] < constant["rmse_db"]


@pytest.mark.parametrize("name", FIT)
def test_a_seed_repeats_bit_by_bit_and_another_one_differs(name: str) -> None:
    train, test = spectra().split(4)
    few = {"iterations": 6}
    first, again, other = (fit(name, train, seed=s, **few) for s in (3, 3, 4))
    assert first.report["losses"] == again.report["losses"]
    assert np.array_equal(first.image(test.receivers[0]), again.image(test.receivers[0]))
    assert not np.array_equal(first.image(test.receivers[0]), other.image(test.receivers[0]))


@pytest.mark.parametrize("name", FIT)
def test_resumed_training_ends_as_an_uninterrupted_one(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_S", -1.0)  # after every step
    train, test = spectra().split(4)
    whole = fit(name, train, iterations=9)
    file = tmp_path / "half.safetensors"
    done = []

    def killed(stage: str, step: int, total: int) -> None:
        done.append(step)
        if step == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(name, train, iterations=9, checkpoint=file, progress=killed)
    assert file.exists()
    with pytest.raises(ValueError, match="checkpoint: .* other data or options"):
        fit(name, train, iterations=9, checkpoint=file, seed=1)
    done.clear()
    resumed = fit(name, train, iterations=9, checkpoint=file, progress=lambda _, step, __: done.append(step))
    assert done == [5, 6, 7, 8, 9]  # the step at which it was killed had not been saved yet
    assert resumed.report["losses"] == whole.report["losses"]
    assert np.array_equal(resumed.image(test.receivers[0]), whole.image(test.receivers[0]))


@pytest.mark.parametrize("name", FIT)
def test_a_finished_training_is_not_done_again(name: str, tmp_path: Path) -> None:
    train, test = spectra().split(4)
    done: list[int] = []
    first, again = (
        fit(
            name,
            train,
            iterations=5,
            checkpoint=tmp_path / "done",
            progress=lambda _, step, __: done.append(step),
        )
        for _ in range(2)
    )
    assert done == [1, 2, 3, 4, 5]
    assert again.report["losses"] == first.report["losses"]
    assert np.array_equal(again.image(test.receivers[0]), first.image(test.receivers[0]))


def test_the_time_of_a_training_includes_what_came_before_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_S", -1.0)

    def killed(stage: str, step: int, total: int) -> None:
        if step == 3:
            raise KeyboardInterrupt

    def step(i: int) -> float:
        time.sleep(1.0 if i == 0 else 0.0)
        return 1.0

    learner = training.Learner({}, {}, step)
    for progress, ends in ((killed, pytest.raises(KeyboardInterrupt)), (None, nullcontext())):
        how = Training(4, checkpoint=tmp_path / "half.safetensors", progress=progress)
        with ends:
            losses, seconds = training.train(learner, how, "same")
    assert losses == [1.0] * 4 and seconds > 1.0


@pytest.mark.parametrize("name", FIT)
def test_a_saved_model_draws_the_same(name: str, fitted: dict[str, Any], tmp_path: Path) -> None:
    model = fitted[name]
    model.save(tmp_path / "model.safetensors")
    loaded = type(model).load(tmp_path / "model.safetensors", device="cpu")
    receiver = np.array([1.0, 2.0, 1.5])
    assert np.array_equal(loaded.spectrum(receiver).path_gain, model.spectrum(receiver).path_gain)
    assert loaded.spectrum(receiver).range_db == model.spectrum(receiver).range_db
    assert model.model_bytes <= (tmp_path / "model.safetensors").stat().st_size
    other = CGAN if name == "NeRF2" else NeRF2
    with pytest.raises(ValueError, match=f"holds a '{name}'"):
        other.load(tmp_path / "model.safetensors")


def test_a_ray_is_the_sum_of_what_its_points_send_through_those_before_them() -> None:
    """NeRF2's renderer against complex numbers, point by point."""
    options = NeRF2Options(far_m=6.0, near_m=0.5, samples=5, depth=2, width=8, octaves=2)
    network = NeRF2._build(options, SHAPE, 1)
    rng = np.random.default_rng(2)
    origin, source = rng.normal(size=(2, 3)).astype(np.float32)
    toward = np.array([0.6, 0.0, 0.8], np.float32)
    asked: list[Any] = []
    for name in ("attenuation", "signal"):
        network[name].register_forward_hook(lambda _, __, out: asked.append(out.detach().numpy()[0]))
    row = lambda v: torch.from_numpy(v)[None]  # noqa: E731
    shown = float(nerf2_module.render(network, options, row(origin), row(toward), row(source)).detach()[0])
    attenuation, signal = (a.astype(np.float64) for a in asked)

    def positive(x: np.ndarray) -> np.ndarray:
        return np.abs(np.where(x > 0, x, 0.01 * x))

    def angle(x: np.ndarray) -> np.ndarray:
        return 2 * np.pi / (1 + np.exp(-x))

    t = np.linspace(0.5, 6.0, 5)
    through, total = 1.0 + 0j, 0j
    for i in range(5):
        distance = t[i + 1] if i < 4 else 1e10
        total += positive(signal[i, 0]) * np.exp(1j * angle(signal[i, 1])) * through * 0.025 / distance
        if i < 4:
            step = t[i + 1] - t[i]
            through *= np.exp(-positive(attenuation[i, 0]) * step) * np.exp(
                1j * angle(attenuation[i, 1]) * step
            )
    assert shown == pytest.approx(abs(total), rel=1e-4)


def test_pictures_are_the_db_image_in_the_stated_range_and_back() -> None:
    ds = spectra()
    known = SpectrumImages.of(ds)
    low, high = ds.range_db
    expected = (10 * np.log10(ds.path_gain[2, 3, 4] + ds.floor) - low) / (high - low)
    assert known.images[2, 3, 4] == pytest.approx(expected, abs=1e-6)
    back = path_gain_of(known.images, ds.floor, ds.range_db)
    assert np.allclose(back, ds.path_gain, rtol=1e-4)
    assert path_gain_of(np.array([-3.0]), ds.floor, ds.range_db)[0] == 0.0


def test_errors_name_the_argument(fitted: dict[str, Any]) -> None:
    train, _ = spectra().split(4)
    with pytest.raises(ValueError, match="near_m, far_m"):
        NeRF2Options(far_m=0.0)
    with pytest.raises(ValueError, match="iterations: got 0"):
        NeRF2.fit(train, SMALL, Training(iterations=0))
    with pytest.raises(ValueError, match="channels: got 12"):
        CGANOptions.around(train.receivers, channels=12)
    with pytest.raises(ValueError, match="rx"):
        fitted["CGAN"].spectrum([np.nan, 0.0, 0.0])
    with pytest.raises(ValueError, match="transmitter: got"):
        fitted["CGAN"].image([1.0, 1.0, 1.0], [0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="device"):
        NeRF2.fit(train, SMALL, Training(iterations=1, device="cpu0x"))


def test_nerf2_trains_on_spectra_of_arrays() -> None:
    directions = hemisphere((9, 36))
    power = np.zeros((4, 9, 36))
    power[:, 6:] = 0.8
    power[np.arange(4), 3, 9 * np.arange(4)] = 1.0
    senders = np.array([[k + 0.5, 1.0, 1.5] for k in range(4)])
    known = ArraySpectra(senders, np.array([1.0, 2.0, 0.5]), power, 920e6, PlanarArray(4, 4), directions)
    model = fit("NeRF2", known, iterations=300, rays=64)
    losses = model.report["losses"]
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:10])
    drawn = model.image([1.0, 2.0, 0.5], [1.5, 1.0, 1.5])
    assert drawn.shape == (9, 36)
    with pytest.raises(ValueError, match="without a dB range"):
        model.spectrum([1.0, 2.0, 0.5])
