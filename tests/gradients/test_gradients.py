"""Gradients of the rasteriser's whole path (parameters, image, loss), of rays through Gaussians, of path records by
their materials, and of specular paths by ends, orientations and materials, in float64: Warp's tape against finite differences
on many random scenes, with the cutoffs of photos; what lies at a cutoff; second backward calls."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from radio_scenes import box_mesh, joined
from rays_by_definition import blended, met
from scipy.spatial.transform import Rotation

from warprrf import device
from warprrf.geometry.mesh import Mesh
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussian_rays import GaussianRays
from warprrf.geometry.splats.rasterizer import Blending, Rasterizer
from warprrf.kernels.radio import records
from warprrf.rf.em.materials import Material
from warprrf.rf.em.waves import SPEED_OF_LIGHT
from warprrf.rf.paths.specular import OUTPUTS, POSITIONS
from warprrf.rf.paths.trace import trace_specular
from warprrf.rf.scene import Scene
from warprrf.rf.tracing.model import Parameters
from warprrf.rf.tracing.records import Materials, Records

CHANNELS = 5  # take two launches
RAYS, PLACES = 40, 3
NAMES = ("means", "quaternions", "scales", "opacities")
DTYPES = {"means": wp.vec3d, "quaternions": wp.vec4d, "scales": wp.vec3d}
# Relative step of the central differences; with one Richardson step their error is of order h^4 plus rounding / h.
STEP = 1e-5


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


@wp.kernel
def loss_of_rays(
    transmittance: wp.array(dtype=wp.float64),
    t: wp.array(dtype=wp.float64, ndim=2),
    alpha: wp.array(dtype=wp.float64, ndim=2),
    weight: wp.array(dtype=wp.float64, ndim=2),
    left: wp.array(dtype=wp.float64),
    index: wp.array(dtype=int, ndim=2),
    of_segment: wp.array(dtype=wp.float64),
    of_ray: wp.array(dtype=wp.float64),
    loss: wp.array(dtype=wp.float64),
):
    """Smooth and different in every output; rays weighted."""
    i = wp.tid()
    wp.atomic_add(loss, 0, of_segment[i] * wp.log(transmittance[i] + wp.float64(0.1)))
    wp.atomic_add(loss, 0, of_ray[i] * left[i] * left[i])
    for k in range(wp.static(PLACES)):
        if index[i, k] >= 0:
            share = of_ray[i] / wp.float64(1 + k)
            wp.atomic_add(loss, 0, share * (weight[i, k] * t[i, k] + wp.sin(alpha[i, k]) + t[i, k] * t[i, k]))


@wp.kernel
def loss_of_powers(
    power: wp.array(dtype=wp.float64), weight: wp.array(dtype=wp.float64), loss: wp.array(dtype=wp.float64)
):
    """Smooth and different in every power, as decibels above a floor are."""
    i = wp.tid()
    wp.atomic_add(loss, 0, weight[i] * wp.log(power[i] + wp.float64(0.1)))


@wp.kernel
def loss_of_numbers(
    values: wp.array(dtype=Any), weight: wp.array(dtype=Any), loss: wp.array(dtype=wp.float64)
):
    """Weighted sum."""
    i = wp.tid()
    wp.atomic_add(loss, 0, weight[i] * values[i])


@wp.kernel
def loss_of_vectors(
    values: wp.array(dtype=Any), weight: wp.array(dtype=Any), loss: wp.array(dtype=wp.float64)
):
    """Weighted sum of components; vectors of weight 0 may be NaN."""
    i = wp.tid()
    if wp.length_sq(weight[i]) > wp.float64(0.0):
        wp.atomic_add(loss, 0, wp.dot(weight[i], values[i]))


class WholePath:
    """Parameters ``values`` and a loss of them; ``spoil`` names one whose adjoint is planted wrong."""

    values: dict[str, np.ndarray]

    def __init__(self, seed: int, spoil: str | None = None) -> None:
        self.spoil = spoil
        self.blending = Blending(
            alpha_max=0.95, transmittance_min=0.02, rule=("product", "exp")[seed // 2 % 2]
        )
        self.draw(seed, np.random.default_rng(seed))

    def record(
        self, values: dict[str, np.ndarray], *only: Any
    ) -> tuple[wp.Tape, wp.array, dict[str, wp.array]]:
        arrays = self.arrays(values)
        loss = wp.zeros(1, dtype=wp.float64, requires_grad=True)
        with wp.Tape() as tape:
            if self.spoil is not None:  # recorded first, so it runs last, when the gradient is complete
                wrong = arrays[self.spoil]
                tape.record_func(lambda: wrong.grad.assign(wrong.grad.numpy() * (1 + 1e-4)), [wrong])
            self.add_loss(arrays, loss, *only)
        return tape, loss, arrays

    def arrays(self, values: dict[str, np.ndarray]) -> dict[str, wp.array]:
        return {
            k: wp.array(v, dtype=DTYPES.get(k, wp.float64), requires_grad=True) for k, v in values.items()
        }

    def loss(self, values: dict[str, np.ndarray]) -> float:
        return float(self.record(values)[1].numpy()[0])

    def gradients(self) -> dict[str, np.ndarray]:
        tape, loss, arrays = self.record(self.values)
        tape.backward(loss)
        return {k: v.grad.numpy().copy() for k, v in arrays.items()}

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


class Pictures(WholePath):
    """A random scene of Gaussians in a panorama or photo."""

    def draw(self, seed, rng):
        means = rng.uniform(-1.5, 1.5, (6, 3))
        self.values = {
            "means": means + 0.4 * np.sign(means),
            "quaternions": rng.normal(size=(6, 4)),
            "scales": np.exp(rng.uniform(np.log(0.08), np.log(0.6), (6, 3))),
            "opacities": rng.uniform(0.1, 1.0, 6),
            "sh": rng.normal(size=(6, 16, CHANNELS)) * 0.1,
            "background": rng.uniform(0.1, 1, CHANNELS),
        }
        self.camera = random_camera(rng, self.values["means"], spherical=seed % 2 == 0)
        self.target = rng.normal(size=(self.camera.height, self.camera.width, CHANNELS))
        # Interior pixels: no cutoff, clamp or early exit is decided otherwise within a step. Found once, so the loss
        # stays one function.
        *_, margin = blended(self.values, self.camera, self.values["sh"][:, 0], self.blending)
        self.interior = margin > 2e-3
        self.share = self.interior.mean()

    def image(self, a):
        raster = Rasterizer(blending=self.blending, real=wp.float64)
        colors = raster.colors(a["means"], a["sh"], self.camera)
        return raster.rasterize(*(a[name] for name in NAMES), colors, self.camera, a["background"])

    def add_loss(self, a, loss):
        image = self.image(a)
        given = wp.array(self.target, dtype=wp.float64), wp.array(self.interior, dtype=wp.float64)
        inputs = [image.features, image.alpha, image.depth, *given, loss]
        wp.launch(decibel_loss, dim=self.interior.shape, inputs=inputs)


class Rays(WholePath):
    """A random scene of Gaussians, rays and segments."""

    def draw(self, seed, rng):
        self.values = {
            "means": rng.uniform(-1.5, 1.5, (7, 3)),
            "quaternions": rng.normal(size=(7, 4)),
            "scales": np.exp(rng.uniform(np.log(0.08), np.log(0.7), (7, 3))),
            "opacities": rng.uniform(0.2, 1.0, 7),
        }
        self.order = ("peak", "range")[seed % 2]
        # Rays through the neighbourhood of random Gaussians, so that most meet several.
        self.start = rng.uniform(-2, 2, (RAYS, 3))
        aim = self.values["means"][rng.integers(7, size=RAYS)] + 0.1 * rng.normal(size=(RAYS, 3))
        self.end = self.start + rng.uniform(0.8, 2.5, (RAYS, 1)) * (aim - self.start)
        clear = self.margins() > self.MARGIN
        self.weights = [wp.array(clear * rng.uniform(0.5, 1.5, RAYS), dtype=wp.float64) for _ in range(2)]
        self.share = clear.mean()

    MARGIN = 1e-2
    """A ray counts if cutoff, clamp, segment's end, order and early exit are this far from deciding otherwise."""

    def margins(self):
        """How far each ray and its segment are from any decision, relatively."""
        along, b = self.end - self.start, self.blending
        found = [met(self.values, *ray) for ray in zip(self.start, along, strict=True)]
        t, raw = (np.stack([row[k] for row in found]) for k in (0, 1))
        decided = np.minimum(np.abs(np.log(raw / b.alpha_min)), np.abs(np.log(raw / b.alpha_max)))
        # A cutoff does not matter where the peak is far behind, nor the ends where the Gaussian is faint.
        faint = raw < b.alpha_min * np.exp(-self.MARGIN)
        ends = np.minimum(np.abs(t), np.abs(t - np.linalg.norm(along, axis=1)[:, None]))
        margin = np.where(t > -self.MARGIN, decided, np.inf).min(axis=1)
        margin = np.minimum(margin, np.where(faint, np.inf, ends).min(axis=1))
        reach = np.linalg.norm(self.values["means"] - self.start[:, None], axis=-1)
        key = np.where((t > 0) & ~faint, t if self.order == "peak" else reach, np.inf)
        order = np.argsort(key, axis=1)
        with np.errstate(invalid="ignore"):
            gaps = np.diff(np.take_along_axis(key, order, 1), axis=1)
        margin = np.minimum(margin, np.where(np.isfinite(gaps), gaps, np.inf).min(axis=1))
        alpha = np.where(np.isfinite(key) & (raw > b.alpha_min), np.minimum(raw, b.alpha_max), 0.0)
        alpha = np.take_along_axis(alpha, order, 1)
        left = np.cumprod(1 - alpha, axis=1) if b.rule == "product" else np.exp(-np.cumsum(alpha, axis=1))
        return np.minimum(margin, np.abs(left / b.transmittance_min - 1).min(axis=1))

    def add_loss(self, a, loss):
        rays = GaussianRays(tuple(a.values()), blending=self.blending)
        passed = rays.transmit(self.start, self.end)
        hits = rays.trace(self.start, self.end - self.start, PLACES, order=self.order)
        inputs = [passed, *hits.outputs, hits.index, *self.weights, loss]
        wp.launch(loss_of_rays, dim=RAYS, inputs=inputs)


