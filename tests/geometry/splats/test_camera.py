"""Cameras: pixel grids, poses, and that projecting a direction finds its pixel."""

from dataclasses import replace

import numpy as np
import pytest
from views import look

from warprrf.geometry.splats.camera import Camera

ALONG_X = replace(look([1.0, 2.0, 3.0], [2, 2, 3], f=50.0), fy=60.0, cx=30.0, cy=20.0)


def test_spherical_grid_is_the_stated_one():
    d = Camera.spherical(180, 90, position=(1, 2, 3)).directions()
    zenith, azimuth = (0 + 0.5) * np.pi / 90, -np.pi + (10 + 0.5) * 2 * np.pi / 180
    expected = [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)]
    assert np.allclose(d[0, 10], expected, atol=1e-15)
    assert np.allclose(np.linalg.norm(d, axis=2), 1)


@pytest.mark.parametrize("camera", [ALONG_X, Camera.spherical(40, 20, position=(1, 2, 3))])
def test_projection_inverts_directions(camera):
    points = camera.position + 2.5 * camera.directions().reshape(-1, 3)
    uv, _ = camera.project(points)
    v, u = np.meshgrid(np.arange(camera.height) + 0.5, np.arange(camera.width) + 0.5, indexing="ij")
    assert np.allclose(uv, np.stack([u, v], axis=-1).reshape(-1, 2), atol=1e-9)


def test_a_point_is_in_frame_by_its_pixel_in_front_and_deep_enough():
    c = ALONG_X
    points = c.position + 2.5 * c.directions()
    inside, pixel = c.in_frame(points.reshape(-1, 3))
    assert inside.all()
    assert np.array_equal(pixel, np.argwhere(np.ones((c.height, c.width))))
    behind = 2 * c.position - points.reshape(-1, 3)
    assert not c.in_frame(behind)[0].any()
    u, v = (
        np.array([-0.1, 0.1, c.width - 0.1, c.width + 0.1, 5.0, 5.0]),
        np.array([9.0] * 4 + [-0.1, c.height + 0.1]),
    )
    local = 2.0 * np.column_stack([(u - c.cx) / c.fx, (v - c.cy) / c.fy, np.ones(6)])
    inside, pixel = c.in_frame(local @ c.rotation + c.position)
    assert inside.tolist() == [False, True, True, False, False, False]
    assert pixel.tolist() == [[0, 0], [9, 0], [9, c.width - 1], [0, 0], [0, 0], [0, 0]]
    deep = [c.in_frame(local[1:2] @ c.rotation + c.position, nearest_m)[0][0] for nearest_m in (1.9, 2.1)]
    assert deep == [True, False]


def test_a_panorama_has_a_pixel_for_every_direction():
    c = Camera.spherical(40, 20, position=(1, 2, 3))
    inside, pixel = c.in_frame(c.position + [[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0, 0, 0]])
    assert inside.tolist() == [True, True, True, False]
    assert pixel[:3].tolist() == [[10, 39], [19, 20], [0, 20]]


def test_a_camera_stays_where_its_caller_goes_on_with_the_pose():
    pose = np.eye(4)
    camera = Camera.pinhole(4, 3, fx=5, fy=5, cx=2, cy=1, world_to_camera=pose)
    pose[0, 3] = 7.0
    assert camera.position.tolist() == [0, 0, 0]


def test_opencv_axes_and_position():
    assert np.allclose(ALONG_X.position, [1, 2, 3])
    assert np.array_equal(ALONG_X.rotation, [[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    uv, depth = ALONG_X.project([[2.0, 2.0, 3.0], [2.0, 1.9, 2.9], [0.0, 2.0, 3.0]])
    assert np.allclose(uv[0], [30, 20]) and depth[0] == pytest.approx(1)
    assert (uv[1] > uv[0]).all()  # right is -y, down is -z
    assert np.isnan(uv[2]).all()  # behind


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"world_to_camera": np.diag([-1.0, 1, 1, 1])}, "^world_to_camera.*not a rotation"),
        ({"world_to_camera": np.diag([1.0, 1, 1, 2])}, "^world_to_camera.*last row"),
        ({"kind": "spherical", "fx": 0, "fy": 0, "cx": 0, "cy": 0}, "^world_to_camera.*turned"),
    ],
)
def test_no_way_of_building_a_camera_takes_nonsense(change, complaint):
    turned = np.diag([-1.0, -1, 1, 1])
    lens = {"kind": "pinhole", "width": 4, "height": 3, "fx": 5, "fy": 5, "cx": 2, "cy": 1}
    Camera(**lens, world_to_camera=turned)
    with pytest.raises(ValueError, match=complaint):
        Camera(**{**lens, "world_to_camera": turned, **change})
