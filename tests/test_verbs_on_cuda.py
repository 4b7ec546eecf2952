"""Every public verb that launches anything launches it on a GPU, where one is preferred: no verb is left to the CPU there,
and none has never run on one."""

import pytest
import warp as wp
from fuzz import calls
from fuzz.place import Place

OF_A_MESH = {"find_overlaps", "lie_in_patches"}
"""Kernels of planar patches, which are found on the CPU, once a mesh."""
NOTHING_THERE = {"Mesh.on_device", "RadioField.load", "HarmonicField.load", "splats.Rasterizer"}
"""What takes a device to keep it, or to put arrays there."""
ON_A_CPU_ALONE = {"Reconstruction.from_files", "BistaticField.prior"}
"""What launches nothing but these kernels."""


@pytest.mark.cuda
@pytest.mark.parametrize("device", ["cuda:0"], indirect=True)
def test_every_verb_launches_where_it_is_asked_to(place, device, tmp_path, monkeypatch):
    """`reconstruct`, whose example is refused, is not among them: tests/geometry launches its steps."""
    monkeypatch.chdir(tmp_path)
    launched, launch = [], wp.launch

    def noted(kernel, *args, **kwargs):
        launched.append((wp.get_device(kwargs.get("device")).alias, kernel.func.__name__))
        return launch(kernel, *args, **kwargs)

    monkeypatch.setattr(wp, "launch", noted)
    there, silent = Place(place.folder, device), set()
    for name in calls.public().keys() - set(calls.REFUSED):
        arguments = calls.example(name, there)
        launched.clear()
        try:
            calls.call(name, arguments)
        except ImportError as error:
            if 'pip install "warprrf[' not in str(error):
                raise
            continue  # an optional package that this machine with a GPU lacks
        astray = {kernel for where, kernel in launched if where != device} - OF_A_MESH
        assert not astray, f"{name}: launched on the CPU"
        takes_a_device = any(p.name == "device" for p in calls.signature(name))
        if takes_a_device and not any(where == device for where, _ in launched):
            silent.add(name)
    assert silent == NOTHING_THERE | ON_A_CPU_ALONE
