"""Held-out photos of any place: what is forgiven (one change of colours) and what is not."""

import numpy as np
import pytest
from views import pinhole

from benchmarks.photos import psnr, recoloured, score
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import Blending
from warprrf.geometry.splats.render import render


def test_an_affine_change_of_colours_is_undone_and_noise_is_not():
    rng = np.random.default_rng(1)
    image = rng.uniform(0.2, 0.8, (64, 64, 3)).astype(np.float32)
    change = np.eye(3) + rng.normal(size=(3, 3)) * 0.05
    changed = (image @ change + 0.03).astype(np.float32)
    assert np.abs(recoloured(image, changed) - changed).max() < 1e-5
    photo = (changed + rng.normal(size=image.shape) * 0.05).astype(np.float32)
    # -10 log10(0.05^2) = 26.02 dB; twelve numbers fitted to twelve thousand change that by 0.005 dB.
    assert psnr(recoloured(image, photo), photo) == pytest.approx(26.02, abs=0.15)


def test_a_rendering_beside_its_own_photo_is_exact_and_what_nothing_covers_is_a_hole():
    rng = np.random.default_rng(2)
    wall = Gaussians(
        np.c_[rng.uniform([-2, -2], [0, 2], (400, 2)), np.full(400, 3.0)], np.tile([1.0, 0, 0, 0], (400, 1)),
        np.tile([0.2, 0.2, 0.01], (400, 1)), np.full(400, 0.9), rng.normal(size=(400, 1, 3)),
    )  # fmt: skip
    camera = pinhole(64, 48, focal=48)
    photo = np.clip(render(wall, camera, device="cpu", blending=Blending()).features, 0, 1)
    found = score(wall, camera, photo, "cpu")
    assert found["psnr_db_as_is"] > 60 and found["ssim"] > 0.99
    assert found["holes"] == pytest.approx(0.5, abs=0.1)  # the wall ends in the middle