class PathRecords(WholePath):
    """Records of every sequence by chance: powers by the materials' lobe weights, permittivities and mirrored shares."""

    SEQUENCES = ("M", "S", "MS", "SM", "MSM", "E", "EM", "TMT", "TS", "TSTT", "ET")
    share = 1.0

    def draw(self, seed, rng):
        kernel, self.launches = records.build(wp.float64).record_power, []
        lobes = tuple(rng.choice(40, 3, replace=False).tolist())
        weight, excess, mirror, through = (
            rng.uniform(0.1, 1.0, (3, 3)),
            rng.uniform(0.3, 20.0, 3),
            *rng.uniform(0.1, 1.0, (2, 3)),
        )
        self.values = {"weight": weight, "excess": excess, "mirror": mirror, "through": through}
        p = Parameters(np.log(weight), np.log(excess), np.log(mirror), lobes, reciprocal=seed % 2 == 1)
        group = rng.integers(0, 3, 4)  # the material of each
        slabs = np.where(rng.random(4) < 0.5, 3.0 - 0.2j, 0.0), rng.uniform(0.1, 2.0, 4)
        materials = Materials(p, slabs, group, rng.integers(0, 4, 6), rng.uniform(0.1, 3.0, 6))
        for name in self.SEQUENCES:
            columns = 3 if name == "M" else len(name)
            kinds = {"M": records.MIRROR, "S": records.SCATTER, "E": records.SOURCE, "T": records.SLAB}
            kind = np.tile(np.int8([kinds[letter] for letter in (columns * name)[:columns]]), (9, 1))
            index = rng.integers(0, 4, (9, columns)).astype(np.int32)
            index[:, 1:][rng.random((9, columns - 1)) < 0.3] = -1 if name == "M" else 0
            angle = rng.uniform(0.05, 1.0, (9, columns, 3))
            one = Records(index, angle, kind, rng.uniform(0.5, 2.0, 9), np.arange(9), half_width=0.01)
            self.launches.append(
                (kernel, *one._table(materials)[:2], wp.array(rng.normal(size=9), dtype=wp.float64))
            )

    def add_loss(self, a, loss):
        for kernel, table, materials, weight in self.launches:
            power = wp.empty(9, dtype=wp.float64, requires_grad=True)
            wp.launch(kernel, dim=9, inputs=[0, table, materials, *a.values(), power])
            wp.launch(loss_of_powers, dim=9, inputs=[power, weight, loss])


