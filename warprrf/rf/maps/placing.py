"""Where transmitters go: candidates compared by the radio maps that a field has of each.

With several transmitters each receiver takes the one that it gets best. All sets are tried as long as they are few; of more, the
best one is added at a time, which comes close where each brings less the more there are (Nemhauser, Wolsey and Fisher 1978).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from math import comb
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import Number, check_array, check_count, checked, one_of
from warprrf.device import Progress, with_progress
from warprrf.rf.maps.radio_map import MapOptions, radio_map

OBJECTIVES: dict[str, Callable[[np.ndarray, float], float]] = {
    "share": lambda snr_db, level_db: float(np.mean(snr_db >= level_db)),
    "worst tenth": lambda snr_db, level_db: float(np.quantile(snr_db, 0.1)),
    "mean rate": lambda snr_db, level_db: float(np.mean(np.log2(1.0 + 10.0 ** (snr_db / 10.0)))),
}
"""Of cells' signal-to-noise ratios (C,) [dB]: the share of those above a level, what nine of ten exceed, Shannon's rate."""


@checked
def place(
    field: Any,
    candidates: ArrayLike,
    n: int = 1,
    *,
    objective: Annotated[str, one_of(*OBJECTIVES)] = "share",
    level_db: Number = 10.0,
    height: float = 1.5,
    cell: float = 0.5,
    progress: Progress | None = None,
    **options: Any,
) -> np.ndarray:
    """Which of ``candidates`` transmitters should stand at, by the radio maps that the field has of each.

    Args:
        field: a :class:`warprrf.RadioField` with a mesh.
        candidates: positions [m], shape ``(C, 3)``.
        n: how many transmitters.
        objective: of the signal-to-noise ratio of the best beam over the cells of the map: ``"share"`` of cells of
            ``level_db`` or more; ``"worst tenth"``, what nine of ten cells exceed [dB]; ``"mean rate"``, Shannon's.
        level_db: for ``"share"`` [dB].
        height, cell: of the maps [m], as for :meth:`RadioField.radio_map`.
        progress: called as ``progress("place", done, total)``, once for each candidate.
        options: attributes of :class:`~warprrf.rf.maps.radio_map.MapOptions`.

    Returns:
        Indices of candidates, shape ``(n,)``: the best of all sets up to 50,000 (pairs of 300), else in the order in which they
        were added.

    Raises:
        ValueError: naming the argument; for a candidate where no transmitter can be.

    Example::

        chosen = wr.place(field, ceiling, 2, objective="worst tenth")
    """
    places = check_array("candidates", candidates, (None, 3))
    check_count("n", n, 1, len(places))
    asked, every = MapOptions(**options), with_progress(places, "place", progress)
    snr_db = [radio_map(field, height, cell, source, asked).best_beam_snr_db for source in every]
    return best_set(np.stack(snr_db), n, objective, level_db)


def best_set(
    snr_db: np.ndarray, n: int, objective: str, level: float = 0.0, *, most: int = 50_000
) -> np.ndarray:
    """What :func:`place` chooses by candidates' maps [dB], NaN outside the air, shape ``(C, Y, X)``; of more than ``most`` sets not
    all are tried."""
    nothing_db = -300.0  # of a cell that one candidate leaves out, another does not
    measure, cells = OBJECTIVES[objective], np.fmax(snr_db, nothing_db)[:, ~np.isnan(snr_db).all(axis=0)]

    def worth(some: Sequence[int]) -> float:
        return measure(cells[list(some)].max(axis=0), level)

    if comb(len(cells), n) <= most:
        return np.array(max(combinations(range(len(cells)), n), key=worth))
    chosen = list[int]()
    for _ in range(n):
        left = [k for k in range(len(cells)) if k not in chosen]
        chosen.append(max(left, key=lambda k: worth([*chosen, k])))
    return np.array(chosen)
