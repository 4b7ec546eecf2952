"""Fixtures of more than one folder."""

import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

sys.path[:0] = [
    str(Path(__file__).parent / "helpers"),
    str(Path(__file__).parent),
    str(Path(__file__).parent.parent),
]
import ptx  # noqa: E402

import warprrf.device  # noqa: E402


def pytest_addoption(parser):
    parser.addoption(
        "--pretend-cuda",
        action="store_true",
        help="run the library's kernels as compiled for CUDA, on the CPU; what asks for Embree fails",
    )


@contextmanager
def _pretending(order=None):
    launched = []

    def stand_in(kernel, dim, inputs, *, adjoint):
        launched.append(kernel.key.split("__locals__")[-1] + ("_adjoint" if adjoint else ""))
        ptx.launch(kernel, dim, inputs, adjoint=adjoint, order=order)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(warprrf.device, "_stand_in", stand_in)
        yield launched


@pytest.fixture
def pretended_cuda():
    """A context in which every device passes for CUDA: kernels run as compiled for it, on arrays in CPU memory.

    ``with pretended_cuda(order=...) as launched:`` gives a list that fills with the names of the kernels launched;
    ``order`` is that of :func:`ptx.launch`.
    """
    return _pretending


@pytest.fixture(scope="session", autouse=True)
def _everything_on_pretended_cuda(request):
    if not request.config.getoption("--pretend-cuda"):
        yield
        return
    with _pretending():
        yield


@pytest.fixture(autouse=True)
def _compiled_for(request):
    """The parameter that `on_cuda_too` gives a test."""
    if getattr(request, "param", "cpu") == "cpu":
        yield
        return
    with _pretending() as launched:
        yield
    assert launched, "the test launched no kernel: it needs no on_cuda_too"


def pytest_generate_tests(metafunc):
    if metafunc.definition.get_closest_marker("on_cuda_too"):
        metafunc.parametrize("_compiled_for", ["cpu", "cuda"], indirect=True)
