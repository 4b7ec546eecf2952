"""Depth maps made flat, in a box whose walls have a colour each."""

import numpy as np
import views

from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.photos.surface.fusion import _flat
from warprrf.geometry.photos.surface.segments import (
    UNSURE,
    segments_of,
    with_segments,
)

LOW, HIGH = np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.5])
CAMERA = views.look([-0.6, -1.2, 1.2], [0.8, 2.0, 1.0], width=160, height=120, f=110.0)
TRUE = views.range_in_box(CAMERA, LOW, HIGH)
PLACE = CAMERA.position + TRUE[..., None] * CAMERA.directions()
WALL = np.abs(np.concatenate([PLACE - LOW, HIGH - PLACE], axis=-1)).argmin(axis=-1)
COLOURS = [
    [0.8, 0.3, 0.3],
    [0.3, 0.7, 0.3],
    [0.3, 0.3, 0.8],
    [0.7, 0.7, 0.2],
    [0.2, 0.7, 0.7],
    [0.9, 0.9, 0.9],
]
PHOTO = np.array(COLOURS)[WALL]
ALL = np.full(TRUE.shape, True)
RIM = np.zeros_like(ALL)  # what photos prove: near edges of walls
for shift, axis in ((4, 0), (-4, 0), (4, 1), (-4, 1)):
    RIM |= np.roll(WALL, shift, axis) != WALL
BACK = WALL == 4  # what the camera looks at


def flat(depth, proved, shown=ALL, photo=PHOTO):
    return with_segments(depth, proved, shown, segments_of(photo, CAMERA), CAMERA)


def rough(noise=0.01):
    """Depths of the rims alone, with errors."""
    factor = 1 + noise * np.random.default_rng(3).standard_normal(TRUE.shape)
    return np.where(RIM, factor * TRUE, 0.0)


def test_walls_are_whole_and_smooth_where_their_rims_alone_are_known():
    found = flat(rough(), RIM)
    error = np.abs(found / TRUE - 1)
    assert RIM.mean() < 0.4
    assert (found > 0).mean() > 0.95
    assert np.median(error[found > 0]) < 0.003 and np.percentile(error[found > 0], 95) < UNSURE


def test_each_depth_map_is_cut_by_its_own_photo():
    grey, told = np.full_like(PHOTO, 0.5), []
    photos = PosedPhotos([PHOTO, grey], [CAMERA] * 2)
    first, second = _flat([rough()] * 2, [RIM] * 2, [CAMERA] * 2, photos, lambda *step: told.append(step))
    assert (first == flat(rough(), RIM)).all() and (second == flat(rough(), RIM, photo=grey)).all()
    assert (first != second).any()
    assert told == [("segments", k, 2) for k in range(3)]


def test_depths_in_a_strip_fix_no_plane_far_from_it():
    line = np.zeros_like(RIM)
    line[:, 85:95] = BACK[:, 85:95]
    factor = 1 + 0.01 * np.random.default_rng(4).standard_normal(TRUE.shape)
    found = flat(np.where(line, factor * TRUE, 0.0), line)
    far = BACK & (np.abs(np.arange(160) - 90) > 40)
    assert line.sum() > 0.06 * BACK.sum()  # enough pixels, but all in one place
    assert (found[far] == 0).all() and (found[line] > 0).all()


def test_what_stands_before_a_wall_of_its_colour_stays_and_so_does_what_is_masked():
    depth, proved = TRUE.copy(), ALL.copy()
    before = (slice(50, 60), slice(80, 95))
    assert BACK[before].all()
    depth[before] *= 0.7
    masked = ALL.copy()
    masked[:40] = False
    depth[:40] = 9.0
    found = flat(depth, proved & masked, shown=masked)
    np.testing.assert_array_equal(found[before], depth[before])
    np.testing.assert_array_equal(found[:40], 9.0)
    assert (np.abs(found / TRUE - 1)[40:] < 0.01).mean() > 0.95


def test_depths_that_lie_on_no_plane_stay():
    rng = np.random.default_rng(5)
    depth = TRUE * rng.uniform(0.5, 1.5, TRUE.shape)
    np.testing.assert_array_equal(flat(depth, ALL), depth)
