"""Trained opacities: weights from cached responses, their adjoint against finite differences, and a whole fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.rf.fields.harmonic.field import HarmonicField
from warprrf.rf.fields.harmonic.fitting import Layer, Target
from warprrf.rf.fields.harmonic.opacity import Listed, OpacityTraining, list_responses
from warprrf.rf.fields.harmonic.problem import Problem
from warprrf.rf.fields.harmonic.transport import Transport, transport

SHAPE = (12, 24)
RANGE_DB = (-60.0, 0.0)


def shell(count: int = 250, seed: int = 0) -> Gaussians:
    """Blobs on two shells around the origin: what lies behind shows only through the first."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = np.where(np.arange(count) % 2, 2.0, 4.0)
    return Gaussians(
        (direction * distance[:, None]).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 3), 0.35, np.float32),
        rng.uniform(0.2, 0.9, count).astype(np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


def listed_pairs(seed: int = 0) -> Listed:
    """Random lists of up to four of nine Gaussians a pixel, two receivers."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 5, 2 * SHAPE[0] * SHAPE[1])
    gaussian = np.concatenate([rng.choice(9, n, replace=False) for n in counts]).astype(np.int32)
    blank = Transport(
        shape=SHAPE,
        receivers=rng.random((2, 3)),
        start=np.concatenate([[0], np.cumsum(counts)]),
        gaussian=gaussian,
        weight=np.zeros(len(gaussian), np.float32),
        dominant=np.where(counts > 0, 0, -1).reshape(2, *SHAPE).astype(np.int32),
        expected_range=np.ones((2, *SHAPE), np.float32),
        rule="product",
    )
    return Listed(blank, rng.uniform(0.2, 1.0, len(gaussian)).astype(np.float32), 1 - 1e-6)


def test_listed_responses_give_the_weights_that_the_rasteriser_gives() -> None:
    gaussians = replace(shell(), opacities=np.full(250, 0.999, np.float32))
    receivers = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1]])
    seen = transport(gaussians, receivers, SHAPE, range_db=RANGE_DB, top_k=64)
    listed = list_responses(gaussians, seen, RANGE_DB, top_k=64)
    assert len(listed.response) > 1.05 * len(seen.gaussian)  # what hides behind is listed too
    assert np.allclose(listed.transport.pixel_weight, seen.pixel_weight, atol=2e-3)
    other = replace(gaussians, opacities=(0.6 * gaussians.opacities).astype(np.float32))
    thinner = transport(other, receivers, SHAPE, range_db=RANGE_DB, top_k=64)
    found = listed.with_opacities(other.opacities)
    assert np.allclose(found.pixel_weight, thinner.pixel_weight, atol=5e-3)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("with_unit", [False, True])
def test_gradient_by_opacity_against_finite_differences(with_unit: bool) -> None:
    listed = listed_pairs()
    rng = np.random.default_rng(1)
    opacities = rng.uniform(0.2, 0.8, 9)
    problem = Problem(listed.with_opacities(opacities), batch=2, precision=np.float64)
    unit = rng.uniform(0.5, 2.0, len(problem.seen)) if with_unit else None
    target = Target(
        image=rng.uniform(0.1, 0.9, (2, *SHAPE)), initial=np.zeros(len(problem.seen)), unit=unit,
        factor=rng.uniform(5.0, 50.0, (2, *SHAPE)), low=0.0, high=40.0,
    )  # fmt: skip
    table = rng.normal(0, 0.3, (len(problem.seen), 16))
    coefficients = problem.upload(table, problem.kernels.vec16)

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        everyone = np.zeros(9)
        everyone[problem.seen] = values
        layer = Layer(problem, target, OpacityTraining(problem, listed, everyone))
        return layer.step(0, coefficients), layer.opacity_gradient

    start = opacities[problem.seen]
    gradient = loss(start)[1]
    step = 1e-5
    for k in range(len(start)):
        away = np.zeros(len(start))
        away[k] = step
        slope = (loss(start + away)[0] - loss(start - away)[0]) / (2 * step)
        assert gradient[k] == pytest.approx(slope, rel=2e-3, abs=1e-7)


def test_training_opacity_fits_what_frozen_opacity_cannot() -> None:
    """Targets of the same blobs, more transparent: with opacity trained the loss ends lower, and so do opacities."""
    from types import SimpleNamespace

    gaussians = shell()
    receivers = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1], [-0.2, 0.3, 0.2], [0.1, 0.1, -0.3]])
    clear = replace(gaussians, opacities=(0.4 * gaussians.opacities).astype(np.float32))
    shown = transport(clear, receivers, SHAPE, range_db=RANGE_DB, top_k=64)
    solid = np.full((len(receivers), *SHAPE), 1e-9)
    ds = SimpleNamespace(
        receivers=receivers, transmitter=np.array([0.5, 0.5, 0.5]), frequency_hz=300e9,
        path_gain=(solid * shown.pixel_weight).astype(np.float32), delay_s=None, aod=None, floor=1e-13,
        range_db=(-130.0, -90.0), beam_sigma_rad=0.1,
    )  # fmt: skip
    seen = transport(gaussians, receivers, SHAPE, range_db=ds.range_db, top_k=64)
    fields = [
        HarmonicField.fit(
            gaussians,
            ds,
            "rf3dgs",
            transport=seen,
            sh_degree=0,
            iterations=120,
            train_opacity=train,
            device="cpu",
        )
        for train in (False, True)
    ]
    frozen, trained = (np.mean(f.report["losses"]["gain"][-5:]) for f in fields)
    assert trained < 0.8 * frozen
    assert np.array_equal(fields[0].gaussians.opacities, gaussians.opacities)
    moved = fields[1].gaussians.opacities
    assert not np.array_equal(moved, gaussians.opacities)
    assert ((moved >= 0) & (moved <= 1)).all()
