"""The rasteriser against brute force, and its laws; gradients are in tests/gradients, hard cases in tests/hard_cases."""

import numpy as np
import pytest
from rays_by_definition import blended, cloud
from views import pinhole

from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.rasterizer import RADIO, Blending
from warprrf.geometry.splats.render import blend_weights, render

CAMERAS = {
    "pinhole": pinhole(64, 48, focal=38.4, position=(0.0, 0.0, -4.0)),
    "pinhole inside": pinhole(64, 48, focal=38.4, position=(0.1, 0.2, 0.0)),
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
    out = render(g, camera, features, background, blending=Blending(rule=rule))
    color, alpha, depth, margin = blended(g, camera, features, Blending(rule=rule), background)
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
    out = render(g, camera, features, blending=RADIO)
    w = blend_weights(g, camera, top_k=200)
    met = features[np.maximum(w.index, 0)] * (w.index >= 0)[..., None]
    rebuilt = np.einsum("hwk,hwkc->hwc", w.weight, met)
    assert np.abs(rebuilt - out.features).max() < 2e-4  # one contribution of alpha_min at a cutoff
    assert (np.diff(np.where(w.index >= 0, 1, 0), axis=2) <= 0).all()
    few = blend_weights(g, camera, top_k=3)
    strongest = -np.sort(-w.weight, axis=2)[..., :3]
    assert np.allclose(-np.sort(-few.weight, axis=2), strongest, atol=1e-6)
    assert np.allclose(few.dropped, w.weight.sum(2) - strongest.sum(2), atol=1e-5)
    disagree = w.dominant != out.dominant
    assert disagree.mean() < 0.01  # equal weights may be named either way
