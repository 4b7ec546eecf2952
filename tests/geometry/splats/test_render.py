"""The rasteriser against brute force, and its laws; gradients are in tests/gradients, hard cases in tests/hard_cases."""

import numpy as np
import pytest

from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import RADIO, Blending
from warprrf.geometry.splats.render import blend_weights, render


def pinhole(width=64, height=48, position=(0.0, 0.0, -4.0)):
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(position)
    return Camera.pinhole(
        width, height, fx=0.6 * width, fy=0.6 * width, cx=width / 2, cy=height / 2, world_to_camera=pose
    )


def cloud(rng, n, low=0.02, high=0.4, spread=2.0):
    return Gaussians(
        rng.uniform(-spread, spread, (n, 3)),
        rng.normal(size=(n, 4)),
        np.exp(rng.uniform(np.log(low), np.log(high), (n, 3))),
        rng.uniform(0.05, 1.0, n),
        rng.normal(size=(n, 4, 3)) * 0.3,
    )


def brute_force(g: Gaussians, camera: Camera, features, *, alpha_min=1 / 255, alpha_max=0.99, transmittance_min=1e-4,
          rule="product", background=0.0):  # fmt: skip
    """Textbook splatting in float64: every Gaussian on every ray. Features, alpha, depth, and how close the closest
    cutoff decision of each pixel was."""
    origin = camera.position
    directions = camera.directions().reshape(-1, 3)
    m = g.means.astype(np.float64) - origin
    whiten = g.rotations.transpose(0, 2, 1) / g.scales.astype(np.float64)[:, :, None]
    order = np.argsort(np.linalg.norm(m, axis=1).astype(np.float32), kind="stable")
    pixels = len(directions)
    color, left = np.zeros((pixels, features.shape[1])), np.ones(pixels)
    alpha_sum, depth_sum, margin = np.zeros(pixels), np.zeros(pixels), np.full(pixels, np.inf)
    for k in order:
        along = directions @ whiten[k].T
        perpendicular = (directions @ m[k])[:, None] * directions - m[k]
        offset = perpendicular @ whiten[k].T
        c = np.cross(along / np.linalg.norm(along, axis=1, keepdims=True), offset)
        t = np.sum(along * (whiten[k] @ m[k]), axis=1) / np.sum(along * along, axis=1)
        raw = g.opacities[k].astype(np.float64) * np.exp(-0.5 * np.sum(c * c, axis=1))
        counted = (raw >= alpha_min) & (t > 0) & (left > transmittance_min)
        margin = np.minimum(margin, np.where(t > 0, np.abs(raw / alpha_min - 1), np.inf))
        margin = np.minimum(margin, np.abs(left / transmittance_min - 1))
        alpha = np.where(counted, np.minimum(raw, alpha_max), 0)
        weight = alpha * left
        color += weight[:, None] * features[k]
        alpha_sum += weight
        depth_sum += weight * np.where(counted, t, 0)
        left = left * (1 - alpha if rule == "product" else np.exp(-alpha))
    color += left[:, None] * background
    shape = (camera.height, camera.width)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.where(alpha_sum > 0, depth_sum / alpha_sum, np.inf)
    return color.reshape(*shape, -1), alpha_sum.reshape(shape), depth.reshape(shape), margin.reshape(shape)


CAMERAS = {
    "pinhole": pinhole(),
    "pinhole inside": pinhole(position=(0.1, 0.2, 0.0)),
    "spherical": Camera.spherical(72, 36, position=(0.1, -0.2, 0.3)),
    "spherical, width no multiple of a tile": Camera.spherical(50, 25, position=(0.4, 0.2, -0.3)),
}


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("rule", ["product", "exp"])
def test_agrees_with_brute_force_in_float64_away_from_the_cutoff(camera, rule):
    rng = np.random.default_rng(3)
    g = cloud(rng, 300)
    features, background = rng.random((300, 6)), rng.random(6)
    out = render(g, camera, features, background, device="cpu", blending=Blending(rule=rule))
    color, alpha, depth, margin = brute_force(g, camera, features, rule=rule, background=background)
    clear = margin > 1e-3
    assert clear.mean() > 0.5
    assert np.abs(out.features - color)[clear].max() < 1e-5 * max(1.0, np.abs(color).max())
    assert np.abs(out.alpha - alpha)[clear].max() < 1e-5
    seen = clear & np.isfinite(depth)
    assert np.abs(out.depth[seen] - depth[seen]).max() < 1e-4
    assert (np.isinf(out.depth) == (out.alpha == 0)).all()
    # A pixel at a cutoff may gain or lose one contribution of alpha_min, not more.
    assert np.abs(out.features - color).max() < 4 / 255


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_blending_weights_rebuild_the_image(camera):
    rng = np.random.default_rng(4)
    g = cloud(rng, 200)
    features = rng.random((200, 3)).astype(np.float32)
    out = render(g, camera, features, device="cpu", blending=RADIO)
    w = blend_weights(g, camera, top_k=200, device="cpu")
    rebuilt = np.einsum(
        "hwk,hwkc->hwc", w.weight, features[np.maximum(w.index, 0)] * (w.index >= 0)[..., None]
    )
    assert np.abs(rebuilt - out.features).max() < 2e-4  # one contribution of alpha_min at a cutoff
    assert (np.diff(np.where(w.index >= 0, 1, 0), axis=2) <= 0).all()
    few = blend_weights(g, camera, top_k=3, device="cpu")
    strongest = -np.sort(-w.weight, axis=2)[..., :3]
    assert np.allclose(-np.sort(-few.weight, axis=2), strongest, atol=1e-6)
    assert np.allclose(few.dropped, w.weight.sum(2) - strongest.sum(2), atol=1e-5)
    disagree = w.dominant != out.dominant
    assert disagree.mean() < 0.01  # equal weights may be named either way


