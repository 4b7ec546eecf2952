"""Every kernel of the library compiles for CUDA to instructions that the tool in tests/ptx knows.

That they compute the same is asked by the tests marked `on_cuda_too`, beside the laws that they hold.
"""

import importlib
import inspect
import itertools
import pkgutil

import numpy as np
import ptx
import pytest
import warp as wp
from ptx.parse import parse
from ptx.translate import translate
from warp._src.context import user_modules

import warprrf.kernels
from warprrf.geometry.camera import Camera
from warprrf.geometry.rasterizer import Blending, Rasterizer

# They arrange rays for Embree, which is a CPU's, in a CPU compiler's vector types.
FOR_A_CPU_ALONE = {"pack_rays", "pick_rays", "place_hits", "pack_segments", "judge_segments"}
# A GPU blends by `blend_pixels`.
MODULES = sorted({m.name for m in pkgutil.iter_modules(warprrf.kernels.__path__)} - {"blend"})


def kernels_of(name):
    """Kernels of one module of ``warprrf.kernels``, those of its builders for both precisions and rules included."""
    module = importlib.import_module(f"warprrf.kernels.{name}")
    for builder in (
        f for key, f in vars(module).items() if key.startswith("build") and f.__module__ == module.__name__
    ):
        needed = [p for p in inspect.signature(builder).parameters.values() if p.default is p.empty]
        for arguments in itertools.product(
            *({"real": (wp.float32, wp.float64), "rule": (0, 1)}[p.name] for p in needed)
        ):
            builder(*arguments)
    return [
        k
        for m in list(user_modules.values())
        for k in list(m._get_live_kernels())
        if k.func.__module__ == module.__name__ and k.func.__name__ not in FOR_A_CPU_ALONE
    ]


@pytest.mark.parametrize("name", MODULES)
def test_kernels_compile_for_cuda_to_instructions_that_are_known(name):
    for kernel in kernels_of(name):
        text, _, entries = ptx.compile_kernel(kernel, 256)
        module = parse(text)
        assert entries[0] in module.functions
        for entry in set(entries) & set(module.functions):
            assert translate(module, entry).source


def test_no_kernel_is_missed():
    names = {k.func.__name__ for name in MODULES for k in kernels_of(name)}
    assert {"blend", "blend_adjoint", "project", "cast_rays", "transmit_adjoint", "light_surface"} <= names
    assert not names & FOR_A_CPU_ALONE
    assert len(names) > 55


def rendered(real):
    """A photo and the gradients of what it was made of."""
    random = np.random.default_rng(0)
    n = 60
    arrays = [
        random.normal(size=(n, 3)) + [0, 0, 3.0], random.normal(size=(n, 4)), np.exp(random.normal(-2.0, 0.4, (n, 3))),
        random.uniform(0.05, 0.95, n), random.uniform(size=(n, 3)),
    ]  # fmt: skip
    raster = Rasterizer(device="cpu", blending=Blending(), real=real)
    types = [raster.vector(3), raster.vector(4), raster.vector(3), real, real]
    inputs = [
        wp.array(a, dtype=t, device="cpu", requires_grad=True) for a, t in zip(arrays, types, strict=True)
    ]
    cam = Camera.pinhole(40, 24, fx=30.0, fy=30.0, cx=20.0, cy=12.0, world_to_camera=np.eye(4))
    with wp.Tape() as tape:
        image = raster.rasterize(*inputs, cam)
    image.features.grad.fill_(1.0)
    image.depth.grad.fill_(0.1)
    tape.backward()
    return [image.features.numpy(), image.alpha.numpy(), image.dominant.numpy()], [
        a.grad.numpy() for a in inputs
    ]


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_an_image_does_not_depend_on_the_order_of_threads_and_its_gradient_by_rounding_alone(
    real, pretended_cuda
):
    found = []
    for order in (None, "reversed", 1):
        with pretended_cuda(order=order) as launched:
            found.append(rendered(real))
        assert {"blend", "blend_adjoint", "chain"} <= set(launched)
    for images, gradients in found[1:]:
        for one, other in zip(found[0][0], images, strict=True):
            np.testing.assert_array_equal(one, other)
        for one, other in zip(found[0][1], gradients, strict=True):
            error = np.abs(one - other).max() / np.abs(one).max()
            assert error < (1e-5 if real is wp.float32 else 1e-13)
