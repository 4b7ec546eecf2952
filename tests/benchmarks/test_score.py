"""Scores of a reconstruction, on errors that are put in by hand."""

import numpy as np
import pytest
import views
from radio_scenes import box_mesh

from benchmarks.lobby import score
from warprrf.geometry.mesh import Mesh

LOW, HIGH = np.array([-2.0, -3.0, 0.0]), np.array([2.0, 3.0, 2.5])


def room(low=LOW, high=HIGH, without=()):
    vertices, faces = box_mesh(low, high)
    return Mesh(vertices, np.delete(faces, without, axis=0))


def camera(angle=0.0, position=(0.0, 0.0, 1.2)):
    return views.look(position, np.add(position, [np.cos(angle), np.sin(angle), 0.0]), 80, 60, 50.0)


CAMERAS = [camera(a) for a in np.arange(8) * np.pi / 4]


def test_a_room_too_large_by_3_cm_is_3_cm_off_in_distance_but_not_in_normal():
    result = score.score_mesh(room(LOW - 0.03, HIGH + 0.03), room(), CAMERAS, device="cpu")
    assert result.figures["mesh_distance_median_m"] == pytest.approx(0.03, abs=1e-6)
    assert result.figures["mesh_normal_median_deg"] < 1e-3


def test_a_missing_wall_is_missed_and_incomplete():
    whole = score.score_mesh(room(without=(0, 1)), room(), CAMERAS, device="cpu").figures
    rays = np.concatenate([c.directions().reshape(-1, 3) for c in CAMERAS])
    seen = room().cast(np.repeat([c.position for c in CAMERAS], 4800, axis=0), rays, device="cpu")
    share = np.mean(seen.face < 2)
    assert whole["mesh_missed"] == pytest.approx(share, abs=0.02)
    assert whole["mesh_complete"] == pytest.approx(1 - share, abs=0.03)


def test_camera_errors_count_all_cameras():
    truth = {str(k): camera(0.1 * k, (k, 0.0, 1.0)) for k in range(4)}
    posed = {str(k): camera(0.1 * k, (k, 0.04 * (k == 2), 1.0)) for k in range(4)}
    figures = score.score_cameras(posed, truth)
    assert figures["camera_rms_m"] == pytest.approx(0.02)
    assert figures["camera_max_m"] == pytest.approx(0.04)
    assert figures["cameras_posed"] == figures["cameras_total"] == 4