def test_one_gaussian_peaks_where_its_ray_passes_closest():
    g = Gaussians([[1.0, 2.0, 0.5]], [[1, 0, 0, 0]], [[0.05] * 3], [0.5], np.zeros((1, 1, 3)))
    camera = Camera.spherical(360, 180, position=(0, 0, 0))
    out = render(g, camera, np.ones((1, 1)), device="cpu")
    row, column = np.unravel_index(np.argmax(out.alpha), out.alpha.shape)
    direction = camera.directions()[row, column]
    assert np.arccos(direction @ g.means[0] / np.linalg.norm(g.means[0])) < np.radians(0.75)
    assert out.depth[row, column] == pytest.approx(np.linalg.norm(g.means[0]), abs=1e-3)
    assert out.alpha.max() == pytest.approx(0.5, abs=0.01)


def test_exponential_rule_blends_to_more_than_one_where_the_product_rule_does_not():
    g = Gaussians(
        [[0, 0, 1.0 + 0.1 * k] for k in range(6)],
        [[1, 0, 0, 0]] * 6,
        [[0.3] * 3] * 6,
        [0.9] * 6,
        np.zeros((6, 1, 1)),
    )
    camera = pinhole(17, 17, position=(0, 0, 0))
    centre = (8, 8)
    product = render(g, camera, np.ones((6, 1)), device="cpu").features[centre]
    exponential = render(g, camera, np.ones((6, 1)), device="cpu", blending=Blending(rule="exp")).features[
        centre
    ]
    assert (
        product <= 1.0 < exponential
    )  # sum_k a exp(-k a) = a (1 - e^{-6a}) / (1 - e^{-a}) = 1.51 at a = 0.9
    assert exponential == pytest.approx(0.9 * (1 - np.exp(-5.4)) / (1 - np.exp(-0.9)), rel=0.02)


def test_result_does_not_depend_on_the_number_of_threads(monkeypatch):
    import warprrf.device

    rng = np.random.default_rng(5)
    g, camera = cloud(rng, 400), CAMERAS["pinhole"]
    several = render(g, camera, device="cpu")
    monkeypatch.setattr(warprrf.device, "threads", lambda: 1)
    one = render(g, camera, device="cpu")
    assert np.array_equal(several.features, one.features)


@pytest.mark.parametrize(
    ("argument", "change"),
    [
        ("features", {"features": np.ones((3, 2))}),
        ("background", {"background": np.ones(5)}),
        ("g", {"g": "not Gaussians"}),
        ("cam", {"cam": None}),
        ("device", {"device": "cuda:99"}),
    ],
)
def test_bad_input_is_named(argument, change):
    arguments = {
        "g": cloud(np.random.default_rng(0), 4),
        "cam": CAMERAS["pinhole"],
        "device": "cpu",
        **change,
    }
    with pytest.raises((ValueError, TypeError), match=f"^{argument}"):
        render(**arguments)


def test_nothing_in_view_gives_the_background():
    g = Gaussians([[0, 0, -100.0]], [[1, 0, 0, 0]], [[0.1] * 3], [0.9], np.zeros((1, 1, 3)))
    out = render(g, pinhole(position=(0, 0, 0)), background=0.25, device="cpu")
    assert (out.features == 0.25).all() and (out.dominant == -1).all() and np.isinf(out.depth).all()
