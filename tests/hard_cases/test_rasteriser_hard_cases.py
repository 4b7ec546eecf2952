"""Hard cases of the rasteriser, each with the right answer: from a closed form, or from the definition evaluated in
NumPy with long doubles where a double would cancel."""

import numpy as np
import pytest
import warp as wp
from rays_by_definition import gaussians, met
from scipy.special import spence
from views import look, pinhole

from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.rasterizer import Blending, Rasterizer
from warprrf.geometry.splats.render import render

pytestmark = pytest.mark.usefixtures("each_form")

SMOOTH = Blending(alpha_min=1e-6, alpha_max=1.0, transmittance_min=-0.5)
ORIGIN = (0.0, 0.0, 0.0)


def alpha_of_one(g, cam, blending):
    """Alpha of a single Gaussian on every ray, by its definition."""
    t, raw, _ = met(g, cam.position, cam.directions(), np.longdouble)
    seen = (raw > blending.alpha_min) & (t > 0)
    return np.where(seen, np.minimum(raw, blending.alpha_max), 0).astype(float)[..., 0]


def ours64(g, cam, blending=SMOOTH):
    """Alpha of the float64 rasteriser."""
    raster = Rasterizer(blending=blending, real=wp.float64)
    table = wp.ones((len(g), 1), dtype=wp.float64)
    return raster.rasterize(*raster.upload(g), table, cam).alpha.numpy()


def ours32(g, cam, blending=SMOOTH):
    return render(g, cam, np.ones((len(g), 1)), blending=blending).alpha


@pytest.mark.parametrize(
    ("name", "value"),
    [("scales", [0.1, s, 0.1]) for s in (0.0, -0.1, 1e-40, np.inf, np.nan)]
    + [("quaternions", (0, 0, 0, 0)), ("opacities", 1.5), ("opacities", -0.1)],
    ids=str,
)
def test_what_is_no_gaussian_is_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name}:"):
        gaussians([0, 0, 5.0], **({"scales": [0.1] * 3} | {name: value}))


def test_the_smallest_scales_accepted_are_seen_by_the_ray_through_them_alone():
    smallest = float(np.finfo(np.float32).tiny)
    for scale in (smallest, 1e-30, 1e-15):
        for alpha in (ours32, ours64):
            seen = alpha(gaussians([0, 0, 5.0], [scale] * 3), pinhole())
            expected = np.zeros((33, 33))
            expected[16, 16] = 0.8  # the middle pixel's ray passes exactly through the mean
            assert np.allclose(seen, expected, atol=1e-6), (scale, alpha)


@pytest.mark.parametrize("length", [1e-6, 1e6])
def test_the_length_of_a_quaternion_changes_no_pixel(length):
    q = np.array([0.4, -0.2, 0.7, 0.3])
    q /= np.linalg.norm(q)
    g = gaussians([0, 0, 5.0], [0.5, 0.1, 1.0], quaternions=q)
    raster = Rasterizer(blending=SMOOTH, real=wp.float64)
    inputs = raster.upload(g)
    table = wp.ones((1, 1), dtype=wp.float64)
    turns = [wp.array([q * s], dtype=wp.vec4d) for s in (1.0, length)]
    found = [raster.rasterize(inputs[0], turn, *inputs[2:], table, pinhole()) for turn in turns]
    unit, scaled = (image.alpha.numpy() for image in found)
    assert unit.max() > 0.5
    assert np.allclose(unit, scaled, rtol=1e-12, atol=1e-14)
    entered = gaussians([0, 0, 5.0], [0.5, 0.1, 1.0], quaternions=q * length)
    assert np.allclose(ours32(entered, pinhole()), unit, atol=1e-5)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("seed", range(4))
def test_needles_of_one_to_ten_thousand(seed):
    rng = np.random.default_rng(seed)
    mean = [rng.uniform(-1, 1), rng.uniform(-1, 1), 5.0]
    g = gaussians(mean, [2.0, 2e-4, 2e-4], quaternions=rng.normal(size=4))
    cam = pinhole(201, 201, focal=300.0) if seed % 2 == 0 else look(ORIGIN, g.means[0], 201, 201, 20_000.0)
    blending = Blending(alpha_min=1e-4, alpha_max=1.0, transmittance_min=-0.5)
    expected = alpha_of_one(g, cam, blending)
    assert expected.max() > 0
    assert np.abs(ours64(g, cam, blending) - expected).max() < 1e-6
    # float32: a direction is rounded to 6e-8, which at 5 m is 3e-7 m, 1.5e-3 of the needle's width.
    assert np.abs(ours32(g, cam, blending) - expected).max() < 5e-3


