"""Gradients of hits and transmittance with respect to the Gaussians, in float64: Warp's tape against finite differences
on many random scenes, torch's gradcheck, second backward calls and gradients used again."""

import numpy as np
import pytest
import warp as wp

from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.rasterizer import Blending

SCENES = 60
COUNT, RAYS, PLACES = 7, 40, 3
NAMES = ("means", "quaternions", "scales", "opacities")
DTYPES = (wp.vec3d, wp.vec4d, wp.vec3d, wp.float64)
STEP = (
    1e-5  # of the central differences; with one Richardson step their error is of order h^4 plus rounding / h
)
MARGIN = 1e-2  # a ray counts if cutoff, clamp, segment's end, order and early exit are this far from deciding otherwise


@wp.kernel
def loss_of_rays(
    transmittance: wp.array(dtype=wp.float64),
    t: wp.array(dtype=wp.float64, ndim=2),
    alpha: wp.array(dtype=wp.float64, ndim=2),
    weight: wp.array(dtype=wp.float64, ndim=2),
    left: wp.array(dtype=wp.float64),
    index: wp.array(dtype=int, ndim=2),
    of_segment: wp.array(dtype=wp.float64),
    of_ray: wp.array(dtype=wp.float64),
    loss: wp.array(dtype=wp.float64),
):
    """Smooth and different in every output; rays weighted."""
    i = wp.tid()
    wp.atomic_add(loss, 0, of_segment[i] * wp.log(transmittance[i] + wp.float64(0.1)))
    wp.atomic_add(loss, 0, of_ray[i] * left[i] * left[i])
    for k in range(wp.static(PLACES)):
        if index[i, k] >= 0:
            share = of_ray[i] / wp.float64(1 + k)
            wp.atomic_add(loss, 0, share * (weight[i, k] * t[i, k] + wp.sin(alpha[i, k]) + t[i, k] * t[i, k]))


