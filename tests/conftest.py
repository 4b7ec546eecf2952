"""Fixtures of more than one folder."""

import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import ptx  # noqa: E402

import warprrf.device  # noqa: E402


@pytest.fixture
def pretended_cuda(monkeypatch):
    """A context in which every device passes for CUDA: kernels run as compiled for it, on arrays in CPU memory.

    ``with pretended_cuda(order=...) as launched:`` gives a list that fills with the kernels launched.
    """

    @contextmanager
    def pretend(order=None):
        launched = []

        def stand_in(kernel, dim, inputs, *, adjoint):
            launched.append(kernel.key.split(".")[-1] + ("_adjoint" if adjoint else ""))
            ptx.launch(kernel, dim, inputs, adjoint=adjoint, order=order)

        with monkeypatch.context() as patch:
            patch.setattr(warprrf.device, "_stand_in", stand_in)
            yield launched

    return pretend
