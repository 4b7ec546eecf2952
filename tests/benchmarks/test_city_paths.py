"""Mirror paths of Sionna RT's scenes: all open; in the small ones every path of PathSolver's is found, with its delay and
gain, and what is extra is a path too."""

from pathlib import Path

import numpy as np
import pytest
from sionna_room import sionna_or_skip

import warprrf as wr
from benchmarks.city_paths import LINKS, compare

SMALL = (
    "box",
    "box_one_screen",
    "simple_wedge",
    "double_reflector",
    "triple_reflector",
    "simple_street_canyon",
)


@pytest.fixture(scope="module")
def scenes():
    """The folder of Sionna RT's scenes."""
    sionna_or_skip()
    import sionna

    return Path(next(iter(sionna.__path__))) / "rt" / "scenes"


@pytest.mark.parametrize("name", SMALL)
def test_every_path_of_path_solver_is_found_and_others_obey_geometry(name, scenes, monkeypatch):
    monkeypatch.setattr("benchmarks.city_paths.MOST_RECEIVERS", 4)
    row = compare(LINKS[name])
    assert row["paths_of_sionna"] >= 4
    assert row["lost"] == [] and row["found"] == row["paths_of_sionna"]
    assert row["delay_error_s"] < row["delay_tolerance_s"] and row["gain_error_db"] < 0.05
    assert row["only_ours_wrong"] == 0
    if row["roofs"]:
        assert row["roofs"]["roofed_refused"] == row["roofs"]["roofed"] > 500
        assert row["roofs"]["open_refused"] == 0 and row["roofs"]["open"] > 500


def test_all_scenes_of_sionna_open(scenes):
    names = {path.name for path in scenes.iterdir() if (path / f"{path.name}.xml").is_file()}
    assert names == LINKS.keys() and len(names) == 15
    for name in sorted(names):
        scene = wr.Scene.load(scenes / name / f"{name}.xml")
        used = {material.itu for material in scene.materials}
        assert used <= {"metal", "glass", "concrete", "marble", "wood", "brick"}
        for material in scene.materials:
            assert np.isfinite(material.permittivity(3.5e9))
