"""Fitting per-Gaussian harmonics to spectra on cached blending weights, with Adam and the adjoint of ``kernels.field``.

A layer is one set of 16 coefficients per Gaussian: the gain, fitted to dB images, or a plainly blended channel (delay,
angle of departure), fitted to its own images. :func:`fit_layer` fits one to the batches of a
:class:`~warprrf.rf.fields.harmonic.batches.Problem`. No rasteriser runs here. Each sum has one owner, so the result depends on
the seed and not on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from warprrf import device as _device
from warprrf.device import Progress
from warprrf.kernels.radio import harmonics as _kernels
from warprrf.kernels.raster.sh import COEFFICIENTS as DEGREE_TO_COUNT
from warprrf.rf.fields.harmonic.batches import Problem
from warprrf.rf.fields.harmonic.opacity import RATE as OPACITY_RATE
from warprrf.rf.fields.harmonic.opacity import OpacityTraining

KINDS = {"exp": _kernels.EXPONENTIAL, "linear": _kernels.CLAMPED, "signed": _kernels.SIGNED}
ADAM = (0.9, 0.999, 1e-15)  # decays and epsilon as RF-3DGS publishes them
FINAL_RATE = 0.05  # the learning rate falls exponentially to this share of its first value


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


@dataclass(frozen=True)
class Target:
    """What a layer is fitted to, for all receivers of a problem.

    Attributes:
        image: values in units of the loss, shape ``(R, H, W)``: the dB image mapped by the range, or a channel.
        factor: what multiplies a pixel's blended gain (solid angle and spreading loss), shape ``(R, H, W)``; None for
            a channel.
        extra: power added to a pixel [linear], shape ``(R, H, W)``; None for zero.
        mask: one where a channel's pixel counts, shape ``(R, H, W)``; None for a gain.
        initial: degree-0 coefficient that each of the Gaussians seen starts with and is pulled to, shape ``(G,)``.
        unit: what each Gaussian's blended value is multiplied by, shape ``(G,)``; None for one.
        floor, low, high: N0 [linear, in the units of ``factor``] and the range of the dB image [dB].
        ssim_share: weight of 1 - SSIM in the loss, the rest is L1; gains only.
    """

    image: np.ndarray
    initial: np.ndarray
    unit: np.ndarray | None = None
    factor: np.ndarray | None = None
    extra: np.ndarray | None = None
    mask: np.ndarray | None = None
    floor: float = 1.0
    low: float = 0.0
    high: float = 1.0
    ssim_share: float = 0.2


@dataclass
class State:
    """Where an optimisation stands: enough to go on and end with the same bits.

    Attributes:
        step: steps done.
        coefficients, first, second: coefficients and Adam's moments, shape ``(G, 16)``.
        losses: loss of each step.
        opacity: logits of the opacities and their moments, shape ``(3, G)``; None where they are not trained.
    """

    step: int
    coefficients: np.ndarray
    first: np.ndarray
    second: np.ndarray
    losses: list[float] = field(default_factory=list)
    opacity: np.ndarray | None = None


@dataclass(frozen=True)
class BatchTarget:
    """One batch's part of a :class:`Target` on the device.

    Attributes:
        image, factor, extra, mask: flattened, as in :class:`Target`; ``mask`` is None for a gain.
        moments: window averages of (t, t^2, t^2), which SSIM needs.
        count: pixels that the loss is averaged over.
    """

    image: wp.array
    factor: wp.array
    extra: wp.array
    mask: wp.array | None
    moments: wp.array
    count: float


class Layer:
    """Loss and gradient of one layer's coefficients on a :class:`Problem`'s batches."""

    def __init__(
        self, problem: Problem, target: Target, kind: str, opacity: OpacityTraining | None = None
    ) -> None:
        self.problem, self.target, self.kind, self.opacity = problem, target, KINDS[kind], opacity
        p, k = problem, problem.kernels
        shape = (len(p.transport.receivers), p.pixels)
        self._scaled: dict[int, wp.array] = {}
        self._recorded: dict[int, tuple[wp.array, _device.Recording]] = {}
        if opacity is not None:
            self.opacity_gradient = np.zeros(len(p.seen))
        self.images = np.asarray(target.image, p.precision).reshape(shape)
        ones, zeros = np.ones(shape, p.precision), np.zeros(shape, p.precision)
        factor = ones if target.factor is None else np.asarray(target.factor, p.precision).reshape(shape)
        extra = zeros if target.extra is None else np.asarray(target.extra, p.precision).reshape(shape)
        mask = None if target.mask is None else np.asarray(target.mask, p.precision).reshape(shape)
        self.data: list[BatchTarget] = []
        pairs = 0
        for batch in p.batches:
            pick, pairs = batch.receivers, max(pairs, len(batch.pair_pixel))
            image = p.upload(self.images[pick].ravel())
            moments = wp.zeros(len(image), dtype=k.vec3, device=p.device)
            if mask is None:
                u = self.images[pick].reshape(-1)
                wp.copy(moments, p.upload(np.stack([u, u * u, u * u], axis=-1), k.vec3))
                moments = self._filtered(moments, wp.zeros_like(moments), wp.zeros_like(moments))
            self.data.append(
                BatchTarget(
                    image=image,
                    factor=p.upload(factor[pick].ravel()),
                    extra=p.upload(extra[pick].ravel()),
                    mask=None if mask is None else p.upload(mask[pick].ravel()),
                    moments=moments,
                    count=float(len(image)) if mask is None else max(float(mask[pick].sum()), 1.0),
                )
            )
        largest = max(len(d.image) for d in self.data)
        self.contribution = wp.zeros(pairs, dtype=p.real, device=p.device)
        self.scalars = [wp.zeros(largest, dtype=p.real, device=p.device) for _ in range(5)]
        self.vectors = [wp.zeros(largest, dtype=k.vec3, device=p.device) for _ in range(3)]
        self.gradient = wp.zeros(len(p.seen), dtype=k.vec16, device=p.device)

    def _filtered(
        self, source: wp.array, between: wp.array, out: wp.array, count: int | None = None
    ) -> wp.array:
        p, (height, width) = self.problem, self.problem.transport.shape
        size = len(source) if count is None else count
        p.launch(p.ssim.filter_rows, size, width, 1, 1, source, between)
        p.launch(p.ssim.filter_columns, size, height, width, between, out)
        return out

    def weights(self, index: int) -> wp.array:
        """The weights of batch ``index`` in the target's unit; kept where all batches are in memory. Where opacities
        are trained, as they are now."""
        batch, unit = self.problem.batches[index], self.target.unit
        if self.opacity is not None:
            now = wp.zeros_like(batch.pair_weight)
            self.opacity.weights(index, now)
            return now
        if unit is None:
            return batch.pair_weight
        if index not in self._scaled:
            if not self.problem.in_memory:
                self._scaled.clear()
            scaled = batch.pair_weight.numpy() * unit[batch.pair_owner()]
            self._scaled[index] = self.problem.upload(scaled)
        return self._scaled[index]

    def step(self, index: int, coefficients: wp.array, *, need_loss: bool = True) -> float:
        """Loss of batch ``index``; leaves its gradient in ``self.gradient`` (zero for Gaussians it does not see)."""
        data, target = self.data[index], self.target
        size = len(data.image)
        total, _, absolute, score, adjoint = self.scalars
        if self.opacity is not None or not self.problem.in_memory:
            self._launch(index, coefficients)
        else:  # every array stays where it is
            recorded = self._recorded.get(index)
            if recorded is None or recorded[0] is not coefficients:
                recording = _device.Recording(lambda: self._launch(index, coefficients), self.problem.device)
                self._recorded[index] = coefficients, recording
            else:
                recorded[1].run()
        if self.opacity is not None:
            self.opacity_gradient = self.opacity.gradient(index, self.contribution, total, adjoint)
        if not need_loss:
            return float("nan")
        error = float(np.sum(absolute.numpy()[:size], dtype=np.float64)) / data.count
        if data.mask is not None:
            return error
        similarity = float(np.mean(score.numpy()[:size], dtype=np.float64))
        return (1 - target.ssim_share) * error + target.ssim_share * (1 - similarity)

    def _launch(self, index: int, coefficients: wp.array) -> None:
        """The kernels of a step."""
        p, k, batch, data = self.problem, self.problem.kernels, self.problem.batches[index], self.data[index]
        weights = self.weights(index)
        target, size = self.target, len(data.image)
        total, image, absolute, score, adjoint = self.scalars
        p.launch(
            k.contributions, batch.rows, self.kind, batch.row_gaussian, batch.row_start, batch.pair_direction,
            weights, p.basis, coefficients, self.contribution,
        )  # fmt: skip
        p.launch(k.pixel_sums, size, batch.pixel_start, batch.pair_of_pixel, self.contribution, total)
        if data.mask is not None:
            share = p.real(1.0 / data.count)
            p.launch(k.absolute_adjoint, size, share, data.mask, data.image, total, absolute, adjoint)
        else:
            scale = (p.real(target.floor), p.real(target.low), p.real(target.high))
            moments, between, slopes = self.vectors
            p.launch(k.to_image, size, data.factor, data.extra, *scale, data.image, total, image, moments)
            self._filtered(moments, between, slopes, size)
            p.launch(p.ssim.slopes, size, data.moments, slopes, score, moments)
            self._filtered(moments, between, slopes, size)
            shares = p.real((1 - target.ssim_share) / size), p.real(target.ssim_share / size)
            p.launch(
                k.loss_adjoint, size, data.factor, data.extra, *scale, *shares, data.image, total, image,
                slopes, absolute, adjoint,
            )  # fmt: skip
        p.launch(
            k.coefficient_adjoint, batch.rows, self.kind, batch.row_gaussian, batch.row_start, batch.pair_pixel,
            batch.pair_direction, weights, p.basis, self.contribution, adjoint, self.gradient,
        )  # fmt: skip

    def power(self, index: int, coefficients: wp.array) -> np.ndarray:
        """What the layer predicts for the receivers of batch ``index``: factor times blend plus extra."""
        self.step(index, coefficients, need_loss=False)
        data = self.data[index]
        total = self.scalars[0].numpy()[: len(data.image)]
        return data.factor.numpy() * total + data.extra.numpy()


def fit_layer(
    problem: Problem,
    target: Target,
    kind: str,
    *,
    steps: int,
    degree: int = 3,
    rates: Rates | None = None,
    state: State | None = None,
    each: Callable[[State], None] | None = None,
    stage: str = "fit",
    progress: Progress | None = None,
    opacity: OpacityTraining | None = None,
) -> State:
    """Fit one layer.

    Args:
        problem: weights and batches.
        target: what to fit.
        kind: ``"exp"``, ``"linear"`` (clamped at zero) or ``"signed"``.
        steps: optimiser steps, one batch each.
        degree: of the harmonics, 0 to 3; coefficients above it stay zero.
        rates: learning rates and ridge.
        state: go on from here instead of starting.
        each: called with the state every 50 steps and after the last.
        stage, progress: for the progress callback.
        opacity: opacities that are trained with the layer; None leaves them as they are.

    Returns:
        Final state; coefficients of the Gaussians ``problem.seen``, shape ``(G, 16)``.
    """
    rates = rates or Rates()
    p, k = problem, problem.kernels
    count = DEGREE_TO_COUNT[degree]
    active = np.arange(_kernels.COEFFICIENTS) < count
    rate = np.where(active, rates.directional, 0.0)
    rate[0] = rates.constant
    layer = Layer(problem, target, kind, opacity)
    if state is None:
        table = np.zeros((len(p.seen), _kernels.COEFFICIENTS))
        table[:, 0] = target.initial
        state = State(0, table, np.zeros_like(table), np.zeros_like(table))
    coefficients, first, second = (
        p.upload(a, k.vec16) for a in (state.coefficients, state.first, state.second)
    )
    initial = p.upload(target.initial)
    losses = list(state.losses)
    decay1, decay2, epsilon = ADAM

    def snapshot(step: int) -> State:
        logits = None if opacity is None else opacity.state
        return State(step, coefficients.numpy(), first.numpy(), second.numpy(), losses, logits)

    for step in range(state.step, steps):
        index = p.batch_at(step)
        losses.append(layer.step(index, coefficients))
        # one pixel's L1 pull on a neper of gain, so that the ridge counts in pixels
        pull = np.log10(np.e) * 10 / (target.high - target.low) if target.mask is None else 1.0
        pull /= layer.data[index].count
        ridge = np.where(active, rates.ridge_directional, 0.0) * pull
        ridge[0] = rates.ridge * pull
        now = rate * FINAL_RATE ** (step / max(steps - 1, 1))
        p.launch(
            k.adam, len(p.seen), k.vec16(*now.tolist()), k.vec16(*ridge.tolist()), p.real(decay1), p.real(decay2),
            p.real(1 / (1 - decay1 ** (step + 1))), p.real(1 / (1 - decay2 ** (step + 1))), p.real(epsilon),
            initial, layer.gradient, first, second, coefficients,
        )  # fmt: skip
        if opacity is not None:
            opacity.step(
                layer.opacity_gradient, step + 1, OPACITY_RATE * FINAL_RATE ** (step / max(steps - 1, 1))
            )
        if progress is not None:
            progress(stage, step + 1, steps)
        if each is not None and ((step + 1) % 50 == 0 or step + 1 == steps):
            each(snapshot(step + 1))
    return snapshot(max(steps, state.step))
