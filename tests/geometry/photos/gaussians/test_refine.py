"""Refinement: the loss and its derivative, learning, and that stopping does not change the result."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from skimage.metrics import structural_similarity
from views import look

from warprrf.device import resolve
from warprrf.geometry.photos.config import RefineConfig
from warprrf.geometry.photos.gaussians.densify import filled
from warprrf.geometry.photos.gaussians.refine import refine
from warprrf.geometry.photos.gaussians.targets import Exposures, Targets
from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.planes import Plane
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.photo_loss import PhotoLoss
from warprrf.geometry.splats.render import render
from warprrf.kernels.ssim import MARGIN


def ring_of_cameras(count=8):
    angles = np.arange(count) * 2 * np.pi / count
    return [look([4 * np.cos(a), 4 * np.sin(a), 0.3], [0, 0, 0], f=57.6) for a in angles]


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(0)
    n = 300
    truth = Gaussians(
        rng.uniform([-1.5, -1.5, -0.5], [1.5, 1.5, 0.5], (n, 3)), rng.normal(size=(n, 4)),
        rng.uniform(0.05, 0.2, (n, 3)), rng.uniform(0.5, 0.95, n), rng.normal(size=(n, 1, 3)) * 0.8,
    )  # fmt: skip
    cameras = ring_of_cameras()
    photos = [np.clip(render(truth, c).features, 0, 1) for c in cameras]
    start = Gaussians(
        truth.means + rng.normal(size=(n, 3)) * 0.03, truth.quaternions, np.full((n, 3), 0.1), np.full(n, 0.5),
        np.zeros((n, 1, 3)),
    )  # fmt: skip
    return start, photos, cameras


CONFIG = RefineConfig(
    iterations=60, downscale=1, densify_from=20, densify_every=20, max_scale_m=1.0, thickness_m=1.0, mean_rate=2e-3,
    checkpoint_every=20,
)  # fmt: skip


def psnr(g, photos, cameras):
    errors = [np.mean((render(g, c).features - p) ** 2) for c, p in zip(cameras, photos, strict=True)]
    return float(np.mean(-10 * np.log10(errors)))


def test_refinement_learns_the_photos_and_densifies(problem):
    start, photos, cameras = problem
    end = refine(start, PosedPhotos(photos, cameras), config=CONFIG)
    assert psnr(end, photos, cameras) > psnr(start, photos, cameras) + 4
    assert len(end) > len(start)


def test_a_run_continued_from_a_checkpoint_equals_one_never_stopped(problem, tmp_path):
    start, photos, cameras = problem
    whole = refine(start, PosedPhotos(photos, cameras), config=CONFIG, device="cpu")

    class Killed(Exception):
        pass

    def kill_after_the_second_checkpoint(stage, done, total):
        if done >= 0.8 * total:
            raise Killed

    how = {"config": CONFIG, "checkpoint": tmp_path / "refine.safetensors", "device": "cpu"}
    with pytest.raises(Killed):
        refine(start, PosedPhotos(photos, cameras), progress=kill_after_the_second_checkpoint, **how)
    resumed = refine(start, PosedPhotos(photos, cameras), **how)
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(resumed, name), getattr(whole, name)), name


def test_a_damaged_checkpoint_is_refused(problem, tmp_path):
    start, photos, cameras = problem
    file = tmp_path / "refine.safetensors"
    short = RefineConfig(iterations=20, downscale=1, checkpoint_every=20)
    refine(start, PosedPhotos(photos, cameras), config=short, checkpoint=file)
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ValueError, match="cannot be read"):
        refine(start, PosedPhotos(photos, cameras), config=short, checkpoint=file)


@pytest.mark.usefixtures("device")
def test_gaussians_near_a_plane_are_pulled_flat_into_it():
    rng = np.random.default_rng(1)
    n = 200
    uv = rng.uniform(-0.8, 0.8, (n, 2))
    noisy = np.column_stack([uv, rng.normal(size=n) * 0.01])
    tilt = np.column_stack([np.ones(n), rng.normal(size=(n, 2)) * 0.05, np.zeros(n)])
    scales = np.tile([0.06, 0.06, 0.003], (n, 1))
    start = Gaussians(noisy, tilt, scales, np.full(n, 0.8), rng.normal(size=(n, 1, 3)))
    cameras = ring_of_cameras(4)
    photos = [np.clip(render(start, c).features, 0, 1) for c in cameras]
    plane = Plane(
        normal=np.array([0, 0, 1.0]), offset=0.0, inliers=np.arange(n),
        corner=np.array([-1.0, -1.0]),
        cell_m=0.5, occupied=np.ones((4, 4), bool),
    )  # fmt: skip
    config = RefineConfig(iterations=60, downscale=1, densify_from=999)
    free = refine(start, PosedPhotos(photos, cameras), config=config)
    held = refine(start, PosedPhotos(photos, cameras), config=config, planes=[plane])
    assert np.abs(held.means[:, 2]).max() < 1e-3 < np.abs(free.means[:, 2]).mean()
    assert np.degrees(np.arccos(np.clip(np.abs(held.normals[:, 2]), 0, 1))).max() < 1.0


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("lanes", [1, 16])  # of a GPU's threads and of a CPU's
def test_photo_loss_is_l1_and_ssim_and_its_derivative_is_right(lanes):
    rng = np.random.default_rng(2)
    shape = (24, 20, 3)
    image, target = rng.random(shape), rng.random(shape)
    loss = PhotoLoss(resolve(), 0.2, real=wp.float64, lanes=lanes)

    def evaluate(values):
        size = shape[:2]
        t = loss.plane(target, size)
        wp.copy(loss.canvas(size), loss.plane(values, size))
        score, gradient = (
            plane.numpy().reshape(24, -1)[:, MARGIN : MARGIN + 60].reshape(shape)
            for plane in loss(t, loss.moments(t, size), size)
        )
        return 0.8 * np.abs(values - target).mean() + 0.2 * (1 - score.mean()), gradient.copy(), score.copy()

    _, gradient, score = evaluate(image)
    _, published = structural_similarity(
        image, target, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        full=True,
    )  # fmt: skip
    # The border differs: zeros here, mirrored there.
    assert np.abs(score - published)[6:-6, 6:-6].max() < 1e-4
    v = rng.normal(size=shape)
    h = 1e-6
    difference = (evaluate(image + h * v)[0] - evaluate(image - h * v)[0]) / (2 * h)
    assert (gradient * v).sum() == pytest.approx(difference, rel=1e-6)


def test_photos_of_changed_exposure_and_white_balance_give_the_same_colours(problem):
    start, photos, cameras = problem
    rng = np.random.default_rng(3)
    gains = np.exp(rng.uniform(-0.25, 0.25, (len(photos), 3)))
    gains /= np.exp(np.log(gains).mean(axis=0))
    changed = [np.minimum(0.6 * p * g, 1) for p, g in zip(photos, gains, strict=True)]
    kept = [0.6 * p for p in photos]
    posed = PosedPhotos(changed, cameras)
    fitted = refine(start, posed, config=CONFIG)
    blind = refine(start, posed, config=replace(CONFIG, fit_exposure=False))
    straight = refine(start, PosedPhotos(kept, cameras), config=CONFIG)
    found, lost, best = (psnr(g, kept, cameras) for g in (fitted, blind, straight))
    assert best - found < 0.15 and best - lost > 3 * (best - found)


@pytest.mark.usefixtures("device")
def test_gains_of_photos_are_recovered_whatever_is_masked_or_clipped():
    rng = np.random.default_rng(6)
    shape = (20, 30, 3)
    gains = np.exp(rng.normal(size=(4, 3)) * 0.2)
    gains /= np.exp(np.log(gains).mean(axis=0))
    image = rng.random(shape, dtype=np.float32)
    photos = [np.minimum(image * g, 1).astype(np.float32) for g in gains]
    mask = np.zeros(shape[:2], bool)
    mask[:, :10] = True
    photos[1][mask] = 0.3
    camera = Camera.pinhole(30, 20, fx=30, fy=30, cx=15, cy=10, world_to_camera=np.eye(4))
    targets = Targets(PosedPhotos(photos, [camera] * 4, [None, mask, None, None]), PhotoLoss(resolve(), 0.2))
    exposures = Exposures(4)
    rendered = wp.array(image, dtype=float)
    for visit in range(20):
        for view in range(4):
            exposures.fit(rendered, targets.at(view, 1), visit)
    found = np.array([exposures.gain(view) for view in range(4)])
    # The prior is 1e-3 a pixel, the squares of what is neither masked nor clipped are a tenth or more: a gain keeps one
    # percent of its logarithm, which is below one half.
    assert np.allclose(found, gains, rtol=5e-3)


def test_masked_pixels_take_no_part(problem):
    start, photos, cameras = problem
    masks = [np.zeros(p.shape[:2], bool) for p in photos]
    masks[0][10:30, 20:40] = masks[3][:, :15] = True
    rng = np.random.default_rng(4)
    spoilt = [np.where(m[..., None], rng.random(p.shape), p) for p, m in zip(photos, masks, strict=True)]
    posed = [PosedPhotos(images, cameras, masks) for images in (photos, spoilt)]
    # A CPU's sums are the same bits from run to run.
    one, other = (refine(start, photos, config=CONFIG, device="cpu") for photos in posed)
    assert np.array_equal(one.sh, other.sh) and np.array_equal(one.means, other.means)


def test_a_hole_in_the_start_is_filled(problem):
    _, photos, cameras = problem
    start = Gaussians(
        np.random.default_rng(5).uniform([-1.5, -1.5, -0.5], [0.0, 1.5, 0.5], (300, 3)),
        np.tile([1.0, 0, 0, 0], (300, 1)), np.full((300, 3), 0.12), np.full(300, 0.9), np.zeros((300, 1, 3)),
    )  # fmt: skip
    wall = [np.full_like(p, 0.6) for p in photos]
    posed = PosedPhotos(wall, cameras)
    uncovered = [(render(start, c).alpha < 0.5).mean() for c in cameras]
    end = filled(start, posed)
    left = [(render(end, c).alpha < 0.5).mean() for c in cameras]
    assert np.mean(uncovered) > 0.3 and np.mean(left) < 0.02
    masked = PosedPhotos(wall, cameras, [np.ones(p.shape[:2], bool) for p in wall])
    assert len(filled(start, masked)) == len(start)
    assert len(filled(end, posed)) <= len(end) + 20