class SpecularPaths(WholePath):
    """Line of sight, chains of up to two mirrors and ways through up to two slabs, in a turned room with a pane and a solid wall
    across half of it: gains, Jones matrices, delays, angles and vertices by all that they hang on."""

    share = 1.0

    def draw(self, seed, rng):
        self.frequency_hz = float(np.exp(rng.uniform(np.log(1e9), np.log(100e9))))
        half = rng.uniform(1.5, 4.0, 3)
        sheet = box_mesh([0.3, -half[1], -half[2]], [0.301, rng.uniform(-0.5, 1.0), half[2]])
        sheet = sheet[0], sheet[1][(sheet[0][sheet[1]][:, :, 0] == 0.3).all(axis=1)]
        solid = box_mesh(
            [-0.5, rng.uniform(-1.0, 0.5), -half[2]], [-0.5 + rng.uniform(0.01, 0.2), half[1], half[2]]
        )
        mesh, part = joined(box_mesh(-half, half, inward=True), sheet, solid)
        turn = Rotation.random(None, rng).as_matrix()
        lossy = rng.uniform(0.01, 0.1, 3) * self.frequency_hz * 4.0 / 18e9
        materials = [
            Material.custom(f"m{k}", relative_permittivity=rng.uniform(2.0, 8.0), conductivity=lossy[k])
            for k in range(3)
        ]
        ends = np.concatenate([rng.uniform(0.5, 0.9, (1, 3)), rng.uniform(-0.9, 0.9, (2, 3))]) * half
        ends[:, 0] = np.array([1.0, -1.0, 1.0]) * rng.uniform(0.6, 0.9, 3) * half[0]
        held = trace_specular(
            Scene(Mesh(mesh.vertices @ turn.T, mesh.faces), materials, part), transmitter=turn @ ends[0],
            receivers=ends[1:] @ turn.T, frequency_hz=self.frequency_hz, mirror_order=2, transmissions=2,
        )  # fmt: skip
        wavelength_m = SPEED_OF_LIGHT / self.frequency_hz
        self.held, self.values = (
            held,
            {
                **held.parameters,
                "transmitter_orientation": rng.normal(size=(1, 3)),
                "receiver_orientation": rng.normal(size=(2 if seed % 2 else 1, 3)),
                "thickness_m": rng.uniform(0.2, 3.0, 3) * wavelength_m,
                "roughness_m": rng.uniform(0.02, 0.1, 3) * wavelength_m,
                "scattering": rng.uniform(0.1, 0.8, 3),
            },
        )
        known = {name: getattr(held.evaluate(**self.values), name) for name in OUTPUTS}
        self.weights = {
            name: rng.normal(size=numbers(v).shape) * np.isfinite(numbers(v)) for name, v in known.items()
        }
        # gains of 1e-4 and delays of 1e-8 count as much as angles
        self.scales = {name: np.nanmax(np.abs(value)) for name, value in known.items()}

    def arrays(self, values):
        types = {name: wp.vec3d for name in POSITIONS}
        return {k: wp.array(v, dtype=types.get(k, wp.float64), requires_grad=True) for k, v in values.items()}

    def add_loss(self, a, loss, only=OUTPUTS):
        found = self.held.evaluate(**a)
        for name in only:
            values = getattr(found, name).flatten()
            weight = wp.array(self.weights[name] / self.scales[name], dtype=values.dtype)
            weight = weight.reshape((values.size,))
            kernel = loss_of_numbers if values.dtype is wp.float64 else loss_of_vectors
            wp.launch(kernel, dim=values.size, inputs=[values, weight, loss])

    def errors(self):
        """Per input: worst deviation of a derivative of what is made of any output, relative to the largest of that output."""
        worst = {}
        for (name, _), (found, expected) in self.slopes().items():
            if np.abs(expected).max() > 1e-6:  # not of what does not hang on it
                off = np.abs(found - expected).max() / np.abs(expected).max()
                worst[name] = max(worst.get(name, 0.0), float(off))
        return worst

    def slopes(self):
        """By input and output: derivatives by the tape, and central differences with one Richardson step."""
        found, k = {}, 2.0 * np.pi * self.frequency_hz / SPEED_OF_LIGHT
        for output in OUTPUTS:
            tape, loss, arrays = self.record(self.values, (output,))
            tape.backward(loss)
            for name, array in arrays.items():
                found[name, output] = array.grad.numpy().copy(), np.zeros(self.values[name].shape)
        for name, value in self.values.items():
            for at in np.ndindex(value.shape):
                size = 1.0 if name in POSITIONS[2:] else 10.0 / k if name in POSITIONS else value[at]
                step = (1e-2 if name == "conductivity" else 1e-4) * size  # delays hardly hang on it
                move = step * (
                    np.arange(value.size).reshape(value.shape) == np.ravel_multi_index(at, value.shape)
                )
                sides = [
                    self.held.evaluate(**{**self.values, name: value + m * move}) for m in (1, -1, 2, -2)
                ]
                for output in OUTPUTS:
                    up, down, far_up, far_down = (numbers(getattr(side, output)) for side in sides)
                    near, far = up - down, far_up - far_down
                    if output in ("phi_r", "phi_t"):  # across pi
                        near, far = ((d + np.pi) % (2.0 * np.pi) - np.pi for d in (near, far))
                    slope = np.nan_to_num(8.0 * near - far) / (12.0 * step)
                    found[name, output][1][at] = (self.weights[output] * slope).sum() / self.scales[output]
        return found


