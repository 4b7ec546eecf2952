"""Fixtures of more than one folder."""

import sys
from contextlib import nullcontext
from functools import partialmethod
from pathlib import Path

import pytest
import warp as wp
from hypothesis import settings

settings.register_profile("any machine", deadline=None)  # a busy one is no defect
settings.load_profile("any machine")
HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "helpers"), str(HERE), str(HERE.parent)]

from second_device import second_device


def pytest_addoption(parser):
    parser.addoption("--on", default="cpu", help="the device of tests that name none (default: %(default)s)")


@pytest.fixture(autouse=True)
def _default_device(request, monkeypatch):
    """Tests that name no device run on the CPU, where a GPU is at hand too. Where none is, those that ask for one get a
    second CPU device that the library takes for one. Arrays of the other device are refused there."""
    on = request.config.getoption("--on")
    if on == "cpu" and not request.node.get_closest_marker("cuda"):
        with wp.ScopedDevice("cpu"):
            yield
        return
    monkeypatch.setattr(wp.config, "launch_array_access_mode", wp.config.LaunchArrayAccessMode.STRICT)
    with nullcontext() if wp.is_cuda_available() else second_device(), wp.ScopedDevice(on):
        yield


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def device(request, monkeypatch, _default_device):
    """Warp's default device while a test runs: the CPU, and again a GPU or what stands for one. Kernels must run there."""
    launched, launch = [], wp.launch

    def counted(kernel, *args, **kwargs):
        launched.append(wp.get_device(kwargs.get("device")).alias)
        return launch(kernel, *args, **kwargs)

    monkeypatch.setattr(wp, "launch", counted)
    with wp.ScopedDevice(request.param):
        yield request.param
    assert request.param in launched, (
        f"nothing was launched on {request.param}: this test says nothing about it"
    )


@pytest.fixture(params=["blocks", "reference"])
def each_form(request, monkeypatch):
    """The rasteriser in each of its forms: blocks of pixels, and a thread per pixel as on a GPU."""
    from warprrf.geometry.splats.rasterizer import Rasterizer

    made = partialmethod(Rasterizer.__init__, per_pixel=request.param == "reference")
    monkeypatch.setattr(Rasterizer, "__init__", made)


@pytest.fixture(scope="session")
def lobby_scene():
    """The lobby with its true materials."""
    from places import LOBBY

    from warprrf import Scene

    return Scene.load(LOBBY / "scene.xml")


@pytest.fixture(scope="session")
def place(tmp_path_factory):
    """A small room, and files of all kinds that the library makes of it."""
    from fuzz.place import Place

    return Place(tmp_path_factory.mktemp("fuzz") / "place").make()
