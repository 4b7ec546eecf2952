"""The rasteriser and rays through Gaussians as functions of PyTorch: the image of `render`, and autograd's rules."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warprrf.geometry.splats import torch_functions as interop
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import Blending
from warprrf.geometry.splats.render import render

CAMERA = Camera.spherical(50, 25, position=(0.1, -0.2, 0.3))
SMOOTH = Blending(alpha_min=1e-12, alpha_max=1.0, transmittance_min=1e-12)
START, END = np.array([[-4.0, 0.1, 0.2], [0.3, -4.0, 0.1]]), np.array([[4.0, 0, 0], [0.1, 4.0, 0.3]])


def tensors(seed, n=20, channels=5, dtype=torch.float64, finest=-4.0):
    rng = np.random.default_rng(seed)
    values = (
        rng.uniform(-2, 2, (n, 3)), rng.normal(size=(n, 4)), np.exp(rng.uniform(finest, -0.5, (n, 3))),
        rng.uniform(0, 1, n), rng.random((n, channels)), rng.random(channels),
    )  # fmt: skip
    return [torch.tensor(v, dtype=dtype, requires_grad=True) for v in values]


def images(values, camera=CAMERA, **options):
    return interop.rasterize(*values[:5], camera, values[5], **options)


def passed(values, **options):
    return interop.ray_transmittance(*values[:4], START, END, **options)


def hits(values, **options):
    index, *found = interop.ray_hits(*values[:4], START, END - START, 4, **options)
    assert index.dtype == torch.int32 and not index.requires_grad
    assert (found[0] < 10).all()  # all places are taken: no infinity meets autograd
    return found


def test_the_image_is_that_of_render():
    values = tensors(1, dtype=torch.float32)
    means, quaternions, scales, opacities, features, background = (v.detach().numpy() for v in values)
    g = Gaussians(means, quaternions, scales, opacities, np.zeros((len(means), 1, 3)))
    expected = render(g, CAMERA, features, background, blending=Blending())
    found = images(values)
    for a, b in zip(found[:2], (expected.features, expected.alpha), strict=True):
        assert a.dtype == torch.float32
        np.testing.assert_allclose(a.detach().numpy(), b, atol=1e-6)


def test_without_gaussians_the_background_is_seen():
    values = [v.detach()[:0] for v in tensors(1)[:5]]
    background = torch.tensor([0.2, 0.3], dtype=torch.float64, requires_grad=True)
    image, alpha, _ = images([*values[:4], torch.zeros((0, 2), dtype=torch.float64), background])
    assert torch.equal(image, background.detach().expand(image.shape)) and not alpha.any()
    image.sum().backward()
    assert (background.grad == CAMERA.width * CAMERA.height).all()
    assert (passed(values) == 1).all()


@pytest.mark.parametrize(("function", "inputs"), [(images, 6), (passed, 4), (hits, 4)])
def test_gradcheck_passes(function, inputs):
    values = tensors(3, n=4, channels=1, finest=-1.0)
    options = {"camera": Camera.spherical(8, 4, position=(0.1, 0.2, 0.05))} if function is images else {}

    def of(*some):
        return function([*some, *values[inputs:]], blending=SMOOTH, **options)

    assert torch.autograd.gradcheck(of, values[:inputs], eps=1e-6, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("size", [0.1, 1.0])  # of the larger ones some are cut off at zero
def test_colours_of_harmonics_pass_gradcheck(size):
    generator = torch.Generator().manual_seed(5)
    means = torch.randn((4, 3), generator=generator, dtype=torch.float64, requires_grad=True)
    sh = (size * torch.randn((4, 16, 2), generator=generator, dtype=torch.float64)).requires_grad_()
    cam = Camera.spherical(8, 4, position=(3.0, 0.2, 0.1))
    assert bool((interop.colors(means, sh, cam) == 0).any()) == (size == 1.0)
    assert torch.autograd.gradcheck(lambda m, s: interop.colors(m, s, cam), (means, sh), atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize(("function", "inputs"), [(images, 6), (hits, 4)])
def test_second_backward_and_reused_gradients_behave(function, inputs):
    values = tensors(4, finest=-2.0)[:inputs]
    found = function(values)
    incoming = [torch.randn(i.shape, dtype=i.dtype) for i in found]
    kept = [i.clone() for i in incoming]
    torch.autograd.backward(found, incoming, retain_graph=True)
    once = [v.grad.clone() for v in values]
    torch.autograd.backward(found, incoming)
    for v, first in zip(values, once, strict=True):
        assert first.abs().max() > 0
        assert torch.allclose(v.grad, 2 * first, rtol=1e-13)
    assert all(torch.equal(a, b) for a, b in zip(incoming, kept, strict=True))


def test_a_second_derivative_is_refused_not_zero():
    values = tensors(4)
    (slope,) = torch.autograd.grad(images(values)[0].square().sum(), values[:1], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


@pytest.mark.parametrize("what", ["input", "output"])
def test_what_is_changed_in_place_before_backward_is_noticed(what):
    values = tensors(4)
    image = images(values)[0]
    loss = image.sum()
    with torch.no_grad():
        {"input": values[0], "output": image}[what].add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_gradients_are_the_same_whether_all_or_some_are_wanted():
    values = tensors(4)
    every = torch.autograd.grad(images(values)[0].square().sum(), values)
    for k, value in enumerate(values):
        alone = [v if v is value else v.detach() for v in values]
        assert torch.equal(torch.autograd.grad(images(alone)[0].square().sum(), value)[0], every[k])
        assert every[k].abs().max() > 0


@pytest.mark.parametrize(
    ("function", "place", "value", "name"),
    [
        (images, 0, torch.full((5, 3), float("nan")), "means"),
        (images, 3, torch.ones(4), "opacities"),
        (images, 4, torch.ones(5, 2, dtype=torch.int64), "features"),
        (passed, 0, torch.full((5, 3), float("nan")), "means"),
        (passed, 2, torch.zeros(5, 3), "scales"),
    ],
)
def test_bad_tensors_are_named(function, place, value, name):
    values = [v.detach() for v in tensors(0, n=5, dtype=torch.float32)]
    values[place] = value
    with pytest.raises((ValueError, TypeError), match=f"^{name}:"):
        function(values)
