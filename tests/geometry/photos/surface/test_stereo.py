"""Depth maps mended by photos, in a box whose depth is known in closed form."""

from functools import partial

import numpy as np
import pytest
import views
import warp as wp
from scipy import ndimage

from warprrf.device import filled
from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.photos.surface import stereo
from warprrf.kernels import patch_match

look = partial(views.look, width=160, height=120, f=130.0)
LOW, HIGH = np.array([-2.0, -2.0, 0.0]), np.array([2.0, 2.0, 2.5])
PLAIN_X = HIGH[0]  # the wall there shows nothing
search = partial(stereo.mended, progress=lambda *told: None)


def mended(*given):
    """The depth maps alone."""
    return search(*given)[0]


def truth(camera):
    """Range along every pixel's ray to the inside of the box, and the photo of its pattern."""
    t = views.range_in_box(camera, LOW, HIGH)
    x = camera.position + t[..., None] * camera.directions()
    rng = np.random.default_rng(5)
    waves = rng.normal(size=(12, 3)) * 2 * np.pi / 0.5
    pattern = np.sin(x @ waves.T + rng.uniform(0, 6, 12)).sum(axis=-1) / 12
    grey = np.where(x[..., 0] > PLAIN_X - 1e-6, 0.5, 0.5 + 0.5 * pattern)
    return t, np.repeat(grey[..., None], 3, axis=2).astype(np.float32)


@wp.kernel
def correlations(
    planes: wp.array(dtype=wp.vec3),
    greys: wp.array(dtype=patch_match.window),
    weights: wp.array(dtype=patch_match.window),
    moments: wp.array(dtype=wp.vec2),
    turn: wp.mat33,
    shift: wp.vec3,
    images: wp.array(dtype=wp.float32),
    size: wp.vec3i,
    found: wp.array(dtype=wp.float32),
):
    k = wp.tid()
    m = moments[k]
    found[k] = patch_match.correlation(
        planes[k], 20.5, 15.5, greys[k], weights[k], m[0], m[1], turn, shift, images, size
    )


@wp.kernel
def disagreements(
    planes: wp.array(dtype=wp.vec3),
    grey: patch_match.window,
    weight: patch_match.window,
    moments: wp.vec2,
    others: patch_match.Others,
    least: float,
    found: wp.array(dtype=wp.float32),
):
    k = wp.tid()
    found[k] = patch_match.disagreement(
        planes[k], 20.5, 15.5, grey, weight, moments[0], moments[1], others, least
    )


