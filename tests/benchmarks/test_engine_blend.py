"""The torch renderer and the rasteriser define the same image and the same gradients; torch's rules hold for ours."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from benchmarks.engine import torch_renderer
from benchmarks.engine.blend import blend_figures
from benchmarks.engine.peers import Scene, take_turns
from benchmarks.engine.torch_renderer import render_with_torch
from warprrf.device import threads
from warprrf.geometry.splats import torch_functions as interop
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.rasterizer import Blending


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    """The torch renderer works in several batches, as it does on large scenes."""
    monkeypatch.setattr(torch_renderer, "CHUNK", 1 << 12)


POSE = np.eye(4)
POSE[:3, 3] = (0.1, -0.2, 0.3)
CAMERAS = {
    "pinhole inside": Camera.pinhole(50, 35, fx=25.0, fy=28.0, cx=24.0, cy=19.0, world_to_camera=POSE),
    "spherical": Camera.spherical(50, 25, position=(0.1, -0.2, 0.3)),
}


def tensors(seed, n=80, channels=5, dtype=torch.float64, spread=2.0):
    rng = np.random.default_rng(seed)
    values = (
        rng.uniform(-spread, spread, (n, 3)), rng.normal(size=(n, 4)), np.exp(rng.uniform(-4, -0.5, (n, 3))),
        rng.uniform(0, 1, n), rng.random((n, channels)), rng.random(channels),
    )  # fmt: skip
    return [torch.tensor(v, dtype=dtype, requires_grad=True) for v in values]


def both(values, cam, blending):
    ours = interop.rasterize(*values[:5], cam, values[5], blending=blending)
    peer = render_with_torch(*values[:5], cam, values[5], blending=blending)
    return ours, (peer.features, peer.alpha, peer.depth)


def gradients(images, values, seed=0):
    generator = torch.Generator().manual_seed(seed)
    total = sum(
        (torch.randn(i.shape, generator=generator, dtype=torch.float64).to(i) * i).sum() for i in images
    )
    return torch.autograd.grad(total, values, retain_graph=True)


@pytest.mark.parametrize("rule", ["product", "exp"])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_torch_renderer_and_rasteriser_agree_in_float64(camera, rule):
    values = tensors(1)
    ours, peer = both(values, camera, Blending(rule=rule))
    assert ours[1].max() > 0.8
    for a, b in zip(ours, peer, strict=True):
        assert (a - b).abs().max() < 1e-9 * max(1.0, float(b.detach().abs().max()))
    for a, b in zip(gradients(ours, values), gradients(peer, values), strict=True):
        assert (a - b).abs().max() < 1e-9 * b.abs().max()


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_torch_renderer_and_rasteriser_agree_in_float32(camera):
    # No cutoff to fall on either side of: the images differ by rounding alone.
    smooth = Blending(alpha_min=1e-6, alpha_max=1 - 1e-6, transmittance_min=-0.5)
    values = tensors(2, dtype=torch.float32)
    ours, peer = both(values, camera, smooth)
    for a, b in zip(ours[:2], peer[:2], strict=True):
        assert (a - b).abs().max() < 1e-4
    for a, b in zip(gradients(ours[:2], values), gradients(peer[:2], values), strict=True):
        assert torch.linalg.norm(a - b) < 1e-4 * torch.linalg.norm(b)


def test_torch_gradcheck_passes_and_a_planted_wrong_adjoint_fails(monkeypatch):
    smooth = Blending(alpha_min=1e-12, alpha_max=1.0, transmittance_min=-0.5)
    cam = Camera.spherical(8, 4, position=(0.1, 0.2, 0.05))
    values = tensors(3, n=3, channels=1)
    with torch.no_grad():
        values[0] += 0.4 * values[0].sign()
        values[2].clamp_(min=0.3)

    def function(*v):
        return interop.rasterize(*v[:5], cam, v[5], blending=smooth)

    assert torch.autograd.gradcheck(function, values, eps=1e-6, atol=1e-6, rtol=1e-6)
    Function = interop._Rasterize
    right = Function.backward

    def wrong(ctx, *incoming):
        out = list(right(ctx, *incoming))
        out[4] = out[4] * (1 + 1e-4)
        return tuple(out)

    monkeypatch.setattr(Function, "backward", staticmethod(wrong))
    with pytest.raises(RuntimeError, match="Jacobian mismatch"):
        torch.autograd.gradcheck(function, values, eps=1e-6, atol=1e-6, rtol=1e-6)


def test_colours_of_harmonics_pass_gradcheck():
    generator = torch.Generator().manual_seed(5)
    means = torch.randn((4, 3), generator=generator, dtype=torch.float64, requires_grad=True)
    sh = (0.1 * torch.randn((4, 16, 2), generator=generator, dtype=torch.float64)).requires_grad_()
    cam = Camera.spherical(8, 4, position=(3.0, 0.2, 0.1))
    assert torch.autograd.gradcheck(lambda m, s: interop.colors(m, s, cam), (means, sh), atol=1e-7, rtol=1e-6)


def test_second_backward_and_reused_gradients_behave():
    values = tensors(4, n=20)
    images = interop.rasterize(*values[:5], CAMERAS["spherical"], values[5])
    incoming = [torch.randn(i.shape, dtype=i.dtype) for i in images]
    kept = [i.clone() for i in incoming]
    torch.autograd.backward(images, incoming, retain_graph=True)
    once = [v.grad.clone() for v in values]
    torch.autograd.backward(images, incoming)
    for v, first in zip(values, once, strict=True):
        assert first.abs().max() > 0
        assert torch.allclose(v.grad, 2 * first, rtol=1e-13)
    for a, b in zip(incoming, kept, strict=True):
        assert torch.equal(a, b)


def test_a_second_derivative_is_refused_not_zero():
    values = tensors(4, n=5)
    image = interop.rasterize(*values[:5], CAMERAS["spherical"], values[5])[0]
    (slope,) = torch.autograd.grad(image.square().sum(), values[:1], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


def test_an_input_changed_in_place_before_backward_is_noticed():
    values = tensors(4, n=5)
    image = interop.rasterize(*values[:5], CAMERAS["spherical"], values[5])[0]
    with torch.no_grad():
        values[0] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


def test_an_output_changed_in_place_before_backward_is_noticed():
    image = interop.rasterize(*tensors(4, n=5)[:5], CAMERAS["spherical"])[0]
    loss = image.sum()
    with torch.no_grad():
        image *= 2
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_gradients_are_the_same_whether_all_or_some_are_wanted():
    values = tensors(4, n=20)
    outputs = interop.rasterize(*values[:5], CAMERAS["spherical"], values[5])
    every = torch.autograd.grad(outputs[0].square().sum(), values)
    for k, value in enumerate(values):
        alone = [v if v is value else v.detach() for v in values]
        image = interop.rasterize(*alone[:5], CAMERAS["spherical"], alone[5])[0]
        assert torch.equal(torch.autograd.grad(image.square().sum(), value)[0], every[k])
        assert every[k].abs().max() > 0


@pytest.mark.parametrize(
    ("place", "value", "name"),
    [
        (0, torch.full((5, 3), float("nan")), "means"),
        (1, torch.zeros(5, 4), "quaternions"),
        (2, torch.zeros(5, 3), "scales"),
        (2, torch.full((5, 3), 1e-40), "scales"),
        (2, torch.full((5, 3), float("inf")), "scales"),
        (2, torch.full((5, 3), float("nan")), "scales"),
        (3, torch.full((5,), 1.5), "opacities"),
        (3, torch.ones(4), "opacities"),
        (4, torch.ones(5, 2, dtype=torch.int64), "features"),
        (5, torch.ones(7), "background"),
    ],
)
def test_bad_tensors_are_named(place, value, name):
    values = [v.detach() for v in tensors(0, n=5, dtype=torch.float32)]
    values[place] = value
    with pytest.raises((ValueError, TypeError), match=f"^{name}:"):
        interop.rasterize(*values[:5], CAMERAS["spherical"], values[5])


def test_blend_benchmark_runs_small_and_its_two_images_are_one():
    result = blend_figures(300, 40, 30, repeats=1)
    assert result["image_difference"]["quantile_99.9"] < 1e-4
    assert max(result["gradient_difference"].values()) < 1e-2
    assert result["passing_pairs"] > 1000
    assert [run["threads"] for run in result["runs"]] == sorted({1, threads()})
    for run in result["runs"]:
        assert run["speedup"] == pytest.approx(run["torch"]["seconds"] / run["ours"]["seconds"])
        assert run["ours"]["seconds"] == run["ours"]["forward_s"] + run["ours"]["backward_s"] > 0


def _failing(scene, parameters):
    raise FloatingPointError("planted")


def test_a_renderer_that_fails_in_its_process_is_named(capfd):
    with pytest.raises(RuntimeError, match="^bad: its process ended"):
        take_turns({"bad": _failing}, Scene(10, 8, 8), threads=1, turns=1)
    assert "planted" in capfd.readouterr().err
