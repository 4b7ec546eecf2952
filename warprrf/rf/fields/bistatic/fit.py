"""Fitting material groups to readings: damped Gauss-Newton in dB on cached responses.

Of each group the fit learns the weights of its scattering lobes, one permittivity (the Fresnel curve that lobes and
mirror share), the strength of its mirror reflection, and, if asked for, an indirect radiance. All are positive, so
their logarithms are fitted. Priors keep what no spectrum shows near plausible values and tie a surface's scattered and
mirrored shares together, because they split one reflection (S^2 and 1 - S^2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve
from scipy.linalg.blas import ssyrk

from warprrf.rf.fields.bistatic.materials import Layout, Parameters
from warprrf.rf.fields.bistatic.response import Response, jacobian, predict

NEPER = 10.0 / np.log(10.0)
"""Decibels of a neper of power."""
OWN_GAIN = -2
"""In place of a measuring chain's index: readings of one place whose common gain is not known. Their sum tells it."""


@dataclass(frozen=True)
class Target:
    """What was read at one receiver, and how errors of it count.

    Attributes:
        db: readings, 10 log10(P / N0 + 1), shape ``(N,)``.
        trust: by which errors are multiplied: 1 but for readings with noise of their own, 0 for those left out, shape
            ``(N,)``; None for 1.
        censored: readings that only say that there was no more, shape ``(N,)`` bool; None for none.
    """

    db: np.ndarray
    trust: np.ndarray | None = None
    censored: np.ndarray | None = None

    @classmethod
    def joined(cls, targets: Sequence[Target]) -> Target:
        """All readings of ``targets``, one after another."""
        trust = [np.ones(len(t.db)) if t.trust is None else t.trust for t in targets]
        censored = [np.zeros(len(t.db), bool) if t.censored is None else t.censored for t in targets]
        return cls(
            np.concatenate([t.db for t in targets]),
            np.concatenate(trust) if any(t.trust is not None for t in targets) else None,
            np.concatenate(censored) if any(t.censored is not None for t in targets) else None,
        )

    def part(self, index: np.ndarray) -> Target:
        """Some of the readings."""
        return Target(*(None if a is None else a[index] for a in (self.db, self.trust, self.censored)))  # type: ignore[arg-type]

    def trusted(self, trust: np.ndarray) -> Target:
        """The same with errors multiplied by ``trust`` (N,)."""
        return replace(self, trust=trust * (1.0 if self.trust is None else self.trust))

    def gain(self, power: np.ndarray) -> float:
        """Under which predicted powers (N,) in units of the floor have the sum of what was read."""
        known = 1.0 if self.trust is None else self.trust > 0
        return float((known * np.expm1(self.db / NEPER)).sum() / max((known * power).sum(), 1e-300))

    def error(self, power: np.ndarray) -> np.ndarray:
        """Error of predicted powers ``(..., N)`` in units of the floor, as it counts [dB]."""
        error = NEPER * np.log1p(power) - self.db
        if self.censored is not None:
            error = np.where(self.censored, np.maximum(error, 0.0), error)
        return np.asarray(error if self.trust is None else self.trust * error)

    def slope(self, power: np.ndarray) -> np.ndarray:
        """Derivative of :meth:`error` to the power ``(N,)``."""
        slope = NEPER / (1.0 + power)
        if self.censored is not None:
            slope = np.where(self.censored & (NEPER * np.log1p(power) <= self.db), 0.0, slope)
        return np.asarray(slope if self.trust is None else self.trust * slope)


