"""Every kernel of the library compiles for CUDA, on a machine with a GPU or without, to no worse code than it did.

That they compute the same there is asked by the tests that take the fixture `device`, beside the laws that they hold.
"""

import ast
import importlib
import inspect
import json

import pytest
from cuda_code import HOT, MODULES, TABLE, Code, compiled, kernels_of, translated

MORE = 1.15  # of registers and instructions: another Warp changes them by a few per cent, a ruined kernel by more


def test_kernels_are_looked_for_where_they_are():
    assert "cast_rays" in kernels_of("warprrf.kernels.rays.mesh")
    assert {"warprrf.kernels.rays.mesh", "warprrf.kernels.raster.reference"} <= set(MODULES)
    written = json.loads(TABLE.read_text())["kernels"]
    assert {name: set(labels) for name, labels in HOT.items()} == {k: set(v) for k, v in written.items()}


SOURCES = {name: inspect.getsource(importlib.import_module(name)) for name in MODULES}
BOTH = [name for name, source in SOURCES.items() if "real: type" in source and "wp.kernel" in source]
DOUBLE = [pytest.param(name, True, marks=pytest.mark.long) for name in BOTH]
"""The same code in float64, which a CPU runs in other tests."""


@pytest.mark.parametrize(("name", "double"), [*((name, False) for name in MODULES), *DOUBLE])
def test_kernels_compile_for_cuda_and_do_not_get_worse(name, double, tmp_path):
    """Figures are those of tests/golden/cuda_kernels.json: `python tests/helpers/cuda_code.py` writes it anew."""
    every, tree = kernels_of(name), ast.parse(SOURCES[name])
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    in_source = {f.name for f in functions if any("wp.kernel" in ast.unparse(d) for d in f.decorator_list)}
    assert {k.func.__name__ for k in every.values()} == in_source  # none is missed
    kernels = {label: kernel for label, kernel in every.items() if ("float64" in label) == double}
    assert kernels or not in_source
    if double or name not in HOT:
        assert translated(kernels, tmp_path) == kernels.keys()
        return
    code = compiled(kernels, tmp_path)
    assert code.keys() == kernels.keys()
    for label, figures in json.loads(TABLE.read_text())["kernels"][name].items():
        now, then = code[label], Code(**figures)
        assert now.local_bytes <= then.local_bytes, f"{label}: arrays or registers went to memory"
        assert now.registers <= MORE * then.registers, label
        assert now.instructions <= MORE * then.instructions, label
