"""How the rasteriser gets through its work changes nothing about the result: lists of tiles, threads, blocks of pixels
or one pixel at a time."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from benchmarks.engine.scenes import panorama, photo
from warprrf import device
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import RADIO, WARP, Blending, Rasterizer
from warprrf.geometry.splats.render import render
from warprrf.kernels.raster import reference
from warprrf.kernels.raster.project import SUMS

CAMERAS = {
    "pinhole": photo(70, 45),
    "spherical": panorama(33, 66),
    "inside": Camera.spherical(40, 20, position=(0.5, 0.2, 0.1)),
}


def mixed(seed, n=150):
    """Discs, needles and balls of very different sizes round the camera, some with it inside."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(0, 1, (n, 3)) * (18, 12, 4), rng.normal(size=(n, 4)), np.exp(rng.uniform(-4, 0.7, (n, 3))),
        rng.uniform(0.05, 1, n), np.zeros((n, 1, 3)),
    )  # fmt: skip


def image_and_gradients(g, cam, *, channels=3, device="cpu", **options):
    raster = Rasterizer(device=device, **options)
    real = raster.real
    inputs = raster.upload(g)
    rng = np.random.default_rng(5)
    features = wp.array(rng.random((len(g), channels)), dtype=real, device=device)
    background = wp.array(rng.random(channels), dtype=real, device=device)
    for array in (*inputs, features, background):
        array.requires_grad = True
    image, adjoint = raster.blend_with_adjoint(raster.prepare(*inputs, cam), features, background)
    for out in (image.features, image.alpha, image.depth):
        out.grad.assign(rng.normal(size=out.shape))
    seen = adjoint()
    gradients = [a.grad for a in (*inputs, features, background)]
    arrays = (image.features, image.alpha, image.depth, image.dominant, image.peak, seen, *gradients)
    return [a.numpy().copy() for a in arrays]


@pytest.mark.parametrize("camera", ["pinhole", "spherical"])
def test_the_number_of_threads_changes_no_bit(camera, monkeypatch):
    g = mixed(7, 400)
    results = []
    for count in (1, 2, 5):
        with ThreadPoolExecutor(5) as pool:
            monkeypatch.setattr(device, "threads", lambda count=count: count)
            monkeypatch.setattr(device, "_pool", lambda pool=pool: pool)
            results.append(image_and_gradients(g, CAMERAS[camera], channels=5))
    assert np.abs(results[0][6]).max() > 0
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert np.array_equal(a, b)


def test_the_exponential_of_float32_errs_by_less_than_1e_6():
    # One broad Gaussian on the axis of a narrow view: directions are nearly exact, q runs from 0 to 80.
    g = Gaussians([[0, 0, 1.0]], [[1, 0, 0, 0]], [[0.01] * 3], [1.0], np.zeros((1, 1, 1)))
    cam = Camera.pinhole(256, 1, fx=2560, fy=2560, cx=0.5, cy=0.5, world_to_camera=np.eye(4))
    blending = Blending(alpha_min=1e-20, alpha_max=1.0, transmittance_min=-0.5)
    found = render(g, cam, np.ones((1, 1)), device="cpu", blending=blending).alpha[0]
    x = np.arange(256) / 2560.0
    q = (x / 0.01) ** 2 / (1 + x * x)
    assert q.max() > 80
    assert np.abs(found - np.exp(-q / 2)).max() < 1e-6


def test_a_gpu_s_tiles_have_a_lane_for_each_sum_and_two_fill_a_warp():
    """What the native code that adds up over a tile counts on."""
    assert (reference.LANES, SUMS, WARP) == (16, 16, 32)


OTHERS = [{"per_pixel": True}, pytest.param({"device": "cuda:0"}, marks=pytest.mark.cuda)]


@pytest.mark.parametrize("other", OTHERS, ids=["reference", "cuda"])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize(
    ("real", "rule", "channels"),
    [(wp.float32, "product", 5), (wp.float64, "exp", 3), (wp.float64, "product", 1)],
    ids=["float32", "float64", "one channel"],
)
def test_blocks_blend_what_the_reference_does(real, rule, channels, camera, other):
    """Image, ranges, owners, seen weights and every gradient; five channels take two launches."""
    g, how = mixed(7, 400), {"channels": channels, "real": real, "blending": Blending(rule=rule)}
    expected = image_and_gradients(g, camera, **how)
    found = image_and_gradients(g, camera, **how, **other)
    tolerance = 2e-5 if real is wp.float32 else 1e-12
    for k, (a, b) in enumerate(zip(expected, found, strict=True)):
        assert np.abs(a).max() > 0
        if k == 3:  # owners
            assert np.array_equal(a, b)
        assert np.abs(a - b).max() <= tolerance * np.abs(a).max()


@pytest.mark.parametrize("other", OTHERS, ids=["reference", "cuda"])
@pytest.mark.parametrize(
    ("real", "rule"), [(wp.float64, "product"), (wp.float64, "exp"), (wp.float32, "product")]
)
def test_long_lists_blended_in_stretches_are_what_they_are_in_one(real, rule, other):
    """Lists of many stretches; some pixels are finished within one, the others see through them all."""
    rng, n, cam = np.random.default_rng(3), 20_000, CAMERAS["inside"]
    off = rng.normal(0, 3, (n, 3))
    opacities = np.where(off[:, 0] < 0, 0.08, 0.004)
    g = Gaussians(
        cam.position + off, rng.normal(size=(n, 4)), rng.uniform(0.1, 0.6, (n, 3)), opacities,
        np.zeros((n, 1, 3)),
    )  # fmt: skip
    how = {"channels": 5, "real": real, "blending": Blending(1e-3, transmittance_min=1e-3, rule=rule)}
    raster = Rasterizer(device="cpu", per_pixel=True, real=real, blending=how["blending"])
    prepared = raster.prepare(*raster.upload(g), cam)
    image = raster.blend(prepared, wp.zeros((len(g), 1), dtype=real, device="cpu"))
    finished = (image.transmittance.numpy() <= 1e-3).mean()
    assert np.median(np.diff(prepared.starts.numpy())) > 4 * reference.STRETCH
    assert 0.2 < finished < 0.8
    expected, found = image_and_gradients(g, cam, **how), image_and_gradients(g, cam, **how, **other)
    tolerance = 2e-5 if real is wp.float32 else 1e-12
    for a, b in zip(expected, found, strict=True):
        assert np.abs(a - b).max() <= tolerance * np.abs(a).max()


@pytest.mark.parametrize("other", OTHERS, ids=["reference", "cuda"])
@pytest.mark.parametrize("top_k", [1, 3, 16])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_blocks_find_the_strongest_weights_that_the_reference_finds(camera, top_k, other):
    found = []
    for options in ({}, other):
        raster = Rasterizer(blending=RADIO, **{"device": "cpu", **options})
        arrays = raster.strongest(raster.prepare(*raster.upload(mixed(7, 400)), camera), top_k)
        found.append([a.numpy() for a in arrays])
    assert np.array_equal(found[0][0], found[1][0])  # which Gaussians
    for a, b in zip(found[0][1:], found[1][1:], strict=True):
        assert np.abs(a).max() > 0.1
        assert np.abs(a - b).max() <= 3e-6 * max(1, np.abs(a).max())