class WholePath:
    """A random scene, rays and segments, and a loss; ``spoil`` names an input whose adjoint is planted wrong."""

    def __init__(self, seed, *, spoil=None):
        rng = np.random.default_rng(seed)
        self.values = {
            "means": rng.uniform(-1.5, 1.5, (COUNT, 3)),
            "quaternions": rng.normal(size=(COUNT, 4)),
            "scales": np.exp(rng.uniform(np.log(0.08), np.log(0.7), (COUNT, 3))),
            "opacities": rng.uniform(0.2, 1.0, COUNT),
        }
        self.order = ("peak", "range")[seed % 2]
        self.blending = Blending(
            alpha_max=0.95, transmittance_min=0.02, rule=("product", "exp")[seed // 2 % 2]
        )
        # Rays through the neighbourhood of random Gaussians, so that most meet several.
        self.start = rng.uniform(-2, 2, (RAYS, 3))
        aim = self.values["means"][rng.integers(COUNT, size=RAYS)] + 0.1 * rng.normal(size=(RAYS, 3))
        self.end = self.start + rng.uniform(0.8, 2.5, (RAYS, 1)) * (aim - self.start)
        segment, ray = self.margins()
        self.weights = [
            wp.array((m > MARGIN) * rng.uniform(0.5, 1.5, RAYS), dtype=wp.float64, device="cpu")
            for m in (segment, ray)
        ]
        self.share = np.mean(segment > MARGIN), np.mean(ray > MARGIN)
        self.spoil = spoil

    def margins(self):
        """How far each segment and each ray is from any decision, relatively."""
        w, x, y, z = (
            self.values["quaternions"] / np.linalg.norm(self.values["quaternions"], axis=1, keepdims=True)
        ).T
        rows = [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
            1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ]  # fmt: skip
        rotations = np.stack(rows, axis=1).reshape(-1, 3, 3)
        whiten = rotations.transpose(0, 2, 1) / self.values["scales"][:, :, None]
        length = np.linalg.norm(self.end - self.start, axis=1)
        unit = (self.end - self.start) / length[:, None]
        offset = np.einsum("nij,rnj->rni", whiten, self.start[:, None] - self.values["means"])
        toward = np.einsum("nij,rj->rni", whiten, unit)
        t = -(offset * toward).sum(-1) / (toward**2).sum(-1)
        raw = self.values["opacities"] * np.exp(-0.5 * ((offset + t[..., None] * toward) ** 2).sum(-1))
        b = self.blending
        decided = np.minimum(np.abs(np.log(raw / b.alpha_min)), np.abs(np.log(raw / b.alpha_max)))
        # A cutoff does not matter where the peak is far behind, nor the ends where the Gaussian is faint.
        faint = raw < b.alpha_min * np.exp(-MARGIN)
        ray = np.where(t > -MARGIN, decided, np.inf).min(axis=1)
        ray = np.minimum(ray, np.where(faint, np.inf, np.abs(t)).min(axis=1))
        within = (t > -MARGIN) & (t < length[:, None] + MARGIN)
        segment = np.where(within, decided, np.inf).min(axis=1)
        ends = np.minimum(np.abs(t), np.abs(t - length[:, None]))
        segment = np.minimum(segment, np.where(faint, np.inf, ends).min(axis=1))
        reach = np.linalg.norm(self.values["means"] - self.start[:, None], axis=-1)
        key = np.where((t > 0) & ~faint, t if self.order == "peak" else reach, np.inf)
        order = np.argsort(key, axis=1)
        with np.errstate(invalid="ignore"):
            gaps = np.diff(np.take_along_axis(key, order, 1), axis=1)
        ray = np.minimum(ray, np.where(np.isfinite(gaps), gaps, np.inf).min(axis=1))
        alpha = np.where(np.isfinite(key) & (raw > b.alpha_min), np.minimum(raw, b.alpha_max), 0.0)
        alpha = np.take_along_axis(alpha, order, 1)
        left = np.cumprod(1 - alpha, axis=1) if b.rule == "product" else np.exp(-np.cumsum(alpha, axis=1))
        return segment, np.minimum(ray, np.abs(left / b.transmittance_min - 1).min(axis=1))

    def record(self, values):
        inputs = [
            wp.array(values[name], dtype=dtype, requires_grad=True, device="cpu")
            for name, dtype in zip(NAMES, DTYPES, strict=True)
        ]
        loss = wp.zeros(1, dtype=wp.float64, requires_grad=True, device="cpu")
        with wp.Tape() as tape:
            if self.spoil is not None:  # recorded first, so it runs last, when the gradient is complete
                wrong = inputs[NAMES.index(self.spoil)]
                tape.record_func(lambda: wrong.grad.assign(wrong.grad.numpy() * (1 + 1e-4)), [wrong])
            rays = GaussianRays(tuple(inputs), blending=self.blending)
            passed = rays.transmit(self.start, self.end)
            hits = rays.trace(self.start, self.end - self.start, PLACES, order=self.order)
            wp.launch(
                loss_of_rays,
                dim=RAYS,
                inputs=[passed, *hits.outputs, hits.index, *self.weights, loss],
                device="cpu",
            )
        return tape, loss, dict(zip(NAMES, inputs, strict=True))

    def loss(self, values):
        return float(self.record(values)[1].numpy()[0])

    def gradients(self):
        tape, loss, inputs = self.record(self.values)
        tape.backward(loss)
        return {name: array.grad.numpy().copy() for name, array in inputs.items()}

    def errors(self):
        """Per input: deviation of the derivative along a random direction and the gradient from central differences,
        relative to the length of the gradient."""
        rng, out = np.random.default_rng(99), {}
        for name, gradient in self.gradients().items():
            v = rng.normal(size=gradient.shape)
            v = v / np.linalg.norm(v) + gradient / max(np.linalg.norm(gradient), 1e-300)
            estimates = []
            for h in (2 * STEP, STEP):
                up, down = (
                    self.loss({**self.values, name: self.values[name] + sign * h * v}) for sign in (1, -1)
                )
                estimates.append((up - down) / (2 * h))
            expected = (4 * estimates[1] - estimates[0]) / 3
            out[name] = abs(float(np.sum(gradient * v)) - expected) / max(np.linalg.norm(gradient), 1e-6)
        return out


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("seed", range(SCENES))
def test_gradients_match_finite_differences_to_1e_6(seed):
    path = WholePath(seed)
    assert min(path.share) > 0.4  # most rays are away from decisions
    assert np.linalg.norm(path.gradients()["means"]) > 1e-3
    errors = path.errors()
    assert max(errors.values()) < 1e-6, errors


@pytest.mark.parametrize("name", NAMES)
def test_a_planted_wrong_adjoint_is_caught(name):
    errors = WholePath(1, spoil=name).errors()
    assert errors.pop(name) > 1e-5
    assert max(errors.values()) < 1e-6


def test_gradients_do_not_depend_on_the_number_of_threads(monkeypatch):
    from warprrf import device

    both = []
    for count in (1, 2):
        monkeypatch.setattr(device, "threads", lambda count=count: count)
        both.append(WholePath(2).gradients())
    for name in NAMES:
        assert np.array_equal(both[0][name], both[1][name])


def test_a_second_backward_on_the_tape_adds_the_same_again():
    path = WholePath(3)
    tape, loss, inputs = path.record(path.values)
    tape.backward(loss)
    once = {name: array.grad.numpy().copy() for name, array in inputs.items()}
    tape.backward(loss)
    for name, array in inputs.items():
        assert np.abs(once[name]).max() > 0
        np.testing.assert_allclose(array.grad.numpy(), 2 * once[name], rtol=1e-12, atol=1e-14)
    tape.zero()
    tape.backward(loss)
    for name, array in inputs.items():
        assert np.array_equal(array.grad.numpy(), once[name])


@pytest.mark.parametrize("layers", [1, 2])
def test_a_fully_opaque_layer_has_the_derivative_of_the_others_product(layers):
    """With alpha_max of one, T = (1 - a1)(1 - a2)(1 - 0.3): a division by 1 - a would be by zero."""
    opacities = np.array([1.0, 1.0 if layers == 2 else 0.5, 0.3])
    inputs = [
        wp.array(v, dtype=dtype, requires_grad=True, device="cpu")
        for v, dtype in zip(
            (
                [[1, 0, 0], [2, 0, 0], [3, 0, 0]],
                np.tile([1.0, 0, 0, 0], (3, 1)),
                np.full((3, 3), 0.1),
                opacities,
            ),
            DTYPES,
            strict=True,
        )
    ]
    with wp.Tape() as tape:
        rays = GaussianRays(tuple(inputs), blending=Blending(alpha_max=1.0))
        passed = rays.transmit([0, 0, 0], [4, 0, 0])
        left = rays.trace([0, 0, 0], [1, 0, 0], 3)
    assert passed.numpy()[0] == 0 and left.left.numpy()[0] == 0
    tape.backward(grads={passed: wp.ones(1, dtype=wp.float64, device="cpu")})
    expected = [-np.prod(1 - np.delete(opacities, i)) for i in range(3)]
    np.testing.assert_allclose(inputs[3].grad.numpy(), expected, atol=1e-15)


# --------------------------------------------------------------------------------------------------------- torch


def scene(torch, seed, dtype):
    rng = np.random.default_rng(seed)
    values = (
        rng.uniform(-1, 1, (4, 3)), rng.normal(size=(4, 4)), np.exp(rng.uniform(-1, 0, (4, 3))),
        rng.uniform(0.2, 0.9, 4),
    )  # fmt: skip
    return [torch.tensor(v, dtype=dtype, requires_grad=True) for v in values]


def test_torch_gradcheck_passes_and_a_planted_wrong_adjoint_fails(monkeypatch):
    torch = pytest.importorskip("torch")
    from warprrf.geometry.splats import torch_functions as interop

    smooth = Blending(alpha_min=1e-12, alpha_max=1.0, transmittance_min=1e-12)
    values = scene(torch, 0, torch.float64)
    start, end = np.array([[-4.0, 0.1, 0.2], [0.3, -4.0, 0.1]]), np.array([[4.0, 0, 0], [0.1, 4.0, 0.3]])

    def passed(*v):
        return interop.ray_transmittance(*v, start, end, blending=smooth)

    def hits(*v):
        return interop.ray_hits(*v, start, end - start, 4, blending=smooth)[1:]

    assert (hits(*values)[0] < 10).all()  # all places are taken: no infinity meets gradcheck
    for function in (passed, hits):
        assert torch.autograd.gradcheck(function, values, eps=1e-6, atol=1e-7, rtol=1e-6)
    Function = interop._Rays
    right = Function.backward

    def wrong(ctx, *incoming):
        out = list(right(ctx, *incoming))
        out[2] = out[2] * (1 + 1e-4)
        return tuple(out)

    monkeypatch.setattr(Function, "backward", staticmethod(wrong))
    for function in (passed, hits):
        with pytest.raises(RuntimeError, match="Jacobian mismatch"):
            torch.autograd.gradcheck(function, values, eps=1e-6, atol=1e-7, rtol=1e-6)


def test_torch_second_backward_and_reused_gradients_behave():
    torch = pytest.importorskip("torch")
    from warprrf.geometry.splats import torch_functions as interop

    values = scene(torch, 1, torch.float32)
    index, t, alpha, weight, left = interop.ray_hits(*values, [-4, 0, 0], [[1, 0, 0], [1, 0.1, 0]], 3)
    assert index.dtype == torch.int32 and weight.dtype == torch.float32 and not index.requires_grad
    incoming = torch.ones_like(weight)
    torch.autograd.backward(weight, incoming, retain_graph=True)
    once = [v.grad.clone() for v in values]
    torch.autograd.backward(weight, incoming)
    assert torch.equal(incoming, torch.ones_like(weight))
    for v, first in zip(values, once, strict=True):
        assert first.abs().max() > 0
        assert torch.equal(v.grad, 2 * first)


def test_torch_refuses_what_the_rasteriser_refuses():
    torch = pytest.importorskip("torch")
    from warprrf.geometry.splats import torch_functions as interop

    values = scene(torch, 1, torch.float32)
    values[2] = torch.zeros(4, 3)
    with pytest.raises(ValueError, match=r"^scales:"):
        interop.ray_transmittance(*values, [0, 0, 0], [1, 0, 0])
    values[2] = torch.ones(4, 3)
    with pytest.raises(ValueError, match=r"^b:.*NaN"):
        interop.ray_transmittance(*values, [0, 0, 0], [1, 0, float("nan")])
