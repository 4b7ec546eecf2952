"""What is measured on a GPU runs without one, in tiny sizes."""

import pytest
import warp as wp

from benchmarks import gpu
from benchmarks.runner import Job


def test_without_a_gpu_every_part_runs_in_tiny_sizes(monkeypatch, tmp_path, capsys):
    found = {}

    def here(name, device, dry):
        assert dry and device == "cpu"
        found[name] = gpu.PARTS[name](gpu.DRY, wp.get_device("cpu"))
        return found[name], ""

    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    monkeypatch.setattr(gpu, "_apart", here)
    gpu.run(gpu.Options(parts=tuple(gpu.PARTS)), Job(tmp_path))
    assert "No GPU was measured" in capsys.readouterr().out and not list(tmp_path.iterdir())
    blending = found["blending"]
    assert blending["seconds"] == blending["forward_s"] + blending["backward_s"] > 0
    assert blending["spectrum_s"] > 0 and "over_gsplat" not in blending
    assert found["stage_2"]["receivers"] == gpu.DRY.receivers and found["bistatic"]["spectrum_s"] > 0


def test_a_part_in_its_process_is_told_with_its_error(monkeypatch):
    found, error = gpu._apart("mesh_rays", "cpu", True)
    assert not error and found["cpu_hits_per_s"] > 0 and found["largest_difference_m"] < 1e-4
    found, error = gpu._apart("nothing", "cpu", True)
    assert not found and "KeyError" in error
    monkeypatch.setattr(gpu, "PART_LIMIT_S", 0.1)
    assert gpu._apart("mesh_rays", "cpu", True) == ({}, "stopped after 0 s")


def test_a_part_that_fails_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(gpu, "_apart", lambda *_: ({}, "planted"))
    with pytest.raises(ValueError, match="failed: mesh_rays"):
        gpu.run(gpu.Options(dry=True, parts=("mesh_rays",)), Job(tmp_path))
