"""Training opacities with the rest frozen, as RF-3DGS does: cached responses and order in the place of weights.

A Gaussian's response on a pixel's ray and the order along the ray do not depend on opacities; only the blending weights
do, and those are cheap to make anew. So that Gaussians behind a wall are listed too, and can show when the wall turns
transparent, the lists are made with all opacities thinned: a pixel's list goes down to where the thinned transmittance
is 1e-4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warprrf.device import DeviceLike, Progress
from warprrf.geometry.splats.gaussians import Gaussians
from warprrf.geometry.splats.rasterizer import Blending
from warprrf.kernels.adam import EPSILON, FIRST_DECAY, SECOND_DECAY, corrections
from warprrf.kernels.radio import opacity as _kernels
from warprrf.rf.fields.harmonic.problem import Problem
from warprrf.rf.fields.harmonic.transport import Transport, cutoffs, views


@dataclass(frozen=True)
class Listed:
    """Responses along the rays of some receivers, in the order of a :class:`Transport` of theirs.

    Attributes:
        transport: its weights are those of the Gaussians' own opacities.
        response: of each pair, in [0, 1], shape ``(E,)`` float32.
        alpha_max: clamp of alpha.
    """

    transport: Transport
    response: np.ndarray
    alpha_max: float

    def with_opacities(self, opacities: np.ndarray) -> Transport:
        """The weights that other opacities (N,) give."""
        seen = self.transport
        alpha = np.minimum(opacities[seen.gaussian] * self.response.astype(np.float64), self.alpha_max)
        cumulated = np.concatenate([[0.0], np.cumsum(np.log1p(-alpha))])
        left = np.exp(cumulated[:-1] - cumulated[seen.start[seen.pixel]])
        return replace(seen, weight=(alpha * left).astype(np.float32))


def list_responses(
    gaussians: Gaussians,
    seen: Transport,
    range_db: tuple[float, float],
    *,
    top_k: int = 32,
    device: DeviceLike = None,
    progress: Progress | None = None,
) -> Listed:
    """Responses and order along the rays of the receivers of ``seen``.

    Args:
        gaussians: the frozen geometry.
        seen: weights of the receivers, whose interaction points are kept; made with the ``product`` rule.
        range_db: range of the data set's dB images.
        top_k: Gaussians kept per pixel, those of largest thinned weight.
    """
    rules = cutoffs(range_db)
    share = 0.5  # of each opacity
    thin = replace(gaussians, opacities=(share * gaussians.opacities).astype(np.float32))
    # transmittance at which a list ends: float32 weights give alpha to 0.1 % there
    blending = Blending(share * rules.alpha_min, rules.alpha_max, 1e-4, "product")
    counts, indices, responses = [], [], []
    for view in views(thin, seen.receivers, seen.shape, top_k, blending, device=device, progress=progress):
        weight = np.asarray(view.weight, np.float64)
        listed = (np.asarray(view.index) >= 0) & (weight > 0)
        weight = np.where(listed, weight, 0.0)
        left = 1.0 - (np.cumsum(weight, axis=-1) - weight)
        alpha = weight / np.maximum(left, 1e-12)
        index = np.asarray(view.index)[listed]
        counts.append(np.count_nonzero(listed, axis=-1).ravel())
        indices.append(index)
        responses.append(np.minimum(alpha[listed] / thin.opacities[index], 1.0).astype(np.float32))
    start = np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64)
    gaussian = np.concatenate(indices).astype(np.int32)
    response = np.concatenate(responses)
    blank = replace(seen, start=start, gaussian=gaussian, weight=np.zeros(len(gaussian), np.float32))
    found = Listed(blank, response, rules.alpha_max)
    own = found.with_opacities(np.asarray(gaussians.opacities, np.float64))
    return replace(found, transport=own)


class OpacityTraining:
    """Logits of the opacities of the Gaussians that a problem sees, and their Adam.

    Args:
        problem: of the transport of ``listed``.
        listed: responses.
        opacities: to start from, of all Gaussians, shape ``(N,)``.
        state: logits and Adam's moments to go on from, shape ``(3, G)``.
    """

    def __init__(
        self, problem: Problem, listed: Listed, opacities: np.ndarray, state: np.ndarray | None = None
    ) -> None:
        self.problem, self.kernels = problem, _kernels.build(problem.real)
        self.alpha_max = problem.real(listed.alpha_max)
        limits = np.array([1e-4, 1 - 1e-6])  # opacities that logits are made of
        self._limits = np.log(limits / (1 - limits))
        first = np.clip(np.asarray(opacities, np.float64)[problem.seen], *limits)
        self.state = np.stack([np.log(first / (1 - first)), np.zeros_like(first), np.zeros_like(first)])
        if state is not None:
            self.state = np.array(state, np.float64)
        responses = replace(listed.transport, weight=listed.response)
        self.pairs = []
        for batch in problem.batches:
            owner = np.repeat(batch.row_gaussian.numpy(), np.diff(batch.row_start.numpy()))
            response = np.empty(len(owner), np.float32)
            response[batch.pair_of_pixel.numpy()] = responses.subset(batch.receivers).weight
            own = wp.array(owner.astype(np.int32), dtype=int, device=problem.device)
            self.pairs.append((own, problem.upload(response)))
        largest = max(len(b.pair_pixel) for b in problem.batches)
        self._weight, self._pair_adjoint = (
            wp.zeros(largest, dtype=problem.real, device=problem.device) for _ in range(2)
        )
        self._opacity = problem.upload(self.opacities)

    @property
    def opacities(self) -> np.ndarray:
        """Opacities of the Gaussians seen, shape ``(G,)``."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.state[0])))

    def weights(self, index: int) -> wp.array:
        """Blending weights of batch ``index`` as the opacities now are, pair by pair."""
        p, batch = self.problem, self.problem.batches[index]
        p.launch(
            self.kernels.blend, len(batch.pixel_start) - 1, self.alpha_max, batch.pixel_start, batch.pair_of_pixel,
            *self.pairs[index], self._opacity, self._weight,
        )  # fmt: skip
        return self._weight

    def gradient(self, index: int, contribution: wp.array, total: wp.array, adjoint: wp.array) -> np.ndarray:
        """Derivative of the loss by each opacity of batch ``index``, shape ``(G,)``."""
        p, batch = self.problem, self.problem.batches[index]
        p.launch(
            self.kernels.blend_adjoint, len(batch.pixel_start) - 1, self.alpha_max, batch.pixel_start,
            batch.pair_of_pixel, *self.pairs[index], self._opacity, contribution, total, adjoint, self._pair_adjoint,
        )  # fmt: skip
        owner = self.pairs[index][0].numpy()
        return np.bincount(owner, weights=self._pair_adjoint.numpy()[: len(owner)], minlength=len(p.seen))

    def step(self, gradient: np.ndarray, count: int, rate: float) -> None:
        """Adam's step ``count`` (from 1) along the derivative by the opacities."""
        opacity = self.opacities
        slope = gradient * opacity * (1.0 - opacity)
        unbias1, unbias2 = corrections(count)
        logits, first, second = self.state
        first = FIRST_DECAY * first + (1 - FIRST_DECAY) * slope
        second = SECOND_DECAY * second + (1 - SECOND_DECAY) * slope**2
        logits = logits - rate * unbias1 * first / (np.sqrt(unbias2 * second) + EPSILON)
        self.state = np.stack([np.clip(logits, *self._limits), first, second])
        self._opacity = self.problem.upload(self.opacities)
