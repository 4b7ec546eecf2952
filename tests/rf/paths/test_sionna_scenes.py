"""Sionna RT's own scenes: all open, and in the small ones every path of PathSolver's is found, with its delay and gain."""

import numpy as np
import pytest
from sionna_room import placed

import warprrf as wr
from warprrf.rf.paths.path_set import Paths

F = 3.5e9
ALL = (
    "box", "box_knife", "box_one_screen", "box_two_screens", "floor_wall", "simple_reflector", "double_reflector",
    "triple_reflector", "simple_wedge", "simple_street_canyon", "simple_street_canyon_with_cars", "etoile", "munich",
    "florence", "san_francisco",
)  # fmt: skip
PLACES = {
    "box": ((0.5, -0.8, 1.9), (2.1, 1.3, 3.3), (-1.7, 2.2, 4.1)),
    "box_one_screen": ((2.5, -0.8, 1.9), (2.1, 1.3, 3.3), (-2.7, 2.2, 4.1), (-3.1, 4.0, 0.7)),
    "simple_wedge": ((8.0, 9.0, 1.0), (20.0, 4.0, -3.0), (-6.0, 12.0, 2.0), (-9.0, -3.0, 0.5)),
    "double_reflector": ((0.0, 0.3, 0.5), (0.4, -0.1, 0.6), (0.1, 0.1, 1.2)),
    "triple_reflector": ((-9.0, 0.3, 4.0), (9.0, 0.2, 5.0), (3.0, -0.6, 1.2)),
    "simple_street_canyon": ((-33.0, 0.0, 32.0), (10.0, 3.0, 1.5), (-20.0, -4.0, 1.5), (40.0, 0.0, 1.5)),
}
"""Transmitter, then receivers [m]."""


@pytest.mark.parametrize("name", PLACES)
def test_every_path_of_path_solver_is_found(name, rt):
    transmitter, *receivers = PLACES[name]
    path = getattr(rt.scene, name)
    live = rt.load_scene(path, merge_shapes=False)
    live.frequency = F
    placed(rt, live, transmitter, receivers)
    solved = rt.PathSolver()(live, max_depth=2, synthetic_array=True, refraction=False, seed=1)
    theirs = Paths.from_sionna(solved, frequency_hz=F, drop_repeated=True)
    scene = wr.Scene.load(path)
    ours = wr.trace_paths(scene, transmitter=transmitter, receivers=receivers, frequency_hz=F, mirror_order=2)
    assert theirs.valid.sum() >= 4
    for r in range(len(receivers)):
        a, b = theirs[r], ours[r]
        gap = 3e8 * np.abs(a.tau[:, None] - b.tau) + np.linalg.norm(a.arrival[:, None] - b.arrival, axis=2)
        same = gap.argmin(axis=1)
        assert len(set(same)) == len(same)
        assert np.abs(a.tau - b.tau[same]).max() < 1e-11  # PathSolver's float32 at tens of metres
        assert np.abs(10 * np.log10(a.power / b.power[same])).max() < 0.05


@pytest.mark.parametrize("name", ALL)
def test_all_scenes_of_sionna_open(name, rt):
    for material in wr.Scene.load(getattr(rt.scene, name)).materials:
        assert material.itu in {"metal", "glass", "concrete", "marble", "wood", "brick"}
        assert np.isfinite(material.permittivity(F))
