"""Mirror paths of Sionna RT's small scenes: every path of PathSolver's is found, and what is extra is a path too."""

import pytest

from benchmarks.city_paths import LINKS, compare


@pytest.mark.parametrize(
    "name", ["simple_street_canyon", "box", "floor_wall", "simple_reflector", "double_reflector"]
)
def test_every_path_of_path_solver_is_found_and_others_obey_geometry(name):
    pytest.importorskip("sionna.rt", reason="Sionna RT is an extra", exc_type=ImportError)
    row = compare(LINKS[name])
    assert row["paths_of_sionna"] >= 4
    assert row["lost"] == [] and row["found"] == row["paths_of_sionna"]
    assert row["length_error_m"] < 1e-4
    assert row["only_ours_wrong"] == 0