def numbers(values):
    """Complex numbers as two."""
    return values.view(float).reshape(*values.shape, 2) if np.iscomplexobj(values) else values


def random_camera(rng: np.random.Generator, means: np.ndarray, *, spherical: bool) -> Camera:
    """A panorama amid the Gaussians, or a photo that shows two of their means at least."""
    if spherical:
        return Camera.spherical(18, 9, position=rng.uniform(-0.3, 0.3, 3))
    while True:
        rotation = Rotation.random(None, rng).as_matrix()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, rotation @ rng.uniform(-0.3, 0.3, 3)
        camera = Camera.pinhole(17, 11, fx=7.0, fy=8.0, cx=8.0, cy=6.0, world_to_camera=pose)
        pixels, _ = camera.project(means)
        if ((pixels > 0) & (pixels < (17, 11))).all(axis=1).sum() >= 2:
            return camera


SCENES = {Pictures: 32, Rays: 32, PathRecords: 60, SpecularPaths: 60}
EVERY_TIME = 20  # of each on the CPU
ON_A_GPU = 8  # of each: launches there are other ones, derivatives are not
EVERY = pytest.mark.parametrize("kind", SCENES)
CASES = [
    *(
        pytest.param(kind, k, "cpu", marks=[pytest.mark.long] * (k >= EVERY_TIME))
        for kind, count in SCENES.items()
        for k in range(count)
    ),
    *(pytest.param(kind, k, "cuda:0", marks=pytest.mark.cuda) for kind in SCENES for k in range(ON_A_GPU)),
]


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize(("kind", "seed", "device"), CASES, indirect=["device"])
def test_gradients_match_finite_differences_to_1e_6(kind, seed):
    path = kind(seed)
    assert path.share > 0.4  # most pixels or rays are away from decisions
    assert np.linalg.norm(next(iter(path.gradients().values()))) > 1e-3  # and something is seen
    errors = path.errors()
    assert max(errors.values()) < 1e-6, errors


