"""The engine's benchmark in tiny sizes: its sphere is closed, and its errors move as they must."""

import numpy as np
import pytest
from places import LOBBY

pytest.importorskip("open3d")

from benchmarks.engine import table
from benchmarks.engine.rays import bumpy_sphere
from benchmarks.runner import Job, execute


def test_the_bumpy_sphere_is_closed_wound_outward_and_seen_from_its_middle():
    mesh = bumpy_sphere(5_000)
    assert mesh.is_closed
    assert len(mesh.faces) == pytest.approx(5_000, rel=0.1)
    winding, _ = mesh.crossings([[0.0, 0, 0], [9, 0, 0]], [[0.1, 0.2, 0.3]])
    np.testing.assert_array_equal(winding, [[1], [0]])


def test_the_images_error_is_what_is_put_in():
    reference = np.array([[1.0, 1e-2], [1e-4, 0.0]])
    found = table.error_of(reference * 10**0.1, reference)
    # The floor takes its share where there is little: 1e-6 of the brightest.
    expected = [1.0, 1.0, 10 * np.log10((1e-4 * 10**0.1 + 1e-6) / (1e-4 + 1e-6)), 0.0]
    assert found["error_rms_db"] == pytest.approx(np.sqrt(np.mean(np.square(expected))), rel=1e-3)


def test_more_discs_err_less(tmp_path):
    options = table.Options(
        scene=str(LOBBY / "scene.xml"), gaussians=(500, 10_000), shape=(24, 48), rays=2_000, triangles=1_000,
        repeats=1,
    )  # fmt: skip
    found = execute(table.BENCHMARKS["engine"], options, Job(tmp_path, device="cpu"))
    few, many = found["growth"]
    assert many["error_rms_db"] < 0.5 * few["error_rms_db"]
    assert many["range_error_median_m"] < few["range_error_median_m"] < 1e-3
