"""Loss and adjoint of the field fit against NumPy and finite differences, in float64; trained opacities."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from path_makers import random_directions
from scipy.special import factorial, lpmv

from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.kernels.ssim import RADIUS, WINDOW
from warprrf.rf.fields.harmonic.field import HarmonicField
from warprrf.rf.fields.harmonic.fitting import Layer, Rates, Target, fit_layer
from warprrf.rf.fields.harmonic.opacity import Listed, OpacityTraining, list_responses
from warprrf.rf.fields.harmonic.problem import Problem
from warprrf.rf.fields.harmonic.transport import Rows, Transport, transport
from warprrf.rf.spectra.spectrum import pixel_directions

SHAPE = (12, 24)
GAUSSIANS = 9


def synthetic_transport(receivers=3, seed=0):
    """Random sparse weights: zero to four Gaussians a pixel, indices with gaps."""
    rng = np.random.default_rng(seed)
    pixels, views = SHAPE[0] * SHAPE[1], []
    for _ in range(receivers):
        counts = rng.integers(0, 5, pixels)
        gaussian = np.concatenate([rng.choice(GAUSSIANS, n, replace=False) * 3 for n in counts])
        views.append(
            Rows(
                start=wp.array(np.concatenate([[0], np.cumsum(counts)]), dtype=int),
                gaussian=wp.array(gaussian, dtype=int),
                weight=wp.array(rng.uniform(0.1, 0.9, len(gaussian)), dtype=float),
                dominant=wp.array(np.where(counts > 0, 0, -1), dtype=int),
                expected_range=wp.ones(pixels, dtype=wp.float64),
            )
        )
    return Transport(SHAPE, rng.random((receivers, 3)), tuple(views), 3 * GAUSSIANS, "product")


def pairs_of(seen):
    """Pixel, counted through all receivers, Gaussian and weight of every pair."""
    pixels = SHAPE[0] * SHAPE[1]
    each = [
        (
            k * pixels + np.repeat(np.arange(pixels), np.diff(v.start.numpy())),
            v.gaussian.numpy(),
            v.weight.numpy(),
        )
        for k, v in enumerate(seen.views)
    ]
    return (np.concatenate(parts) for parts in zip(*each, strict=True))


def gain_target(problem, seed=1, unit=None):
    rng = np.random.default_rng(seed)
    shape = (len(problem.transport.receivers), *SHAPE)
    return Target(
        image=rng.uniform(0.1, 0.9, shape),
        initial=np.zeros(len(problem.seen)),
        unit=unit,
        factor=rng.uniform(5.0, 50.0, shape),
        extra=np.where(rng.random(shape) < 0.1, 20.0, 0.0),
        low=0.0,
        high=40.0,
    )


def coefficients_for(problem, kind, seed=2):
    table = np.random.default_rng(seed).normal(0, 0.3, (len(problem.seen), 16))
    table[:, 0] += 6.0 if kind == "linear" else 1.0  # clamped sums stay off their kink
    return table


def harmonics(d):
    """Real harmonics of degree 0 to 3 from SciPy's Legendre functions, in the INRIA order and signs, shape (..., 16)."""
    azimuth, out = np.arctan2(d[..., 1], d[..., 0]), []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            m = abs(order)
            norm = np.sqrt((2 * degree + 1) / (4 * np.pi) * factorial(degree - m) / factorial(degree + m))
            turn = 1.0 if m == 0 else np.sqrt(2) * (np.cos(m * azimuth) if order > 0 else np.sin(m * azimuth))
            out.append(norm * turn * lpmv(m, degree, d[..., 2]))
    return np.stack(out, axis=-1)