@EVERY
def test_a_planted_wrong_adjoint_is_caught(kind):
    for name in kind(2).values:
        errors = kind(2, spoil=name).errors()
        assert errors.pop(name) > 1e-5, name
        assert max(errors.values()) < 1e-6, name  # and only that one


@EVERY
def test_a_second_backward_on_the_tape_adds_the_same_gradients_again(kind):
    path = kind(3)
    tape, loss, arrays = path.record(path.values)
    tape.backward(loss)
    once = {k: v.grad.numpy().copy() for k, v in arrays.items()}
    tape.backward(loss)
    for name, array in arrays.items():
        assert np.abs(once[name]).max() > 0
        assert np.allclose(array.grad.numpy(), 2 * once[name], rtol=1e-12, atol=1e-14), name
    tape.zero()
    tape.backward(loss)
    for name, array in arrays.items():
        assert np.allclose(array.grad.numpy(), once[name], rtol=1e-12, atol=1e-14), name


@EVERY
def test_gradients_do_not_depend_on_the_number_of_threads(kind, monkeypatch):
    both = []
    for count in (1, 2):  # of a CPU: a GPU adds in any order
        monkeypatch.setattr(device, "threads", lambda count=count: count)
        with wp.ScopedDevice("cpu"):
            both.append(kind(2).gradients())
    for name, gradient in both[0].items():
        assert np.array_equal(gradient, both[1][name]), name


