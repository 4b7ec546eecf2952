"""Training opacities with the rest frozen, as RF-3DGS does: cached responses and order in the place of weights.

A Gaussian's response on a pixel's ray and the order along the ray do not depend on opacities; only the blending weights
do, and those are cheap to make anew. So that Gaussians behind a wall are listed too, and can show when the wall turns
transparent, the lists are made with all opacities thinned: a pixel's list goes down to where the thinned transmittance
is 1e-4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import warp as wp

from warprrf.device import Progress, launch, with_progress
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import Blending, Rasterizer
from warprrf.kernels.adam import build_adam, corrections
from warprrf.kernels.radio import opacity as _kernels
from warprrf.kernels.radio.transport import write_responses
from warprrf.rf.fields.harmonic.problem import Pairs, Problem
from warprrf.rf.fields.harmonic.transport import Transport, cutoffs, kept, strongest


@dataclass(frozen=True)
class Listed:
    """Responses along the rays of some receivers, in the order of a :class:`Transport` of theirs.

    Attributes:
        transport: its weights are those of the Gaussians' own opacities.
        responses: of each receiver's pairs, in [0, 1], shape ``(E,)`` float32 on the device.
        alpha_max: clamp of alpha.
    """

    transport: Transport
    responses: tuple[wp.array, ...]
    alpha_max: float

    def with_opacities(self, opacities: np.ndarray) -> Transport:
        """The weights that other opacities (N,) give."""
        seen, device, kernels = self.transport, self.transport.device, _kernels.build(wp.float32)
        opacity = wp.array(opacities, dtype=float, device=device)
        views = []
        for view, response in zip(seen.views, self.responses, strict=True):
            order = wp.ones(len(response), dtype=int, device=device)
            wp.utils.array_scan(order, order, inclusive=False)  # 0, 1, 2, ...
            weight = wp.empty(len(response), dtype=float, device=device)
            inputs = [self.alpha_max, view.start, order, view.gaussian, response, opacity, weight]
            launch(kernels.blend, len(view.start) - 1, inputs, device=device)
            views.append(replace(view, weight=weight))
        return replace(seen, views=tuple(views))


def list_responses(
    gaussians: Gaussians,
    seen: Transport,
    range_db: tuple[float, float],
    *,
    top_k: int = 32,
    progress: Progress | None = None,
) -> Listed:
    """Responses and order along the rays of the receivers of ``seen``, on its device.

    Args:
        seen: weights of the receivers, whose interaction points are kept; made with the ``product`` rule.
        range_db: range of the data set's dB images.
        top_k: Gaussians kept per pixel, those of largest thinned weight.
    """
    rules, device = cutoffs(range_db), seen.device
    share = 0.5  # of each opacity
    thin = replace(gaussians, opacities=(share * gaussians.opacities).astype(np.float32))
    # transmittance at which a list ends: float32 weights give alpha to 0.1 % there
    blending = Blending(share * rules.alpha_min, rules.alpha_max, 1e-4, "product")
    raster = Rasterizer(device=device, blending=blending)
    scene, views, responses = raster.upload(thin), [], []
    pairs_of = list(zip(seen.receivers, seen.views, strict=True))
    for position, view in with_progress(pairs_of, "transport", progress):
        found = strongest(raster, scene, position, seen.shape, top_k)
        start, pairs, _, _ = kept(device, found, 0.0)
        gaussian, response = (wp.empty(pairs, dtype=kind, device=device) for kind in (int, float))
        inputs = [*found[:2], scene[3], start, gaussian, response]
        launch(write_responses, len(start) - 1, inputs, device=device)
        views.append(replace(view, start=start, gaussian=gaussian, weight=response))
        responses.append(response)
    listed = Listed(replace(seen, views=tuple(views)), tuple(responses), rules.alpha_max)
    return replace(listed, transport=listed.with_opacities(gaussians.opacities))


class OpacityTraining:
    """Logits of the opacities of the Gaussians that a problem sees, and their Adam, on the problem's device.

    Args:
        problem: of the transport of ``listed``.
        opacities: to start from, of all Gaussians, shape ``(N,)``.
        state: logits and Adam's moments to go on from, shape ``(3, G)``.
    """

    def __init__(
        self, problem: Problem, listed: Listed, opacities: np.ndarray, state: np.ndarray | None = None
    ) -> None:
        self.problem, self.kernels = problem, _kernels.build(problem.real)
        self.alpha_max = problem.real(listed.alpha_max)
        limits = np.array([1e-4, 1 - 1e-6])  # opacities that logits are made of
        self._limits = [problem.real(x) for x in np.log(limits / (1 - limits))]
        first = np.clip(np.asarray(opacities, np.float64)[problem.seen], *limits)
        if state is None:
            state = np.stack([np.log(first / (1 - first)), np.zeros_like(first), np.zeros_like(first)])
        self._logits, self._first, self._second = (problem.upload(row) for row in state)
        self.pairs = [self._pairs(batch, listed.responses) for batch in problem.batches]
        largest = max(len(b.pair_pixel) for b in problem.batches)
        zeros = partial(wp.zeros, dtype=problem.real, device=problem.device)
        self._weight, self._pair_adjoint = zeros(largest), zeros(largest)
        self.gradient, self._opacity = zeros(len(problem.seen)), zeros(len(problem.seen))
        self._activate()

    def _pairs(self, batch: Pairs, responses: Sequence[wp.array]) -> tuple[wp.array, wp.array]:
        """The row of each pair of a batch, and its response."""
        p = self.problem
        row = wp.empty(len(batch.pair_pixel), dtype=int, device=p.device)
        p.launch(_kernels.owners, len(p.seen), batch.row_start, row)
        own = [responses[r].to(p.device) for r in batch.receivers]
        return row, p.in_order(batch.pair_of_pixel, own)

    @property
    def opacities(self) -> np.ndarray:
        """Opacities of the Gaussians seen, shape ``(G,)``."""
        return self._opacity.numpy()

    @property
    def state(self) -> np.ndarray:
        """Logits and Adam's moments, shape ``(3, G)``."""
        return np.stack([a.numpy() for a in (self._logits, self._first, self._second)])

    def weights(self, index: int) -> wp.array:
        """Blending weights of batch ``index`` as the opacities now are, pair by pair."""
        p, batch = self.problem, self.problem.batches[index]
        p.launch(
            self.kernels.blend, len(batch.pixel_start) - 1, self.alpha_max, batch.pixel_start, batch.pair_of_pixel,
            *self.pairs[index], self._opacity, self._weight,
        )  # fmt: skip
        return self._weight

    def find_gradient(self, index: int, contribution: wp.array, total: wp.array, adjoint: wp.array) -> None:
        """Write the derivative of the loss of batch ``index`` by each logit to ``gradient``."""
        p, batch = self.problem, self.problem.batches[index]
        p.launch(
            self.kernels.blend_adjoint, len(batch.pixel_start) - 1, self.alpha_max, batch.pixel_start,
            batch.pair_of_pixel, *self.pairs[index], self._opacity, contribution, total, adjoint, self._pair_adjoint,
        )  # fmt: skip
        inputs = batch.row_start, self._pair_adjoint, self._opacity, self.gradient
        p.launch(self.kernels.add_rows, len(p.seen), *inputs)

    def step(self, count: int, rate: float) -> None:
        """Adam's step ``count`` (from 1) along the derivative by the logits."""
        p, none = self.problem, wp.empty(0, dtype=self.problem.real, device=self.problem.device)
        p.launch(
            build_adam(p.real), len(p.seen), 1, p.upload(np.array([rate])), *corrections(count), none, none, self.gradient,
            self._first, self._second, self._logits,
        )  # fmt: skip
        self._activate()

    def _activate(self) -> None:
        p = self.problem
        p.launch(self.kernels.activate, len(p.seen), *self._limits, self._logits, self._opacity)
