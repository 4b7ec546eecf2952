"""Where transmitters go: candidates compared by the radio maps that a field has of each, added one at a time.

With several transmitters each receiver takes the one that it gets best. Adding the best one at a time comes close to the best set,
because the more there are, the less another one brings (Nemhauser, Wolsey and Fisher 1978).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warprrf.checks import check_array, check_choice, check_count, check_number
from warprrf.device import Progress
from warprrf.rf.maps.radio_map import MapOptions, radio_map

OBJECTIVES: dict[str, Callable[[np.ndarray, float], float]] = {
    "share": lambda snr_db, level_db: float(np.mean(snr_db >= level_db)),
    "worst tenth": lambda snr_db, level_db: float(np.quantile(snr_db, 0.1)),
    "mean rate": lambda snr_db, level_db: float(np.mean(np.log2(1.0 + 10.0 ** (snr_db / 10.0)))),
}
"""Of cells' signal-to-noise ratios (C,) [dB]: the share of those above a level, what nine of ten exceed, Shannon's rate."""
LEAST_DB = -300.0  # of a cell that gets nothing


def place(
    field: Any,
    candidates: ArrayLike,
    n: int = 1,
    *,
    objective: str = "share",
    level_db: float = 10.0,
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
        Indices of candidates, in the order in which they were added, shape ``(n,)``.

    Raises:
        ValueError: naming the argument; for a candidate where no transmitter can be.

    Example::

        chosen = wr.place(field, ceiling, 2, objective="worst tenth")
    """
    places = check_array("candidates", candidates, (None, 3))
    check_count("n", n, 1, len(places))
    check_choice("objective", objective, OBJECTIVES)
    level = check_number("level_db", level_db)
    found = []
    for k, source in enumerate(places):
        found.append(radio_map(field, height, cell, source, MapOptions(**options)).best_beam_snr_db)
        if progress is not None:
            progress("place", k + 1, len(places))
    return one_by_one(np.stack(found), n, objective, level)


def in_air(snr_db: np.ndarray) -> np.ndarray:
    """Signal-to-noise ratios of candidates' maps [dB], NaN outside the air, in the cells that lie in it, ``(C, cells)``."""
    return np.asarray(np.fmax(snr_db, LEAST_DB)[:, ~np.isnan(snr_db).all(axis=0)])


def one_by_one(snr_db: np.ndarray, n: int, objective: str, level: float = 0.0) -> np.ndarray:
    """What :func:`place` chooses by candidates' maps [dB], NaN outside the air, shape ``(C, Y, X)``."""
    measure, snr_db = OBJECTIVES[objective], in_air(snr_db)
    best, chosen = np.full(snr_db.shape[1], LEAST_DB), list[int]()
    for _ in range(n):
        left = [k for k in range(len(snr_db)) if k not in chosen]
        with_each = [measure(np.maximum(best, snr_db[k]), level) for k in left]
        chosen.append(left[int(np.argmax(with_each))])
        best = np.maximum(best, snr_db[chosen[-1]])
    return np.array(chosen)
