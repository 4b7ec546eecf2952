"""Gradients of the whole path, parameters -> image -> loss, in float64: Warp's tape against finite differences on many
random scenes, with the cutoffs of photos; what lies at a cutoff; second backward calls and gradients used again."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.rasterizer import Blending, Rasterizer

pytestmark = pytest.mark.usefixtures("each_form")

SCENES = 60
COUNT, CHANNELS = 6, 5  # five channels take two launches
DTYPES = {"means": wp.vec3d, "quaternions": wp.vec4d, "scales": wp.vec3d}
# Relative step of the central differences; with one Richardson step their error is of order h^4 plus rounding / h.
STEP = 1e-5
# No pixel may decide a cutoff, the clamp or the early exit otherwise within a step: each is this far away, relatively.
MARGIN = 2e-3


@wp.kernel
def decibel_loss(
    features: wp.array(dtype=wp.float64, ndim=3),
    alpha: wp.array(dtype=wp.float64, ndim=2),
    depth: wp.array(dtype=wp.float64, ndim=2),
    target: wp.array(dtype=wp.float64, ndim=3),
    weight: wp.array(dtype=wp.float64, ndim=2),
    loss: wp.array(dtype=wp.float64),
):
    """Squared error of log(features + 0.1), plus squares of alpha and depth; pixels weighted."""
    y, x = wp.tid()
    error = wp.float64(0.1) * depth[y, x] * depth[y, x] + alpha[y, x] * alpha[y, x]
    for c in range(wp.static(CHANNELS)):
        value = wp.log(features[y, x, c] + wp.float64(0.1)) - target[y, x, c]
        error += value * value
    wp.atomic_add(loss, 0, weight[y, x] * error)


class WholePath:
    """A random scene, a camera and a loss; ``spoil`` names an input whose adjoint is planted wrong."""

    def __init__(self, seed: int, *, spoil: str | None = None) -> None:
        rng = np.random.default_rng(seed)
        means = rng.uniform(-1.5, 1.5, (COUNT, 3))
        self.values = {
            "means": means + 0.4 * np.sign(means),
            "quaternions": rng.normal(size=(COUNT, 4)),
            "scales": np.exp(rng.uniform(np.log(0.08), np.log(0.6), (COUNT, 3))),
            "opacities": rng.uniform(0.1, 1.0, COUNT),
            "sh": rng.normal(size=(COUNT, 16, CHANNELS)) * 0.1,
            "background": rng.uniform(0.1, 1, CHANNELS),
        }
        self.camera = random_camera(rng, self.values["means"], spherical=seed % 2 == 0)
        self.blending = Blending(
            alpha_max=0.95, transmittance_min=0.02, rule=("product", "exp")[seed // 2 % 2]
        )
        self.target = rng.normal(size=(self.camera.height, self.camera.width, CHANNELS))
        self.spoil = spoil
        # Interior pixels: nothing of theirs is decided within a step. Decided once, so the loss stays one function.
        self.interior = (margins(self.values, self.camera, self.blending) > MARGIN).astype(np.float64)

    def arrays(self, values: dict[str, np.ndarray]) -> dict[str, wp.array]:
        return {
            k: wp.array(v, dtype=DTYPES.get(k, wp.float64), requires_grad=True) for k, v in values.items()
        }

    def record(self, values: dict[str, np.ndarray]) -> tuple[wp.Tape, wp.array, dict[str, wp.array]]:
        raster = Rasterizer(blending=self.blending, real=wp.float64)
        a = self.arrays(values)
        loss = wp.zeros(1, dtype=wp.float64, requires_grad=True)
        target = wp.array(self.target, dtype=wp.float64)
        weight = wp.array(self.interior, dtype=wp.float64)
        with wp.Tape() as tape:
            if self.spoil is not None:  # recorded first, so it runs last, when the gradient is complete
                wrong = a[self.spoil]
                tape.record_func(lambda: wrong.grad.assign(wrong.grad.numpy() * (1 + 1e-4)), [wrong])
            colors = raster.colors(a["means"], a["sh"], self.camera)
            image = raster.rasterize(
                a["means"],
                a["quaternions"],
                a["scales"],
                a["opacities"],
                colors,
                self.camera,
                a["background"],
            )
            wp.launch(
                decibel_loss,
                dim=self.interior.shape,
                inputs=[image.features, image.alpha, image.depth, target, weight, loss],
            )
        return tape, loss, a

    def loss(self, values: dict[str, np.ndarray]) -> float:
        return float(self.record(values)[1].numpy()[0])

    def gradients(self) -> dict[str, np.ndarray]:
        tape, loss, a = self.record(self.values)
        tape.backward(loss)
        return {k: v.grad.numpy().copy() for k, v in a.items()}

    def errors(self) -> dict[str, float]:
        """Per input: deviation of the derivative along a random direction from central differences, relative to the
        length of the gradient, as a random direction meets it."""
        rng = np.random.default_rng(99)
        out = {}
        for name, gradient in self.gradients().items():
            v = rng.normal(size=gradient.shape)
            # Along the gradient too: a random direction alone could be nearly perpendicular to it.
            v = v / np.linalg.norm(v) + gradient / max(np.linalg.norm(gradient), 1e-300)
            estimates = []
            for h in (2 * STEP, STEP):
                up, down = (
                    self.loss({**self.values, name: self.values[name] + sign * h * v}) for sign in (1, -1)
                )
                estimates.append((up - down) / (2 * h))
            expected = (4 * estimates[1] - estimates[0]) / 3
            out[name] = abs(float(np.sum(gradient * v)) - expected) / max(np.linalg.norm(gradient), 1e-6)
        return out


def random_camera(rng: np.random.Generator, means: np.ndarray, *, spherical: bool) -> Camera:
    """A panorama amid the Gaussians, or a photo that shows two of their means at least."""
    if spherical:
        return Camera.spherical(18, 9, position=rng.uniform(-0.3, 0.3, 3))
    while True:
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation *= np.sign(np.linalg.det(rotation))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, rotation @ rng.uniform(-0.3, 0.3, 3)
        camera = Camera.pinhole(17, 11, fx=7.0, fy=8.0, cx=8.0, cy=6.0, world_to_camera=pose)
        pixels, _ = camera.project(means)
        if ((pixels > 0) & (pixels < (17, 11))).all(axis=1).sum() >= 2:
            return camera


def margins(values: dict[str, np.ndarray], camera: Camera, blending: Blending) -> np.ndarray:
    """Smallest relative distance of any pixel's pairs from a decision: cutoff, clamp, early exit, half-space."""
    w, x, y, z = (values["quaternions"] / np.linalg.norm(values["quaternions"], axis=1, keepdims=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
        1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    rotations = np.stack(rows, axis=1).reshape(-1, 3, 3)
    directions = camera.directions()
    m = values["means"] - camera.position
    left = np.ones(directions.shape[:2])
    closest = np.full(directions.shape[:2], np.inf)
    for k in np.argsort(np.linalg.norm(m, axis=1)):
        whiten = rotations[k].T / values["scales"][k][:, None]
        g, o = directions @ whiten.T, whiten @ m[k]
        along = g @ o
        q = np.sum(np.cross(g, o) ** 2, axis=-1) / np.sum(g * g, axis=-1)
        raw = values["opacities"][k] * np.exp(-q / 2)
        cosine = along / np.linalg.norm(g, axis=-1) / np.linalg.norm(o)
        near = np.minimum(np.abs(raw / blending.alpha_min - 1), np.abs(raw / blending.alpha_max - 1))
        # Cutoffs far from deciding do not matter where the Gaussian lies behind, nor the half-space where it is faint.
        closest = np.where(cosine > -0.01, np.minimum(closest, near), closest)
        closest = np.where(raw > 0.5 * blending.alpha_min, np.minimum(closest, np.abs(cosine)), closest)
        closest = np.minimum(closest, np.abs(left / blending.transmittance_min - 1))
        alpha = np.where((raw > blending.alpha_min) & (along > 0), np.minimum(raw, blending.alpha_max), 0)
        alpha = np.where(left > blending.transmittance_min, alpha, 0)
        left = left * (1 - alpha if blending.rule == "product" else np.exp(-alpha))
    return closest


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("seed", range(SCENES))
def test_whole_path_gradients_match_finite_differences_to_1e_6(seed):
    path = WholePath(seed)
    assert path.interior.mean() > 0.5  # the scene is mostly away from decisions
    assert np.linalg.norm(path.gradients()["means"]) > 1e-3  # and something is seen
    errors = path.errors()
    assert max(errors.values()) < 1e-6, errors


@pytest.mark.parametrize("name", ["means", "quaternions", "scales", "opacities", "sh", "background"])
def test_a_planted_wrong_adjoint_is_caught(name):
    errors = WholePath(1, spoil=name).errors()
    assert errors.pop(name) > 1e-5
    assert max(errors.values()) < 1e-6  # and only that one


@pytest.mark.parametrize("seed", range(10))
def test_a_step_over_a_cutoff_moves_a_pixel_by_one_faint_layer_at_most(seed):
    """Pixels at a threshold: the image jumps there, by no more than alpha_min times the pair's contrast, or than the
    light left at the early exit."""
    path = WholePath(seed)
    raster = Rasterizer(blending=path.blending, real=wp.float64)
    rng = np.random.default_rng(seed)
    features, background = rng.random((COUNT, CHANNELS)), rng.random(CHANNELS)

    def image(values):
        a = path.arrays(values)
        table = wp.array(features, dtype=wp.float64)
        return raster.rasterize(
            a["means"], a["quaternions"], a["scales"], a["opacities"], table, path.camera, background
        ).features.numpy()

    still, h = image(path.values), 1e-4
    moved = image({**path.values, "means": path.values["means"] + h * rng.normal(size=(COUNT, 3))})
    # Without jumps a step h moves a pixel by h / s times the slope of the response, at most exp(-1/2) a layer.
    smooth = COUNT * 5 * h / path.values["scales"].min()
    jump = COUNT * path.blending.alpha_min + path.blending.transmittance_min
    difference = np.abs(moved - still).max(axis=2)
    interior = path.interior > 0
    assert difference[interior].max() < smooth
    assert difference.max() < smooth + jump


def test_a_second_backward_on_the_tape_adds_the_same_gradients_again():
    tape, loss, a = WholePath(3).record(WholePath(3).values)
    tape.backward(loss)
    once = {k: v.grad.numpy().copy() for k, v in a.items()}
    tape.backward(loss)
    for name, array in a.items():
        assert np.allclose(array.grad.numpy(), 2 * once[name], rtol=1e-12, atol=1e-14), name
    tape.zero()
    tape.backward(loss)
    for name, array in a.items():
        assert np.abs(once[name]).max() > 0
        assert np.array_equal(array.grad.numpy(), once[name]), name


def test_gradients_handed_to_the_tape_can_be_used_again():
    path = WholePath(4)
    raster = Rasterizer(blending=path.blending, real=wp.float64)
    seed = wp.array(np.random.default_rng(0).normal(size=path.target.shape), dtype=wp.float64)
    kept = seed.numpy().copy()
    found = []
    for _ in range(2):
        a = path.arrays(path.values)
        with wp.Tape() as tape:
            colors = raster.colors(a["means"], a["sh"], path.camera)
            image = raster.rasterize(
                a["means"],
                a["quaternions"],
                a["scales"],
                a["opacities"],
                colors,
                path.camera,
                a["background"],
            )
        tape.backward(grads={image.features: seed})
        found.append({k: v.grad.numpy().copy() for k, v in a.items()})
        assert np.array_equal(seed.numpy(), kept)
    for name in found[0]:
        assert np.abs(found[0][name]).max() > 0
        assert np.array_equal(found[0][name], found[1][name]), name
