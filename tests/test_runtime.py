"""Warp starts without a word on a machine without a GPU, and works where its cache of kernels cannot be written."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp
from places import ROOT
from warp._src import context

from warprrf import device


def _started(cache):
    code = (
        "from warprrf.device import resolve; import warp; resolve('cpu'); print(warp.config.kernel_cache_dir)"
    )
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300, check=True,
        env={**os.environ, "WARP_CACHE_PATH": str(cache)},
    )  # fmt: skip


def test_nothing_is_said_at_a_start_without_a_gpu(tmp_path):
    done = _started(tmp_path)
    assert done.stderr == "" and done.stdout.startswith(str(tmp_path))


def test_kernels_go_to_a_temporary_folder_where_the_cache_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    done = _started(tmp_path / "file" / "cache")
    for word in ("UserWarning: kernel cache: ", str(tmp_path / "file" / "cache"), "WARP_CACHE_PATH"):
        assert word in done.stderr
    assert "warprrf-kernels-" in done.stdout
    assert not Path(done.stdout.strip()).exists()  # it is gone with the process


def test_a_module_that_cannot_be_kept_in_the_cache_is_compiled_elsewhere(monkeypatch, tmp_path):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(device, "_temporary", [])

    class Module:
        folders: tuple[str, ...] = ()

        def load(self, device, block_dim):
            self.folders += (wp.config.kernel_cache_dir,)
            if len(self.folders) == 1:
                raise PermissionError(13, "Permission denied", str(tmp_path))

    module = Module()
    with pytest.warns(UserWarning, match=rf"kernel cache: .*{tmp_path}.*WARP_CACHE_PATH"):
        device.load_module(module, "cpu", 1)
    first, second = module.folders
    assert first == str(tmp_path) and Path(second).is_dir() and "warprrf-kernels-" in second


def test_other_words_on_standard_error_are_kept(capfd):
    with device._without_cuda_warning():
        warning = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. None.\n"
        os.write(2, b"before\n" + warning + b"after\n")
    os.write(2, b"later\n")
    assert capfd.readouterr().err == "before\nafter\nlater\n"


WITHOUT_GPU = {
    "without CUDA": {"is_cuda_enabled": False},
    "no NVIDIA driver was found.*driver 580 or later": {"driver_version": None},
    r"driver is too old, of CUDA 12\.8.*driver 580 or later, of CUDA 13\.0": {"driver_version": (12, 8)},
    "no card: nvidia-smi": {"driver_version": (13, 0)},
}


@pytest.mark.parametrize("name", ["cuda", "cuda:0"])
@pytest.mark.parametrize(("why", "found"), WITHOUT_GPU.items(), ids=["build", "driver", "old driver", "card"])
def test_why_there_is_no_gpu_is_said(why, found, name, monkeypatch):
    device.start()
    runtime = context.runtime
    for key, value in {"is_cuda_enabled": True, "min_driver_version": (13, 0), **found}.items():
        monkeypatch.setattr(runtime, key, value)
    monkeypatch.setattr(runtime, "device_map", {"cpu": runtime.cpu_device})
    monkeypatch.setattr(runtime, "cuda_devices", [])
    with pytest.raises(ValueError, match=rf"device: got '{name}', expected one of cpu; .*{why}"):
        device.resolve(name)
    with pytest.raises(ValueError, match=r"device: got 'gpu', expected one of cpu$"):
        device.resolve("gpu")


def test_a_driver_that_is_too_old_is_warned_of(monkeypatch):
    """Once, when Warp starts: without an error, as a CPU is there."""
    device.start()
    monkeypatch.setattr(context.runtime, "driver_version", (12, 8))
    monkeypatch.setattr(context.runtime, "min_driver_version", (13, 0))
    with pytest.warns(UserWarning, match="there is a CPU alone; the NVIDIA driver is too old"):
        device.start.__wrapped__()
