"""Calibration of a scene's materials with Sionna RT's own gradients: what its users do with measured spectra.

Permittivity, conductivity and scattering coefficient of every material are Dr.Jit variables; the PathSolver's path
coefficients are differentiated with respect to them ("evaluated" loops), and Adam lowers the mean absolute error of the
dB image, one receiver a step. Scattering patterns and geometry stay as they are: Sionna has no gradient of the former
that its solver uses, and none of the latter here.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warprrf import device as _device
from warprrf.device import Progress
from warprrf.rf.em.materials import Material
from warprrf.rf.interop.sionna_engine import Sampling, SionnaEngine
from warprrf.rf.scene import Scene
from warprrf.rf.spectra.beam import BeamOperator
from warprrf.rf.spectra.spectrum import directions_from_angles, pixel_of, to_db

if TYPE_CHECKING:
    from warprrf.rf.spectra.dataset import SpectrumDataset

SAMPLES = 500_000  # rays a step
RATE = 0.15  # Adam, in nepers of permittivity less one and of conductivity, and in logits of S^2
ADAM_DECAYS, ADAM_EPSILON = (0.9, 0.99), 1e-8
FARTHEST = 12.0  # logit of S^2, and nepers that permittivity and conductivity may move
_NEPER_DB = 10.0 / np.log(10.0)


@dataclass(frozen=True)
class SionnaCalibration:
    """What a calibration found.

    Attributes:
        scene: the scene with calibrated materials.
        losses: mean absolute error of the dB image [dB] at each step's receiver, before the step.
        seconds: time of the steps, without start and compilation.
        start_s: time of start and compilation: the scene loaded, one step tried.
    """

    scene: Scene = field(repr=False)
    losses: list[float] = field(repr=False)
    seconds: float
    start_s: float


@dataclass(frozen=True)
class Calibration:
    """How a scene is calibrated.

    Attributes:
        seconds: how long; at least one step is done. Start and compilation are not counted.
        depth: most bounces on a path.
        samples: rays a step.
        rate: Adam's learning rate.
        most_steps: stop after so many steps.
        seed: of the receivers' order and the rays.
    """

    seconds: float
    depth: int = 1
    samples: int = SAMPLES
    rate: float = RATE
    most_steps: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.seconds) and self.seconds > 0):
            raise ValueError(f"seconds: got {self.seconds!r}, expected a positive time")
        if self.most_steps is not None and self.most_steps < 1:
            raise ValueError(f"most_steps: got {self.most_steps!r}, expected at least 1, or None")


def calibrate_sionna(
    scene: Scene,
    train: SpectrumDataset,
    how: Calibration,
    *,
    device: Any = None,
    progress: Progress | None = None,
) -> SionnaCalibration:
    """Fit a scene's materials to spectra.

    Args:
        scene: scene of an XML file, such as the twin of a field before any measurement.
        train: spectra to fit.
        device: where beams are spread.
        progress: called with the stage ``"fit"``, in tenths of seconds.

    Raises:
        ImportError: without Sionna RT.
        ValueError: for a scene without an XML file.
    """
    begun = time.perf_counter()
    engine = _GradientEngine(
        scene, transmitter=train.transmitter, frequency_hz=train.frequency_hz, shape=train.shape,
        beam_sigma_rad=train.beam_sigma_rad,
        sampling=Sampling(depth=how.depth, samples=how.samples, seed=how.seed), device=device,
    )  # fmt: skip
    beam = BeamOperator(train.shape, train.beam_sigma_rad, device=device)
    first = _unbound(scene.materials, float(train.frequency_hz))
    values = first.copy()
    mean, square = np.zeros_like(values), np.zeros_like(values)
    floor = float(train.floor)

    def gradient(step: int) -> tuple[float, np.ndarray]:
        epoch, place = divmod(step, len(train))
        receiver = int(np.random.default_rng([how.seed, epoch]).permutation(len(train))[place])
        target = to_db(train.path_gain[receiver], floor)

        def adjoint(pixels: np.ndarray) -> tuple[float, np.ndarray]:
            power = np.maximum(beam(pixels), 0.0) + floor
            miss = 10.0 * np.log10(power) - target
            slope = np.sign(miss) * _NEPER_DB / power / miss.size
            return float(np.abs(miss).mean()), beam.adjoint(slope)

        return engine.gradient(train.receivers[receiver], values, adjoint, how.seed + step)

    gradient(0)  # compiles
    start_s, started = time.perf_counter() - begun, time.perf_counter()
    losses: list[float] = []
    while True:
        loss, slope = gradient(len(losses))
        losses.append(loss)
        mean = ADAM_DECAYS[0] * mean + (1 - ADAM_DECAYS[0]) * slope
        square = ADAM_DECAYS[1] * square + (1 - ADAM_DECAYS[1]) * slope**2
        count = len(losses)
        unbiased = [m / (1 - decay**count) for m, decay in zip((mean, square), ADAM_DECAYS, strict=True)]
        values = values - how.rate * unbiased[0] / (np.sqrt(unbiased[1]) + ADAM_EPSILON)
        values = np.clip(values, first - FARTHEST, first + FARTHEST)
        spent = time.perf_counter() - started
        if progress is not None:
            progress("fit", int(10 * min(spent, how.seconds)), max(1, int(10 * how.seconds)))
        if spent >= how.seconds or count == how.most_steps:
            break
    calibrated = scene.with_materials(_bound(scene.materials, values, float(train.frequency_hz)))
    return SionnaCalibration(calibrated, losses, time.perf_counter() - started, start_s)


def _unbound(materials: Sequence[Material], frequency_hz: float) -> np.ndarray:
    """ln(epsilon_r - 1), ln conductivity and logit of S^2 of each material, shape ``(M, 3)``."""
    rows = []
    for material in materials:
        share = np.clip(material.scattering_coefficient(frequency_hz) ** 2, 1e-4, 1 - 1e-4)
        rows.append(
            (
                np.log(max(material.relative_permittivity(frequency_hz) - 1.0, 1e-3)),
                np.log(max(material.conductivity(frequency_hz), 1e-3)),
                np.log(share / (1.0 - share)),
            )
        )
    return np.array(rows)


def _physical(values: np.ndarray) -> np.ndarray:
    """Relative permittivity, conductivity [S/m] and S of each material, shape ``(M, 3)``."""
    share = np.exp(-np.logaddexp(0.0, -values[:, 2]))
    return np.column_stack([1.0 + np.exp(values[:, 0]), np.exp(values[:, 1]), np.sqrt(share)])


def _slopes(values: np.ndarray) -> np.ndarray:
    """Derivatives of :func:`_physical`, one number each."""
    physical = _physical(values)
    s = physical[:, 2]
    return np.column_stack([physical[:, 0] - 1.0, physical[:, 1], 0.5 * s * (1.0 - s**2)])


def _bound(materials: Sequence[Material], values: np.ndarray, frequency_hz: float) -> list[Material]:
    found = []
    for material, (permittivity, conductivity, scattering) in zip(materials, _physical(values), strict=True):
        row = replace(
            material.band(frequency_hz), a=float(permittivity), b=0.0, c=float(conductivity), d=0.0,
            source="calibrated by gradient descent",
        )  # fmt: skip
        found.append(replace(material, bands=(row,), scattering=float(scattering)))
    return found


class _GradientEngine(SionnaEngine):
    """Sionna RT with materials as differentiable variables."""

    def __init__(self, scene: Any, **options: Any) -> None:
        super().__init__(scene, **options)
        self._solver.loop_mode = "evaluated"  # symbolic loops carry no gradients
        objects = self._scene.objects
        owners = [int(scene.face_material[scene.face_object == k][0]) for k in range(len(scene.object_names))]
        known = {m: objects[name].radio_material for m, name in zip(owners, scene.object_names, strict=True)}
        self._materials = [known[m] for m in range(len(scene.materials))]

    def gradient(
        self, receiver: np.ndarray, values: np.ndarray, adjoint: Any, seed: int
    ) -> tuple[float, np.ndarray]:
        """Loss and its gradient with respect to ``values`` (M, 3).

        Args:
            adjoint: from the path gain per pixel before the beam (H, W) to the loss and its gradient (H, W).
        """
        drjit = _device.require("drjit", extra="sionna")
        names = ("relative_permittivity", "conductivity", "scattering_coefficient")
        real = type(self._materials[0].scattering_coefficient)
        variables = []
        for material, row in zip(self._materials, _physical(values), strict=True):
            for name, value in zip(names, row, strict=True):
                variable = drjit.opaque(real, float(value))  # a literal would be compiled in, anew each step
                drjit.enable_grad(variable)
                setattr(material, name, variable)
                variables.append(getattr(material, name))
        self._scene.add(self._rt.Receiver("rx", position=receiver.tolist()))
        try:
            paths = self._solver(
                self._scene, max_depth=self.sampling.depth, max_num_paths_per_src=self._most,
                samples_per_src=self.sampling.samples, synthetic_array=True, los=True, specular_reflection=True,
                diffuse_reflection=True, refraction=self.sampling.refraction, seed=seed,
            )  # fmt: skip
        finally:
            self._scene.remove("rx")
        cells = self.shape[0] * self.shape[1]
        zenith, azimuth = (
            np.asarray(a.numpy(), np.float64).reshape(-1) for a in (paths.theta_r, paths.phi_r)
        )
        count = len(zenith)
        whole = drjit.uint32_array_t(real)
        image = drjit.zeros(real, cells)
        if count:
            row, column = pixel_of(directions_from_angles(zenith, azimuth), self.shape)
            cell = whole((row * self.shape[1] + column).astype(np.uint32))
            valid = drjit.mask_t(real)(paths.valid.numpy().reshape(-1))
            index, power = drjit.arange(whole, count), drjit.zeros(real, count)
            for part in paths.a:  # 2 receive x 2 transmit polarisations, real and imaginary
                for antenna in range(4):
                    power += 0.5 * drjit.square(drjit.gather(real, part.array, index + antenna * count))
            drjit.scatter_reduce(drjit.ReduceOp.Add, image, power, cell, valid)
        loss, slope = adjoint(np.asarray(image.numpy(), np.float64).reshape(self.shape))
        scale = float(np.abs(slope).max()) or 1.0  # slopes of 1e14 and powers of 1e-14 would leave float32
        weight = real((slope / scale).reshape(-1).astype(np.float32))
        drjit.backward(drjit.sum(image * weight))
        found = np.array([float(drjit.grad(v).numpy().reshape(-1)[0]) for v in variables])
        # Sionna evaluates the materials of all scenes in memory: left on, gradients would be recorded in each solve.
        for material in self._materials:
            for name in names:
                setattr(material, name, drjit.detach(getattr(material, name)))
        self._solved += 1
        if self._solved % 20 == 0:
            drjit.flush_malloc_cache()
        return loss, np.nan_to_num(found.reshape(-1, 3) * scale) * _slopes(values)
