"""Calibration with Sionna RT's own gradients on a small room whose materials are known."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("sionna.rt")
from small_room import small_room

import warprrf as wr
from benchmarks.baselines.sionna_calibration import Calibration, calibrate_sionna
from warprrf.rf.interop import sionna_engine
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine
from warprrf.rf.paths.sionna import by_delay


@pytest.mark.long
def test_calibration_lowers_the_error_and_finds_what_scatters(tmp_path, monkeypatch):
    folder = small_room(tmp_path)
    train = wr.SpectrumDataset.load(folder / "spectra.nc").split(4)[0]
    true = wr.Scene.load(folder / "scene.xml")
    truth = [m.scattering_coefficient(300e9) for m in true.materials]
    halved = [replace(m, scattering=0.5 * s) for m, s in zip(true.materials, truth, strict=True)]
    effort = Calibration(seconds=60.0, most_steps=12, samples=20_000, rate=0.5)
    found = calibrate_sionna(true.with_materials(halved), train, effort, device="cpu")
    assert len(found.losses) == 12
    assert np.mean(found.losses[-4:]) < 0.7 * np.mean(found.losses[:4])
    walls = next(k for k, m in enumerate(true.materials) if m.name == "concrete")
    learned = found.scene.materials[walls].scattering_coefficient(300e9)
    assert abs(learned - truth[walls]) < 0.5 * (0.5 * truth[walls])  # it began at half of the truth
    assert found.scene.materials[walls].name == "concrete"
    # Sionna evaluates the materials of all scenes in memory: none may go on recording gradients.
    drjit = pytest.importorskip("drjit")
    recorded = []

    def watched(paths, *rest):
        recorded.append(any(drjit.grad_enabled(part) for part in paths.a))
        return by_delay(paths, *rest)

    monkeypatch.setattr(sionna_engine, "by_delay", watched)
    SionnaEngine(
        found.scene, transmitter=train.transmitter, frequency_hz=train.frequency_hz, shape=train.shape,
        sampling=Sampling(depth=1, samples=20_000), device="cpu",
    ).solve(train.receivers[0])  # fmt: skip
    assert recorded == [False]
