"""Fitting material groups to spectra: damped Gauss-Newton in dB on cached transport, and Adam beside it.

Of each group the fit learns the weights of its scattering lobes, one permittivity (the Fresnel curve that lobes and
mirror share), the strength of its mirror reflection, and, if asked for, an indirect radiance. All are positive, so
their logarithms are fitted. Priors keep what no spectrum shows near plausible values and tie a surface's scattered and
mirrored shares together, because they split one reflection (S^2 and 1 - S^2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import solve
from scipy.linalg.blas import ssyrk

from warprrf.rf.em.half_spaces import fresnel_curves
from warprrf.rf.fields.bistatic.chains import chain_reflection

NEPER = 10.0 / np.log(10.0)
HUBER_DB = 3.0  # larger residuals count linearly: shadows that the geometry puts in the wrong place
MAX_STEPS = 40
LONGEST = 1.5  # change of a logarithm in one step
TOLERANCE = 1e-3  # relative fall of the objective that ends the fit


@dataclass(frozen=True)
class Parameters:
    """Radio parameters of the groups.

    Attributes:
        log_weight: ln of the lobe weights, shape ``(G, L)``; their sum is S^2.
        log_excess: ln(epsilon_r - 1), shape ``(G,)``.
        log_mirror: ln of the share of |Gamma|^2 that is reflected as by a mirror, shape ``(G,)``; 1 - S^2.
        log_indirect: ln of the indirect radiance [1/m^2], shape ``(G,)``; -inf where there is none.
        log_gain: ln of a gain common to all paths (an uncalibrated receiver).
    """

    log_weight: np.ndarray
    log_excess: np.ndarray
    log_mirror: np.ndarray
    log_indirect: np.ndarray
    log_gain: float = 0.0

    @property
    def weight(self) -> np.ndarray:
        """Lobe weights ``(G, L)``."""
        return np.exp(self.log_weight)

    def take(self, index: np.ndarray) -> Parameters:
        """The rows ``index``: of materials to those of groups, say."""
        return replace(
            self, log_weight=self.log_weight[index], log_excess=self.log_excess[index],
            log_mirror=self.log_mirror[index], log_indirect=self.log_indirect[index],
        )  # fmt: skip

    @classmethod
    def prior(cls, groups: int, lobes: int) -> Parameters:
        """What a surface is taken for before any measurement: half scattered, half mirrored, epsilon_r of 4."""
        return cls(
            np.full((groups, lobes), np.log(0.5 / lobes)), np.full(groups, np.log(3.0)), np.full(groups, np.log(0.5)),
            np.full(groups, -np.inf),
        )  # fmt: skip


@dataclass(frozen=True)
class Deviations:
    """Standard deviations of the priors, in nepers but for ``energy``."""

    weight: float = 2.0
    excess: float = 0.8
    mirror: float = 1.5
    indirect: float = 3.0
    gain: float = 1.0
    energy: float = 0.25
    together: float = 1.0


@dataclass(frozen=True)
class View:
    """Cached transport of one training receiver, all powers in units of N0.

    Attributes:
        groups: groups that it sees lit, shape ``(A,)``.
        basis: bounces at unit weight, shape ``(N, A, L, 3)`` float32: pixel, group, lobe, Fresnel component.
        seen: groups that it sees at all, shape ``(B,)``.
        dark: indirect power at unit radiance, shape ``(N, B)`` float32.
        gain: power of each specular path without its reflections, shape ``(K,)``.
        path_group, cosine, turn: groups it meets (-1: none), cosines of incidence and angles between planes of
            incidence, shapes ``(K, 3)``.
        beam: power of each path's beam per pixel, shape ``(K, N)`` float32.
        extra: power that is not fitted, shape ``(N,)``.
        again_group, again: groups that send on light of other surfaces, shape ``(C,)``, and what they send, shape
            ``(N, C)`` float32, per unit of what they scatter of even light.
        target_db: 10 log10(P / N0 + 1), shape ``(N,)``.
    """

    groups: np.ndarray
    basis: np.ndarray
    seen: np.ndarray
    dark: np.ndarray
    gain: np.ndarray
    path_group: np.ndarray
    cosine: np.ndarray
    turn: np.ndarray
    beam: np.ndarray
    extra: np.ndarray
    again_group: np.ndarray
    again: np.ndarray
    target_db: np.ndarray

    def tied(self, material: np.ndarray) -> View:
        """The view by materials instead of groups; ``material`` (G,) is that of each group."""
        own = material[self.groups]
        lit, place = np.unique(own, return_inverse=True)
        shape = self.basis.shape
        basis = np.zeros((shape[0], len(lit), *shape[2:]), np.float32)
        for a, k in enumerate(place.reshape(-1)):
            basis[:, k] += self.basis[:, a]
        seen, dark = _gathered(material[self.seen], self.dark)
        again_group, again = _gathered(material[self.again_group], self.again)
        met = self.path_group >= 0
        owner = np.where(met, material[np.where(met, self.path_group, 0)], -1)
        return replace(
            self, groups=lit, basis=basis, seen=seen, dark=dark, path_group=owner, again_group=again_group, again=again
        )  # fmt: skip

    def pixels(self, chosen: np.ndarray) -> View:
        """Some of its pixels."""
        return replace(
            self, basis=self.basis[chosen], dark=self.dark[chosen], beam=self.beam[:, chosen], extra=self.extra[chosen],
            again=self.again[chosen], target_db=self.target_db[chosen],
        )  # fmt: skip


def _gathered(owner: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (N, C) summed by ``owner`` (C,): the owners, and a column of each."""
    found, place = np.unique(owner, return_inverse=True)
    out = np.zeros((len(columns), len(found)), np.float32)
    for a, k in enumerate(place.reshape(-1)):
        out[:, k] += columns[:, a]
    return found, out


