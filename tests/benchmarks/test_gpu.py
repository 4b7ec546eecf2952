"""What is measured on a GPU runs without one, in tiny sizes."""

import pytest
import warp as wp

from benchmarks import gpu


def test_without_a_gpu_every_part_runs_in_tiny_sizes(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    monkeypatch.setattr(gpu, "_apart", lambda name, dry: (gpu.PARTS[name](gpu.DRY, wp.get_device("cpu")), ""))
    assert gpu.main(["--out", str(tmp_path), "--parts", *gpu.PARTS]) == 0
    told = capsys.readouterr().out
    assert "No GPU was measured" in told and not list(tmp_path.iterdir())
    found = gpu.run(tmp_path, dry=True, parts=["blending"])["blending"]
    assert found["seconds"] == found["forward_s"] + found["backward_s"] > 0
    assert found["spectrum_s"] > 0 and "over_gsplat" not in found


def test_a_part_in_its_process_is_told_with_its_error(monkeypatch, tmp_path):
    found, error = gpu._apart("mesh_rays", dry=True)
    assert not error and found["cpu_hits_per_s"] > 0 and found["largest_difference_m"] < 1e-4
    found, error = gpu._apart("nothing", dry=True)
    assert not found and "KeyError" in error
    monkeypatch.setattr(gpu, "PART_LIMIT_S", 0.1)
    assert gpu._apart("mesh_rays", dry=True) == ({}, "stopped after 0 s")


def test_unknown_parts_are_refused():
    with pytest.raises(ValueError, match="parts: got 'nothing'"):
        gpu.run(dry=True, parts=["nothing"])
