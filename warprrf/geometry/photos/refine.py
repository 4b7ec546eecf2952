"""Photometric refinement: move, reshape, split and prune Gaussians until they render the photos.

Loss 0.8 L1 + 0.2 (1 - SSIM) on one photo a step, Adam on all parameters (Kerbl et al., "3D Gaussian Splatting", 2023,
states loss and rates; where we differ is said at the setting). Gaussians that lie on a detected plane are pulled into
it after every step: bare walls constrain depth poorly, their planes are known to millimetres. Deterministic for a seed
on a CPU, whatever the number of threads; a run continued from a checkpoint equals one that was never stopped.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warprrf.device import Progress, check_array, launch, resolve
from warprrf.files import write_atomically
from warprrf.geometry.photos.planes import Plane
from warprrf.geometry.splats.camera import Camera
from warprrf.geometry.splats.gaussians import Gaussians, quaternions_of, rotations_of
from warprrf.geometry.splats.rasterizer import Blending, Rasterizer
from warprrf.kernels import adam as optimize
from warprrf.kernels import ssim as ssim_kernels
from warprrf.kernels.raster.sh import COEFFICIENTS


@dataclass(frozen=True)
class RefineConfig:
    """Settings of :func:`refine`; the defaults suit about 100 photos of a furnished room on two CPU cores.

    Attributes:
        iterations: steps, one photo each.
        downscale: photos are averaged over squares of this many pixels while training.
        full_from: share of the iterations after which photos are taken as they are.
        sh_degree: of the colours; rendered rooms are nearly matt, so 1.
        ssim_share: weight of 1 - SSIM; L1 has the rest.
        mean_rate, final_mean_rate: metres a step at the start and the end, exponential in between.
        densify_from, densify_until, densify_every: in iterations; ``until`` as a share of all.
        densify_share: at most this share of the Gaussians is split or cloned at a time, those with the largest mean
            gradient of the projected position.
        max_gaussians: densification stops here.
        split_above_m: larger ones are split, smaller ones cloned.
        prune_opacity: fainter ones are removed.
        max_scale_m: larger ones are removed ("abnormally large"; the paper's centre approximation relies on it).
        thickness_m: upper bound of the smallest scale.
        plane_distance_m, plane_angle_rad: a Gaussian this close to a plane belongs to it.
        plane_strength: share of the deviation from its plane removed after every step.
        checkpoint_every: iterations.
    """

    iterations: int = 2400
    downscale: int = 2
    full_from: float = 0.9
    sh_degree: int = 1
    ssim_share: float = 0.2
    mean_rate: float = 4e-4
    final_mean_rate: float = 4e-5
    scale_rate: float = 5e-3
    quaternion_rate: float = 2e-3
    opacity_rate: float = 3e-2
    color_rate: float = 5e-3
    densify_from: int = 300
    densify_until: float = 0.65
    densify_every: int = 200
    densify_share: float = 0.08
    max_gaussians: int = 60_000
    split_above_m: float = 0.03
    prune_opacity: float = 0.02
    max_scale_m: float = 0.3
    thickness_m: float = 0.004
    plane_distance_m: float = 0.04
    plane_angle_rad: float = 0.6
    plane_strength: float = 0.1
    checkpoint_every: int = 300

    def __post_init__(self) -> None:
        for name in ("iterations", "downscale", "densify_every", "max_gaussians", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: got {getattr(self, name)!r}, expected at least 1")
        if self.sh_degree not in COEFFICIENTS:
            raise ValueError(f"sh_degree: got {self.sh_degree!r}, expected 0, 1, 2 or 3")


def refine(
    gaussians: Gaussians,
    images: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    *,
    config: RefineConfig | None = None,
    planes: Sequence[Plane] = (),
    seed: int = 0,
    progress: Progress | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    device: Any = None,
) -> Gaussians:
    """Optimise Gaussians against photos.

    Args:
        images: photos in [0, 1], each ``(H, W, 3)``, one per camera.
        cameras: pinhole cameras of the same sizes.
        planes: detected planes; Gaussians on them are kept flat.
        checkpoint: file to continue from if it exists and to keep up to date; it is removed by nobody.

    Raises:
        ValueError: if images and cameras do not match, or a checkpoint is of other settings or damaged.
        RuntimeError: if the loss becomes NaN.
    """
    config = config or RefineConfig()
    if len(images) != len(cameras) or not images:
        raise ValueError(
            f"images: got {len(images)} for {len(cameras)} cameras, expected one each and at least one"
        )
    for k, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        if camera.kind != "pinhole":
            raise ValueError(f"cameras[{k}]: got a {camera.kind} camera, expected pinhole")
        check_array(f"images[{k}]", image, (camera.height, camera.width, 3), np.float32)
    run = _Refinement(gaussians, images, cameras, config, planes, seed, resolve(device))
    if checkpoint is not None and Path(checkpoint).exists():
        run.restore(Path(checkpoint))
    while run.iteration < config.iterations:
        run.step()
        if checkpoint is not None and run.iteration % config.checkpoint_every == 0:
            run.store(Path(checkpoint))
        if progress is not None and (run.iteration % 20 == 0 or run.iteration == config.iterations):
            progress("refine", run.iteration, config.iterations)
    return run.result()


class PhotoLoss:
    """0.8 L1 + 0.2 (1 - SSIM) of a rendered ``(H, W, 3)`` image and its derivative, in Warp."""

    def __init__(self, device: Any, ssim_share: float, real: Any = wp.float32) -> None:
        self.device, self.ssim_share, self.real = device, ssim_share, real
        self.kernels = ssim_kernels.build(real)

    def moments(self, image: wp.array, target: wp.array, shape: tuple[int, int, int]) -> wp.array:
        """Window averages of (u, u^2, u t)."""
        products = wp.empty(image.size, dtype=self.kernels.vec3, device=self.device)
        launch(self.kernels.moments, image.size, [image, target, products], device=self.device)
        return self.filtered(products, shape)

    def filtered(self, source: wp.array, shape: tuple[int, int, int]) -> wp.array:
        """Window averages of an image of vectors."""
        height, width, channels = shape
        between = wp.empty_like(source)
        out = wp.empty_like(source)
        launch(
            self.kernels.filter_rows, source.size, [width, channels, 0, source, between], device=self.device
        )
        launch(
            self.kernels.filter_columns,
            source.size,
            [height, width * channels, between, out],
            device=self.device,
        )
        return out

    def __call__(
        self, image: wp.array, target: wp.array, target_moments: wp.array, gradient: wp.array
    ) -> wp.array:
        """Write dL/d(image) to ``gradient``; returns the SSIM of every element, flat."""
        shape, count = image.shape, image.size
        flat, out = image.flatten(), gradient.flatten()
        score = wp.empty(count, dtype=self.real, device=self.device)
        slopes = wp.empty(count, dtype=self.kernels.vec3, device=self.device)
        averages = self.moments(flat, target, shape)
        launch(self.kernels.slopes, count, [target_moments, averages, score, slopes], device=self.device)
        filtered = self.filtered(slopes, shape)
        shares = [(1 - self.ssim_share) / count, self.ssim_share / count]
        launch(self.kernels.adjoint, count, [flat, target, filtered, *shares, out], device=self.device)
        return score


class _Refinement:
    """State of a run: what Adam moves, its moments, densification statistics, the iteration."""

    WIDTHS = {"means": 3, "quaternions": 4, "log_scales": 3, "logits": 1}

    def __init__(
        self,
        gaussians: Gaussians,
        images: Sequence[np.ndarray],
        cameras: Sequence[Camera],
        config: RefineConfig,
        planes: Sequence[Plane],
        seed: int,
        device: Any,
    ) -> None:
        self.config, self.planes, self.seed, self.device = config, list(planes), seed, device
        self.images, self.cameras = images, cameras
        self.iteration = 0
        self.raster = Rasterizer(device=device, blending=Blending())
        self.loss = PhotoLoss(device, config.ssim_share)
        self.targets: dict[tuple[int, int], tuple[wp.array, wp.array]] = {}
        self.views: dict[tuple[int, int], Camera] = {}
        self.width_sh = 3 * COEFFICIENTS[config.sh_degree]
        self.plane_table = wp.array(
            np.array([[*p.normal, p.offset] for p in self.planes], dtype=np.float32).reshape(-1, 4),
            dtype=wp.vec4,
            device=device,
        )
        self.load(self.initial(gaussians))

    def initial(self, g: Gaussians) -> dict[str, np.ndarray]:
        """Parameters with the thin axis last."""
        order = np.argsort(-g.scales, axis=1, kind="stable")
        scales = np.take_along_axis(g.scales, order, axis=1).astype(np.float64)
        rotations = np.take_along_axis(g.rotations, order[:, None, :], axis=2)
        rotations[:, :, 2] *= np.linalg.det(rotations)[:, None]
        coefficients = COEFFICIENTS[self.config.sh_degree]
        sh = np.zeros((len(g), coefficients, 3))
        kept = min(coefficients, g.sh.shape[1])
        sh[:, :kept] = g.sh[:, :kept]
        opacity = np.clip(g.opacities.astype(np.float64), 1e-4, 1 - 1e-4)
        values = {
            "means": g.means,
            "quaternions": quaternions_of(rotations),
            "log_scales": np.log(scales),
            "logits": np.log(opacity / (1 - opacity)),
            "sh": sh,
        }
        arrays = {name: np.ascontiguousarray(v, dtype=np.float32) for name, v in values.items()}
        for name in values:
            arrays[f"first.{name}"] = np.zeros_like(arrays[name])
            arrays[f"second.{name}"] = np.zeros_like(arrays[name])
        arrays["pull"] = np.zeros(len(g), np.float32)
        arrays["hits"] = np.zeros(len(g), np.float32)
        arrays["seen"] = np.zeros(len(g), np.float32)
        return self.with_planes(arrays)

    def with_planes(self, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Assign every Gaussian to the nearest plane that it lies on."""
        c = self.config
        best = np.full(len(arrays["means"]), c.plane_distance_m)
        owner = np.full(len(best), -1, np.int32)
        means = arrays["means"].astype(np.float64)
        w, x, y, z = (arrays["quaternions"] / np.linalg.norm(arrays["quaternions"], axis=1, keepdims=True)).T
        axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
        for k, plane in enumerate(self.planes):
            distance = np.abs(plane.distance(means))
            aligned = np.abs(axis @ plane.normal) > np.cos(c.plane_angle_rad)
            nearer = (distance < best) & aligned
            nearer[nearer] = plane.covers(means[nearer])
            best[nearer], owner[nearer] = distance[nearer], k
        return {**arrays, "plane_of": owner}

    def load(self, arrays: dict[str, np.ndarray]) -> None:
        """Put the state on the device."""
        n, device = len(arrays["means"]), self.device
        self.count = n
        self.state = {
            name: wp.array(value.reshape(-1), dtype=int if name == "plane_of" else float, device=device)
            for name, value in arrays.items()
        }
        self.widths = {**self.WIDTHS, "sh": self.width_sh}
        self.gradients = {
            name: wp.zeros(n * k, dtype=float, device=device) for name, k in self.widths.items()
        }
        self.scales = wp.zeros(n, dtype=wp.vec3, requires_grad=True, device=device)
        self.opacities = wp.zeros(n, dtype=float, requires_grad=True, device=device)
        self.means = _shaped(self.state["means"], wp.vec3, (n,), self.gradients["means"])
        self.quaternions = _shaped(self.state["quaternions"], wp.vec4, (n,), self.gradients["quaternions"])
        self.log_scales = _shaped(self.state["log_scales"], wp.vec3, (n,), self.gradients["log_scales"])
        self.sh = _shaped(self.state["sh"], float, (n, self.width_sh // 3, 3), self.gradients["sh"])

    def arrays(self) -> dict[str, np.ndarray]:
        """The state on the host, one row per Gaussian."""
        return {name: value.numpy().reshape(self.count, -1).copy() for name, value in self.state.items()}

    def target(self, view: int, scale: int) -> tuple[Camera, wp.array, wp.array]:
        """Camera, photo and the photo's window averages at a downscale."""
        key = (view, scale)
        if key not in self.targets:
            image = np.asarray(self.images[view], dtype=np.float32)
            height, width = image.shape[0] // scale, image.shape[1] // scale
            cut = image[: height * scale, : width * scale]
            small = cut.reshape(height, scale, width, scale, 3).mean(axis=(1, 3), dtype=np.float32)
            pixels = wp.array(small.reshape(-1), dtype=float, device=self.device)
            camera = self.cameras[view]
            self.views[key] = Camera(
                "pinhole", width, height, camera.world_to_camera,
                camera.fx / scale, camera.fy / scale, camera.cx / scale, camera.cy / scale,
            )  # fmt: skip
            self.targets[key] = (pixels, self.loss.moments(pixels, pixels, small.shape))
        return self.views[key], *self.targets[key]

    def step(self) -> None:
        """One photo: render, differentiate, move; densify when it is time."""
        c, device, n = self.config, self.device, self.count
        epoch, position = divmod(self.iteration, len(self.images))
        view = int(np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.images))[position])
        scale = c.downscale if self.iteration < c.full_from * c.iterations else 1
        camera, target, target_moments = self.target(view, scale)
        launch(
            optimize.activate,
            n,
            [self.log_scales, self.state["logits"], self.scales, self.opacities],
            device=device,
        )
        colors = wp.zeros((n, 3), dtype=float, requires_grad=True, device=device)
        origin = self.raster.colors_into(self.means, self.sh, camera, colors)
        prepared = self.raster.prepare(self.means, self.quaternions, self.scales, self.opacities, camera)
        image, adjoint = self.raster.blend_with_adjoint(prepared, colors)
        score = self.loss(image.features, target, target_moments, image.features.grad)
        seen = adjoint()
        self.raster.colors_adjoint(self.means, self.sh, origin, colors)
        launch(
            optimize.activate_adjoint,
            n,
            [self.scales, self.opacities, self.scales.grad, self.opacities.grad, self.log_scales.grad,
             self.gradients["logits"]],
            device=device,
        )  # fmt: skip
        self.scales.grad.zero_()
        self.opacities.grad.zero_()
        launch(
            optimize.accumulate,
            n,
            [wp.vec3(camera.position), self.means, self.means.grad, seen, self.state["pull"], self.state["hits"],
             self.state["seen"]],
            device=device,
        )  # fmt: skip
        self.iteration += 1
        self.move()
        if self.iteration % 100 == 0 and not np.isfinite(score.numpy()).all():
            raise RuntimeError(f"refine: the loss became NaN at iteration {self.iteration}")
        until = c.densify_until * c.iterations
        if c.densify_from <= self.iteration <= until and self.iteration % c.densify_every == 0:
            self.densify()

    def move(self) -> None:
        """One step of Adam on everything, then the pull towards planes."""
        c, t = self.config, self.iteration
        progress = t / c.iterations
        mean_rate = c.mean_rate * (c.final_mean_rate / c.mean_rate) ** progress
        higher = [c.color_rate / 20] * (self.width_sh - 3)  # the slower rate of the published method
        rates = {
            "means": [mean_rate] * 3, "quaternions": [c.quaternion_rate] * 4, "log_scales": [c.scale_rate] * 3,
            "logits": [c.opacity_rate], "sh": [c.color_rate] * 3 + higher,
        }  # fmt: skip
        corrections = [1 / (1 - 0.9**t), 1 / (1 - 0.999**t)]
        for name, width in self.widths.items():
            rate = wp.array(rates[name], dtype=float, device=self.device)
            moments = [self.state[f"first.{name}"], self.state[f"second.{name}"]]
            launch(
                optimize.adam,
                self.count,
                [width, rate, *corrections, self.gradients[name], *moments, self.state[name]],
                device=self.device,
            )
        strength = c.plane_strength if t < c.iterations else 1.0  # in the end exactly flat
        launch(
            optimize.pull_to_planes,
            self.count,
            [self.state["plane_of"], self.plane_table, strength, c.thickness_m, self.means, self.quaternions,
             self.log_scales],
            device=self.device,
        )  # fmt: skip

    def densify(self) -> None:
        """Split or clone where the image pulls hardest, prune the faint, the huge and the unseen."""
        c = self.config
        arrays = self.arrays()
        scales = np.exp(arrays["log_scales"].astype(np.float64))
        opacity = 1 / (1 + np.exp(-arrays["logits"][:, 0].astype(np.float64)))
        huge = scales.max(axis=1) > c.max_scale_m
        unseen = (arrays["hits"][:, 0] > 0) & (arrays["seen"][:, 0] < 1e-3)
        keep = ~(huge | unseen | (opacity < c.prune_opacity))
        if not keep.any():
            raise RuntimeError(
                "refine: every Gaussian would be pruned; do photos and camera poses belong together?"
            )
        pull = arrays["pull"][:, 0] / np.maximum(arrays["hits"][:, 0], 1)
        room = min(c.max_gaussians - int(keep.sum()), int(c.densify_share * keep.sum()))
        chosen = np.zeros(len(keep), bool)
        if room > 0:
            ranking = np.where(keep, pull, -1)
            chosen[np.argsort(-ranking, kind="stable")[:room]] = True
            chosen &= keep & (pull > 0)
        split = chosen & (scales.max(axis=1) > c.split_above_m)
        copies = {name: value[chosen].copy() for name, value in arrays.items()}
        rng = np.random.default_rng([self.seed, 2, self.iteration])
        largest = np.argmax(scales, axis=1)
        rows = np.arange(len(scales))
        offset = np.zeros_like(scales)
        offset[rows, largest] = scales[rows, largest]
        rotations = rotations_of(arrays["quaternions"])
        shift = np.einsum("nij,nj->ni", rotations, offset)
        jitter = rng.normal(size=(int(chosen.sum()), 3)) * scales[chosen] * 0.3
        jitter[:, 2] = 0  # in the surface
        step = np.where(
            split[chosen][:, None], 0.7 * shift[chosen], np.einsum("nij,nj->ni", rotations[chosen], jitter)
        )
        copies["means"] = (copies["means"] + step).astype(np.float32)
        arrays["means"] = np.where(split[:, None], arrays["means"] - 0.7 * shift, arrays["means"]).astype(
            np.float32
        )
        shrink = np.zeros_like(scales)
        shrink[rows, largest] = np.log(1.6)
        arrays["log_scales"] = np.where(split[:, None], arrays["log_scales"] - shrink, arrays["log_scales"])
        copies["log_scales"] = np.where(
            split[chosen][:, None], copies["log_scales"] - shrink[chosen], copies["log_scales"]
        )
        for name in self.widths:
            for moment in ("first", "second"):
                copies[f"{moment}.{name}"][:] = 0
                arrays[f"{moment}.{name}"][chosen] = 0
        merged = {name: np.concatenate([value[keep], copies[name]]) for name, value in arrays.items()}
        for name in ("pull", "hits", "seen"):
            merged[name][:] = 0
        merged = {name: v if name == "plane_of" else v.astype(np.float32) for name, v in merged.items()}
        self.load(self.with_planes(merged))

    def result(self) -> Gaussians:
        """The Gaussians, without those too faint to matter."""
        arrays = self.arrays()
        opacity = 1 / (1 + np.exp(-arrays["logits"][:, 0].astype(np.float64)))
        scales = np.exp(arrays["log_scales"].astype(np.float64))
        keep = (opacity >= self.config.prune_opacity) & (scales.max(axis=1) <= self.config.max_scale_m)
        sh = arrays["sh"].reshape(self.count, -1, 3)
        return Gaussians(arrays["means"], arrays["quaternions"], scales, opacity, sh)[keep]

    def fingerprint(self) -> str:
        """What a checkpoint must agree with to be continued."""
        return json.dumps(
            {
                **asdict(self.config),
                "photos": len(self.images),
                "planes": len(self.planes),
                "seed": self.seed,
            },
            sort_keys=True,
        )

    def store(self, path: Path) -> None:
        """Write the whole state, to a temporary file first."""
        from safetensors.numpy import save_file

        metadata = {"iteration": str(self.iteration), "settings": self.fingerprint()}
        write_atomically(path, lambda file: save_file(self.arrays(), file, metadata))

    def restore(self, path: Path) -> None:
        """Continue from a checkpoint."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, framework="np") as file:
                metadata = file.metadata() or {}
                arrays = {name: file.get_tensor(name) for name in file.keys()}
        except (SafetensorError, OSError) as error:
            raise ValueError(
                f"checkpoint: {path} cannot be read ({error}); delete it to start over"
            ) from error
        if metadata.get("settings") != self.fingerprint():
            raise ValueError(
                f"checkpoint: {path} is of other settings or photos; delete it or give another file"
            )
        self.iteration = int(metadata["iteration"])
        self.load(arrays)


def _shaped(flat: wp.array, dtype: Any, shape: tuple[int, ...], gradient: wp.array) -> wp.array:
    """A view of a flat float array as vectors or a table, with a view of ``gradient`` as its gradient."""

    def view(array: wp.array) -> wp.array:
        return wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=array.device, copy=False)

    out = view(flat)
    out.grad = view(gradient)
    return out
