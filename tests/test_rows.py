"""Equal rows are found as NumPy finds them."""

import numpy as np
import pytest

from warprrf.rows import distinct_rows


@pytest.mark.parametrize(("count", "columns", "values"), [(0, 2, 3), (1, 3, 3), (400, 2, 12), (900, 3, 9)])
def test_distinct_rows_are_those_of_numpy(count, columns, values):
    rng = np.random.default_rng(count)
    for rows in (
        rng.integers(0, values, (count, columns)),
        rng.choice([-1.5, -0.0, 0.0, 2.0], (count, columns)),
    ):
        found = distinct_rows(rows)
        known = np.unique(rows, axis=0, return_index=True, return_inverse=True, return_counts=True)[1:]
        for own, other in zip(found, known, strict=True):
            assert np.array_equal(own, other.reshape(-1))