PANORAMA = Camera.spherical(64, 32, position=ORIGIN)
ASIDE = (5.77, 5.77, 5.78)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(
    ("mean", "scales", "camera", "most64", "most32"),
    [
        *((m, [100.0] * 3, c, 1e-9, 1e-5)
          for m in ((3, -2, 5), (0, 0, 250), (80, 0, 0)) for c in (pinhole(), PANORAMA)),
        *(((0, 0, offset), [1.0, 0.5, 2.0], PANORAMA, 1e-9, 1e-5) for offset in (0.3, 1e-3, 1e-6)),  # inside it
        *(((0, 0, z), [0.5] * 3, PANORAMA, 1e-8, 2e-6) for z in (3, -3)),  # at a pole
        *(((-3, y, 0.5), [0.4, 0.3, 0.5], PANORAMA, 1e-9, 1e-5) for y in (0.0, -0.0, 1e-7)),  # on the seam
        ((0, 0, 1000), [0.5] * 3, pinhole(focal=2000.0), 1e-9, 1e-5),  # a pixel is half a metre there
        # 10 um, in pixels of 20 um: on the axis small components of directions keep their digits. Elsewhere they are
        # rounded to about 4e-8: 0.04 standard deviations, times the steepest slope 0.61.
        ((0, 0, 10), [1e-5] * 3, pinhole(focal=5e5), 1e-6, 1e-5),
        (ASIDE, [1e-5] * 3, look(ORIGIN, ASIDE, 33, 33, 5e5), 1e-6, 0.05),
    ],
)  # fmt: skip
def test_one_gaussian_of_any_size_is_what_its_definition_says(mean, scales, camera, most64, most32):
    g = gaussians(mean, scales)
    expected = alpha_of_one(g, camera, SMOOTH)
    assert expected.max() > 0.1
    assert np.abs(ours64(g, camera) - expected).max() < most64
    found = render(g, camera, np.ones((1, 1)), blending=SMOOTH)
    assert np.abs(found.alpha - expected).max() < most32
    peak = np.unravel_index(expected.argmax(), expected.shape)
    reach, _, _ = met(g, camera.position, camera.directions()[peak])
    assert found.depth[peak] == pytest.approx(float(reach[0]), rel=1e-5)


def test_camera_exactly_at_a_centre_does_not_see_that_gaussian():
    behind_it = gaussians([[0.5, 0.25, 0.125], [2.0, 0.25, 0.125]], [0.3] * 3)
    cam = Camera.spherical(64, 32, position=(0.5, 0.25, 0.125))
    for alpha in (ours32, ours64):
        assert np.array_equal(alpha(behind_it, cam), alpha(behind_it[1:], cam))
        assert alpha(behind_it, cam).max() > 0.7


@pytest.mark.usefixtures("device")
def test_equal_ranges_are_blended_in_the_order_given():
    g = gaussians([[0, 0, 2.0]] * 3, [0.3] * 3, opacities=(0.5, 0.25, 0.75))
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        chosen = g[np.array(order)]
        a, b, c = chosen.opacities
        out = render(chosen, pinhole(), np.eye(3), blending=SMOOTH)
        expected = [a, (1 - a) * b, (1 - a) * (1 - b) * c]
        assert out.features[16, 16] == pytest.approx(expected, abs=1e-6)
        assert out.dominant[16, 16] == int(np.argmax(expected))
    # Also where ranges are equal and places are not: mirror images about the axis.
    pair = gaussians([[0.1, 0, 2.0], [-0.1, 0, 2.0]], [0.3] * 3, opacities=0.5)
    response = 0.5 * np.exp(-0.5 * (2.0 * 0.1 / np.hypot(2.0, 0.1) / 0.3) ** 2 * (1 + 0.1**2 / 4))
    out = render(pair, pinhole(), np.eye(2), blending=SMOOTH)
    assert out.features[16, 16] == pytest.approx([response, (1 - response) * response], abs=1e-6)