def loss_by_hand(problem, target, kind, table):
    """The documented loss in NumPy: dense loops, no kernels."""
    basis = harmonics(pixel_directions(SHAPE).reshape(-1, 3))
    pixel, gaussian, weight = pairs_of(problem.transport)
    local = np.searchsorted(problem.seen, gaussian)
    x = np.einsum("ek,ek->e", table[local], basis[pixel % (SHAPE[0] * SHAPE[1])])
    gain = {"exp": np.exp, "linear": lambda v: np.maximum(v, 0), "signed": lambda v: v}[kind](x)
    if target.unit is not None:
        gain = gain * target.unit[local]
    total = np.bincount(pixel, weights=weight.astype(np.float64) * gain, minlength=target.image.size)
    if target.mask is not None:
        return float((target.mask.ravel() * np.abs(total - target.image.ravel())).sum() / target.mask.sum())
    power = target.factor.ravel() * total + target.extra.ravel()
    u = (10 * np.log10(power + 1.0) - target.low) / (target.high - target.low)
    u = u.reshape(target.image.shape)
    a, b = u, target.image

    def smooth(image):
        padded = np.pad(image, ((0, 0), (RADIUS, RADIUS), (0, 0)))
        rows = sum(w * padded[:, k : k + image.shape[1]] for k, w in enumerate(WINDOW))
        return sum(w * np.roll(rows, RADIUS - k, axis=2) for k, w in enumerate(WINDOW))

    ma, mb = smooth(a), smooth(b)
    va, vb, cov = smooth(a * a) - ma**2, smooth(b * b) - mb**2, smooth(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    return float(0.8 * np.abs(a - b).mean() + 0.2 * (1 - similarity.mean()))


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("kind", ["exp", "linear", "signed"])
@pytest.mark.parametrize("with_unit", [False, True])
def test_loss_and_gradient_against_numpy_and_finite_differences(kind, with_unit):
    problem = Problem(synthetic_transport(), batch=3, precision=np.float64)
    unit = np.random.default_rng(7).uniform(0.5, 2.0, len(problem.seen)) if with_unit else None
    target = replace(gain_target(problem, unit=unit), kind=kind)
    if kind == "signed":
        mask = (np.random.default_rng(8).random(target.image.shape) < 0.7).astype(float)
        target = Target(image=target.image, initial=target.initial, kind=kind, unit=unit, mask=mask)
    table = coefficients_for(problem, kind)
    layer = Layer(problem, target)

    def loss(values):
        return layer.step(0, problem.upload(values, problem.kernels.vec16))

    assert loss(table) == pytest.approx(loss_by_hand(problem, target, kind, table), rel=1e-12)
    gradient = layer.gradient.numpy().copy()
    assert np.abs(gradient).max() > 1e-4
    step = 1e-6
    rng = np.random.default_rng(9)
    for _ in range(6):  # directions mix all coefficients, so each of them is tested
        direction = rng.normal(size=table.shape)
        numeric = (loss(table + step * direction) - loss(table - step * direction)) / (2 * step)
        assert (gradient * direction).sum() == pytest.approx(numeric, rel=2e-5, abs=1e-9)


def test_gradient_does_not_depend_on_how_launches_are_split(monkeypatch):
    import warprrf.device as device

    problem = Problem(synthetic_transport(receivers=4), batch=4)
    layer = Layer(problem, gain_target(problem))
    table = problem.upload(coefficients_for(problem, "exp"), problem.kernels.vec16)
    results = []
    for smallest in (1, 10**9):
        monkeypatch.setattr(device, "MIN_SPLIT", smallest)
        results.append((layer.step(0, table), layer.gradient.numpy().copy()))
    assert results[0][0] == results[1][0]
    assert np.array_equal(results[0][1], results[1][1])


@pytest.mark.usefixtures("device")
def test_adams_first_step_is_the_learning_rate_against_the_gradients_sign():
    """Kingma and Ba 2015: after bias correction the first update is rate * g / |g|."""
    problem = Problem(synthetic_transport(), batch=3, precision=np.float64)
    target = gain_target(problem)
    layer = Layer(problem, target)
    start = np.zeros((len(problem.seen), 16))
    layer.step(0, problem.upload(start, problem.kernels.vec16))
    gradient = layer.gradient.numpy()
    state = fit_layer(problem, target, steps=1, rates=Rates(0.3, 0.01, 0.0, 0.0))
    assert state.coefficients[:, 0] == pytest.approx(-0.3 * np.sign(gradient[:, 0]), rel=1e-6)
    assert state.coefficients[:, 1:] == pytest.approx(-0.01 * np.sign(gradient[:, 1:]), rel=1e-6)


@pytest.mark.parametrize(("degree", "count"), [(0, 1), (1, 4), (2, 9), (3, 16)])
def test_coefficients_above_the_degree_stay_zero(degree, count):
    problem = Problem(synthetic_transport(), batch=3)
    state = fit_layer(problem, gain_target(problem), steps=4, degree=degree)
    assert state.coefficients[:, :count].all()
    assert not state.coefficients[:, count:].any()


RANGE_DB = (-60.0, 0.0)


def test_the_ridge_holds_a_gaussian_at_its_start():
    problem = Problem(synthetic_transport(), batch=3)
    target = gain_target(problem)
    free, held = (
        fit_layer(problem, target, steps=60, rates=Rates(0.05, 0.05, ridge, ridge)).coefficients
        for ridge in (0.0, 1e6)
    )
    assert np.abs(free).max() > 0.5
    assert np.abs(held).max() < 0.1 * np.abs(free).max()


def test_a_pixels_weight_is_the_sum_of_its_pairs_and_zero_without_any():
    seen = synthetic_transport()
    pixel, _, weight = pairs_of(seen)
    expected = np.bincount(pixel, weight, 3 * SHAPE[0] * SHAPE[1]).reshape(3, *SHAPE)
    assert np.allclose(seen.pixel_weight, expected, rtol=1e-12, atol=0)


def shell(count=250, seed=0):
    """Blobs on two shells around the origin: what lies behind shows only through the first."""
    rng = np.random.default_rng(seed)
    direction, distance = random_directions(count, rng), np.where(np.arange(count) % 2, 2.0, 4.0)
    return Gaussians(
        (direction * distance[:, None]).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 3), 0.35, np.float32),
        rng.uniform(0.2, 0.9, count).astype(np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


def test_listed_responses_give_the_weights_that_the_rasteriser_gives():
    gaussians = replace(shell(), opacities=np.full(250, 0.999, np.float32))
    receivers = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 0.1]])
    seen = transport(gaussians, receivers, SHAPE, range_db=RANGE_DB, top_k=64)
    listed = list_responses(gaussians, seen, RANGE_DB, top_k=64)
    pairs = [sum(len(view.gaussian) for view in found.views) for found in (listed.transport, seen)]
    assert pairs[0] > 1.05 * pairs[1]  # what hides behind is listed too
    assert np.allclose(listed.transport.pixel_weight, seen.pixel_weight, atol=2e-3)
    other = replace(gaussians, opacities=(0.6 * gaussians.opacities).astype(np.float32))
    thinner = transport(other, receivers, SHAPE, range_db=RANGE_DB, top_k=64)
    found = listed.with_opacities(other.opacities)
    assert np.allclose(found.pixel_weight, thinner.pixel_weight, atol=5e-3)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("with_unit", [False, True])