def test_a_colour_that_is_cut_off_at_zero_has_no_gradient():
    means = wp.array([[1.0, 2.0, 3.0]], dtype=wp.vec3d, requires_grad=True)
    sh = wp.array([[[1.0, -4.0]]], dtype=wp.float64, requires_grad=True)
    with wp.Tape() as tape:
        colors = Rasterizer(real=wp.float64).colors(means, sh, Camera.spherical(4, 2, position=(0, 0, 0)))
    assert (colors.numpy() > 0).tolist() == [[True, False]]
    for times in (1, 2):
        tape.backward(grads={colors: wp.ones_like(colors)})
        np.testing.assert_allclose(sh.grad.numpy(), [[[times * 0.28209479177387814, 0.0]]], atol=1e-15)


@pytest.mark.parametrize("seed", range(6))
def test_a_step_over_a_cutoff_moves_a_pixel_by_one_faint_layer_at_most(seed):
    """Pixels at a threshold: the image jumps there, by no more than alpha_min times the pair's contrast, or than the
    light left at the early exit."""
    path, h = Pictures(seed), 1e-4
    path.values["sh"][:] = 0.0
    path.values["sh"][:, 0] = np.random.default_rng(seed).uniform(-1.0, 1.0, (6, CHANNELS))
    away = path.values["means"] + h * np.random.default_rng(seed).normal(size=(6, 3))
    still, moved = (
        path.image(path.arrays(values)).features.numpy()
        for values in (path.values, path.values | {"means": away})
    )
    # Without jumps a step h moves a pixel by h / s times the slope of the response, at most exp(-1/2) a layer.
    smooth = 6 * 5 * h / path.values["scales"].min()
    jump = 6 * path.blending.alpha_min + path.blending.transmittance_min
    difference = np.abs(moved - still).max(axis=2)
    assert difference[path.interior].max() < smooth
    assert difference.max() < smooth + jump


@pytest.mark.parametrize("layers", [1, 2])
def test_a_fully_opaque_layer_has_the_derivative_of_the_others_product(layers):
    """With alpha_max of one, T = (1 - a1)(1 - a2)(1 - 0.3): a division by 1 - a would be by zero."""
    opacities = np.array([1.0, 1.0 if layers == 2 else 0.5, 0.3])
    arrays = WholePath.arrays(
        None,
        {
            "means": [[1, 0, 0], [2, 0, 0], [3, 0, 0]],
            "quaternions": np.tile([1.0, 0, 0, 0], (3, 1)),
            "scales": np.full((3, 3), 0.1),
            "opacities": opacities,
        },
    )
    with wp.Tape() as tape:
        rays = GaussianRays(tuple(arrays.values()), blending=Blending(alpha_max=1.0))
        passed = rays.transmit([0, 0, 0], [4, 0, 0])
        left = rays.trace([0, 0, 0], [1, 0, 0], 3)
    assert passed.numpy()[0] == 0 and left.left.numpy()[0] == 0
    tape.backward(grads={passed: wp.ones(1, dtype=wp.float64)})
    expected = [-np.prod(1 - np.delete(opacities, i)) for i in range(3)]
    np.testing.assert_allclose(arrays["opacities"].grad.numpy(), expected, atol=1e-15)
