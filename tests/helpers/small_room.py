"""A room of concrete with a block of marble in it, small enough for whole evaluations in a test."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from places import LOBBY
from radio_scenes import box_mesh
from sionna_room import write_xml

import warprrf as wr
from warprrf.geometry.splats.gaussians import discs_on_mesh
from warprrf.rf.simulate import sample_receivers

TRANSMITTER = (0.8, 0.9, 2.2)
SHAPE = (12, 24)


def small_room(folder: Path) -> Path:
    """Scene, its mesh as a reconstruction, and spectra of 10 training and 4 test receivers, in ``folder``."""
    shutil.copy(LOBBY / "materials.json", folder)
    walls = box_mesh([0, 0, 0], [5, 4, 3], inward=True)
    block = box_mesh([2.2, 1.2, -0.01], [3.0, 2.8, 2.6])
    scene = wr.Scene.load(write_xml(folder, {"walls": ("concrete", walls), "block": ("marble", block)}))
    receivers = sample_receivers(scene, 14, clearance=0.2, seed=3)
    ds = wr.simulate(
        scene,
        transmitter=TRANSMITTER,
        receivers=receivers,
        frequency_hz=300e9,
        shape=SHAPE,
        beam_sigma_rad=np.radians(6.0),
        roles=["train"] * 10 + ["test"] * 4,
    )
    assert 0 < np.count_nonzero(ds.line_of_sight[10:]) < 4
    ds.save(folder / "spectra.nc")
    replace(ds.subset([*range(4), *range(10, 14)]), engine="sionna").save(folder / "spectra_sionna.nc")
    wr.Reconstruction(discs_on_mesh(scene.mesh, 800), scene.mesh).save(folder / "reconstruction")
    return folder
