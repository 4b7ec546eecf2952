"""Fixtures of more than one folder."""

import fcntl
import os
import sys
from contextlib import contextmanager, nullcontext
from functools import partialmethod
from pathlib import Path
from unittest import mock

import pytest
import warp as wp
from hypothesis import settings

settings.register_profile("any machine", deadline=None)  # a busy one is no defect
settings.load_profile("any machine")
HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "helpers"), str(HERE), str(HERE.parent)]

from second_device import second_device

LONGEST = (
    "viewer/test_viewer.py", "fuzz/test_fuzz.py", "test_concurrency.py", "test_cluster.py", "test_notebooks.py",
    "geometry/test_reconstruction.py", "geometry/photos/surface/test_completion.py", "rf/fields/bistatic/test_locate.py",
    "rf/test_against_mitsuba.py", "rf/relevance/test_relevance.py", "test_office.py", "rf/interop/test_sionna_engine.py",
    "rf/fields/test_batches.py", "rf/fields/bistatic/test_shapes.py", "test_verbs_on_cuda.py", "test_output.py",
    "test_cuda_kernels.py", "test_package.py", "benchmarks/test_baselines.py", "rf/fields/bistatic/test_field.py",
    "rf/fields/bistatic/test_readings.py", "geometry/photos/posed/test_sfm.py", "benchmarks/test_evaluation.py",
    "benchmarks/test_filmed.py", "benchmarks/test_pipeline.py", "test_invariances.py", "benchmarks/test_fits.py",
)  # fmt: skip
"""Files of twenty seconds and more. Workers take whole files, these first, so that none is left alone with one at the end."""


def pytest_collection_modifyitems(items):
    place = {HERE / name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(LONGEST)))


def pytest_addoption(parser):
    parser.addoption("--on", default="cpu", help="the device of tests that name none (default: %(default)s)")


@contextmanager
def _preferred(on):
    """A device that arrays of others are refused on: a GPU, or where none is at hand a second CPU device that the library
    takes for one."""
    strict = mock.patch.object(wp.config, "launch_array_access_mode", wp.config.LaunchArrayAccessMode.STRICT)
    with strict, nullcontext() if wp.is_cuda_available() else second_device(), wp.ScopedDevice(on):
        yield


@pytest.fixture(scope="session", autouse=True)
def _preferred_device(request):
    """That of `--on`, of what many tests share too."""
    on = request.config.getoption("--on")
    with nullcontext() if on == "cpu" else _preferred(on):
        yield


@pytest.fixture(autouse=True)
def _default_device(request, _preferred_device):
    """Tests that name no device run on the CPU, where a GPU is at hand too; those that ask for a GPU get one."""
    if request.config.getoption("--on") != "cpu":
        yield
    elif request.node.get_closest_marker("cuda"):
        with _preferred("cpu"):
            yield
    else:
        with wp.ScopedDevice("cpu"):
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
    """A small room, and files of all kinds that the library makes of it: one for all workers, which only read it."""
    from fuzz.place import Place

    folder = tmp_path_factory.getbasetemp()
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    with (folder / "place.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one makes it, the other waits
        return Place(folder / "place").make()
