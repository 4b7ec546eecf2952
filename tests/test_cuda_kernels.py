"""Every kernel of the library compiles for CUDA to instructions that the tool in tests/ptx knows.

That they compute the same is asked by the tests marked `on_cuda_too`, beside the laws that they hold.
"""

import importlib
import inspect
import itertools
import pkgutil

import ptx
import pytest
import warp as wp
from ptx.parse import parse
from ptx.translate import translate
from warp._src.context import user_modules

import warprrf.kernels

# They arrange rays for Embree, which is a CPU's, in a CPU compiler's vector types.
FOR_A_CPU_ALONE = {"pack_rays", "pick_rays", "place_hits", "pack_segments", "judge_segments"}
# A GPU blends by `blend_pixels` and `pixel_weights`, whose functions are in `warps`.
WITHOUT = {"blend", "weights", "warps"}
MODULES = sorted({m.name for m in pkgutil.iter_modules(warprrf.kernels.__path__)} - WITHOUT)


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
