"""Fitting per-Gaussian harmonics to spectra on cached blending weights, with Adam and a hand-written adjoint.

A layer is one set of 16 coefficients per Gaussian: the gain, fitted to dB images, or a plainly blended channel (delay,
angle of departure), fitted to its own images. :func:`fit_layer` fits one to the batches of a
:class:`~warprrf.rf.fields.harmonic.problem.Problem` by the kernels of :mod:`warprrf.kernels.radio.harmonics`. No
rasteriser runs here. Each sum has one owner, so the result depends on the seed and not on the number of threads.
:func:`targets` says what the layers are fitted to.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import warp as wp

from warprrf import tensor_files
from warprrf.checks import Count, Seed, checked, one_of, whole
from warprrf.geometry.splats.gaussians import Y00
from warprrf.geometry.splats.photo_loss import WRAPPED, PhotoLoss
from warprrf.kernels.adam import build_adam, corrections
from warprrf.kernels.radio import harmonics as _kernels
from warprrf.kernels.raster.sh import COEFFICIENTS as DEGREE_TO_COUNT
from warprrf.rf.fields.harmonic.opacity import OpacityTraining
from warprrf.rf.fields.harmonic.problem import Problem
from warprrf.rf.fields.harmonic.transport import TOP_K
from warprrf.rf.spectra.dataset import SpectrumDataset
from warprrf.rf.spectra.spectrum import directions_from_angles, to_db


@dataclass(frozen=True)
class Rates:
    """How fast coefficients learn and how firmly they stay where the data says little.

    Attributes:
        constant: Adam rate of the degree-0 coefficient [nepers of gain, or units of the channel].
        directional: rate of the others. (RF-3DGS' 2.5e-3 and 1.25e-4 are for 8-bit colours over 10 000 steps; a gain
            spans 14 nepers and is fitted in a few hundred.)
        ridge: pull towards the initial value, in pixels: how many pixels' L1 pull it balances at a deviation of one.
            A Gaussian that many pixels see hardly feels it, a rarely seen one stays near its initial value.
        ridge_directional: the same for the other coefficients.
    """

    constant: float = 0.2
    directional: float = 0.1
    ridge: float = 0.02
    ridge_directional: float = 0.2


GAIN_RATES = Rates()
CHANNEL_RATES = Rates(constant=0.1, directional=0.05, ridge=0.02, ridge_directional=0.1)


@checked
@dataclass(frozen=True)
class FieldOptions:
    """What a field computes, and how :meth:`HarmonicField.fit` learns it.

    Attributes:
        model: ``"rf3dgs+"`` or ``"rf3dgs"``.
        transmittance: ``"product"`` of (1 - alpha), or the paper's ``"exp"`` of minus the sum of alphas.
        interaction_point: ``"centre"`` of the dominant Gaussian (the paper), ``"peak"``, ``"expected"``, ``"mesh"``.
        gain: ``"exp"`` of the harmonics or ``"linear"``, clamped at zero.
        sh_degree: 0 to 3.
        top_k: Gaussians kept per pixel.
        line_of_sight: None (the paper: surfaces must carry it), or ``"explicit"``: Friis gain where the mesh lets the
            transmitter be seen, spread by the data set's beam.
        iterations: optimiser steps of the gain, ``batch`` receivers each; twice as many change the test PSNR by less
            than 0.1 dB.
        batch: receivers per step.
        train_opacity: also train the opacities with the gain, as RF-3DGS does; the field then has Gaussians of its own
            opacities. Needs the ``product`` transmittance.
        checkpoint: file to save progress to and go on from; removed when the fit is done, and no part of a field.
        seed: of the batches.

    Raises:
        ValueError: for a value that is not allowed.
    """

    model: Annotated[str, one_of("rf3dgs+", "rf3dgs")] = "rf3dgs+"
    transmittance: Annotated[str, one_of("product", "exp")] = "product"
    interaction_point: Annotated[str, one_of("centre", "peak", "expected", "mesh")] = "centre"
    gain: Annotated[str, one_of("exp", "linear")] = "exp"
    sh_degree: Annotated[int, one_of(*DEGREE_TO_COUNT)] = 3
    top_k: Count = TOP_K
    line_of_sight: Annotated[str | None, one_of(None, "explicit")] = None
    iterations: Annotated[int, whole(0)] = 300
    batch: Count = 10
    train_opacity: bool = False
    checkpoint: str | os.PathLike[str] | None = None
    seed: Seed = 0

    def __post_init__(self) -> None:
        if self.train_opacity and self.transmittance != "product":
            raise ValueError(f"train_opacity: got transmittance {self.transmittance!r}, expected 'product'")


KINDS = {"exp": _kernels.EXPONENTIAL, "linear": _kernels.CLAMPED, "signed": _kernels.SIGNED}
SSIM_SHARE = 0.2  # of 1 - SSIM in the loss of a gain, the rest is L1: as RF-3DGS publishes it
CHECKPOINT = "warprrf field checkpoint 2"


@dataclass(frozen=True)
class Target:
    """What a layer is fitted to, for all receivers of a problem.

    Attributes:
        image: values in units of the loss, shape ``(R, H, W)``: the dB image mapped by the range, or a channel.
        initial: degree-0 coefficient that each of the Gaussians seen starts with and is pulled to, shape ``(G,)``.
        unseen: that of Gaussians that no training receiver sees: the median.
        kind: what a Gaussian's value is of its harmonics' sum: ``"exp"``, ``"linear"`` (clamped at zero), ``"signed"``.
        unit: what each Gaussian's value is multiplied by, shape ``(G,)``; None for one.
        factor: what multiplies a pixel's blended gain (solid angle and spreading loss), shape ``(R, H, W)``; None for
            a channel.
        extra: power added to a pixel [linear], shape ``(R, H, W)``.
        mask: one where a channel's pixel counts, shape ``(R, H, W)``; None for a gain.
        low, high: range of the dB image [dB over N0]; ``factor`` and ``extra`` are in units of N0.
    """

    image: np.ndarray
    initial: np.ndarray
    unseen: float = 0.0
    kind: str = "exp"
    unit: np.ndarray | None = None
    factor: np.ndarray | None = None
    extra: np.ndarray | None = None
    mask: np.ndarray | None = None
    low: float = 0.0
    high: float = 1.0


@dataclass
class State:
    """Where an optimisation stands: enough to go on and end with the same bits.

    Attributes:
        coefficients, first, second: coefficients and Adam's moments, shape ``(G, 16)``.
        losses: loss of each step done, shape ``(S,)``.
        opacity: logits of the opacities and their moments, shape ``(3, G)``; None where they are not trained.
    """

    coefficients: np.ndarray
    first: np.ndarray
    second: np.ndarray
    losses: np.ndarray = field(default_factory=lambda: np.zeros(0))
    opacity: np.ndarray | None = None


def load_states(path: str | os.PathLike[str] | None, identity: str) -> dict[str, State]:
    """States of layers in a checkpoint; none if there is none.

    Args:
        identity: digest of all that the fit's result depends on.
    """
    if path is None or not Path(path).exists():
        return {}
    tensors, header = tensor_files.read(path, CHECKPOINT)
    if header.get("identity") != identity:
        raise ValueError(
            f"checkpoint: {path} belongs to a fit with other data or options; delete it or name another file"
        )
    parts: dict[str, dict[str, np.ndarray]] = {}
    for key, tensor in tensors.items():
        layer, _, name = key.partition("/")
        parts.setdefault(layer, {})[name] = tensor
    with tensor_files.named(path, "checkpoint: corrupt"):
        return {layer: State(**own) for layer, own in parts.items()}


def save_states(path: str | os.PathLike[str], identity: str, states: Mapping[str, State]) -> None:
    """Write what :func:`load_states` reads."""
    tensors = {
        f"{layer}/{name}": value
        for layer, state in states.items()
        for name, value in vars(state).items()
        if value is not None
    }
    tensor_files.write(path, tensors, {"identity": identity}, CHECKPOINT)


@dataclass(frozen=True)
class _BatchTarget:
    """One batch's part of a :class:`Target` on the device, flattened.

    Attributes:
        image: of a gain a plane of the loss.
        moments: what the loss keeps of a gain's image.
        count: pixels that the loss is averaged over.
    """

    image: wp.array
    factor: wp.array | None
    extra: wp.array | None
    mask: wp.array | None
    moments: tuple[wp.array, wp.array] | None
    count: float


class Layer:
    """Loss and gradient of one layer's coefficients on a :class:`Problem`'s batches."""

    def __init__(self, problem: Problem, target: Target, opacity: OpacityTraining | None = None) -> None:
        self.problem, self.target, self.kind, self.opacity = problem, target, KINDS[target.kind], opacity
        p, k = problem, problem.kernels
        self.loss = PhotoLoss(p.device, SSIM_SHARE, real=p.real, panorama=True)
        self.unit = p.upload(np.ones(len(p.seen)) if target.unit is None else target.unit)
        self.data = [self._data(batch.receivers) for batch in p.batches]
        pairs = max(len(batch.pair_pixel) for batch in p.batches)
        pixels = max(len(batch.receivers) for batch in p.batches) * p.pixels
        self.contribution = wp.zeros(pairs, dtype=p.real, device=p.device)
        self.scalars = [wp.zeros(pixels, dtype=p.real, device=p.device) for _ in range(3)]
        self.errors = wp.zeros(pixels // p.transport.shape[1], dtype=wp.vec2d, device=p.device)
        self.gradient = wp.zeros(len(p.seen), dtype=k.vec16, device=p.device)

    def _data(self, receivers: np.ndarray) -> _BatchTarget:
        p, target, shape = self.problem, self.target, (len(receivers), *self.problem.transport.shape)
        image = np.asarray(target.image[receivers], p.precision)
        whole = target.factor, target.extra, target.mask
        factor, extra, mask = (None if a is None else p.upload(a[receivers].ravel()) for a in whole)
        if target.mask is not None:
            counted = max(float(target.mask[receivers].sum(dtype=np.float64)), 1.0)
            return _BatchTarget(p.upload(image.ravel()), factor, extra, mask, None, counted)
        plane = self.loss.plane(image, shape)
        return _BatchTarget(plane, factor, extra, mask, self.loss.moments(plane, shape), image.size)

    def step(self, index: int, coefficients: wp.array) -> float:
        """Loss of batch ``index``; leaves its gradient in ``self.gradient`` (zero for Gaussians it does not see)."""
        p, k, batch, data = self.problem, self.problem.kernels, self.problem.batches[index], self.data[index]
        size = len(batch.receivers) * p.pixels
        total, absolute, adjoint = self.scalars
        weight = batch.pair_weight if self.opacity is None else self.opacity.weights(index)
        seen = [batch.pair_direction, weight, self.unit, p.basis]
        rows = len(p.seen)
        p.launch(k.contributions, rows, self.kind, batch.row_start, *seen, coefficients, self.contribution)
        p.launch(k.pixel_sums, size, batch.pixel_start, batch.pair_of_pixel, self.contribution, total)
        score = wp.empty(0, dtype=p.real, device=p.device)
        if data.moments is not None:
            score = self._image_adjoint(data, data.moments, len(batch.receivers))
        else:
            share = p.real(1.0 / data.count)
            p.launch(k.absolute_adjoint, size, share, data.mask, data.image, total, absolute, adjoint)
        p.launch(
            k.coefficient_adjoint, rows, self.kind, batch.row_start, batch.pair_pixel, *seen, self.contribution,
            adjoint, self.gradient,
        )  # fmt: skip
        if self.opacity is not None:
            self.opacity.find_gradient(index, self.contribution, total, adjoint)
        width = p.transport.shape[1]
        lines = size // width
        place = width, len(score) // lines, WRAPPED
        p.launch(k.row_errors, lines, *place, absolute, score, self.errors)
        error, similarity = self.errors[:lines].numpy().sum(axis=0) / data.count
        if data.mask is not None:
            return float(error)
        return float((1 - SSIM_SHARE) * error + SSIM_SHARE * (1 - similarity))

    def _image_adjoint(
        self, data: _BatchTarget, moments: tuple[wp.array, wp.array], receivers: int
    ) -> wp.array:
        """The plane of similarities of the dB image of the sums that lie in ``self.scalars``; leaves errors and adjoint
        there."""
        p, k, target = self.problem, self.problem.kernels, self.target
        shape = receivers, *p.transport.shape
        total, absolute, adjoint = self.scalars
        canvas, rows, width = self.loss.canvas(shape), shape[0] * shape[1], shape[2]
        place = width, len(canvas) // rows, WRAPPED
        scale = p.real(target.low), p.real(target.high)
        count = rows * (width + 2 * WRAPPED)
        p.launch(k.to_image, count, *place, data.factor, data.extra, *scale, total, canvas)
        score, slopes = self.loss(data.image, moments, shape)
        p.launch(
            k.loss_adjoint, rows * width, *place, data.factor, data.extra, *scale, total, canvas, data.image, slopes,
            absolute, adjoint,
        )  # fmt: skip
        return score


def fit_layer(
    problem: Problem,
    target: Target,
    *,
    steps: int,
    rates: Rates = GAIN_RATES,
    degree: int = 3,
    opacity: OpacityTraining | None = None,
    state: State | None = None,
    each: Callable[[int, Callable[[], State]], None] | None = None,
) -> State:
    """Fit one layer.

    Args:
        steps: optimiser steps, one batch each.
        rates: learning rates and ridge.
        degree: of the harmonics, 0 to 3; coefficients above it stay zero.
        opacity: opacities that are trained with the layer; None leaves them as they are.
        each: called after every step with the number of steps done and a function that gives the state.

    Returns:
        Final state; coefficients of the Gaussians ``problem.seen``, shape ``(G, 16)``.
    """
    p, k = problem, problem.kernels
    active = np.arange(_kernels.COEFFICIENTS) < DEGREE_TO_COUNT[degree]
    rate = np.where(active, rates.directional, 0.0)
    rate[0] = rates.constant
    firm = np.where(active, rates.ridge_directional, 0.0)
    firm[0] = rates.ridge
    layer = Layer(problem, target, opacity)
    if state is None:
        table = np.zeros((len(p.seen), _kernels.COEFFICIENTS))
        table[:, 0] = target.initial
        state = State(table, np.zeros_like(table), np.zeros_like(table))
    stand = state.coefficients, state.first, state.second
    coefficients, first, second = (p.upload(a, k.vec16) for a in stand)
    initial = p.upload(target.initial)
    losses = list(state.losses)
    adam, width = build_adam(p.real), _kernels.COEFFICIENTS
    moved = [_numbers(a) for a in (layer.gradient, first, second, coefficients)]

    def snapshot() -> State:
        logits = None if opacity is None else opacity.state
        return State(coefficients.numpy(), first.numpy(), second.numpy(), np.array(losses), logits)

    final_rate = 0.05  # the learning rate falls exponentially to this share of its first value
    for step in range(len(losses), steps):
        index = p.batch_at(step)
        losses.append(layer.step(index, coefficients))
        # one pixel's L1 pull on a neper of gain, so that the ridge counts in pixels
        pull = np.log10(math.e) * 10 / (target.high - target.low) if target.mask is None else 1.0
        ridge = firm * (pull / layer.data[index].count)
        falling = final_rate ** (step / max(steps - 1, 1))
        p.launch(
            adam, len(p.seen), width, p.upload(rate * falling), *corrections(step + 1), p.upload(ridge), initial,
            *moved,
        )  # fmt: skip
        if opacity is not None:
            opacity_rate = 0.05  # Adam's, of the logits, as RF-3DGS publishes it
            opacity.step(step + 1, opacity_rate * falling)
        if each is not None:
            each(step + 1, snapshot)
    return snapshot()


def _numbers(vectors: wp.array) -> wp.array:
    """The memory of ``vectors``, which have to live on, as numbers."""
    real = vectors.dtype._wp_scalar_type_
    count = vectors.size * _kernels.COEFFICIENTS
    return wp.array(ptr=vectors.ptr, dtype=real, shape=count, device=vectors.device)


def targets(
    options: FieldOptions,
    ds: SpectrumDataset,
    images: np.ndarray,
    problem: Problem,
    factor: np.ndarray,
    extra: np.ndarray,
) -> tuple[dict[str, Target], float, float]:
    """What to fit the spectra ``images`` (R, H, W) of ``ds`` with.

    Args:
        factor: what multiplies a pixel's blended gain, shape ``(R, H, W)``.
        extra: power of an explicit line of sight, shape ``(R, H, W)``.

    Returns:
        Targets of the layers in order: ``gain`` first, then ``delay``, ``aod_x``, ``aod_y``, ``aod_z`` for ``rf3dgs``;
        the linear factor of the gain, its median over the pixels above the floor; seconds per unit of the delay
        layer, the longest delay.
    """
    floor = ds.floor
    blended = factor * problem.transport.pixel_weight
    met = blended > 0
    power = images - extra
    above = (power > floor) & met
    if not above.any():
        raise ValueError(
            "ds: got no pixel above the floor where a ray meets a Gaussian; expected spectra with power and "
            "geometry around the receivers"
        )
    gain_unit = float(np.median(power[above] / blended[above]))
    # Each Gaussian starts from the mean gain, in dB, of the pixels that see it: shadows lie 14 nepers below the median.
    dark = 0.1  # a pixel below the floor counts as this share of it where logarithms are averaged
    floored = np.maximum(power, dark * floor)
    relative = np.log(floored / np.where(met, blended * gain_unit, np.nan))
    start = np.nan_to_num(problem.weighted_means(relative))
    exponential = options.gain == "exp"
    low, high = ds.range_db
    layers = {
        "gain": Target(
            image=np.clip((to_db(images, floor) - low) / (high - low), 0.0, 1.0),
            kind=options.gain,
            initial=start / Y00 if exponential else np.full(len(start), 1.0 / Y00),
            unseen=0.0 if exponential else 1.0 / Y00,
            unit=None if exponential else np.exp(start),
            # in units of the floor, so that float32 works near one
            factor=factor * (gain_unit / floor),
            extra=extra / floor,
            low=low - 10 * np.log10(floor),
            high=high - 10 * np.log10(floor),
        )
    }
    delay_unit = 1.0
    if options.model == "rf3dgs" and ds.delay_s is not None:
        seen = (images > floor) & (problem.transport.dominant >= 0)
        departure = directions_from_angles(*np.moveaxis(np.asarray(ds.aod, np.float64), -1, 0))
        channels = {"delay": np.asarray(ds.delay_s, np.float64)}
        channels |= {f"aod_{axis}": departure[..., k] for k, axis in enumerate("xyz")}
        for name, image in channels.items():
            mask = seen & np.isfinite(image)
            if not mask.any():  # not measured
                continue
            if name == "delay":
                delay_unit = float(image[mask].max())
                image = image / delay_unit
            middle = float(np.median(image[mask]))
            mean = problem.weighted_means(np.where(mask, image, np.nan))
            layers[name] = Target(
                kind="signed",
                image=np.where(mask, image, 0.0),
                initial=np.where(np.isnan(mean), middle, mean) / Y00,
                unseen=middle / Y00,
                mask=mask,
            )
    return layers, gain_unit, delay_unit