def test_gradient_by_logits_of_opacity_against_finite_differences(with_unit):
    rng = np.random.default_rng(1)
    blank = synthetic_transport(receivers=2)
    responses = [wp.array(rng.uniform(0.2, 1.0, len(v.gaussian)), dtype=float) for v in blank.views]
    listed = Listed(blank, tuple(responses), 1 - 1e-6)
    opacities = rng.uniform(0.2, 0.8, 3 * GAUSSIANS)
    problem = Problem(listed.with_opacities(opacities), batch=2, precision=np.float64)
    unit = rng.uniform(0.5, 2.0, len(problem.seen)) if with_unit else None
    target = gain_target(problem, unit=unit)
    coefficients = problem.upload(coefficients_for(problem, "exp"), problem.kernels.vec16)

    def loss(values):
        everyone = np.zeros(3 * GAUSSIANS)
        everyone[problem.seen] = values
        layer = Layer(problem, target, OpacityTraining(problem, listed, everyone))
        return layer.step(0, coefficients), layer.opacity.gradient.numpy()

    start = opacities[problem.seen]
    gradient = loss(start)[1]
    step = 1e-5
    for k in range(len(start)):
        away = np.zeros(len(start))
        away[k] = step
        slope = (loss(start + away)[0] - loss(start - away)[0]) / (2 * step)
        by_logit = slope * start[k] * (1.0 - start[k])
        assert gradient[k] == pytest.approx(by_logit, rel=2e-3, abs=1e-7)


def test_training_opacity_fits_what_frozen_opacity_cannot():
    """Targets of the same blobs, more transparent: with opacity trained the loss ends lower, and so do opacities."""
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
    how = {"transport": seen, "sh_degree": 0, "iterations": 120, "device": "cpu"}
    fields = [HarmonicField.fit(gaussians, ds, "rf3dgs", train_opacity=t, **how) for t in (False, True)]
    frozen, trained = (np.mean(f.report["losses"]["gain"][-5:]) for f in fields)
    assert trained < 0.8 * frozen
    assert np.array_equal(fields[0].gaussians.opacities, gaussians.opacities)
    moved = fields[1].gaussians.opacities
    assert not np.array_equal(moved, gaussians.opacities)
    assert ((moved >= 0) & (moved <= 1)).all()
