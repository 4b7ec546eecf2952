"""What a field must beat where power was measured: each is fitted to some links and predicts others [dB]."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from benchmarks.measured.links import Links


def log_distance(train: Links, test: Links) -> np.ndarray:
    """A line over the logarithm of the distance."""
    law = np.polyfit(np.log10(train.distance_m), train.level_db, 1)
    return np.polyval(law, np.log10(test.distance_m))


def multi_wall(train: Links, test: Links) -> np.ndarray:
    """COST 231's multi-wall model (final report, 4.7.2): free space, a constant, and a loss for each kind of wall crossed."""
    return _walls(train, test, [np.ones(len(train)), *train.walls.T], free_space=True)


def multi_wall_exponent(train: Links, test: Links) -> np.ndarray:
    """The same with the distance's exponent fitted too."""
    return _walls(
        train, test, [np.ones(len(train)), np.log10(train.distance_m), *train.walls.T], free_space=False
    )


def _walls(train: Links, test: Links, columns: list[np.ndarray], free_space: bool) -> np.ndarray:
    known = np.stack(columns, axis=1).astype(float)
    asked = [np.ones(len(test)), *([] if free_space else [np.log10(test.distance_m)]), *test.walls.T]
    spread = [-20.0 * np.log10(links.distance_m) if free_space else 0.0 for links in (train, test)]
    law = np.linalg.lstsq(known, train.level_db - spread[0], rcond=None)[0]
    return np.asarray(np.stack(asked, axis=1) @ law + spread[1])


def nearest(train: Links, test: Links) -> np.ndarray:
    """The mean of the known link whose ends lie nearest: the same place under the nearest anchor, or a place beside it."""
    apart = _apart(test.senders, train.senders) + _apart(test.receivers, train.receivers)
    return np.asarray(train.level_db[apart.argmin(axis=1)])


def gaussian_process(train: Links, test: Links) -> np.ndarray:
    """A Gaussian process over both ends, on the log-distance law.

    The kernel is squared exponential with a length for either end; lengths, spread and noise are those of the largest
    marginal likelihood.
    """
    level = train.level_db - log_distance(train, train)
    ends = [_apart(train.senders, train.senders) ** 2, _apart(train.receivers, train.receivers) ** 2]

    def kernel(log: np.ndarray, squares: list[np.ndarray]) -> np.ndarray:
        exponent = sum(
            square * np.exp(-2.0 * length) for square, length in zip(squares, log[:2], strict=True)
        )
        return np.asarray(np.exp(2.0 * log[2] - 0.5 * exponent))

    def solved(log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        factor = cho_factor(kernel(log, ends) + np.exp(2.0 * log[3]) * np.eye(len(level)), lower=True)
        return factor[0], cho_solve(factor, level)

    def loss(log: np.ndarray) -> float:
        factor, weights = solved(log)
        return float(0.5 * level @ weights + np.log(np.diag(factor)).sum())

    start = np.log([2.0, 1.0, level.std(), 1.5])
    bounds = [(np.log(0.1), np.log(30.0))] * 2 + [(np.log(0.3), np.log(30.0))] * 2
    best = minimize(loss, start, method="L-BFGS-B", bounds=bounds).x
    across = [_apart(test.senders, train.senders) ** 2, _apart(test.receivers, train.receivers) ** 2]
    return np.asarray(log_distance(train, test) + kernel(best, across) @ solved(best)[1])


def _apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(a[:, None] - b, axis=2))


RIVALS = {
    "log-distance": log_distance,
    "multi-wall (COST 231)": multi_wall,
    "multi-wall, exponent fitted": multi_wall_exponent,
    "nearest link": nearest,
    "Gaussian process": gaussian_process,
}