@pytest.fixture(scope="module")
def room():
    cameras = [
        look([-0.6 + 0.4 * (k % 4), -1.2 + 0.3 * (k // 4), 1.2], [0.3 + 0.1 * k, 2.0, 1.1]) for k in range(8)
    ]
    true, images = zip(*map(truth, cameras), strict=True)
    return cameras, list(true), PosedPhotos(images, cameras)


@pytest.fixture(scope="module")
def spoiled(room):
    """The room's depth maps, each with two squares too far or too near by 15 to 30 % and one without a depth."""
    _, true, _ = room
    rng, maps, wrong = np.random.default_rng(2), [], []
    for t in true:
        depth, bad = t.copy(), np.zeros(t.shape, bool)
        for factor in (rng.uniform(1.15, 1.3), rng.uniform(0.7, 0.85), 0.0):
            i, j = rng.integers(0, 88), rng.integers(0, 128)
            depth[i : i + 32, j : j + 32] = factor * t[i : i + 32, j : j + 32]
            bad[i : i + 32, j : j + 32] = True
        maps.append(depth)
        wrong.append(bad)
    return maps, np.array(wrong)


@pytest.fixture(scope="module")
def searched(room, spoiled):
    cameras, _, photos = room
    return [np.array(part) for part in search(spoiled[0], cameras, photos)]


@pytest.fixture(scope="module")
def found(searched):
    return searched[0]


def shown_x(room):
    """x of what every pixel shows."""
    cameras, true, _ = room
    return np.array([c.position[0] + t * c.directions()[..., 0] for c, t in zip(cameras, true, strict=True)])


def patterned(room):
    """Pixels that show the pattern, a window's width from the plain wall and from the border."""
    shown = shown_x(room) < PLAIN_X - 0.3
    shown[:, :8] = shown[:, -8:] = False
    shown[:, :, :8] = shown[:, :, -8:] = False
    return shown


def test_a_window_is_a_chess_board_round_its_middle():
    places = list(zip(patch_match.COLUMNS, patch_match.ROWS, strict=True))[: patch_match.SAMPLES]
    board = {(i, j) for i in range(-4, 5, 2) for j in range(-4, 5, 2) if (i + j) % 4 == 0}
    assert set(places) == board and len(board) == len(places) == 13


def test_the_last_photo_is_left_out_only_where_it_could_not_help():
    """Costs below what is to be beaten come out as they are; of the others some are not computed to the end."""
    rng, n, (height, width) = np.random.default_rng(3), 3000, (40, 50)
    photos = [ndimage.gaussian_filter(rng.random((height, width)), 1.5) for _ in range(3)]
    photos[1] = 0.5 * photos[1] + 0.5 * photos[2]  # the first shows something else
    grey, weight = np.zeros(16), np.zeros(16)
    at = 15 + np.array(patch_match.ROWS, int), 20 + np.array(patch_match.COLUMNS, int)
    grey[:13], weight[:13] = photos[2][at][:13], 1 / 13
    mean = float(weight @ grey)
    moments = wp.vec2(mean, float(weight @ grey**2) - mean**2)
    planes = np.column_stack([rng.uniform(-9, 9, n), np.zeros((n, 2))])
    sizes = [(k * height * width, width, height) for k in range(3)]
    others = filled(
        patch_match.Others, "cpu", turns=np.tile(np.eye(3), (3, 1, 1)), shifts=np.array([[1.0, 0, 0], [0, 1, 0], [1, 1, 0]]),
        sizes=np.array(sizes), images=np.concatenate([x.ravel() for x in photos]), told=np.zeros((1, 3)), contradicting=0.0,
    )  # fmt: skip

    def costs(least):
        out = wp.zeros(n, dtype=wp.float32, device="cpu")
        given = (
            wp.array(planes, dtype=wp.vec3, device="cpu"),
            patch_match.window(*grey),
            patch_match.window(*weight),
        )
        wp.launch(disagreements, dim=n, inputs=[*given, moments, others, least, out], device="cpu")
        return out.numpy()

    whole = costs(float(patch_match.UNKNOWN))
    for least in (0.1, 0.15, 0.2, 0.3):
        below, some = whole < least, costs(least)
        np.testing.assert_array_equal(some[below], whole[below])
        assert (some[~below] >= least).all() and below.sum() > 20
        assert (some[~below] > whole[~below]).sum() > 100


@pytest.mark.parametrize("shift", [(3.5, 0.1, 0.01), (-0.1, 3.5, 0.01)])
def test_a_window_correlates_with_what_another_photo_shows_at_its_places(shift):
    """Against NumPy and SciPy's interpolation, for planes that lie in the other photo and beyond either border of columns, or
    of rows; a plane that is not a number is nowhere."""
    rng, n, (height, width) = np.random.default_rng(7), 4000, (40, 50)
    image = ndimage.gaussian_filter(rng.random((height, width)), 1.0).astype(np.float32)
    board = [(i, j) for j in range(-4, 5, 2) for i in range(-4, 5, 2) if (i + j) % 4 == 0]
    turn = np.eye(3) + rng.normal(0, 0.02, (3, 3)) * [[1, 1, 20], [1, 1, 20], [0.02, 0.02, 0.1]]
    planes = np.stack([rng.uniform(-12, 12, n), *rng.normal(0, 0.1, (2, n))], axis=1)
    greys, weights = np.zeros((n, 16)), np.zeros((n, 16))
    greys[:, :13], weights[:, :13] = rng.random((n, 13)), rng.random((n, 13))
    weights /= weights.sum(axis=1, keepdims=True)
    mean = (weights * greys).sum(axis=1)
    variance = (weights * greys**2).sum(axis=1) - mean**2
    pixel = np.array([(20.5 + i, 15.5 + j, 1.0) for i, j in board])
    inverse = planes[:, :1] + planes[:, 1:] @ np.array(board).T
    h = pixel @ turn.T + inverse[..., None] * np.array(shift)
    x, y = h[..., 0] / h[..., 2], h[..., 1] / h[..., 2]
    there = (h[..., 2] > 1e-6) & (x > 0.5) & (y > 0.5) & (x < width - 0.51) & (y < height - 0.51)
    value = ndimage.map_coordinates(image, [y - 0.5, x - 0.5], order=1, mode="nearest")
    w = weights[:, :13]
    total, square = (w * value).sum(axis=1), (w * value**2).sum(axis=1)
    product = (w * value * greys[:, :13]).sum(axis=1)
    expected = (product - total * mean) / np.sqrt(np.maximum(square - total**2, 1e-12) * variance)
    expected[~there.all(axis=1)] = -2.0
    planes[-1], expected[-1] = np.nan, -2.0
    found = wp.zeros(n, dtype=wp.float32, device="cpu")
    given = [
        wp.array(planes, dtype=wp.vec3, device="cpu"), wp.array(greys, dtype=patch_match.window, device="cpu"),
        wp.array(weights, dtype=patch_match.window, device="cpu"),
        wp.array(np.stack([mean, variance], axis=1), dtype=wp.vec2, device="cpu"), wp.mat33(turn), wp.vec3(shift),
        wp.array(np.concatenate([np.zeros(7), image.ravel()]), dtype=wp.float32, device="cpu"),
        wp.vec3i(7, width, height),
    ]  # fmt: skip
    wp.launch(correlations, dim=n, inputs=[*given, found], device="cpu")
    low, high = np.stack([x, y]).min(axis=2) < 0.5, np.stack([x - width, y - height]).max(axis=2) > -0.51
    own = int(shift[1] > 1)  # of its columns or rows
    other = (low | high)[1 - own]
    assert min((low[own] & ~other).sum(), (high[own] & ~other).sum(), (expected > -2).sum()) > 300
    near = np.abs(np.stack([x - 0.5, y - 0.5, x - width + 0.51, y - height + 0.51])).min(axis=(0, 2)) < 1e-3
    np.testing.assert_allclose(found.numpy()[~near], expected[~near], atol=2e-3)


def test_photos_mend_wrong_depths(room, spoiled, found):
    true, wrong = np.array(room[1]), spoiled[1] & patterned(room)
    before = np.abs(np.array(spoiled[0]) / true - 1)[wrong]
    assert np.median(before) > 0.14
    after = np.abs(found / true - 1)[wrong & (found > 0)]
    assert (found[wrong] > 0).mean() > 0.8
    assert np.median(after) < 0.01 and (after < 0.03).mean() > 0.9


def test_what_photos_prove_is_right(room, searched):
    found, proved = searched
    error = np.abs(found / np.array(room[1]) - 1)[proved]
    assert (error < 0.02).mean() > 0.98
    near = ndimage.maximum_filter(shown_x(room) < PLAIN_X - 1e-6, (1, 13, 13))  # windows are 9 pixels wide
    assert proved[patterned(room)].mean() > 0.8 and proved[~near].mean() < 0.02


def test_a_photo_whose_pose_is_wrong_proves_next_to_nothing(room):
    cameras, true, photos = room
    raised = look(cameras[3].position + [0, 0, 0.2], [0.6, 2.0, 1.3])
    images = [truth(raised)[1] if k == 3 else image for k, image in enumerate(photos.images)]
    shares = [proved.mean() for proved in search(true, cameras, PosedPhotos(images, cameras))[1]]
    assert shares[3] < 0.08 and min(shares[:3] + shares[4:]) > 0.6


def test_right_depths_stay_as_they_are(room, spoiled, found):
    true = np.array(room[1])
    error = np.abs(found / true - 1)[~spoiled[1]]
    assert (error == 0).mean() > 0.9
    assert (error < 0.02).mean() > 0.97


def test_rough_depths_become_as_exact_as_photos_allow(room):
    """Squares of 8 pixels, each off by 5 % rms; seen from 9 degrees aside a pixel is 5 % of the depth: half
    are found to a tenth of it."""
    cameras, true, photos = room
    rng = np.random.default_rng(4)
    rough = [t * np.exp(0.05 * rng.normal(size=(15, 20))).repeat(8, 0).repeat(8, 1) for t in true]
    result = np.array(mended(rough, cameras, photos))
    shown = patterned(room) & (result > 0)
    error = np.abs(result / np.array(true) - 1)[shown]
    assert np.median(np.abs(np.array(rough) / np.array(true) - 1)[shown]) > 0.03
    assert np.median(error) < 0.005 and np.percentile(error, 90) < 0.02


def test_a_plain_wall_keeps_its_depth(room, spoiled, found):
    plain = (shown_x(room) > PLAIN_X - 1e-6) & ~spoiled[1]
    assert plain.sum() > 5000
    assert (found == np.array(spoiled[0]))[plain].mean() > 0.9


def test_masked_pixels_are_not_mended(room, spoiled):
    cameras, _, photos = room
    masks = [np.ones((120, 160), np.uint8) for _ in cameras]
    hidden = PosedPhotos(photos.images, cameras, masks)
    result = mended(spoiled[0], cameras, hidden)
    np.testing.assert_array_equal(result, spoiled[0])


def test_one_photo_or_no_depth_mends_nothing(room, spoiled):
    cameras, _, photos = room
    for maps in (spoiled[0][:1], [np.zeros((120, 160))]):
        result = mended(maps, cameras[:1], photos.subset([0]))
        np.testing.assert_array_equal(result, maps)


def test_maps_vote_for_a_depth_up_to_the_tolerance_and_against_one_that_they_see_through():
    camera = views.pinhole(32, 24, focal=30)
    depth = 2.0 / camera.directions()[..., 2]
    for factor, expected in ((1.012, (1, 0)), (0.988, (1, 0)), (1.03, (0, 1)), (0.97, (0, 0))):
        agreed, crossed = stereo._votes(depth, camera, [(camera, factor * depth)], 0.015)
        assert (agreed == expected[0]).all() and (crossed == expected[1]).all(), factor
