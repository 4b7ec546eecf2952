"""The groups' fit by Adam, for comparison with Gauss-Newton."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warprrf.rf.fields.bistatic.fit import NEPER, Fitted, GroupFit, Reading, huber, priors, start_of
from warprrf.rf.fields.bistatic.materials import Parameters
from warprrf.rf.fields.bistatic.response import jacobian


def fit_groups_adam(
    readings: Sequence[Reading],
    start: Parameters,
    area: np.ndarray,
    options: GroupFit | None = None,
    *,
    steps: int = 300,
    rate: float = 0.05,
) -> Fitted:
    """The objective of :func:`warprrf.rf.fields.bistatic.fit.fit_groups` by Adam (Kingma and Ba 2015), all readings a
    step."""
    o = options or GroupFit()
    start, layout = start_of(readings, start, o)
    vector, weight = layout.pack(start), 1.0 / o.noise_db**2
    first, second, losses = np.zeros(layout.size), np.zeros(layout.size), []
    count = max(sum(len(r.target_db) for r in readings), 1)
    for step in range(1, steps + 1):
        p = layout.unpack(vector)
        gradient, loss = np.zeros(layout.size), 0.0
        for reading in readings:
            power, table, index = jacobian(reading.response, p, layout)
            error = NEPER * np.log1p(power) - reading.target_db
            value, robust = huber(error, o.huber_db)
            loss += float(value.sum())
            gradient[index] += table @ (weight * robust * error * NEPER / (1.0 + power)).astype(np.float32)
        r, j = priors(p, start, layout, o.deviations, area)
        gradient += j.T @ r
        losses.append((loss + float((r**2).sum()) / weight) / count)
        first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
        decay = 0.5 * (1 + np.cos(np.pi * step / steps))
        slope = (first / (1 - 0.9**step)) / (np.sqrt(second / (1 - 0.999**step)) + 1e-12)
        vector = vector - rate * decay * slope
    return Fitted(layout.unpack(vector), np.eye(layout.size), layout, losses, steps)
