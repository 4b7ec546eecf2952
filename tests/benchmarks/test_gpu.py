"""What is measured on a GPU runs without one, in tiny sizes."""

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
