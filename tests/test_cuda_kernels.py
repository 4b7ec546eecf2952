"""Every kernel of the library compiles for CUDA, on a machine with a GPU or without.

That they compute the same there is asked by the tests that take the fixture `device`, beside the laws that they hold.
"""

import ast
import importlib
import inspect
import itertools
import pkgutil

import pytest
import warp as wp

import warprrf.kernels

ARCHITECTURE = 75  # the oldest that Warp compiles for
CHOICES = {
    "real": (wp.float32, wp.float64),
    "rule": (0, 1),
    "width": (1, 4),
    "lanes": (1,),  # of a GPU
    "channels": (1, 3),
}  # what builders of kernels are asked for
FOR_A_CPU_ALONE = "warprrf.kernels.raster.blocks"  # a GPU blends by `reference`
EVERY = pkgutil.walk_packages(warprrf.kernels.__path__, "warprrf.kernels.")
MODULES = sorted(m.name for m in EVERY if not m.ispkg and m.name != FOR_A_CPU_ALONE)


def kernels_of(name):
    """Kernels of one module, those that its builders make for both precisions and all rules included."""
    module = importlib.import_module(name)
    found = [*vars(module).values()]
    for builder in (f for key, f in vars(module).items() if key.startswith("build")):
        needed = [p.name for p in inspect.signature(builder).parameters.values() if p.default is p.empty]
        if set(needed) <= set(CHOICES):  # others make functions, which the kernels call
            for arguments in itertools.product(*(CHOICES[p] for p in needed)):
                made = builder(*arguments)
                found += [made] if isinstance(made, wp.Kernel) else vars(made).values()
    return [k for k in found if isinstance(k, wp.Kernel) and k.func.__module__ == name]


def test_kernels_are_looked_for_where_they_are():
    assert "cast_rays" in {k.func.__name__ for k in kernels_of("warprrf.kernels.rays.mesh")}
    assert {"warprrf.kernels.rays.mesh", "warprrf.kernels.raster.reference"} <= set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_kernels_compile_for_cuda(name, tmp_path):
    kernels, tree = kernels_of(name), ast.parse(inspect.getsource(importlib.import_module(name)))
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    in_source = {f.name for f in functions if any("wp.kernel" in ast.unparse(d) for d in f.decorator_list)}
    assert {k.func.__name__ for k in kernels} == in_source  # none is missed
    for module in {k.module for k in kernels}:
        paths = wp.compile_aot_module(module, arch=ARCHITECTURE, use_ptx=True, module_dir=tmp_path)
        text = "".join(path.read_text() for path in paths)
        assert all(f".entry {k.key}" in text.replace(".visible", "") for k in kernels if k.module is module)