@dataclass(frozen=True)
class Reading:
    """What was read at one receiver, and how that answers to the parameters.

    Attributes:
        response: of the N readings, in units of the floor N0.
        target: what was read.
        chain: measuring chain whose unknown gain they hold, -1 where the gain is known, or :data:`OWN_GAIN`.
        ratio: carrier of the readings over that of the parameters.
    """

    response: Response
    target: Target
    chain: int = -1
    ratio: float = 1.0

    def tied(self, material: np.ndarray) -> Reading:
        """The same by materials instead of groups; ``material`` (G,) is that of each group."""
        return replace(self, response=self.response.tied(material))

    def gain(self, p: Parameters, power: np.ndarray) -> float:
        """Of the measuring chain, or of these readings, where ``power`` (N,) is predicted."""
        return gain_of(self.chain, p, self.target, power)

    def power(self, p: Parameters) -> np.ndarray:
        """Prediction without the chain's gain, in units of the floor, shape ``(N,)``."""
        return predict(self.response, p.at_ratio(self.ratio))

    def error_db(self, p: Parameters) -> np.ndarray:
        """Prediction less what was read, as it counts [dB], shape ``(N,)``."""
        power = self.power(p)
        return self.target.error(self.gain(p, power) * power)

    def linearised(self, p: Parameters, layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """:meth:`error_db` ``(N,)``, its derivatives ``(C, N)`` float32, and the places of those parameters ``(C,)``."""
        power, table, index = jacobian(self.response, p.at_ratio(self.ratio), layout)
        if self.ratio != 1.0:
            slopes = layout.slopes_at_ratio(p, self.ratio)[index]
            index = np.unique(slopes.indices)
            table = np.asarray(slopes[:, index].T @ table)
        gain = self.gain(p, power)
        if self.chain == OWN_GAIN:  # what changes all alike changes nothing
            known = (
                np.ones(len(power)) if self.target.trust is None else (self.target.trust > 0).astype(float)
            )
            alike = table @ known / max(float(known @ power), 1e-300)
            table = table - alike[:, None] * power
        if self.chain != -1:
            power, table = gain * power, np.float32(gain) * table.astype(np.float32)
        if self.chain >= 0:
            table = np.concatenate([table, power[None].astype(np.float32)])
            index = np.append(index, layout.first_chain + self.chain)
        table *= self.target.slope(power).astype(np.float32)
        return self.target.error(power), table, index


def gain_of(chain: int, p: Parameters, target: Target, power: np.ndarray) -> float:
    """Gain of readings of ``chain``, of which ``target`` was read and ``power`` (N,) is predicted in units of the floor."""
    if chain == OWN_GAIN:
        return target.gain(power)
    return float(np.exp(p.log_gains[chain])) if chain >= 0 else 1.0


@dataclass(frozen=True)
class Deviations:
    """Standard deviations of the priors, in nepers but for ``energy``.

    Attributes:
        weight, excess, mirror: of lobe weights, permittivity less one, and mirror share from where the fit starts.
        gain: of the common gain from one.
        chain: of a measuring chain's unknown gain from one.
        energy: of scattered and mirrored shares from a sum of one.
        together: of a group's indirect radiance from the mean group's.
    """

    weight: float = 2.0
    excess: float = 0.8
    mirror: float = 1.5
    gain: float = 1.0
    chain: float = 10.0
    energy: float = 0.25
    together: float = 1.0


@dataclass(frozen=True)
class GroupFit:
    """How groups are fitted.

    Attributes:
        indirect: whether each group has an indirect radiance.
        gain: whether a gain common to all paths is fitted.
        noise_db: standard deviation of an independent reading's error that priors are weighed against [dB]. Errors of a
            view's pixels hang together (one misplaced edge), which a larger value stands for.
        huber_db: larger errors count linearly [dB]: shadows that the geometry puts in the wrong place.
        steps: most steps.
        longest: most that a logarithm changes in one step.
        tolerance: relative fall of the objective that ends the fit.
        deviations: of the priors.
    """

    indirect: bool = False
    gain: bool = False
    noise_db: float = 3.0
    huber_db: float = 3.0
    steps: int = 40
    longest: float = 1.5
    tolerance: float = 1e-3
    deviations: Deviations = Deviations()


@dataclass(frozen=True)
class Fitted:
    """Result of :func:`fit_groups`.

    Attributes:
        parameters: the fitted parameters.
        covariance: of the free ones (Laplace), shape ``(F, F)``; see :class:`Layout`.
        losses: objective after each step, per reading [dB^2].
        steps: steps taken.
    """

    parameters: Parameters
    covariance: np.ndarray
    losses: list[float]
    steps: int


def priors(
    p: Parameters, start: Parameters, layout: Layout, sd: Deviations, area: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of the priors ``(K,)`` and their Jacobian ``(K, F)``: distance to the start and to the mean group,
    energy kept."""
    own = np.arange(layout.groups)
    residuals, rows = [], []

    def add(values: np.ndarray, places: np.ndarray, slope: np.ndarray | float) -> None:
        block = np.zeros((len(values), layout.size))
        np.put_along_axis(block, places.reshape(len(values), -1), slope, axis=1)
        residuals.append(values)
        rows.append(block)

    for j, places in enumerate(layout.weight(own).T):
        add((p.log_weight[:, j] - start.log_weight[:, j]) / sd.weight, places, 1.0 / sd.weight)
    add((p.log_excess - start.log_excess) / sd.excess, layout.excess(own), 1.0 / sd.excess)
    add((p.log_mirror - start.log_mirror) / sd.mirror, layout.mirror(own), 1.0 / sd.mirror)
    if layout.indirect:
        mean = np.average(p.log_indirect, weights=area)
        add((p.log_indirect - mean) / sd.together, layout.radiance(own), 1.0 / sd.together)
    if layout.gain:
        add(np.array([p.log_gain / sd.gain]), np.array([layout.common_gain]), 1.0 / sd.gain)
    if layout.chains:
        add(p.log_gains / sd.chain, layout.first_chain + np.arange(layout.chains), 1.0 / sd.chain)
    shares = np.column_stack([p.weight, np.exp(p.log_mirror)])  # S^2 by lobes, and 1 - S^2
    places = np.column_stack([layout.weight(own), layout.mirror(own)])
    add((shares.sum(axis=1) - 1.0) / sd.energy, places, shares / sd.energy)
    return np.concatenate(residuals), np.concatenate(rows)


def huber(error: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Loss and weight of each error: square up to ``threshold``, linear beyond (Huber 1964)."""
    size = np.abs(error)
    small = size <= threshold
    loss = np.where(small, error**2, threshold * (2 * size - threshold))
    return loss, np.where(small, 1.0, threshold / np.maximum(size, 1e-12))


def objective(readings: Sequence[Reading], p: Parameters, threshold_db: float) -> float:
    """Sum of the robust squares of the readings' errors [dB^2]."""
    return sum(float(huber(r.error_db(p), threshold_db)[0].sum()) for r in readings)


def start_of(readings: Sequence[Reading], start: Parameters, options: GroupFit) -> tuple[Parameters, Layout]:
    """Where a fit starts, with an indirect radiance where one is wanted and none is known, and what is free."""
    chains = max(0, *(r.chain + 1 for r in readings))
    if len(start.log_gains) != chains:
        start = replace(start, log_gains=np.array([_first_gain(readings, start, c) for c in range(chains)]))
    layout = Layout(*start.log_weight.shape, indirect=options.indirect, gain=options.gain, chains=chains)
    if options.indirect and not np.isfinite(start.log_indirect).all():
        start = replace(start, log_indirect=np.full(layout.groups, _dark_level(readings)))
    return start, layout


def fit_groups(
    readings: Sequence[Reading],
    start: Parameters,
    area: np.ndarray,
    options: GroupFit | None = None,
) -> Fitted:
    """Levenberg-Marquardt on the groups' parameters.

    Args:
        readings: of the training receivers.
        start: where the fit starts and the priors centre; ``log_indirect`` is set here if it is -inf.
        area: area of each group [m^2], shape ``(G,)``.
        options: what is free, and how far the fit goes.
    """
    o = options or GroupFit()
    start, layout = start_of(readings, start, o)
    vector, damping, weight = layout.pack(start), 1e-3, 1.0 / o.noise_db**2
    count = max(sum(len(r.target.db) for r in readings), 1)
    hessian, losses, taken = np.eye(layout.size), [], 0

    def total(x: np.ndarray) -> float:
        p = layout.unpack(x)
        prior = priors(p, start, layout, o.deviations, area)[0]
        return weight * objective(readings, p, o.huber_db) + float((prior**2).sum())

    current = total(vector)
    for step in range(o.steps):
        p = layout.unpack(vector)
        hessian, gradient = _normal_equations(readings, p, layout, o)
        r, j = priors(p, start, layout, o.deviations, area)
        hessian += j.T @ j
        gradient += j.T @ r
        improved = False
        for _ in range(8):
            move = solve(hessian + damping * np.diag(np.diag(hessian)), -gradient, assume_a="pos")
            move = np.clip(move, -o.longest, o.longest)
            value = total(vector + move)
            improved = value < current
            if improved:
                break
            damping *= 5.0
        taken = step + 1
        if not improved:
            break
        # Steps that were cut short, or do worse than the quadratic model says, are no sign of having arrived.
        expected = -float(move @ (2.0 * gradient + hessian @ move))
        honest = current - value > 0.5 * expected
        fall = (current - value) / current
        vector, current = vector + move, value
        damping = max(damping * 0.3, 1e-6) if honest else damping * 3.0
        losses.append(current / weight / count)
        if fall < o.tolerance and honest and (np.abs(move) < o.longest).all():
            break
    return Fitted(layout.unpack(vector), np.linalg.inv(hessian), losses, taken)


def _normal_equations(
    readings: Sequence[Reading], p: Parameters, layout: Layout, options: GroupFit
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton matrix and gradient of the data term."""
    hessian, gradient = np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    for reading in readings:
        error, table, index = reading.linearised(p, layout)
        if len(index) == 0:  # nothing that it sees is lit
            continue
        root = np.sqrt(huber(error, options.huber_db)[1]) / options.noise_db
        table *= root.astype(np.float32)
        hessian[np.ix_(index, index)] += ssyrk(1.0, table.T, trans=1)  # its upper triangle
        gradient[index] += table @ (root * error).astype(np.float32)
    return np.triu(hessian) + np.triu(hessian, 1).T, gradient


def _first_gain(readings: Sequence[Reading], start: Parameters, chain: int) -> float:
    """ln of the gain that makes the chain's readings agree with what ``start`` predicts, in the median of their power."""
    ratio = [np.zeros(0)]
    for r in readings:
        read, expected = np.expm1(r.target.db / NEPER), r.power(start)
        known = (read > 0) & (expected > 0) & (True if r.target.censored is None else ~r.target.censored)
        if r.chain == chain:
            ratio.append(np.log(read[known] / expected[known]))
    every = np.concatenate(ratio)
    return float(np.median(every)) if len(every) else 0.0


def _dark_level(readings: Sequence[Reading]) -> float:
    """ln of a radiance that explains what the darkest illuminated pixels hold [1/m^2]."""
    found = []
    for reading in readings:
        base, power = reading.response.indirect.sum(axis=0), np.expm1(reading.target.db / NEPER)
        illuminated = (base > 0) & (power > 0)
        if illuminated.any():
            found.append(np.percentile(np.log(power[illuminated] / base[illuminated]), 20))
    return float(np.median(found)) if found else 0.0