@dataclass(frozen=True)
class Fit:
    """Result of :func:`fit_groups`.

    Attributes:
        parameters: the fitted parameters.
        covariance: of the free ones (Laplace), shape ``(F, F)``; see :class:`Layout`.
        layout: which ones are free.
        losses: objective after each step, per pixel [dB^2].
        steps: steps taken.
    """

    parameters: Parameters
    covariance: np.ndarray
    layout: Layout
    losses: list[float]
    steps: int


class Layout:
    """Order of the free parameters in a vector: per group lobes, excess, mirror, indirect; then the common gain."""

    def __init__(self, groups: int, lobes: int, *, indirect: bool, gain: bool) -> None:
        self.groups, self.lobes, self.indirect, self.gain = groups, lobes, indirect, gain
        self.stride = lobes + 2 + int(indirect)
        self.size = groups * self.stride + int(gain)

    def pack(self, p: Parameters) -> np.ndarray:
        """Vector of ``p``."""
        columns = [p.log_weight, p.log_excess[:, None], p.log_mirror[:, None]]
        if self.indirect:
            columns.append(p.log_indirect[:, None])
        vector = np.concatenate(columns, axis=1).ravel()
        return np.append(vector, p.log_gain) if self.gain else vector

    def unpack(self, vector: np.ndarray) -> Parameters:
        """Parameters of a vector."""
        table = vector[: self.groups * self.stride].reshape(self.groups, self.stride)
        n = self.lobes
        return Parameters(
            table[:, :n].copy(), table[:, n].copy(), table[:, n + 1].copy(),
            table[:, n + 2].copy() if self.indirect else np.full(self.groups, -np.inf),
            float(vector[-1]) if self.gain else 0.0,
        )  # fmt: skip


