"""Up, floor and scale where nobody surveyed."""

from dataclasses import replace

import numpy as np
import pytest
from places import LOBBY
from views import lobby_cameras

import warprrf as wr
from warprrf.geometry.photos.posed import sparse
from warprrf.geometry.photos.posed.photo_files import read_photo
from warprrf.geometry.photos.posed.upright import held_up, upright, vertical_of_edges

EMPTY = np.zeros(0, dtype=np.int64)


@pytest.fixture(scope="module")
def lobby():
    """Twelve true cameras of the lobby, and points that each sees on the true mesh."""
    cameras = lobby_cameras([f"view_{k:03d}.jpg" for k in range(0, 120, 10)])
    mesh = wr.Scene.load(LOBBY / "scene.xml").mesh
    points = []
    for camera in cameras.values():
        towards = camera.directions()[4::20, 4::20].reshape(-1, 3)
        hit = mesh.cast(np.broadcast_to(camera.position, towards.shape), towards)
        points.append(hit.point[hit.valid])
    count = [len(p) for p in points]
    xyz = np.concatenate(points) + 0.003 * np.random.default_rng(0).standard_normal((sum(count), 3))
    length = np.full(len(xyz), 3)  # each counts as seen by its own camera and two that are told too
    own = np.repeat(np.repeat(np.arange(len(cameras)), count), 3)
    return sparse.SparseModel(cameras, xyz, np.ones((len(xyz), 3)), np.zeros(len(xyz)), length, own)


@pytest.fixture(scope="module")
def lost(lobby):
    """The same in units and axes of their own."""
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    return lobby.transformed(scale=0.13, rotation=turn * np.linalg.det(turn), shift=[3.0, -2.0, 1.0])


def read(name):
    return read_photo(LOBBY / "photos" / name)


def test_the_lobby_stands_upright_on_its_floor_in_metres_without_survey(lobby, lost):
    first, last = list(lobby.cameras)[0], list(lobby.cameras)[-1]
    apart = np.linalg.norm(lobby.cameras[first].position - lobby.cameras[last].position)
    out = upright(sparse.scaled(lost, (first, last, float(apart))), read)
    assert out.metric and out.upright and out.guessed == ()
    mine, true = (np.array([c.position for c in m.cameras.values()]) for m in (out, lobby))
    scale, rotation, shift = sparse.fit_similarity(mine, true)
    assert scale == pytest.approx(1.0, rel=1e-9)
    assert np.degrees(np.arccos(min(rotation[2, 2], 1.0))) < 1.0
    assert abs(shift[2]) < 0.05
    assert np.abs(mine[:, :2].mean(axis=0)).max() < 1e-9


def test_vertical_edges_say_where_up_is(lost, lobby):
    up, proven = vertical_of_edges(lost.cameras, read)
    mine, true = (np.array([c.position for c in model.cameras.values()]) for model in (lost, lobby))
    turned = sparse.fit_similarity(mine, true)[1] @ up
    assert proven and np.degrees(np.arccos(turned[2])) < 1.0


def test_what_photos_do_not_show_is_said_to_be_guessed(lost):
    bare = replace(lost, points=np.zeros((0, 3)), colors=np.zeros((0, 3)), reprojection_error=np.zeros(0),
                   track_length=EMPTY, track_camera=EMPTY)  # fmt: skip
    plausible = sparse.assume_scale(lost)
    seen_from = np.array([c.position for c in plausible.cameras.values()])[plausible.track_camera[::3]]
    assert np.median(np.linalg.norm(plausible.points - seen_from, axis=1)) == pytest.approx(3.0)
    out = upright(sparse.assume_scale(bare), lambda name: np.full((48, 64, 3), 0.5, dtype=np.float32))
    assert [text.split(":")[0] for text in out.guessed] == ["scale", "up", "floor"] and not out.metric
    np.testing.assert_allclose(held_up(list(out.cameras.values())), [0, 0, 1], atol=1e-9)


def test_noise_proves_no_vertical(lost):
    rng = np.random.default_rng(0)
    held, proven = vertical_of_edges(lost.cameras, lambda name: rng.random((120, 160, 3), dtype=np.float32))
    assert not proven


@pytest.mark.parametrize(
    "scale, message",
    [
        (("view_000.jpg", "view_010.jpg", 0.0), "distance in metres"),
        (("view_000.jpg", "view_000.jpg", 1.0), "twice"),
        (("view_000.jpg", "gone.jpg", 1.0), "no pose was found for gone.jpg"),
        (("view_000.jpg", "view_110.jpg", 1.0), "at one place"),
    ],
)
def test_a_scale_that_says_nothing_is_refused(lost, scale, message):
    cameras = lost.cameras | {"view_110.jpg": lost.cameras["view_000.jpg"]}
    with pytest.raises(ValueError, match=message):
        sparse.scaled(replace(lost, cameras=cameras, unposed=("gone.jpg",)), scale)
