"""Photometric refinement: move, reshape, split and prune Gaussians until they render the photos.

Loss 0.8 L1 + 0.2 (1 - SSIM) on one photo a step, Adam on all parameters (Kerbl et al., "3D Gaussian Splatting", 2023).
Gaussians that lie on a detected plane are pulled into it after every step: bare walls constrain depth poorly, their
planes are known to millimetres. Deterministic for a seed on a CPU, whatever the number of threads; a run continued
from a checkpoint equals one that was never stopped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import warp as wp

from warprrf import tensor_files
from warprrf.checks import check_count
from warprrf.device import DeviceLike, Progress, launch, resolve, silent
from warprrf.geometry.photos.config import RefineConfig
from warprrf.geometry.photos.gaussians.densify import (
    PARAMETERS,
    PRUNE_OPACITY,
    STATISTICS,
    Arrays,
    densified,
    filled,
    opacity_and_scales,
)
from warprrf.geometry.photos.gaussians.targets import Exposures, Target, Targets
from warprrf.geometry.photos.posed.images import PosedPhotos
from warprrf.geometry.planes import Plane
from warprrf.geometry.splats.gaussians import Gaussians, quaternions_of, rotations_of
from warprrf.geometry.splats.photo_loss import PhotoLoss
from warprrf.geometry.splats.rasterizer import Rasterizer
from warprrf.kernels import adam as optimize
from warprrf.kernels.raster.sh import COEFFICIENTS

ENOUGH_TO_FILL = 100
"""Iterations from which on holes are filled: new Gaussians stand at a guessed depth until photos have moved them."""
CHECKPOINT = "warprrf refinement 2"

FINE_FROM, COARSE_PIXELS = 0.8, 100_000
"""Until this share of the iterations squares are twice as wide, and twice again, as long as photos would have more pixels."""
SCALE_RATE, QUATERNION_RATE, OPACITY_RATE, COLOR_RATE = 5e-3, 2e-3, 3e-2, 5e-3
"""Of the logarithms of scales, quaternions, logits of opacities and constant colours."""

PARTS = 1000  # of the work: what progress counts, as iterations become slower when photos are compared larger


def refine(
    gaussians: Gaussians,
    photos: PosedPhotos,
    *,
    config: RefineConfig,
    planes: Sequence[Plane] = (),
    progress: Progress | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    device: DeviceLike = None,
) -> Gaussians:
    """Optimise Gaussians against photos.

    Args:
        planes: detected planes; Gaussians on them are kept flat.
        checkpoint: file to continue from if it exists and to keep up to date; of the same arguments.
    """
    run = _Refinement(photos, config, planes, resolve(device))
    if checkpoint is not None and Path(checkpoint).exists():
        run.restore(Path(checkpoint))
    else:
        run.start(gaussians)
    report = progress or silent
    report("refine", run.done(), PARTS)
    while run.iteration < config.iterations:
        run.step()
        if checkpoint is not None and run.iteration % config.checkpoint_every == 0:
            run.store(Path(checkpoint))
        if run.iteration % 20 == 0 or run.iteration == config.iterations:
            report("refine", run.done(), PARTS)
    return run.result()


class _Refinement:
    """State of a run: what Adam moves, its moments, densification statistics, the iteration."""

    def __init__(
        self, photos: PosedPhotos, config: RefineConfig, planes: Sequence[Plane], device: wp.Device
    ) -> None:
        self.config, self.planes, self.device = config, list(planes), device
        # 0.2: weight of 1 - SSIM; L1 has the rest
        self.loss = PhotoLoss(device, 0.2)
        self.targets = Targets(photos, self.loss)
        self.exposures = Exposures(len(self.targets))
        self.iteration = 0
        self.raster = Rasterizer(device=device)
        table = np.array([[*p.normal, p.offset] for p in self.planes], dtype=np.float32).reshape(-1, 4)
        self.plane_table = wp.array(table, dtype=wp.vec4, device=self.device)

    def start(self, gaussians: Gaussians) -> None:
        """Begin with ``gaussians``, and others where they leave holes in the photos, if there is time to move those."""
        if self.config.iterations >= ENOUGH_TO_FILL:
            gaussians = filled(gaussians, self.targets.photos, device=self.device)
        self.load(self.on_planes(_initial(gaussians)))

    def on_planes(self, arrays: Arrays) -> Arrays:
        """``arrays`` with ``plane_of``, the nearest plane that each Gaussian lies on, -1 for none."""
        plane_distance_m, plane_angle_rad = 0.04, 0.6  # a Gaussian this close to a plane belongs to it
        best = np.full(len(arrays["means"]), plane_distance_m)
        owner = np.full(len(best), -1, np.int32)
        means = arrays["means"].astype(np.float64)
        axis = rotations_of(arrays["quaternions"])[:, :, 2]
        for k, plane in enumerate(self.planes):
            distance = np.abs(plane.distance(means))
            nearer = (distance < best) & (np.abs(axis @ plane.normal) > np.cos(plane_angle_rad))
            nearer[nearer] = plane.covers(means[nearer])
            best[nearer], owner[nearer] = distance[nearer], k
        return {**arrays, "plane_of": owner}

    def load(self, arrays: Arrays) -> None:
        n, device = len(arrays["means"]), self.device
        self.count = n
        self.widths = {name: arrays[name].reshape(n, -1).shape[1] for name in PARAMETERS}
        self.state = {
            name: wp.array(value.reshape(-1), dtype=int if name == "plane_of" else float, device=device)
            for name, value in arrays.items()
        }
        widths = self.widths.items()
        self.gradients = {name: wp.zeros(n * k, dtype=float, device=device) for name, k in widths}
        self.scales = wp.zeros(n, dtype=wp.vec3, requires_grad=True, device=device)
        self.opacities = wp.zeros(n, dtype=float, requires_grad=True, device=device)
        self.means = self.shaped("means", wp.vec3, (n,))
        self.quaternions = self.shaped("quaternions", wp.vec4, (n,))
        self.log_scales = self.shaped("log_scales", wp.vec3, (n,))
        self.sh = self.shaped("sh", float, (n, self.widths["sh"] // 3, 3))

    def shaped(self, name: str, dtype: type, shape: tuple[int, ...]) -> wp.array:
        """A view of a parameter's flat array as vectors or a table, with one of its gradient as its gradient."""
        view, grad = (
            wp.array(ptr=flat.ptr, dtype=dtype, shape=shape, device=flat.device, copy=False)
            for flat in (self.state[name], self.gradients[name])
        )
        view.grad = grad
        return view

    def arrays(self) -> Arrays:
        """The state on the host, one row per Gaussian."""
        return {name: value.numpy().reshape(self.count, -1).copy() for name, value in self.state.items()}

    def step(self) -> None:
        """One photo: render, differentiate, move; densify when it is time."""
        c, count = self.config, len(self.targets)
        epoch, position = divmod(self.iteration, count)
        view = int(np.random.default_rng([c.seed, 1, epoch]).permutation(count)[position])
        score = self.differentiate(self.targets.at(view, self.scale(self.iteration)))
        self.iteration += 1
        self.move()
        if self.iteration % 100 == 0 and not np.isfinite(score.numpy()).all():
            raise RuntimeError(f"refine: the loss became NaN at iteration {self.iteration}")
        # 0.65: of the iterations Gaussians are split and cloned
        until = 0.65 * c.iterations
        if c.densify_from <= self.iteration <= until and self.iteration % c.densify_every == 0:
            rng = np.random.default_rng([c.seed, 2, self.iteration])
            left = 1 + int((until - self.iteration) // c.densify_every)
            self.load(self.on_planes(densified(self.arrays(), c, rng, rounds_left=left)))

    def scale(self, iteration: int) -> int:
        """Side in pixels of the squares that photos are averaged over."""
        c, scale = self.config, self.config.downscale
        full_from = 0.9  # share of the iterations after which photos are taken as they are
        full_pixels = 400_000  # of larger photos fewer iterations see all, so that they take as long
        in_full = (1 - full_from) * min(1.0, full_pixels / self.targets.pixels)
        if iteration >= c.iterations - round(in_full * c.iterations):
            return 1
        if iteration < FINE_FROM * c.iterations:
            while self.targets.pixels > COARSE_PIXELS * scale**2:
                scale *= 2
        return scale

    def done(self) -> int:
        """Parts of the work that are behind."""
        sizes = np.array([self.scale(k) for k in range(self.config.iterations)])
        overhead = 30_000  # pixels that would take as long as what every iteration does besides
        work = np.cumsum(self.targets.pixels / sizes**2 + overhead)
        return int(PARTS * work[self.iteration - 1] / work[-1]) if self.iteration else 0

    def differentiate(self, target: Target) -> wp.array:
        """Render one photo and leave the loss's gradients in ``self.gradients``; returns the SSIM of every number."""
        camera = target.camera
        n, device, state = self.count, self.device, self.state
        logits, logits_grad = state["logits"], self.gradients["logits"]
        launch(optimize.activate, n, [self.log_scales, logits, self.scales, self.opacities], device=device)
        colors = wp.zeros((n, 3), dtype=float, requires_grad=True, device=device)
        origin = self.raster.colors_into(self.means, self.sh, camera, colors)
        prepared = self.raster.prepare(self.means, self.quaternions, self.scales, self.opacities, camera)
        image, adjoint = self.raster.blend_with_adjoint(prepared, colors)
        shape = camera.height, camera.width
        self.exposures.show(image.features, target, self.loss.canvas(shape))
        score, slope = self.loss(target.pixels, target.moments, shape)
        self.exposures.adjoint(image.features, target, slope)
        if self.config.fit_exposure:
            self.exposures.fit(image.features, target, self.iteration // len(self.targets))
        weight = adjoint()
        self.raster.colors_adjoint(self.means, self.sh, origin, colors)
        scales, opacities = self.scales, self.opacities
        slopes = [scales.grad, opacities.grad, self.log_scales.grad, logits_grad]
        launch(optimize.activate_adjoint, n, [scales, opacities, *slopes], device=device)
        scales.grad.zero_()
        opacities.grad.zero_()
        seen = [wp.vec3(camera.position), self.means, self.means.grad, weight]
        launch(optimize.accumulate, n, [*seen, *(state[name] for name in STATISTICS)], device=device)
        return score

    def move(self) -> None:
        """One step of Adam on everything, then the pull towards planes."""
        c, t = self.config, self.iteration
        # 4e-5: metres a step at the end; exponential from that at the start
        mean_rate = c.mean_rate * (4e-5 / c.mean_rate) ** (t / c.iterations)
        higher = [COLOR_RATE / 20] * (self.widths["sh"] - 3)  # the slower rate of the published method
        rates = {
            "means": [mean_rate] * 3, "quaternions": [QUATERNION_RATE] * 4, "log_scales": [SCALE_RATE] * 3,
            "logits": [OPACITY_RATE], "sh": [COLOR_RATE] * 3 + higher,
        }  # fmt: skip
        adam = optimize.build_adam(wp.float32)
        for name, width in self.widths.items():
            moments = [self.state[f"first.{name}"], self.state[f"second.{name}"]]
            inputs = [
                width,
                np.array(rates[name]),
                *optimize.corrections(t),
                None,
                None,
                self.gradients[name],
                *moments,
            ]
            launch(adam, self.count, [*inputs, self.state[name]], device=self.device)
        plane_strength = 0.1  # share of the deviation from its plane removed after every step
        strength = plane_strength if t < c.iterations else 1.0  # in the end exactly flat
        plane = [self.state["plane_of"], self.plane_table, strength, c.thickness_m]
        shape = [self.means, self.quaternions, self.log_scales]
        launch(optimize.pull_to_planes, self.count, [*plane, *shape], device=self.device)

    def result(self) -> Gaussians:
        """The Gaussians, without those too faint to matter."""
        arrays = self.arrays()
        opacity, scales = opacity_and_scales(arrays)
        keep = (opacity >= PRUNE_OPACITY) & (scales.max(axis=1) <= self.config.max_scale_m)
        sh = arrays["sh"].reshape(self.count, -1, 3)
        return Gaussians(arrays["means"], arrays["quaternions"], scales, opacity, sh)[keep]

    def store(self, path: Path) -> None:
        arrays = {**self.arrays(), "log_gains": self.exposures.log_gains}
        tensor_files.write(path, arrays, {"iteration": self.iteration}, CHECKPOINT)

    def restore(self, path: Path) -> None:
        try:
            arrays, header = tensor_files.read(path, CHECKPOINT)
        except ValueError as error:
            raise ValueError(f"checkpoint: it cannot be read; delete it to start over ({error})") from error
        self.iteration = check_count("iteration", header.get("iteration"), 0)
        self.exposures.log_gains = arrays.pop("log_gains")
        self.load(arrays)


def _initial(g: Gaussians) -> Arrays:
    """Parameters with the thin axis last, moments and statistics zero."""
    order = np.argsort(-g.scales, axis=1, kind="stable")
    rotations = np.take_along_axis(g.rotations, order[:, None, :], axis=2)
    rotations[:, :, 2] *= np.linalg.det(rotations)[:, None]
    # 1: of the colours: rooms are nearly matt
    sh = np.zeros((len(g), COEFFICIENTS[1], 3))
    sh[:, :1] = g.sh[:, :1]
    opacity = np.clip(g.opacities.astype(np.float64), 1e-4, 1 - 1e-4)
    values = {
        "means": g.means,
        "quaternions": quaternions_of(rotations),
        "log_scales": np.log(np.take_along_axis(g.scales, order, axis=1).astype(np.float64)),
        "logits": np.log(opacity / (1 - opacity)),
        "sh": sh,
    }
    arrays = {name: np.ascontiguousarray(v, dtype=np.float32) for name, v in values.items()}
    for name in PARAMETERS:
        arrays[f"first.{name}"], arrays[f"second.{name}"] = (np.zeros_like(arrays[name]) for _ in range(2))
    return {**arrays, **{name: np.zeros((len(g), 1), np.float32) for name in STATISTICS}}