def specular_power(
    gain: np.ndarray, path_group: np.ndarray, cosine: np.ndarray, turn: np.ndarray, p: Parameters
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Power of specular paths ``(K,)``, and its logarithmic derivatives to the mirror strength and the excess of each
    met group, ``(K, 3)`` (zero where none)."""
    met = path_group >= 0
    own = np.maximum(path_group, 0)
    share, slope = chain_reflection(p.log_excess[own], cosine, turn, met)
    strength = np.where(met, p.log_mirror[own], 0.0).sum(axis=1)
    return np.asarray(gain, float) * np.exp(strength) * share, met.astype(float), slope


def scattered_share(p: Parameters) -> np.ndarray:
    """Share of power that each group scatters under even light, ``(G,)``: lobe weights times 2 int F cos dcos."""
    return p.weight.sum(axis=1) * fresnel_curves().even(p.log_excess)[0]


def predict(view: View, p: Parameters) -> np.ndarray:
    """Power per pixel in units of N0, shape ``(N,)``."""
    curves = fresnel_curves()
    alpha = curves.at(curves.coordinates, p.log_excess[view.groups])[0]
    mixed = (p.weight[view.groups][:, :, None] * alpha[:, None, :]).astype(np.float32)
    power = view.basis.reshape(len(view.basis), -1) @ mixed.ravel()
    power = np.maximum(power, 0.0) + view.extra
    if len(view.again_group):
        power = power + view.again @ scattered_share(p.take(view.again_group)).astype(np.float32)
    power = power + view.dark @ np.exp(p.log_indirect[view.seen]).astype(np.float32)
    strength = specular_power(view.gain, view.path_group, view.cosine, view.turn, p)[0]
    return np.exp(p.log_gain) * (power + strength.astype(np.float32) @ view.beam)


def jacobian(view: View, p: Parameters, layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Power ``(N,)``, its derivatives to what this view depends on ``(N, C)`` and the indices of that ``(C,)``."""
    curves = fresnel_curves()
    alpha, slope = curves.at(curves.coordinates, p.log_excess[view.groups])
    weight = p.weight[view.groups]
    per_lobe = np.einsum("nalm,am->nal", view.basis, alpha.astype(np.float32), optimize=True) * weight.astype(
        np.float32
    )
    to_excess = np.einsum(
        "nalm,alm->na", view.basis, (weight[:, :, None] * slope[:, None, :]).astype(np.float32), optimize=True
    )
    lobes = np.arange(layout.lobes)
    first = layout.stride * view.groups
    # No index stands twice within a block, so that blocks can be added to a table column by column.
    blocks = [
        ((first[:, None] + lobes).ravel(), per_lobe.reshape(len(per_lobe), -1)),
        (first + layout.lobes, to_excess),
    ]
    power = np.maximum(per_lobe.sum(axis=(1, 2)), 0.0) + view.extra
    if len(view.again_group):
        own = p.take(view.again_group)
        even, rise = curves.even(own.log_excess)
        share = own.weight * even[:, None]
        again = view.again[:, :, None] * share.astype(np.float32)
        power = power + again.sum(axis=(1, 2))
        first = layout.stride * view.again_group
        blocks += [
            ((first[:, None] + lobes).ravel(), again.reshape(len(power), -1)),
            (first + layout.lobes, view.again * (own.weight.sum(axis=1) * rise).astype(np.float32)),
        ]
    if layout.indirect:
        dark = view.dark * np.exp(p.log_indirect[view.seen]).astype(np.float32)
        power = power + dark.sum(axis=1)
        blocks.append((layout.stride * view.seen + layout.lobes + 2, dark))
    strength, to_mirror, rise = specular_power(view.gain, view.path_group, view.cosine, view.turn, p)
    power = power + strength.astype(np.float32) @ view.beam
    met = np.unique(view.path_group[view.path_group >= 0])
    if len(met):
        mirror = np.zeros((len(met), len(strength)))
        excess = np.zeros_like(mirror)
        for b in range(view.path_group.shape[1]):
            k = np.flatnonzero(view.path_group[:, b] >= 0)
            row = np.searchsorted(met, view.path_group[k, b])
            mirror[row, k] += strength[k] * to_mirror[k, b]
            excess[row, k] += strength[k] * rise[k, b]
        both = np.concatenate([mirror, excess]).astype(np.float32) @ view.beam
        blocks += [
            (layout.stride * met + layout.lobes + 1, both[: len(met)].T),
            (layout.stride * met + layout.lobes, both[len(met) :].T),
        ]
    scale = np.exp(p.log_gain)
    power = scale * power
    if layout.gain:
        blocks.append((np.array([layout.size - 1]), power[:, None] / scale))
    index = np.unique(np.concatenate([where for where, _ in blocks]))
    table = np.zeros((len(power), len(index)), np.float32)
    for where, columns in blocks:
        table[:, np.searchsorted(index, where)] += columns
    return power, table * np.float32(scale), index


def _priors(
    p: Parameters, start: Parameters, layout: Layout, sd: Deviations, area: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of the priors and their Jacobian: distance to the start and to the mean group, energy kept."""
    G, L = layout.groups, layout.lobes
    own = np.arange(G) * layout.stride
    residuals, rows = [], []

    def add(values: np.ndarray, columns: np.ndarray, slope: Any) -> None:
        block = np.zeros((len(values), layout.size))
        block[np.arange(len(values)), columns] = slope
        residuals.append(values)
        rows.append(block)

    for j in range(L):
        add((p.log_weight[:, j] - start.log_weight[:, j]) / sd.weight, own + j, 1.0 / sd.weight)
    add((p.log_excess - start.log_excess) / sd.excess, own + L, 1.0 / sd.excess)
    add((p.log_mirror - start.log_mirror) / sd.mirror, own + L + 1, 1.0 / sd.mirror)
    if layout.indirect:
        mean = np.average(p.log_indirect, weights=area)
        add((p.log_indirect - mean) / sd.together, own + L + 2, 1.0 / sd.together)
    if layout.gain:
        add(np.array([p.log_gain / sd.gain]), np.array([layout.size - 1]), 1.0 / sd.gain)
    total = p.weight.sum(axis=1) + np.exp(p.log_mirror)
    block = np.zeros((G, layout.size))
    for j in range(L):
        block[np.arange(G), own + j] = p.weight[:, j] / sd.energy
    block[np.arange(G), own + L + 1] = np.exp(p.log_mirror) / sd.energy
    residuals.append((total - 1.0) / sd.energy)
    rows.append(block)
    return np.concatenate(residuals), np.concatenate(rows)


def huber(residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Loss and weight of each residual [dB]."""
    size = np.abs(residual)
    small = size <= HUBER_DB
    return np.where(small, residual**2, HUBER_DB * (2 * size - HUBER_DB)), np.where(
        small, 1.0, HUBER_DB / np.maximum(size, 1e-12)
    )


def objective(views: Sequence[View], p: Parameters) -> float:
    """Sum of the robust squares of the dB image's error."""
    total = 0.0
    for view in views:
        total += float(huber(NEPER * np.log1p(predict(view, p)) - view.target_db)[0].sum())
    return total


def fit_groups(
    views: Sequence[View],
    start: Parameters,
    area: np.ndarray,
    *,
    indirect: bool = False,
    gain: bool = False,
    noise_db: float = 3.0,
    deviations: Deviations | None = None,
    steps: int = MAX_STEPS,
    progress: Any = None,
) -> Fit:
    """Levenberg-Marquardt on the groups' parameters.

    Args:
        views: cached transport of the training receivers.
        start: where the fit starts and the priors centre; ``log_indirect`` is set here if it is -inf.
        area: area of each group [m^2], shape ``(G,)``.
        indirect: whether each group has an indirect radiance.
        gain: whether a common gain is fitted.
        noise_db: standard deviation of an independent pixel's error that priors are weighed against [dB]. Errors of a
            view's pixels hang together (one misplaced edge), which a larger value stands for.
        steps: most steps.
    """
    sd = deviations or Deviations()
    layout = Layout(*start.log_weight.shape, indirect=indirect, gain=gain)
    if indirect and not np.isfinite(start.log_indirect).all():
        start = replace(start, log_indirect=np.full(layout.groups, _dark_level(views)))
    vector, damping = layout.pack(start), 1e-3
    losses: list[float] = []
    weight = 1.0 / noise_db**2
    count = max(sum(len(v.target_db) for v in views), 1)
    hessian = np.eye(layout.size)
    taken = 0

    def total(x: np.ndarray) -> float:
        p = layout.unpack(x)
        return weight * objective(views, p) + float((_priors(p, start, layout, sd, area)[0] ** 2).sum())

    current = total(vector)
    for step in range(steps):
        p = layout.unpack(vector)
        hessian, gradient = normal_equations(views, p, layout, weight)
        r, j = _priors(p, start, layout, sd, area)
        hessian += j.T @ j
        gradient += j.T @ r
        improved = False
        for _ in range(8):
            move = solve(hessian + damping * np.diag(np.diag(hessian)), -gradient, assume_a="pos")
            move = np.clip(move, -LONGEST, LONGEST)
            value = total(vector + move)
            if value < current:
                improved = True
                break
            damping *= 5.0
        taken = step + 1
        if progress is not None:
            progress("fit", taken, steps)
        if not improved:
            break
        # Steps that were cut short, or do worse than the quadratic model says, are no sign of having arrived.
        expected = -float(move @ (2.0 * gradient + hessian @ move))
        honest = current - value > 0.5 * expected
        fall = (current - value) / current
        vector, current = vector + move, value
        damping = max(damping * 0.3, 1e-6) if honest else damping * 3.0
        losses.append(current / weight / count)
        if fall < TOLERANCE and honest and (np.abs(move) < LONGEST).all():
            break
    return Fit(layout.unpack(vector), np.linalg.inv(hessian), layout, losses, taken)


def normal_equations(
    views: Sequence[View], p: Parameters, layout: Layout, weight: float
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and gradient of the data term."""
    hessian, gradient = np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    for view in views:
        power, table, index = jacobian(view, p, layout)
        residual = NEPER * np.log1p(power) - view.target_db
        robust = weight * huber(residual)[1]
        root = np.sqrt(robust)
        table *= (root * NEPER / (1.0 + power))[:, None].astype(np.float32)
        hessian[np.ix_(index, index)] += ssyrk(1.0, table.T)  # its upper triangle
        gradient[index] += table.T @ (root * residual).astype(np.float32)
    return np.triu(hessian) + np.triu(hessian, 1).T, gradient


def fit_groups_adam(
    views: Sequence[View],
    start: Parameters,
    area: np.ndarray,
    *,
    indirect: bool = False,
    noise_db: float = 3.0,
    deviations: Deviations | None = None,
    steps: int = 300,
    rate: float = 0.05,
) -> Fit:
    """The same objective by Adam (Kingma and Ba 2015), all views a step: for comparison with :func:`fit_groups`."""
    sd = deviations or Deviations()
    layout = Layout(*start.log_weight.shape, indirect=indirect, gain=False)
    if indirect and not np.isfinite(start.log_indirect).all():
        start = replace(start, log_indirect=np.full(layout.groups, _dark_level(views)))
    vector, weight = layout.pack(start), 1.0 / noise_db**2
    first, second, losses = np.zeros(layout.size), np.zeros(layout.size), []
    count = max(sum(len(v.target_db) for v in views), 1)
    for step in range(1, steps + 1):
        p = layout.unpack(vector)
        gradient, loss = np.zeros(layout.size), 0.0
        for view in views:
            power, table, index = jacobian(view, p, layout)
            residual = NEPER * np.log1p(power) - view.target_db
            value, robust = huber(residual)
            loss += float(value.sum())
            pull = weight * robust * residual * NEPER / (1.0 + power)
            pull = pull.astype(np.float32)
            gradient[index] += table.T @ pull
        r, j = _priors(p, start, layout, sd, area)
        gradient += j.T @ r
        losses.append((loss + float((r**2).sum()) / weight) / count)
        first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
        decay = 0.5 * (1 + np.cos(np.pi * step / steps))
        vector = vector - rate * decay * (first / (1 - 0.9**step)) / (
            np.sqrt(second / (1 - 0.999**step)) + 1e-12
        )
    return Fit(layout.unpack(vector), np.eye(layout.size), layout, losses, steps)


def _dark_level(views: Sequence[View]) -> float:
    """ln of a radiance that explains what the darkest lit pixels hold [1/m^2]."""
    found = []
    for view in views:
        base, power = view.dark.sum(axis=1), np.expm1(view.target_db / NEPER)
        lit = (base > 0) & (power > 0)
        if lit.any():
            found.append(np.percentile(np.log(power[lit] / base[lit]), 20))
    return float(np.median(found)) if found else 0.0