def test_opacity_zero_contributes_nothing_and_opacity_one_hides_what_is_behind():
    g = gaussians([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]], [0.3] * 3, opacities=(0.0, 1.0, 0.5))
    out = render(g, pinhole(), np.eye(3), blending=SMOOTH)
    assert out.features[16, 16] == pytest.approx([0, 1, 0], abs=0)
    assert out.depth[16, 16] == pytest.approx(3.0) and out.dominant[16, 16] == 1
    assert (out.features[..., 0] == 0).all()
    photo = render(g, pinhole(), np.eye(3))  # clamped at 0.99, so that a hundredth passes
    assert photo.features[16, 16] == pytest.approx([0, 0.99, 0.01 * 0.5], abs=1e-6)


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("rule", ["product", "exp"])
def test_gradients_at_opacity_zero_and_one_are_those_of_the_blend(rule):
    """On the axis the image is a1 + T(a1) a2 with features one and two behind: derivatives in closed form."""
    for first, blending in ((1.0, SMOOTH), (0.0, SMOOTH), (1.0, Blending())):
        blending = Blending(blending.alpha_min, blending.alpha_max, blending.transmittance_min, rule)
        raster = Rasterizer(blending=blending, real=wp.float64)
        g = gaussians([[0, 0, 2.0], [0, 0, 3.0]], [0.3] * 3, opacities=(first, 0.5))
        inputs = raster.upload(g)
        for array in inputs:
            array.requires_grad = True
        table = wp.array([[1.0], [2.0]], dtype=wp.float64)
        with wp.Tape() as tape:
            out = raster.rasterize(*inputs, table, pinhole(1, 1))
        tape.backward(grads={out.features: wp.ones_like(out.features)})
        alpha = min(first, blending.alpha_max)
        left, slope = (1 - alpha, -1.0) if rule == "product" else (np.exp(-alpha), -np.exp(-alpha))
        clamped = first > blending.alpha_max
        # Opacity 0 is below the cutoff and sees no gradient, a clamped one neither. An alpha of exactly one hides what
        # is behind from its own gradient too, under the product rule: its weights are zero.
        behind = 0.0 if left == 0 else slope * 0.5 * 2.0
        d_first = 0.0 if clamped or first == 0 else 1.0 + behind
        assert inputs[3].grad.numpy() == pytest.approx([d_first, 2.0 * left], abs=1e-12)
        for array in inputs:
            assert np.isfinite(array.grad.numpy()).all()


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("count", [0, 3])
def test_none_visible_is_the_background_and_has_no_gradient_but_the_backgrounds(count):
    raster = Rasterizer(real=wp.float64)
    inputs = raster.upload(gaussians(np.full((count, 3), -50.0), [0.1] * 3))
    for array in inputs:
        array.requires_grad = True
    features = wp.ones((count, 2), dtype=wp.float64, requires_grad=True)
    background = wp.array([0.25, 0.5], dtype=wp.float64, requires_grad=True)
    with wp.Tape() as tape:
        out = raster.rasterize(*inputs, features, pinhole(20, 10), background)
    assert (out.features.numpy() == [0.25, 0.5]).all()
    assert (out.alpha.numpy() == 0).all() and (out.dominant.numpy() == -1).all()
    tape.backward(grads={out.features: wp.ones_like(out.features), out.depth: wp.ones_like(out.depth)})
    assert background.grad.numpy() == pytest.approx([200.0, 200.0])
    for array in (*inputs, features):
        assert (array.grad.numpy() == 0).all()


def test_one_million_gaussians_in_a_plane_let_through_what_the_dilogarithm_says():
    """A lattice of pitch h, scale s = h, opacity o: along a ray at angle theta to the plane's normal
    -ln T = 2 pi s^2 / (h^2 cos theta) (Li2(o) - Li2(alpha_min)), the integral of -ln(1 - alpha) over the lattice."""
    side, pitch, opacity = 1000, 0.01, 0.3
    grid = (np.arange(side) - (side - 1) / 2) * pitch
    x, y = np.meshgrid(grid, grid)
    g = gaussians(np.stack([x, y, np.full_like(x, 2.0)], axis=-1).reshape(-1, 3), [pitch] * 3, opacity)
    assert len(g) == 1_000_000
    cam = pinhole(25, 25, focal=12.5)
    blending = Blending(alpha_min=1e-3, alpha_max=1.0, transmittance_min=-0.5)
    out = render(g, cam, np.ones((len(g), 1)), background=0.0, blending=blending)

    def dilogarithm(v):
        return spence(1 - v)  # SciPy's spence(z) is Li2(1 - z)

    cosine = cam.directions()[..., 2]
    optical = 2 * np.pi / cosine * (dilogarithm(opacity) - dilogarithm(blending.alpha_min))
    # The cutoff's edge leaves alpha_min times the number of lattice points near it, a few.
    assert np.abs(out.alpha - (1 - np.exp(-optical))).max() < 4e-3
    assert np.abs(out.depth * cosine - 2.0).max() < 0.03
