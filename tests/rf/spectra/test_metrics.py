"""Metrics against closed forms, brute force and scikit-image."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from warprrf.rf.spectra import metrics
from warprrf.rf.spectra.spectrum import Spectrum, pixel_directions, pixel_solid_angles, spread

SHAPE = (18, 36)
FLOOR = 1e-12
RANGE_DB = (-120.0, -60.0)


def small_dataset(count=3, seed=0):
    rng = np.random.default_rng(seed)
    gain = 10 ** rng.uniform(-11, -6, (count, *SHAPE))
    return SimpleNamespace(
        receivers=rng.random((count, 3)),
        path_gain=gain,
        delay_s=rng.uniform(1e-8, 5e-8, gain.shape),
        aod=np.stack([rng.uniform(0.2, 3.0, gain.shape), rng.uniform(-3, 3, gain.shape)], axis=-1),
        floor=FLOOR,
        range_db=RANGE_DB,
        line_of_sight=np.arange(count) % 2 == 0,
    )


def scored(ds, change=lambda truth: truth):
    """Figures of predictions that are the truth, changed."""
    truth = {
        tuple(r): Spectrum(ds.path_gain[k], ds.delay_s[k], ds.aod[k], FLOOR, RANGE_DB)
        for k, r in enumerate(ds.receivers)
    }
    return metrics.evaluate(ds, lambda rx: change(truth[tuple(rx)]))


def test_psnr_of_a_constant_offset_is_twenty_log_of_it():
    image = np.random.default_rng(0).uniform(0.2, 0.7, SHAPE)
    assert metrics.psnr(image + 0.1, image) == pytest.approx(20.0)
    assert metrics.psnr(image, image) == metrics.PSNR_CEILING_DB


def test_unit_image_maps_floor_to_zero_and_clips_above_the_range():
    gain = np.array([[0.0, 1e-9, 1.0]])
    expected = [0.0, (10 * np.log10(1e-9 + FLOOR) + 120) / 60, 1.0]
    assert metrics.unit_image(gain, FLOOR, RANGE_DB)[0] == pytest.approx(expected)


def test_ssim_equals_scikit_images():
    skimage = pytest.importorskip("skimage.metrics")
    rng = np.random.default_rng(1)
    for _ in range(5):
        a, b = rng.random(SHAPE), rng.random(SHAPE)
        b = 0.7 * a + 0.3 * b
        expected = skimage.structural_similarity(a, b, data_range=1.0)
        assert metrics.ssim(a, b) == pytest.approx(expected, abs=1e-12)
    assert metrics.ssim(a, a) == pytest.approx(1.0)


def test_rmse_weighs_rows_by_solid_angle():
    difference = np.zeros(SHAPE)
    difference[4] = 6.0
    weight = pixel_solid_angles(SHAPE)
    assert metrics.rmse_db(difference, np.zeros(SHAPE)) == pytest.approx(
        6 * np.sqrt(weight[4] / weight.sum())
    )


def test_strongest_direction_is_that_of_a_path_even_beside_the_pole():
    weak, strong = np.array([1.0, 0.0, 0.1]), np.array([0.2, -0.1, 1.0])
    image = spread(np.stack([weak, strong]), np.array([1.0, 1.5]), (60, 120), np.radians(4.0))
    found = metrics.strongest_direction(image)
    assert metrics.angle_deg(found, strong / np.linalg.norm(strong)) < 2.2  # half a pixel's diagonal


def test_angle_is_accurate_for_tiny_and_opposite_directions():
    a = np.array([1.0, 0.0, 0.0])
    tiny = np.array([np.cos(1e-9), np.sin(1e-9), 0.0])
    assert metrics.angle_deg(a, tiny) == pytest.approx(np.degrees(1e-9), rel=1e-6)
    assert metrics.angle_deg(a, -a) == pytest.approx(180.0)


def test_beam_response_equals_the_double_sum():
    image = np.random.default_rng(2).random(SHAPE) ** 8
    toward = pixel_directions(SHAPE)
    kappa = metrics.beam_kappa(np.radians(25.0))
    response = metrics.beam_response(image, np.radians(25.0))
    for row, column in ((0, 0), (3, 35), (9, 17), (17, 20)):
        weight = np.exp(kappa * (toward @ toward[row, column] - 1))
        assert response[row, column] == pytest.approx((weight * image).sum(), rel=1e-10)


def test_steering_half_a_beamwidth_off_a_lone_path_loses_three_decibels():
    image = np.zeros((90, 180))
    image[45, 90] = 1e-8
    path = pixel_directions(image.shape)[45, 90]
    across = np.cross(path, [0.0, 0.0, 1.0])
    off = np.cos(np.radians(5.0)) * path + np.sin(np.radians(5.0)) * across / np.linalg.norm(across)
    assert metrics.beam_gain_loss_db(image, off, np.radians(10.0)) == pytest.approx(
        10 * np.log10(2), abs=1e-9
    )
    assert metrics.beam_gain_loss_db(image, 3.0 * off, np.radians(10.0)) == pytest.approx(10 * np.log10(2))
    with pytest.raises(ValueError, match="direction: got a vector of length zero"):
        metrics.beam_gain_loss_db(image, 0.0 * off, np.radians(10.0))
    assert metrics.beam_gain_loss_db(image, path, np.radians(10.0)) == pytest.approx(0.0, abs=1e-9)


def test_weighted_median_ignores_what_has_no_weight():
    assert metrics.weighted_median(np.array([5.0, 1.0, 3.0, 100.0]), np.array([1.0, 1.0, 1.5, 0.0])) == 3.0
    with pytest.raises(ValueError, match="weights"):
        metrics.weighted_median(np.array([1.0]), np.array([0.0]))


def test_a_perfect_prediction_has_no_error():
    report = scored(small_dataset())
    assert report["psnr_db"] == metrics.PSNR_CEILING_DB
    assert report["ssim"] == pytest.approx(1.0)
    for key in ("rmse_db", "direction_median_deg", "tof_error_median_ns", "aod_error_median_deg"):
        assert report[key] == pytest.approx(0.0, abs=1e-9)
    assert report["direction_within_1deg"] == 1.0
    assert report["receivers_blocked"] == 1
    assert report["lpips"] is None and report["lpips_reason"]


def test_a_late_delay_and_a_turned_departure_are_measured_as_such():
    turn = [np.radians(4.0), 0.0]
    report = scored(small_dataset(), lambda s: replace(s, delay_s=s.delay_s + 2e-9, aod=s.aod + turn))
    assert report["tof_error_median_ns"] == pytest.approx(2.0)
    assert report["aod_error_median_deg"] == pytest.approx(4.0)


def test_delays_that_are_missing_for_most_power_give_no_figure():
    one_row = np.where(np.arange(SHAPE[0])[:, None] == 0, 1.0, np.nan)
    report = scored(small_dataset(), lambda s: replace(s, delay_s=s.delay_s * one_row, aod=None))
    assert report["tof_error_median_ns"] is None
    assert report["aod_error_median_deg"] is None


def test_blocked_figures_are_those_of_receivers_without_line_of_sight():
    ds = small_dataset(4)
    report = scored(ds, lambda s: s.path_gain * (1.0 + (s.path_gain == ds.path_gain[1::2]).any()))
    rows = report["per_receiver"]["psnr_db"]
    assert report["psnr_db_blocked"] == pytest.approx(rows[[1, 3]].mean())
    assert report["psnr_db"] == pytest.approx(rows.mean())
    assert report["psnr_db_blocked"] < report["psnr_db"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.zeros((4, 4)), "shape"),
        (np.full(SHAPE, np.nan), "NaN"),
        (np.full(SHAPE, -1.0), "at least 0"),
    ],
)
def test_bad_predictions_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        metrics.evaluate(small_dataset(), lambda rx: wrong)
